"""A stereo calibration made elsewhere, in an OpenCV FileStorage file (YAML, XML or JSON)."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import LARGEST_BASELINE_MM
from slviewer.geometry.rigid import nearest_rotation
from slviewer.session.importers import matlab_calibration
from slviewer.session.importers.filestorage import Storage

ENTRIES = ("K_camera", "D_camera", "K_projector", "D_projector", "R", "T")

_ROTATION_TOLERANCE = 1e-4  # a matrix written with five digits still passes
_SHORTEST_BASELINE_MM = 1.0
_NAMED = 30

_INTRINSICS = (
    ENTRIES[:4],
    ("cam_K", "cam_kc", "pro_K", "pro_kc"),  # sltk
    ("Kc", "kc", "Kp", "kp"),  # SLStudio
    ("cam_int", "cam_dist", "proj_int", "proj_dist"),  # procam-calibration
    ("cam_K", "cam_kc", "proj_K", "proj_kc"),
    ("K_cam", "D_cam", "K_proj", "D_proj"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
    ("camera_matrix", "camera_distortion", "projector_matrix", "projector_distortion"),
    ("cameraMatrix", "distCoeffs", "projectorMatrix", "projectorDistCoeffs"),
    ("M1", "D1", "M2", "D2"),  # OpenCV's stereo_calib
    ("K1", "D1", "K2", "D2"),
    ("K1", "dist1", "K2", "dist2"),
    ("KK_left", "kc_left", "KK_right", "kc_right"),  # Bouguet's toolbox for MATLAB
)
_TRANSFORMS = (
    ENTRIES[4:],
    ("Rp", "Tp"),  # SLStudio
    ("roration", "translation"),  # procam-calibration, as it spells it
    ("rotation", "translation"),
    ("rot", "trans"),
    ("Rlr", "Tlr"),  # SLMaster
)
"""Common names, in the order of `ENTRIES`; a file is taken to use one row of each."""
_SIZES = {
    "camera": ("camera_size", "cam_size", "image_size", "imageSize", ("frameWidth", "frameHeight")),
    "projector": ("projector_size", "pro_size", "proj_size", ("screenResX", "screenResY")),
}
"""Where a file may state sizes, width before height."""


def read_matrices(
    storage: Storage, keys: Sequence[str] | None = None, unit_mm: float = 1.0
) -> dict[str, np.ndarray]:
    """The matrices under the file's own `keys`, given in the order of `ENTRIES`, and named by
    these.

    K (3, 3) px; D (5,) = (k1, k2, p1, p2, k3); R (3, 3), the nearest rotation to what the file
    says; T (3,) mm, of the file's `unit_mm`; all float64. R and T map camera to projector. Without
    `keys`, those of `identify_keys`; MATLAB's are converted. Raises InputError where an entry is
    missing, has another shape, or says what pinhole and Brown distortion with square axes cannot.
    """
    keys = identify_keys(storage) if keys is None else keys
    if len(keys) != len(ENTRIES):
        raise InputError(
            f"{len(keys)} keys were given", f"name those of {' '.join(ENTRIES)}, in this order"
        )
    if missing := [key for key in keys if key not in storage.entries]:
        raise InputError(
            f"{storage.name} has no {', '.join(missing)}: its keys are {_list_keys(storage)}"
        )
    matrices = {entry: storage.matrix(key) for entry, key in zip(ENTRIES, keys, strict=True)}
    if matrices["R"].shape == (3, 4) and {"R1", "R2"} <= set(storage.entries):
        # SLMaster writes P2 in its place; both rectifying rotations contain it
        matrices["R"] = storage.matrix("R2").T @ storage.matrix("R1")
    named = dict(zip(ENTRIES, keys, strict=True))
    matrices = matlab_calibration.convert_entries(storage, named, matrices)
    matrices["T"] = unit_mm * matrices["T"]
    return {
        entry: _CHECKS[entry[0]](matrices[entry], f"{storage.name}: {key}")
        for entry, key in zip(ENTRIES, keys, strict=True)
    }


def identify_keys(storage: Storage) -> tuple[str, ...]:
    """The file's names for the entries of `ENTRIES`, by the names that are common.

    Raises InputError where they are none of these, or where several would do.
    """
    rows = [(*lenses, *transform) for lenses in _INTRINSICS for transform in _TRANSFORMS]
    matches: list[tuple[str, ...]] = [row for row in rows if set(row) <= set(storage.entries)]
    matches += matlab_calibration.list_keys(storage)
    if len(matches) == 1:
        return matches[0]
    remedy = f"name those of {' '.join(ENTRIES)} with --keys; its keys are {_list_keys(storage)}"
    if matches:
        raise InputError(
            f"{storage.name} holds {' and '.join(', '.join(row) for row in matches)}", remedy
        )
    raise InputError(
        f"the entries of {storage.name} have no names that are known here",
        f"{remedy}. A file of one camera is for calibrate --camera",
    )


def read_sizes(storage: Storage) -> dict[str, tuple[tuple[int, int], str]]:
    """What a file states as sizes (width, height) px: {"camera" or "projector": (the size, the key
    that states it)}."""
    sizes = {}
    for device, spellings in _SIZES.items():
        for spelling in spellings:
            keys = (spelling,) if isinstance(spelling, str) else spelling
            if not set(keys) <= set(storage.entries):
                continue
            values = np.concatenate([storage.matrix(key).ravel() for key in keys])
            if values.shape == (2,) and (values >= 1).all() and (values == values.round()).all():
                sizes[device] = (int(values[0]), int(values[1])), " and ".join(keys)
                break
    return sizes or matlab_calibration.read_image_sizes(storage)


def list_unused(
    storage: Storage, keys: Sequence[str], sizes: dict[str, tuple[tuple[int, int], str]]
) -> list[str]:
    """The entries of a file, without texts and mappings, that neither ``keys`` nor ``sizes``
    name."""
    used = [*keys, *(key for _, text in sizes.values() for key in text.split(" and "))]
    of_matlab = ("TangentialDistortion", "RadialDistortion")
    return [key for key in storage.list_unused(used) if not key.endswith(of_matlab)]


def _list_keys(storage: Storage) -> str:
    """Name the first keys of a file for a message."""
    keys = list(storage.entries)
    return ", ".join([*keys[:_NAMED], "..."] if len(keys) > _NAMED else keys) or "none"


def _check_intrinsics(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the camera matrix (3, 3); InputError where it is none, or has skew."""
    try:
        return Lens(matrix, np.zeros(5), (1, 1)).K
    except InputError as error:
        raise error.within(where) from error


