"""What is written for other programs is read back by other programs: as it was, and in its true
size."""

import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pye57
import pytest
import trimesh
from facts import raises

from slviewer.errors import InputError, SlviewerError
from slviewer.registration.open3d_loader import open3d
from slviewer.session.formats import e57
from slviewer.session.importers.clouds import read_cloud
from slviewer.session.shape_files import (
    estimated_bytes,
    mesh_formats,
    own_formats,
    read_mesh_file,
    write_shape,
)
from slviewer.surface.shapes import Mesh, PointSet
from tests.proofs.file_variants.clouds import write_e57

RNG = np.random.default_rng(7)
NOTES = ("calibration: splined", "frame: the camera's")


def bumpy(n: int = 40) -> Mesh:
    """A grid of 60 mm x 60 mm, 600 mm away: normals towards the camera, colours, sigma."""
    y, x = np.mgrid[-30 : 30 : n * 1j, -30 : 30 : n * 1j]
    z = 600 + 3 * np.sin(x / 7) * np.cos(y / 9)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    k = np.arange(n * n).reshape(n, n)
    faces = [[k[:-1, :-1], k[1:, :-1], k[:-1, 1:]], [k[:-1, 1:], k[1:, :-1], k[1:, 1:]]]
    triangles = np.concatenate([np.stack([each.ravel() for each in one], 1) for one in faces])
    triangles = triangles[:, ::-1]  # counter-clockwise seen by the camera
    normals = trimesh.Trimesh(vertices, triangles, process=False).vertex_normals
    colours = RNG.integers(0, 256, (n * n, 3), dtype=np.uint8)
    return Mesh(vertices, triangles, normals, colours, RNG.random(n * n) * 0.05)


MESH = bumpy()
POINTS = PointSet(MESH.vertices, MESH.normals, MESH.colours, MESH.sigma_mm)
SIZE = np.ptp(MESH.vertices, axis=0)


