"""Planes, spheres and cylinders fitted to a selected region, with their uncertainty, or refused
where none fits; robust starts by the least median of squares over small samples; and the 3-2-1
alignment of a part by three such features."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.optimize
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.evaluation.acceptance import narrowest_range
from slviewer.evaluation.fit import MAX_SIGMA, fit_settled
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import Floats, Uncertainty, move_points, rigid_transform
from slviewer.geometry.robust import fit_reweighted, robust_sigma
from slviewer.geometry.shapes import fit_plane, fit_sphere
from slviewer.geometry.vectors import (
    diagonal,
    finite_rows,
    lengths,
    patch_means,
    rms,
    subsample,
    unit_vectors,
)
from slviewer.inspection.features import Feature, Kind, perpendicular_axes
from slviewer.inspection.membership import MIN_PARALLEL, Membership, find_members
from slviewer.inspection.regions import Region
from slviewer.inspection.uncertainty import PointErrors, Spread, scatter_covariance
from slviewer.reconstruction.axis_agreement import RAISED_RATIO
from slviewer.reconstruction.rig_change import bound_change
from slviewer.records.measurement import Quantity
from slviewer.records.verification import MAX_EXCLUDED

SAMPLE = 1000
HYPOTHESES = 400
POLISHED = 5
NEIGHBOURS = (12, 60)
NEAR = 2.5
"""Robust standard deviations: what lies nearer belongs to a hypothesis."""


def estimate_start(kind: Kind, points: Floats) -> Feature:
    """Estimate the shape that is closest to at least half of the points (n, 3); the same points
    give the same result.

    Raises InputError, the last one's, where no sample holds a shape.
    """
    rng = np.random.default_rng(0)
    sample = points[rng.choice(len(points), min(SAMPLE, len(points)), replace=False)]
    normals = local_normals(sample, points) if kind == "cylinder" else None
    # samples of the whole region show its curvature; noise would hide it from neighbours
    rated: list[tuple[float, Feature]] = []
    for _ in range(HYPOTHESES if kind != "plane" else HYPOTHESES // 4):
        try:
            candidate = _fit_sample(kind, sample, normals, rng)
        except (InputError, np.linalg.LinAlgError):
            continue
        rated.append((_robust_distance(candidate, sample), candidate))
    refused = InputError(
        f"No {kind} passes through the {len(points)} points: select another region."
    )
    polished: list[tuple[float, Feature]] = []
    for sigma, candidate in sorted(rated, key=lambda each: each[0])[:POLISHED]:
        try:
            for _ in range(3):
                near = np.abs(candidate.distance(sample)) <= NEAR * sigma + 1e-9
                candidate = least_squares(kind, sample[near], candidate)
                sigma = _robust_distance(candidate, sample)
        except InputError as error:
            refused = error
            continue
        polished.append((sigma, candidate))
    if not polished:
        raise refused
    return min(polished, key=lambda each: each[0])[1]


def local_normals(sample: np.ndarray, points: np.ndarray) -> Floats:
    """(m, 3): unit normals at ``sample`` (m, 3), of either sign, from neighbours among ``points``
    (n, 3): about a tenth of the region across, so that the noise of a point does not tilt them."""
    thin = points[:: max(1, len(points) // 6000)]
    count = int(np.clip(len(thin) // 100, *NEIGHBOURS))
    _, near = cKDTree(thin).query(sample, k=min(count, len(thin)))
    patches = thin[near]
    patches = patches - patches.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))[1][:, :, 0]


def _fit_sample(
    kind: Kind, sample: Floats, normals: Floats | None, rng: np.random.Generator
) -> Feature:
    """Return the shape through a minimal sample of points; LinAlgError where they do not determine
    it.

    The axis of a cylinder is perpendicular to two normals (Gauss map), and the circle through three
    points, projected along it, gives the rest.
    """
    chosen = rng.integers(0, len(sample), 4 if kind == "sphere" else 3)
    if kind == "plane":
        return fit_plane_feature(sample[chosen])
    frame, axis, flattest = np.eye(3), None, 1e-9
    if normals is not None:
        axis = np.cross(*normals[chosen[:2]])
        length = np.linalg.norm(axis)
        if length < 0.05:
            raise np.linalg.LinAlgError("The normals are parallel.")
        axis /= length
        frame, flattest = perpendicular_axes(axis), 1e-6
    points = sample[chosen] @ frame.T
    edges = points[1:] - points[0]
    if abs(np.linalg.det(edges)) <= flattest * lengths(edges).prod():
        raise np.linalg.LinAlgError("The points are flat.")
    offset = np.linalg.solve(2.0 * edges, (edges**2).sum(axis=1))
    return Feature(kind, (points[0] + offset) @ frame, axis, float(np.linalg.norm(offset)))


def _robust_distance(feature: Feature, points: Floats) -> float:
    """Return the robust standard deviation in mm of points (n, 3) about a feature."""
    return robust_sigma(feature.distance(points), about=0.0)


def fit_plane_feature(points: Floats) -> Feature:
    """Return the least-squares plane of points (n, 3); its place is their centroid."""
    plane = fit_plane(points)
    middle = points.mean(axis=0)
    return Feature("plane", middle - plane.distance(middle) * plane.normal, plane.normal)


LEAST_POINTS = 50
MAX_FITTED_POINTS = 20_000
"""Points that a fit looks at: more of them change it by less than what it cannot know anyway."""
MAX_SHARED_POINTS = 400
MAX_COMPARED_POINTS = 2_000
NO_ERRORS = PointErrors()
MAX_EXCLUDED_SHARE = 0.4
"""Share of a region that may lie off the shape; beyond it the region holds something else."""
MAX_RMS_RISE = 0.005
"""Distance from a plane (1 sigma), as a share of the region's size, from which on a region that
bends is not a plane."""
RIVAL_RATIO = 2.0
"""Another shape must leave this many times less before a region is said to hold that one
instead."""
MAX_RADIUS_RATIO = 100.0
"""Times the region's size: a cylinder of a larger radius is a plane."""
MAX_RADIUS_SIGMA = 0.1
"""Largest standard deviation of a radius, as a share of it."""


