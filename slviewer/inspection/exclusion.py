"""Which points of a scan are deviations of the part, and which are not the part at all.

The worst errors of a part are the points that lie farthest from its nominal model. A point is
therefore excluded only where it cannot be the part: alone (a spike), or part of something that
stands beside the part's footprint (a table, a clamp). All other points are deviations, at any
distance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.shapes import Plane, ransac_plane
from slviewer.geometry.vectors import occupied_cubes, subsample, unit_vectors
from slviewer.inspection.nominal_surface import MIN_NORMAL_COSINE, NominalSurface
from slviewer.records.measurement import ExcludedPoints, Exclusion
from slviewer.records.record import to_vector
from slviewer.surface.shapes import extent_across, label_connected

NOISE = 4.0
"""Standard deviations: what is nearer to the nominal than that lies on it."""
LINK = 2.0
"""Of the spacing that most neighbours of a scan keep threefold: within a cluster."""
MIN_CLUSTER = 5
"""Points of a cluster; fewer are spikes."""
MIN_TABLE = 50
TABLE_SHARE = 0.2
"""Points of a plane that the part stands on, and its least share of those beside the part."""
MAX_PLANES = 3
TABLE_TOLERANCE, LARGER, MOST_TABLE = 0.002, 1.2, 0.97
"""Thickness of a plane over the nominal's diagonal; its size over that, from which on it cannot be
the part; and the largest share of a scan that is a table."""
FOOTPRINT_SHARE = 0.5
"""Share of a cluster's points over the footprint, or inside the nominal, that makes it a deviation
of the part."""
BURR = 0.1
"""Of the nominal's diagonal: what touches the part beside its footprint and reaches less far from
it is the part's own, a burr or dirt; what reaches farther may be a clamp."""
STANDING = 0.9
"""Share of what touches the part that lies over the touched face, where it is a feature."""
CONTACT = 0.5
"""Of the spacing that most neighbours of a scan keep threefold: what is nearer touches."""
MAX_CONTACT_POINTS, MAX_TRIED_POINTS = 200_000, 20_000


@dataclass(frozen=True, eq=False)
class ClassifiedPoints:
    """What each point of a scan is.

    ``signed`` (n,) mm: deviation, NaN where excluded; ``is_unmatched`` (n,) bool: deviations far
    from the nominal, or that face another way than the nominal where they are nearest; ``excluded``
    lists the others.
    """

    signed: Floats
    is_unmatched: Mask
    excluded: tuple[ExcludedPoints, ...]


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """A scan's points at the best fit.

    ``points`` and their unit ``normals`` (n, 3) in the nominal's frame, NaN or None where unknown;
    ``away`` (n,) mm from the nearest place on the nominal, positive outside and infinite beyond the
    rim of an open one, whose normal is ``towards`` (n, 3). ``spacing_mm``: of the scan, between
    most neighbours; ``noise_mm``: standard deviation of a point.
    """

    points: Floats
    normals: Floats | None
    away: Floats
    towards: Floats
    spacing_mm: float
    noise_mm: float

    def facing(self) -> Floats:
        """Return the cosines (n,) between the points' normals and the nominal's; 1 if unknown."""
        if self.normals is None:
            return np.ones(len(self.points))
        cosine = np.einsum("ij,ij->i", self.normals, self.towards)
        return np.where(np.isfinite(cosine), cosine, 1.0)


