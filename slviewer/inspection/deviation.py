"""Signed deviations of a scan from a nominal model after best-fit alignment: their statistics and
colours, and whether they stay within a tolerance, as far as their uncertainty lets one say."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    Uncertainty,
    move_points,
)
from slviewer.geometry.vectors import rms, subsample, unit_vectors
from slviewer.inspection.nominal_surface import REACH, NominalSurface, fit_pose, search_pose
from slviewer.inspection.uncertainty import scatter_covariance
from slviewer.records.acceptance import Decision, worst_decision
from slviewer.records.measurement import LEAST_AREA, ToleranceVerdict
from slviewer.registration.pairwise import Progress
from slviewer.surface.shapes import Mesh

NOISE_REACH = 10.0
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
    """Places (n, 3) mm evenly over the nominal's area, in its frame; which of them were
    ``measured``, and which the views can see, (n,) bool."""

    places: Floats
    measured: Mask
    is_visible: Mask

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
    farther than ``reach_mm``, or that face another way. ``T_nominal_scan`` (4, 4) is the best fit;
    ``normals`` (n, 3) the nominal's where each point's nearest place is, in the scan's frame, NaN
    likewise. ``area``: what of the nominal was measured. ``alignment_mm``: standard uncertainty
    that the best fit adds to a point, RMS over the points; ``alignment_spread`` its covariance, in
    the nominal's frame. ``surface``: the nominal, of whose triangles ``turned`` faced away from the
    scan.
    """

    signed: np.ndarray
    normals: np.ndarray
    T_nominal_scan: Floats
    reach_mm: float
    area: NominalArea
    alignment_mm: float
    alignment_spread: Uncertainty
    surface: NominalSurface
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

    ``normals`` (n, 3) of the scan, towards the camera, NaN where unknown: what faces another way
    than the nominal is excluded by them. ``sigma_mm``: the expected error of one point.
    ``reach_mm``: points farther off the nominal belong to something else; by default 2 % of its
    diagonal, never below ten times the noise. ``initial`` (4, 4) scan to nominal: replaces the
    search. ``views``: of each view the centres (k, 3) mm of its devices, in the scan's frame, which
    all have to see a place; all places are visible without, and None is for a scan that no camera
    at its origin saw. Raises SlviewerError where the two cannot be aligned with trust.
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
    T = initial
    if T is None:
        has_camera = views is not None
        T = search_pose(
            points, normals, surface, sigma_mm, lambda share: report(0.6 * share), has_camera
        )
    turned = np.zeros(len(nominal.faces), bool)
    if normals is not None:
        turned = surface.seen_from_behind(points, normals, T, reach_mm)
    if turned.any():
        faces = np.where(turned[:, None], nominal.faces[:, ::-1], nominal.faces)
        surface = NominalSurface(Mesh(nominal.vertices, faces))
    T, alignment, spread = _refine_best_fit(
        points, normals, surface, T, reach_mm, lambda share: report(0.6 + 0.2 * share)
    )
    report(0.8)
    signed, towards = surface.distances(points, normals, T, reach_mm)
    counted = np.isfinite(signed)
    if not counted.any():
        raise InputError(
            f"No point of the scan lies within {reach_mm:.3g} mm of the nominal model: does it show"
            " that part?"
        )
    report(0.95)
    feet = move_points(T, points[counted]) - signed[counted, None] * towards[counted]
    area = _measure_area(feet, surface, [move_points(T, centres) for centres in views or ()])
    report(1.0)
    return Deviation(
        signed.astype(np.float32),
        (towards @ T[:3, :3]).astype(np.float32),
        T,
        reach_mm,
        area,
        alignment,
        spread,
        surface,
        int(turned.sum()),
    )


def _refine_best_fit(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: np.ndarray,
    reach: float,
    report: Progress,
) -> tuple[np.ndarray, float, Uncertainty]:
    """The pose of least squared distances of the points that belong to the nominal, the standard
    uncertainty, mm, that its own gives the points, and its covariance."""
    points = subsample(points, MAX_ALIGNED_POINTS)
    normals = None if normals is None else subsample(normals, MAX_ALIGNED_POINTS)
    T, moved, J, away = fit_pose(points, normals, surface, T, reach, report=report)
    covariance = scatter_covariance(moved, J, away)
    return (
        T,
        float(np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J).mean())),
        Uncertainty(covariance, moved.mean(axis=0)),
    )


def _measure_area(feet: Floats, surface: NominalSurface, views: Sequence[Floats]) -> NominalArea:
    """What of the nominal was measured. ``feet`` (n, 3): where on it the scan's points were
    measured; ``views`` as in `deviation`, in its frame."""
    places, facing = surface.sample(COVERAGE_SAMPLES, seed=1)
    thin = subsample(feet, MAX_FEET)
    tree = cKDTree(thin)
    spacing, _ = tree.query(subsample(thin, 2000), k=2)
    away, _ = tree.query(places, workers=-1)
    measured = away <= SPACINGS * float(np.percentile(spacing[:, 1], 95))
    is_visible = np.full(len(places), not views)
    for centres in views:
        is_visible |= np.all(
            [
                surface.seen_from(places, facing, unit_vectors(centre - places), MIN_SEEN_COSINE)
                for centre in centres
            ],
            axis=0,
        )
    return NominalArea(places, measured, is_visible)


def judge_deviation(
    deviation: Deviation, sigma_mm: Floats, tolerance_mm: float, least_area: float = LEAST_AREA
) -> ToleranceVerdict:
    """The verdict on a deviation; ``sigma_mm`` (n,): standard uncertainty of its points along the
    surface's normal; ``least_area``: percent of the visible area that it needs."""
    if not tolerance_mm > 0:
        raise InputError(f"A tolerance of {tolerance_mm:g} mm was given: give a positive one.")
    counted = deviation.counted
    signed = deviation.signed[counted].astype(np.float64)
    U = 2 * np.hypot(np.nan_to_num(sigma_mm[counted].astype(np.float64)), deviation.alignment_mm)
    typical = float(np.median(U))
    off = np.abs(signed)
    inside, outside = off + U <= tolerance_mm, off - U > tolerance_mm
    numbers = deviation.statistics()
    low, high = (
        (end, judge_limits(end, typical, -tolerance_mm, tolerance_mm))
        for end in (numbers["p_low"], numbers["p_high"])
    )
    area = deviation.area.percent_measured() or 0.0
    return ToleranceVerdict(
        tolerance_mm,
        typical,
        low,
        high,
        "undecided" if area < least_area else worst_decision({low[1], high[1]}),
        100 * float(np.mean(off <= tolerance_mm)),
        100 * float(inside.mean()),
        100 * float(outside.mean()),
        100 * float(np.mean(~inside & ~outside)),
        area,
        least_area,
    )


def judge_limits(value: float, U: float, lower: float | None, upper: float | None) -> Decision:
    """Decide by guard bands whether a value of expanded uncertainty U (k = 2) lies between limits,
    of which one may be absent: "pass" inside both by U, "fail" beyond one by more than U, else
    "undecided"."""
    low, high = (-np.inf if lower is None else lower), (np.inf if upper is None else upper)
    if not (np.isfinite(value) and np.isfinite(U)):
        return "undecided"
    if low + U <= value <= high - U:
        return "pass"
    return "fail" if value < low - U or value > high + U else "undecided"


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
