"""Signed deviations of a scan from a nominal model after best-fit alignment, their statistics and
colours; and what of the nominal was measured, and what of it is missing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    Uncertainty,
    move_points,
)
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import lengths, rms, subsample, unit_vectors
from slviewer.inspection.exclusion import (
    NOISE,
    ClassifiedPoints,
    LocatedPoints,
    classify_points,
    find_tables,
)
from slviewer.inspection.nominal_pose import (
    GOOD_ERROR,
    REACH,
    fit_pose,
    improve_pose,
    search_pose,
)
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.uncertainty import scatter_covariance
from slviewer.inspection.wrong_part import explain_misfit
from slviewer.records.measurement import ExcludedPoints
from slviewer.registration.pairwise import Progress
from slviewer.registration.refusal import Refused, WrongPart
from slviewer.surface.shapes import Mesh

NOISE_REACH = 10.0
ROBUST_SIGMAS, ROBUST_STEP, ROBUST_ROUNDS = 4.685, 0.8, 4
"""Of the deviations' robust standard deviation: points beyond do not count in the best fit, so that
the error of one feature does not spread over the part. The fit is repeated where that brings the
limit down to this share of the last."""
MIN_GAP_COSINE = 0.3
"""Between a normal and the way from a place on the nominal to where the part is instead."""
RAY_NEIGHBOURS, LEAST_ON_RAY, RAY_SPACINGS = 24, 6, 1.5
"""Points about a ray, of which at least six must be there, and all lie behind a place that is
missing; and their distance from it over that which most neighbours keep threefold."""
MIN_FOREIGN, MAX_FOREIGN = 0.01, 0.5
"""Share of a scan that is not the part, between which the pose is searched again without it."""
COVERAGE_SAMPLES = 20_000
MIN_SEEN_COSINE = 0.45
"""Of a place on the nominal that a view can measure: at more oblique ones points are few."""
MIN_PLACES = 20
MAX_ALIGNED_POINTS = 60_000
MAX_FEET = 400_000
SPACINGS = 3.0
"""A place on the nominal was measured if a scan point's foot is no farther than so many of their
spacings."""


@dataclass(frozen=True, eq=False)
class NominalArea:
    """Places (n, 3) mm evenly over the nominal's area, in its frame.

    ``gap_mm`` (n,): from each to where the scan was measured on the nominal; ``spacing_mm``: nearer
    ones were ``measured``, (n,) bool, and so were those that deviate; ``deviation`` (n,) mm: how
    far the part is from these, NaN for others, and ``counterpart`` (n, 3) where it is instead, as
    far as it was measured there. ``is_visible`` (n,) bool: to the views.
    """

    places: Floats
    measured: Mask
    is_visible: Mask
    gap_mm: Floats
    deviation: Floats
    counterpart: Floats
    spacing_mm: float

    @property
    def largest_gap(self) -> tuple[float, Floats]:
        """Diameter in mm of the largest visible spot that was not measured, and its middle (3,); 0
        where there is none."""
        gaps = np.where(self.is_visible & ~self.measured, self.gap_mm, 0.0)
        worst = int(np.argmax(gaps))
        return 2 * float(gaps[worst]), self.places[worst]

    def percent_measured(self, within: Mask | None = None) -> float | None:
        """Percent of the visible area, of the places ``within`` (n,) bool alone, that was measured;
        None where hardly any is visible."""
        chosen = self.is_visible if within is None else self.is_visible & within
        if np.count_nonzero(chosen) < MIN_PLACES:
            return None
        return 100 * float(self.measured[chosen].mean())


@dataclass(frozen=True, eq=False)
class Deviation:
    """A scan's points against a nominal model.

    ``signed`` (n,) float32 mm: of each scan point, positive outside the nominal; NaN for points
    that are ``excluded`` because they cannot be the part; ``is_unmatched`` (n,) bool: farther than
    ``reach_mm``, or facing another way, and deviations all the same. ``T_nominal_scan`` (4, 4) is
    the best fit; ``normals`` (n, 3) the nominal's where each point's nearest place is, in the
    scan's frame, NaN likewise. ``area``: what of the nominal was measured. ``alignment_mm``:
    standard uncertainty that the best fit adds to a point, RMS over the points;
    ``alignment_spread`` its covariance, in the nominal's frame. ``noise_mm``: standard deviation of
    a point; ``located`` and ``facing`` (n, 3): the points and their normals in the nominal's frame.
    ``surface``: the nominal, of whose triangles ``turned`` faced away from the scan.
    """

    signed: np.ndarray
    normals: np.ndarray
    T_nominal_scan: Floats
    reach_mm: float
    area: NominalArea
    alignment_mm: float
    alignment_spread: Uncertainty
    surface: NominalSurface
    is_unmatched: Mask
    excluded: tuple[ExcludedPoints, ...]
    noise_mm: float
    located: Floats
    facing: Floats | None
    turned: int = 0

    @property
    def coverage(self) -> float:
        """Share of the nominal's area that was measured."""
        return float(self.area.measured.mean())

    @property
    def uncovered(self) -> Floats:
        """(k, 3) float32 mm: places on the nominal that were not measured, in the scan's frame."""
        back = np.asarray(np.linalg.inv(self.T_nominal_scan), np.float64)
        return move_points(back, self.area.places[~self.area.measured]).astype(np.float32)

    @property
    def counted(self) -> Mask:
        """(n,) bool: the points that belong to the nominal."""
        return np.isfinite(self.signed)

    def statistics(self) -> dict[str, float]:
        """Of the points that belong to the nominal, mm: ``mean``, ``rms``, ``sigma`` about the
        mean, ``within_95`` (95 % are off by less), ``lowest`` and ``highest``, and ``p_low``,
        ``p_high``, between which 99.7 % lie; and the numbers of ``points`` used and
        ``left_out``."""
        values = self.signed[self.counted].astype(np.float64)
        low, high = np.percentile(values, [0.15, 99.85])
        return {
            "mean": float(values.mean()),
            "rms": rms(values),
            "sigma": float(values.std()),
            "within_95": float(np.percentile(np.abs(values), 95)),
            "lowest": float(values.min()),
            "highest": float(values.max()),
            "p_low": float(low),
            "p_high": float(high),
            "points": int(values.size),
            "left_out": int(self.signed.size - values.size),
        }

    def histogram(self, bins: int = 81) -> tuple[Floats, Floats]:
        """Edges (bins + 1,) mm, symmetric about 0, and counts (bins,); values beyond 99.8 % are
        excluded."""
        values = self.signed[self.counted]
        limit = max(float(np.percentile(np.abs(values), 99.8)), 1e-6)
        edges = np.linspace(-limit, limit, bins + 1)
        return edges, np.histogram(values, edges)[0]


