"""The pose of a shape that slides or turns, from a small feature: a dent, a keyway, a mark.

The mean over the overlap leaves such motions undetermined, although a feature of a few points may
determine them. Moved along its loose motions, a scan fits as before except where either scan shows
the feature; these points give the pose, and the rise of their misfit shows how well.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.rigid import Floats, Uncertainty, move_points, turn_about
from slviewer.geometry.vectors import lengths, occupied_cubes, subsample, unit_vectors
from slviewer.registration.open3d_loader import fit_normals, open3d
from slviewer.registration.refine import LooseMotions, RefinedPose, refine_pose
from slviewer.registration.scan import PreparedScan
from slviewer.registration.start import pose_distance

MOST_ERROR = 1 / 100
"""Of the object's size: what a feature may leave open at the rim (1 sigma)."""
_RISE, _MOTION = 100.0, 1 / 30
"""Least rise of the misfit, in variances of the noise, by a motion over the size."""
_DEPTH = 3.0
"""Least depth of a feature, over the noise of a point."""
_ABOVE = 4.0
"""Least squared misfit over that of the places of the other scan where the motions bring it."""
_LEAST_POINTS = 15  # of a feature, in each scan
_EXPLAINED = 0.6
"""Least share of the feature's misfit that vanishes at the pose."""
_ALIKE = 0.85
"""A rival's share of the best pose's gain."""
_DISTINCT = 1 / 20
"""Least distance of a rival from the pose, over the object's size."""
_NEIGHBOURS, _OF_NORMALS = 6, 10
_SURVEYED = (1 / 16, 1 / 8, 1 / 4, 1 / 2) * 3
"""Motions along which misfit is surveyed, over the object's size."""
_LEAST_SURVEYED = 3
_MOST_POINTS, _TARGETS = 40_000, 40
_PROBES, _SPUN_PROBES = 10, 2
_SPIN_DEG = 15
_BEST = 6
_UNSEEN = 1.25
"""Ratio of true to estimated sigma, as in ``refine``."""


class _Surface:
    """The thinned points of a scan, with normals that follow small features."""

    def __init__(self, scan: PreparedScan) -> None:
        cloud = open3d().geometry.PointCloud(scan.fine)
        fit_normals(cloud, _OF_NORMALS)
        self.points, self.tree = scan.fine_points, scan.fine_tree
        self.normals = np.asarray(cloud.normals)

    def distances(self, points: Floats, normals: Floats, reach: float) -> Floats:
        """Return the mean distances (...) mm of points (..., 3) from their neighbours along the
        mean of both normals, at most ``reach``; NaN beyond the rim."""
        away, near = self.tree.query(points, _NEIGHBOURS)
        gaps = points[..., None, :] - self.points[near]
        both, own = self.normals[near], normals[..., None, :]
        both = unit_vectors(both + own * np.sign(np.sum(both * own, axis=-1, keepdims=True)))
        height = np.sum(gaps * both, axis=-1).mean(axis=-1)
        # the neighbours of a point beyond the rim lie on one side of it
        across, farthest = (
            np.maximum(each**2 - height**2, 0.0)
            for each in (lengths(gaps.mean(axis=-2)), away[..., -1])
        )
        return np.where(across > 0.4 * farthest, np.nan, np.clip(height, -reach, reach))


@dataclass(frozen=True, eq=False)
class _Side:
    """The feature's points and normals (n, 3) of one scan, and their squared misfit (n,) mm² where
    the other scan does not show it."""

    points: Floats
    normals: Floats
    misfit: Floats
    other: _Surface

    def distances(self, T: Floats, reach: float) -> Floats:
        """Return the distances (..., n) mm from the other scan at poses (..., 4, 4)."""
        normals = self.normals @ np.swapaxes(T[..., :3, :3], -1, -2)
        return self.other.distances(move_points(T, self.points), normals, reach)

    def select(self, which: np.ndarray | slice) -> "_Side":
        """Return some of the points."""
        return replace(
            self,
            points=self.points[which],
            normals=self.normals[which],
            misfit=self.misfit[which],
        )


