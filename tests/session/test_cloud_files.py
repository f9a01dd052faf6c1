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
from slviewer.session.shape_files import describe_loss, write_shape
from slviewer.session.units import MM
from slviewer.surface.shapes import PointSet
from tests.facts import missing_facts

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
    write_shape(path, PointSet(POINTS, NORMALS, COLOURS))


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
        ("a.e57", write_e57, True, True),
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
        ("a.csv", "1,5,2,5,3,5\n" * 200, "decimal points"),
        ("a.pts", "300\n" + "1 2 3\n" * 200, "announces 300 points and 200 follow"),
        ("a.csv", "East;North;Height\n" + "1;2;3\n" * 200, "East, North, Height"),
        ("a.xyz", "1 2 3\n" * 200 + "1 2\n", "truncated"),
        ("a.xyz", "nan nan nan\n" * 200, "all 200 points"),
        ("a.xyz", "1 2 3\n" * 200, "different places"),
        ("a.pcd", "VERSION 0.7\n", "DATA"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\n", "damaged"),
        ("a.dxf", "x", r"give \.ply, "),
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


def test_points_far_from_each_other_are_refused(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.xyz", np.append(POINTS, [[500_000, 0, 0]], axis=0), "%.3f")
    with pytest.raises(SlviewerError, match="5e\\+05 mm across"):
        read_cloud(tmp_path / "a.xyz")


def mark(number: float, style: str) -> str:
    """Write a number with marks between thousands, or with a decimal comma, in quotes."""
    text = f"{number:,.3f}"
    if style == "1.234,5":
        return text.translate(str.maketrans(",.", ".,"))
    return f'"{text}"' if style == '"1,234.5"' else f'"{number:.3f}"'.replace(".", ",")


@pytest.mark.parametrize(
    ("style", "separator"), [('"1,234.5"', ","), ("1.234,5", ";"), ('"1234,5"', ",")]
)
def test_numbers_of_other_countries_are_read(tmp_path: Path, style: str, separator: str) -> None:
    """Quoted cells hold separators, as this name of a column does."""
    points = np.round(100 * POINTS, 3)
    lines = [separator.join(['"Distance, mm"', "x", "y", "z"])]
    lines += [separator.join(["1.5", *(mark(each, style) for each in row)]) for row in points]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    cloud = read(tmp_path / "a.csv")
    assert np.allclose(cloud.points, points) and any("numbers" in note for note in cloud.notes)


@pytest.mark.parametrize("words", [("nan(ind)", "-1.#IND"), ("1.#QNAN", "-nan(ind)")])
def test_numbers_that_windows_calls_none_are_dropped(tmp_path: Path, words: tuple) -> None:
    lines = [f"{x:.3f} {y:.3f} {z:.3f}" for x, y, z in POINTS]
    (tmp_path / "a.xyz").write_text("\n".join([*lines, *(f"1 2 {word}" for word in words)]))
    assert len(read(tmp_path / "a.xyz").points) == len(POINTS)


def test_negative_columns_behind_a_comma_are_no_thousands(tmp_path: Path) -> None:
    text = "\n".join(f"{x:.3f},{y:.3f},{z:.3f},{i}" for i, (x, y, z) in enumerate(-abs(POINTS)))
    (tmp_path / "a.csv").write_text(text)
    assert np.allclose(read(tmp_path / "a.csv").points, -abs(POINTS), atol=1e-3)


def test_normals_of_zeros_are_estimated(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS, None, np.zeros_like(POINTS))
    cloud = read(tmp_path / "a.ply")
    assert cloud.normals is None and "normals" in " ".join(cloud.notes)


def test_pcd_of_old_versions_states_no_number_of_points(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", False)
    lines = (tmp_path / "a.pcd").read_bytes().split(b"\n")
    old = [line for line in lines if not line.startswith(b"POINTS")]
    (tmp_path / "a.pcd").write_bytes(b"\n".join(old))
    assert len(read(tmp_path / "a.pcd").points) == len(POINTS)


def test_points_beside_a_mesh_are_counted(tmp_path: Path) -> None:
    box = trimesh.creation.box((60, 40, 20))
    box.vertices = np.vstack([box.vertices, [[1, 2, 3], [4, 5, 6]]])
    box.export(tmp_path / "a.off")
    assert "2 of 10 points" in " ".join(read(tmp_path / "a.off").notes)


SCALARS = {"temperature": RNG.normal(20, 1, 300), "time": 1.7e9 + RNG.uniform(size=300)}


@pytest.mark.parametrize("suffix", ["ply", "pcd", "csv"])
def test_scalars_and_origin_come_back(tmp_path: Path, suffix: str) -> None:
    """Coordinates as large as a survey's are given back to less than a micrometre, and scalars of
    double precision and unknown ones as they are."""
    origin = np.array([694_000_000.0, 5_155_000_000.0, 120_000.0])
    scalars = SCALARS | {"gaps": np.where(np.arange(300) % 7, 1.5, np.nan).astype(np.float32)}
    path = tmp_path / f"a.{suffix}"
    write_shape(path, PointSet(POINTS, NORMALS, COLOURS, origin=origin), scalars=scalars)
    cloud = read(path)
    assert np.abs(cloud.points - origin - POINTS.astype(np.float32)).max() < 2e-6
    assert list(cloud.scalars) == list(scalars)
    for name, values in scalars.items():
        assert np.array_equal(cloud.scalars[name], values, equal_nan=True)
    assert np.array_equal(cloud.colours, COLOURS)
    assert not cloud.notes


def test_formats_that_hold_less_say_so(tmp_path: Path) -> None:
    shape = PointSet(POINTS, origin=np.array([1e6, 0, 0]))
    assert not describe_loss(tmp_path / "a.ply", shape, SCALARS)
    loss = describe_loss(tmp_path / "a.xyz", shape, SCALARS)
    assert not missing_facts(loss, "temperature", "time", ".csv")
    assert not missing_facts(describe_loss(tmp_path / "a.glb", shape), "origin 1000000 0 0 mm")


@pytest.mark.parametrize(
    ("name", "head", "unit"),
    [
        ("a.csv", "X [m],Y [m],Z [m],T [K]\n", "m"),
        ("a.csv", "index;x_cm;y_cm;z_cm\n", "cm"),
        ("a.txt", "x\ty\tz\tt\nm\tm\tm\ts\n", "m"),
        ("a.xyz", "# units: inches\n", "inch"),
        ("a.xyz", "// all coordinates in metres\n", "m"),
        ("a.xyz", "# made in 2 m distance, unit=mm\n", "mm"),
        ("a.obj", "# File units = centimeters\n", "cm"),
        ("a.pcd", "# units m\n", "m"),
        ("a.ply", "comment Unit: meter\n", "m"),
        ("a.ply", "comment made elsewhere\n", "mm"),
    ],
)
def test_units_that_a_file_states_are_obeyed(
    tmp_path: Path, name: str, head: str, unit: str
) -> None:
    path, points = tmp_path / name, np.round(POINTS / 10, 3)
    separator = next((each for each in ",;\t" if each in head), " ")
    columns = 4 if separator != " " else 3
    table = np.column_stack([np.arange(300) if "index" in head else points[:, 0], points])
    if "index" not in head:
        table = np.column_stack([points, points[:, 0]])
    rows = "".join(separator.join(f"{v:.3f}" for v in row[:columns]) + "\n" for row in table)
    if name == "a.obj":
        rows = "".join(f"v {row}\n" for row in rows.splitlines())
    if name == "a.pcd":
        head += "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300\n"
        head += "HEIGHT 1\nPOINTS 300\nDATA ascii\n"
    if name == "a.ply":
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\n{head}element vertex 300\n{axes}end_header\n"
    path.write_text(head + rows)
    cloud = read(path)
    assert cloud.unit == unit
    assert np.abs(cloud.points - MM[cloud.unit] * points).max() < 1e-3
    given = read_cloud(path, "cm")[1][0]
    assert given.unit == "cm"
    if unit != "cm" and "elsewhere" not in head:
        assert not missing_facts(" ".join(given.notes), f"states {unit}", "in cm")


def test_units_that_are_not_read_are_refused(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.xyz", POINTS, "%.3f", header="units: micrometers")
    with pytest.raises(SlviewerError, match=r"um.*--unit"):
        read_cloud(tmp_path / "a.xyz")


@pytest.mark.parametrize(
    ("size", "unit", "named"),
    [(0.05, "mm", ["m"]), (50.0, "mm", []), (50_000.0, "m", ["mm", "cm", "inch"])],
)
def test_unlikely_sizes_name_the_units_that_fit(size: float, unit: str, named: list[str]) -> None:
    points = np.array([[0.0, 0, 0], [size, 0, 0]])
    warning = unit_warning("a", points, unit)  # type: ignore[arg-type]
    assert re.findall(r"--unit (\w+)", warning) == named


def test_whole_numbers_of_three_digits_are_no_thousands(tmp_path: Path) -> None:
    """A table of pixels and depths: 100,200,500.12."""
    u, v = np.mgrid[100:140, 200:240].reshape(2, -1)
    table = np.column_stack([u, v, 500 + 0.013 * u])
    path = tmp_path / "depths.csv"
    np.savetxt(path, table, ["%d", "%d", "%.3f"], delimiter=",")
    np.testing.assert_allclose(read(path).points, table, atol=1e-3)


def test_coordinates_of_a_ply_in_capitals_are_read(tmp_path: Path) -> None:
    properties = "\n".join(f"property float {axis}" for axis in "XYZ")
    head = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n{properties}\nend_header\n"
    with (tmp_path / "a.ply").open("w") as file:
        file.write(head)
        np.savetxt(file, POINTS, "%.4f")
    np.testing.assert_allclose(read(tmp_path / "a.ply").points, POINTS, atol=1e-3)