def deviation(
    points: np.ndarray,
    nominal: Mesh,
    *,
    normals: Floats | None = None,
    sigma_mm: float | None = None,
    reach_mm: float | None = None,
    initial: Floats | None = None,
    views: Sequence[Floats] | None = (),
    progress: Progress | None = None,
) -> Deviation:
    """Align scan points (n, 3) mm with a nominal model, and return the signed distance of each.

    ``normals`` (n, 3) of the scan, towards the camera, NaN where unknown: by them the sides of a
    wall are told apart. ``sigma_mm``: the expected error of one point. ``reach_mm``: points farther
    off the nominal do not count in the best fit, and are deviations unless they stand beside the
    part; by default 2 % of its diagonal, never below ten times the noise. ``initial`` (4, 4) scan
    to nominal: replaces the search. ``views``: of each view the centres (k, 3) mm of its devices,
    in the scan's frame, which all have to see a place; all places are visible without, and None is
    for a scan that no camera at its origin saw. Raises SlviewerError where the two cannot be
    aligned with trust.
    """
    report = progress or (lambda share: None)
    points = np.asarray(points, np.float64)
    if not len(points) or not np.isfinite(points).all():
        raise InputError(
            "The scan has no points, or some that are not finite: give its measured points alone."
        )
    surface = NominalSurface(nominal)
    if reach_mm is None:
        reach_mm = max(REACH * surface.diagonal, NOISE_REACH * (sigma_mm or 0.0))
    if not reach_mm > 0:
        raise InputError(f"A reach of {reach_mm:g} mm was given: give a positive one.")
    report(0.0)
    given, T = _Scan(points, normals, sigma_mm, views), initial
    if T is None:
        part = given.take(~find_tables(points, surface, sigma_mm or 0.0))
        T = _search_pose(part, surface, lambda share: report(0.6 * share))
    surface, turned = _turn_faces(points, normals, surface, T, reach_mm)
    placed = _Placement.fit(given, given, surface, T, reach_mm)
    if initial is None:
        placed = placed.without_foreign(given, surface, reach_mm)
    report(0.9)
    T, scan, found = placed.T, placed.scan, placed.found
    alignment, spread = placed.alignment_mm, placed.spread
    counted = np.isfinite(found.signed)
    if not (counted & ~found.is_unmatched).any():
        raise InputError(
            f"No point of the scan lies within {reach_mm:.3g} mm of the nominal model: does it show"
            " that part?"
        )
    report(0.95)
    area = _measure_area(scan, found, surface, given.place_views(T))
    report(1.0)
    towards = np.where(counted[:, None], scan.towards, np.nan)
    return Deviation(
        found.signed.astype(np.float32),
        (towards @ T[:3, :3]).astype(np.float32),
        T,
        reach_mm,
        area,
        alignment,
        spread,
        surface,
        found.is_unmatched,
        found.excluded,
        scan.noise_mm,
        scan.points,
        scan.normals,
        turned,
    )


