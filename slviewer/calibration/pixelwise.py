"""The pixel-wise rational model (the Letter, steps 2 to 5).

For every camera pixel ``z = (c0 + c1 phi)/(1 + c2 phi)`` (eq. 9), ``x = c3 z`` and ``y = c4 z``
(eq. 10, 11), fitted to target poses that stereo reconstructed and that were projected onto their
ideal planes (eq. 12, 13).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from slviewer.calibration.moments import fit_rational
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats
from slviewer.geometry.shapes import Plane, fit_plane
from slviewer.geometry.triangulation import MARGIN, depth_per_px, ray_depth, triangulate_pixels
from slviewer.records.calibration import AxisFit, PixelwiseFit

PLANE_PIXELS = 30_000
"""Approximate number of pixels in a pose's plane fit; the phase is smooth, and more pixels do not
change the plane."""
BAND_BYTES = 2**27
"""Memory for the band of image rows that is fitted at a time; the band is narrower the more poses
there are."""
MIN_POSES = 4
"""One pose more than coefficients, so that the fit's RMS is meaningful."""
MAX_EXTRAPOLATION = 1.5
"""Largest extrapolation beyond a pixel's calibrated phase range, in lengths of that range."""


@dataclass(frozen=True)
class PixelFit:
    """Fit of one axis: ``coefficients`` (5, h, w) float64 c0 ... c4 for phase in rad and depth in
    mm, or NaN.

    ``rms_mm`` (3, h, w): RMS residuals in z, x and y; ``poses`` (h, w): number of poses of each
    pixel; ``phase_min`` and ``phase_max`` (h, w) rad: their phase range; ``condition`` (h, w):
    condition number of the fit of eq. 9.
    """

    coefficients: Floats
    rms_mm: NDArray[np.float32]
    poses: NDArray[np.uint16]
    phase_min: NDArray[np.float32]
    phase_max: NDArray[np.float32]
    condition: NDArray[np.float32]


