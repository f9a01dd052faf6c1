"""Whether a part stays within a tolerance of its nominal model, as far as the uncertainty of its
deviations lets one say.

A tolerance holds for the surface, not for the noise of single points. The deviations are therefore
averaged over as many neighbours as bring the mean's uncertainty well below the tolerance, and every
such local mean is judged; a few points in one place weigh as much as a whole side.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erfcx

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, distance_jacobian
from slviewer.geometry.vectors import median_spacing, occupied_cubes, rms
from slviewer.inspection.deviation import Deviation
from slviewer.inspection.exclusion import label_clusters
from slviewer.records.acceptance import COVERAGE, Decision, worst_decision
from slviewer.records.measurement import LEAST_AREA, DeviatingPlace, PlaceKind, ToleranceVerdict
from slviewer.records.record import to_vector
from slviewer.surface.shapes import extent_across

MEAN_SHARE = 0.19
"""Of the tolerance: so many points are averaged that the expanded uncertainty of their mean is no
larger. Larger means hide small errors, smaller ones exceed the tolerance by noise."""
LEAST_POINTS, MOST_POINTS = 6, 64
"""Averaged in a local mean."""
FAIL_SIGMAS = {1: 3.0, 2: 2.5, 4: 2.0, 8: 2.0}
"""Standard deviations by which a mean fails, by how many times as many points it averages: there
are hundreds of the smallest."""
DOUBT_SIGMAS = 1.5
"""Standard deviations by which few points beside each other keep a part from passing."""
SINGLE_SIGMAS = 4.0
"""Standard deviations by which single points fail, `MIN_PLACE` or more of `BESIDE` neighbours."""
BESIDE = 8
EXTREMES, EXTREME_SHARE = 3, 2e-4
"""Means at either end that do not keep a part from passing, as few pixels on an edge do; and their
share of large scans. More of them beside each other are a place."""
WIDER, CHANCE_SIGMAS = 4, 3.5
"""Times the points of a mean that the wider one about it averages; and standard deviations by which
noise alone may carry the largest of hundreds away from that."""
RIVAL_SIGMAS = 3.0
"""Standard deviations by which a mean may be smaller than the largest, and have been it but for
noise."""
MOST_NOISE = 3.0
"""Of the median: points whose noise is larger are not counted on."""
SUSPECT = 0.8
"""Of the tolerance: of means beyond it wider ones are made."""
JOINED = 3.0
"""Spacings between points that lie beside each other."""
MOST_MEANS = 60_000
"""Points of larger scans are combined first."""
FACE = 3.0
"""Ratio of the distance that two sides of a thin wall are apart in a search for neighbours, to the
radius of a mean."""
MIN_PLACE = 3
MOST_PLACES = 20
MOST_ALONE = 0.02
"""Share of isolated points, above which the scan is too bad to pass."""
LARGEST_GAP = 0.05
"""Diameter of the largest spot without points that may pass, of the nominal's diagonal; not where
the operator wants a verdict on a smaller area."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Deviations ``value`` (n,) mm of points, or of several combined (``count``), where they lie,
    in the nominal's frame, how they face and how the nominal does there, and their standard
    deviations of noise and, common to neighbours, of calibration and alignment."""

    place: Floats
    facing: Floats
    towards: Floats
    value: Floats
    noise: Floats
    common: Floats
    is_unmatched: np.ndarray

    def __len__(self) -> int:
        return len(self.value)


@dataclass(frozen=True, eq=False)
class _Means:
    """Local means (n,) mm of deviations, their standard deviations, the radius (n,) mm, and the
    standard deviation (n,) mm of the deviations in it beyond noise."""

    value: Floats
    sigma: Floats
    radius: Floats
    variation: Floats

    def take(self, chosen: np.ndarray) -> "_Means":
        """Return some of the means."""
        return _Means(**{name: values[chosen] for name, values in vars(self).items()})

    def bound(self, times: int = 1) -> Floats:
        """Return what a mean of so many ``times`` the least number of points exceeds in spite of
        its uncertainty, (n,) mm."""
        return np.abs(self.value) - FAIL_SIGMAS[times] * self.sigma

    def noise(self, count: int) -> Floats:
        """The standard uncertainty (n,) mm of means of ``count`` points, but for how the form
        varies within."""
        return np.sqrt(np.maximum(self.sigma**2 - self.variation**2 / count, 0.0))


def judge_deviation(
    deviation: Deviation,
    sigma_mm: Floats,
    tolerance_mm: float,
    least_area: float = LEAST_AREA,
    common_mm: Floats | None = None,
) -> ToleranceVerdict:
    """Decide whether a part stays within plus and minus a tolerance.

    ``sigma_mm`` (n,): noise of the points along the surface's normal, and ``common_mm`` (n,) what
    neighbours share, from the calibration. ``least_area``: percent of the visible area that a pass
    needs.
    """
    if not tolerance_mm > 0:
        raise InputError(f"A tolerance of {tolerance_mm:g} mm was given: give a positive one.")
    points = _list_points(deviation, sigma_mm, common_mm)
    count = float(np.median(points.noise) / tolerance_mm)
    needed = int(np.clip((COVERAGE * count / MEAN_SHARE) ** 2, LEAST_POINTS, MOST_POINTS))
    means = _average(points, needed)
    places, doubts = _list_places(deviation, points, means, needed, tolerance_mm)
    U = COVERAGE * means.sigma
    off = np.abs(means.value)
    inside, outside = off + U <= tolerance_mm, off - U > tolerance_mm
    lowest, highest = (_judge_end(points, means, sign, needed, tolerance_mm) for sign in (-1, 1))
    area = deviation.area.percent_measured() or 0.0
    spot = 2 * float(np.percentile(means.radius, 95))
    gap, gap_place = deviation.area.largest_gap
    doubts += _list_doubts(deviation, area, least_area, gap)
    if not (places or doubts):
        doubts += _doubt_small(points, tolerance_mm)
    doubtful: set[Decision] = {"undecided"} if doubts else set()
    decision = "fail" if places else worst_decision({lowest[1], highest[1]} | doubtful)
    signed = deviation.signed[deviation.counted]
    return ToleranceVerdict(
        tolerance_mm,
        float(np.median(U)),
        lowest,
        highest,
        decision,
        100 * float(np.mean(np.abs(signed) <= tolerance_mm)),
        100 * float(inside.mean()),
        100 * float(outside.mean()),
        100 * float(np.mean(~inside & ~outside)),
        area,
        least_area,
        places,
        spot,
        gap,
        to_vector(gap_place) if gap else None,
        doubts=tuple(doubts),
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


def _judge_end(
    points: _Points, means: _Means, sign: int, count: int, tolerance: float
) -> tuple[float, Decision]:
    """Return the least or the largest local mean of ``count`` points, but for a few, and its
    decision; how the form varies within one, as across an edge, keeps it from failing, not from
    passing. A mean that noise may have carried towards the tolerance, the largest of many, does not
    keep the part from passing where the wider one about it agrees with it and lies inside."""
    rank = min(EXTREMES + int(EXTREME_SHARE * len(means.value)), len(means.value) // 10)
    end = int(np.argsort(sign * means.value)[-1 - rank])
    value, sigma = float(means.value[end]), float(means.sigma[end])
    if sign * value - FAIL_SIGMAS[1] * sigma > tolerance:
        return value, "fail"
    noise = means.noise(count)
    noise = np.minimum(noise, MOST_NOISE * np.median(noise))  # of few points on an edge
    off = sign * means.value
    reached = off + COVERAGE * noise
    doubtful = np.flatnonzero((reached > tolerance) & (off + noise <= tolerance))
    if len(doubtful):
        wider = _average(points, WIDER * count, doubtful)
        agrees = np.abs(off[doubtful] - sign * wider.value) <= CHANCE_SIGMAS * noise[doubtful]
        limit = sign * wider.value + COVERAGE * wider.noise(WIDER * count)
        reached[doubtful[agrees]] = limit[agrees]
    return value, "pass" if np.sort(reached)[-1 - rank] <= tolerance else "undecided"


def _list_points(deviation: Deviation, sigma_mm: Floats, common_mm: Floats | None) -> _Points:
    """Return the deviations of a scan, combined to at most about `MOST_MEANS`."""
    counted = deviation.counted
    towards = (deviation.normals[counted] @ deviation.T_nominal_scan[:3, :3].T).astype(np.float64)
    facing = towards if deviation.facing is None else deviation.facing[counted]
    if not np.isfinite(facing).all():
        facing = np.where(np.isfinite(facing), facing, towards)
    value = deviation.signed[counted].astype(np.float64)
    noise = np.maximum(np.nan_to_num(sigma_mm[counted]).astype(np.float64), deviation.noise_mm)
    common = np.zeros(len(value)) if common_mm is None else np.nan_to_num(common_mm[counted])
    unmatched = deviation.is_unmatched[counted]
    places = deviation.located[counted]
    common = common.astype(np.float64)
    points = _Points(places, facing, towards, value, noise, common, unmatched)
    if len(points) > MOST_MEANS:
        side = deviation.area.spacing_mm * np.sqrt(len(points) / MOST_MEANS) / 3
        points = _combine(points, side)
    # noise makes a best fit uncertain, the part's form does not
    J = distance_jacobian(points.place - points.place.mean(axis=0), points.towards)
    fitted = J[~points.is_unmatched]
    covariance = np.median(points.noise) ** 2 * np.linalg.pinv(fitted.T @ fitted, hermitian=True)
    aligned = np.sqrt(np.einsum("ni,ij,nj->n", J, covariance, J))
    return replace(points, common=np.hypot(points.common, aligned))


def _combine(points: _Points, side: float) -> _Points:
    """Return the means of points by cubes of ``side`` mm, and by the way that they face."""
    axis = np.argmax(np.abs(points.facing), axis=1)
    faces = 2 * axis + (np.take_along_axis(points.facing, axis[:, None], 1)[:, 0] > 0)
    apart = 2 * float(np.ptp(points.place, axis=0).max()) + 2 * side
    keyed = points.place + np.outer(faces, [apart, 0, 0])
    _, which = occupied_cubes(keyed, side)
    count = np.bincount(which)

    def mean(values: Floats) -> Floats:
        return np.bincount(which, values) / count

    return _Points(
        np.stack([mean(column) for column in points.place.T], axis=1),
        np.stack([mean(column) for column in points.facing.T], axis=1),
        np.stack([mean(column) for column in points.towards.T], axis=1),
        mean(points.value),
        mean(points.noise) / np.sqrt(count),
        mean(points.common),
        mean(points.is_unmatched.astype(np.float64)) > 0.5,
    )


def _average(points: _Points, count: int, chosen: np.ndarray | None = None) -> _Means:
    """Return the mean of each of the ``chosen`` points, or of all, and its nearest neighbours that
    face alike, ``count`` in all, of which the largest and the least do not count: spikes."""
    count = min(count, len(points))
    radius = _median_radius(points, count)
    keyed = np.hstack([points.place, FACE * radius * points.facing])
    asked = keyed if chosen is None else keyed[chosen]
    distance, near = cKDTree(keyed).query(asked, k=count, workers=-1)
    distance, near = distance.reshape(len(asked), count), near.reshape(len(asked), count)
    order = np.argsort(points.value[near], axis=1)
    near = np.take_along_axis(near, order, axis=1)
    trimmed = near[:, 1:-1]
    value = points.value[trimmed].mean(axis=1)
    noise = np.sqrt(np.mean(points.noise[near] ** 2, axis=1) / count)
    # what the deviation changes by within the mean, beyond noise
    most = (1 + 2 * np.sqrt(2 / count)) * np.mean(points.noise[near] ** 2, axis=1)
    varies = np.maximum(points.value[trimmed].var(axis=1) - most, 0.0)
    sigma = np.sqrt(noise**2 + points.common[near].mean(axis=1) ** 2 + varies / count)
    return _Means(value, sigma, distance.max(axis=1), np.sqrt(varies))


def _median_radius(points: _Points, count: int) -> float:
    """Return the median radius in mm that holds ``count`` points."""
    some = points.place[:: max(1, len(points) // 2000)]
    return float(np.median(cKDTree(points.place).query(some, k=count)[0].max(axis=-1)))


def _list_places(
    deviation: Deviation, points: _Points, means: _Means, count: int, tolerance: float
) -> tuple[tuple[DeviatingPlace, ...], list[str]]:
    """Return the connected areas out of tolerance, the worst first, and in words those that may be
    noise."""
    single = _Means(
        points.value, np.hypot(points.noise, points.common), means.radius, 0 * means.radius
    )
    bound, certain = means.bound(), np.abs(single.value) - SINGLE_SIGMAS * single.sigma
    large = np.flatnonzero((certain > bound) & (certain > tolerance))
    tree = cKDTree(points.place)
    if len(large) and len(points) >= BESIDE:
        near = tree.query(points.place[large], k=BESIDE)[1]
        sided = np.sign(points.value[large])[:, None] * points.value[near]
        last = np.argsort(sided, axis=1)[:, -MIN_PLACE]  # one or two may be spikes
        beside = np.take_along_axis(near, last[:, None], axis=1)[:, 0]
        is_better = certain[beside] > np.maximum(bound[large], tolerance)
        large, beside = large[is_better], beside[is_better]
        bound[large] = certain[beside]
        means = _replace(means, large, single.take(beside))
    for times in list(FAIL_SIGMAS)[1:]:
        suspect = np.flatnonzero(np.abs(means.value) > SUSPECT * tolerance)
        if not len(suspect) or times * count > len(points):
            break
        wider = _average(points, times * count, suspect)
        is_better = wider.bound(times) > bound[suspect]
        bound[suspect[is_better]] = wider.bound(times)[is_better]
        means = _replace(means, suspect[is_better], wider.take(is_better))
    means, bound, doubts = _join_small(points, means, bound, tolerance, median_spacing(tree, 2000))
    area, link = deviation.area, max(deviation.area.spacing_mm, float(np.median(means.radius)))
    found = list[DeviatingPlace]()
    missing = np.flatnonzero(np.abs(np.nan_to_num(area.deviation)) > tolerance + area.spacing_mm)
    out = bound > tolerance
    for sign in (-1, 1):
        own = np.flatnonzero(out & (np.sign(means.value) == sign))
        samples = missing[np.sign(area.deviation[missing]) == sign]
        together = np.concatenate([points.place[own], area.counterpart[samples]])
        for members in label_clusters(together, link):
            # one spike before an open place is the counterpart of all its samples
            if len(np.unique(together[members], axis=0)) < MIN_PLACE:
                continue
            measured, places = own[members[members < len(own)]], members[members >= len(own)]
            found.append(
                _describe(
                    points, means, bound, measured, count, deviation, samples[places - len(own)]
                )
            )
    found.sort(key=lambda each: -abs(each.value_mm))
    return tuple(found[:MOST_PLACES]), doubts


def _join_small(
    points: _Points, means: _Means, bound: Floats, tolerance: float, spacing: float
) -> tuple[_Means, Floats, list[str]]:
    """Return the means, and what they exceed for certain, with connected points beyond the
    tolerance taken together where no mean holds them: what is thinner than a mean, as a rib; and
    in words those that may be noise.

    That points were chosen as large ones makes their mean too large by what noise about the
    tolerance would, the mean of a normal distribution cut off at `SUSPECT`.
    """
    noise, bound, doubts = points.noise, bound.copy(), list[str]()
    link, limit = JOINED * spacing, SUSPECT * tolerance
    chosen_by = noise * np.sqrt(2 / np.pi) / erfcx((limit - tolerance) / noise / np.sqrt(2))
    for sign in (-1, 1):
        large = np.flatnonzero(sign * points.value > limit)
        for members in label_clusters(points.place[large], link):
            own = large[members]
            if len(own) < LEAST_POINTS or np.mean(bound[own] > tolerance) > 0.5:
                continue  # means hold it
            kept = own[np.argsort(np.abs(points.value[own]))[1:-1]]
            sigma = np.hypot(rms(noise[own]) / np.sqrt(len(own)), points.common[own].mean())
            value = float(points.value[kept].mean()) - sign * float(chosen_by[own].mean())
            certain = sign * value - FAIL_SIGMAS[1] * sigma
            if certain > tolerance:
                own = own[bound[own] <= tolerance]  # which join the others, if there are any
                bound[own] = certain
                every = np.ones(len(own))
                spread = every * points.value[kept].std()
                joined = _Means(value * every, sigma * every, means.radius[own], spread)
                means = _replace(means, own, joined)
            elif sign * value - DOUBT_SIGMAS * sigma > tolerance:
                doubts.append(_describe_doubt(len(own), points.place[own].mean(axis=0), value))
    return means, bound, doubts


def _doubt_small(points: _Points, tolerance: float) -> Iterator[str]:
    """Yield where the mean of the fewest neighbours lies out of tolerance, though not that of as
    many as noise demands: dirt."""
    large = np.flatnonzero(np.abs(points.value) > tolerance)
    if len(large) < MIN_PLACE:
        return
    means = _average(points, LEAST_POINTS, large)
    beyond = np.abs(means.value) - DOUBT_SIGMAS * means.sigma
    if beyond.max() > tolerance:
        worst = int(np.argmax(beyond))
        yield _describe_doubt(LEAST_POINTS, points.place[large[worst]], means.value[worst])


def _describe_doubt(count: int, at: Floats, value: float) -> str:
    """Return what keeps a part from passing where a few points lie off."""
    place = " ".join(f"{x:.1f}" for x in at)
    return (
        f"{count} points at x y z {place} mm of the model lie {value:.3f} mm off, which may be"
        " noise: scan there again, from nearer, and merge"
    )


def _replace(means: _Means, which: np.ndarray, others: _Means) -> _Means:
    """Return means of which some (k,) are replaced."""
    fields = {name: values.copy() for name, values in vars(means).items()}
    for name, values in fields.items():
        values[which] = getattr(others, name)
    return _Means(**fields)


def _describe(
    points: _Points,
    means: _Means,
    bound: Floats,
    measured: np.ndarray,
    count: int,
    deviation: Deviation,
    samples: np.ndarray,
) -> DeviatingPlace:
    """Return an area out of tolerance from the ``measured`` means, of ``count`` points and more,
    what they exceed for certain (``bound``), and the ``samples`` of the nominal in it."""
    area = deviation.area
    worst, sigma, place = 0.0, 0.0, np.zeros(3)
    if len(measured):
        first = measured[int(np.argmax(bound[measured]))]
        worst, place = means.value[first], points.place[first]
        # the largest of several means is too large by noise; what one averages has a larger peak
        rivals = np.sign(worst) * means.value > abs(worst) - RIVAL_SIGMAS * means.sigma[first]
        chosen = np.sqrt(1 + 2 * np.log(max(1.0, np.count_nonzero(rivals) / count)))
        sigma = np.hypot(chosen * means.sigma[first], means.variation[first])
    if len(samples):
        extreme = samples[int(np.argmax(np.abs(area.deviation[samples])))]
        if abs(area.deviation[extreme]) > abs(worst) + area.spacing_mm:
            worst, place = area.deviation[extreme], area.places[extreme]
            sigma = area.spacing_mm / 2
    is_unmatched = len(samples) > 0 or bool(points.is_unmatched[measured].mean() > 0.5)
    kinds: tuple[PlaceKind, PlaceKind] = ("excess", "missing") if is_unmatched else ("high", "low")
    extent = np.concatenate([points.place[measured], area.places[samples]])
    return DeviatingPlace(
        kinds[0 if worst > 0 else 1],
        to_vector(place),
        float(worst),
        COVERAGE * float(sigma),
        extent_across(extent),
        len(measured),
    )


def _list_doubts(deviation: Deviation, area: float, least_area: float, gap: float) -> Iterator[str]:
    """Yield what keeps a scan from passing although no place of it is out of tolerance."""
    if area < least_area:
        yield (
            f"{area:.1f} % of the area that the views can see was measured, and {least_area:g} %"
            " are needed: see that the scan shows this part, scan what is missing and merge"
        )
    most = max(3 * deviation.area.spacing_mm, LARGEST_GAP * deviation.surface.diagonal)
    if area >= least_area >= LEAST_AREA and gap > most:
        place = " ".join(f"{x:.1f}" for x in deviation.area.largest_gap[1])
        yield (
            f"a spot of {gap:.2g} mm at x y z {place} mm of the model was not measured, and could"
            " hide an error: scan it too and merge"
        )
    alone = sum(each.points for each in deviation.excluded if each.reason == "alone")
    if alone > MOST_ALONE * len(deviation.signed):
        yield (
            f"{100 * alone / len(deviation.signed):.1f} % of the points are isolated: scan again"
            " with more light"
        )
    for each in deviation.excluded:
        if each.reason == "touching":
            yield (
                f"{each.text()} is not in the model: exclude it by the region of interest if it is"
                " not the part's"
            )
