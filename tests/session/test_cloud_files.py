"""Clouds of other scanners are read as they are, or refused with the reason."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from slviewer.errors import SlviewerError
from slviewer.registration.open3d_loader import open3d, point_cloud
from slviewer.session.importers.clouds import ReadCloud, read_cloud, unit_warning
from slviewer.session.ply import write_ply
from slviewer.session.shape_files import write_shape
from slviewer.surface.shapes import PointSet

RNG = np.random.default_rng(0)
POINTS = np.round(RNG.uniform(-50, 50, (300, 3)), 3)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1)[:, None]
COLOURS = RNG.integers(0, 256, (300, 3)).astype(np.uint8)


def read(path: Path) -> ReadCloud:
    (cloud,) = read_cloud(path)[1]
    return cloud


def write_text(path: Path, separator: str, header: str = "") -> None:
    rows = np.hstack([POINTS, NORMALS, COLOURS])
    np.savetxt(path, rows, "%.6f", separator, header=header, comments="")


def write_pcd(path: Path, compressed: bool) -> None:
    cloud = point_cloud(POINTS, NORMALS)
    open3d().io.write_point_cloud(str(path), cloud, write_ascii=False, compressed=compressed)


def write_e57(path: Path) -> None:
    pytest.importorskip("pye57")
    write_shape(path, PointSet(POINTS, None, COLOURS))


def write_text_ply(path: Path) -> None:
    path.write_bytes(trimesh.PointCloud(POINTS, COLOURS).export(file_type="ply", encoding="ascii"))


@pytest.mark.parametrize(
    ("name", "write", "has_normals", "has_colours"),
    [
        ("a.xyz", lambda path: write_text(path, " "), True, True),
        ("a.csv", lambda path: write_text(path, ",", "X,Y,Z,nx,ny,nz,r,g,b"), True, True),
        ("a.pts", lambda path: write_text(path, ";", "300"), True, True),
        ("a.ply", lambda path: write_ply(path, POINTS, COLOURS, NORMALS), True, True),
        ("t.ply", write_text_ply, False, True),
        ("a.pcd", lambda path: write_pcd(path, False), True, False),
        ("c.pcd", lambda path: write_pcd(path, True), True, False),
        ("a.e57", write_e57, False, True),
    ],
)
def test_points_normals_and_colours_are_those_of_the_file(
    tmp_path: Path, name: str, write: Callable[[Path], None], has_normals: bool, has_colours: bool
) -> None:
    write(tmp_path / name)
    cloud = read(tmp_path / name)
    assert np.abs(cloud.points - POINTS).max() < 1e-4
    assert (cloud.normals is not None, cloud.colours is not None) == (has_normals, has_colours)
    if cloud.normals is not None:
        assert np.abs(cloud.normals - NORMALS).max() < 1e-5
    if cloud.colours is not None:
        assert (cloud.colours == COLOURS).all()


def test_nan_and_repeated_points_are_dropped_and_counted(tmp_path: Path) -> None:
    rows = np.vstack([POINTS, np.full((7, 3), np.nan), POINTS[:5]])
    np.savetxt(tmp_path / "a.xyz", rows, "%.3f")
    cloud = read(tmp_path / "a.xyz")
    assert len(cloud.points) == len(POINTS)
    assert "7 of 312" in cloud.notes[0]
    assert "5 of 305" in cloud.notes[1]


@pytest.mark.parametrize("has_normals", [True, False])
@pytest.mark.parametrize("form", ["ascii", "binary", "compressed"])
def test_colours_are_read_from_every_pcd(tmp_path: Path, form: str, has_normals: bool) -> None:
    cloud = open3d().geometry.PointCloud(open3d().utility.Vector3dVector(POINTS))
    colours = np.random.default_rng(1).integers(0, 256, POINTS.shape).astype(np.uint8)
    cloud.colors = open3d().utility.Vector3dVector(colours / 255)
    if has_normals:
        cloud.normals = open3d().utility.Vector3dVector(np.tile([0.0, 0.6, 0.8], (len(POINTS), 1)))
    file, options = tmp_path / "a.pcd", {"write_ascii": form == "ascii"}
    open3d().io.write_point_cloud(str(file), cloud, compressed=form == "compressed", **options)
    found = read(file)
    assert np.array_equal(found.colours, colours)
    assert (found.normals is not None) == has_normals


def test_place_of_the_scanner_is_read_from_pcd(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", False)
    content = (tmp_path / "a.pcd").read_bytes()
    content = content.replace(b"VIEWPOINT 0 0 0", b"VIEWPOINT 1 2 -3")
    (tmp_path / "a.pcd").write_bytes(content)
    cloud = read(tmp_path / "a.pcd")
    assert cloud.sensor is not None
    assert cloud.sensor.tolist() == [1, 2, -3]


def test_mesh_with_large_triangles_gets_places_on_them(tmp_path: Path) -> None:
    trimesh.creation.box((60, 40, 20)).export(tmp_path / "a.stl")
    cloud = read(tmp_path / "a.stl")
    assert 3000 < len(cloud.points) < 50_000
    assert np.isclose(np.abs(cloud.points) / [30, 20, 10], 1).any(axis=1).all()  # on its faces
    assert "8 vertices" in cloud.notes[-1]
    ball = trimesh.creation.icosphere(5, 30.0)
    ball.export(tmp_path / "b.ply")
    dense = read(tmp_path / "b.ply")
    assert len(dense.points) == len(ball.vertices)
    assert dense.normals is not None
    assert (np.sum(dense.normals * dense.points, axis=1) > 29.9).all()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.xyz", "", "three numbers"),
        ("a.xyz", "1,5 2,5 3,5\n" * 200, "decimal points"),
        ("a.xyz", "1 2 3\n" * 200 + "1 2\n", "truncated"),
        ("a.xyz", "nan nan nan\n" * 200, "all 200 points"),
        ("a.xyz", "1 2 3\n" * 200, "different places"),
        ("a.pcd", "VERSION 0.7\n", "DATA"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\n", "damaged"),
        ("a.las", "x", r"give \.ply, "),
        ("a.stl", "", "a.stl"),
    ],
)
def test_unusable_files_are_refused(tmp_path: Path, name: str, content: str, reason: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(SlviewerError, match=reason):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "c.pcd", "a.e57"])
def test_truncated_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "a.ply":
        write_ply(path, POINTS)
    elif name == "a.e57":
        write_e57(path)
    else:
        write_pcd(path, name == "c.pcd")
    path.write_bytes(path.read_bytes()[:-1200])
    with pytest.raises(SlviewerError, match="truncated"):
        read_cloud(path)


def test_points_far_from_the_origin_are_refused(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.xyz", POINTS + 500_000, "%.3f")
    with pytest.raises(SlviewerError, match="5e\\+05 mm"):
        read_cloud(tmp_path / "a.xyz")


@pytest.mark.parametrize(
    ("size", "unit", "named"),
    [(0.05, "mm", ["m"]), (50.0, "mm", []), (50_000.0, "m", ["mm", "cm", "inch"])],
)
def test_unlikely_sizes_name_the_units_that_fit(size: float, unit: str, named: list[str]) -> None:
    points = np.array([[0.0, 0, 0], [size, 0, 0]])
    warning = unit_warning("a", points, unit)  # type: ignore[arg-type]
    assert re.findall(r"--unit (\w+)", warning) == named