@dataclass(frozen=True, eq=False)
class FeatureFit:
    """A fitted feature and its residuals, mm.

    ``points`` (n, 3): those that belong to it; ``rms`` and ``maximum`` (signed, the one farthest
    off) are of these; ``form``: width of the narrowest range that holds 95 % of their deviations.
    ``excluded`` counts the other points of the region, and ``excluded_as`` tells what they are;
    ``warnings``: sentences.
    """

    feature: Feature
    spread: Spread
    rms: float
    maximum: float
    form: float
    points: Floats
    excluded: int
    excluded_as: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def used(self) -> int:
        """Number of the points that belong to the feature."""
        return len(self.points)

    def quantities(self) -> list[Quantity]:
        """Return radius, diameter, form error and residuals of the feature, with uncertainties
        where known."""
        listed = [
            Quantity("form (95 %)", self.form, "mm"),
            Quantity("RMS", self.rms, "mm"),
            Quantity("farthest off", self.maximum, "mm"),
        ]
        radius = self.feature.radius
        if radius is None:
            return listed
        # of a fit with a radius the last parameter
        sigma, known = float(self.spread.sigmas[-1]), self.spread.whole
        size = [
            Quantity(name, times * radius, "mm", times * sigma, known)
            for name, times in (("radius", 1), ("diameter", 2))
        ]
        return size + listed


