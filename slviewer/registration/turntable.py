"""The axis of a turntable, estimated from registered scans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import turn_about

_MAX_ANGLE_ERROR_DEG = 3.0
"""Largest difference between a measured and a given step of the turntable."""


@dataclass(frozen=True, eq=False)
class TurntableAxis:
    """A turntable's axis in the camera's frame: a ``point`` (3,) mm on it and its ``direction`` (3,).

    Positive angles are right-handed about the direction.
    """

    point: np.ndarray
    direction: np.ndarray

    def rotation(self, deg: float) -> np.ndarray:
        """Return the motion (4, 4) of an object on the table when the table turns by an angle."""
        unit = np.asarray(self.direction, dtype=np.float64) / np.linalg.norm(self.direction)
        return turn_about(np.radians(deg) * unit, self.point)


def fit_turntable_axis(steps: Sequence[np.ndarray], step_deg: float) -> TurntableAxis:
    """Fit the axis to registrations of consecutive scans, T_before_after (4, 4) mm each, ``step_deg`` apart.

    The direction is such that the table turns by ``step_deg`` from each scan to the next. Raises ``InputError`` where a
    measured step differs from that angle, and for angles near 0 or 180 degrees, which determine no direction.
    """
    if not _MAX_ANGLE_ERROR_DEG < abs(step_deg) < 180.0 - _MAX_ANGLE_ERROR_DEG:
        raise InputError(
            f"A turntable's step of {step_deg:g} degrees gives no axis: step by {_MAX_ANGLE_ERROR_DEG:g} to "
            f"{180 - _MAX_ANGLE_ERROR_DEG:g} degrees, either way, or start from features."
        )
    # registration turns the later scan back by the table's step
    turns = np.array([-np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) for T in steps])
    angles = np.linalg.norm(turns, axis=1)
    for angle in angles:
        if abs(angle - abs(step_deg)) > _MAX_ANGLE_ERROR_DEG:
            raise InputError(
                f"Two scans in a row lie {angle:.1f} degrees apart and the turntable is said to step by "
                f"{abs(step_deg):g}: check the angle and the order of the scans, or start from features."
            )
    direction = (turns / angles[:, None]).mean(axis=0) * np.sign(step_deg)
    A = np.vstack([np.eye(3) - T[:3, :3] for T in steps])
    b = np.concatenate([T[:3, 3] for T in steps])
    # the position along the axis is free: the minimum-norm solution is the point nearest to the camera
    return TurntableAxis(np.linalg.lstsq(A, b, rcond=1e-3)[0], direction / np.linalg.norm(direction))
