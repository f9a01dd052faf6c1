"""The pixel-wise rational model (the Letter, steps 2 to 5).

For every camera pixel ``z = (c0 + c1 phi)/(1 + c2 phi)`` (eq. 9), ``x = c3 z`` and ``y = c4 z`` (eq. 10, 11), fitted
to target poses that stereo reconstructed and that were projected onto their ideal planes (eq. 12, 13).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange

from slviewer.calibration.moments import RationalMoments
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel
from slviewer.geometry.shapes import Plane, fit_plane
from slviewer.geometry.triangulation import depth_per_px, triangulate, triangulate_pixels

MIN_POSES = 4
"""Three coefficients and one pose more, so that the fit's RMS says something."""
REACH = 1.5
"""How far beyond the phases it was calibrated with, in lengths of their range, a pixel still measures."""


@dataclass(frozen=True)
class PixelFit:
    """One axis: ``coefficients`` (5, h, w) float64 c0 ... c4 for phase in rad and depth in mm; NaN where not fitted.

    ``rms_mm`` (3, h, w) is the fit's RMS in z, x and y; ``poses`` (h, w) how many a pixel saw; ``phase_min`` and
    ``phase_max`` the range that it saw; ``condition`` (h, w) how nearly the three terms of eq. 9 are alike over it.
    """

    coefficients: np.ndarray
    rms_mm: np.ndarray
    poses: np.ndarray
    phase_min: np.ndarray
    phase_max: np.ndarray
    condition: np.ndarray


