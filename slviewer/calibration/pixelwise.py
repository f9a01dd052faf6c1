"""The pixel-wise rational model (the Letter, steps 2 to 5).

For every camera pixel ``z = (c0 + c1 phi)/(1 + c2 phi)`` (eq. 9), ``x = c3 z`` and ``y = c4 z``
(eq. 10, 11), fitted to target poses that stereo reconstructed and that were projected onto their
ideal planes (eq. 12, 13).

The fit works with moments in float64, some image rows at a time. Depth and phase are relative to a
reference point of each pixel (``zeta = z - z_ref``, ``s = phi - phi_ref``), which leaves the
rational family as it is, ``zeta = (a0 + a1 s)/(1 + a2 s)``, and keeps the sums well conditioned.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slviewer.calibration.observe import Observation, combine_observed
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rigid import Floats, Floats32, move_points
from slviewer.geometry.shapes import Plane, fit_plane
from slviewer.geometry.triangulation import MARGIN, depth_per_px, ray_depth, triangulate_pixels
from slviewer.geometry.vectors import diagonal, lengths
from slviewer.records.calibration import AxisFit, PixelwiseFit
from slviewer.records.record import from_plain

PLANE_PIXELS = 30_000
"""Approximate number of pixels in a pose's plane fit; the phase is smooth, and more pixels do not
change the plane."""
BAND_BYTES = 2**27
"""Memory for the band of image rows that is fitted at a time; the band is narrower the more poses
there are."""
MIN_POSES = 4
"""One pose more than coefficients, so that the fit's RMS is meaningful."""
SAME_PLACE = 0.01
"""Largest distance of a feature from its place in another pose, over the board's diagonal, with
which the board did not move between them: 2 mm of 225."""
POSES_FOR_PIXELWISE = 8
"""With fewer poses a pixel's own fit is noisier than what it corrects, and stereo is the better
default."""
_UNSOLVED = (np.nan,) * 5
MAX_EXTRAPOLATION = 1.5
"""Largest extrapolation beyond a pixel's calibrated phase range, in lengths of that range."""


@dataclass(frozen=True)
class PixelFit:
    """Fit of one axis: ``coefficients`` (5, h, w) float64 c0 ... c4 for phase in rad and depth in
    mm, or NaN.

    ``rms_mm`` (3, h, w): RMS residuals in z, x and y; ``poses`` (h, w): number of poses of each
    pixel, those at one place counted once; ``phase_min`` and ``phase_max`` (h, w) rad: their phase
    range; ``condition`` (h, w): condition number of the fit of eq. 9.
    """

    coefficients: Floats
    rms_mm: Floats32
    poses: NDArray[np.uint16]
    phase_min: Floats32
    phase_max: Floats32
    condition: Floats32


@dataclass(frozen=True)
class PixelwiseModel:
    """The Letter's calibration: a rational function of the phase for each camera pixel and captured
    axis.

    ``periods_px`` is the fringe period of the coefficients' phase; the phase of captures with
    another period is converted. ``planes`` are the ideal planes of the target poses (eq. 12),
    reconstructed from ``depth_axis``. ``area``: the part of the camera's image that changes, all of
    it if None.
    """

    fits: Mapping[Axis, PixelFit]
    periods_px: Mapping[Axis, float]
    planes: Mapping[str, Plane]
    depth_axis: Axis
    area: ImageArea | None = None

    name = "pixelwise"

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The captured axes."""
        return tuple(self.fits)

    def points(self, phase: PhaseMap) -> Floats32:
        """Return points (h, w, 3) float32 mm; NaN where phase or fit are invalid, or too far from
        the fitted range."""
        fit = self.fits[phase.axis]
        out = np.empty((*phase.phase.shape, 3), np.float32)
        ratio = phase.period_px / self.periods_px[phase.axis]
        run_rows(
            _evaluate,
            len(out),
            phase.phase,
            ratio,
            fit.coefficients,
            fit.phase_min,
            fit.phase_max,
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
            pixels = fitted.size if self.area is None else self.area.area_px
            share = min(np.count_nonzero(fitted) / pixels, 1.0)
            axes[str(axis)] = AxisFit(share, poses, *self.median_rms_mm(axis).values())
        return PixelwiseFit(axes)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving."""
        keys = PixelFit.__annotations__
        arrays = {
            f"{axis}_{key}": getattr(fit, key) for axis, fit in self.fits.items() for key in keys
        }
        return arrays | (self.area.to_arrays() if self.area else {})

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
        """Return the model that ``to_dict`` and ``to_arrays`` saved. Raises InputError that names
        an invalid field."""
        saved = from_plain(data, _SavedModel)
        keys = PixelFit.__annotations__
        fits = {
            axis: PixelFit(**{key: arrays[f"{axis}_{key}"] for key in keys})
            for axis in saved["periods_px"]
        }
        planes = {
            name: Plane(np.array(normal), offset)
            for name, (*normal, offset) in saved["planes"].items()
        }
        area = ImageArea.from_arrays(arrays)
        return cls(fits, saved["periods_px"], planes, saved["depth_axis"], area)