def _check_distortion(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the distortion (5,) k1 k2 p1 p2 k3; InputError for other non-zero coefficients."""
    coefficients = matrix.ravel()
    size = coefficients.size
    if max(matrix.shape, default=0) != size or size not in (4, 5, 8, 12, 14):
        raise InputError(
            f"{where} has shape {matrix.shape}",
            "OpenCV's distortion has 4, 5, 8, 12 or 14 coefficients",
        )
    if np.any(coefficients[5:]):
        raise InputError(
            f"{where} has {size} coefficients with rational, prism or tilt terms, which k1 k2 p1 p2"
            " k3 cannot represent",
            "calibrate with five coefficients",
        )
    return np.concatenate([coefficients[:5], np.zeros(max(0, 5 - size))])


def _check_rotation(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a matrix; InputError where it is far from one."""
    if matrix.shape != (3, 3):
        raise InputError(
            f"{where} has shape {matrix.shape}", "the rotation from camera to projector is 3x3"
        )
    nearest = nearest_rotation(matrix)
    error = np.abs(matrix - nearest).max()
    if error > _ROTATION_TOLERANCE:
        raise InputError(
            f"{where} is not a rotation (off by {error:.2g}, determinant"
            f" {np.linalg.det(matrix):.3g})",
            "check it",
        )
    return nearest


def _check_translation(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return the translation (3,) mm; InputError for another shape or an impossible length."""
    if matrix.shape not in ((3, 1), (1, 3), (3,)):
        raise InputError(
            f"{where} has shape {matrix.shape}",
            "the translation from camera to projector has 3 numbers",
        )
    translation: np.ndarray = matrix.ravel()
    length = math.hypot(*translation)
    if not _SHORTEST_BASELINE_MM <= length <= LARGEST_BASELINE_MM:
        raise InputError(
            f"{where} is {length:.3g} mm long",
            "give its unit with --unit (mm, cm, m, inch), or the translation in mm",
        )
    return translation


_CHECKS: dict[str, Callable[[np.ndarray, str], np.ndarray]] = {
    "K": _check_intrinsics,
    "D": _check_distortion,
    "R": _check_rotation,
    "T": _check_translation,
}
"""The check of an entry, by its first letter."""
