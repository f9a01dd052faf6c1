"""PLY: what is written is read back, by us and by others, and a failed write leaves no trace."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from facts import raises

from slviewer.errors import InputError, SlviewerError
from slviewer.session.ply import read_ply, write_ply

RNG = np.random.default_rng(0)
POINTS = RNG.normal(0, 100, (50, 3)).astype(np.float32)
COLOURS = RNG.integers(0, 256, (50, 3), dtype=np.uint8)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
FACES = RNG.permuted(np.tile(np.arange(50), (20, 1)), axis=1)[:, :3].astype(np.int32)
SIGMA = RNG.random(50).astype(np.float32)


def test_everything_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(path, POINTS, COLOURS, NORMALS, {"sigma_z": SIGMA}, FACES)
    ply = read_ply(path)
    for found, truth in (
        (ply.points, POINTS),
        (ply.colours, COLOURS),
        (ply.normals, NORMALS),
        (ply.scalars["sigma_z"], SIGMA),
        (ply.faces, FACES),
    ):
        assert found is not None
        assert np.array_equal(found, truth)
        assert found.dtype == truth.dtype
    assert b"comment slviewer: units mm" in path.read_bytes()[:200]
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]


def test_points_alone_and_grey(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS.astype(np.float64))
    ply = read_ply(tmp_path / "a.ply")
    assert np.array_equal(ply.points, POINTS)
    assert ply.colours is None and ply.normals is None and ply.faces is None and ply.scalars == {}
    write_ply(tmp_path / "a.ply", POINTS, colours=COLOURS[:, 0])  # over an older one
    colours = read_ply(tmp_path / "a.ply").colours
    assert colours is not None and np.array_equal(colours, np.repeat(COLOURS[:, :1], 3, axis=1))
    write_ply(tmp_path / "none.ply", np.empty((0, 3)))
    assert read_ply(tmp_path / "none.ply").points.shape == (0, 3)


def test_trimesh_reads_it(tmp_path: Path) -> None:
    write_ply(tmp_path / "mesh.ply", POINTS, COLOURS, NORMALS, {"sigma_z": SIGMA}, FACES)
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    assert np.array_equal(mesh.vertices, POINTS)
    assert np.array_equal(mesh.faces, FACES)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], COLOURS)
    write_ply(tmp_path / "cloud.ply", POINTS, COLOURS)
    assert np.array_equal(trimesh.load(tmp_path / "cloud.ply").vertices, POINTS)


def test_open3d_reads_it(tmp_path: Path) -> None:
    from slviewer.registration.open3d_loader import open3d

    write_ply(tmp_path / "cloud.ply", POINTS, COLOURS, NORMALS, {"sigma_z": SIGMA})
    cloud = open3d().io.read_point_cloud(str(tmp_path / "cloud.ply"))
    assert np.array_equal(np.asarray(cloud.points), POINTS)
    assert np.allclose(np.asarray(cloud.colors) * 255, COLOURS)
    assert np.allclose(np.asarray(cloud.normals), NORMALS)


def test_what_is_not_known_is_no_nan_in_the_file(tmp_path: Path) -> None:
    normals, sigma = NORMALS.copy(), SIGMA.copy()
    normals[:3], sigma[5] = np.nan, np.nan
    write_ply(
        tmp_path / "a.ply",
        POINTS,
        normals=normals,
        scalars={"sigma_noise": sigma},
        notes=["é\nof a scan"],
    )
    ply = read_ply(tmp_path / "a.ply")
    assert ply.normals is not None and np.isnan(ply.normals[:3]).all()
    assert np.array_equal(ply.normals[3:], NORMALS[3:])
    assert np.isnan(ply.scalars["sigma_noise"][5]) and np.array_equal(
        ply.scalars["sigma_noise"][6:], SIGMA[6:]
    )
    assert b"comment ? of a scan\n" in (tmp_path / "a.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ({"points": np.zeros((2, 3, 3))}, ("(2, 3, 3)", "(n, 3)")),
        ({"points": np.full((2, 3), np.nan)}, ("NaN",)),
        ({"colours": COLOURS[:10]}, ("colours", "(10, 3)", "50 points")),
        ({"colours": COLOURS / 255}, ("colours", "float64", "uint8")),
        ({"normals": NORMALS[:, :2]}, ("normals", "(50, 2)", "50 points")),
        ({"scalars": {"a b": SIGMA}}, ("'a b'", "property")),
        ({"scalars": {"x": SIGMA}}, ("'x'", "property")),
        ({"scalars": {"a": SIGMA[:3]}}, ("a", "(3,)", "50 points")),
        ({"faces": [[0, 1, 50]]}, ("(1, 3)", "below 50")),
        ({"faces": [[0, 1]]}, ("(1, 2)", "(m, 3)")),
    ],
)
def test_what_does_not_fit_is_refused(
    tmp_path: Path, arguments: dict, facts: tuple[str, ...]
) -> None:
    with raises(InputError, *facts):
        write_ply(tmp_path / "a.ply", **{"points": POINTS, **arguments})
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, POINTS)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SlviewerError):
        write_ply(path, POINTS[:3])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]
    with pytest.raises(SlviewerError):
        write_ply(path / "a.ply", POINTS)  # below a file


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(InputError):
        read_ply(path)
    path.write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    with raises(InputError, "a.ply", "little-endian"):
        read_ply(path)
    path.write_bytes(b"")
    with raises(InputError, "a.ply", "little-endian"):
        read_ply(path)
    write_ply(path, POINTS)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError):
        read_ply(path)
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty short q\nend_header\n"
    )
    with raises(InputError, "a.ply", "q"):
        read_ply(path)
