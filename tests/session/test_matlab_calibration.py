"""MATLAB's stereo parameters as `toStruct` and `jsonencode` write them, of both generations of
names, recognised and by --keys."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from slviewer.session.importers.filestorage import Storage, read_storage
from slviewer.session.importers.matlab_calibration import read_image_sizes, read_unit
from slviewer.session.importers.opencv_calibration import identify_keys, read_matrices

K1 = np.array([[530.0, 0, 120], [0, 531.0, 88], [0, 0, 1]])
K2 = np.array([[1400.0, 0, 450], [0, 2800.0, 580], [0, 0, 1]])
D1, D2 = np.array([-0.1, 0.02, 1e-3, -2e-3, 0.004]), np.array([0.05, -0.01, 0, 0, 0])
R, T = cv2.Rodrigues(np.array([0.02, 0.31, -0.01]))[0], np.array([-170.0, 3.0, 40.0])
RIGHT = {
    "K_camera": K1, "D_camera": D1, "K_projector": K2, "D_projector": D2, "R": R, "T": T
}  # fmt: skip


FROM_ONE = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])  # pixels counted from 1


def camera(K: np.ndarray, D: np.ndarray, new: bool, radial: int) -> dict:
    matrix = K + FROM_ONE
    name, written = ("K", matrix) if new else ("IntrinsicMatrix", matrix.T)
    return {
        name: written.tolist(), "RadialDistortion": D[[0, 1, 4]][:radial].tolist(),
        "TangentialDistortion": D[[2, 3]].tolist(), "ImageSize": [180, 240],
        "WorldUnits": "millimeters",
    }  # fmt: skip


def parameters(pose: dict, new: bool = False, radial: int = 3) -> dict:
    cameras = {
        f"CameraParameters{i}": camera(K, D, new, radial) for i, K, D in ((1, K1, D1), (2, K2, D2))
    }
    return cameras | pose


OLD = {"RotationOfCamera2": R.T.tolist(), "TranslationOfCamera2": T.tolist()}
POSE = np.block([[R, T[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
STRUCTS = {
    "old": parameters(OLD),
    "new": parameters({"PoseCamera2": {"R": R.tolist(), "Translation": T.tolist()}}, new=True),
    "matrix": parameters({"PoseCamera2": {"A": POSE.tolist()}}, new=True),
    "rows": parameters({"PoseCamera2": POSE.T.tolist()}, new=True),
    "rigid3d": parameters({"PoseCamera2": {"Rotation": R.T.tolist(), "Translation": T.tolist()}}),
    "both": parameters(OLD, new=True),
    "inside": {"stereoParams": parameters(OLD)},
}


def check_matrices(read: dict[str, np.ndarray]) -> None:
    for entry, matrix in RIGHT.items():
        np.testing.assert_allclose(read[entry], matrix, atol=1e-9, err_msg=entry)


@pytest.mark.process
@pytest.mark.parametrize("name", STRUCTS)
def test_structs_are_recognised(tmp_path: Path, name: str) -> None:
    (tmp_path / "rig.json").write_text(json.dumps(STRUCTS[name]))
    storage = read_storage(tmp_path / "rig.json")
    check_matrices(read_matrices(storage))
    assert read_unit(storage) == "mm"
    assert {device: size for device, (size, _) in read_image_sizes(storage).items()} == {
        "camera": (240, 180), "projector": (240, 180)
    }  # fmt: skip


def flat(**changes: np.ndarray) -> Storage:
    entries = {
        "Ka": K1 + FROM_ONE, "Da": D1, "Kb": K2 + FROM_ONE, "Db": D2, "Rab": R.T, "Tab": T
    }  # fmt: skip
    return Storage("rig.json", entries | changes)


def test_transposed_matrices_of_any_name_are_matlabs() -> None:
    storage = flat()
    transposed = flat(Ka=storage.entries["Ka"].T, Kb=storage.entries["Kb"].T)
    check_matrices(read_matrices(transposed, ("Ka", "Da", "Kb", "Db", "Rab", "Tab")))


def test_two_radial_coefficients_and_another_unit(tmp_path: Path) -> None:
    cut = parameters(OLD, radial=2)
    cut["CameraParameters1"]["WorldUnits"] = cut["CameraParameters2"]["WorldUnits"] = "Inches"
    entries = {
        f"CameraParameters{i}.{key}": np.atleast_1d(np.array(value, float))
        for i in (1, 2)
        for key, value in cut[f"CameraParameters{i}"].items()
        if key != "WorldUnits"
    }
    entries |= {key: np.array(value) for key, value in OLD.items()}
    nested = {"CameraParameters1": None, "CameraParameters2": None}
    storage = Storage("rig.json", entries | nested, {"CameraParameters1.WorldUnits": "Inches"})
    read = read_matrices(storage, identify_keys(storage), 25.4)
    np.testing.assert_allclose(read["D_camera"], [*D1[:4], 0])
    np.testing.assert_allclose(read["T"], 25.4 * T)
    assert read_unit(storage) == "inch"
