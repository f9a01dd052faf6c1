"""Form, orientation, location and profile by ISO 1101: widths of tolerance zones, with their
uncertainty.

Noise widens any range of measured points. A zone's width is therefore not read off the points, but
estimated from the deviations' polynomials up to degree `DEGREE` across the region, as a filter's
cutoff does in ISO 12181 and ISO 12781. The polynomials of one degree are taken for normally
distributed with one variance, whose prior is half-Cauchy with the noise as its scale (Gelman 2006):
degrees that show nothing but noise shrink, those that show form do not. The width is that of the
mean of `DRAWS` draws of the polynomials, and the spread of the draws' widths is its uncertainty.
Where the deviations as a whole are no larger than noise makes them, U is at least the width: a
perfect part is covered too. Reference features are those of least squares (GG), whose zones are
never narrower than the minimum zones of ISO 1101.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Literal

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree
from scipy.special import chdtri

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Uncertainty
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import PATCHES, finite_rows, subsample, sum_by_cube, unit_vectors
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import MAX_FITTED_POINTS, MAX_SHARED_POINTS, FeatureFit
from slviewer.inspection.membership import find_isolated
from slviewer.inspection.uncertainty import (
    DRAWS,
    Shared,
    Spread,
    draw_motions,
    draw_steps,
    joint_covariance,
)
from slviewer.records.acceptance import COVERAGE
from slviewer.records.measurement import Quantity

FormKind = Literal["flatness", "roundness", "cylindricity"]
OrientationKind = Literal["parallelism", "perpendicularity"]
DEGREE = 6
"""Of the polynomials across a region that count as form; what is finer is noise or unresolved."""
MAX_DRAWN_POINTS = 5_000
SPIKE_SIGMA = 5.0
CELL_POINTS, MAX_CELLS, WINDOW = 5, 24, 5
"""Of the estimate of the points' density: points a cell at least, cells along a region, and cells
that are averaged."""
FINE_POINTS, FINE_SIGMA = (6, 24), 5.0
"""Neighbours whose mean deviation is tested for form that is too fine for the smooth part, and
standard deviations of that mean from which on it is form."""
NOISE_SIGMAS = 2.5
"""By so much noise may enlarge the deviation of a single point of a fine defect."""
HIDDEN_SHARE = 0.01
"""Of a feature: a defect of such an area is meant to be seen."""
FINE_SHARE = 0.25
"""Standard uncertainty of a fine defect, as a share of it: it seldom fills its neighbourhood."""
SPAN_RATIO = 1e-4
"""Directions of a basis with a smaller root mean square tell nothing: a short arc looks the same
along them."""
LEVEL = 0.95
"""Of the test whether noise alone explains the deviations."""
BURN_IN, THINNING = 50, 3
"""Of the draws of the polynomials' weights: steps before the first, and steps of which one is
kept."""
THIN = 0.01
POINTS_PER_TERM = 10
SECTIONS = 10
"""Along a cylinder, of each of which the roundness is measured."""
MAX_TILT_DEG = 10.0
"""Features farther from parallel or perpendicular than this are not meant to be so."""


@dataclass(frozen=True, eq=False)
class SmoothDeviations:
    """The smooth part of deviations (n,) mm at ``points`` (n, 3), along ``normals`` (n, 3).

    ``basis @ draws``, (n, r) and (r, DRAWS), are draws of the smooth part; ``is_noise``: whether
    noise alone explains it. ``noise_mm`` is the standard deviation of one point, and of each
    weight; ``fine`` (n,) mm is what neighbourhoods lie off the smooth part beyond noise; ``answer``
    (r, m) gives the weights by displacements of the ``sampled`` points (m,) along their normals.
    """

    points: Floats
    normals: Floats
    basis: Floats
    draws: Floats
    is_noise: bool
    noise_mm: float
    fine: Floats
    answer: np.ndarray
    sampled: np.ndarray

    @property
    def smooth(self) -> Floats:
        """(n,) mm: the smooth part, the mean of its draws, and what is too fine for it."""
        return self.basis @ self.draws.mean(axis=1) + self.fine


def smallest_defect(points: Floats, deviations: Floats) -> float:
    """The smallest local defect, mm, of so few points that it would be found among deviations (n,)
    mm at points (n, 3): by their noise, which is that of neighbours' differences."""
    _, near = cKDTree(points).query(points, k=2)
    noise = robust_sigma(deviations - deviations[near[:, 1]], about=0.0) / np.sqrt(2)
    return float(FINE_SIGMA * noise / np.sqrt(FINE_POINTS[0]))


