"""Signed deviations of a scan from a nominal model after best-fit alignment: their statistics and
colours, and whether they stay within a tolerance, as far as their uncertainty lets one say."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    Uncertainty,
    distance_jacobian,
    move_points,
    turn_about,
)
from slviewer.geometry.vectors import rms, subsample
from slviewer.inspection.nominal_surface import NominalSurface, search_start
from slviewer.inspection.uncertainty import scatter_covariance
from slviewer.records.acceptance import Decision, worst_decision
from slviewer.records.measurement import ToleranceVerdict
from slviewer.registration.pairwise import Progress, Registration
from slviewer.surface.shapes import Mesh

REACH = 0.02
"""Of the nominal's diagonal: scan points farther from it belong to something else, a table or a
clamp."""
NOISE_REACH = 10.0
COVERAGE_SAMPLES = 20_000
MAX_ALIGNED_POINTS = 60_000
MAX_FEET = 400_000
SPACINGS = 3.0
"""A place on the nominal was measured if a scan point's foot is no farther than so many of their
spacings."""
MAX_ITERATIONS = 40
MIN_NORMAL_COSINE = 0.5
"""Cosine: a scan point whose normal is turned away further from the nominal's lies on something
else there."""


@dataclass(frozen=True, eq=False)
class Deviation:
    """A scan's points against a nominal model.

    ``signed`` (n,) float32 mm: of each scan point, positive outside the nominal; NaN for points
    farther than ``reach_mm``, or that face another way. ``T_nominal_scan`` (4, 4) is the best fit;
    ``normals`` (n, 3) the nominal's where each point's nearest place is, in the scan's frame, NaN
    likewise. ``coverage``: share of the nominal's area that was measured; ``uncovered`` (k, 3) mm:
    places of the rest, in the scan's frame. ``alignment_mm``: standard uncertainty that the best
    fit adds to a point, RMS over the points; ``alignment_spread`` its covariance, in the nominal's
    frame.
    """

    signed: np.ndarray
    normals: np.ndarray
    T_nominal_scan: Floats
    reach_mm: float
    coverage: float
    uncovered: Floats
    alignment_mm: float
    start: Registration | None = None
    alignment_spread: Uncertainty | None = None

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
    progress: Progress | None = None,
    has_camera: bool = True,
) -> Deviation:
    """Align scan points (n, 3) mm with a nominal model, and return the signed distance of each.

    ``normals`` (n, 3) of the scan, towards the camera, NaN where unknown: what faces another way
    than the nominal is excluded by them. ``sigma_mm``: the expected error of one point.
    ``reach_mm``: points farther off the nominal belong to something else; by default 2 % of its
    diagonal, never below ten times the noise. ``initial`` (4, 4) scan to nominal: replaces the
    search. ``has_camera``: whether the scan was seen from its origin. Raises SlviewerError where
    the two cannot be aligned with trust.
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
    start = None
    if initial is None:
        start = search_start(
            points, normals, surface, sigma_mm, lambda share: report(0.6 * share), has_camera
        )
        initial = start.T_reference_scan
    T, alignment, spread = _refine_best_fit(
        points, normals, surface, initial, reach_mm, lambda share: report(0.6 + 0.2 * share)
    )
    report(0.8)
    signed, towards = _signed_distances(points, normals, surface, T, reach_mm)
    counted = np.isfinite(signed)
    if not counted.any():
        raise InputError(
            f"No point of the scan lies within {reach_mm:.3g} mm of the nominal model: does it show"
            " that part?"
        )
    report(0.95)
    feet = move_points(T, points[counted]) - signed[counted, None] * towards[counted]
    measured, uncovered = _measure_coverage(feet, surface)
    back = np.linalg.inv(T)
    report(1.0)
    return Deviation(
        signed.astype(np.float32),
        (towards @ T[:3, :3]).astype(np.float32),
        T,
        reach_mm,
        measured,
        move_points(back, uncovered).astype(np.float32),
        alignment,
        start,
        spread,
    )


def _signed_distances(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: Floats,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) and the nominal's normals (n, 3), NaN where a point does not belong to
    it."""
    away, towards = surface.signed(move_points(T, points))
    belongs = np.abs(away) <= reach
    if normals is not None:
        cosine = np.sum((normals @ T[:3, :3].T) * towards, axis=1)
        belongs &= ~(cosine < MIN_NORMAL_COSINE)  # an unknown normal excludes nothing
    away[~belongs] = np.nan
    towards[~belongs] = np.nan
    return away, towards


def _refine_best_fit(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: np.ndarray,
    reach: float,
    report: Progress,
) -> tuple[np.ndarray, float, Uncertainty]:
    """The pose of least squared distances of the points that belong to the nominal, by
    Gauss-Newton, the standard uncertainty, mm, that its own gives the points, and its
    covariance."""
    points = subsample(points, MAX_ALIGNED_POINTS)
    normals = None if normals is None else subsample(normals, MAX_ALIGNED_POINTS)
    T = np.array(T, np.float64)
    for turn in range(MAX_ITERATIONS):
        report(turn / MAX_ITERATIONS)
        away, towards = _signed_distances(points, normals, surface, T, reach)
        counted = np.isfinite(away)
        if np.count_nonzero(counted) < 100:
            raise InputError(
                f"Only {np.count_nonzero(counted)} points of the scan lie within {reach:.3g} mm of"
                " the nominal model: does it show that part?"
            )
        moved = move_points(T, points[counted])
        middle = moved.mean(axis=0)
        J = distance_jacobian(moved - middle, towards[counted])
        information = J.T @ J
        change = -np.linalg.lstsq(information, J.T @ away[counted], rcond=1e-10)[0]
        T = turn_about(change[:3], middle, change[3:]) @ T
        if np.abs(J @ change).max() < 1e-5:
            break
    covariance = scatter_covariance(moved, J, away[counted])
    return (
        T,
        float(np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J).mean())),
        Uncertainty(covariance, middle),
    )


def _measure_coverage(feet: Floats, surface: NominalSurface) -> tuple[float, Floats]:
    """Share of the nominal's area that was measured, and places (k, 3) in its frame of the rest.
    ``feet`` (n, 3): where on the nominal the scan's points were measured."""
    places, _ = surface.sample(COVERAGE_SAMPLES, seed=1)
    thin = subsample(feet, MAX_FEET)
    tree = cKDTree(thin)
    spacing, _ = tree.query(subsample(thin, 2000), k=2)
    away, _ = tree.query(places, workers=-1)
    measured = away <= SPACINGS * float(np.percentile(spacing[:, 1], 95))
    return float(measured.mean()), places[~measured]


def judge_deviation(
    deviation: Deviation, sigma_mm: Floats, tolerance_mm: float
) -> ToleranceVerdict:
    """The verdict on a deviation; ``sigma_mm`` (n,): standard uncertainty of its points along the
    surface's normal."""
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
    return ToleranceVerdict(
        tolerance_mm,
        typical,
        low,
        high,
        worst_decision({low[1], high[1]}),
        100 * float(np.mean(off <= tolerance_mm)),
        100 * float(inside.mean()),
        100 * float(outside.mean()),
        100 * float(np.mean(~inside & ~outside)),
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