def fit_feature(
    kind: Kind,
    points: np.ndarray,
    errors: PointErrors = NO_ERRORS,
    region: Region | None = None,
    camera: Floats | None = None,
) -> FeatureFit:
    """The shape of a region's points (n, 3) mm, by least squares of the distances, without those
    that lie beside it or are isolated.

    ``errors``: of the points; changes of the rig are part of the uncertainty where the axes of the
    scan, or the residuals, show more than is predicted. What deviates over the shape's own area is
    part of it too: by as much as it would move the fit. ``region``: of its points, where there are
    others around it: those beyond it that lie over its part of the shape deviate from that.
    ``camera`` (3,) mm: as in `find_members`. Raises InputError where the region does not hold the
    shape.
    """
    points = np.asarray(points, np.float64)
    points = points[finite_rows(points)]
    inside = np.ones(len(points), bool) if region is None else region.within(points)
    around, points = points[~inside], points[inside]
    if len(points) < LEAST_POINTS:
        raise InputError(
            f"The region holds {len(points)} measured points: a {kind} needs {LEAST_POINTS}; see"
            " that the part has it there, and scan it again or merge scans that show more of it."
        )
    if kind == "point":
        raise InputError("A point is picked, not fitted: fit a plane, a sphere or a cylinder.")
    sampled = subsample(points, MAX_FITTED_POINTS)
    try:
        feature, inliers = _fit_robustly(kind, sampled)
    except InputError as error:
        raise _describe_alternative(kind, sampled, error) from error
    every = np.vstack([points, around])
    if inliers.all() and not len(around):
        basis, membership = sampled, None
    else:
        normals = local_normals(every, every)
        feature, basis = _refit_parallel(kind, feature, sampled[inliers], points, normals)
        reach = max(MAX_SIGMA * robust_sigma(feature.distance(basis)), 1e-9 * np.abs(every).max())
        over = np.ones(len(every), bool)
        if region is not None:
            feet = every - feature.distance(every)[:, None] * feature.normals(every)
            over = region.within(feet)
            over[: len(points)] = True
        every, normals = every[over], normals[over]
        is_near = np.abs(feature.distance(every)) <= reach
        is_near[len(points) :] = False
        inside = np.arange(len(every)) < len(points)
        membership = find_members(feature, every, normals, is_near, inside, camera)
    return _describe_fit(feature, basis, every, len(points), membership, errors)


def _refit_parallel(
    kind: Kind, feature: Feature, inliers: Floats, points: Floats, normals: Floats
) -> tuple[Feature, Floats]:
    """Fit a feature again to the points (n, 3) of a region whose ``normals`` are about its own;
    also returns the points that it was fitted to. What meets it at an edge otherwise biases it."""
    own = normals[: len(points)]
    parallel = points[np.abs(np.sum(own * feature.normals(points), axis=1)) > MIN_PARALLEL]
    if len(parallel) < max(LEAST_POINTS, (1 - MAX_EXCLUDED_SHARE) * len(inliers)):
        return feature, inliers
    parallel = subsample(parallel, MAX_FITTED_POINTS)
    try:
        feature, used = fit_settled(partial(least_squares, kind), parallel, feature)
    except (InputError, np.linalg.LinAlgError):
        return feature, inliers
    return feature, parallel[used]


def _describe_fit(
    feature: Feature,
    basis: Floats,
    every: Floats,
    count: int,
    membership: Membership | None,
    errors: PointErrors,
) -> FeatureFit:
    """The fit of a feature to the points ``basis`` (m, 3), with its uncertainty. ``every`` (n, 3):
    points that may belong to it, the first ``count`` of which lie in its region."""
    kind, belongs = feature.kind, np.ones(len(every), bool)
    if membership is not None:
        belongs = membership.belongs
    excluded = count - int(np.count_nonzero(belongs[:count]))
    if excluded > MAX_EXCLUDED_SHARE * count:
        raise InputError(
            f"{100 * excluded / count:.0f} % of the region lies off the best {kind}: "
            "select a region that shows nothing else."
        )
    _refuse_other(kind, feature, basis)
    spread, warnings = _estimate_spread(feature, basis, errors), list[str]()
    if found := _find_misfit(feature, basis, errors):
        warnings.append(found[0])
        spread = replace(spread, scatter=spread.scatter + found[1])
    residuals = feature.distance(every)
    reason, deviating = "", 0
    if membership is not None:
        deviating = int(np.count_nonzero(membership.deviates))
        reason = replace(
            membership,
            isolated=membership.isolated[:count],
            beside=membership.beside[:count],
        ).describe_excluded()
    if membership is not None and (deviating or membership.doubtful.any()):
        # least squares of these points too would take these steps; apart by sides, as what is
        # taken for the feature's own by mistake must not balance what is
        far, J = membership.deviates | membership.doubtful, feature.jacobian(every)
        near = belongs & ~far
        sides = [near | (far & (side * residuals > 0)) for side in (1, -1)]
        steps = np.array([np.linalg.lstsq(J[k], -residuals[k], rcond=None)[0] for k in sides])
        spread = replace(spread, scatter=spread.scatter + steps.T @ steps, form=steps)
    if deviating:
        farthest = float(np.abs(residuals[membership.deviates]).max())  # type: ignore[union-attr]
        warnings.append(
            f"{100 * deviating / len(every):.2g} % of the points lie off the {kind}, over its own"
            f" area, by up to {farthest:.3g} mm: they count as its form, and U allows for them"
        )
    sigma = spread.sigmas[-1]
    if feature.radius is not None and not sigma <= MAX_RADIUS_SIGMA * feature.radius:
        raise InputError(
            f"The radius of the {kind} is only known as {feature.radius:.3g} ± {sigma:.2g} mm: the"
            " region shows too little of its curve; scan more of it."
        )
    if excluded > MAX_EXCLUDED * count:
        warnings.append(
            f"{100 * excluded / count:.1f} % of the region's points were excluded ({reason}): see"
            " that it shows nothing else"
        )
    fitted = residuals[belongs]
    farthest, form = float(fitted[np.argmax(np.abs(fitted))]), narrowest_range(fitted, 0.95)
    return FeatureFit(
        feature,
        spread,
        rms(fitted),
        farthest,
        form,
        every[belongs],
        excluded,
        reason,
        tuple(warnings),
    )