def classify_points(
    scan: LocatedPoints, surface: NominalSurface, reach: float, views: Sequence[Floats]
) -> ClassifiedPoints:
    """Separate deviations from what is not the part.

    ``reach`` mm: what lies nearer and faces alike is on the nominal. ``views``: of each view the
    centres (k, 3) mm of its devices, in the nominal's frame.
    """
    facing, signed = scan.facing(), scan.away.copy()
    gap = np.abs(signed)
    # noise moves a point beyond an edge, where the nearest place faces another way
    is_near = (gap <= reach) & (facing >= MIN_NORMAL_COSINE)
    is_near |= (gap <= NOISE * scan.noise_mm) & (facing > -MIN_NORMAL_COSINE)
    far = np.flatnonzero(~is_near)
    if not len(far):
        return ClassifiedPoints(signed, ~is_near, ())
    beyond = far[np.isinf(signed[far])]
    signed[beyond] = surface.gaps(scan.points[beyond])
    is_inside = (signed[far] < 0) | ((facing[far] < -MIN_NORMAL_COSINE) & (gap[far] <= reach))
    excluded = list[ExcludedPoints]()
    foreign = list[np.ndarray]()
    # an open model has no underside: a table that is seen through its holes lies behind it
    beside = np.ones(len(far), bool) if not surface.is_closed else ~is_inside
    for plane in _list_tables(scan.points[far[beside]], surface, scan):
        on_plane = beside & (np.abs(plane.distance(scan.points[far])) <= _plane_tolerance(scan))
        foreign.append(far[on_plane])
        excluded.append(_describe("table", scan.points[far[on_plane]]))
        far, is_inside, beside = far[~on_plane], is_inside[~on_plane], beside[~on_plane]
    if not surface.is_closed:
        is_inside &= _is_over(scan, far, surface, views, outwards=True)
    outside = far[~is_inside]
    rest = np.concatenate([far[is_inside], outside])
    inside_count = int(is_inside.sum())
    part = cKDTree(subsample(scan.points[is_near], MAX_CONTACT_POINTS)) if is_near.any() else None
    is_over = np.arange(len(rest)) < inside_count
    is_over[inside_count:] = _is_over(scan, outside, surface, views)
    alone = list[np.ndarray]()
    for members in label_clusters(scan.points[rest], LINK * scan.spacing_mm):
        cluster = rest[members]
        if len(cluster) < MIN_CLUSTER:
            alone.append(cluster)
        elif is_over[members].mean() < FOOTPRINT_SHARE:
            reason = _reason_to_exclude(scan, cluster, signed, surface, part)
            if reason is not None:
                foreign.append(cluster)
                excluded.append(_describe(reason, scan.points[cluster]))
    if alone:
        excluded.append(_describe("alone", scan.points[np.concatenate(alone)]))
    if foreign:
        border = _list_border(scan, is_near, np.concatenate(foreign))
        if len(border):
            excluded.append(_describe("border", scan.points[border]))
        signed[border] = np.nan
    signed[np.concatenate([*alone, *foreign, far[:0]])] = np.nan
    return ClassifiedPoints(signed, ~is_near & np.isfinite(signed), tuple(excluded))


def _reason_to_exclude(
    scan: LocatedPoints,
    cluster: np.ndarray,
    signed: Floats,
    surface: NominalSurface,
    part: cKDTree | None,
) -> Exclusion | None:
    """Return why a ``cluster`` (k,) beside the footprint is not the part, whose points on the
    nominal are in the tree ``part``; None where it is a deviation."""
    places = subsample(scan.points[cluster], MAX_TRIED_POINTS)
    if part is None or not (part.query(places)[0] <= CONTACT * scan.spacing_mm).any():
        return "beside"
    is_low = np.abs(signed[cluster]).max() < BURR * surface.diagonal
    return None if is_low or _stands_on(scan, cluster, signed, surface) else "touching"