@dataclass(frozen=True)
class PixelwiseModel:
    """The Letter's calibration: a rational function of the phase for each camera pixel and captured
    axis.

    ``periods_px`` is the fringe period of the coefficients' phase; the phase of captures with
    another period is converted. ``planes`` are the ideal planes of the target poses (eq. 12),
    reconstructed from ``depth_axis``.
    """

    fits: Mapping[Axis, PixelFit]
    periods_px: Mapping[Axis, float]
    planes: Mapping[str, Plane]
    depth_axis: Axis

    name = "pixelwise"

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The captured axes."""
        return tuple(self.fits)

    def points(self, phase: PhaseMap) -> NDArray[np.float32]:
        """Return points (h, w, 3) float32 mm; NaN where phase or fit are invalid, or too far from
        the fitted range."""
        fit = self.fits[phase.axis]
        out = np.empty((*phase.phase.shape, 3), np.float32)
        ratio = phase.period_px / self.periods_px[phase.axis]
        _evaluate(
            phase.phase,
            ratio,
            fit.coefficients,
            fit.phase_min,
            fit.phase_max,
            MAX_EXTRAPOLATION,
            out,
        )
        return out

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """Return the depth noise (h, w) float32 mm predicted from the phase noise, ``|dz/dphi|
        sigma_phi``."""
        c0, c1, c2 = self.fits[phase.axis].coefficients[:3]
        ratio = phase.period_px / self.periods_px[phase.axis]
        per_rad = np.abs(c1 - c0 * c2) / (1 + c2 * (ratio * phase.phase)) ** 2
        return (per_rad * ratio * phase.sigma_phase).astype(np.float32)

    def median_rms_mm(self, axis: Axis) -> dict[str, float]:
        """Return the median of the pixels' RMS residuals in z, x and y."""
        z, x, y = (float(np.nanmedian(r)) for r in self.fits[axis].rms_mm)
        return {"z": z, "x": x, "y": y}

    def describe(self) -> PixelwiseFit:
        """Return the figures of the fits, medians over the pixels."""
        axes = {}
        for axis, fit in self.fits.items():
            fitted = np.isfinite(fit.coefficients[0])
            poses = float(np.median(fit.poses[fitted]))
            axes[str(axis)] = AxisFit(
                float(fitted.mean()), poses, *self.median_rms_mm(axis).values()
            )
        return PixelwiseFit(axes)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        keys = PixelFit.__annotations__
        return {
            f"{axis}_{key}": getattr(fit, key) for axis, fit in self.fits.items() for key in keys
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that are not images, as JSON types."""
        planes = {
            name: [*plane.normal.tolist(), plane.offset] for name, plane in self.planes.items()
        }
        return {
            "periods_px": dict(self.periods_px),
            "planes": planes,
            "depth_axis": self.depth_axis,
        }

    @classmethod
    def from_arrays(
        cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> "PixelwiseModel":
        """Return the model that ``to_dict`` and ``to_arrays`` saved."""
        keys = PixelFit.__annotations__
        fits = {
            axis: PixelFit(**{key: arrays[f"{axis}_{key}"] for key in keys})
            for axis in data["periods_px"]
        }
        planes = {
            name: Plane(np.array(values[:3]), values[3]) for name, values in data["planes"].items()
        }
        return cls(fits, data["periods_px"], planes, data["depth_axis"])


def calibrate_pixelwise(
    observations: Sequence[Observation],
    stereo: StereoModel,
    progress: Callable[[float], None] | None = None,
) -> PixelwiseModel:
    """Fit the pixel-wise model of each captured axis (steps 3 to 5) to the poses that the stereo
    calibration used.

    Raises CalibrationRejected when no pixel has at least 4 poses.
    """
    used = [o for o in observations if o.name in stereo.poses]
    if len(used) < MIN_POSES:
        raise CalibrationRejected(
            f"{len(used)} usable poses, and a pixel needs at least {MIN_POSES}: capture the board"
            " in more positions"
        )
    depth_axis = best_axis(used, stereo)
    planes = {o.name: ideal_plane(o, stereo, depth_axis) for o in used}
    z_ref = mid_depth(stereo)
    width, height = used[0].size
    axes = [axis for axis in stereo.axes if all(axis in o.surfaces for o in used)]
    periods = {axis: used[0].periods_px[axis] for axis in axes}
    fits = {axis: _empty_fit(height, width) for axis in axes}
    band = max(1, min(height, BAND_BYTES // (8 * len(used) * width * (len(axes) + 1))))
    # allocated once: new memory is slow at first
    buffer = np.empty((len(axes) + 1, len(used) * band * width))
    for first in range(0, height, band):
        rows = slice(first, min(first + band, height))
        phases, z, rays = _collect_rows(
            used, stereo, planes, axes, periods, depth_axis, rows, buffer
        )
        for axis in axes:
            reference = _reference_phase(stereo, axis, periods[axis], z_ref, rows)
            _fit_rows(phases[axis], z, reference, z_ref, rays, rows, fits[axis])
        if progress:
            progress(rows.stop / height)
    if not any((fit.poses >= MIN_POSES).any() for fit in fits.values()):
        raise CalibrationRejected(
            f"no pixel has a view of the board in {MIN_POSES} poses or more: let the poses overlap"
            " in the image"
        )
    return PixelwiseModel(fits, periods, planes, depth_axis)


def pixel_samples(
    observations: Sequence[Observation],
    stereo: StereoModel,
    model: PixelwiseModel,
    axis: Axis,
    pixel: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples that one pixel (u, v) was fitted to: phase (n,) rad and ideal points (n,
    3) mm, one per pose.

    The phase is in the model's ``periods_px``.
    """
    u, v = pixel
    phases, points = [], []
    for o in observations:
        u0, v0, u1, v1 = o.box
        if o.name not in model.planes or not (
            u0 <= u < u1 and v0 <= v < v1 and o.region[v - v0, u - u0]
        ):
            continue
        coordinate = o.surfaces[model.depth_axis].evaluate(np.array([u]), np.array([v]))
        coordinate *= o.periods_px[model.depth_axis] / (2 * np.pi)
        X = triangulate_pixels(stereo.rig, np.array([[u, v]], float), coordinate, model.depth_axis)[
            0
        ]
        plane = model.planes[o.name]
        points.append(X - (X @ plane.normal - plane.offset) * plane.normal)
        phase = float(o.surfaces[axis].evaluate(np.array([u]), np.array([v]))[0])
        phases.append(phase * o.periods_px[axis] / model.periods_px[axis])
    return np.array(phases), np.array(points).reshape(-1, 3)


def mid_depth(stereo: StereoModel) -> float:
    """Return the middle of the calibrated depths, mm; raises CalibrationRejected for an imported
    stereo calibration."""
    if stereo.depth_range_mm is None:
        raise CalibrationRejected(
            "the stereo calibration was imported, without poses to fit pixels to: calibrate from"
            " target poses"
        )
    return float(np.mean(stereo.depth_range_mm))


def best_axis(observations: Sequence[Observation], stereo: StereoModel) -> Axis:
    """Return the axis whose coordinate changes most with depth, at mid depth."""
    z = np.full(observations[0].size[::-1], mid_depth(stereo))
    sensitivity = {
        axis: float(np.nanmedian(depth_per_px(stereo.rig, axis, z))) for axis in stereo.axes
    }
    return min(stereo.axes, key=lambda axis: sensitivity[axis])


def ideal_plane(observation: Observation, stereo: StereoModel, axis: Axis) -> Plane:
    """Fit a plane to the stereo reconstruction of a pose's smoothed phase (step 3, eq. 12)."""
    u0, v0, u1, v1 = observation.box
    step = max(1, int(((u1 - u0) * (v1 - v0) / PLANE_PIXELS) ** 0.5))
    v, u = np.nonzero(observation.region[::step, ::step])
    v, u = v0 + v * step, u0 + u * step
    coordinate = observation.surfaces[axis].evaluate(u, v) * (
        observation.periods_px[axis] / (2 * np.pi)
    )
    points = triangulate_pixels(stereo.rig, np.column_stack([u, v]).astype(float), coordinate, axis)
    finite = points[np.isfinite(points[:, 2])]
    if len(finite) < 100:
        raise CalibrationRejected(
            f"{observation.name}: stereo reconstructs {len(finite)} points of the board: exclude"
            " this pose"
        )
    return fit_plane(finite)


def _collect_rows(
    used: Sequence[Observation],
    stereo: StereoModel,
    planes: Mapping[str, Plane],
    axes: Sequence[Axis],
    periods: Mapping[Axis, float],
    depth_axis: Axis,
    rows: slice,
    buffer: np.ndarray,
) -> tuple[dict[Axis, np.ndarray], np.ndarray, np.ndarray]:
    """Collect the samples of all poses in some image rows.

    Returns the phase (n, h', w) rad of each axis in ``periods``, the depth (n, h', w) mm, both
    views of ``buffer``, and the sums (h', w, 6) for ``x = c3 z`` and ``y = c4 z`` (eq. 10, 11).
    Stereo's points are projected along the plane's normal onto it (step 4, eq. 13); NaN outside a
    pose's board.
    """
    rig, width = stereo.rig, used[0].size[0]
    shape = len(used), rows.stop - rows.start, width
    *axis_phases, z = (each[: np.prod(shape)].reshape(shape) for each in buffer)
    phases, sums = dict(zip(axes, axis_phases, strict=True)), np.zeros((*shape[1:], 6))
    for each in (*axis_phases, z):
        each.fill(np.nan)
    extent = np.array(rig.projector.size, float)
    for i, o in enumerate(used):
        u0, v0, u1, v1 = o.box
        first, last = max(rows.start, v0), min(rows.stop, v1)
        if first >= last:
            continue
        here, box = (
            (last - first, u1 - u0),
            (
                slice(first - rows.start, last - rows.start),
                slice(u0, u1),
            ),
        )
        region = _region_rows(o, first - v0, last - v0)
        smooth = {
            axis: o.surfaces[axis].evaluate_grid(here, (u0, first)) for axis in {*axes, depth_axis}
        }
        for axis in axes:
            np.multiply(
                smooth[axis],
                o.periods_px[axis] / periods[axis],
                out=phases[axis][i][box],
                where=region,
            )
        plane = planes[o.name]
        _project_onto_plane(
            smooth[depth_axis], region, o.periods_px[depth_axis] / (2 * np.pi), rig.camera.rays(),
            first, u0,
            rig.R.copy(), rig.t.copy(), rig.projector.parameters, 0 if depth_axis == "x" else 1,
            extent,
            plane.normal, plane.offset, z[i], sums, first - rows.start,
        )  # fmt: skip
    return phases, z, sums


def _region_rows(o: Observation, first: int, last: int) -> np.ndarray:
    """Unpack rows ``first`` to ``last`` of an observation's region, (last - first, width) bool."""
    width = o.box[2] - o.box[0]
    start, stop = first * width, last * width
    bits = np.unpackbits(o.packed_region[start // 8 : -(-stop // 8)])
    return bits[start % 8 :][: stop - start].view(bool).reshape(last - first, width)


def _reference_phase(
    stereo: StereoModel, axis: Axis, period_px: float, z: float, rows: slice
) -> np.ndarray:
    """Return the phase (h', w) rad that stereo predicts at depth ``z`` mm; 0 outside the
    projector's image."""
    rays = stereo.rig.camera.rays()[rows]
    points = np.dstack([rays * z, np.full(rays.shape[:2], z)])
    coordinate = stereo.rig.project(points)[..., 0 if axis == "x" else 1]
    return np.nan_to_num(2 * np.pi * coordinate / period_px)


def _empty_fit(height: int, width: int) -> PixelFit:
    """Allocate a fit for an image."""
    shape = height, width
    poses, coefficients = np.zeros(shape, np.uint16), np.empty((5, *shape))
    rms, least, most, condition = (np.empty((*n, *shape), np.float32) for n in ((3,), (), (), ()))
    return PixelFit(coefficients, rms, poses, least, most, condition)


def _fit_rows(
    phase: np.ndarray,
    z: np.ndarray,
    phase_ref: np.ndarray,
    z_ref: float,
    rays: np.ndarray,
    rows: slice,
    fit: PixelFit,
) -> None:
    """Fill the ``rows`` of ``fit`` from the samples of ``_collect_rows`` (step 5)."""
    a, rms_z = np.empty((3, *phase.shape[1:])), np.empty(phase.shape[1:])
    poses, least, most = fit.poses[rows], fit.phase_min[rows], fit.phase_max[rows]
    fit_rational(
        phase, z, phase_ref, z_ref, MIN_POSES, a, rms_z, poses, least, most, fit.condition[rows]
    )
    a0, a1, a2 = a
    # zeta = (a0 + a1 s)/(1 + a2 s) with s = phi - r and z = z_ref + zeta, back in the Letter's own
    # terms
    b0, b1 = a0 + z_ref, a1 + z_ref * a2
    scale = 1 - a2 * phase_ref
    n, zz, xz, yz, xx, yy = np.moveaxis(rays, -1, 0)
    c, rms = fit.coefficients[:, rows], fit.rms_mm[:, rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        c[0], c[1], c[2], c[3], c[4] = (
            (b0 - b1 * phase_ref) / scale,
            b1 / scale,
            a2 / scale,
            xz / zz,
            yz / zz,
        )
        rms[0], rms[1], rms[2] = (
            rms_z, np.sqrt(np.maximum(xx - c[3] * xz, 0) / n),
            np.sqrt(np.maximum(yy - c[4] * yz, 0) / n)
        )  # fmt: skip
    missing = ~np.isfinite(c).all(0)
    c[:, missing] = np.nan
    rms[:, missing] = np.nan


@kernel(parallel=True)
def _project_onto_plane(  # type: ignore[no-untyped-def]
    phase,
    region,
    px_per_rad,
    rays,
    v0,
    u0,
    R,
    t,
    parameters,
    row,
    extent,
    normal,
    offset,
    z,
    sums,
    first,
):
    """Fill depths ``z`` and ``sums`` with stereo's points projected along the ``normal`` onto their
    plane.

    ``phase`` and ``region`` start at pixel (u0, v0), and at row ``first`` of ``z`` and ``sums``.
    """
    low, high = -0.5 - MARGIN * extent[row], (1.0 + MARGIN) * extent[row] - 0.5
    for i in prange(phase.shape[0]):
        shift = 0.0  # the neighbour's distortion is a guess that saves a step or two
        for j in range(phase.shape[1]):
            measured = phase[i, j] * px_per_rad
            if not (region[i, j] and low <= measured <= high):
                continue
            uc, vc = rays[v0 + i, u0 + j, 0], rays[v0 + i, u0 + j, 1]
            depth, new, _ = ray_depth(uc, vc, measured, shift, R, t, parameters, row, extent)
            if np.isnan(depth) and shift != 0.0:
                depth, new, _ = ray_depth(uc, vc, measured, 0.0, R, t, parameters, row, extent)
            shift = new
            if np.isnan(depth):
                continue
            off = depth * (uc * normal[0] + vc * normal[1] + normal[2]) - offset
            X, Y, Z = (
                uc * depth - off * normal[0],
                vc * depth - off * normal[1],
                depth - off * normal[2],
            )
            z[first + i, u0 + j] = Z
            a = sums[first + i, u0 + j]
            a[0] += 1.0
            a[1] += Z * Z
            a[2] += X * Z
            a[3] += Y * Z
            a[4] += X * X
            a[5] += Y * Y


@kernel(parallel=True)
def _evaluate(phase, ratio, c, phase_min, phase_max, reach, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (h, w, 3) with the points of phases times ``ratio``; NaN beyond the fitted range
    and ``reach``."""
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