def least_squares(kind: Kind, points: Floats, start: Feature | None) -> Feature:
    """The shape of least squared distances from points (n, 3); a cylinder needs a ``start``."""
    if kind == "plane":
        return fit_plane_feature(points)
    if kind == "sphere":
        sphere = fit_sphere(points)
        return Feature("sphere", sphere.centre, None, sphere.radius)
    assert start is not None
    return _fit_cylinder(start, points)


def _fit_robustly(kind: Kind, points: np.ndarray) -> tuple[Feature, np.ndarray]:
    """The feature, and which of the points it was fitted to: repeated until the set is stable."""
    return fit_settled(partial(least_squares, kind), points, estimate_start(kind, points))


def _fit_cylinder(start: Feature, points: Floats) -> Feature:
    """The least-squares cylinder near a start; its place is next to the middle of the points.
    Raises InputError where the radius diverges: the points are flat."""
    solution = scipy.optimize.least_squares(
        lambda step: start.moved(step).distance(points),
        np.zeros(start.parameters),
        method="lm",
        max_nfev=600,
    )
    feature = start.moved(solution.x)
    if not 0 < (feature.radius or 0.0) < MAX_RADIUS_RATIO * diagonal(points):
        raise InputError(
            "No cylinder fits: its radius diverges; select a region that shows more of its curve."
        )
    axis = feature.unit_direction
    along = axis * np.sign(axis[np.argmax(np.abs(axis))])
    middle = feature.place + ((points.mean(axis=0) - feature.place) @ along) * along
    return Feature("cylinder", middle, along, feature.radius)


def _estimate_spread(feature: Feature, points: Floats, errors: PointErrors) -> Spread:
    """Estimate the covariance of a fitted feature: own scatter, and the errors shared through the
    calibration."""
    J = feature.jacobian(points)
    own = scatter_covariance(points, J, feature.distance(points))
    if (shared := errors.raised) is None:
        return Spread(own)
    some = subsample(points, MAX_SHARED_POINTS)
    J = feature.jacobian(some)
    # a displacement of the points changes each distance by its part along the normal, and the fit
    # makes up for it
    answers = -np.linalg.pinv(J)[:, :, None] * feature.normals(some)[None]
    return Spread(own, shared(some, answers), errors.calibration)


