"""The axis of a turntable, estimated from registered scans."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import turn_about
from slviewer.geometry.vectors import lengths, unit_vectors

_MAX_ANGLE_ERROR_DEG = 3.0
"""Largest difference between a measured and a given step of the turntable."""


@dataclass(frozen=True, eq=False)
class TurntableAxis:
    """A turntable's axis in the camera's frame: a ``point`` (3,) mm on it and its ``direction``
    (3,).

    Positive angles are right-handed about the direction.
    """

    point: np.ndarray
    direction: np.ndarray

    def rotation(self, deg: float) -> np.ndarray:
        """Return the motion (4, 4) of an object on the table when the table turns by an angle."""
        return turn_about(np.radians(deg) * unit_vectors(self.direction), self.point)


def shortest_turn(deg: float) -> float:
    """Return the angle, -180 to 180 degrees, that turns to the same place."""
    return (deg + 180.0) % 360.0 - 180.0


def determines_axis(deg: float) -> bool:
    """Whether a step of the table by -180 to 180 degrees is far enough from 0 and from 180 to give
    its axis."""
    return _MAX_ANGLE_ERROR_DEG < abs(deg) < 180.0 - _MAX_ANGLE_ERROR_DEG


def fit_turntable_axis(steps: Sequence[np.ndarray], step_deg: ArrayLike) -> TurntableAxis:
    """Fit the axis to registrations of scans, T_before_after (4, 4) mm each, ``step_deg`` apart:
    one angle, or (n,).

    The direction is such that the table turns by ``step_deg`` from a scan to the one after it.
    Raises ``InputError`` where a measured step differs from its angle, and for angles near 0 or 180
    degrees, which determine no direction.
    """
    given = np.broadcast_to(np.asarray(step_deg, np.float64), len(steps))
    if unfit := [deg for deg in given if not determines_axis(deg)]:
        raise InputError(
            f"A turntable's step of {unfit[0]:g} degrees gives no axis: step by"
            f" {_MAX_ANGLE_ERROR_DEG:g} to {180 - _MAX_ANGLE_ERROR_DEG:g} degrees, either way, or"
            " start from features."
        )
    # registration turns the later scan back by the table's step
    turns = np.array([-np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) for T in steps])
    angles = lengths(turns)
    for angle, deg in zip(angles, np.abs(given), strict=True):
        if abs(angle - deg) > _MAX_ANGLE_ERROR_DEG:
            raise InputError(
                f"Two scans in a row lie {angle:.1f} degrees apart and the turntable is said to"
                f" step by {deg:g}: check the angle and the order of the scans, or start from"
                " features."
            )
    direction = (turns / angles[:, None] * np.sign(given)[:, None]).mean(axis=0)
    A = np.vstack([np.eye(3) - T[:3, :3] for T in steps])
    b = np.concatenate([T[:3, 3] for T in steps])
    # the position along the axis is free: the minimum-norm solution is the point nearest to the
    # camera
    return TurntableAxis(np.linalg.lstsq(A, b, rcond=1e-3)[0], unit_vectors(direction))
