"""Where to start ICP from: candidate poses from matched FPFH features, and from the centroids; or
one that is known, such as from points that an operator picked on both scans, or by the axis of a
turntable, which is estimated from registered scans.

RANSAC is our own, in NumPy, because Open3D's parallel one gives another answer at every call.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, fit_rigid, move_points, rigid_transform, turn_about
from slviewer.geometry.vectors import diagonal, lengths, thin_out, unit_vectors
from slviewer.registration.open3d_loader import align_icp, open3d
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan

Start = Literal["features", "centroids", "initial", "picked", "turntable", "markers"]
"""How a start was found: searched for (the first two); the last pose, picked points, the
turntable's angle, markers."""
SEARCHED: tuple[Start, ...] = ("features", "centroids")

_TRIPLETS = 60_000
_SEED = 0
_CANDIDATES = 6
_LEAST_VOTES = 0.15  # of those for the best pose
_COARSE_POINTS = 2000
"""Of a scan in the coarse ICP, or up to twice as many: only scans much larger than the reference
have more."""
LEAST_PICKS = 3
_THIN = 0.1
"""Picks whose second extent is a smaller share of the first lie on a line: they leave the turn
about it open."""
_WORST = 0.15
"""Of the picks' extent: what is worse was not the same points, and ICP would not find back."""


@dataclass(frozen=True)
class Candidate:
    """An initial pose ``T`` (4, 4), T_reference_scan, and its origin ``start``.

    ``score``: 0 to 1, share of the thinned scan that fits the reference at this pose; NaN if not
    evaluated. ``is_decided``: it follows from registrations, and no other pose can be meant.
    """

    T: Floats
    start: Start
    score: float = float("nan")
    is_decided: bool = False


