"""Final refinement of a registration by symmetric point-to-plane ICP, and the uncertainty of the
pose.

The residual of a pair is its distance along the mean of both normals (Rusinkiewicz, *A symmetric
objective function for ICP*, 2019): exact where the surface is curved, so that the points' spacing
does not show in the pose. The covariance is estimated from the residuals themselves, summed within
patches before they are squared (a cluster-robust "sandwich"): neighbours that are wrong together do
not pass for independent measurements.
"""

from dataclasses import dataclass

import numpy as np

from slviewer.geometry.cubes import occupied_cubes
from slviewer.geometry.rigid import move_points, turn_about
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import diagonal, rms_length
from slviewer.registration.markers import MarkerPose
from slviewer.registration.prepared import PreparedScan
from slviewer.registration.uncertainty import Uncertainty

_STEPS = 12
_SETTLED_MM, _NEAR_MM = 2e-3, 5e-3
_FIRST_POINTS, _MOST_POINTS = 8_000, 40_000
_MIN_COSINE = 0.8  # between the normals of a pair
_MIN_PAIRS = 60
_PATCHES = (16.0, 9.0, 5.0)
"""Diameter of the overlap over the side of a patch: coarser patches include errors of longer
correlation length."""
_LEAST_PATCHES = 20
_INDEPENDENT = 100
"""Number of independent measurements that a surface counts as, beside markers."""
_UNSEEN = 1.25
"""Ratio of true to estimated sigma on simulated scans: residuals do not show that pairs change with
the pose."""


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A refined pose ``T`` (4, 4), T_reference_scan, with its uncertainty, None where it could not
    be estimated.

    ``gate_mm``: largest distance of a pair along its normal in the last iteration.
    """

    T: np.ndarray
    gate_mm: float
    uncertainty: Uncertainty | None


def refine_pose(
    scan: PreparedScan,
    reference: PreparedScan,
    T: np.ndarray,
    widest: float,
    narrowest: float,
    markers: MarkerPose | None = None,
) -> RefinedPose:
    """Refine a pose ``T`` (4, 4) by symmetric point-to-plane ICP on the thinned clouds, and by the
    corners of markers.

    The gate decreases from ``widest`` mm to three times the residuals' noise, not below
    ``narrowest`` mm. With too few pairs the current pose is returned with the uncertainty None.
    """
    gate, lateral = widest, 2.0 * max(scan.fine_spacing, reference.fine_spacing)
    stride, least = (
        max(1, len(scan.fine_points) // points) for points in (_FIRST_POINTS, _MOST_POINTS)
    )
    for _ in range(_STEPS):
        pairs = _match_pairs(scan, reference, T, gate, lateral, stride)
        if pairs is None:
            return RefinedPose(T, gate, None)
        points, normal, residual = pairs
        centre, sigma, J, weight = _weigh_pairs(points, normal, residual)
        H, gradient = (J * weight[:, None]).T @ J, J.T @ (weight * residual)
        if markers is not None:
            H_markers, gradient_markers = markers.normal_equations(
                T, centre, sigma * np.sqrt(_count_alike(points))
            )
            H, gradient = H + H_markers, gradient + gradient_markers
        step = -np.linalg.lstsq(H, gradient, rcond=1e-10)[0]
        T = turn_about(step[:3], centre, step[3:]) @ T
        next_gate = min(gate, max(3.0 * sigma, narrowest))
        motion = np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * diagonal(points)
        if next_gate > 0.99 * gate and motion < (_SETTLED_MM if stride == least else _NEAR_MM):
            if stride == least:
                break
            stride = least  # the last iterations use many more points
        gate = next_gate
    pairs = _match_pairs(scan, reference, T, gate, lateral, stride)
    return RefinedPose(
        T, gate, None if pairs is None else _estimate_uncertainty(*pairs, T, markers)
    )


def _match_pairs(
    scan: PreparedScan,
    reference: PreparedScan,
    T: np.ndarray,
    gate: float,
    lateral: float,
    stride: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Match every ``stride``-th point of the scan, moved by ``T`` (4, 4), with the nearest point of
    the reference.

    Pairs differ by less than ``gate`` mm along their mean normal and ``lateral`` mm across it, and
    have similar normals. Returns the scan points (n, 3) in the reference's frame, mean normals (n,
    3), and residuals (n,) in mm; None for fewer than 60 pairs.
    """
    points = move_points(T, scan.fine_points[::stride])
    distance, nearest = reference.fine_tree.query(
        points, distance_upper_bound=float(np.hypot(gate, lateral)), workers=-1
    )
    near = np.isfinite(distance)
    points, nearest = points[near], nearest[near]
    reference_normals, scan_normals = (
        reference.fine_normals[nearest],
        scan.fine_normals[::stride][near] @ T[:3, :3].T,
    )
    is_pair = np.einsum("ij,ij->i", reference_normals, scan_normals) > _MIN_COSINE
    gap = points - reference.fine_points[nearest]
    normal = reference_normals + scan_normals
    normal /= np.maximum(np.sqrt(np.einsum("ij,ij->i", normal, normal)), 1e-9)[:, None]
    residual = np.einsum("ij,ij->i", gap, normal)
    across = np.sqrt(np.maximum(np.einsum("ij,ij->i", gap, gap) - residual**2, 0.0))
    # beyond the rim the nearest point is far across
    is_pair &= (np.abs(residual) < gate) & (across < lateral)
    return (
        (points[is_pair], normal[is_pair], residual[is_pair])
        if np.count_nonzero(is_pair) >= _MIN_PAIRS
        else None
    )


