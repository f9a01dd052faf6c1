"""A stereo calibration made elsewhere, in an OpenCV FileStorage file (YAML, XML or JSON)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError

ENTRIES = ("K_camera", "D_camera", "K_projector", "D_projector", "R", "T")

_ROTATION_TOLERANCE = 1e-4  # a matrix written with five digits still passes
_SHORTEST_BASELINE_MM = 1.0


_SPELLINGS: tuple[tuple[str, ...], ...] = (
    ENTRIES,
    ("cam_K", "cam_kc", "pro_K", "pro_kc", "R", "T"),  # sltk
    ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),  # SLStudio
    ("cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation"),  # procam-calibration, as it spells it
    ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
    ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
    ("K_cam", "D_cam", "K_proj", "D_proj", "R", "T"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T"),
    ("camera_matrix", "camera_distortion", "projector_matrix", "projector_distortion", "R", "T"),
    ("cameraMatrix", "distCoeffs", "projectorMatrix", "projectorDistCoeffs", "R", "T"),
    ("M1", "D1", "M2", "D2", "R", "T"),  # OpenCV's stereo_calib
    ("K1", "D1", "K2", "D2", "R", "T"),
    ("K1", "dist1", "K2", "dist2", "R", "T"),
)
"""Common names of the entries, each row in the order of `ENTRIES`; a file is taken to use one row as a whole, but for R
and T."""
_TRANSFORMS = ("R", "T"), ("rotation", "translation"), ("rot", "trans")
_SIZES = {
    "camera": ("camera_size", "cam_size", "image_size", "imageSize", ("frameWidth", "frameHeight")),
    "projector": ("projector_size", "pro_size", "proj_size", ("screenResX", "screenResY")),
}
"""Where a file may state sizes, width before height."""


def read(path: Path, keys: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The matrices under the file's own `keys`, given in the order of `ENTRIES`, and named by these.

    K (3, 3) px; D (5,) = (k1, k2, p1, p2, k3); R (3, 3), the nearest rotation to what the file says; T (3,) mm; all
    float64. R and T map camera to projector. Without `keys`, those of `identify_keys`. Raises InputError where an entry
    is missing, has another shape, or says what pinhole and Brown distortion with square axes cannot.
    """
    keys = identify_keys(path) if keys is None else keys
    if len(keys) != len(ENTRIES):
        raise InputError(f"{len(keys)} keys were given: name those of {' '.join(ENTRIES)}, in this order")
    with _open_storage(Path(path)) as storage:
        there = list(storage.root().keys())
        if missing := [key for key in keys if key not in there]:
            raise InputError(
                f"{Path(path).name} has no {', '.join(missing)}: its keys are {', '.join(there) or 'none'}"
            )
        matrices = [_read_matrix(storage.getNode(key), f"{Path(path).name}: {key}") for key in keys]
    where = {entry: f"{Path(path).name}: {key}" for entry, key in zip(ENTRIES, keys, strict=True)}
    values = dict(zip(ENTRIES, matrices, strict=True))
    return {
        "K_camera": _check_intrinsics(values["K_camera"], where["K_camera"]),
        "D_camera": _check_distortion(values["D_camera"], where["D_camera"]),
        "K_projector": _check_intrinsics(values["K_projector"], where["K_projector"]),
        "D_projector": _check_distortion(values["D_projector"], where["D_projector"]),
        "R": _check_rotation(values["R"], where["R"]),
        "T": _check_translation(values["T"], where["T"]),
    }


def identify_keys(path: Path) -> tuple[str, ...]:
    """The file's names for the entries of `ENTRIES`, by the names that are common.

    Raises InputError where they are none of these, or where several would do.
    """
    with _open_storage(Path(path)) as storage:
        there = list(storage.root().keys())
    rows = [(*row[:4], *transform) for row in _SPELLINGS for transform in dict.fromkeys((row[4:], *_TRANSFORMS))]
    matches = list(dict.fromkeys(row for row in rows if set(row) <= set(there)))
    if len(matches) == 1:
        return matches[0]
    remedy = f"name those of {' '.join(ENTRIES)} with --keys; its keys are {', '.join(there) or 'none'}"
    if matches:
        raise InputError(f"{Path(path).name} holds {' and '.join(', '.join(row) for row in matches)}: {remedy}")
    raise InputError(f"the entries of {Path(path).name} have no names that are known here: {remedy}")