class _SavedModel(TypedDict):
    """What `PixelwiseModel.to_dict` returns."""

    periods_px: dict[Axis, float]
    planes: dict[str, tuple[float, float, float, float]]
    depth_axis: Axis


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
            f"{len(used)} usable poses, and a pixel needs at least {MIN_POSES}",
            "capture the board in more positions",
        )
    depth_axis = best_axis(used, stereo)
    width, height = used[0].size
    axes = [axis for axis in stereo.axes if all(axis in o.surfaces for o in used)]
    model = PixelwiseModel(
        {axis: _empty_fit(height, width) for axis in axes},
        {axis: used[0].periods_px[axis] for axis in axes},
        {o.name: ideal_plane(o, stereo, depth_axis) for o in used},
        depth_axis,
        combine_observed(used),
    )
    band = max(1, min(height, BAND_BYTES // (8 * len(used) * width * (len(axes) + 1))))
    # allocated once: new memory is slow at first
    buffer = np.empty((len(axes) + 1, len(used) * band * width))
    twins = list_twins(used, stereo)
    for first in range(0, height, band):
        rows = slice(first, min(first + band, height))
        phases, z, sums = _collect_rows(model, used, stereo, rows, buffer)
        for axis, phase in zip(axes, phases, strict=True):
            _fit_rows(model, axis, stereo, rows, (phase, z, sums), twins)
        if progress:
            progress(rows.stop / height)
    if not any((fit.poses >= MIN_POSES).any() for fit in model.fits.values()):
        raise CalibrationRejected(
            f"no pixel has a view of the board in {MIN_POSES} poses or more",
            "let the poses overlap in the image",
        )
    return model


def list_twins(used: Sequence[Observation], stereo: StereoModel) -> np.ndarray:
    """Return of each pose the last one before it at the same place, (n,) int64; -1 without any.

    What a pose at the place of another shows of a pixel's curve is the same: two places that were
    captured twice remain two.
    """
    boards = [move_points(stereo.poses[o.name], o.points) for o in used]
    twins = np.full(len(used), -1)
    for k, board in enumerate(boards):
        limit = SAME_PLACE * diagonal(board)
        same = [
            i
            for i, other in enumerate(boards[:k])
            if other.shape == board.shape and lengths(other - board).max() < limit
        ]
        twins[k] = max(same, default=-1)
    return twins


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
        plane = model.planes[o.name]
        at = np.array([u]), np.array([v])
        (X,) = _reconstruct(o, stereo, model.depth_axis, *at)
        points.append(X - (X @ plane.normal - plane.offset) * plane.normal)
        (phase,) = o.surfaces[axis].evaluate(*at)
        phases.append(phase * o.periods_px[axis] / model.periods_px[axis])
    return np.array(phases), np.array(points).reshape(-1, 3)


def mid_depth(stereo: StereoModel) -> float:
    """Return the middle of the calibrated depths, mm; raises CalibrationRejected for an imported
    stereo calibration."""
    if stereo.depth_range_mm is None:
        raise CalibrationRejected(
            "the stereo calibration was imported, without poses to fit pixels to",
            "calibrate from target poses",
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
    points = _reconstruct(observation, stereo, axis, u0 + u * step, v0 + v * step)
    finite = points[np.isfinite(points[:, 2])]
    if len(finite) < 100:
        raise CalibrationRejected(
            f"{observation.name}: stereo reconstructs {len(finite)} points of the board",
            "exclude this pose",
        )
    return fit_plane(finite)


def _reconstruct(
    o: Observation, stereo: StereoModel, axis: Axis, u: np.ndarray, v: np.ndarray
) -> Floats:
    """Return stereo's points (n, 3) mm of a pose's smoothed phase at camera pixels ``u``, ``v``
    (n,)."""
    pixels = np.column_stack([u, v]).astype(float)
    return triangulate_pixels(stereo.rig, pixels, o.coordinate(axis, u, v), axis)


def _collect_rows(
    model: PixelwiseModel,
    used: Sequence[Observation],
    stereo: StereoModel,
    rows: slice,
    buffer: np.ndarray,
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Collect the samples of all poses in some image rows.

    Returns the phase (n, h', w) rad of each axis, the depth (n, h', w) mm, all views of ``buffer``,
    and the sums (h', w, 6) for ``x = c3 z`` and ``y = c4 z`` (eq. 10, 11). Stereo's points are
    projected along the plane's normal onto it (step 4, eq. 13); NaN outside a pose's board.
    """
    rig, depth_axis = stereo.rig, model.depth_axis
    shape = len(used), rows.stop - rows.start, used[0].size[0]
    *phases, z = (each[: np.prod(shape)].reshape(shape) for each in buffer)
    for each in (*phases, z):
        each.fill(np.nan)
    sums = np.zeros((*shape[1:], 6))
    extent = np.array(rig.projector.size, float)
    for i, o in enumerate(used):
        u0, v0, u1, v1 = o.box
        first, last = max(rows.start, v0), min(rows.stop, v1)
        if first >= last:
            continue
        box = slice(first - rows.start, last - rows.start), slice(u0, u1)
        region = o.region_rows(first - v0, last - v0)
        smooth = {
            axis: o.surfaces[axis].evaluate_grid(region.shape, (u0, first))
            for axis in {*model.axes, depth_axis}
        }
        for axis, phase in zip(model.axes, phases, strict=True):
            ratio = o.periods_px[axis] / model.periods_px[axis]
            np.multiply(smooth[axis], ratio, out=phase[i][box], where=region)
        plane = model.planes[o.name]
        run_rows(
            _project_onto_plane,
            len(region),
            smooth[depth_axis], region, o.periods_px[depth_axis] / (2 * np.pi),
            rig.camera.rays()[first:last, u0:u1], rig.R.copy(), rig.t.copy(),
            rig.projector.parameters, "xy".index(depth_axis), extent, plane.normal, plane.offset,
            z[i][box], sums[box],
        )  # fmt: skip
    return phases, z, sums


def _empty_fit(height: int, width: int) -> PixelFit:
    """Allocate a fit for an image."""
    shape = height, width
    poses, coefficients = np.zeros(shape, np.uint16), np.empty((5, *shape))
    rms, least, most, condition = (np.empty((*n, *shape), np.float32) for n in ((3,), (), (), ()))
    return PixelFit(coefficients, rms, poses, least, most, condition)


def _fit_rows(
    model: PixelwiseModel,
    axis: Axis,
    stereo: StereoModel,
    rows: slice,
    samples: tuple[np.ndarray, np.ndarray, np.ndarray],
    twins: np.ndarray,
) -> None:
    """Fill the ``rows`` of an axis' fit from its ``samples`` by ``_collect_rows`` (step 5);
    ``twins``: by ``list_twins``.

    The reference of each pixel is the phase that stereo predicts at mid depth; 0 outside the
    projector's image.
    """
    (phase, z, sums), fit, z_ref = samples, model.fits[axis], mid_depth(stereo)
    rays = stereo.rig.camera.rays()[rows]
    middle = np.dstack([rays * z_ref, np.full(rays.shape[:2], z_ref)])
    coordinate = stereo.rig.project(middle)[..., "xy".index(axis)]
    phase_ref = np.nan_to_num(2 * np.pi * coordinate / model.periods_px[axis])
    a, rms_z = np.empty((3, *phase.shape[1:])), np.empty(phase.shape[1:])
    poses, least, most = fit.poses[rows], fit.phase_min[rows], fit.phase_max[rows]
    run_rows(
        fit_rational,
        phase.shape[1],
        phase,
        z,
        twins,
        phase_ref,
        z_ref,
        MIN_POSES,
        a,
        rms_z,
        poses,
        least,
        most,
        fit.condition[rows],
    )
    a0, a1, a2 = a
    # zeta = (a0 + a1 s)/(1 + a2 s) with s = phi - r and z = z_ref + zeta, back in the Letter's own
    # terms
    b0, b1 = a0 + z_ref, a1 + z_ref * a2
    scale = 1 - a2 * phase_ref
    n, zz, xz, yz, xx, yy = np.moveaxis(sums, -1, 0)
    c, rms = fit.coefficients[:, rows], fit.rms_mm[:, rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        c[:3] = (b0 - b1 * phase_ref) / scale, b1 / scale, a2 / scale
        c[3], c[4], rms[0] = xz / zz, yz / zz, rms_z
        rms[1] = np.sqrt(np.maximum(xx - c[3] * xz, 0) / n)
        rms[2] = np.sqrt(np.maximum(yy - c[4] * yz, 0) / n)
    missing = ~np.isfinite(c).all(0)
    c[:, missing] = rms[:, missing] = np.nan


@kernel()
def _project_onto_plane(  # type: ignore[no-untyped-def]
    first,
    last,
    phase,
    region,
    px_per_rad,
    rays,
    R,
    t,
    parameters,
    row,
    extent,
    normal,
    offset,
    z,
    sums,
):
    """Fill depths ``z`` and ``sums`` with stereo's points projected along the ``normal`` onto their
    plane."""
    low, high = -0.5 - MARGIN * extent[row], (1.0 + MARGIN) * extent[row] - 0.5
    for i in range(first, last):
        shift = 0.0  # the neighbour's distortion is a guess that saves a step or two
        for j in range(phase.shape[1]):
            measured = phase[i, j] * px_per_rad
            if not (region[i, j] and low <= measured <= high):
                continue
            uc, vc = rays[i, j, 0], rays[i, j, 1]
            depth, new, _ = ray_depth(uc, vc, measured, shift, R, t, parameters, row, extent)
            if np.isnan(depth) and shift != 0.0:
                depth, new, _ = ray_depth(uc, vc, measured, 0.0, R, t, parameters, row, extent)
            shift = new
            if np.isnan(depth):
                continue
            off = depth * (uc * normal[0] + vc * normal[1] + normal[2]) - offset
            X, Y = uc * depth - off * normal[0], vc * depth - off * normal[1]
            Z = depth - off * normal[2]
            z[i, j] = Z
            a = sums[i, j]
            a[0] += 1.0
            a[1] += Z * Z
            a[2] += X * Z
            a[3] += Y * Z
            a[4] += X * X
            a[5] += Y * Y


@kernel()
def _evaluate(first, last, phase, ratio, c, phase_min, phase_max, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (h, w, 3) with the points of phases times ``ratio``; NaN too far beyond the
    fitted range."""
    for v in range(first, last):
        for u in range(phase.shape[1]):
            p = ratio * np.float64(phase[v, u])
            margin = MAX_EXTRAPOLATION * (phase_max[v, u] - phase_min[v, u])
            denominator = 1.0 + c[2, v, u] * p
            z = (c[0, v, u] + c[1, v, u] * p) / denominator
            inside = p >= phase_min[v, u] - margin and p <= phase_max[v, u] + margin
            if not (inside and z > 0.0):
                z = np.nan
            out[v, u, 0] = c[3, v, u] * z
            out[v, u, 1] = c[4, v, u] * z
            out[v, u, 2] = z


@kernel()
def fit_rational(
    first,
    last,
    phase,
    z,
    twins,
    phase_ref,
    z_ref,
    min_poses,
    coefficients,
    rms,
    poses,
    phase_min,
    phase_max,
    condition,
):
    """Fit pixels of some rows to their poses: phase (n, h', w) rad and depth z (n, h', w) mm, NaN
    where invalid; ``twins`` (n,): by ``list_twins``.

    Fills ``coefficients`` (3, h', w) a0 ... a2 and ``rms`` mm, NaN at pixels of fewer than
    ``min_poses`` poses; ``poses``, the range of valid ``phase``, and the fit's ``condition``, (h',
    w) each. First the equation's own residual is minimised, which is linear, ``zeta = a0 + a1 s -
    a2 zeta s``; then one Gauss-Newton step minimises the residual in depth.
    """
    for v in range(first, last):
        a = np.empty(10)
        for u in range(phase.shape[2]):
            reference = phase_ref[v, u]
            count, low, high = _sum_linear_moments(phase, z, v, u, reference, z_ref, a)
            places = count - _count_twins(phase, z, v, u, twins)
            poses[v, u], phase_min[v, u], phase_max[v, u] = places, low, high
            a0 = a1 = a2 = residual = scaled_condition = np.nan
            if places >= min_poses:
                a0, a1, a2, _, _ = _solve_moments(a)
                if not np.isnan(a0):
                    _sum_gauss_newton_moments(phase, z, v, u, reference, z_ref, a0, a1, a2, a)
                    b0, b1, b2, explained, scaled_condition = _solve_moments(a)
                    a0, a1, a2 = a0 + b0, a1 + b1, a2 + b2
                    residual = np.sqrt(max(0.0, a[9] - explained) / count)
            coefficients[0, v, u], coefficients[1, v, u], coefficients[2, v, u] = a0, a1, a2
            rms[v, u], condition[v, u] = residual, scaled_condition


@njit
def _count_twins(phase, z, v, u, twins):
    """Return how many of a pixel's valid poses have a valid one before them at the same place."""
    count = 0
    for i in range(len(twins)):
        if twins[i] < 0 or not np.isfinite(phase[i, v, u] + z[i, v, u]):
            continue
        j = twins[i]
        while j >= 0 and not np.isfinite(phase[j, v, u] + z[j, v, u]):
            j = twins[j]
        if j >= 0:
            count += 1
    return count


@njit
def _add_moments(a, j0, j1, j2, r):
    """Add an equation ``j0 x0 + j1 x1 + j2 x2 = r`` to the sums ``a`` (10,).

    a[:6]: upper triangle of the normal matrix, a[6:9]: its right side, a[9]: sum of the squares.
    """
    a[0] += j0 * j0
    a[1] += j0 * j1
    a[2] += j0 * j2
    a[3] += j1 * j1
    a[4] += j1 * j2
    a[5] += j2 * j2
    a[6] += j0 * r
    a[7] += j1 * r
    a[8] += j2 * r
    a[9] += r * r


@njit
def _sum_linear_moments(phase, z, v, u, phase_ref, z_ref, a):
    """Fill the sums ``a`` (10,), see ``_add_moments``. Returns the number of valid poses and the
    range of their phases."""
    a[:] = 0.0
    count, low, high = 0, np.inf, -np.inf
    for i in range(phase.shape[0]):
        p = phase[i, v, u]
        s, zeta = p - phase_ref, z[i, v, u] - z_ref
        if not (np.isfinite(s) and np.isfinite(zeta)):
            continue
        _add_moments(a, 1.0, s, -zeta * s, zeta)
        count += 1
        low, high = min(low, p), max(high, p)
    return count, low, high


@njit
def _sum_gauss_newton_moments(phase, z, v, u, phase_ref, z_ref, a0, a1, a2, a):
    """Fill ``a`` (10,) with one pixel's Gauss-Newton sums for z = (a0 + a1 s) / (1 + a2 s) over the
    poses.

    ``s`` is the phase less ``phase_ref``, z less ``z_ref``; poses with NaN are skipped.
    """
    a[:] = 0.0
    for i in range(phase.shape[0]):
        s = phase[i, v, u] - phase_ref
        w = 1.0 / (1.0 + a2 * s)
        model = (a0 + a1 * s) * w
        r = z[i, v, u] - z_ref - model
        if not (np.isfinite(s) and np.isfinite(r)):
            continue
        _add_moments(a, w, s * w, -s * w * model, r)


@njit
def _solve_moments(a):
    """Solve the normal equations ``a`` by Cholesky of the normalised matrix.

    Returns the three unknowns, the sum of squares that they explain, and the condition; NaN without
    a solution.
    """
    if a[0] <= 0 or a[3] <= 0 or a[5] <= 0:
        return _UNSOLVED
    d0, d1, d2 = 1 / np.sqrt(a[0]), 1 / np.sqrt(a[3]), 1 / np.sqrt(a[5])
    m01, m02, m12 = a[1] * d0 * d1, a[2] * d0 * d2, a[4] * d1 * d2
    y0, b1, b2 = a[6] * d0, a[7] * d1, a[8] * d2
    l11s = 1 - m01 * m01
    if not l11s > 1e-12:
        return _UNSOLVED
    l11 = np.sqrt(l11s)
    l21 = (m12 - m01 * m02) / l11
    l22s = 1 - m02 * m02 - l21 * l21
    if not l22s > 1e-12:
        return _UNSOLVED
    l22 = np.sqrt(l22s)
    y1 = (b1 - m01 * y0) / l11
    y2 = (b2 - m02 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    x0 = y0 - m01 * x1 - m02 * x2
    return x0 * d0, x1 * d1, x2 * d2, y0 * y0 + y1 * y1 + y2 * y2, 1 / min(l11, l22)