@dataclass(frozen=True, eq=False)
class _Scan:
    """A scan, as the arguments of `deviation`."""

    points: Floats
    normals: Floats | None
    sigma_mm: float | None
    views: Sequence[Floats] | None

    def take(self, chosen: Mask) -> "_Scan":
        """Return some of the points (n,) bool."""
        normals = None if self.normals is None else self.normals[chosen]
        return replace(self, points=self.points[chosen], normals=normals)

    def place_views(self, T: Floats) -> list[Floats]:
        """Return the views in the nominal's frame."""
        return [move_points(T, centres) for centres in self.views or ()]


@dataclass(frozen=True, eq=False)
class _Placement:
    """A scan at its best fit ``T`` (4, 4): its points there, what each is, and the uncertainty."""

    T: Floats
    scan: LocatedPoints
    found: ClassifiedPoints
    alignment_mm: float
    spread: Uncertainty

    @classmethod
    def fit(
        cls, scan: _Scan, own: _Scan, surface: NominalSurface, T: Floats, reach: float
    ) -> "_Placement":
        """Fit a scan from ``T`` (4, 4), by its ``own`` points alone, and classify all."""
        T, alignment, spread = _refine_best_fit(own.points, own.normals, surface, T, reach)
        located = _locate(scan.points, scan.normals, surface, T, reach, scan.sigma_mm or 0.0)
        found = classify_points(located, surface, reach, scan.place_views(T))
        return cls(T, located, found, alignment, spread)

    def without_foreign(self, scan: _Scan, surface: NominalSurface, reach: float) -> "_Placement":
        """Fit again without what is not the part, as a clamp, which draws the pose to itself."""
        counted = np.isfinite(self.found.signed)
        if not MIN_FOREIGN < np.mean(~counted) < MAX_FOREIGN:
            return self
        own = scan.take(counted)
        try:
            T = improve_pose(own.points, own.normals, surface, own.sigma_mm, self.T)
            return self.fit(scan, own, surface, T, reach)
        except InputError:  # too few points are left
            return self


def _turn_faces(
    points: Floats, normals: Floats | None, surface: NominalSurface, T: Floats, reach: float
) -> tuple[NominalSurface, int]:
    """The nominal with the triangles turned that the scan shows from behind, and their number."""
    if normals is None:
        return surface, 0
    turned, mesh = surface.seen_from_behind(points, normals, T, reach), surface.mesh
    if not turned.any():
        return surface, 0
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return NominalSurface(Mesh(mesh.vertices, faces)), int(turned.sum())


