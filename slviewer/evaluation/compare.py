"""Calibrations side by side: the same capture, the same pixels, each model's own fit."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.fit import (
    LEAST_PIXELS,
    ShapeResult,
    ShapeSearch,
    finite_or_none,
    incidence,
    measured_pixels,
)
from slviewer.geometry.shapes import Plane, Sphere
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.record import to_vector
from slviewer.records.verification import ModelFit, Shape, Verification

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
    it is the largest patch of the shape.
    """

    shape: Shape
    results: dict[str, ShapeResult]
    region: np.ndarray
    common: np.ndarray
    coverage: dict[str, float]
    incidence: dict[str, float] | None
    share: float = 1.0
    is_searched: bool = False

    @property
    def warnings(self) -> list[str]:
        """Warnings where more than 2 % of the points were excluded, where a plane is a minor part
        of the scene, and where the RMS is far above the noise floor by every model."""
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
        raise InputError("No cloud was given to evaluate: name at least one model.")
    every, sigma_z = _merge_clouds(clouds)
    shared = np.logical_and.reduce([cloud.mask for cloud in clouds.values()])
    if len(clouds) > 1 and region is None and np.count_nonzero(shared) < LEAST_PIXELS:
        raise InputError(
            f"{' and '.join(clouds)} share {np.count_nonzero(shared)} measured pixels: name one"
            " model, or place the shape where the board poses were."
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
    )


def _merge_clouds(clouds: Mapping[str, Cloud]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first cloud's points and their noise, and the next cloud's where it has none.
    InputError where they differ in size."""
    sizes = {cloud.points.shape[:2] for cloud in clouds.values()}
    if len(sizes) > 1:
        raise InputError(
            f"The models' clouds have different sizes, {sizes}: reconstruct them from the same"
            " capture."
        )
    first, *others = clouds.values()
    points, sigma_z = first.points.copy(), first.sigma_z.copy()
    for cloud in others:
        missing = ~np.isfinite(points).all(axis=2)
        points[missing], sigma_z[missing] = cloud.points[missing], cloud.sigma_z[missing]
    return points, sigma_z