@dataclass(frozen=True, eq=False)
class _Feature:
    """What of two scans does not fit when the scan moves along the loose motions.

    ``sigma`` mm: noise of a distance; ``reach`` mm: the largest one.
    """

    scan: _Side
    reference: _Side
    sigma: float
    reach: float

    @property
    def misfit(self) -> Floats:
        """(n,) mm²: of the points of both scans."""
        return np.concatenate([self.scan.misfit, self.reference.misfit])

    def distances(self, poses: Floats) -> Floats:
        """Return distances (..., n) mm of the points of both scans at poses (..., 4, 4); NaN beyond
        the rim."""
        sides = (self.scan, poses), (self.reference, np.asarray(np.linalg.inv(poses), float))
        return np.concatenate([side.distances(T, self.reach) for side, T in sides], axis=-1)

    def gains(self, poses: Floats) -> Floats:
        """Return how much of the misfit vanishes (...) mm² at poses (..., 4, 4)."""
        return np.nansum(self.misfit - self.distances(poses) ** 2, axis=-1)

    def jacobian(self, T: Floats, loose: LooseMotions, width: float) -> Floats:
        """Return the derivatives (n, k) of the distances by the loose motions, over ``width`` mm to
        either side: normals of a few points would be too noisy."""
        steps = width * np.eye(loose.count)
        ends = [np.stack([loose.move(sign * each) @ T for each in steps]) for sign in (1, -1)]
        ahead, behind = (self.distances(each) for each in ends)
        return np.nan_to_num((ahead - behind).T / (2.0 * width))

    def thinned(self, most: int) -> "_Feature":
        """The feature with at most so many points of each scan."""
        scan, reference = (
            side.select(np.s_[:: -(-len(side.points) // most)])
            for side in (self.scan, self.reference)
        )
        return replace(self, scan=scan, reference=reference)


def hold_by_feature(
    scan: PreparedScan,
    reference: PreparedScan,
    pose: RefinedPose,
    loose: LooseMotions,
    size: float,
) -> list[RefinedPose]:
    """Return the poses at which a feature of both scans coincides, the best first and then those
    that fit alike; [] where no feature determines the pose.

    ``pose``: one at which the surfaces agree, up to the ``loose`` motions; ``size``: of the object,
    mm.
    """

    def tighten(T: Floats) -> RefinedPose:
        """Refine a pose without its loose motions."""
        return refine_pose(scan, reference, T, pose.gate_mm, pose.gate_mm, loose=loose)

    amounts = np.random.default_rng(0).normal(size=(len(_SURVEYED), loose.count))
    amounts = size * np.array(_SURVEYED)[:, None] * unit_vectors(amounts)
    surveyed = [tighten(loose.move(each) @ pose.T) for each in amounts]
    poses = np.array([each.T for each in surveyed if np.isfinite(each.uncertainty.shift_mm)])
    feature = None
    if loose.count <= 3 and len(poses) >= _LEAST_SURVEYED:
        feature = _detect_feature(scan, reference, poses, 2.0 * pose.gate_mm)
    if feature is None:
        return []
    bases = [pose.T, *(tighten(T).T for T in _flip(scan, pose.T, loose))]
    width = 3.0 * max(scan.fine_spacing, reference.fine_spacing)
    solutions: list[tuple[float, RefinedPose]] = []
    for T in _list_candidates(feature, bases, loose):
        T = _settle(feature, tighten(T).T, loose, width)
        refined = tighten(T)
        T = _settle(feature, refined.T, loose, width)
        solutions.append((float(feature.gains(T)), replace(refined, T=T)))
    solutions.sort(key=lambda each: -each[0])
    best, held = solutions[0]
    uncertainty = _estimate_uncertainty(feature, held, loose, width, size)
    if uncertainty is None:
        return []
    # the edges of a step have several minima side by side
    distinct = [held]
    for gain, each in solutions:
        gaps = [pose_distance(scan.fine_points, each.T, other.T) for other in distinct]
        if gain >= _ALIKE * best and min(gaps) > _DISTINCT * size:
            distinct.append(each)
    return [replace(each, uncertainty=uncertainty) for each in distinct]


def _detect_feature(
    scan: PreparedScan, reference: PreparedScan, poses: Floats, reach: float
) -> _Feature | None:
    """Return the points that do not fit at most of the ``poses`` (m, 4, 4), which differ by loose
    motions; None where too few do."""
    found = []
    surfaces = _Surface(scan), _Surface(reference)
    both_ways = poses, np.linalg.inv(poses)
    for own, other, T in zip(surfaces, surfaces[::-1], both_ways, strict=True):
        points, normals = (subsample(each, _MOST_POINTS) for each in (own.points, own.normals))
        side = _Side(points, normals, np.zeros(len(points)), other)
        squares = np.array([side.distances(each, reach) ** 2 for each in T])
        is_seen = np.count_nonzero(np.isfinite(squares), axis=0) >= _LEAST_SURVEYED
        if np.count_nonzero(is_seen) < _LEAST_POINTS:
            return None
        side.misfit[is_seen] = np.nanmedian(squares[:, is_seen], axis=0)
        found.append(side.select(is_seen))
    sigma = float(1.4826 * np.sqrt(np.median(np.concatenate([side.misfit for side in found]))))
    smooth = []
    for side in found:
        near = cKDTree(side.points).query(side.points, _NEIGHBOURS + 1)[1]
        smooth.append(np.median(side.misfit[near], axis=1))
    sides = []
    for k, T in enumerate(both_ways):
        shown = np.flatnonzero(smooth[k] > (_DEPTH * sigma) ** 2)
        # along edges of the shape all points fit badly
        landed = cKDTree(found[1 - k].points).query(move_points(T, found[k].points[shown]))[1]
        shown = shown[smooth[k][shown] > _ABOVE * np.median(smooth[1 - k][landed], axis=0)]
        if len(shown) < _LEAST_POINTS:
            return None
        sides.append(found[k].select(shown))
    return _Feature(sides[0], sides[1], sigma, reach)


def _flip(scan: PreparedScan, T: Floats, loose: LooseMotions) -> Iterator[Floats]:
    """Yield the pose (4, 4) turned by 180 degrees about principal axes: a part with equal ends may
    lie either way round."""
    points = move_points(T, subsample(scan.fine_points, 2000))
    middle = points.mean(axis=0)
    if len(loose.turns) == 3:
        return
    main = unit_vectors(np.vstack([loose.turns, loose.shifts])[0])
    if len(loose.turns):
        middle = loose.centre + main * ((middle - loose.centre) @ main)
    arm = points - middle
    arm -= np.outer(arm @ main, main)
    across = np.linalg.eigh(arm.T @ arm)[1][:, 1:].T
    for axis in (main, *across):
        yield turn_about(np.pi * axis, middle) @ T


def _list_candidates(feature: _Feature, bases: list[Floats], loose: LooseMotions) -> list[Floats]:
    """Return the poses (4, 4) that bring points of the scan's feature to points of the reference's
    along the loose motions, those of the largest gain."""
    few = feature.thinned(_TARGETS)
    probes = subsample(feature.scan.points, _SPUN_PROBES if loose.spins else _PROBES)
    starts = [
        carried
        for base in bases
        for point in move_points(base, probes)
        for target in few.reference.points
        for carried in _carry(point, target, loose, base)
    ]
    poses = np.array(starts)
    gains = np.concatenate(
        [few.gains(each) for each in np.array_split(poses, 1 + len(poses) // 1000)]
    )
    chosen: list[Floats] = []
    apart = 0.1 * loose.radius
    for k in np.argsort(-gains):
        gaps = [lengths(move_points(poses[k] - T, feature.scan.points)).max() for T in chosen]
        if all(gap > apart for gap in gaps):
            chosen.append(poses[k])
        if len(chosen) == _BEST:
            break
    return chosen


def _carry(point: Floats, target: Floats, loose: LooseMotions, T: Floats) -> Iterator[Floats]:
    """Yield the pose ``T`` (4, 4) moved along the loose motions so that a point (3,) comes to a
    target (3,), turned about it where the motions leave this open."""
    turns, shifts = unit_vectors(loose.turns), loose.shifts
    is_flat = len(shifts) == 2
    rotation = np.zeros(3)
    spin = turns[0] if len(turns) else np.zeros(3)
    if len(turns) and not is_flat:
        # in the plane across a single axis; about three, in space
        free = np.eye(3) if len(turns) == 3 else np.eye(3) - np.outer(spin, spin)
        before, after = unit_vectors(np.stack([point, target]) - loose.centre) @ free
        across = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(across), before @ after)
        rotation = angle * unit_vectors(across)
        spin = unit_vectors(target - loose.centre)
    M = turn_about(rotation, loose.centre)
    M[:3, 3] += (target - move_points(M, point[None])[0]) @ shifts.T @ shifts
    for deg in np.arange(0, 360, _SPIN_DEG if loose.spins else 360):
        yield turn_about(np.radians(deg) * spin, target) @ M @ T


def _settle(feature: _Feature, T: Floats, loose: LooseMotions, width: float) -> Floats:
    """Return the pose (4, 4) moved along the loose motions to the least misfit, by Gauss-Newton
    steps."""
    for step in (2.0 * width, width):
        for _ in range(8):
            distances = np.nan_to_num(feature.distances(T))
            J = feature.jacobian(T, loose, step)
            amounts: Floats = np.asarray(-np.linalg.lstsq(J, distances, rcond=1e-3)[0], float)
            length = float(lengths(amounts))
            T = loose.move(amounts * min(1.0, step / max(length, 1e-9))) @ T
            if length < 0.01 * step:
                break
    return T


def _estimate_uncertainty(
    feature: _Feature, pose: RefinedPose, loose: LooseMotions, width: float, size: float
) -> Uncertainty | None:
    """Return the uncertainty of a pose that the feature holds; None where it does not."""
    distances, T = feature.distances(pose.T), pose.T
    is_seen = np.isfinite(distances)
    gain = feature.gains(T)
    if not gain > _EXPLAINED * feature.misfit[is_seen].sum():
        return None
    J = feature.jacobian(T, loose, width)
    least = (_RISE + 5.0 * np.sqrt(2.0 * np.count_nonzero(is_seen))) * feature.sigma**2
    for motion in _MOTION * size * np.linalg.eigh(J.T @ J)[1].T:
        ends = np.stack([loose.move(sign * motion) @ T for sign in (1, -1)])
        if not (gain - feature.gains(ends) > least).all():
            return None
    # the points of a patch share counterparts, and the edge of a step: they count as one
    points = np.vstack([move_points(T, feature.scan.points), feature.reference.points])
    count = len(occupied_cubes(points, 2.0 * width)[0])
    squares = np.nansum(distances**2) / max(count - loose.count, 1)
    covariance = _UNSEEN**2 * squares * np.linalg.inv(J.T @ J)
    if not np.trace(covariance) < (MOST_ERROR * size) ** 2:
        return None
    twists = loose.twists(pose.uncertainty.centre)
    return replace(
        pose.uncertainty, covariance=pose.uncertainty.covariance + twists.T @ covariance @ twists
    )