def search_starts(
    scanned: PreparedScan, referred: PreparedScan, size: float, initial: Candidate | None = None
) -> list[Candidate]:
    """Refine candidate poses by a coarse ICP, and sort them by the part of the scan on the
    reference, largest first; one or more.

    Equal poses are listed once. ``size``: of the object in mm. With ``initial``, only this
    candidate is refined.
    """
    coarse = max(size / 40.0, 2.0 * referred.spacing, 2.0 * scanned.spacing)
    voxel = float(f"{coarse:.3g}")
    if initial is not None:
        tried = [initial]
    else:
        shift = np.median(referred.fine_points, axis=0) - np.median(scanned.fine_points, axis=0)
        tried = [Candidate(T, "features") for T in _feature_poses(scanned, referred, voxel)]
        tried.append(Candidate(rigid_transform(np.eye(3), shift), "centroids"))
    scan, reference = scanned.thinned(voxel), referred.thinned(voxel)
    tree = cKDTree(np.asarray(reference.points))
    sparse_scan = scan.uniform_down_sample(max(1, len(scan.points) // _COARSE_POINTS))
    found: list[Candidate] = []
    for candidate in tried:
        T = candidate.T
        for gate in (6.0 * voxel, 3.0 * voxel, 1.5 * voxel):
            T = align_icp(
                sparse_scan, reference, T, gate, open3d().pipelines.registration.L2Loss(), 1e-5, 20
            )
        if all(pose_distance(np.asarray(scan.points), T, other.T) > 0.5 * voxel for other in found):
            score = _score_pose(scan, reference, tree, T, voxel)
            found.append(replace(candidate, T=T, score=score))
    return sorted(found, key=lambda candidate: -candidate.score)


def pose_distance(points: Floats, T: Floats, other: Floats) -> float:
    """Return the largest coordinate difference in mm of some 20 of the points (n, 3) between two
    poses (4, 4)."""
    return float(np.abs(move_points(T - other, thin_out(points, 20))).max())


def _score_pose(scan: Any, reference: Any, tree: cKDTree, T: Floats, voxel: float) -> float:
    """Return the share of the scan that overlaps the reference, times the share of agreement where
    the two face each other."""
    points = move_points(T, np.asarray(scan.points))
    normals = np.asarray(scan.normals) @ T[:3, :3].T
    distance, nearest = tree.query(points, distance_upper_bound=3.0 * voxel)
    near = np.isfinite(distance)
    if not near.any():
        return 0.0
    other = nearest[near]
    their_normals = np.asarray(reference.normals)[other]
    height = np.abs(
        np.sum(their_normals * (points[near] - np.asarray(reference.points)[other]), axis=1)
    )
    on = (height < 0.5 * voxel) & (np.sum(their_normals * normals[near], axis=1) > 0.9)
    return float(on.sum() / len(points) * on.sum() / near.sum())


def _feature_poses(scanned: PreparedScan, referred: PreparedScan, voxel: float) -> list[Floats]:
    """Return up to six different poses, those on which most feature matches agree; none without
    matches."""
    scan, reference = scanned.thinned(voxel), referred.thinned(voxel)
    matches = np.asarray(
        open3d().pipelines.registration.correspondences_from_features(
            scanned.features(voxel), referred.features(voxel), mutual_filter=True
        )
    )
    if len(matches) < 10:
        return []
    p, q = np.asarray(scan.points)[matches[:, 0]], np.asarray(reference.points)[matches[:, 1]]
    n, m = np.asarray(scan.normals)[matches[:, 0]], np.asarray(reference.normals)[matches[:, 1]]

    triplets = np.random.default_rng(_SEED).integers(0, len(p), (_TRIPLETS, 3))
    span = diagonal(p)
    triplets = triplets[_match_triangles(p[triplets], q[triplets], 0.1 * span, voxel)][:2000]
    if len(triplets) == 0:
        return []
    motions = fit_rigid(p[triplets], q[triplets])
    normal_products = np.einsum("ni,nj->nij", m, n).reshape(-1, 9)
    votes = np.empty(len(motions), dtype=np.int64)
    for chunk in np.array_split(np.arange(len(motions)), max(1, len(motions) * len(p) // 100_000)):
        gap = move_points(motions[chunk], p) - q
        close = np.einsum("kni,kni->kn", gap, gap) < (1.5 * voxel) ** 2
        alike = motions[chunk, :3, :3].reshape(-1, 9) @ normal_products.T > 0.8
        votes[chunk] = np.count_nonzero(close & alike, axis=1)

    poses: list[np.ndarray] = []
    order = np.argsort(-votes, kind="stable")
    rest = motions[order[votes[order] >= max(4.0, _LEAST_VOTES * votes.max())]]
    while len(rest) and len(poses) < _CANDIDATES:
        poses.append(rest[0])
        gaps = move_points(rest - rest[0], thin_out(p, 20))
        rest = rest[np.abs(gaps).max(axis=(1, 2)) > 5.0 * voxel]
    return poses


def _match_triangles(p: Floats, q: Floats, shortest: float, slack: float) -> np.ndarray:
    """Return which pairs of triangles ``(k, 3, 3)`` have sides longer than ``shortest`` that agree
    within ``slack`` mm."""
    a, b = (lengths(x - np.roll(x, 1, axis=1)) for x in (p, q))
    return np.all((a > shortest) & (np.abs(a - b) < slack), axis=1)


def fit_picked_start(
    scan_points: np.ndarray, reference_points: np.ndarray
) -> tuple[Candidate, Floats]:
    """The pose that brings three or more picked points (n, 3) mm of the scan onto those of the
    reference, in order, and how far each pair (n,) stays apart in mm.

    Raises ``InputError`` for picks that do not belong together, and ``Refused`` for ones that lie
    on a line or that no rigid motion brings near each other.
    """
    p, q = np.asarray(scan_points, dtype=np.float64), np.asarray(reference_points, dtype=np.float64)
    if p.shape != q.shape or p.ndim != 2 or p.shape[1] != 3:
        raise InputError(
            f"Picked points of shapes {p.shape} and {q.shape} are not pairs",
            "pick as many on both scans.",
        )
    if len(p) < LEAST_PICKS:
        raise InputError(
            f"{len(p)} point pairs were picked", f"pick {LEAST_PICKS} or more, well apart."
        )
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise InputError("A picked point lies where nothing was measured", "pick on the surface.")
    for name, points in (("scan", p), ("reference", q)):
        extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not extents[1] > _THIN * extents[0] or not extents[0] > 0:
            raise Refused(
                "picks",
                f"The points picked on the {name} lie on one line, which leaves the turn about it"
                " open: pick one more beside it.",
            )
    T = fit_rigid(p, q)
    residual = lengths(move_points(T, p) - q)
    extent = diagonal(q)
    if residual.max() > _WORST * extent:
        raise Refused(
            "picks",
            f"The picked pairs stay up to {residual.max():.1f} mm apart (pair"
            f" {int(residual.argmax()) + 1} the most): pick the same points, in the same order, on"
            " both scans.",
        )
    return Candidate(T, "picked"), np.asarray(residual)


MAX_ANGLE_ERROR_DEG = 3.0
"""Largest difference between a measured and a given step of the turntable."""


@dataclass(frozen=True, eq=False)
class TurntableAxis:
    """A turntable's axis in the camera's frame: a ``point`` (3,) mm on it and its ``direction``
    (3,).

    Positive angles are right-handed about the direction.
    """

    point: np.ndarray
    direction: Floats

    def rotation(self, deg: float) -> Floats:
        """Return the motion (4, 4) of an object on the table when the table turns by an angle."""
        return turn_about(np.radians(deg) * unit_vectors(self.direction), self.point)


def shortest_turn(deg: float) -> float:
    """Return the angle, -180 to 180 degrees, that turns to the same place."""
    return (deg + 180.0) % 360.0 - 180.0


def determines_axis(deg: float) -> bool:
    """Whether a step of the table by -180 to 180 degrees is far enough from 0 and from 180 to give
    its axis."""
    return MAX_ANGLE_ERROR_DEG < abs(deg) < 180.0 - MAX_ANGLE_ERROR_DEG


def fit_turntable_axis(steps: Sequence[Floats], step_deg: ArrayLike) -> TurntableAxis:
    """Fit the axis to registrations of scans, T_before_after (4, 4) mm each, ``step_deg`` apart:
    one angle, or (n,).

    The direction is such that the table turns by ``step_deg`` from a scan to the one after it.
    Raises ``InputError`` where a measured step differs from its angle, and for angles near 0 or 180
    degrees, which determine no direction.
    """
    given = np.broadcast_to(np.asarray(step_deg, np.float64), len(steps))
    if unfit := [deg for deg in given if not determines_axis(deg)]:
        raise InputError(
            f"A turntable's step of {unfit[0]:g} degrees gives no axis",
            f"step by {MAX_ANGLE_ERROR_DEG:g} to {180 - MAX_ANGLE_ERROR_DEG:g} degrees, either way,"
            " or start from features.",
        )
    # registration turns the later scan back by the table's step
    turns = np.array([-np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) for T in steps])
    angles = lengths(turns)
    for angle, deg in zip(angles, np.abs(given), strict=True):
        if abs(angle - deg) > MAX_ANGLE_ERROR_DEG:
            raise InputError(
                f"Two scans in a row lie {angle:.1f} degrees apart and the turntable is said to"
                f" step by {deg:g}",
                "check the angle and the order of the scans, or start from features.",
            )
    direction = (turns / angles[:, None] * np.sign(given)[:, None]).mean(axis=0)
    A = np.vstack([np.eye(3) - T[:3, :3] for T in steps])
    b = np.concatenate([T[:3, 3] for T in steps])
    # the position along the axis is free: the minimum-norm solution is the point nearest to the
    # camera
    return TurntableAxis(np.linalg.lstsq(A, b, rcond=1e-3)[0], unit_vectors(direction))