def _find_misfit(
    feature: Feature, points: Floats, errors: PointErrors
) -> tuple[str, Floats] | None:
    """Compare the residuals of a fit, in the mean of patches, with what noise and calibration
    predict; where they are far above, return a warning, and what a change of the rig that would
    explain them adds to the covariance of the parameters (p, p)."""
    middles, means, noise = patch_means(points, feature.distance(points))
    response, shared = errors.response, errors.shared
    if response is None or not errors.is_predicted or len(means) <= feature.parameters:
        return None
    some = subsample(points, MAX_SHARED_POINTS)
    places = np.vstack([middles, some])
    normals, J = feature.normals(places), feature.jacobian(places)
    m = len(middles)
    # the fit makes up for part of the displacements along the normals, as in `_estimate_spread`
    answers = np.zeros((feature.parameters, len(places), 3))
    answers[:, m:] = -np.linalg.pinv(J[m:])[:, :, None] * normals[m:]
    remaining = np.einsum("mp,pni->mni", J[:m], answers)
    remaining[np.arange(m), np.arange(m)] += normals[:m]
    by_px = response.residual_px * np.sum(normals[:m] * response.by_px(middles), axis=1)
    variance = noise**2 + by_px**2
    if shared is not None:
        variance += np.sum(shared(places, remaining) ** 2, axis=0)
    observed, predicted = rms(means), float(np.sqrt(variance.mean()))
    if not observed > RAISED_RATIO * predicted:
        return None
    by_change = response.by_change(places)
    effects = np.einsum("mni,nik->mk", remaining, by_change)
    change = bound_change(effects, means, np.sqrt(variance))
    added = change[:, None] * np.einsum("pni,nik->kp", answers, by_change)
    return (
        f"the {feature.kind} fits {observed / predicted:.0f} times worse than noise and calibration"
        f" predict: points lie {observed:.2g} mm off it in the mean of patches (predicted"
        f" {predicted:.2g} mm). Focus, zoom, aperture or a device has changed since the"
        " calibration, or the part has this form; U allows for both. To tell, check the calibration"
        " with a new pose of its board (`slviewer check`): where it no longer fits, calibrate"
        " again; where it does, this is the part's form or light by other paths",
        added.T @ added,
    )


def _refuse_other(kind: Kind, feature: Feature, points: Floats) -> None:
    """Raise InputError where the region plainly holds something else than the requested shape."""
    some = subsample(points, MAX_COMPARED_POINTS)
    mine = robust_sigma(feature.distance(some))
    if kind == "plane":
        size = diagonal(some)
        if mine > MAX_RMS_RISE * size and mine > RIVAL_RATIO * _residual_from_quadric(
            feature, some
        ):
            raise InputError(
                f"The region bends: it rises {mine:.3g} mm off its best plane over {size:.3g} mm;"
                " fit a sphere or a cylinder, or select a flatter region."
            )
        return
    other, rival, flat = _fit_rivals(kind, some)
    if rival * RIVAL_RATIO < mine and rival * RIVAL_RATIO < flat:
        raise InputError(
            f"The region is no {kind}: points lie {mine:.3g} mm off it, and {rival:.3g} mm off a"
            f" {other} (1 sigma); fit a {other}, or select another region."
        )
    if not flat > RIVAL_RATIO * mine:
        raise InputError(
            f"The region is nearly flat: points lie {flat:.3g} mm off a plane, and {mine:.3g} mm"
            f" off the {kind} (1 sigma); fit a plane, or select more of the {kind}'s curve."
        )


def _describe_alternative(kind: Kind, points: Floats, error: InputError) -> InputError:
    """Describe which other shape the region holds where the requested one could not be fitted at
    all."""
    other, rival, flat = _fit_rivals(kind, subsample(points, MAX_COMPARED_POINTS))
    best, residual = (other, rival) if rival * RIVAL_RATIO < flat else ("plane", flat)
    if not np.isfinite(residual):
        return error
    return InputError(
        f"The region holds no {kind}, rather a {best}: points lie {residual:.3g} mm off that (1"
        f" sigma); fit a {best}, or select more of the {kind}'s curve."
    )


def _fit_rivals(kind: Kind, points: Floats) -> tuple[Kind, float, float]:
    """Return the other curved shape that points may have, and their `_residual_of` it and of a
    plane."""
    other: Kind = "cylinder" if kind == "sphere" else "sphere"
    return other, _residual_of(other, points), _residual_of("plane", points)


def _residual_of(kind: Kind, points: Floats) -> float:
    """Return the robust sigma in mm of the points' distances from another shape; infinite where it
    does not fit at all."""
    try:
        return robust_sigma(_fit_robustly(kind, points)[0].distance(points))
    except (InputError, np.linalg.LinAlgError):
        return float("inf")


