"""Final refinement of a registration by symmetric point-to-plane ICP, the uncertainty of the pose,
and the degrees of freedom that the shared shape leaves undetermined.

The residual of a pair is its distance along the mean of both normals (Rusinkiewicz, *A symmetric
objective function for ICP*, 2019): exact where the surface is curved, so that the points' spacing
does not show in the pose. The covariance is estimated from the residuals themselves, summed within
patches before they are squared (a cluster-robust "sandwich"): neighbours that are wrong together do
not pass for independent measurements.

A plane slides, a sphere turns, a cylinder does both. The eigenvalues of the information matrix of
point-to-plane residuals measure how well each of the six motions is determined. Noise in the
normals would act like relief; so the matrix is the product of one scan's Jacobian with the other's,
whose noise is independent and cancels.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.rigid import Floats, Uncertainty, distance_jacobian, move_points, turn_about
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import diagonal, rms_length, subsample, sum_by_cube, unit_vectors
from slviewer.registration.markers import MarkerPose
from slviewer.registration.scan import PreparedScan

Shape = Literal["plane", "sphere", "cylinder", "slides", "turns"]

_STEPS = 12
_SETTLED, _NEAR = 1e-5, 3e-5  # of the overlap's diagonal
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
_FREEDOM_POINTS = 20_000
_UNKNOWN = Uncertainty(np.full((6, 6), np.inf), np.full(3, np.nan))


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A refined pose ``T`` (4, 4), T_reference_scan, with its uncertainty, infinite where it could
    not be estimated.

    ``gate_mm``: largest distance of a pair along its normal in the last iteration.
    """

    T: Floats
    gate_mm: float
    uncertainty: Uncertainty