@dataclass(frozen=True)
class PixelwiseModel:
    """The Letter's calibration: a rational function of the phase for each camera pixel and captured axis.

    ``periods_px`` is the fringe period that the coefficients' phase counts in; a capture of another period is
    converted to it. ``planes`` are the ideal planes of the target poses (eq. 12), reconstructed from ``depth_axis``.
    """

    fits: Mapping[Axis, PixelFit]
    periods_px: Mapping[Axis, float]
    planes: Mapping[str, Plane]
    depth_axis: Axis

    name = "pixelwise"

    @property
    def axes(self) -> tuple[Axis, ...]:
        return tuple(self.fits)

    def points(self, phase: PhaseMap) -> np.ndarray:
        """(h, w, 3) float32 mm; NaN where the phase is invalid, unfitted, or too far from the fitted range."""
        fit = self.fits[phase.axis]
        out = np.empty((*phase.phase.shape, 3), np.float32)
        ratio = phase.period_px / self.periods_px[phase.axis]
        _evaluate(phase.phase, ratio, fit.coefficients, fit.phase_min, fit.phase_max, REACH, out)
        return out

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``."""
        c0, c1, c2 = self.fits[phase.axis].coefficients[:3]
        ratio = phase.period_px / self.periods_px[phase.axis]
        per_rad = np.abs(c1 - c0 * c2) / (1 + c2 * (ratio * phase.phase)) ** 2
        return (per_rad * ratio * phase.sigma_phase).astype(np.float32)

    def median_rms_mm(self, axis: Axis) -> dict[str, float]:
        """The fit's median RMS over the pixels, in z, x and y."""
        z, x, y = (float(np.nanmedian(r)) for r in self.fits[axis].rms_mm)
        return {"z": z, "x": x, "y": y}

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat named arrays, for saving."""
        keys = PixelFit.__annotations__
        return {f"{axis}_{key}": getattr(fit, key) for axis, fit in self.fits.items() for key in keys}

    def to_dict(self) -> dict[str, Any]:
        """What is not an image, JSON-able."""
        planes = {name: [*plane.normal.tolist(), plane.offset] for name, plane in self.planes.items()}
        return {"periods_px": dict(self.periods_px), "planes": planes, "depth_axis": self.depth_axis}

    @classmethod
    def restored(cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "PixelwiseModel":
        """The inverse of ``to_dict`` and ``to_arrays``."""
        keys = PixelFit.__annotations__
        fits = {axis: PixelFit(**{key: arrays[f"{axis}_{key}"] for key in keys}) for axis in data["periods_px"]}
        planes = {name: Plane(np.array(values[:3]), values[3]) for name, values in data["planes"].items()}
        return cls(fits, data["periods_px"], planes, data["depth_axis"])


def calibrate_pixelwise(
    observations: Sequence[Observation],
    stereo: StereoModel,
    progress: Callable[[float], None] | None = None,
) -> PixelwiseModel:
    """Steps 3 to 5 for each captured axis, from the poses that the stereo calibration used.

    Raises CalibrationRejected when no pixel saw the board in at least 4 poses.
    """
    used = [o for o in observations if o.name in stereo.poses]
    if len(used) < MIN_POSES:
        raise CalibrationRejected(
            f"{len(used)} usable poses, and a pixel needs at least {MIN_POSES}: capture the board in more positions"
        )
    depth_axis = best_axis(used, stereo)
    planes = {o.name: ideal_plane(o, stereo, depth_axis) for o in used}
    z_ref = mid_depth(stereo)
    width, height = used[0].size
    axes = [axis for axis in stereo.axes if all(axis in o.surfaces for o in used)]
    periods = {axis: used[0].periods_px[axis] for axis in axes}
    moments = {
        axis: RationalMoments(_reference_phase(stereo, axis, period, z_ref), z_ref) for axis, period in periods.items()
    }
    rays = _RayMoments((height, width))
    total, done = 2 * len(used), 0
    for refine in (False, True):
        for o in used:
            origin = (o.box[1], o.box[0])
            phases = {axis: o.smoothed_phase(axis) for axis in axes}
            points = ideal_points(o, stereo, depth_axis, phases[depth_axis], planes[o.name])
            for axis in axes:
                add = moments[axis].add_refinement if refine else moments[axis].add
                add(phases[axis] * (o.periods_px[axis] / periods[axis]), points[..., 2], origin)
            if not refine:
                rays.add(points, origin)
            done += 1
            if progress:
                progress(done / total)
        if not refine:
            for axis in axes:
                moments[axis].solve(MIN_POSES)
    if not any((m.poses >= MIN_POSES).any() for m in moments.values()):
        raise CalibrationRejected(
            f"no pixel saw the board in {MIN_POSES} poses or more: let the poses overlap in the image"
        )
    c3, c4, rms_x, rms_y = rays.solve(MIN_POSES)
    fits = {axis: _pixel_fit(m, c3, c4, rms_x, rms_y) for axis, m in moments.items()}
    return PixelwiseModel(fits, periods, planes, depth_axis)


def pixel_samples(
    observations: Sequence[Observation], stereo: StereoModel, model: PixelwiseModel, axis: Axis, pixel: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """What one pixel (u, v) was fitted to: phase (n,) rad and ideal points (n, 3) mm, one of each pose that it saw.

    The phase counts in the model's ``periods_px``.
    """
    u, v = pixel
    phases, points = [], []
    for o in observations:
        u0, v0, u1, v1 = o.box
        if o.name not in model.planes or not (u0 <= u < u1 and v0 <= v < v1 and o.region[v - v0, u - u0]):
            continue
        coordinate = o.surfaces[model.depth_axis].evaluate(np.array([u]), np.array([v]))
        coordinate *= o.periods_px[model.depth_axis] / (2 * np.pi)
        X = triangulate_pixels(stereo.rig, np.array([[u, v]], float), coordinate, model.depth_axis)[0]
        plane = model.planes[o.name]
        points.append(X - (X @ plane.normal - plane.offset) * plane.normal)
        phase = float(o.surfaces[axis].evaluate(np.array([u]), np.array([v]))[0])
        phases.append(phase * o.periods_px[axis] / model.periods_px[axis])
    return np.array(phases), np.array(points).reshape(-1, 3)


def mid_depth(stereo: StereoModel) -> float:
    """Middle of the calibrated depths, mm."""
    if stereo.depth_range_mm is None:
        raise CalibrationRejected("the stereo calibration was made elsewhere, without poses to fit pixels to")
    return float(np.mean(stereo.depth_range_mm))


def best_axis(observations: Sequence[Observation], stereo: StereoModel) -> Axis:
    """The axis whose coordinate moves most with depth, at mid depth."""
    z = np.full(observations[0].size[::-1], mid_depth(stereo))
    sensitivity = {axis: float(np.nanmedian(depth_per_px(stereo.rig, axis, z))) for axis in stereo.axes}
    return min(stereo.axes, key=lambda axis: sensitivity[axis])


def ideal_plane(observation: Observation, stereo: StereoModel, axis: Axis) -> Plane:
    """The plane of the stereo reconstruction of a pose's smoothed phase (step 3, eq. 12)."""
    points = _stereo_points(observation, stereo, axis, observation.smoothed_phase(axis))
    finite = points[np.isfinite(points[..., 2])]
    if len(finite) < 100:
        raise CalibrationRejected(
            f"{observation.name}: stereo reconstructs {len(finite)} points of the board: leave this pose out"
        )
    return fit_plane(finite)


