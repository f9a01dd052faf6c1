"""Planes and spheres in one organised cloud: which pixels show them, their least-squares fits, the
residuals, and those that noise alone would cause; and calibrations side by side: the same capture,
the same pixels, each model's own fit.

RANSAC says where the shape is; the largest patch of connected pixels within a tolerance says how
far it reaches. The tolerance is many times wider than any form error worth measuring, so that
finding the shape never flatters it: what is wrong by less stays in, and what is wrong by more,
inside the patch, stays in too, to be counted as excluded. Where a cloud is noisier than that (Gray
code alone), the tolerances follow its expected noise.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
import scipy

from slviewer.errors import InputError
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.shapes import (
    Plane,
    Sphere,
    fit_plane,
    fit_sphere,
    ransac_plane,
    ransac_sphere,
)
from slviewer.geometry.vectors import (
    finite_rows,
    lengths,
    patch_means,
    rms,
    subsample,
    unit_vectors,
)
from slviewer.reconstruction.axis_agreement import RAISED_RATIO
from slviewer.reconstruction.cloud import Cloud, Map, Points
from slviewer.records.record import to_vector
from slviewer.records.verification import MAX_EXCLUDED, ModelFit, Shape, Verification

MAX_SIGMA = 5.0
LEAST_POINTS = 100
RANSAC_TOLERANCE = 0.003  # of the field's diagonal, or twice the noise
PATCH_TOLERANCE = 0.009  # or six times the noise
SPHERE_TOLERANCE = 0.04  # of its radius, where that is known or less than the patch's
RIM_PX = 2  # mixed pixels at an object's outline show neither the object nor what is behind it
LEAST_PIXELS = 200
_SAMPLE = 40_000


@dataclass(frozen=True, eq=False)
class ShapeResult:
    """Distances of a cloud from its own best plane or sphere, the ``shape``.

    ``points`` pixels were evaluated; of these ``excluded`` lie beyond 5 robust sigma and count
    neither in the fit nor in ``rms_mm``, the root mean square of the perpendicular (radial)
    distances. ``noise_floor_mm`` is what that would be from the cloud's expected noise alone, over
    the same pixels; NaN where none is known. ``error_map`` ``(h, w)`` float32, mm, NaN where
    nothing was evaluated, holds every distance, those excluded too: positive towards the camera for
    a plane (Letter eq. 12), outwards for a sphere, whose radius is free. ``inliers`` ``(h, w)``
    bool says which pixels counted.
    """

    shape: Plane | Sphere
    rms_mm: float
    noise_floor_mm: float
    points: int
    excluded: int
    error_map: Map
    inliers: Map

    @property
    def plane(self) -> Plane:
        """The fitted plane."""
        assert isinstance(self.shape, Plane)
        return self.shape

    @property
    def sphere(self) -> Sphere:
        """The fitted sphere."""
        assert isinstance(self.shape, Sphere)
        return self.shape

    @property
    def radius_mm(self) -> float:
        """Radius of the fitted sphere."""
        return self.sphere.radius

    @property
    def excluded_share(self) -> float:
        """Share of the points that were excluded as outliers."""
        return self.excluded / self.points

    @property
    def warning(self) -> str | None:
        """A warning if so many points were excluded that the RMS is not representative of the
        shape."""
        if self.excluded_share <= MAX_EXCLUDED:
            return None
        return (
            f"{100 * self.excluded_share:.1f} % of the points are outliers, beyond {MAX_SIGMA:g}"
            " robust standard deviations, and not part of the RMS: look at the error map before"
            " you trust it."
        )


def finite_or_none(value: float) -> float | None:
    """Return the value, or None for NaN and infinity."""
    return value if np.isfinite(value) else None


class FittedShape(Protocol):
    """A surface with distances from it."""

    def distance(self, points: Points) -> np.ndarray:
        """Signed distances (n,) mm of points (n, 3)."""


AnyShape = TypeVar("AnyShape", bound=FittedShape)


def fit_settled(
    fit: Callable[[np.ndarray, AnyShape], AnyShape], points: Points, start: AnyShape
) -> tuple[AnyShape, np.ndarray]:
    """Fit a shape to points (n, 3) mm, those beyond 5 robust sigma excluded, repeated until the set
    is stable.

    ``fit(points, shape)`` is a least-squares fit that may start from a shape. Returns the shape and
    which points were used, (n,) bool.
    """
    shape, inliers = start, np.zeros(len(points), dtype=bool)
    for _ in range(30):
        before, inliers = inliers, within_sigmas(shape.distance(points), points)
        if np.count_nonzero(inliers ^ before) <= 1e-5 * len(points):
            break
        shape = fit(points[inliers], shape)
    return shape, inliers


def within_sigmas(residuals: np.ndarray, points: Points) -> np.ndarray:
    """(n,) bool: the residuals (n,) mm within 5 robust sigma of their median.

    Sigma is that of *all* residuals, so that it does not shrink from round to round until only the
    best are left; of exact points it is nothing but rounding, which excludes none of them.
    """
    reach = max(MAX_SIGMA * robust_sigma(residuals), 1e-9 * float(np.abs(points).max()))
    return np.abs(residuals - np.median(residuals)) <= reach


def evaluate_plane(
    points: Points,
    mask: Map | None,
    sigma_z: Map | None = None,
    start: Plane | None = None,
) -> ShapeResult:
    """Fit a plane to a cloud ``(h, w, 3)`` mm, NaN where invalid, and measure the distances from
    it.

    ``mask`` ``(h, w)``: the pixels that show the plane; None: the largest flat patch is found.
    ``sigma_z`` ``(h, w)`` mm: the expected noise of z, for the noise floor. ``start``: about where
    the plane lies, if that is known.
    """
    return ShapeSearch("plane", points, sigma_z).evaluate(mask, start)


def evaluate_sphere(
    points: Points,
    mask: Map | None,
    sigma_z: Map | None = None,
    radius: float | None = None,
    start: Sphere | None = None,
) -> ShapeResult:
    """Fit a sphere to a cloud ``(h, w, 3)`` mm, NaN where invalid, and measure the radial distances
    from it.

    ``mask`` ``(h, w)``: the pixels that show the sphere; None: the largest round patch is found.
    ``sigma_z`` ``(h, w)`` mm: the expected noise of z. ``radius`` in mm, roughly, helps to find the
    sphere; the fitted radius stays free, as in the Letter's Table 2. ``start``: about where the
    sphere lies, if that is known.
    """
    return ShapeSearch("sphere", points, sigma_z, radius).evaluate(mask, start)


def evaluate_spheres(
    points: Points, count: int, sigma_z: Map | None = None, radius: float | None = None
) -> list[ShapeResult]:
    """The ``count`` spheres of one cloud, such as a ball bar's two, from left to right; otherwise
    as above."""
    search = ShapeSearch("sphere", points, sigma_z, radius)
    return [search.evaluate(region, start) for start, region in search.find_several(count)]


@dataclass(frozen=True, eq=False)
class ShapeSearch:
    """A plane or a sphere that is looked for in a cloud ``points`` ``(h, w, 3)`` mm, NaN where
    invalid.

    ``sigma_z`` ``(h, w)`` mm is the expected noise; ``radius`` in mm, roughly, narrows the search
    for a sphere.
    """

    shape: Shape
    points: Points
    sigma_z: Map | None = None
    radius: float | None = None

    def start(self, mask: Map) -> Plane | Sphere:
        """Estimate the shape that most points under ``mask`` agree with, by RANSAC."""
        measured = measured_pixels(self.points, mask)
        if self.radius is None:
            tolerance = RANSAC_TOLERANCE * self._field_mm
        else:
            tolerance = SPHERE_TOLERANCE / 2 * self.radius
        tolerance = max(tolerance, 2.0 * self._typical_noise(measured))
        some = _sample_points(self.points, measured)
        if self.shape == "plane":
            return ransac_plane(some, tolerance)[0]
        return ransac_sphere(some, tolerance, self.radius)[0]

    def find(
        self, mask: Map | None = None, start: Plane | Sphere | None = None
    ) -> tuple[Plane | Sphere, Map]:
        """Detect the shape with most pixels, and its region ``(h, w)`` bool.

        The region is one patch without its outermost two pixels; isolated pixels and small holes
        inside it belong to it, whether something was measured there or not. A roughly known shape
        to ``start`` from spares the search. The shape that comes back is a start for fits, not a
        result. Raises ``InputError`` where no such shape fills a patch.
        """
        points, measured = self.points, measured_pixels(self.points, mask)
        noise = self._typical_noise(measured)
        fitted = start or self.start(measured)
        patch, rim = np.zeros_like(measured), np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
        for _ in range(20):
            before, reach = patch, PATCH_TOLERANCE * self._field_mm
            if isinstance(fitted, Sphere):
                own = SPHERE_TOLERANCE * fitted.radius
                reach = own if self.radius is not None else min(reach, own)
            distances = fitted.distance(np.where(measured[..., None], points, 0.0))
            agreeing = measured & (np.abs(distances) < max(reach, 6.0 * noise))
            patch = _largest_patch(agreeing)
            # without the outermost pixels, where the patch ends inside the image
            region = cv2.erode(patch.astype(np.uint8), rim, borderValue=1).astype(bool)
            shown = np.count_nonzero(region & agreeing)
            if shown < LEAST_PIXELS or shown < 0.5 * np.count_nonzero(region & measured):
                raise InputError(
                    f"The largest {'flat' if self.shape == 'plane' else 'round'} patch has {shown}"
                    f" of {np.count_nonzero(measured)} measured pixels",
                    "check that the shape fills a good part of the view, and that the cloud is not"
                    " mere noise.",
                )
            if np.count_nonzero(patch ^ before) <= 1e-4 * np.count_nonzero(patch):
                break
            # alternately a patch of agreeing pixels and least squares over it
            fitted = _FITS[self.shape](_sample_points(points, patch & agreeing))
        return fitted, region

    def find_several(self, count: int) -> list[tuple[Plane | Sphere, Map]]:
        """``count`` shapes of one cloud and their regions, from left to right in the image."""
        free = measured_pixels(self.points, None)
        found = []
        for _ in range(count):
            found.append(self.find(free))
            free &= ~cv2.dilate(
                found[-1][1].astype(np.uint8), np.ones((4 * RIM_PX + 1,) * 2, np.uint8)
            ).astype(bool)
        return sorted(found, key=lambda each: float(np.nonzero(each[1])[1].mean()))

    def evaluate(self, mask: Map | None, start: Plane | Sphere | None = None) -> ShapeResult:
        """Fit the shape to the measured pixels under ``mask``, and evaluate the residuals; as
        `evaluate_sphere`."""
        points, sigma_z = self.points, self.sigma_z
        if mask is None:
            start, mask = self.find()
        start = start or self.start(mask)
        evaluated = mask & finite_rows(points)
        chosen = points[evaluated].astype(np.float64)
        if len(chosen) < LEAST_POINTS:
            raise InputError(
                f"{len(chosen)} points were measured in the region",
                f"at least {LEAST_POINTS} are needed.",
            )
        fitted, is_inlier = fit_settled(lambda some, _: _FITS[self.shape](some), chosen, start)
        residuals = fitted.distance(chosen)
        error_map = np.full(points.shape[:2], np.nan, dtype=np.float32)
        error_map[evaluated] = residuals
        inliers = np.zeros(points.shape[:2], dtype=bool)
        inliers[evaluated] = is_inlier
        floor = np.nan
        if sigma_z is not None:
            floor = noise_floor(fitted, chosen[is_inlier], sigma_z[inliers])
        return ShapeResult(
            fitted,
            rms(residuals[is_inlier]),
            floor,
            len(chosen),
            int(np.count_nonzero(~is_inlier)),
            error_map,
            inliers,
        )

    @cached_property
    def _field_mm(self) -> float:
        """Diagonal of what the image shows: that of the image, times the median step from pixel to
        pixel."""
        steps = [
            lengths(np.diff(lines[:: max(1, len(lines) // 100)], axis=1))
            for lines in (self.points, self.points.swapaxes(0, 1))
        ]
        known = np.concatenate([step[np.isfinite(step)] for step in steps])
        step = float(np.median(known)) if known.size else 0.0
        return step * float(np.hypot(*self.points.shape[:2]))

    def _typical_noise(self, measured: Map) -> float:
        """Median noise of the measured pixels in mm; 0 where none is known."""
        if self.sigma_z is None:
            return 0.0
        if self.sigma_z.shape != measured.shape:
            raise InputError(
                f"The noise map has shape {self.sigma_z.shape} and the cloud {measured.shape}",
                "they must agree.",
            )
        known = self.sigma_z[measured & np.isfinite(self.sigma_z)]
        return float(np.median(known)) if known.size else 0.0


_FITS: dict[Shape, Callable[[np.ndarray], Plane | Sphere]] = {
    "plane": fit_plane,
    "sphere": fit_sphere,
}


def noise_floor(shape: Plane | Sphere, points: Points, sigma_z: Map) -> float:
    """Root mean square of ``sigma_z |n . r|`` over points (n, 3), r = (x/z, y/z, 1), n the shape's
    normal there; mm.

    ``sigma_z`` (n,) is the expected noise of each depth; an error of z moves the point along its
    ray r.
    """
    known = np.isfinite(sigma_z)
    if not known.any():
        return float("nan")
    points, sigma_z = points[known], sigma_z[known].astype(np.float64)
    rays = points / points[:, 2:]
    if isinstance(shape, Plane):
        along = rays @ shape.normal
    else:
        along = np.sum(unit_vectors(points - shape.centre) * rays, axis=1)
    return rms(sigma_z * along)


def measured_pixels(points: Points, mask: Map | None) -> Map:
    """Return which pixels ``(h, w)`` of a cloud hold a point, under a mask if there is one;
    ``InputError`` if too few do."""
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(
            f"The cloud has shape {points.shape}", "an organised cloud (h, w, 3) is needed."
        )
    if mask is not None and mask.shape != points.shape[:2]:
        raise InputError(
            f"The mask has shape {mask.shape} and the cloud {points.shape[:2]}", "they must agree."
        )
    measured = finite_rows(points)
    measured = measured if mask is None else measured & mask
    if np.count_nonzero(measured) < LEAST_PIXELS:
        raise InputError(
            f"{np.count_nonzero(measured)} points were measured where the shape is looked for",
            f"at least {LEAST_PIXELS} are needed; check that it is in view and illuminated.",
        )
    return measured


def _sample_points(points: Points, measured: Map) -> np.ndarray:
    """Return some 40,000 of the measured points, (n, 3) float64."""
    chosen = points[measured]
    return chosen[:: -(-len(chosen) // _SAMPLE)].astype(np.float64)


def _largest_patch(agreeing: Map) -> Map:
    """Return the largest 4-connected patch; gaps of up to four unmeasured pixels do not cut it, and
    small holes are filled."""
    closed = cv2.morphologyEx(agreeing.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    patches, count = scipy.ndimage.label(closed)
    if not count:
        return np.zeros_like(agreeing)
    patch = patches == 1 + np.argmax(np.bincount(patches.ravel())[1:])
    # in a frame, which joins what reaches the image's border
    others, _ = scipy.ndimage.label(np.pad(~patch, 1, constant_values=True), np.ones((3, 3)))
    is_hole = np.bincount(others.ravel()) < 0.005 * np.count_nonzero(patch)
    is_hole[[0, others[0, 0]]] = False  # the patch itself, and what surrounds it
    return np.asarray(patch | is_hole[others[1:-1, 1:-1]])


def incidence(
    points: np.ndarray, mask: np.ndarray, depth_range: tuple[float, float]
) -> dict[str, float]:
    """Percent of the points ``(h, w, 3)`` under ``mask`` with z < z0 (R1), z0 <= z <= z1 (R2), z >
    z1 (R3), mm.

    The Letter's "incidence" (Table 1, 500 and 700 mm). Pixels without a measured point are
    excluded.
    """
    z0, z1 = depth_range
    if not z0 < z1:
        raise InputError(
            f"The depth range {z0:g} to {z1:g} mm is empty", "give the smaller depth first."
        )
    z = points[..., 2][mask]
    z = z[np.isfinite(z)]
    if z.size == 0:
        raise InputError("No point was measured in the region: its depths are unknown.")
    r1, r3 = 100.0 * np.count_nonzero(z < z0) / z.size, 100.0 * np.count_nonzero(z > z1) / z.size
    return {"R1": r1, "R2": 100.0 - r1 - r3, "R3": r3}


LEAST_SHARE = 0.5
"""Of the scene's measured pixels, that a plane must hold to be what was captured."""
MOST_OVER_FLOOR = 4.0
"""Times the noise floor, up to which the best model's RMS may be the calibration's own error;
beyond, the shape is doubtful too."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """One capture of a plane or a sphere, measured with several models.

    ``results`` by model name, each over the pixels of ``common`` ``(h, w)`` bool: those of
    ``region`` ``(h, w)`` bool that every model measures. ``coverage`` by model: share of the
    region's illuminated pixels that it measures, NaN where these are not known. ``incidence``:
    percent of the measured region in R1, R2, R3, or None without a depth range. ``share``: of the
    pixels that all models measure, those in the region; ``is_searched``: the region was not given,
    it is the largest patch of the shape. ``misfit_ratio``: the least of models that know
    their errors, of the residuals in the mean of patches over what noise and calibration predict.
    """

    shape: Shape
    results: dict[str, ShapeResult]
    region: np.ndarray
    common: np.ndarray
    coverage: dict[str, float]
    incidence: dict[str, float] | None
    share: float = 1.0
    is_searched: bool = False
    misfit_ratio: float = 0.0

    @property
    def warnings(self) -> list[str]:
        """Warnings where more than 2 % of the points were excluded, where a plane is a minor part
        of the scene, and where residuals are far above what is predicted by every model."""
        messages = [
            f"{model}: {result.warning}" for model, result in self.results.items() if result.warning
        ]
        if self.is_searched and self.shape == "plane" and self.share < LEAST_SHARE:
            messages.append(
                f"the largest plane holds {100 * self.share:.0f} % of the measured pixels"
                f" ({self.region_text()}), and the figures are of it alone: is this a capture of a"
                " plane?"
            )
        known = {
            model: ratio
            for model, result in self.results.items()
            if np.isfinite(ratio := result.rms_mm / result.noise_floor_mm)
        }
        best = min(known, key=lambda model: known[model], default="")
        if best and known[best] > MOST_OVER_FLOOR:
            messages.append(
                f"the RMS is {known[best]:.1f} times the noise floor at best ({best}): this is no"
                f" {self.shape}, the frames are disturbed, or the calibration is off by that much"
            )
        elif self.misfit_ratio > RAISED_RATIO:
            messages.append(
                f"residuals in the mean of patches are {self.misfit_ratio:.1f} times what is"
                f" predicted: the {self.shape} has form errors, or focus, zoom, aperture or a"
                " device has changed since the calibration: run `slviewer check`"
            )
        return messages

    def region_text(self) -> str:
        """Describe the position of the measured region in the image."""
        left, right, top, bottom = self._region_px()
        return f"columns {left}-{right}, rows {top}-{bottom}"

    def _region_px(self) -> tuple[int, int, int, int]:
        """First and last column, first and last row of the measured region."""
        rows, columns = (np.flatnonzero(self.region.any(axis=axis)) for axis in (1, 0))
        return int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1])

    def record(
        self, masked: Mapping[str, float] = MappingProxyType({}), **origin: Any
    ) -> Verification:
        """Return the figures without the maps.

        ``masked``: {model: share that it masks}, of models that do; ``origin``: the record's inputs
        and scales.
        """
        return Verification(
            shape=self.shape,
            models={
                model: ModelFit(
                    points=result.points,
                    excluded=result.excluded,
                    rms_mm=result.rms_mm,
                    noise_floor_mm=finite_or_none(result.noise_floor_mm),
                    coverage=finite_or_none(self.coverage[model]),
                    masked=masked.get(model),
                    **_shape_fields(result.shape),
                )
                for model, result in self.results.items()
            },
            incidence=self.incidence,
            share=finite_or_none(self.share),
            region_px=self._region_px(),
            warnings=tuple(self.warnings),
            **origin,
        )


def _shape_fields(shape: Plane | Sphere) -> dict[str, Any]:
    """The fields of a record that describe a fitted shape."""
    if isinstance(shape, Plane):
        return {"normal": to_vector(shape.normal), "offset_mm": float(shape.offset)}
    return {"centre_mm": to_vector(shape.centre), "radius_mm": shape.radius}


def fit_clouds(
    shape: Shape,
    clouds: Mapping[str, Cloud],
    illuminated: np.ndarray | None = None,
    *,
    region: np.ndarray | None = None,
    depth_range: tuple[float, float] | None = None,
    radius: float | None = None,
) -> Comparison:
    """Fit the shape to every model's cloud of one capture, over the pixels that all of them
    measure.

    ``illuminated`` ``(h, w)`` bool: what a perfect decoder could measure. ``region`` ``(h, w)``
    bool: the pixels that show the shape, such as a board's outline; None: the shape is looked for
    where every model measures, and its region grown in the first model's cloud, completed by the
    others'. ``depth_range`` in mm bounds R2. ``radius`` in mm, roughly, helps to find a sphere; the
    fitted one is free all the same.

    Raises ``InputError`` where clouds differ in size, the shape is not found, or the models share
    too few pixels.
    """
    if not clouds:
        raise InputError("No cloud was given to evaluate", "name at least one model.")
    every, sigma_z = _merge_clouds(clouds)
    shared = np.logical_and.reduce([cloud.mask for cloud in clouds.values()])
    if len(clouds) > 1 and region is None and np.count_nonzero(shared) < LEAST_PIXELS:
        raise InputError(
            f"{' and '.join(clouds)} share {np.count_nonzero(shared)} measured pixels",
            "name one model, or place the shape where the board poses were.",
        )
    # A wall behind the shape may hold more pixels, in a model that measures everywhere.
    searched = region if region is not None else shared
    search = ShapeSearch(shape, every, sigma_z, radius)
    start = search.start(searched)
    is_searched = region is None
    if region is None:
        start, region = search.find(None, start)
    measured_pixels(every, region)  # says so if there is too little
    common = region & shared
    lit = np.zeros_like(region) if illuminated is None else region & illuminated
    lit_pixels = np.count_nonzero(lit) or np.nan
    results: dict[str, ShapeResult] = {}
    for model, cloud in clouds.items():
        try:
            search = ShapeSearch(shape, cloud.points, cloud.sigma_z)
            results[model] = search.evaluate(common, start)
        except InputError as error:
            raise InputError(f"No {shape} could be fitted to the {model} cloud. {error}") from error
    return Comparison(
        shape=shape,
        results=results,
        region=region,
        common=common,
        coverage={
            model: np.count_nonzero(lit & cloud.mask) / lit_pixels
            for model, cloud in clouds.items()
        },
        incidence=None if depth_range is None else incidence(every, region, depth_range),
        share=int(np.count_nonzero(common)) / max(1, int(np.count_nonzero(shared))),
        is_searched=is_searched,
        misfit_ratio=_misfit_ratio(results, clouds),
    )


def _misfit_ratio(results: Mapping[str, ShapeResult], clouds: Mapping[str, Cloud]) -> float:
    """Return the ratio as in `Comparison.misfit_ratio`; 0 where no model knows its errors."""
    ratios = []
    for model, result in results.items():
        if (sigma := clouds[model].sigma_calibration) is not None:
            at = tuple(subsample(np.argwhere(result.inliers), _SAMPLE).T)
            points = clouds[model].points[at].astype(np.float64)
            _, means, noise = patch_means(points, result.error_map[at].astype(np.float64))
            predicted = np.hypot(rms(noise), noise_floor(result.shape, points, sigma[at]))
            ratios.append(rms(means) / float(predicted))
    return min(ratios, default=0.0)


def _merge_clouds(clouds: Mapping[str, Cloud]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first cloud's points and their noise, and the next cloud's where it has none.
    InputError where they differ in size."""
    sizes = {cloud.points.shape[:2] for cloud in clouds.values()}
    if len(sizes) > 1:
        raise InputError(
            f"The models' clouds have different sizes, {sizes}",
            "reconstruct them from the same capture.",
        )
    first, *others = clouds.values()
    points, sigma_z = first.points.copy(), first.sigma_z.copy()
    for cloud in others:
        missing = ~np.isfinite(points).all(axis=2)
        points[missing], sigma_z[missing] = cloud.points[missing], cloud.sigma_z[missing]
    return points, sigma_z