def refine_pose(
    scan: PreparedScan,
    reference: PreparedScan,
    T: np.ndarray,
    widest: float,
    narrowest: float,
    markers: MarkerPose | None = None,
    loose: "LooseMotions | None" = None,
) -> RefinedPose:
    """Refine a pose ``T`` (4, 4) by symmetric point-to-plane ICP on the thinned clouds, and by the
    corners of markers; ``loose`` motions do not change it.

    The gate decreases from ``widest`` mm to three times the residuals' noise, not below
    ``narrowest`` mm. With too few pairs the current pose is returned with infinite uncertainty.
    """
    gate, lateral = widest, 2.0 * max(scan.fine_spacing, reference.fine_spacing)
    stride, least = (
        max(1, len(scan.fine_points) // points) for points in (_FIRST_POINTS, _MOST_POINTS)
    )
    steps_left = _STEPS
    while True:
        pairs = _match_pairs(scan, reference, T, gate, lateral, stride)
        if pairs is None:
            return RefinedPose(T, gate, _UNKNOWN)
        e = _linearise(*pairs, T, markers, loose)
        if not steps_left:
            return RefinedPose(T, gate, _estimate_uncertainty(pairs[0], e))
        steps_left -= 1
        step = -np.linalg.lstsq(e.H, e.gradient, rcond=1e-10)[0]
        T = turn_about(step[:3], e.centre, step[3:]) @ T
        next_gate = min(gate, max(3.0 * e.sigma, narrowest))
        motion = np.linalg.norm(step[3:]) / diagonal(pairs[0]) + np.linalg.norm(step[:3])
        if next_gate > 0.99 * gate and motion < (_SETTLED if stride == least else _NEAR):
            if stride == least:
                steps_left = 0
                continue
            stride = least  # the last iterations use many more points
        gate = next_gate


def _match_pairs(
    scan: PreparedScan,
    reference: PreparedScan,
    T: np.ndarray,
    gate: float,
    lateral: float,
    stride: int,
) -> tuple[Floats, Floats, Floats] | None:
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
    reference_normals = reference.fine_normals[nearest]
    scan_normals = scan.fine_normals[::stride][near] @ T[:3, :3].T
    is_pair = np.einsum("ij,ij->i", reference_normals, scan_normals) > _MIN_COSINE
    gap = points - reference.fine_points[nearest]
    normal = unit_vectors(reference_normals + scan_normals)
    residual = np.einsum("ij,ij->i", gap, normal)
    across = np.sqrt(np.maximum(np.einsum("ij,ij->i", gap, gap) - residual**2, 0.0))
    # beyond the rim the nearest point is far across
    is_pair &= (np.abs(residual) < gate) & (across < lateral)
    if np.count_nonzero(is_pair) < _MIN_PAIRS:
        return None
    return points[is_pair], normal[is_pair], residual[is_pair]


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of pairs and markers, of a small rotation (rad) about ``centre`` (3,) mm and
    a translation (mm).

    ``sigma``: noise of the residuals, mm; ``H`` (6, 6) and ``gradient`` (6,) of all; ``gradients``
    (n, 6) of each pair; ``scatter`` (6, 6): covariance of the markers' gradient.
    """

    centre: Floats
    sigma: float
    H: np.ndarray
    gradient: Floats
    gradients: Floats
    scatter: Floats


def _linearise(
    points: Floats,
    normal: Floats,
    residual: Floats,
    T: Floats,
    markers: MarkerPose | None,
    loose: "LooseMotions | None",
) -> _Equations:
    """Return the normal equations of pairs, as of ``_match_pairs``, and of markers at a pose ``T``
    (4, 4), without ``loose`` motions."""
    centre = points.mean(axis=0)
    sigma = max(robust_sigma(residual, about=0.0), 1e-6)
    J, weight = distance_jacobian(points - centre, normal), tukey_weights(residual, sigma)
    if loose is not None:
        # the noise of normals would act like relief
        twists = loose.twists(centre)
        J = J - J @ np.linalg.pinv(twists) @ twists
    gradients = J * (weight * residual)[:, None]
    H, gradient = (J * weight[:, None]).T @ J, gradients.sum(axis=0)
    scatter = np.zeros((6, 6))
    if markers is not None:
        # So many pairs count as one measurement: what a calibration leaves bent is alike over a
        # good part of the surface, and a plane would slide until it fits.
        alike = max(1.0, len(points) / _INDEPENDENT)
        of_markers = markers.normal_equations(T, centre, sigma * np.sqrt(alike))
        H, gradient = H + of_markers[0], gradient + of_markers[1]
        scatter = alike * sigma**2 * of_markers[0]
    return _Equations(centre, sigma, H, gradient, gradients, scatter)


def _estimate_uncertainty(points: Floats, e: _Equations) -> Uncertainty:
    """Estimate the uncertainty of a pose by a cluster-robust covariance of the pairs' points (n,
    3), and from the standard deviations of markers."""
    arm = points - e.centre
    diameter = 2.0 * rms_length(arm)
    inverse = np.linalg.pinv(e.H, rcond=1e-12, hermitian=True)
    covariances: list[np.ndarray] = []
    for share in _PATCHES:
        patches = sum_by_cube(e.gradients, arm, diameter / share)
        if len(patches) < _LEAST_PATCHES and covariances:
            break
        meat = patches.T @ patches * len(patches) / max(len(patches) - 6, 1) + e.scatter
        covariances.append(inverse @ meat @ inverse)
    # errors that are correlated over more than one patch show in larger patches only
    largest = max(covariances, key=lambda covariance: float(np.trace(covariance[3:, 3:])))
    return Uncertainty(_UNSEEN**2 * (largest + largest.T) / 2, e.centre)


@dataclass(frozen=True, eq=False)
class Freedom:
    """Principal motions of a scan on its reference, and how well the shape determines each.

    ``slack_mm`` (6,), ascending: the motion at the overlap's rim that separates the surfaces by the
    noise (RMS). ``motions`` (6, 6): a rotation about the ``centre`` (3,) mm and a translation per
    row, with lengths in units of the overlap's ``radius``, mm.
    """

    slack_mm: Floats
    motions: Floats
    centre: Floats = field(default_factory=lambda: np.zeros(3))
    radius: float = 1.0

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

    def loose_motions(self, limit_mm: float) -> "LooseMotions":
        """Return the motions by which ``shape`` classifies."""
        loose = self.motions[self.slack_mm > 0.5 * limit_mm]
        U, length, directions = np.linalg.svd(loose[:, :3])
        count = int(np.count_nonzero(length > 0.3))
        turns, combined = directions[:count], U.T @ loose[:, 3:]
        # a turn about a point c moves the centre by -turn x c
        crossed = np.cross(turns[:, None], np.eye(3)).swapaxes(1, 2).reshape(-1, 3)
        moved = (combined[:count] / length[:count, None]).ravel()
        point = np.linalg.lstsq(crossed, -moved, rcond=0.1)[0] if count else np.zeros(3)
        shifts = np.linalg.svd(combined[count:], full_matrices=False)[2]
        return LooseMotions(
            turns / self.radius, shifts, self.centre + self.radius * point, self.radius
        )


@dataclass(frozen=True, eq=False)
class LooseMotions:
    """The motions that leave a shape on itself: ``turns`` (r, 3) about a ``centre`` (3,) mm, in rad
    per mm at the overlap's ``radius`` mm, and ``shifts`` (s, 3), unit vectors."""

    turns: Floats
    shifts: Floats
    centre: Floats
    radius: float

    @property
    def count(self) -> int:
        """Number of independent motions."""
        return len(self.turns) + len(self.shifts)

    @property
    def spins(self) -> bool:
        """Whether a point may stay where it is: on planes and spheres."""
        return self.count > 2

    def move(self, amounts: Floats) -> Floats:
        """Return the motion (4, 4) by amounts (r + s,) mm."""
        count = len(self.turns)
        return turn_about(amounts[:count] @ self.turns, self.centre, amounts[count:] @ self.shifts)

    def twists(self, centre: Floats) -> Floats:
        """Return (r + s, 6): rotations about ``centre`` (3,) mm, rad, and translations, mm."""
        turns = np.hstack([self.turns, np.cross(self.turns, centre - self.centre)])
        return np.vstack([turns, np.hstack([np.zeros_like(self.shifts), self.shifts])])


