"""Scans of an object on a turntable: what the angle says of where they lie."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import turn_about

_OFF_DEG = 3.0
"""A step that was found and one that was told differ by less."""


@dataclass(frozen=True, eq=False)
class TurntableAxis:
    """The table's axis in the camera's frame: a ``point`` (3,) mm on it, and its ``direction`` (3,), about which the
    table turns the right-handed way."""

    point: np.ndarray
    direction: np.ndarray

    def turned(self, deg: float) -> np.ndarray:
        """(4, 4): where the table, turned by so much, has brought what it carries."""
        unit = np.asarray(self.direction, dtype=np.float64) / np.linalg.norm(self.direction)
        return turn_about(np.radians(deg) * unit, self.point)


def fit_turntable_axis(steps: Sequence[np.ndarray], step_deg: float) -> TurntableAxis:
    """The axis, from how scans lie on the ones before them (``T`` (4, 4) each), one step of ``step_deg`` apart.

    It points so that the table turns by ``step_deg`` from each scan to the next. Raises ``InputError`` where a step
    that was found is not of that angle, and for an angle that tells no direction.
    """
    if not _OFF_DEG < abs(step_deg) < 180.0 - _OFF_DEG:
        raise InputError(
            f"A turntable's step of {step_deg:g} degrees gives no axis: step by {_OFF_DEG:g} to {180 - _OFF_DEG:g} "
            "degrees, either way, or start from features."
        )
    # what was scanned one step later lies turned back on the scan before
    turns = np.array([-np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) for T in steps])
    angles = np.linalg.norm(turns, axis=1)
    for angle in angles:
        if abs(angle - abs(step_deg)) > _OFF_DEG:
            raise InputError(
                f"Two scans in a row lie {angle:.1f} degrees apart and the turntable is said to step by "
                f"{abs(step_deg):g}: check the angle and the order of the scans, or start from features."
            )
    direction = (turns / angles[:, None]).mean(axis=0) * np.sign(step_deg)
    left = np.vstack([np.eye(3) - T[:3, :3] for T in steps])
    right = np.concatenate([T[:3, 3] for T in steps])
    # nothing fixes the place along the axis: the one nearest the camera is as good as any
    return TurntableAxis(np.linalg.lstsq(left, right, rcond=1e-3)[0], direction / np.linalg.norm(direction))
