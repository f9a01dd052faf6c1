"""Checks of target poses before a stereo calibration; each raises CalibrationRejected with its own
message."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from slviewer.calibration.next_pose import nominal_lens
from slviewer.calibration.observe import Observation
from slviewer.errors import CalibrationRejected
from slviewer.geometry.polynomial import fit_slopes
from slviewer.geometry.rigid import largest_angle_deg
from slviewer.geometry.vectors import unit_vectors

MIN_POSES = 3
MIN_TILT_SPREAD_DEG = 4.0


def check_pose_count(count: int, excluded: Mapping[str, str]) -> None:
    """Raise CalibrationRejected for fewer than MIN_POSES poses; the message lists the ``excluded``
    ones."""
    if count < MIN_POSES:
        why = "".join(f"; {name}: {reason}" for name, reason in excluded.items())
        raise CalibrationRejected(
            f"{count} usable pose{'s' * (count != 1)}, and at least {MIN_POSES} are needed: "
            f"capture the board in more positions and tilts{why}"
        )


def check_tilts(used: Sequence[Observation]) -> None:
    """Raise CalibrationRejected where all boards are nearly parallel.

    Parallel boards share their vanishing line and do not determine the focal length.
    """
    spread = nominal_tilt_spread_deg(used)
    if spread < MIN_TILT_SPREAD_DEG:
        raise CalibrationRejected(
            f"all {len(used)} poses are nearly parallel (tilts differ by {spread:.1f} degrees): "
            "tilt the board by 15 to 30 degrees, in different directions"
        )


def nominal_tilt_spread_deg(used: Sequence[Observation]) -> float:
    """Estimate the largest angle in degrees between two boards with a nominal lens; 0 for fewer
    than two boards."""
    normals = []
    for o in used:
        H, _ = cv2.findHomography(o.points[:, :2], o.camera)
        line = np.linalg.inv(H).T @ np.array([0.0, 0.0, 1.0])
        normal = nominal_lens(o.size).K.T @ line
        normals.append(unit_vectors(normal) * np.sign(normal[2] or 1))
    return largest_angle_deg(np.array(normals)) if len(normals) > 1 else 0.0


def check_handedness(used: Sequence[Observation]) -> None:
    """Raise CalibrationRejected where projector coordinates are a mirror image of the camera's in
    most poses."""
    mirrored = sum(
        _handedness(o.points, o.camera) * _handedness(o.points, o.projector) < 0 for o in used
    )
    if mirrored > len(used) / 2:
        raise CalibrationRejected(
            f"in {mirrored} of {len(used)} poses the projector's coordinates are a mirror image of"
            " what the camera sees: switch off the projector's rear or mirror mode, or exchange"
            " the x and y (V and H) patterns"
        )


def _handedness(points: np.ndarray, pixels: np.ndarray) -> float:
    """Return the determinant of the affine map from board points (n, 3) mm to pixels (n, 2):
    negative if mirrored."""
    return float(np.linalg.det(fit_slopes(points[:, :2], pixels)))