def read_sizes(path: Path) -> dict[str, tuple[tuple[int, int], str]]:
    """What a file states as sizes (width, height) px: {"camera" or "projector": (the size, the key that states it)}."""
    sizes = {}
    with _open_storage(Path(path)) as storage:
        there = list(storage.root().keys())
        for device, spellings in _SIZES.items():
            for spelling in spellings:
                keys = (spelling,) if isinstance(spelling, str) else spelling
                if not set(keys) <= set(there):
                    continue
                values = np.concatenate([_read_matrix(storage.getNode(key), key).ravel() for key in keys])
                if values.shape == (2,) and (values >= 1).all() and (values == values.round()).all():
                    sizes[device] = (int(values[0]), int(values[1])), " and ".join(keys)
                    break
    return sizes


@contextmanager
def _open_storage(path: Path) -> Iterator[Any]:
    """Context manager: the root of an OpenCV FileStorage file; InputError where it cannot be read."""
    if not path.is_file():
        raise InputError(f"{path} is no file: give an OpenCV FileStorage file (.yml, .xml or .json)")
    unreadable = f"{path.name} is no OpenCV FileStorage file (.yml, .xml or .json): export the calibration again"
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise InputError(unreadable) from error
    try:
        if not storage.isOpened():
            raise InputError(unreadable)
        yield storage
    finally:
        storage.release()


def _read_matrix(node: Any, where: str) -> np.ndarray:
    """A FileStorage matrix, or numbers in (nested) lists, as float64."""

    def numbers(node: Any) -> Any:
        """Return a node of numbers or nested sequences as a float or nested lists."""
        if node.isSeq():
            return [numbers(node.at(i)) for i in range(node.size())]
        if node.isInt() or node.isReal():
            return node.real()
        raise ValueError

    try:
        if node.isInt() or node.isReal():
            return np.array([node.real()])
        matrix = node.mat() if node.isMap() else np.array(numbers(node), np.float64)
        if matrix is None:
            raise ValueError
        matrix = np.asarray(matrix, np.float64)
    except (ValueError, cv2.error) as error:
        raise InputError(f"{where} is no matrix of numbers: name the key of one") from error
    if not np.isfinite(matrix).all():
        raise InputError(f"{where} holds numbers that are not finite: calibrate again")
    return matrix


def _check_intrinsics(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the camera matrix (3, 3); InputError where it is none, or has skew."""
    if matrix.shape != (3, 3):
        raise InputError(f"{where} has shape {matrix.shape}: a camera matrix is 3x3")
    fx, fy = matrix[0, 0], matrix[1, 1]
    if fx <= 0 or fy <= 0 or not np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1], atol=1e-9):
        raise InputError(f"{where} is no camera matrix (fx 0 cx, 0 fy cy, 0 0 1): check the key")
    if abs(matrix[0, 1]) > 1e-9 * fx:
        raise InputError(f"{where} has a skew of {matrix[0, 1]:g}, which is not modelled here: calibrate without skew")
    return matrix


def _check_distortion(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the distortion (5,) k1 k2 p1 p2 k3; InputError for other non-zero coefficients."""
    coefficients = matrix.ravel()
    if max(matrix.shape, default=0) != coefficients.size or coefficients.size not in (4, 5, 8, 12, 14):
        raise InputError(f"{where} has shape {matrix.shape}: OpenCV's distortion has 4, 5, 8, 12 or 14 coefficients")
    if np.any(coefficients[5:]):
        raise InputError(
            f"{where} has {coefficients.size} coefficients with rational, prism or tilt terms, which k1 k2 p1 p2 k3 "
            "cannot represent: calibrate with five coefficients"
        )
    return np.concatenate([coefficients[:5], np.zeros(max(0, 5 - coefficients.size))])


def _check_rotation(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a matrix; InputError where it is far from one."""
    if matrix.shape != (3, 3):
        raise InputError(f"{where} has shape {matrix.shape}: the rotation from camera to projector is 3x3")
    U, _, Vt = np.linalg.svd(matrix)
    nearest = U @ Vt
    error = np.abs(matrix - nearest).max()
    if error > _ROTATION_TOLERANCE or np.linalg.det(nearest) < 0:
        raise InputError(
            f"{where} is no rotation (off by {error:.2g}, determinant {np.linalg.det(matrix):.3g}): check it"
        )
    return nearest


def _check_translation(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the translation (3,) mm; InputError for another shape or a length near zero."""
    if matrix.shape not in ((3, 1), (1, 3), (3,)):
        raise InputError(f"{where} has shape {matrix.shape}: the translation from camera to projector has 3 numbers")
    translation = matrix.ravel()
    if np.linalg.norm(translation) < _SHORTEST_BASELINE_MM:
        raise InputError(f"{where} is {np.linalg.norm(translation):.3g} long: give the translation in mm")
    return translation
