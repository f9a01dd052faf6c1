"""Files of reported situations: what is read, noted and refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts, raises
from reports4 import make_case

from slviewer.errors import InputError
from slviewer.session.importers.camera_file import read_camera_file
from slviewer.session.importers.clouds import ReadCloud, read_cloud, unit_warning

Make = Callable[[str], Path]
pytestmark = pytest.mark.computes
FIVE = [-0.080626, -0.05567, 0.000177, -0.000316, 0.868721]


@pytest.fixture
def make(real_data: Path, tmp_path: Path) -> Make:
    """Return the folder of a case, made anew."""
    return lambda name: make_case(real_data, name, tmp_path / "case")


def read(folder: Path, name: str, unit: str | None = None) -> ReadCloud:
    (cloud,) = read_cloud(folder / name, unit)[1]  # type: ignore[arg-type]
    return cloud


def make_points(bump: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) mm and colours (n, 3) of the cases' formula."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-20, 20, (2, 4000))
    z = 600 + 4 * np.sin(x / 6) + 3 * np.cos(y / 5 + 0.4) + 0.05 * x
    z += bump * np.exp(-((x - 6) ** 2 + (y + 5) ** 2) / 20) + rng.normal(0, 0.01, 4000)
    colours = [120 + 60 * np.sin(x / 9), 60 + 40 * np.cos(y / 9), np.full(4000, 200.0)]
    return np.stack([x, y, z], 1), np.stack(colours, 1)


def assert_equal(cloud: ReadCloud, points: np.ndarray, colours: np.ndarray | None = None) -> None:
    assert np.abs(cloud.points - points).max() < 1e-3
    if colours is not None:
        assert cloud.colours is not None
        assert np.abs(cloud.colours - colours).max() <= 1


@pytest.mark.parametrize("end", ["", "_lines"])
def test_cameras_of_ros_are_read_in_both_styles(make: Make, end: str) -> None:
    folder, size = make("02-ros-8-coefficients"), (240, 180)
    plain = read_camera_file(folder / f"plumb{end}.yaml", size)
    np.testing.assert_allclose(plain.lens.D, FIVE, atol=1e-9)
    np.testing.assert_allclose(plain.lens.K[0], [534.4764, 0, 120.9549], atol=1e-6)
    zeros = read_camera_file(folder / f"zeros_says_5{end}.yaml", size)
    np.testing.assert_allclose(zeros.lens.D, FIVE, atol=1e-9)
    for columns in (5, 8):
        rational = read_camera_file(folder / f"eight_says_{columns}{end}.yaml", size)
        assert not missing_facts(" ".join(rational.notes), "rational", 8, "residual")


def test_cameras_as_ini_and_of_matlab_are_read(make: Make) -> None:
    folder = make("03-ini-conf-calibration")
    for name in ("camera.ini", "matlab_new.json", "matlab_old.json", "matlab_intrinsics.json"):
        lens = read_camera_file(folder / name, (240, 180)).lens
        np.testing.assert_allclose([lens.K[0, 0], lens.K[0, 2]], [534.4764, 120.9549], atol=0.01)
    with raises(InputError, "principal point", "image_width"):
        read_camera_file(folder / "stereo.conf", (240, 180))


def test_e57_in_mm_is_questioned(make: Make) -> None:
    folder = make("06-e57-in-mm")
    for name in ("gear", "tooth"):
        cloud = read(folder, f"{name}.e57")
        assert not missing_facts(unit_warning(name, cloud.points, cloud.unit), "--unit mm")


def test_lists_of_vertices_are_skipped_and_named(make: Make) -> None:
    folder, (points, _) = make("07-ply-vertex-lists"), make_points()
    for name in ("pictures_binary", "pictures_ascii", "three_each_binary"):
        cloud = read(folder, f"{name}.ply")
        assert_equal(cloud, points)
        assert cloud.normals is not None
        assert "score" in cloud.scalars and "pictures" in " ".join(cloud.notes)


def test_colours_of_ply_are_kept(make: Make) -> None:
    folder, (points, colours) = make("08-ply-float-colours"), make_points()
    for name in ("floats", "rgba", "diffuse", "big_endian"):
        assert_equal(read(folder, f"{name}.ply"), points, np.rint(colours))
    commas = read(folder, "commas.ply")
    assert_equal(commas, points)
    assert not missing_facts(" ".join(commas.notes), "commas", "decimal")


def test_pcd_of_depth_cameras_is_read(make: Make) -> None:
    folder, (points, colours) = make("09-pcd-viewpoint-rgb"), make_points(6.0)
    for name in ("padded", "compressed"):
        assert_equal(read(folder, f"{name}.pcd", "m"), points, colours.astype(int))
    turned = read(folder, "view_b.pcd", "m")
    assert turned.sensor is not None
    assert not missing_facts(" ".join(turned.notes), "VIEWPOINT", "turned by 20 degrees")
    assert_equal(turned, points)


def test_pts_and_xyz_keep_colours_and_name_the_intensity(make: Make) -> None:
    folder, (points, colours) = make("10-pts-intensity"), make_points()
    for name in ("intensity.pts", "two_blocks.pts"):
        cloud = read(folder, name)
        assert_equal(cloud, points, colours.astype(int))
        assert "intensity" in cloud.scalars
    for name in ("bright.xyz", "one_black_point.xyz"):
        cloud = read(folder, name)
        assert_equal(cloud, points)
        assert cloud.colours is not None


def test_columns_are_taken_by_the_header(make: Make) -> None:
    folder, (points, _) = make("11-csv-columns"), make_points(6.0)
    for name in ("index_first.csv", "name_first.csv", "normals_first.csv", "points3D.txt"):
        cloud = read(folder, name)
        assert_equal(cloud, points)
        assert (cloud.normals is not None) == (name == "normals_first.csv")
        assert (cloud.colours is not None) == (name == "points3D.txt")


def test_obj_keeps_its_colours_and_may_be_points_alone(make: Make) -> None:
    folder = make("18-obj-clouds")
    for name in ("coloured_mesh.obj", "points.obj"):
        cloud = read(folder, name)
        assert cloud.colours is not None
        np.testing.assert_allclose(np.median(cloud.colours[:, [0, 2]], axis=0), [51, 204], atol=1)