def near(found: np.ndarray, truth: np.ndarray, within: float = 1e-6) -> None:
    """To the seven digits of float32."""
    np.testing.assert_allclose(found, truth, rtol=within, atol=within)


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_trimesh_reads_every_mesh(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"part.{suffix}"
    assert write_shape(path, MESH, notes=NOTES) == path.stat().st_size
    found = trimesh.load(path, process=False, force="mesh", maintain_order=True)
    assert len(found.faces) == len(MESH.faces)
    near(read_mesh_file(path).triangles, MESH.vertices[MESH.faces], 1e-5)  # mm, as it was
    unit = 1000 if suffix == "glb" else 1
    near(unit * found.extents, SIZE, 1e-5)
    if suffix == "stl":
        near(found.triangles, MESH.vertices[MESH.faces])
        near(
            found.face_normals,
            trimesh.Trimesh(MESH.vertices, MESH.faces, process=False).face_normals,
            1e-4,
        )
        return
    turned = [1, -1, -1] if suffix == "glb" else [1, 1, 1]  # y up, z towards the viewer
    near(unit * found.vertices, MESH.vertices * turned)
    assert np.array_equal(found.faces, MESH.faces)
    # beside a material, trimesh keeps the colours as an attribute of the scene's mesh
    if suffix == "glb":
        ((_, found),) = trimesh.load(path, process=False).geometry.items()
        painted = found.visual.vertex_attributes["color"]
    else:
        painted = found.visual.vertex_colors
    assert np.array_equal(painted[:, :3], MESH.colours)
    assert MESH.normals is not None
    near(found.vertex_normals, MESH.normals, 1e-4)


def test_trimesh_reads_3mf_in_millimetres(tmp_path: Path) -> None:
    path = tmp_path / "part.3mf"
    size = write_shape(path, MESH, notes=NOTES)
    scene = trimesh.load_scene(path)
    assert scene.units == "millimeter"
    assert len(scene.to_mesh().faces) == len(MESH.faces)
    near(scene.extents, SIZE, 1e-5)
    assert estimated_bytes("3mf", len(MESH.vertices), len(MESH.faces)) == pytest.approx(
        size, rel=0.5
    )
    with raises(InputError, "cloud.3mf", "triangles", ".ply"):
        write_shape(tmp_path / "cloud.3mf", POINTS)


def test_pye57_reads_points_in_metres_and_their_colours(tmp_path: Path) -> None:
    path = tmp_path / "cloud.e57"
    path.write_text("what was there before")
    size = write_shape(path, POINTS, notes=NOTES)
    file = pye57.E57(str(path))
    found = file.read_scan(0, colors=True, ignore_missing_fields=True)
    file.close()
    near(1000 * np.stack([found[f"cartesian{each}"] for each in "XYZ"], axis=1), POINTS.points)
    assert np.array_equal(
        np.stack([found[f"color{each}"] for each in ("Red", "Green", "Blue")], axis=1),
        POINTS.colours,
    )
    assert estimated_bytes("e57", len(POINTS.points)) == pytest.approx(size, rel=0.05)
    assert [each.name for each in tmp_path.iterdir()] == ["cloud.e57"]


def test_a_missing_package_is_named_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(e57, "find_spec", lambda name: None)
    with raises(SlviewerError, "pye57", ".e57", "pip install 'slviewer["):
        write_shape(tmp_path / "part.e57", POINTS)


def test_3mf_is_written_without_other_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("lxml", "networkx", "trimesh"):
        monkeypatch.setitem(sys.modules, name, None)
    assert write_shape(tmp_path / "part.3mf", MESH, notes=("a < b & c",))
    with zipfile.ZipFile(tmp_path / "part.3mf") as archive:
        assert not archive.testzip()
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    assert len(model.findall(".//{*}triangle")) == len(MESH.faces)
    assert "a < b & c" in "".join(model.itertext())


def test_e57_keeps_the_normals_of_the_points(tmp_path: Path) -> None:
    assert POINTS.normals is not None
    write_shape(tmp_path / "cloud.e57", POINTS)
    _, (cloud,) = read_cloud(tmp_path / "cloud.e57")
    assert cloud.normals is not None
    near(cloud.normals, POINTS.normals, 1e-5)
    near(cloud.points, POINTS.points, 1e-4)


@pytest.mark.parametrize(("top", "has_limits"), [(1, False), (1023, False), (65535, True)])
def test_colours_of_an_e57_are_read_by_its_limits(
    tmp_path: Path, top: int, has_limits: bool
) -> None:
    """Dark colours of 10 or 16 bits look like those of 8 bits, and fractions are no levels."""
    levels = np.rint(POINTS.points[:, 0] - POINTS.points[:, 0].min()) % 100
    kind = "float" if top == 1 else f"int {top}"
    fields = [(f"cartesian{axis}", "double", POINTS.points[:, i]) for i, axis in enumerate("XYZ")]
    fields += [(f"color{name}", kind, levels * top / 255) for name in ("Red", "Green", "Blue")]
    (tmp_path / "a.e57").write_bytes(write_e57(fields, limits=top if has_limits else 0))
    _, (cloud,) = read_cloud(tmp_path / "a.e57")
    assert cloud.colours is not None
    near(cloud.colours[:, 0], levels, 1)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_normals_point_as_the_triangles_do_of_every_format(tmp_path: Path, suffix: str) -> None:
    write_shape(tmp_path / f"a.{suffix}", MESH)
    scene = trimesh.load_scene(tmp_path / f"a.{suffix}", process=False)
    (found,) = scene.dump()  # as programs show it, its node applied
    corners = found.vertices[found.faces]
    winding = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(winding * found.vertex_normals[found.faces[:, 0]], axis=1) > 0).all()


