"""The surface that is measured on: a scan's points with all that is known of their errors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.inspection.features import Feature
from slviewer.inspection.regions import Region
from slviewer.inspection.uncertainty import Shared, Spread, splined_shared
from slviewer.pipeline.capture_clouds import read_merge, scan_cloud
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.models import (
    Model,
    check_accepted,
    load_model,
    preferred_model,
    warn_if_stale,
)
from slviewer.pipeline.operation import Job
from slviewer.pipeline.scale import load_scale_correction
from slviewer.pipeline.scan_edits import refuse_region
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.reconstruction.reconstruct import triangulate_grid
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session

MERGED = "merge/"
"""What the name of a merge that the session keeps begins with; its number follows, for meshes
nothing for the last."""
Place = tuple[int, int] | int
"""A point of a surface: pixel (u, v) of a scan, or the index of a merged surface's point."""


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """Points (h, w, 3) of a scan, or (n, 3) of a merged surface, mm, NaN where nothing was
    measured.

    ``sigma_mm`` like them without the last axis: of z, along the camera's ray, for a scan; along
    ``normals`` for a merged surface; ``left_mm`` likewise: standard deviation from the calibration,
    where known. ``faces`` (m, 3): of a merged mesh. ``source`` is the capture or result that it
    came from, ``model`` the calibration, ``inputs`` the hashes of both; ``shared``: the covariance
    of errors of that ``calibration``, by its hash, where known.
    """

    points: np.ndarray
    sigma_mm: np.ndarray
    source: str
    model: str
    inputs: Mapping[str, str]
    left_mm: np.ndarray | None = None
    normals: np.ndarray | None = None
    faces: np.ndarray | None = None
    shared: Shared | None = None
    calibration: str = ""
    texture: np.ndarray | None = None
    scale: float = 1.0

    @property
    def organised(self) -> bool:
        """Whether it is a scan, pixel by pixel."""
        return self.points.ndim == 3

    @property
    def measured(self) -> np.ndarray:
        """Mask of the measured points, (h, w) or (n,) bool."""
        return np.asarray(np.isfinite(self.points).all(axis=-1))

    def within(self, region: Region) -> np.ndarray:
        """(n, 3) float64: the points of a region."""
        return np.asarray(self.points[region.within(self.points)], np.float64)

    def noise(self, region: Region) -> float:
        """mm: the region's expected noise in the median; infinite where it is not known."""
        sigma = self.sigma_mm[region.within(self.points)]
        return float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else float("inf")

    def picked(self, place: Place) -> tuple[Feature, Spread]:
        """The point at a pixel or index, and its uncertainty. Raises InputError where nothing was
        measured there."""
        if self.organised != isinstance(place, tuple):
            raise InputError(
                f"{place} is not a place on {self.source}: give"
                f" {'pixel (u, v)' if self.organised else 'an index'}"
            )
        index = place[::-1] if isinstance(place, tuple) else (place,)
        if not all(0 <= i < n for i, n in zip(index, self.points.shape, strict=False)):
            raise InputError(f"{place} lies outside {self.source}: pick a point of it")
        point = np.asarray(self.points[index], np.float64)
        if not np.isfinite(point).all():
            raise InputError(
                f"nothing was measured at {place} of {self.source}: pick another point"
            )
        away, sigma = np.zeros(3), float(np.nan_to_num(self.sigma_mm[index]))
        if self.organised:
            away = sigma * point / point[2]
        elif self.normals is not None:
            away = sigma * np.asarray(self.normals[index], np.float64)
        shared = None if self.shared is None else self.shared(point[None], np.eye(3)[:, None])
        return Feature("point", point), Spread(np.outer(away, away), shared, self.calibration)

    def sigma_along(self, normals: np.ndarray, whole: bool = False) -> np.ndarray:
        """(n,) mm: standard deviation of the measured points along unit normals (n, 3), of noise
        alone, or on the ``whole``, with what the calibration leaves uncertain."""
        sigma = self.sigma_mm[self.measured].astype(np.float64)
        if whole and self.left_mm is not None:
            sigma = np.hypot(sigma, self.left_mm[self.measured])
        if not self.organised:
            return sigma
        points = self.points[self.measured].astype(np.float64)
        return sigma * np.abs(np.sum(points / points[:, 2:] * normals, axis=1))


LoadSurface = Callable[[Session], MeasuredSurface]
"""Returns a surface of a session that is at hand already."""


def triangulate_surface(on: MeasuredSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and faces (m, 3) of a surface; a scan's end where its depth jumps."""
    if on.faces is not None:
        return np.asarray(on.points, np.float64), on.faces
    if not on.organised:
        raise InputError(f"{on.source} is a cloud without triangles: mesh it first")
    faces = triangulate_grid(on.points)
    return on.points[on.measured].astype(np.float64), faces


def load_surface(
    job: Job,
    scan: str,
    model: str | None = None,
    roi: str = "",
    accept_rejected: bool = False,
    load: LoadSurface | None = None,
) -> MeasuredSurface:
    """Reconstruct a capture to measure on it, or read a stored merge, named ``merge/<number>``;
    ``roi`` as in `resolve_region`, for captures alone. ``load`` returns a surface that is at
    hand."""
    store, warn = job.store, job.warn
    if load is not None:
        return load(store)
    if scan.startswith(MERGED):
        refuse_region(scan, roi)
        return load_merged_surface(store, scan, warn)
    check_accepted(store, accept_rejected)
    warn_if_stale(store, warn)
    model = model or preferred_model(store)
    cloud = scan_cloud(store, scan, model, job.progress, warn, accept_rejected, roi)
    fitted = load_model(store, cloud.model)
    surface = surface_from_cloud(store, scan, cloud, fitted, with_region=not roi)
    job.progress(1.0, "reconstructed")
    return surface


def surface_from_cloud(
    store: Session, scan: str, cloud: Cloud, fitted: Model, *, with_region: bool = True
) -> MeasuredSurface:
    """A capture's cloud, made with one of the session's calibrations, as a surface to measure on.

    ``with_region``: whether it was cut by the session's region, where that is in effect.
    """
    calibration, scale, sigma = f"calibration/{fitted.name}", 1.0, 0.0
    names = [scan, calibration]
    if (applied := load_scale_correction(store, fitted.name)) is not None:
        names.append(f"scale/{fitted.name}")
        scale, sigma = float(applied["factor"]), 1e-6 * float(applied["U_ppm"]) / 2
    inputs = store.input_hashes(*names) | restriction_inputs(store, [scan], with_region=with_region)
    shared = None
    if isinstance(fitted, SplinedModel):
        shared = splined_shared(fitted.bundle, cloud.axis, scale, sigma)
    return MeasuredSurface(
        cloud.points,
        cloud.sigma_z,
        scan,
        fitted.name,
        inputs,
        left_mm=cloud.sigma_calibration,
        normals=grid_normals(cloud.points),
        shared=shared,
        calibration="" if shared is None else inputs[calibration],
        texture=cloud.texture,
        scale=scale,
    )


def load_merged_surface(
    store: Session, merge: str, warn: Warn = ignore_warnings
) -> MeasuredSurface:
    """A stored merge ``merge/<number>``, in the frame of its reference's camera."""
    record, points = read_merge(store, merge, warn)
    sigma = points.scalars.get("sigma", np.full(len(points.points), np.nan, np.float32))
    return MeasuredSurface(
        points.points,
        sigma,
        merge,
        record.model,
        store.input_hashes(merge),
        normals=points.normals,
        faces=points.faces,
        texture=points.colours,
        scale=record.scales.get(record.model, 1.0),
    )
