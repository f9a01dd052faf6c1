"""The last stage of a registration, and how uncertain it leaves the pose.

The residual of a pair is its distance along the mean of both normals (Rusinkiewicz, *A symmetric objective function for
ICP*, 2019): exact where the surface is curved, so that the points' spacing does not show in the pose. The covariance is
estimated from the residuals themselves, summed within patches before they are squared (a cluster-robust "sandwich"):
neighbours that are wrong together do not pass for independent measurements.
"""

from dataclasses import dataclass

import numpy as np

from slviewer.geometry.rigid import move_points, turn_about
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.registration.prepared import PreparedScan

_STEPS = 12
_SETTLED_MM, _NEAR_MM = 2e-3, 5e-3
_FIRST_POINTS, _MOST_POINTS = 8_000, 40_000
_ALIKE = 0.8  # cosine between the normals of a pair
_PATCHES = (16.0, 9.0, 5.0)
"""Sides of the patches, as shares of the overlap's diameter: the coarsest that leaves enough patches sees the most of
what is wrong together."""
_LEAST_PATCHES = 20
_UNSEEN = 1.25
"""What residuals do not show (pairs that change with the pose, errors of normals): measured against simulated truth."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far a pose may be off, one standard deviation each.

    ``covariance`` (6, 6) of a small rotation vector (rad) about ``centre`` (3,), the middle of the overlap in the
    reference's frame, and a shift (mm) there. ``shift_mm`` and ``turn_deg``: root of the expected squared length of the
    shift and of the rotation.
    """

    covariance: np.ndarray
    centre: np.ndarray

    @property
    def shift_mm(self) -> float:
        """Of the overlap's middle."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def turn_deg(self) -> float:
        """Of the rotation, whatever its axis."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """``T`` (4, 4) maps the scan into the reference's frame; ``gate_mm``: how far apart along their normals a pair's
    points may lie."""

    T: np.ndarray
    gate_mm: float
    uncertainty: Uncertainty | None


def refine_pose(
    scan: PreparedScan, reference: PreparedScan, T: np.ndarray, widest: float, narrowest: float
) -> RefinedPose:
    """Symmetric point-to-plane ICP on the thinned clouds, from a pose that is right within ``widest`` mm.

    The gate closes from ``widest`` to three times the residuals' noise, but not below ``narrowest``. Without enough
    pairs to go by, the pose comes back as it was, and its uncertainty is None.
    """
    gate, lateral = widest, 2.0 * max(scan.fine_spacing, reference.fine_spacing)
    stride, least = (max(1, len(scan.fine_points) // points) for points in (_FIRST_POINTS, _MOST_POINTS))
    for _ in range(_STEPS):
        pairs = _pairs(scan, reference, T, gate, lateral, stride)
        if pairs is None:
            return RefinedPose(T, gate, None)
        arm, normal, residual = pairs
        centre = arm.mean(axis=0)
        sigma = max(robust_sigma(residual, about=0.0), 1e-6)
        J, weight = _jacobian(arm - centre, normal), tukey_weights(residual, sigma)
        step = -np.linalg.lstsq((J * weight[:, None]).T @ J, J.T @ (weight * residual), rcond=1e-10)[0]
        T = turn_about(step[:3], centre, step[3:]) @ T
        closed = min(gate, max(3.0 * sigma, narrowest))
        moved = np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * np.linalg.norm(np.ptp(arm, axis=0))
        if closed > 0.99 * gate and moved < (_SETTLED_MM if stride == least else _NEAR_MM):
            if stride == least:
                break
            stride = least  # the last steps are of many more points
        gate = closed
    pairs = _pairs(scan, reference, T, gate, lateral, stride)
    return RefinedPose(T, gate, None if pairs is None else _uncertainty(*pairs))


def _pairs(
    scan: PreparedScan, reference: PreparedScan, T: np.ndarray, gate: float, lateral: float, stride: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Scan points in the reference's frame (n, 3), the pairs' mean normals (n, 3) and residuals (n,) in mm."""
    points = move_points(T, scan.fine_points[::stride])
    distance, nearest = reference.fine_tree.query(
        points, distance_upper_bound=float(np.hypot(gate, lateral)), workers=-1
    )
    near = np.isfinite(distance)
    points, nearest = points[near], nearest[near]
    theirs, ours = reference.fine_normals[nearest], scan.fine_normals[::stride][near] @ T[:3, :3].T
    alike = np.sum(theirs * ours, axis=1) > _ALIKE
    gap = points - reference.fine_points[nearest]
    normal = theirs + ours
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    residual = np.sum(gap * normal, axis=1)
    aside = np.sqrt(np.maximum(np.sum(gap**2, axis=1) - residual**2, 0.0))
    kept = alike & (np.abs(residual) < gate) & (aside < lateral)  # beyond the rim, the nearest lies far aside
    return (points[kept], normal[kept], residual[kept]) if np.count_nonzero(kept) >= 60 else None


def _jacobian(arm: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return np.hstack([np.cross(arm, normal), normal])


def _uncertainty(points: np.ndarray, normal: np.ndarray, residual: np.ndarray) -> Uncertainty | None:
    centre = points.mean(axis=0)
    arm = points - centre
    sigma = max(robust_sigma(residual, about=0.0), 1e-6)
    J, weight = _jacobian(arm, normal), tukey_weights(residual, sigma)
    H = (J * weight[:, None]).T @ J
    gradient = J * (weight * residual)[:, None]
    diameter = 2.0 * float(np.sqrt(np.mean(np.sum(arm**2, axis=1))))
    found = None
    for share in _PATCHES:
        patches = _summed(gradient, arm, diameter / share)
        if len(patches) < _LEAST_PATCHES and found is not None:
            break
        meat = patches.T @ patches * len(patches) / max(len(patches) - 6, 1)
        inverse = np.linalg.pinv(H, rcond=1e-12, hermitian=True)
        covariance = inverse @ meat @ inverse
        # what is wrong together over more than one patch only shows in the larger ones
        if found is None or np.trace(covariance[3:, 3:]) > np.trace(found[3:, 3:]):
            found = covariance
    return None if found is None else Uncertainty(_UNSEEN**2 * (found + found.T) / 2, centre)


def _summed(values: np.ndarray, places: np.ndarray, side: float) -> np.ndarray:
    """The sums of ``values`` (n, k) over each cube of ``side`` mm that holds any of the ``places`` (n, 3)."""
    cell = np.floor(places / side).astype(np.int64)
    _, which = np.unique(cell, axis=0, return_inverse=True)
    sums = np.zeros((int(which.max()) + 1, values.shape[1]))
    np.add.at(sums, which.ravel(), values)
    return sums
