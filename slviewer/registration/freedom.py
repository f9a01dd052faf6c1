"""Which motions the shared shape leaves free: a plane slides, a sphere turns, a cylinder does both.

The information matrix of point-to-plane residuals says how fast the surfaces come apart along each of the six
directions of motion. Noise in the normals would pass for relief and hold a plane in place; so the matrix is made from
one scan's normals on one side and the other's on the other: their noise is independent, and cancels.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from slviewer.registration.prepared import PreparedScan

Shape = Literal["plane", "sphere", "cylinder", "slides", "turns"]

_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Freedom:
    """``slack_mm`` (6,), smallest first: how far the scan would have to move in each principal direction, at the
    overlap's rim, until the surfaces come apart by the noise; ``motions`` (6, 6): rows of the directions, a rotation
    and a shift with lengths in units of the overlap's radius."""

    slack_mm: np.ndarray
    motions: np.ndarray

    @property
    def loosest_mm(self) -> float:
        """Slack in the loosest direction."""
        return float(self.slack_mm[-1])

    def shape(self, limit_mm: float) -> Shape | None:
        """What the shape is, judged by its motions of more slack than ``limit_mm``; None where it holds the pose."""
        if not self.loosest_mm > limit_mm:
            return None
        loose = self.motions[self.slack_mm > 0.5 * limit_mm]
        turns = int(np.count_nonzero(np.linalg.svd(loose[:, :3], compute_uv=False) > 0.3))
        if len(loose) >= 3:
            return "sphere" if turns >= 3 else "plane"
        if len(loose) == 2:
            return "cylinder" if turns else "plane"
        return "turns" if turns else "slides"


WORDS: dict[Shape, str] = {
    "plane": "is flat: it slides along itself and turns about its normal",
    "sphere": "is round like a sphere: it turns about any axis through its centre",
    "cylinder": "is round like a cylinder: it slides along its axis and turns about it",
    "slides": "has the same profile all along one direction, and slides along it",
    "turns": "is round about one axis, and turns about it",
}


def estimate_freedom(
    scan: PreparedScan, reference: PreparedScan, T: np.ndarray, points: np.ndarray, rms: float
) -> Freedom:
    """What the overlap's ``points`` (n, 3) mm, in the reference's frame, leave free; ``rms`` in mm is the noise."""
    if len(points) < 6:
        return Freedom(np.full(6, np.inf), np.eye(6))
    points = points[:: -(-len(points) // _POINTS)]
    (there, theirs), (here, ours) = reference.smooth, scan.smooth
    theirs = theirs[cKDTree(there).query(points)[1]]
    ours = ours[cKDTree(here @ T[:3, :3].T + T[:3, 3]).query(points)[1]] @ T[:3, :3].T
    ours = np.where(np.sum(ours * theirs, axis=1, keepdims=True) < 0, -ours, ours)
    arm = points - points.mean(axis=0)
    arm /= float(np.sqrt(np.mean(np.sum(arm**2, axis=1))))
    A, B = (np.hstack([np.cross(arm, normal), normal]) for normal in (theirs, ours))
    information = A.T @ B / len(points)
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    slack = rms / np.sqrt(np.maximum(values, 1e-12))
    return Freedom(slack[::-1], vectors.T[::-1])