def ideal_points(
    observation: Observation, stereo: StereoModel, axis: Axis, phase: np.ndarray, plane: Plane
) -> np.ndarray:
    """(h', w', 3) mm: reconstructed points moved along the plane's normal onto it (step 4, eq. 13)."""
    points = _stereo_points(observation, stereo, axis, phase)
    return points - (points @ plane.normal - plane.offset)[..., None] * plane.normal


def _stereo_points(observation: Observation, stereo: StereoModel, axis: Axis, phase: np.ndarray) -> np.ndarray:
    u0, v0, u1, v1 = observation.box
    coordinate = np.full(observation.size[::-1], np.nan)
    coordinate[v0:v1, u0:u1] = phase * (observation.periods_px[axis] / (2 * np.pi))
    z = triangulate(stereo.rig, coordinate, axis)[v0:v1, u0:u1]
    return np.dstack([stereo.rig.camera.rays()[v0:v1, u0:u1] * z[..., None], z])


def _reference_phase(stereo: StereoModel, axis: Axis, period_px: float, z: float) -> np.ndarray:
    """(h, w) rad: the phase that stereo expects at depth z; 0 where the projector does not reach."""
    rays = stereo.rig.camera.rays()
    points = np.dstack([rays * z, np.full(rays.shape[:2], z)])
    coordinate = stereo.rig.project(points)[..., 0 if axis == "x" else 1]
    return np.nan_to_num(2 * np.pi * coordinate / period_px)


class _RayMoments:
    """Sums for ``x = c3 z`` and ``y = c4 z`` (eq. 10, 11)."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.sums = np.zeros((*shape, 6))

    def add(self, points: np.ndarray, origin: tuple[int, int]) -> None:
        _add_rays(points, origin[0], origin[1], self.sums)

    def solve(self, min_poses: int) -> Iterator[np.ndarray]:
        """c3, c4 (h, w), then the RMS of both fits in mm."""
        n, zz, xz, yz, xx, yy = np.moveaxis(self.sums, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            few = n < min_poses
            c3, c4 = (np.where(few, np.nan, s / zz) for s in (xz, yz))
            rms_x = np.sqrt(np.maximum(xx - c3 * xz, 0) / n).astype(np.float32)
            rms_y = np.sqrt(np.maximum(yy - c4 * yz, 0) / n).astype(np.float32)
        yield from (c3, c4, rms_x, rms_y)


def _pixel_fit(m: RationalMoments, c3: np.ndarray, c4: np.ndarray, rms_x: np.ndarray, rms_y: np.ndarray) -> PixelFit:
    rms_z = m.refine(MIN_POSES)
    a0, a1, a2 = m.coefficients
    # zeta = (a0 + a1 s)/(1 + a2 s) with s = phi - r and z = z_ref + zeta, back in the Letter's own terms
    b0, b1 = a0 + m.z_ref, a1 + m.z_ref * a2
    scale = 1 - a2 * m.phase_ref
    with np.errstate(invalid="ignore", divide="ignore"):
        c = np.stack([(b0 - b1 * m.phase_ref) / scale, b1 / scale, a2 / scale, c3, c4])
    missing = ~np.isfinite(c).all(0)
    c[:, missing] = np.nan
    rms = np.stack([rms_z, rms_x, rms_y])
    rms[:, missing] = np.nan
    return PixelFit(c, rms, m.poses, m.phase_min, m.phase_max, m.condition)


@kernel()
def _add_rays(points, v0, u0, sums):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            if np.isfinite(z):
                a = sums[v0 + i, u0 + j]
                a[0] += 1.0
                a[1] += z * z
                a[2] += x * z
                a[3] += y * z
                a[4] += x * x
                a[5] += y * y


@kernel(parallel=True)
def _evaluate(phase, ratio, c, phase_min, phase_max, reach, out):  # type: ignore[no-untyped-def]
    for v in prange(phase.shape[0]):
        for u in range(phase.shape[1]):
            p = ratio * np.float64(phase[v, u])
            margin = reach * (phase_max[v, u] - phase_min[v, u])
            denominator = 1.0 + c[2, v, u] * p
            z = (c[0, v, u] + c[1, v, u] * p) / denominator
            inside = p >= phase_min[v, u] - margin and p <= phase_max[v, u] + margin
            if inside and z > 0.0:
                out[v, u, 0] = c[3, v, u] * z
                out[v, u, 1] = c[4, v, u] * z
                out[v, u, 2] = z
            else:
                out[v, u, 0] = np.nan
                out[v, u, 1] = np.nan
                out[v, u, 2] = np.nan