def _search_pose(scan: _Scan, surface: NominalSurface, report: Progress) -> Floats:
    """The pose (4, 4) of a scan on the nominal. Raises ``WrongPart`` where there is none, and the
    scan fits another model, else ``Refused``."""
    points, normals, has_camera = scan.points, scan.normals, scan.views is not None
    try:
        return search_pose(points, normals, surface, scan.sigma_mm, report, has_camera)
    except Refused as refusal:
        near = max(GOOD_ERROR * surface.diagonal, NOISE * (scan.sigma_mm or 0.0))
        other = explain_misfit(points, normals, surface.mesh, None, near, has_camera)
        if other:
            raise WrongPart(f"The scan does not show the nominal model: {other}.") from refusal
        raise


def _locate(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: Floats,
    reach: float,
    noise: float,
) -> LocatedPoints:
    """Return the scan's points at its pose ``T`` (4, 4), with their places on the nominal."""
    moved = move_points(T, points)
    away, towards = surface.signed(moved)
    some = subsample(moved, MAX_FEET)
    tree = cKDTree(some, balanced_tree=False, compact_nodes=False)
    stride = max(1, len(some) // 2000)
    gaps, pairs = tree.query(some[::stride], k=2)
    spacing = SPACINGS * float(np.percentile(gaps[:, 1], 95))
    # form hardly differs between neighbours
    ends = subsample(away, MAX_FEET)[pairs]
    steps = np.diff(ends[(np.abs(ends) <= reach).all(axis=1)], axis=1)
    noise = max(noise, robust_sigma(steps, about=0.0) / np.sqrt(2)) if len(steps) else noise
    turned = None if normals is None else normals @ T[:3, :3].T
    return LocatedPoints(moved, turned, away, towards, spacing, noise)


def _refine_best_fit(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, float, Uncertainty]:
    """The pose of least squared distances of the points that belong to the nominal, the standard
    uncertainty, mm, that its own gives the points, and its covariance."""
    points = subsample(points, MAX_ALIGNED_POINTS)
    normals = None if normals is None else subsample(normals, MAX_ALIGNED_POINTS)
    T, moved, J, away = fit_pose(points, normals, surface, T, reach)
    for _ in range(ROBUST_ROUNDS):
        gate = ROBUST_SIGMAS * robust_sigma(away, about=0.0)
        if not 0 < gate < ROBUST_STEP * reach:
            break
        reach = gate
        T, moved, J, away = fit_pose(points, normals, surface, T, reach)
    covariance = scatter_covariance(moved, J, away)
    return (
        T,
        float(np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J).mean())),
        Uncertainty(covariance, moved.mean(axis=0)),
    )


def _measure_area(
    scan: LocatedPoints, found: ClassifiedPoints, surface: NominalSurface, views: Sequence[Floats]
) -> NominalArea:
    """What of the nominal was measured, and how far the part is from places that deviate; ``views``
    as in `deviation`, in its frame."""
    places, facing = surface.sample(COVERAGE_SAMPLES, seed=1)
    matched = np.isfinite(found.signed) & ~found.is_unmatched
    some = subsample(np.flatnonzero(matched), MAX_FEET)
    feet = scan.points[some] - found.signed[some, None] * scan.towards[some]
    gap, _ = cKDTree(feet).query(places, workers=-1)
    is_visible = np.full(len(places), not views)
    for centres in views:
        is_visible |= np.all(
            [
                surface.seen_from(places, facing, unit_vectors(centre - places), MIN_SEEN_COSINE)
                for centre in centres
            ],
            axis=0,
        )
    measured = gap <= scan.spacing_mm
    deviation, counterpart = np.full(len(places), np.nan), places.copy()
    open_places = np.flatnonzero(~measured)
    far = np.flatnonzero(found.is_unmatched)
    if len(far) and len(open_places):
        near, which = cKDTree(scan.points[far]).query(places[open_places], workers=-1)
        part = cKDTree(scan.points[some])
        deviates = near <= part.query(places[open_places], workers=-1)[0]
        chosen, which = open_places[deviates], far[which[deviates]]
        value = _across_gap(scan, which, places[chosen], facing[chosen], surface)
        deviation[chosen], counterpart[chosen] = value, scan.points[which]
    if len(views) == 1 and len(open_places):
        passed = open_places[is_visible[open_places] & np.isnan(deviation[open_places])]
        passed = passed[_lie_before(scan, places[passed], views[0][0])]
        deviation[passed] = -cKDTree(scan.points).query(places[passed], workers=-1)[0]
    return NominalArea(
        places,
        measured | np.isfinite(deviation),
        is_visible,
        gap,
        deviation,
        counterpart,
        scan.spacing_mm,
    )


