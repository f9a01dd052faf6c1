"""The parameters of MATLAB's stereo calibration, as `toStruct` and `jsonencode` write them, in
OpenCV's conventions.

MATLAB counts pixels from 1. `IntrinsicMatrix` and `RotationOfCamera2` multiply row vectors, and are
the transposes of OpenCV's; `K` and `PoseCamera2`, of newer versions, are not. Sources:
mathworks.com/help/vision/ref/stereoparameters.html and cameraparameters.html.
"""

from collections.abc import Mapping

import numpy as np

from slviewer.session.importers.filestorage import Storage
from slviewer.session.units import Units

_INTRINSICS = ("IntrinsicMatrix", "K")
_ROTATIONS = (
    "RotationOfCamera2", "PoseCamera2.R", "PoseCamera2.Rotation", "PoseCamera2.A", "PoseCamera2"
)  # fmt: skip
_TRANSLATIONS = (
    "TranslationOfCamera2", "PoseCamera2.Translation", "PoseCamera2.A", "PoseCamera2"
)  # fmt: skip
_FOR_ROWS = ("RotationOfCamera2", "PoseCamera2.Rotation")
_UNITS: dict[str, Units] = {
    "mm": "mm", "millimeter": "mm", "cm": "cm", "centimeter": "cm", "m": "m", "meter": "m",
    "in": "inch", "inch": "inch", "inche": "inch",
}  # fmt: skip
"""Units by the words for them, without a plural's s."""


def list_keys(storage: Storage) -> list[tuple[str, ...]]:
    """The names of K, D, K, D, R and T in each structure of MATLAB's parameters that a file
    holds."""
    rows = []
    for start in (key.removesuffix("CameraParameters1") for key in storage.entries):
        keys = [
            *(
                _choose(storage, f"{start}CameraParameters{number}.", names)
                for number in (1, 2)
                for names in (_INTRINSICS, ("RadialDistortion",))
            ),
            _choose(storage, start, _ROTATIONS),
            _choose(storage, start, _TRANSLATIONS),
        ]
        if f"{start}CameraParameters1" in storage.entries and all(keys):
            rows.append(tuple(keys))
    return rows


def convert_entries(
    storage: Storage, keys: Mapping[str, str], matrices: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the entries of a calibration, {entry: its matrix}, in OpenCV's conventions, where
    names or shapes show that they are in MATLAB's. ``keys``: {entry: its name in the file}."""
    converted = dict(matrices)
    for_rows = is_transposed(matrices["K_camera"]) and is_transposed(matrices["K_projector"])
    for device in ("camera", "projector"):
        K, name = matrices[f"K_{device}"], keys[f"K_{device}"]
        start = name.rpartition(".")[0]
        if for_rows:
            K = K.T
        elif f"{start}.RadialDistortion" not in storage.entries:
            continue  # neither transposed nor named as MATLAB's
        # MATLAB counts pixels from 1
        converted[f"K_{device}"] = K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
        radial = matrices[f"D_{device}"].ravel()
        if radial.size in (2, 3):
            prefix = keys[f"D_{device}"].rpartition("RadialDistortion")[0]
            tangential = storage.entries.get(f"{prefix}TangentialDistortion")
            p = np.zeros(2) if tangential is None else tangential.ravel()[:2]
            # OpenCV's order: k1, k2, p1, p2, k3
            converted[f"D_{device}"] = np.concatenate([radial[:2], p, radial[2:]])
    R, T = matrices["R"], matrices["T"]
    if R.shape == (4, 4):
        converted["R"] = _for_columns(R)[:3, :3]
    elif keys["R"].endswith(_FOR_ROWS) or (for_rows and "PoseCamera2" not in keys["R"]):
        converted["R"] = R.T
    if T.shape == (4, 4):
        converted["T"] = _for_columns(T)[:3, 3]
    return converted


def _for_columns(pose: np.ndarray) -> np.ndarray:
    """Return a transform (4, 4) that multiplies column vectors, from either kind."""
    return pose.T if pose[3, :3].any() else pose


def is_transposed(K: np.ndarray) -> bool:
    """Whether a camera matrix is the transpose of OpenCV's."""
    return K.shape == (3, 3) and bool(K[2, :2].all()) and not K[:2, 2].any()


def read_image_sizes(storage: Storage) -> dict[str, tuple[tuple[int, int], str]]:
    """{"camera" or "projector": (its size (width, height) px, the key that states it)}."""
    sizes = {}
    for key, value in storage.entries.items():
        for device, number in (("camera", 1), ("projector", 2)):
            if key.endswith(f"CameraParameters{number}.ImageSize") and value is not None:
                height, width = (int(each) for each in value.ravel()[:2])
                sizes[device] = (width, height), key
    return sizes


def read_unit(storage: Storage) -> Units | None:
    """The unit that a file states for T; None where it states none."""
    words = (word for key, word in storage.words.items() if key.endswith("WorldUnits"))
    units = {_UNITS.get(w.strip().lower().replace("metre", "meter").rstrip("s")) for w in words}
    return units.pop() if len(units) == 1 else None


def _choose(storage: Storage, start: str, names: tuple[str, ...]) -> str:
    """Return the first of the names under ``start`` that holds numbers; empty where none does."""
    keys = (f"{start}{name}" for name in names)
    return next((key for key in keys if storage.entries.get(key) is not None), "")