@pytest.mark.parametrize("suffix", ["ply", "stl", "obj", "glb"])
def test_open3d_reads_every_mesh(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"part.{suffix}"
    write_shape(path, MESH, notes=NOTES)
    found = open3d().io.read_triangle_mesh(str(path))
    assert len(found.triangles) == len(MESH.faces)
    corners = np.asarray(found.vertices)[np.asarray(found.triangles)]
    size = np.ptp(corners.reshape(-1, 3), axis=0)
    near((1000 if suffix == "glb" else 1) * size, SIZE, 1e-5)
    if suffix == "stl":
        near(corners, MESH.vertices[MESH.faces])
    else:
        near(
            np.asarray(found.vertex_colors)[np.asarray(found.triangles)] * 255,
            MESH.colours[MESH.faces],
            0.02,
        )  # type: ignore[index]


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "glb"])
def test_clouds_are_read_by_both(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud.{suffix}"
    write_shape(path, POINTS, scalars={"sigma_noise": POINTS.sigma_mm}, notes=NOTES)  # type: ignore[dict-item]
    if suffix == "glb":
        scene = trimesh.load(path)
        near(1000 * scene.extents, SIZE, 1e-5)
        (cloud,) = scene.geometry.values()
        near(1000 * cloud.vertices, POINTS.points)
        assert np.array_equal(cloud.colors[:, :3], POINTS.colours)
        return
    cloud = open3d().io.read_point_cloud(str(path))
    near(np.asarray(cloud.points), POINTS.points)
    if suffix in ("ply", "pcd"):
        assert np.array_equal(np.round(np.asarray(cloud.colors) * 255), POINTS.colours)
        near(np.asarray(cloud.normals), POINTS.normals)  # type: ignore[arg-type]
    if suffix == "ply":
        raw = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
        near(raw["sigma"].ravel(), POINTS.sigma_mm)  # type: ignore[arg-type]
        near(raw["sigma_noise"].ravel(), POINTS.sigma_mm)  # type: ignore[arg-type]


def test_text_is_read_by_whoever_reads_numbers(tmp_path: Path) -> None:
    path = tmp_path / "cloud.xyz"
    write_shape(path, POINTS, notes=NOTES)
    numbers = np.loadtxt(path)
    near(numbers[:, :3], POINTS.points)
    assert np.array_equal(numbers[:, 3:], POINTS.colours)
    found = trimesh.load(path)
    near(found.vertices, POINTS.points)
    assert np.array_equal(found.colors[:, :3], POINTS.colours)
    near(np.asarray(open3d().io.read_point_cloud(str(path)).points), POINTS.points)
    write_shape(path, PointSet(POINTS.points))
    near(trimesh.load(path).vertices, POINTS.points)


@pytest.mark.parametrize("suffix", [each for each in mesh_formats() if each != "3mf"])
def test_units_are_stated_and_sizes_foreseen(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"part.{suffix}"
    size = write_shape(path, MESH, notes=NOTES)
    head = path.read_bytes()[:1500]
    assert b"slviewer" in head and (b"metres" if suffix == "glb" else b"units mm") in head
    assert (suffix == "stl") != (b"splined" in head) and not head.startswith(b"solid")
    foreseen = estimated_bytes(suffix, len(MESH.vertices), len(MESH.faces), scalars=1)
    assert foreseen == pytest.approx(size, rel=0.2 if suffix == "obj" else 0.03)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", mesh_formats())
def test_nothing_unknown_is_nan(tmp_path: Path, suffix: str) -> None:
    assert MESH.normals is not None and MESH.sigma_mm is not None
    normals, sigma = MESH.normals.copy(), MESH.sigma_mm.copy()
    normals[3], sigma[4] = np.nan, np.nan
    holed = Mesh(MESH.vertices, MESH.faces, normals, None, sigma)
    write_shape(tmp_path / f"whole.{suffix}", holed)
    whole = (tmp_path / f"whole.{suffix}").read_bytes()
    if suffix == "obj":
        assert b"nan" not in whole
    found = trimesh.load(tmp_path / f"whole.{suffix}", process=False)
    assert np.isfinite(found.bounds).all()


@pytest.mark.parametrize(
    "suffix", [name for name, form in own_formats().items() if form.takes_points and form.read]
)
def test_what_is_written_is_read_again(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud.{suffix}"
    write_shape(path, POINTS, scalars={"sigma_noise": POINTS.sigma_mm}, notes=NOTES)  # type: ignore[dict-item]
    _, (cloud,) = read_cloud(path)
    near(cloud.points, POINTS.points)
    assert np.array_equal(cloud.colours, POINTS.colours)  # type: ignore[arg-type]
    if suffix in ("ply", "pcd"):
        near(cloud.normals, POINTS.normals)  # type: ignore[arg-type]
        near(cloud.sigma_mm, POINTS.sigma_mm)  # type: ignore[arg-type]


def test_numbers_as_text(tmp_path: Path) -> None:
    values = np.array([[0.0, -0.25, 999.9999999], [-12.5, 5e-7, -4e-7]])
    write_shape(tmp_path / "a.xyz", PointSet(values))
    lines = (tmp_path / "a.xyz").read_bytes().splitlines()
    assert lines[0] == b"0.000000 -0.250000 1000.000000" and b"-0.000000" not in lines[1]
    many = RNG.normal(0, 300, (1000, 3)).astype(np.float32)
    write_shape(tmp_path / "a.xyz", PointSet(many))
    assert np.array_equal(np.loadtxt(tmp_path / "a.xyz").round(6), many.astype(float).round(6))


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with raises(InputError, "a.doc", ".ply", ".stl", ".obj", ".glb", ".3mf"):
        write_shape(tmp_path / "a.doc", MESH)
    with raises(InputError, "a.stl", ".ply", ".xyz", ".glb"):
        write_shape(tmp_path / "a.stl", POINTS)
    with raises(InputError, "a.ply", "NaN"):
        write_shape(tmp_path / "a.ply", PointSet(np.full((3, 3), np.nan)))
    with raises(InputError, "a.glb", "empty"):
        write_shape(tmp_path / "a.glb", PointSet(np.zeros((0, 3))))
    with pytest.raises(InputError):
        write_shape(tmp_path / "a.ply", POINTS, scalars={"deviation": np.zeros(3)})
    assert not list(tmp_path.iterdir())