def _across_gap(
    scan: LocatedPoints, which: np.ndarray, places: Floats, facing: Floats, surface: NominalSurface
) -> Floats:
    """Return how far (n,) mm the part is from places (n, 3) on the nominal, facing (n, 3), that the
    scan shows at its points ``which`` (n,) instead: positive where these lie outside; NaN where
    they do not, as behind a wall."""
    offsets = scan.points[which] - places
    distance = lengths(offsets)
    height = np.einsum("ij,ij->i", offsets, facing)
    is_opposite = np.abs(height) > MIN_GAP_COSINE * distance
    if scan.normals is not None:
        own = np.einsum("ij,ij->i", offsets, scan.normals[which])
        # outside the nominal there is material below the point, inside it air above
        is_opposite &= ~(np.sign(height) * own < MIN_GAP_COSINE * distance)
    is_opposite &= ~surface.is_between(places, scan.points[which])
    # beside a short distance, the points' spacing counts
    value = np.sign(height) * np.where(distance > 2 * scan.spacing_mm, distance, np.abs(height))
    return np.where(is_opposite, value, np.nan)


def _lie_before(scan: LocatedPoints, places: Floats, camera: Floats) -> Mask:
    """Return which places (n, 3) the rays of a ``camera`` (3,) pass through, as the scan's points
    about them show: some are near the ray, and all of these lie behind the place."""
    rays = scan.points - camera
    if scan.normals is not None:  # what faces away was seen from elsewhere
        rays = rays[~(np.einsum("ij,ij->i", rays, scan.normals) > 0)]
    depth, distance = lengths(rays), lengths(places - camera)
    tree = cKDTree(rays / depth[:, None], balanced_tree=False, compact_nodes=False)
    _, near = tree.query(
        (places - camera) / distance[:, None],
        k=RAY_NEIGHBOURS,
        distance_upper_bound=RAY_SPACINGS * scan.spacing_mm / float(np.median(depth)),
        workers=-1,
    )
    is_behind = np.append(depth, np.inf)[near] > distance[:, None] + scan.spacing_mm
    return np.asarray(is_behind.all(axis=1) & (near[:, LEAST_ON_RAY - 1] < len(depth)))


EXCLUDED_COLOUR = (150, 154, 160)
_AT = np.array([-1.0, -0.6, -0.25, 0.0, 0.25, 0.6, 1.0])
_RGB = np.array(
    [
        (26, 54, 140),
        (48, 126, 208),
        (150, 205, 232),
        (236, 238, 226),
        (250, 205, 120),
        (232, 112, 52),
        (150, 18, 38),
    ],
    np.float64,
)
"""From too little (blue) through none (near white) to too much (red): distinguishable with any
colour vision."""


def deviation_colours(signed: np.ndarray, limit: float) -> np.ndarray:
    """(n, 3) uint8 RGB of deviations (n,) mm from -limit to limit and beyond; grey for NaN."""
    if not limit > 0:
        raise InputError(f"A range of {limit:g} mm was given for the colours: give a positive one.")
    share = np.clip(np.nan_to_num(np.asarray(signed, np.float64) / limit), -1, 1)
    colours = np.stack([np.interp(share, _AT, _RGB[:, k]) for k in range(3)], axis=-1)
    colours[~np.isfinite(signed)] = EXCLUDED_COLOUR
    return np.asarray(np.round(colours), np.uint8)


def colour_limit(signed: np.ndarray, tolerance_mm: float | None = None) -> float:
    """Return half the range of the colour scale, mm: the tolerance, or the value that contains 99.5
    % of the points."""
    if tolerance_mm is not None:
        return tolerance_mm
    known = np.abs(signed[np.isfinite(signed)])
    return max(float(np.percentile(known, 99.5)), 1e-6) if known.size else 1.0
