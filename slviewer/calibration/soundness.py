"""Checks of target poses before a stereo calibration; each raises CalibrationRejected with its own message."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.errors import CalibrationRejected

MIN_POSES = 3
MIN_TILT_SPREAD_DEG = 4.0


def check_pose_count(used: Sequence[Observation], excluded: Mapping[str, str]) -> None:
    """Raise CalibrationRejected for fewer than MIN_POSES poses; the message lists the ``excluded`` ones."""
    if len(used) < MIN_POSES:
        why = "".join(f"; {name}: {reason}" for name, reason in excluded.items())
        raise CalibrationRejected(
            f"{len(used)} usable pose{'s' * (len(used) != 1)}, and at least {MIN_POSES} are needed: "
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
    """Estimate the largest angle in degrees between two boards with a nominal lens; 0 for fewer than two boards."""
    normals = []
    for o in used:
        width, height = o.size
        H, _ = cv2.findHomography(o.points[:, :2], o.camera)
        line = np.linalg.inv(H).T @ np.array([0.0, 0.0, 1.0])
        f = 1.5 * width
        nominal = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]])
        normal = nominal.T @ line
        normals.append(normal / np.linalg.norm(normal) * np.sign(normal[2] or 1))
    if len(normals) < 2:
        return 0.0
    cosines = np.clip(np.array(normals) @ np.array(normals).T, -1, 1)
    return float(np.degrees(np.arccos(cosines.min())))


def check_handedness(used: Sequence[Observation]) -> None:
    """Raise CalibrationRejected where projector coordinates are a mirror image of the camera's in most poses."""
    mirrored = sum(_handedness(o.points, o.camera) * _handedness(o.points, o.projector) < 0 for o in used)
    if mirrored > len(used) / 2:
        raise CalibrationRejected(
            f"in {mirrored} of {len(used)} poses the projector's coordinates are a mirror image of what the camera "
            "sees: switch off the projector's rear or mirror mode, or exchange the x and y (V and H) patterns"
        )


def _handedness(points: np.ndarray, pixels: np.ndarray) -> float:
    """Return the determinant of the affine map from board points (n, 3) mm to pixels (n, 2): negative if mirrored."""
    measured = np.isfinite(pixels).all(1)
    design = np.column_stack([points[measured, :2], np.ones(np.count_nonzero(measured))])
    return float(np.linalg.det(np.linalg.lstsq(design, pixels[measured], rcond=None)[0][:2]))
