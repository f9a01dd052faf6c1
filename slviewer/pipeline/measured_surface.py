"""The surface of a scan or of a merge to measure on, with all that is known of its errors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.geometry.rigid import move_points
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import NO_ERRORS
from slviewer.inspection.regions import Region
from slviewer.inspection.uncertainty import PointErrors, Spread, splined_shared
from slviewer.pipeline.cloud_corrections import load_scale_correction
from slviewer.pipeline.models import (
    check_calibration,
    device_centres,
    load_model,
    load_stereo,
    preferred_model,
)
from slviewer.pipeline.operation import Job, Warn, ignore_warnings
from slviewer.pipeline.reconstruct import read_merge, scan_cloud
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals, triangulate_grid
from slviewer.reconstruction.rig_change import PointResponse
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.unorganised import point_set

MERGED = "merge/"
"""Beginning of the name of a stored merge; its number follows, for meshes nothing for the last."""
Place = tuple[int, int] | int
"""A point of a surface: pixel (u, v) of a scan, or the index of a merged surface's point."""


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """Points (h, w, 3) of a scan, or (n, 3) of a merged surface, mm, NaN where not measured.

    ``sigma_mm`` like them without the last axis: of z, along the camera's ray, for a scan; along
    ``normals`` for a merged surface; ``left_mm`` likewise: standard deviation from the calibration
    and a misfit of the axes. ``faces`` (m, 3): of a merged mesh. ``source`` is the capture or
    result that it came from, ``model`` the calibration, ``inputs`` the hashes of both; ``errors``:
    those that the points share, by the hash of the calibration. ``views``: of each scan the centres
    (2, 3) mm of camera and projector. Each where known.
    """

    points: np.ndarray
    sigma_mm: np.ndarray
    source: str
    model: str
    inputs: Mapping[str, str]
    left_mm: np.ndarray | None = None
    normals: np.ndarray | None = None
    faces: np.ndarray | None = None
    errors: PointErrors = NO_ERRORS
    texture: np.ndarray | None = None
    scale: float = 1.0
    views: Sequence[np.ndarray] = ()

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
        """The point at a pixel or index, and its uncertainty. Raises InputError without one."""
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
            raise InputError(f"nothing was measured at {place} of {self.source}: pick another")
        away, sigma = np.zeros(3), float(np.nan_to_num(self.sigma_mm[index]))
        if self.organised:
            away = sigma * point / point[2]
        elif self.normals is not None:
            away = sigma * np.asarray(self.normals[index], np.float64)
        raised, own = self.errors.raised, np.outer(away, away)
        shared = None if raised is None else raised(point[None], np.eye(3)[:, None])
        return Feature("point", point), Spread(own, shared, self.errors.calibration)

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
    return on.points[on.measured].astype(np.float64), triangulate_grid(on.points)


def load_surface(
    job: Job,
    scan: str,
    model: str | None = None,
    roi: str = "",
    load: LoadSurface | None = None,
) -> MeasuredSurface:
    """Reconstruct a capture to measure on it, or read a stored merge, named ``merge/<number>``;
    ``roi`` as in `resolve_region`, for captures alone. ``load`` returns a surface that is at
    hand."""
    store = job.store
    if load is not None:
        return load(store)
    if scan.startswith(MERGED):
        return load_merged_surface(store, scan, job.warn, roi)
    if not store.load_capture(scan).is_imported_cloud:
        check_calibration(job)
        model = model or preferred_model(store)
    cloud = scan_cloud(job, scan, model, roi)
    job.progress(1.0, "reconstructed")
    return surface_from_cloud(store, scan, cloud, with_region=not roi)


def surface_from_cloud(
    store: Session, scan: str, cloud: Cloud, *, with_region: bool = True
) -> MeasuredSurface:
    """A capture's cloud as a surface to measure on; ``with_region``: whether it was cut by the
    session's region, where that is in effect."""
    if cloud.normals is not None:
        on, used = point_set(cloud), restriction_inputs(store, [scan], with_region=with_region)
        known: dict[str, Any] = {"normals": on.normals, "texture": on.colours}
        known |= {"sigma_mm": on.sigma_mm, "inputs": store.input_hashes(scan) | used}
        return MeasuredSurface(on.points, source=scan, model="", **known)
    fitted = load_model(store, cloud.model)
    calibration, scale, sigma = f"calibration/{fitted.name}", 1.0, 0.0
    names = [scan, calibration]
    if (applied := load_scale_correction(store, fitted.name)) is not None:
        names.append(f"scale/{fitted.name}")
        scale, sigma = float(applied["factor"]), 1e-6 * float(applied["U_ppm"]) / 2
    inputs = store.input_hashes(*names) | restriction_inputs(store, [scan], with_region=with_region)
    shared, rig = None, fitted if isinstance(fitted, SplinedModel) else load_stereo(store)
    if isinstance(fitted, SplinedModel):
        shared = splined_shared(fitted.bundle, cloud.axis, scale, sigma)
    response = PointResponse.from_cloud(cloud, rig.pinholes, rig.residual_px, scale)
    return MeasuredSurface(
        cloud.points,
        cloud.sigma_z,
        scan,
        fitted.name,
        inputs,
        left_mm=cloud.sigma_calibration if cloud.misfit is None else cloud.sigma_systematic,
        normals=normals(cloud.points),
        errors=PointErrors(shared, "" if shared is None else inputs[calibration], response),
        texture=cloud.texture,
        scale=scale,
        views=device_centres(store),
    )


def load_merged_surface(
    store: Session, merge: str, warn: Warn = ignore_warnings, roi: str = ""
) -> MeasuredSurface:
    """A stored merge, in the frame of its reference's camera; ``roi`` as in `read_merge`."""
    record, points = read_merge(store, merge, warn, roi)
    sigma = points.scalars.get("sigma", np.full(len(points.points), np.nan, np.float32))
    poses = [np.eye(4), *(np.array(pair.T_reference_scan) for pair in record.pairs.values())]
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
        views=[move_points(T, view) for view in device_centres(store) for T in poses],
    )
