"""Form, orientation, location and profile by ISO 1101: widths of tolerance zones, with their uncertainty.

Noise widens any range of measured points. A zone's width is therefore read off the smooth part of the deviations, the
polynomials up to degree `DEGREE` across the region, as a filter's cutoff does in ISO 12181 and ISO 12781. What noise
still adds to the width of the smooth part is estimated by adding it once more (`DRAWS` draws) and subtracted; both the
spread of these draws and the whole of what was subtracted are part of U, so that a perfect part is covered too.
Reference features are those of least squares (GG), whose zones are never narrower than the minimum zones of ISO 1101.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.cubes import occupied_cubes
from slviewer.geometry.robust import robust_sigma
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import MAX_FITTED_POINTS, MAX_SHARED_POINTS, FeatureFit
from slviewer.inspection.quantities import Quantity
from slviewer.inspection.uncertainty import DRAWS, PATCHES, RigidSpread, Shared, draw_steps, joint_covariance

FormKind = Literal["flatness", "roundness", "cylindricity"]
OrientationKind = Literal["parallelism", "perpendicularity"]
FORM_KINDS: tuple[FormKind, ...] = get_args(FormKind)
ORIENTATION_KINDS: tuple[OrientationKind, ...] = get_args(OrientationKind)
DEGREE = 6
"""Of the polynomials across a region that count as form; what is finer is noise or unresolved."""
MAX_DRAWN_POINTS = 2_000
MAX_EVEN_POINTS = 5_000
SPIKE_SIGMA = 5.0
DENSITY_REACH = 0.3
"""Of the coordinates across a region, -1 to 1: within it the density of the points is estimated."""
PATCH_SIGMA = 4.5
"""Of the mean of a patch: one that is farther off the smooth part shows form that is too fine for it."""
SPAN_RATIO = 1e-3
"""Directions of a basis that are this much weaker than its strongest tell nothing: a short arc looks the same along
them."""
POINTS_PER_TERM = 10
SECTION_SHARE = 0.1
"""Thickness of the section whose roundness is measured, as a share of the region's length along the axis, or of a
sphere's diameter."""
MAX_TILT_DEG = 10.0
"""Features farther from parallel or perpendicular than this are not meant to be so."""


@dataclass(frozen=True, eq=False)
class SmoothDeviations:
    """The smooth part of deviations (n,) mm at ``points`` (n, 3), along ``normals`` (n, 3).

    The smooth part is ``basis @ weights`` (n, r) and (r,); ``noise_mm`` is the standard deviation of one point, and of
    each weight, ``unresolved_mm`` how far patches lie off the smooth part beyond noise; ``answer`` (r, m) gives
    the weights by displacements of the ``sampled`` points (m,) along their normals.
    """

    points: np.ndarray
    normals: np.ndarray
    basis: np.ndarray
    weights: np.ndarray
    noise_mm: float
    unresolved_mm: float
    answer: np.ndarray
    sampled: np.ndarray

    @property
    def smooth(self) -> np.ndarray:
        """(n,) mm: the smooth part."""
        return np.asarray(self.basis @ self.weights)


