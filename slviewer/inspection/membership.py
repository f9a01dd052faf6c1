"""Which points of a region belong to a feature, at any distance from it, and which cannot: isolated
ones, and those of other surfaces beside or behind what was measured of the feature."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.inspection.features import Feature, perpendicular_axes
from slviewer.inspection.regions import Region

NEIGHBOURS = 16
"""Points that a place on a measured feature has within the radius that is looked at."""
MEASURED_SHARE, HOLE_SHARE = 1 / 4, 1 / 8
"""Of these: with fewer points of the feature, its surface is not measured there, but points that
deviate and lie parallel to it are; with the lesser share also those that do not."""
DOUBTED_SHARE = 3 / 4
"""With more of them, all of the feature is measured there, and what is parallel stands over it."""
MIN_PARALLEL, SAME_COSINE = 0.5, 0.8
"""Cosine between the normal of the feature and that of a surface that may be its own; of one that
is, where hardly anything else was measured: neighbours at an edge mix the normals of both sides."""
MAX_SLOPE = 0.5
"""Rise over run from what was measured near the feature, by which a parallel surface goes on from
there, as a shallow dent does, however small."""
LEAST_COMPANY = 3
"""Of a point's eight neighbours that deviate alike: with fewer it is isolated."""
TOGETHER = 1 / 4
"""Mean deviation of the eight, over the reach: about the deepest point of a dent all lie off."""
ALIKE, LEAST_ALIKE = 0.5, 6
"""Share of a point's distance by which those of its company differ from it at most, and the least
number of these with itself."""
MAX_ONE_SIDED = 0.5
"""Length of the mean of the unit vectors to what surrounds a place: 2 / pi at a straight rim."""
AREA_SIDE = 60
"""Places along each direction of a feature, at which is seen whether it was measured."""
MIN_SEEN_COSINE = 0.45
SPACINGS = 3.0
"""As for a nominal model in `deviation`."""


@dataclass(frozen=True, eq=False)
class Membership:
    """Which points (n,) bool are ``isolated``, which are ``beside`` the feature, on another
    surface, and which ``deviate``: the feature's own, though far from it. All others are near.
    ``doubtful``: those beside it that may be its own: parallel, and over its area."""

    isolated: Mask
    beside: Mask
    deviates: Mask
    doubtful: Mask

    @property
    def belongs(self) -> Mask:
        """(n,) bool: the points of the feature."""
        return ~(self.isolated | self.beside)

    def describe_excluded(self) -> str:
        """Which points are excluded and why; empty where none is."""
        n = max(len(self.beside), 1)
        reasons = {
            "on other surfaces beside it": self.beside,
            "isolated": self.isolated,
        }
        return ", ".join(
            f"{100 * np.count_nonzero(mask) / n:.2g} % {reason}"
            for reason, mask in reasons.items()
            if mask.any()
        )


def find_isolated(points: Floats, residuals: Floats, reach: float) -> Mask:
    """Which points (n, 3) lie farther than ``reach`` mm off by ``residuals`` (n,), without
    neighbours that deviate to the same side, some by half of that at least, or `TOGETHER` all by
    less: (n,) bool."""
    is_far = np.abs(residuals) > reach
    isolated, count = is_far.copy(), min(9, len(points))
    if is_far.any() and count > 1:
        _, near = cKDTree(points).query(points[is_far], k=count)
        along = np.sign(residuals[is_far])[:, None] * residuals[near[:, 1:]] / reach
        company = np.sum(along > 0.5, axis=1) >= min(LEAST_COMPANY, count - 1)
        isolated[is_far] = ~company & (np.clip(along, -1, 1).mean(axis=1) < TOGETHER)
    return isolated