WORDS: dict[Shape, str] = {
    "plane": "is flat: it slides along itself and turns about its normal",
    "sphere": "is round like a sphere: it turns about any axis through its centre",
    "cylinder": "is round like a cylinder: it slides along its axis and turns about it",
    "slides": "has the same profile all along one direction, and slides along it",
    "turns": "is round about one axis, and turns about it",
}


def estimate_freedom(
    scan: PreparedScan, reference: PreparedScan, T: Floats, points: Floats, rms: float
) -> Freedom:
    """Estimate which motions of the scan the overlap leaves undetermined.

    ``T`` (4, 4): T_reference_scan; ``points`` (n, 3) mm: the overlap, in the reference's frame;
    ``rms``: noise in mm. The slack is inf for fewer than 6 points.
    """
    if len(points) < 6:
        return Freedom(np.full(6, np.inf), np.eye(6))
    points = subsample(points, _FREEDOM_POINTS)
    smooth_points, normals = reference.smooth
    reference_normals = normals[cKDTree(smooth_points).query(points)[1]]
    smooth_points, normals = scan.smooth
    scan_normals = normals[cKDTree(move_points(T, smooth_points)).query(points)[1]] @ T[:3, :3].T
    is_opposite = np.sum(scan_normals * reference_normals, axis=1, keepdims=True) < 0
    scan_normals = np.where(is_opposite, -scan_normals, scan_normals)
    centre = points.mean(axis=0)
    arm = points - centre
    radius = rms_length(arm)
    arm /= radius
    A, B = distance_jacobian(arm, reference_normals), distance_jacobian(arm, scan_normals)
    return replace(freedom_of(A.T @ B / len(points), rms), centre=centre, radius=radius)


def freedom_of(information: Floats, rms: float) -> Freedom:
    """The freedom that the information (6, 6) of a point in the mean leaves, of rotations with
    lengths in units of the overlap's radius; ``rms``: noise in mm."""
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    slack = rms / np.sqrt(np.maximum(values, 1e-12))
    return Freedom(slack[::-1], vectors.T[::-1])