def smooth_deviations(
    deviations: np.ndarray, points: np.ndarray, normals: np.ndarray, coordinates: np.ndarray, fitted: np.ndarray
) -> SmoothDeviations:
    """Separate deviations (n,) mm into a smooth part, without what the columns of ``fitted`` (n, p) explain, and noise.

    ``coordinates`` (n, k): across the region, in about -1 to 1. Raises InputError for too few points.
    """
    step = -(-len(deviations) // MAX_FITTED_POINTS)
    d, points, normals = deviations[::step], points[::step], normals[::step]
    coordinates, fitted = coordinates[::step], fitted[::step]
    counted = np.ones(len(d), bool)
    for _ in range(2):
        removed, basis = _smooth_basis(coordinates[counted], fitted[counted])
        n, r = basis.shape
        if n < POINTS_PER_TERM * (r + removed.shape[1]):
            raise InputError(
                f"The region holds {n} measured points: its form needs {POINTS_PER_TERM * (r + removed.shape[1])}; "
                "select a wider region."
            )
        whole = np.hstack([removed, basis])
        residuals = d[counted] - whole @ (whole.T @ d[counted])
        reach = max(SPIKE_SIGMA * robust_sigma(residuals), 1e-9 * float(np.abs(points).max()))
        within = np.abs(residuals) <= reach
        if within.all():
            break
        counted[np.flatnonzero(counted)[~within]] = False
    d, points, normals, coordinates = d[counted], points[counted], normals[counted], coordinates[counted]
    if len(d) < n:
        removed, basis = _smooth_basis(coordinates, fitted[counted])
        whole = np.hstack([removed, basis])
        residuals = d - whole @ (whole.T @ d)
    n, columns = whole.shape
    noise = float(np.sqrt(residuals @ residuals / (n - columns)))
    factor, unresolved = _patch_misfit(residuals, coordinates, noise, n, columns)
    sampled = np.arange(0, n, -(-n // MAX_SHARED_POINTS))
    answer = np.linalg.pinv(whole[sampled], rcond=1e-6)
    # the reference is that of even weight by area, whatever the density of the points
    even = np.arange(0, n, -(-n // MAX_EVEN_POINTS))
    near = cKDTree(coordinates[even]).query_ball_point(coordinates[even], DENSITY_REACH, return_length=True)
    root = 1 / np.sqrt(near)[:, None]
    reference = np.linalg.lstsq(root * removed[even], root * whole[even], rcond=1e-6)[0]
    smooth = whole - removed @ reference
    return SmoothDeviations(points, normals, smooth, whole.T @ d, factor * noise, unresolved, answer, sampled)


def zone_width(
    name: str,
    smooth: SmoothDeviations,
    width: Callable[[np.ndarray], np.ndarray],
    shared: Shared | None = None,
    displaced: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Quantity:
    """The width (mm) of a zone that holds the smooth part, with the contribution of noise subtracted and inside U.

    ``width``: of deviations (n, draws), for each draw; ``displaced``: draws of further deviations (n, draws) at points
    (n, 3), as a datum's or an alignment's errors cause.
    """
    field = smooth.smooth
    chosen = np.unique([*range(0, len(field), -(-len(field) // MAX_DRAWN_POINTS)), field.argmin(), field.argmax()])
    value = float(width(field[:, None])[0])
    drawn = smooth.basis[chosen] @ np.random.default_rng(0).normal(size=(smooth.basis.shape[1], DRAWS))
    drawn = field[chosen, None] + smooth.noise_mm * drawn
    if displaced is not None:
        drawn = drawn + displaced(smooth.points[chosen])
    variance = smooth.unresolved_mm**2
    if shared is not None:
        # where the zone touches, its width answers to the deviations there; the rest of the field leaves it unchanged
        change = 1e-3 * smooth.noise_mm + 1e-9
        by_field = np.zeros(len(field))
        for k in (int(field.argmin()), int(field.argmax())):
            moved = field.copy()
            moved[k] += np.sign(field[k] - np.median(field)) * change
            by_field[k] = (float(width(moved[:, None])[0]) - value) / change * np.sign(field[k] - np.median(field))
        answers = (by_field @ smooth.basis) @ smooth.answer
        places = smooth.sampled
        variance += float(np.sum(shared(smooth.points[places], answers[None, :, None] * smooth.normals[places]) ** 2))
    wider = field[chosen, None] + np.sqrt(2) * (drawn - field[chosen, None])
    return _correct_for_noise(name, value, width(drawn), variance, shared is not None, width(wider))


def form_error(kind: FormKind, fit: FeatureFit, points: np.ndarray, shared: Shared | None = None) -> Quantity:
    """Flatness of a plane, cylindricity of a cylinder, roundness of a section of a cylinder or a sphere, mm.

    ``points`` (n, 3) mm: of the region. A cylinder's section is perpendicular to its axis, in the middle; a sphere's
    goes through its centre and the middle of what was measured. Raises InputError for another feature or for too few
    points.
    """
    f = fit.feature
    wanted = {"flatness": ("plane",), "cylindricity": ("cylinder",), "roundness": ("sphere", "cylinder")}[kind]
    if f.kind not in wanted:
        raise InputError(f"A {f.kind} has no {kind}: choose a {' or a '.join(wanted)}.")
    points = points[np.isfinite(points).all(axis=1)]
    if kind == "roundness":
        points, axis = _section_points(f, points)
        normals = f.normals(points)
        across = normals - (normals @ axis)[:, None] * axis
        coordinates = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        fitted = np.column_stack([coordinates, np.ones(len(points))])  # a circle: a thin section shows no tilt
    else:
        normals = f.normals(points)
        coordinates = _region_coordinates(points) if f.kind == "plane" else _cylinder_coordinates(f, points)
        fitted = f.jacobian(points)
    smooth = smooth_deviations(f.distance(points), points, normals, coordinates, fitted)
    return zone_width(kind, smooth, lambda d: np.ptp(d, axis=0), shared)


def orientation_error(
    kind: OrientationKind,
    fit: FeatureFit,
    points: np.ndarray,
    datum: FeatureFit,
    shared: Shared | None = None,
) -> Quantity:
    """Parallelism or perpendicularity, mm, of a plane (all its surface) or a cylinder (its axis) to a datum.

    ``points`` (n, 3) mm: of the toleranced region. Raises InputError where a feature has no direction, or is farther
    than `MAX_TILT_DEG` from the requested orientation.
    """
    f, d = fit.feature, datum.feature
    for each in (f, d):
        if each.direction is None:
            raise InputError(f"A {each.kind} has no direction: {kind} needs planes or cylinders.")
    assert f.direction is not None and d.direction is not None
    # directions of a plane's normal and of an axis answer to each other as perpendicular and parallel
    along = (kind == "parallelism") == (f.kind == d.kind)
    cosine = abs(float(f.direction @ d.direction))
    tilt = float(np.degrees(np.arccos(min(cosine, 1.0)) if along else np.arcsin(min(cosine, 1.0))))
    if tilt > MAX_TILT_DEG:
        raise InputError(f"The {f.kind} is {tilt:.1f} degrees from the {kind} to the {d.kind}: choose another datum.")
    points = points[np.isfinite(points).all(axis=1)]
    if f.kind == "cylinder":
        return _axis_orientation(kind, fit, points, datum, along)

    def zone_normal(datum_direction: np.ndarray) -> np.ndarray:
        """The unit normal (3,) of the zone's planes, for a direction of the datum."""
        assert f.direction is not None
        if along:
            return datum_direction * np.sign(datum_direction @ f.direction)
        across = f.direction - (f.direction @ datum_direction) * datum_direction
        return np.asarray(across / np.linalg.norm(across))

    normal = zone_normal(d.direction)
    normals = np.broadcast_to(normal, points.shape)
    smooth = smooth_deviations(
        (points - f.place) @ normal, points, normals, _region_coordinates(points), np.ones((len(points), 1))
    )
    steps = draw_steps(datum.spread.covariance, np.random.default_rng(1))
    turned = np.stack([zone_normal(_direction_of(d.moved(step))) for step in steps]) - normal

    def displaced(places: np.ndarray) -> np.ndarray:
        """Changes of the heights (n, draws) by the draws of the datum."""
        return np.asarray((places - f.place) @ turned.T)

    return zone_width(kind, smooth, lambda heights: np.ptp(heights, axis=0), shared, displaced)


def position_error(
    fit: FeatureFit, points: np.ndarray, nominal: Feature, alignment: RigidSpread | None = None
) -> Quantity:
    """Position, mm: the diameter of the zone about the ``nominal`` place that holds a sphere's centre or a cylinder's
    axis over its region, or the width of the zone that holds a plane.

    ``points`` (n, 3) mm of the region, like the ``nominal`` in part coordinates, as ``fit``.
    """
    if fit.feature.kind != nominal.kind:
        raise InputError(f"The feature is a {fit.feature.kind}, its nominal a {nominal.kind}: choose one kind.")
    points = points[np.isfinite(points).all(axis=1)]
    f = fit.feature
    if f.direction is None:
        reached = np.zeros((1, 3))
    elif f.kind == "cylinder":
        lengths = (points - f.place) @ f.direction
        reached = np.array([lengths.min(), lengths.max()])[:, None] * f.direction
    else:
        reached = points[:: -(-len(points) // 200)] - f.place
    rng = np.random.default_rng(2)
    moves = None if alignment is None else alignment.draw(rng)
    steps = draw_steps(fit.spread.covariance, rng)

    def off(feature: Feature, moved: np.ndarray | float) -> float:
        """Twice how far a feature, moved by (k, 3), is off its nominal."""
        if feature.direction is None:
            return 2 * float(np.linalg.norm(feature.place + moved - nominal.place))
        normal_or_axis = _direction_of(nominal)
        if feature.kind == "cylinder":
            ends = feature.place + (reached @ _direction_of(f))[:, None] * _direction_of(feature) + moved
            offsets = ends - nominal.place
            return 2 * float(
                np.linalg.norm(offsets - (offsets @ normal_or_axis)[:, None] * normal_or_axis, axis=1).max()
            )
        # the plane's points under the measured ones
        heights = reached - (reached @ _direction_of(feature))[:, None] * _direction_of(feature)
        return 2 * float(np.abs((feature.place + heights + moved - nominal.place) @ normal_or_axis).max())

    shifts = np.zeros((DRAWS, len(reached), 3)) if moves is None else moves(f.place + reached)
    drawn = np.array([off(f.moved(step), shift) for step, shift in zip(steps, shifts, strict=True)])
    return _correct_for_noise("position", off(f, 0.0), drawn, 0.0, fit.spread.shared is not None)


def profile_error(
    points: np.ndarray,
    deviations: np.ndarray,
    normals: np.ndarray,
    alignment: RigidSpread | None = None,
    shared: Shared | None = None,
) -> Quantity:
    """Profile of a surface, mm: twice the largest deviation (n,) mm of points (n, 3) from the nominal, whose normals
    (n, 3) are given; NaN for points that do not belong to it. Raises InputError for too few points."""
    counted = np.isfinite(deviations) & np.isfinite(normals).all(axis=1)
    points, deviations, normals = (np.asarray(each[counted], np.float64) for each in (points, deviations, normals))
    if not len(points):
        raise InputError("No point of the region belongs to the nominal: select a region on it.")
    coordinates = _region_coordinates(points, axes=3)
    smooth = smooth_deviations(deviations, points, normals, coordinates, np.zeros((len(points), 0)))
    moves = None if alignment is None else alignment.draw(np.random.default_rng(3))

    def displaced(places: np.ndarray) -> np.ndarray:
        """Changes of the deviations (n, draws) by the draws of the alignment."""
        assert moves is not None
        nearest = _nearest_rows(smooth.points, places)
        return np.einsum("bni,ni->nb", moves(places), smooth.normals[nearest])

    return zone_width(
        "profile",
        smooth,
        lambda d: 2 * np.abs(d).max(axis=0),
        shared,
        None if moves is None else displaced,
    )


def _correct_for_noise(
    name: str, value: float, drawn: np.ndarray, variance: float, whole: bool, wider: np.ndarray | None = None
) -> Quantity:
    """Return a width (mm) less what noise adds to it, with that and the spread of the draws in U.

    The measured width holds noise once, the ``drawn`` ones (draws,) twice, and ``wider`` three times in variance: these
    are extrapolated to none (SIMEX, Cook and Stefanski 1994), by a line without ``wider``, else by a parabola.
    """
    added = float(drawn.mean() - value)
    if wider is not None:
        added = max(added, float(3 * drawn.mean() - 2 * value - wider.mean()))
    added = min(added, value)
    # where the form is no larger than what noise adds, all of it may be noise
    share = min(max(1 / 3, abs(added) / max(value - added, 1e-12)), 0.7)
    sigma = float(np.sqrt(drawn.var() + share * added**2 + variance))
    return Quantity(name, max(value - added, 0.0), "mm", sigma, whole)


def _axis_orientation(
    kind: OrientationKind, fit: FeatureFit, points: np.ndarray, datum: FeatureFit, along: bool
) -> Quantity:
    """The orientation of a cylinder's axis over its region to a datum: the diameter of its zone where both directions
    should agree (``along``), else its width."""
    f, d = fit.feature, datum.feature
    length = float(np.ptp((points - f.place) @ _direction_of(f)))

    def off(feature: Feature, reference: Feature) -> float:
        """How far the axis' ends lie apart across the requested direction."""
        axis, direction = _direction_of(feature), _direction_of(reference)
        return length * float(np.linalg.norm(np.cross(axis, direction)) if along else abs(axis @ direction))

    steps = draw_steps(joint_covariance(fit.spread, datum.spread), np.random.default_rng(4))
    p = f.parameters
    drawn = np.array([off(f.moved(step[:p]), d.moved(step[p:])) for step in steps])
    whole = fit.spread.shared is not None and datum.spread.shared is not None
    return _correct_for_noise(kind, off(f, d), drawn, 0.0, whole)


def _smooth_basis(coordinates: np.ndarray, fitted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal columns (n, q) of what was fitted, and (n, r) of the polynomials without that."""
    powers = [e for e in product(range(DEGREE + 1), repeat=coordinates.shape[1]) if sum(e) <= DEGREE]
    terms = np.stack([np.prod(coordinates ** np.array(e), axis=1) for e in powers], axis=1)
    removed = _span(fitted / np.maximum(np.linalg.norm(fitted, axis=0), 1e-300))
    return removed, _span(terms - removed @ (removed.T @ terms))


def _span(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns (n, r) that span those given, without directions that rounding alone distinguishes."""
    if not columns.shape[1]:
        return columns
    vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(vectors[:, values > SPAN_RATIO * max(values[0], 1e-300)])


def _patch_misfit(
    residuals: np.ndarray, coordinates: np.ndarray, noise: float, n: int, columns: int
) -> tuple[float, float]:
    """How many times larger than independent ones the patches' mean residuals are (at least 1), and by how much (mm)
    some lie off what noise explains."""
    low = coordinates.min(axis=0)
    side = max(float(np.ptp(coordinates, axis=0).max()) / PATCHES, 1e-12)
    padded = np.zeros((len(coordinates), 3))
    padded[:, : coordinates.shape[1]] = coordinates - low
    cubes, patch = occupied_cubes(padded, side)
    counts = np.bincount(patch, minlength=len(cubes))
    means = np.bincount(patch, residuals, len(cubes)) / np.maximum(counts, 1)
    large = counts >= POINTS_PER_TERM
    expected = noise / np.sqrt(np.maximum(counts, 1))
    if not large.any() or not noise > 0:
        return 1.0, 0.0
    # the smooth part takes its share of the patches' freedom
    freedom = max(1 - columns / max(int(large.sum()), 1), 0.25)
    factor = float(np.sqrt(max(float(np.mean((means[large] / expected[large]) ** 2)) / freedom, 1.0)))
    beyond = np.abs(means[large]) - PATCH_SIGMA * expected[large]
    worst = int(np.argmax(beyond))
    # a defect seldom fills its patch
    return factor, 2 * float(np.abs(means[large])[worst]) if beyond[worst] > 0 else 0.0


def _region_coordinates(points: np.ndarray, axes: int = 2) -> np.ndarray:
    """Coordinates (n, axes) of points along their principal axes, in -1 to 1."""
    offsets = points - points.mean(axis=0)
    _, directions = np.linalg.eigh(offsets.T @ offsets)
    along = offsets @ directions[:, ::-1][:, :axes]
    low, high = along.min(axis=0), along.max(axis=0)
    return np.asarray((2 * along - low - high) / max(float((high - low).max()), 1e-12))


def _cylinder_coordinates(f: Feature, points: np.ndarray) -> np.ndarray:
    """Cosine and sine of the angle about the axis, and the place along it in -1 to 1: (n, 3)."""
    normals, axis = f.normals(points), _direction_of(f)
    first = np.linalg.svd(axis[None])[2][1]
    along = (points - f.place) @ axis
    middle, half = (along.max() + along.min()) / 2, max(float(np.ptp(along)) / 2, 1e-12)
    return np.column_stack([normals @ first, normals @ np.cross(axis, first), (along - middle) / half])


def _section_points(f: Feature, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points of the section whose roundness is measured, and its normal (3,)."""
    if f.kind == "cylinder":
        axis = _direction_of(f)
        along = (points - f.place) @ axis
        middle, reach = (along.max() + along.min()) / 2, SECTION_SHARE * float(np.ptp(along)) / 2
        return points[np.abs(along - middle) <= reach], axis
    towards = points.mean(axis=0) - f.place
    axis = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    axis /= np.linalg.norm(axis)
    return points[np.abs((points - f.place) @ axis) <= SECTION_SHARE * (f.radius or 0.0)], axis


def _nearest_rows(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The rows (m,) of ``points`` (n, 3) nearest to places (m, 3)."""
    return np.asarray(cKDTree(points).query(places)[1])


def _direction_of(f: Feature) -> np.ndarray:
    """The feature's direction (3,); InputError where it has none."""
    if f.direction is None:
        raise InputError(f"A {f.kind} has no direction: choose a plane or a cylinder.")
    return f.direction