def _count_alike(points: np.ndarray) -> float:
    """Return how many of the pairs' points (n, 3) count as one measurement beside markers: what a
    calibration leaves bent is alike over a good part of the surface, and a plane would slide until
    it fits."""
    return max(1.0, len(points) / _INDEPENDENT)


def _weigh_pairs(
    points: np.ndarray, normal: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return the middle (3,) of the pairs' points (n, 3), the residuals' noise in mm, and their
    weights (n,).

    Before the weights: the derivatives (n, 6) of the residuals by a small rotation (rad) about the
    middle and a translation (mm).
    """
    centre = points.mean(axis=0)
    sigma = max(robust_sigma(residual, about=0.0), 1e-6)
    return (
        centre,
        sigma,
        np.hstack([np.cross(points - centre, normal), normal]),
        tukey_weights(residual, sigma),
    )


def _estimate_uncertainty(
    points: np.ndarray,
    normal: np.ndarray,
    residual: np.ndarray,
    T: np.ndarray,
    markers: MarkerPose | None,
) -> Uncertainty | None:
    """Estimate the uncertainty of a pose ``T`` (4, 4) from its pairs by a cluster-robust
    covariance, and from the standard deviations of markers; None for too few patches."""
    centre, sigma, J, weight = _weigh_pairs(points, normal, residual)
    arm = points - centre
    H = (J * weight[:, None]).T @ J
    gradient = J * (weight * residual)[:, None]
    alike = _count_alike(points)
    H_markers = (
        np.zeros((6, 6))
        if markers is None
        else markers.normal_equations(T, centre, sigma * np.sqrt(alike))[0]
    )
    diameter = 2.0 * rms_length(arm)
    largest = None
    for share in _PATCHES:
        patches = _sum_by_cube(gradient, arm, diameter / share)
        if len(patches) < _LEAST_PATCHES and largest is not None:
            break
        meat = (
            patches.T @ patches * len(patches) / max(len(patches) - 6, 1)
            + alike * sigma**2 * H_markers
        )
        inverse = np.linalg.pinv(H + H_markers, rcond=1e-12, hermitian=True)
        covariance = inverse @ meat @ inverse
        # errors that are correlated over more than one patch show in larger patches only
        if largest is None or np.trace(covariance[3:, 3:]) > np.trace(largest[3:, 3:]):
            largest = covariance
    return None if largest is None else Uncertainty(_UNSEEN**2 * (largest + largest.T) / 2, centre)


def _sum_by_cube(values: np.ndarray, points: np.ndarray, side: float) -> np.ndarray:
    """Return the sums (m, k) of ``values`` (n, k) over the m occupied cubes of ``side`` mm of
    ``points`` (n, 3)."""
    _, which = occupied_cubes(points, side)
    return np.stack([np.bincount(which, column) for column in values.T], axis=1)