def hidden_defect(smallest: float, count: int) -> float:
    """Depth, mm, of a defect on `HIDDEN_SHARE` of a feature that the noise among its ``count``
    points hides in less than 2.5 % of scans, from the `smallest_defect` that half of them show; 0
    where enough lie there."""
    least, most = FINE_POINTS
    there = HIDDEN_SHARE * count
    surely = (FINE_SIGMA + COVERAGE) / FINE_SIGMA
    return smallest * surely * float(np.sqrt(least / max(there, least))) if there < most else 0.0


def smooth_deviations(
    deviations: Floats,
    points: Floats,
    normals: Floats,
    coordinates: Floats,
    fitted: Floats,
    unrolled: Floats | None = None,
) -> SmoothDeviations:
    """Separate deviations (n,) mm into a smooth part, without what the columns of ``fitted`` (n, p)
    explain, and noise.

    ``coordinates`` (n, k): across the region, in about -1 to 1; ``unrolled`` (n, 1 or 2): others
    that are in proportion to its area, by default the same. Raises InputError for too few points.
    """
    unrolled = coordinates if unrolled is None else unrolled
    arrays = deviations, points, normals, coordinates, fitted, unrolled
    chosen = [subsample(each, MAX_FITTED_POINTS) for each in arrays]
    rounding = 1e-9 * float(np.abs(chosen[1]).max())
    for exclusions_left in (2, 1, 0):
        d, points, normals, coordinates, fitted, unrolled = chosen
        removed, basis, degrees = _smooth_basis(coordinates, fitted)
        whole, residuals = _project_out(d, removed, basis)
        n, columns = whole.shape
        if exclusions_left and n < POINTS_PER_TERM * columns:
            raise InputError(
                f"The region holds {n} measured points: its form needs"
                f" {POINTS_PER_TERM * columns}; select a wider region."
            )
        reach = max(SPIKE_SIGMA * robust_sigma(residuals), rounding)
        isolated = find_isolated(points, residuals, reach)
        if not isolated.any() or not exclusions_left:
            break
        chosen = [each[~isolated] for each in chosen]
    noise = float(np.sqrt(residuals @ residuals / (n - columns)))
    factor = _patch_misfit(residuals, coordinates, noise, columns)
    sampled = np.arange(0, n, -(-n // MAX_SHARED_POINTS))
    answer = np.linalg.pinv(whole[sampled], rcond=1e-6)
    # the reference is that of even weight by area, whatever the density of the points
    root = np.sqrt(_even_weights(unrolled))[:, None]
    reference = np.linalg.lstsq(root * removed, root * whole, rcond=1e-6)[0]
    smooth = whole - removed @ reference
    weights, noise = whole.T @ d, factor * noise
    form = weights[removed.shape[1] :]
    draws = np.repeat(weights[:, None], DRAWS, axis=1)
    draws[removed.shape[1] :] = _draw_weights(form, degrees, noise, np.random.default_rng(0))
    # what shrinking takes for noise is form where neighbours agree on it
    fine = _find_fine(points, d - whole @ draws.mean(axis=1), robust_sigma(residuals))
    is_noise = not fine.any() and bool(
        form @ form <= noise**2 * chdtri(max(len(form), 1), 1 - LEVEL)
    )
    return SmoothDeviations(points, normals, smooth, draws, is_noise, noise, fine, answer, sampled)


def _range(deviations: Floats, points: Floats) -> Floats:
    """Return the range of deviations (n, draws) in each draw; the ``points`` do not matter."""
    return np.ptp(deviations, axis=0)


def zone_width(
    name: str,
    smooth: SmoothDeviations,
    shared: Shared | None,
    displaced: Callable[[Floats, Floats], Floats] | None = None,
    width: Callable[[Floats, Floats], Floats] = _range,
    is_worst: bool = False,
) -> Quantity:
    """The width (mm) of a zone that holds the smooth part, with the spread of its draws in U.

    ``width``: of deviations (n, draws) at points (n, 3), for each draw; ``displaced``: draws of
    further deviations (n, draws) at points (n, 3) with normals (n, 3), as a datum's or an
    alignment's errors cause. ``is_worst``: the width is that of the worst of several zones, whose
    noise it picks out: as much as the draws add is subtracted.
    """
    field = smooth.smooth
    chosen = np.unique(
        [*range(0, len(field), -(-len(field) // MAX_DRAWN_POINTS)), field.argmin(), field.argmax()]
    )
    drawn = smooth.basis[chosen] @ smooth.draws + smooth.fine[chosen, None]
    if displaced is not None:
        drawn = drawn + displaced(smooth.points[chosen], smooth.normals[chosen])
    widths = width(drawn, smooth.points[chosen])
    value = float(width(field[:, None], smooth.points)[0])
    finer = width((field + FINE_SHARE * smooth.fine)[:, None], smooth.points)[0]
    variance = float(widths.var()) + float(finer - value) ** 2
    if shared is not None:
        # where the zone touches, its width answers to the deviations there; the rest of the field
        # leaves it unchanged
        change = 1e-3 * smooth.noise_mm + 1e-9
        by_field = np.zeros(len(field))
        ends = [field.argmin(), field.argmax()]
        signs = np.sign(field[ends] - np.median(field))
        moved = np.repeat(field[:, None], 2, axis=1)
        moved[ends, [0, 1]] += signs * change
        by_field[ends] = (width(moved, smooth.points) - value) / change * signs
        answers = (by_field @ smooth.basis) @ smooth.answer
        places = smooth.sampled
        effects = shared(smooth.points[places], answers[None, :, None] * smooth.normals[places])
        variance += float(np.sum(effects**2))
    # what the draws' scatter adds to the width bounds by how much the mean's own scatter may have
    # widened it
    added = float(widths.mean()) - value
    sigma = float(np.sqrt(variance + added**2 / 3))
    if is_worst:
        value -= min(max(added, 0.0), value)
    return Quantity(
        name, value, "mm", max(sigma, value / 2) if smooth.is_noise else sigma, shared is not None
    )


def form_error(
    kind: FormKind, fit: FeatureFit, points: Floats, shared: Shared | None = None
) -> Quantity:
    """Flatness of a plane, cylindricity of a cylinder, roundness of a cylinder or a sphere, mm.

    ``points`` (n, 3) mm: of the feature. Roundness is that of the worst section of a cylinder; of a
    sphere the width of the zone that holds all of it: no section is wider. Raises InputError for
    another feature or for too few points.
    """
    f = fit.feature
    wanted = {"flatness": "plane", "cylindricity": "cylinder", "roundness": "sphere or cylinder"}
    if f.kind not in wanted[kind].split(" or "):
        raise InputError(f"A {f.kind} has no {kind}: choose a {wanted[kind]}.")
    points = points[finite_rows(points)]
    normals, fitted = f.normals(points), f.jacobian(points)
    if f.kind == "plane":
        coordinates = unrolled = _region_coordinates(points)
    elif f.kind == "sphere":
        coordinates = unrolled = normals
    else:
        coordinates = _cylinder_coordinates(f, points)
        around, along = coordinates[:, :2], coordinates[:, 2:]
        unrolled = np.column_stack([np.arctan2(around[:, 1], around[:, 0]), along])
    smooth = smooth_deviations(f.distance(points), points, normals, coordinates, fitted, unrolled)
    if kind == "roundness" and f.kind == "cylinder":
        return zone_width(kind, smooth, shared, width=partial(_section_range, f), is_worst=True)
    return zone_width(kind, smooth, shared)


def _section_range(f: Feature, deviations: Floats, points: Floats) -> Floats:
    """Return the largest range of deviations (n, draws) at points (n, 3) from the circle of a
    section of a cylinder, of `SECTIONS` along it, in each draw."""
    coordinates = _cylinder_coordinates(f, points)
    section = np.minimum((coordinates[:, 2] + 1) / 2 * SECTIONS, SECTIONS - 1).astype(int)
    circle = np.column_stack([coordinates[:, :2], np.ones(len(points))])
    ranges = [np.zeros(deviations.shape[1])]
    for k in np.unique(section):
        own, columns = deviations[section == k], circle[section == k]
        ranges.append(_range(own - columns @ np.linalg.lstsq(columns, own, rcond=None)[0], points))
    return np.asarray(np.max(ranges, axis=0))


def orientation_error(
    kind: OrientationKind,
    fit: FeatureFit,
    points: Floats,
    datum: FeatureFit,
    shared: Shared | None = None,
) -> Quantity:
    """Parallelism or perpendicularity, mm, of a plane (all its surface) or a cylinder (its axis) to
    a datum.

    ``points`` (n, 3) mm: of the toleranced region. Raises InputError where a feature has no
    direction, or is farther than `MAX_TILT_DEG` from the requested orientation.
    """
    f, d = fit.feature, datum.feature
    # directions of a plane's normal and of an axis answer to each other as perpendicular and
    # parallel
    along = (kind == "parallelism") == (f.kind == d.kind)
    cosine = abs(float(f.unit_direction @ d.unit_direction))
    tilt = float(np.degrees(np.arccos(min(cosine, 1.0)) if along else np.arcsin(min(cosine, 1.0))))
    if tilt > MAX_TILT_DEG:
        raise InputError(
            f"The {f.kind} is {tilt:.1f} degrees from the {kind} to the {d.kind}: choose another"
            " datum."
        )
    points = points[finite_rows(points)]
    if f.kind == "cylinder":
        return _axis_orientation(kind, fit, points, datum, along)

    def zone_normal(datum_direction: Floats) -> Floats:
        """The unit normal (3,) of the zone's planes, for a direction of the datum."""
        direction = f.unit_direction
        if along:
            return datum_direction * np.sign(datum_direction @ direction)
        across = direction - (direction @ datum_direction) * datum_direction
        return unit_vectors(across)

    normal = zone_normal(d.unit_direction)
    normals = np.broadcast_to(normal, points.shape)
    smooth = smooth_deviations(
        (points - f.place) @ normal,
        points,
        normals,
        _region_coordinates(points),
        np.ones((len(points), 1)),
    )
    steps = draw_steps(datum.spread.covariance, np.random.default_rng(1))
    turned = np.stack([zone_normal(d.moved(step).unit_direction) for step in steps]) - normal

    def displaced(places: Floats, _: Floats) -> Floats:
        """Changes of the heights (n, draws) by the draws of the datum."""
        return (places - f.place) @ turned.T

    return zone_width(kind, smooth, shared, displaced)


def position_error(
    fit: FeatureFit,
    points: Floats,
    nominal: Feature,
    alignment: Uncertainty | None = None,
    shared: Shared | None = None,
) -> Quantity:
    """Position, mm: the diameter of the zone about the ``nominal`` place that holds a sphere's
    centre or a cylinder's axis over its region, or the width of the zone that holds a flat surface,
    with its form.

    ``points`` (n, 3) mm of the region, like the ``nominal`` in part coordinates, as ``fit``.
    """
    if fit.feature.kind != nominal.kind:
        raise InputError(
            f"The feature is a {fit.feature.kind}, its nominal a {nominal.kind}: choose one kind."
        )
    points = points[finite_rows(points)]
    f = fit.feature
    if f.kind == "plane":
        zone = profile_error(
            points, nominal.distance(points), nominal.normals(points), alignment, shared
        )
        return replace(zone, name="position")
    reached = np.zeros((1, 3))
    if f.direction is not None:
        along = (points - f.place) @ f.direction
        reached = np.array([along.min(), along.max()])[:, None] * f.direction
    place_or_axis = replace(nominal, radius=None)

    def off(feature: Feature, moved: Floats | float) -> float:
        """Twice how far a feature, moved by (k, 3), is off its nominal."""
        places = feature.place + reached + moved
        if f.kind == "cylinder":
            turned = feature.unit_direction - f.unit_direction
            places = places + (reached @ f.unit_direction)[:, None] * turned
        return 2 * float(np.abs(place_or_axis.distance(places)).max())

    def draw(spread: Spread, motion: Uncertainty | None) -> Floats:
        """Return the position with each of the drawn errors (draws,)."""
        rng = np.random.default_rng(2)
        shifts = np.zeros((DRAWS, len(reached), 3))
        if motion is not None:
            shifts = draw_motions(motion, rng)(f.place + reached)
        steps = draw_steps(spread.covariance, rng)
        return np.array([off(f.moved(each), s) for each, s in zip(steps, shifts, strict=True)])

    noisy = alignment
    if alignment is not None and alignment.noise is not None:
        noisy = replace(alignment, covariance=alignment.noise)
    drawn = draw(fit.spread.noise, noisy), draw(fit.spread, alignment)
    return _correct_for_noise("position", off(f, 0.0), *drawn, fit.spread.whole)


def profile_error(
    points: Floats,
    deviations: Floats,
    normals: Floats,
    alignment: Uncertainty | None = None,
    shared: Shared | None = None,
) -> Quantity:
    """Profile of a surface, mm: twice the largest deviation (n,) mm of points (n, 3) from the
    nominal, whose normals (n, 3) are given; NaN for points that do not belong to it. Raises
    InputError for too few points.
    """
    counted = np.isfinite(deviations) & finite_rows(normals)
    points, deviations, normals = (
        np.asarray(each[counted], np.float64) for each in (points, deviations, normals)
    )
    if not len(points):
        raise InputError("No point of the region belongs to the nominal: select a region on it.")
    # on the nominal: without noise
    coordinates = _region_coordinates(points - deviations[:, None] * normals, axes=3)
    smooth = smooth_deviations(deviations, points, normals, coordinates, np.zeros((len(points), 0)))
    if alignment is None:
        return zone_width("profile", smooth, shared, width=_twice_largest)
    moves = draw_motions(alignment, np.random.default_rng(3))

    def displaced(places: Floats, towards: Floats) -> Floats:
        """Changes of the deviations (n, draws) by the draws of the alignment."""
        return np.einsum("bni,ni->nb", moves(places), towards)

    return zone_width("profile", smooth, shared, displaced, _twice_largest)


def _twice_largest(deviations: Floats, points: Floats) -> Floats:
    """Return twice the largest size of deviations (n, draws) in each draw; the ``points`` do not
    matter."""
    return 2 * np.abs(deviations).max(axis=0)


def _correct_for_noise(
    name: str, value: float, drawn: Floats, shifted: Floats, whole: bool
) -> Quantity:
    """Return a width (mm) less what noise adds to it, with that and the spread of the draws in U.

    The measured width holds noise once, the ``drawn`` ones (draws,) twice: they are extrapolated to
    none by a line (SIMEX, Cook and Stefanski 1994). ``shifted`` (draws,): drawn with what the form
    of features may shift too, which the measured width may hide.
    """
    added = float(drawn.mean() - value)
    # a width no larger than what noise adds may be noise alone, or hide as much
    share = 0.7 if added >= value else min(max(1 / 3, abs(added) / (value - added)), 0.7)
    hidden = max(float(np.mean(shifted**2) - np.mean(drawn**2)), 0.0)
    sigma = float(np.sqrt(drawn.var() + share * added**2 + hidden))
    return Quantity(name, max(value - added, 0.0), "mm", sigma, whole)


def _draw_weights(
    weights: Floats, degrees: np.ndarray, noise: float, rng: np.random.Generator
) -> Floats:
    """Draw what weights (r,), measured with ``noise``, are without it: (r, DRAWS), by Gibbs
    sampling.

    Weights of one of the ``degrees`` (r,) share a variance with a half-Cauchy prior of scale
    ``noise``, as a mixture of inverse gamma distributions (Wand et al. 2011).
    """
    if not noise > 0 or not len(weights):
        return np.repeat(weights[:, None], DRAWS, axis=1)
    _, group, sizes = np.unique(degrees, return_inverse=True, return_counts=True)
    measured, drawn = weights / noise, np.empty((len(weights), DRAWS))
    variance = np.maximum(np.bincount(group, measured**2) / sizes, 1.0)
    for step in range(-BURN_IN, DRAWS * THINNING):
        kept = (variance / (1 + variance))[group]
        each = kept * measured + np.sqrt(kept) * rng.normal(size=len(weights))
        mixture = 1 / rng.gamma(1.0, 1 / (1 + 1 / variance))
        rate = np.bincount(group, each**2) / 2 + 1 / mixture
        variance = rate / rng.gamma((sizes + 1) / 2)
        if step >= 0 and step % THINNING == 0:
            drawn[:, step // THINNING] = noise * each
    return drawn


def _axis_orientation(
    kind: OrientationKind, fit: FeatureFit, points: Floats, datum: FeatureFit, along: bool
) -> Quantity:
    """The orientation of a cylinder's axis over its region to a datum: the diameter of its zone
    where both directions should agree (``along``), else its width."""
    f, d = fit.feature, datum.feature
    length = float(np.ptp((points - f.place) @ f.unit_direction))

    def off(feature: Feature, reference: Feature) -> float:
        """How far the axis' ends lie apart across the requested direction."""
        axis, direction = feature.unit_direction, reference.unit_direction
        return length * float(
            np.linalg.norm(np.cross(axis, direction)) if along else abs(axis @ direction)
        )

    p = f.parameters

    def draw(own: Spread, other: Spread) -> Floats:
        """Return the orientation with each of the drawn errors (draws,)."""
        steps = draw_steps(joint_covariance(own, other), np.random.default_rng(4))
        return np.array([off(f.moved(step[:p]), d.moved(step[p:])) for step in steps])

    drawn = draw(fit.spread.noise, datum.spread.noise), draw(fit.spread, datum.spread)
    return _correct_for_noise(kind, off(f, d), *drawn, fit.spread.whole and datum.spread.whole)


def _smooth_basis(
    coordinates: np.ndarray, fitted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal columns (n, q) of what was fitted, and (n, r) of the polynomials without that, by
    rising degree, with the degree of each (r,)."""
    removed = _span(fitted / np.maximum(np.sqrt(np.mean(fitted**2, axis=0)), 1e-300))
    whole, degrees = removed, list[int]()
    for degree in range(DEGREE + 1):
        powers = product(range(degree + 1), repeat=coordinates.shape[1])
        terms = np.stack(
            [np.prod(coordinates**e, axis=1) for e in powers if sum(e) == degree], axis=1
        )
        added = _span(terms, whole)
        whole = np.hstack([whole, added])
        degrees += [degree] * added.shape[1]
    return removed, whole[:, removed.shape[1] :], np.array(degrees)


def _project_out(values: np.ndarray, *bases: np.ndarray) -> tuple[Floats, Floats]:
    """Return the columns (n, q + r) of orthonormal bases, and what they leave of values (n,)."""
    whole = np.hstack(bases)
    return whole, values - whole @ (whole.T @ values)


def _span(columns: Floats, without: Floats | None = None) -> Floats:
    """Orthonormal columns (n, r) that span those given, ``without`` what other orthonormal ones (n,
    q) span, and without directions that rounding alone distinguishes."""
    if not columns.shape[1]:
        return columns
    columns = columns / np.sqrt(len(columns))
    if without is not None:
        for _ in range(2):  # once more, for what rounding left
            columns = columns - without @ (without.T @ columns)
    vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
    return vectors[:, values > SPAN_RATIO]


def _even_weights(unrolled: Floats) -> Floats:
    """Weights (n,) of points at coordinates (n, k) in proportion to area, so that equal areas weigh
    the same."""
    low, size = unrolled.min(axis=0), np.ptp(unrolled, axis=0)
    cells = int(np.clip((len(unrolled) / CELL_POINTS) ** (1 / unrolled.shape[1]), 1, MAX_CELLS))
    place = tuple(
        np.minimum((unrolled - low) / np.where(size > 0, size, 1.0) * cells, cells - 1)
        .astype(int)
        .T
    )
    counts = np.zeros((cells,) * len(place))
    np.add.at(counts, place, 1)
    # means over the neighbourhood, which only cells with points count for
    sums, occupied = (
        uniform_filter(each, WINDOW, mode="constant") for each in (counts, np.sign(counts))
    )
    return occupied[place] / sums[place]


def _find_fine(points: Floats, residuals: Floats, sigma: float) -> Floats:
    """Residuals (n,) mm where noise does not explain the mean of `FINE_POINTS` neighbours, else 0:
    the largest such mean, or the point's own where that is larger even without noise. ``sigma``:
    the noise, mm."""
    if not sigma > 1e-9 * float(np.abs(points).max()):
        return np.zeros(len(points))
    counts = np.minimum(FINE_POINTS, len(points))
    _, near = cKDTree(points).query(points, k=counts.max())
    means = np.cumsum(residuals[near], axis=1)[:, counts - 1] / counts
    sigmas = means * np.sqrt(counts) / sigma
    clearest = sigmas[np.arange(len(points)), np.abs(sigmas).argmax(axis=1)]
    sides = np.sign(clearest)
    largest = np.maximum(
        (sides[:, None] * means).max(axis=1), sides * residuals - NOISE_SIGMAS * sigma
    )
    return np.where(np.abs(clearest) > FINE_SIGMA, sides * largest, 0.0)


def _patch_misfit(residuals: Floats, coordinates: Floats, noise: float, columns: int) -> float:
    """How many times larger than independent ones the patches' mean residuals are, at least 1."""
    low = coordinates.min(axis=0)
    side = max(float(np.ptp(coordinates, axis=0).max()) / PATCHES, 1e-12)
    padding = (0, 0), (0, 3 - coordinates.shape[1])
    tallies = np.column_stack([np.ones(len(residuals)), residuals])
    counts, sums = sum_by_cube(tallies, np.pad(coordinates - low, padding), side).T
    means, expected = sums / counts, noise / np.sqrt(counts)
    large = counts >= POINTS_PER_TERM
    if not large.any() or not noise > 0:
        return 1.0
    # the smooth part takes its share of the patches' freedom
    freedom = max(1 - columns / int(large.sum()), 0.25)
    squares = (means[large] / expected[large]) ** 2
    return float(np.sqrt(max(float(np.mean(squares)) / freedom, 1.0)))


def _region_coordinates(points: Floats, axes: int = 2) -> Floats:
    """Coordinates (n, axes) of points along their principal axes, each in -1 to 1; 0 along those in
    which the region is thinner than `THIN` of its length."""
    offsets = points - points.mean(axis=0)
    _, directions = np.linalg.eigh(offsets.T @ offsets)
    along = offsets @ directions[:, ::-1][:, :axes]
    low, high = along.min(axis=0), along.max(axis=0)
    size = high - low
    scaled = (2 * along - low - high) / np.maximum(size, 1e-300)
    return np.where(size > THIN * size.max(), scaled, 0.0)


def _cylinder_coordinates(f: Feature, points: Floats) -> Floats:
    """Cosine and sine of the angle about the axis, and the place along it in -1 to 1: (n, 3)."""
    normals, axis = f.normals(points), f.unit_direction
    first = np.linalg.svd(axis[None])[2][1]
    along = (points - f.place) @ axis
    middle, half = (along.max() + along.min()) / 2, max(float(np.ptp(along)) / 2, 1e-12)
    return np.column_stack(
        [normals @ first, normals @ np.cross(axis, first), (along - middle) / half]
    )