def find_members(
    feature: Feature,
    points: Floats,
    normals: Floats,
    is_near: Mask,
    inside: Mask,
    camera: Floats | None = None,
) -> Membership:
    """Tell which points (n, 3), of surfaces with ``normals`` (n, 3) of either sign, belong to a
    feature; those that are ``is_near`` (n,) bool do.

    Others do where nothing else was measured of the feature: over its own area a point deviates at
    any distance. What is not ``inside`` (n,) the region of the feature does only where its foot is
    surrounded by what was measured of the feature. ``camera`` (3,): from where it was measured, if
    that is known: what a feature turns away from it has no points.
    """
    far = np.flatnonzero(~is_near)
    masks = [np.zeros(len(points), bool) for _ in range(4)]
    membership = Membership(*masks)
    if not len(far) or len(points) - len(far) <= NEIGHBOURS:
        return membership
    distances, along = feature.distance(points), feature.normals(points)
    feet = points - distances[:, None] * along
    tree = cKDTree(feet[is_near])
    sample = feet[is_near][:: max(1, len(tree.data) // 1000)]
    radius = float(np.median(tree.query(sample, k=NEIGHBOURS)[0][:, -1]))
    measured = tree.query_ball_point(feet[far], radius, return_length=True) / NEIGHBOURS
    parallel = np.abs(np.sum(normals[far] * along[far], axis=1)) > SAME_COSINE
    own = (measured <= MEASURED_SHARE) & parallel & inside[far]
    is_hole = (measured <= HOLE_SHARE) & (parallel | _fill_area(feet[far], radius))
    beyond = is_hole & ~inside[far]
    is_hole[beyond] &= measured[beyond] == 0
    beyond &= is_hole
    is_hole[beyond] = _are_surrounded(feet[far][beyond], tree, 3 * radius)
    own |= is_hole
    if camera is not None:
        facing = np.sum(along * (camera - feet), axis=1)
        side = np.sign(np.median(facing[is_near]))
        own &= side * facing[far] > 0
    is_open = (measured <= HOLE_SHARE) & inside[far]
    own = _spread_to_company(own, is_open, feet[far], distances[far], radius)
    gaps = tree.query(feet[far])[0]
    goes_on = parallel & inside[far] & (np.abs(distances[far]) <= MAX_SLOPE * gaps)
    own |= _select_company(goes_on, feet[far], distances[far], 2 * radius)
    company = cKDTree(points[far]).query_ball_point(points[far], 2 * radius, return_length=True)
    membership.deviates[far] = own
    membership.isolated[far] = ~own & (company <= LEAST_COMPANY)
    membership.beside[far] = beside = ~own & (company > LEAST_COMPANY)
    may_be = beside & parallel & inside[far] & (measured <= DOUBTED_SHARE)
    may_be[may_be] = _are_surrounded(feet[far][may_be], tree, 3 * radius)
    membership.doubtful[far] = _select_company(may_be, feet[far], distances[far], 2 * radius)
    return membership


def _are_surrounded(feet: Floats, near: cKDTree, reach: float) -> Mask:
    """Which places (n, 3) have points of a tree within ``reach`` mm on all sides: (n,) bool."""
    surrounded = np.zeros(len(feet), bool)
    for k, around in enumerate(near.query_ball_point(feet, reach)):
        if around:
            towards = unit_vectors(near.data[around] - feet[k])
            surrounded[k] = np.linalg.norm(towards.mean(axis=0)) < MAX_ONE_SIDED
    return surrounded


def _spread_to_company(
    own: Mask, is_open: Mask, feet: Floats, distances: Floats, radius: float
) -> Mask:
    """Which far points, with ``feet`` (n, 3) on the feature, are its ``own`` (n,), of those that
    have as many near ones at about their ``distances`` (n,) as a surface has; and those next to
    them that lie between them and the feature, or deeper, down a steep wall, where hardly anything
    of the feature was measured (``is_open``)."""
    if len(feet) < LEAST_ALIKE:
        return np.zeros(len(feet), bool)
    near, alike = _find_alike(feet, distances, radius)
    own = own & (np.sum(alike, axis=1) >= LEAST_ALIKE)
    d, around = distances[:, None], distances[near]
    is_beside = (lengths(feet[near] - feet[:, None]) <= radius) & (around * d > 0)
    leads = is_beside & is_open[:, None] & (np.abs(around) >= ALIKE * np.abs(d))
    while np.any(found := (leads & own[near]).any(axis=1) & ~own):
        own |= found
    is_between = is_beside & (np.abs(around) >= np.abs(d))
    return np.asarray(own | (is_between & own[near]).any(axis=1))


def _select_company(chosen: Mask, feet: Floats, distances: Floats, radius: float) -> Mask:
    """Return those of the ``chosen`` (n,) far points that have others of them within the radius at
    about their ``distances`` (n,)."""
    selected = chosen.copy()
    _, alike = _find_alike(feet[chosen], distances[chosen], radius)
    selected[chosen] = np.sum(alike, axis=1) > LEAST_COMPANY
    return selected


def _find_alike(feet: Floats, distances: Floats, radius: float) -> tuple[np.ndarray, Mask]:
    """Return the nearest (n, k) of the feet (n, 3), with themselves, and which of them lie within
    the radius at about the same of the ``distances`` (n,)."""
    count = min(NEIGHBOURS, len(feet))
    if not count:
        return np.empty((0, 0), int), np.empty((0, 0), bool)
    gaps, near = cKDTree(feet).query(feet, k=[*range(1, count + 1)])
    off = np.abs(distances[near] - distances[:, None])
    return near, (gaps <= radius) & (off <= ALIKE * np.abs(distances[:, None]))


def _fill_area(feet: Floats, radius: float) -> Mask:
    """Which of the feet (n, 3) of far points fill an area with their neighbours; those of a surface
    that stands on the feature's edge form a line. (n,) bool."""
    count = 8
    if len(feet) < count:
        return np.zeros(len(feet), bool)
    _, near = cKDTree(feet).query(feet, k=count)
    patches = feet[near] - feet[near].mean(axis=1, keepdims=True)
    spread = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", patches, patches) / count)
    return np.asarray(np.sqrt(np.maximum(spread[:, 1], 0)) > 0.5 * radius * np.sqrt(np.pi / 16))


def percent_measured(
    feature: Feature, region: Region, points: Floats, views: list[Floats]
) -> float | None:
    """Percent of a feature's area in a region that was measured by ``points`` (n, 3) of it, of what
    ``views`` can see, each the places (k, 3) of its devices; of all without. None where hardly any
    is visible."""
    reach = float(np.linalg.norm(region.size if region.kind == "box" else region.size[[0, 0, 0]]))
    grid = (np.arange(AREA_SIDE) + 0.5) / AREA_SIDE * 2 - 1
    u, v = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2).T
    if feature.kind == "sphere":
        q = np.sqrt(1 - v * v)
        out = np.stack([q * np.cos(np.pi * u), q * np.sin(np.pi * u), v], 1)
        places = feature.place + (feature.radius or 0.0) * out
    else:
        first, second = perpendicular_axes(feature.unit_direction)
        along = ((region.centre - feature.place) @ feature.unit_direction) * feature.unit_direction
        if feature.kind == "plane":
            middle = region.centre - along
            places = middle + reach * (u[:, None] * first + v[:, None] * second)
        else:
            middle = feature.place + along
            around = np.cos(np.pi * u)[:, None] * first + np.sin(np.pi * u)[:, None] * second
            places = middle + (feature.radius or 0.0) * around
            places = places + reach * v[:, None] * feature.unit_direction
    places = places[region.within(places)]
    normals = feature.normals(places)
    feet = points - feature.distance(points)[:, None] * feature.normals(points)
    if views:
        inner = feature.normals(feet)
        side = np.sign(np.median(np.sum(inner * (views[0].mean(axis=0) - feet), axis=1)))
        cosines = [
            np.min(
                [np.sum(side * normals * unit_vectors(c - places), axis=1) for c in each], axis=0
            )
            for each in views
        ]
        places = places[np.max(cosines, axis=0) > MIN_SEEN_COSINE]
    if len(places) < 20 or len(feet) < 2:
        return None
    tree = cKDTree(feet)
    spacing = np.percentile(tree.query(feet[:: max(1, len(feet) // 2000)], k=2)[0][:, 1], 95)
    return 100 * float(np.mean(tree.query(places)[0] <= SPACINGS * spacing))
