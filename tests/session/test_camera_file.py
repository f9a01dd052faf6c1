"""A camera's lens from files that other programs write."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from facts import missing_facts

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.session.importers.camera_file import read_camera_file

SIZE = (400, 300)
K = np.array([[890.0, 0, 199.5], [0, 889.0, 148.5], [0, 0, 1]])
D = np.array([-0.1, 0.05, 0.001, -0.002, 0.01])
SAMPLE = {
    "image_width": 400, "image_height": 300, "fisheye_model": 0, "camera_matrix": K,
    "distortion_coefficients": D[:, None], "per_view_reprojection_errors": np.ones((10, 1)),
}  # fmt: skip
ROS = {
    "image_width": 400,
    "image_height": 300,
    "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": D.tolist()},
    "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
}
RATIONAL = np.array([0.4, 0.1, 0, 0, 0.2, 3.0, -4.0, 9.0])
CAM0 = {
    "camera_model": "pinhole",
    "distortion_coeffs": D[:4].tolist(),
    "distortion_model": "radtan",
    "intrinsics": [890.0, 889.0, 199.5, 148.5],
    "resolution": [400, 300],
}
MATLAB = {  # rows first, pixels counted from 1, and the matrix transposed
    "ImageSize": [300, 400],
    "IntrinsicMatrix": [[890.0, 0, 0], [0, 889.0, 0], [200.5, 149.5, 1]],
    "RadialDistortion": [-0.1, 0.05, 0.01],
    "TangentialDistortion": [0.001, -0.002],
}


def opencv(path: Path, entries: dict[str, Any]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in entries.items():
        storage.write(key, value)
    storage.release()
    return path


def text(path: Path, entries: dict[str, Any]) -> Path:
    dump = json.dumps if path.suffix == ".json" else yaml.safe_dump
    path.write_text(dump(entries))
    return path


@pytest.mark.process
@pytest.mark.parametrize(
    ("write", "name", "entries"),
    [
        (opencv, "a.yml", SAMPLE),
        (opencv, "a.xml", {"Camera_Matrix": K, "Distortion_Coefficients": D, "image_Width": 400,
                           "image_Height": 300}),
        (text, "ros.yaml", ROS),
        (text, "camchain.yaml", {"cam0": CAM0}),
        (text, "matlab.json", {"cameraParams": MATLAB}),
        (text, "matlab.yaml", {**MATLAB, "FocalLength": [890.0, 889.0]}),
    ],
)  # fmt: skip
def test_a_lens_is_read(
    write: Callable[[Path, dict[str, Any]], Path],
    name: str,
    entries: dict[str, Any],
    tmp_path: Path,
) -> None:
    found = read_camera_file(write(tmp_path / name, entries), SIZE)
    np.testing.assert_allclose(found.lens.K, K)
    np.testing.assert_allclose(found.lens.D[:4], D[:4])
    assert found.lens.size == SIZE and found.focal_sigma is None
    assert all(note.startswith("not used: ") for note in found.notes)


@pytest.mark.process
def test_a_lens_of_larger_images_is_scaled(tmp_path: Path) -> None:
    large = Lens(K, D, SIZE).resize(4)
    entries = {**SAMPLE, "camera_matrix": large.K, "image_width": 1600, "image_height": 1200}
    found = read_camera_file(opencv(tmp_path / "a.yml", entries), SIZE)
    np.testing.assert_allclose(found.lens.K, K)
    unused, scaled = found.notes
    assert "per_view_reprojection_errors" in unused
    assert not missing_facts(scaled, "1600x1200", "400x300")


@pytest.mark.process
@pytest.mark.parametrize(
    ("changed", "facts"),
    [
        ({"image_width": 1600}, ("1600x300", "400x300")),
        ({"fisheye_model": 1}, ("fisheye", "5", "4")),
        ({"distortion_coefficients": RATIONAL}, ("8", "residual")),
        ({"camera_matrix": np.array([[8.0, 0, 2], [0, 8, 1.5], [0, 0, 1]])}, ("8", "mm", "400")),
        ({"camera_matrix": np.eye(2)}, ("camera_matrix", "3x3")),
    ],
)
def test_a_lens_that_does_not_fit_is_refused(
    changed: dict[str, Any], facts: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(InputError) as caught:
        read_camera_file(opencv(tmp_path / "a.yml", {**SAMPLE, **changed}), SIZE)
    assert missing_facts(str(caught.value), "a.yml", *facts) == []


@pytest.mark.process
@pytest.mark.parametrize(
    ("entries", "facts"),
    [
        ({**ROS, "distortion_model": "equidistant"}, ("equidistant",)),
        ({"cam0": {**CAM0, "camera_model": "omni"}}, ("omni",)),
        ({"cam0": CAM0, "cam1": {**CAM0, "intrinsics": [900, 900, 200, 150]}}, ("cam0", "cam1")),
        ({"camera_matrix": (4 * K).tolist()}, ("798", "400x300")),
    ],
)
def test_other_models_and_several_cameras_are_refused(
    entries: dict[str, Any], facts: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(InputError) as caught:
        read_camera_file(text(tmp_path / "a.yaml", entries), SIZE)
    assert missing_facts(str(caught.value), *facts) == []


COLMAP = "# Camera list\n1 OPENCV 400 300 890.0 889.0 200.0 149.0 -0.1 0.05 0.001 -0.002\n"
METASHAPE = (
    "<calibration><projection>frame</projection><width>400</width><height>300</height>"
    "<f>889</f><cx>0</cx><cy>-1</cy><b1>1</b1><k1>-0.1</k1><k2>0.05</k2><k3>0.01</k3>"
    "<p1>-0.002</p1><p2>0.001</p2></calibration>"
)


@pytest.mark.process
@pytest.mark.parametrize(("name", "content"), [("cameras.txt", COLMAP), ("a.xml", METASHAPE)])
def test_pixels_that_count_from_the_corner(name: str, content: str, tmp_path: Path) -> None:
    """Both makers put the centre of the first pixel at 0.5; Metashape exchanges p1 and p2."""
    (tmp_path / name).write_text(content)
    found = read_camera_file(tmp_path / name, SIZE)
    np.testing.assert_allclose(found.lens.K, K)
    np.testing.assert_allclose(found.lens.D[:4], D[:4])
    assert found.notes == ()


@pytest.mark.process
@pytest.mark.parametrize(
    ("name", "content", "facts"),
    [
        ("a.pkl", b"\x80\x04}.", ("pickle", "savez")),
        ("cameras.bin", b"\1\0\0\0", ("COLMAP", "cameras.txt")),
        ("a.cal", b"# c\nParGroup: Camera: Parameter;", ("HALCON",)),
        ("a.xml", METASHAPE.replace("<cx>", "<k4>1</k4><cx>").encode(), ("Metashape", "k4")),
        ("cameras.txt", COLMAP.replace("OPENCV", "FOV").encode(), ("COLMAP", "FOV")),
        ("a.json", b'{"views": [], "intrinsics": [{"width": "4"}]}', ("Meshroom",)),
    ],
)
def test_makers_of_other_files_are_named(
    name: str, content: bytes, facts: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_camera_file(tmp_path / name, SIZE)
    assert missing_facts(str(caught.value), name, *facts) == []