def _residual_from_quadric(plane: Feature, points: Floats) -> float:
    """Return the robust sigma in mm about the quadratic surface over a plane: curvature removed,
    noise remains."""
    offsets = points - points.mean(axis=0)
    basis = monomials(offsets @ perpendicular_axes(plane.unit_direction).T, 2)
    heights = plane.distance(points)

    def solve(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the heights (n,) mm of the weighted quadratic fit, as solution and as fitted
        values."""
        root = np.sqrt(weights)
        fitted = basis @ np.linalg.lstsq(basis * root[:, None], heights * root, rcond=None)[0]
        return fitted, fitted

    return robust_sigma(heights - fit_reweighted(solve, heights, np.ones(len(heights))))


MIN_SINE = 0.17
"""Of the angle between directions that fix a frame: at 10 degrees they hardly do."""


def datum_frame(features: Sequence[Feature]) -> Floats:
    """T_part_measured (4, 4) of three datums: the primary, a plane, is z = 0 with z along its
    normal.

    The secondary is a plane (x = 0, x along its normal), and then the tertiary a plane (y = 0) or a
    sphere or cylinder (y = 0 through its place); or both are spheres or cylinders, and x runs from
    the secondary's place, the origin, to the tertiary's. Raises InputError for others, or where
    they do not fix a frame.
    """
    primary, secondary, tertiary = features
    if primary.kind != "plane":
        raise InputError(f"The primary datum is a {primary.kind}: choose a plane.")
    z = primary.unit_direction
    if secondary.kind == "plane":
        towards = secondary.unit_direction
    elif tertiary.kind != "plane":
        towards = tertiary.place - secondary.place
    else:
        raise InputError(
            "The secondary datum is not a plane, but the tertiary is one: exchange them."
        )
    across = towards - (towards @ z) * z
    if not np.linalg.norm(across) > MIN_SINE * np.linalg.norm(towards):
        raise InputError("The secondary datum fixes no direction in the primary: choose another.")
    x = unit_vectors(across)
    y = np.cross(z, x)
    # rows n and values n . p of the planes through the origin of the part
    if secondary.kind == "plane":
        rows = [z, towards, tertiary.unit_direction if tertiary.kind == "plane" else y]
        places = [primary.place, secondary.place, tertiary.place]
    else:
        rows, places = [z, x, y], [primary.place, secondary.place, secondary.place]
    matrix = np.array(rows)
    if not abs(float(np.linalg.det(matrix))) > MIN_SINE:
        raise InputError("The three datums fix no origin: choose planes that meet in one point.")
    origin = np.linalg.solve(matrix, [row @ place for row, place in zip(rows, places, strict=True)])
    R = np.array([x, y, z])
    return rigid_transform(R, -R @ origin)


def datum_spread(fits: Sequence[FeatureFit], middle: Floats) -> Uncertainty:
    """Covariance of the part coordinates of `datum_frame`, about ``middle`` (3,) mm in part
    coordinates; the errors of the datums are taken as independent of each other."""
    features = [fit.feature for fit in fits]
    T = datum_frame(features)
    back = np.linalg.inv(T)
    covariance, noise = np.zeros((2, 6, 6))
    for k, fit in enumerate(fits):
        columns = []
        for each in np.eye(fit.feature.parameters):
            step = 1e-6
            moved = (
                datum_frame([*features[:k], features[k].moved(step * each), *features[k + 1 :]])
                @ back
            )
            shift = move_points(moved, middle[None])[0] - middle
            turn = moved[[2, 0, 1], [1, 2, 0]] - moved[[1, 2, 0], [2, 0, 1]]
            columns.append(np.concatenate([turn / 2, shift]) / step)
        J = np.array(columns).T
        covariance += J @ fit.spread.covariance @ J.T
        noise += J @ fit.spread.noise.covariance @ J.T
    return Uncertainty(covariance, middle, noise)


def face_towards(fit: FeatureFit, side: Floats) -> FeatureFit:
    """The fit with a plane's normal turned to the half-space of a direction ``side`` (3,); others
    unchanged."""
    f = fit.feature
    if f.kind != "plane" or f.unit_direction @ side >= 0:
        return fit
    # the second tangent stays, the first and the normal are reversed
    sign = np.array([1.0, -1.0, -1.0])
    spread = fit.spread
    shared = None if spread.shared is None else spread.shared * sign
    form = None if spread.form is None else spread.form * sign
    scatter = spread.scatter * np.outer(sign, sign)
    turned = replace(spread, scatter=scatter, shared=shared, form=form)
    return replace(fit, feature=replace(f, direction=-f.unit_direction), spread=turned)