def label_clusters(points: Floats, link: float) -> Iterator[np.ndarray]:
    """Yield the members (k,) of each cluster of points (n, 3), in which neighbours are at most
    about ``link`` mm apart."""
    if not len(points):
        return
    cubes, which = occupied_cubes(points, link / np.sqrt(3))
    pairs = cKDTree(cubes).query_pairs(1.8, output_type="ndarray")
    labels = label_connected(pairs, len(cubes))[which]
    order = np.argsort(labels, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _is_over(
    scan: LocatedPoints,
    chosen: np.ndarray,
    surface: NominalSurface,
    views: Sequence[Floats],
    outwards: bool = False,
) -> Mask:
    """Return which ``chosen`` (k,) points lie over the nominal's footprint: whether the ray that
    they were seen along meets it; ``outwards``: on its way to the camera.

    Without views a point was seen along its normal; without that too it counts as over it.
    """
    points = scan.points[chosen]
    normals = None if scan.normals is None else scan.normals[chosen]
    if views:
        cameras = np.stack([centres[0] for centres in views])
        towards = unit_vectors(cameras[:, None] - points)
        nearest = np.zeros(len(points), np.intp)
        if normals is not None:  # of several views the one that it faces
            nearest = np.argmax(np.nan_to_num(np.einsum("kni,ni->kn", towards, normals)), axis=0)
        towards = towards[nearest, np.arange(len(points))]
        if outwards:
            return surface.is_hit(points, towards)
        return surface.is_hit(cameras[nearest], -towards)
    if normals is None:
        return np.ones(len(points), bool)
    known = np.isfinite(normals).all(axis=1)
    is_over = ~known
    is_over[known] = surface.is_hit(points[known], (1.0 if outwards else -1.0) * normals[known])
    return is_over


def _stands_on(
    scan: LocatedPoints, cluster: np.ndarray, signed: Floats, surface: NominalSurface
) -> bool:
    """Return whether all of a cluster (k,) lies over the face of the nominal that it touches."""
    nearest = np.argsort(np.abs(signed[cluster]))[: max(3, len(cluster) // 20)]
    facing = unit_vectors(np.nan_to_num(scan.towards[cluster[nearest]]).mean(axis=0))
    points = scan.points[subsample(cluster, 2000)]
    return bool(surface.is_hit(points, np.broadcast_to(-facing, points.shape)).mean() >= STANDING)


def _plane_tolerance(scan: LocatedPoints) -> float:
    return max(NOISE * scan.noise_mm, 0.1 * scan.spacing_mm)


def _list_tables(points: Floats, surface: NominalSurface, scan: LocatedPoints) -> Iterator[Plane]:
    """Yield the planes among points (n, 3) beside the part that the nominal lies wholly on one side
    of, and that reach farther than it: a table, a wall."""
    tolerance, count = _plane_tolerance(scan), len(points)
    for _ in range(MAX_PLANES):
        if len(points) < max(MIN_TABLE, TABLE_SHARE * count):
            return
        try:
            plane, _ = ransac_plane(points, tolerance)
        except InputError:
            return
        on_plane = np.abs(plane.distance(points)) <= tolerance
        heights = plane.distance(surface.vertices)
        side = np.sign(np.median(heights))
        is_beside = (side * heights).min() > -2 * max(tolerance, scan.spacing_mm)
        is_wide = extent_across(points[on_plane]) > surface.diagonal
        if on_plane.sum() < max(MIN_TABLE, TABLE_SHARE * count) or not (is_beside and is_wide):
            return
        yield plane
        points = points[~on_plane]


def find_tables(points: Floats, surface: NominalSurface, sigma_mm: float) -> Mask:
    """Return which points (n, 3) of a scan, anywhere, lie on planes that are too large for the
    part: (n,) bool."""
    on_table = np.zeros(len(points), bool)
    tolerance = max(NOISE * sigma_mm, TABLE_TOLERANCE * surface.diagonal)
    for _ in range(MAX_PLANES):
        some = subsample(points[~on_table], MAX_TRIED_POINTS)
        low, high = np.percentile(some, [1, 99], axis=0)
        if np.linalg.norm(high - low) < LARGER * surface.diagonal:
            break
        try:
            plane, inliers = ransac_plane(some, tolerance)
        except InputError:
            break
        low, high = np.percentile(some[inliers], [2, 98], axis=0)
        if np.linalg.norm(high - low) < LARGER * surface.diagonal:
            break
        on_table |= np.abs(plane.distance(points)) <= tolerance
    return on_table if on_table.mean() < MOST_TABLE else np.zeros(len(points), bool)


def _list_border(scan: LocatedPoints, is_near: Mask, foreign: np.ndarray) -> np.ndarray:
    """Return the points (k,) on the nominal that rise towards something foreign beside them, as
    smoothed normals and pixels on both make them."""
    raised = np.flatnonzero(is_near & (scan.away > NOISE * scan.noise_mm))
    if not len(raised):
        return raised
    tree = cKDTree(subsample(scan.points[foreign], MAX_CONTACT_POINTS))
    return raised[tree.query(scan.points[raised], workers=-1)[0] <= scan.spacing_mm]


def _describe(reason: Exclusion, points: Floats) -> ExcludedPoints:
    """Return how many points (n, 3) are excluded, and where they are."""
    middle = np.median(points, axis=0)
    across = 0.0 if reason in ("alone", "border") else extent_across(points)
    return ExcludedPoints(reason, len(points), to_vector(middle), across)
