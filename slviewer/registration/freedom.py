"""Degrees of freedom that the shared shape leaves undetermined: a plane slides, a sphere turns, a
cylinder does both.

The eigenvalues of the information matrix of point-to-plane residuals measure how well each of the
six motions is determined. Noise in the normals would act like relief; so the matrix is the product
of one scan's Jacobian with the other's, whose noise is independent and cancels.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.rigid import move_points
from slviewer.geometry.vectors import rms_length
from slviewer.registration.prepared import PreparedScan

Shape = Literal["plane", "sphere", "cylinder", "slides", "turns"]

_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Freedom:
    """Principal motions of a scan on its reference, and how well the shape determines each.

    ``slack_mm`` (6,), ascending: the motion at the overlap's rim that separates the surfaces by the
    noise (RMS). ``motions`` (6, 6): a rotation and a translation per row, with lengths in units of
    the overlap's radius.
    """

    slack_mm: np.ndarray
    motions: np.ndarray

    @property
    def loosest_mm(self) -> float:
        """Slack of the least determined motion."""
        return float(self.slack_mm[-1])

    def shape(self, limit_mm: float) -> Shape | None:
        """Classify the shape by its motions with more slack than ``limit_mm``; None where all are
        determined."""
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
    """Estimate which motions of the scan the overlap leaves undetermined.

    ``T`` (4, 4): T_reference_scan; ``points`` (n, 3) mm: the overlap, in the reference's frame;
    ``rms``: noise in mm. The slack is inf for fewer than 6 points.
    """
    if len(points) < 6:
        return Freedom(np.full(6, np.inf), np.eye(6))
    points = points[:: -(-len(points) // _POINTS)]
    (reference_points, reference_normals), (scan_points, scan_normals) = (
        reference.smooth,
        scan.smooth,
    )
    reference_normals = reference_normals[cKDTree(reference_points).query(points)[1]]
    scan_normals = scan_normals[cKDTree(move_points(T, scan_points)).query(points)[1]] @ T[:3, :3].T
    is_opposite = np.sum(scan_normals * reference_normals, axis=1, keepdims=True) < 0
    scan_normals = np.where(is_opposite, -scan_normals, scan_normals)
    arm = points - points.mean(axis=0)
    arm /= rms_length(arm)
    A, B = (
        np.hstack([np.cross(arm, normals), normals])
        for normals in (reference_normals, scan_normals)
    )
    information = A.T @ B / len(points)
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    slack = rms / np.sqrt(np.maximum(values, 1e-12))
    return Freedom(slack[::-1], vectors.T[::-1])
