"""Calibration uncertainty at the points of the working volume: systematic, so that neither longer
exposure nor repeated scans reduce it.

All uncertainties exclude a common rigid motion: the pose of the whole space in the camera's frame
is thirty times less certain than its shape, and measurements of a shape do not depend on it.

Outside the calibrated region, the fields are extrapolated by their priors. A prior assumes
independent second differences; where those of a lens are correlated, the errors exceed the prior's
prediction by a factor estimated from the fields' supported part: ``persistence_ratio``.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from slviewer.calibration.splined.bundle import Bundle
from slviewer.calibration.splined.unknowns import (
    Arrangement,
    Device,
    in_illuminated_cells,
    in_image,
    project_point,
    undistort_pixel,
)
from slviewer.errors import InputError
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rigid import Floats, Floats32, Mask, motion_jacobian
from slviewer.geometry.vectors import rms
from slviewer.records.calibration import VolumeSigma

DEPTH_FACTORS = (0.87, 1.13)
"""Of the nearest and the farthest calibrated depth: in front of them (R1), inside (R2) and behind
(R3), as the Letter measured."""
NODES = (21, 16, 11)
"""Nodes of the map across, down, and in depth: interpolation errors stay below 10 to 20 %, and a
map takes about a second."""
MIN_FITTED_POINTS = 3
EXTRAPOLATED_CELLS = 3
"""Approximate distance, in cells, of the working volume's border from the supported cells."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Points in the view of camera and projector.

    Camera ``pixels`` (n, 2), depths ``z`` (n,) mm, ``points`` (n, 3) mm in the camera's frame, and
    ``projector`` pixels (n, 2).
    """

    pixels: Floats
    z: Floats
    points: Floats
    projector: Floats

    def select(self, which: np.ndarray) -> "Volume":
        """Return some of the points."""
        return Volume(*(values[which] for values in vars(self).values()))

    def supported(
        self, rig: Arrangement, camera_illuminated: Mask, projector_illuminated: Mask
    ) -> Mask:
        """(n,) bool: points in cells (rows, columns) bool that target poses illuminated, in both
        devices."""
        return in_illuminated_cells(
            rig.camera, self.pixels, camera_illuminated
        ) & in_illuminated_cells(rig.projector, self.projector, projector_illuminated)


def working_volume(
    rig: Arrangement,
    calibrated_mm: tuple[float, float],
    columns: int = 9,
    rows: int = 7,
    depths: int = 5,
    area: ImageArea | None = None,
) -> Volume:
    """Return the points of a regular grid over the camera's image and depths that the projector's
    image contains.

    ``calibrated_mm``: nearest and farthest calibrated depth, multiplied by ``DEPTH_FACTORS``;
    ``columns``, ``rows``, ``depths`` of the grid; ``area``: the part of the image that changes, all
    of it if None. Raises InputError for an empty range of depths,
    and where the projector's image contains no point.
    """
    near, far = (factor * mm for factor, mm in zip(DEPTH_FACTORS, calibrated_mm, strict=True))
    if not 0 < near < far:
        raise InputError(f"calibrated depths {calibrated_mm} mm leave no volume")
    width, height = rig.camera.size
    u0, v0, u1, v1 = area.bounds if area else (0, 0, width, height)
    u, v = np.linspace(u0, u1 - 1, columns), np.linspace(v0, v1 - 1, rows)
    grid = np.stack(np.meshgrid(u, v, np.linspace(near, far, depths), indexing="ij"), axis=-1)
    grid = grid.reshape(-1, 3)
    if area is not None:
        grid = grid[area.contains(grid[:, :2])]
    volume = select_visible(rig, grid[:, :2], grid[:, 2])
    if not len(volume.z):
        raise InputError(
            f"camera and projector share nothing they both see at {near:.0f}-{far:.0f} mm"
        )
    return volume


def select_visible(rig: Arrangement, pixels: Floats, z: Floats) -> Volume:
    """Select the camera ``pixels`` (n, 2) at depths ``z`` (n,) mm whose points project into the
    projector's image."""
    pixels, z = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(z, np.float64)
    points, projector = view_pixels(rig, pixels, z)
    visible = np.flatnonzero(in_image(rig.projector, projector))
    return Volume(pixels, z, points, projector).select(visible)


def view_pixels(rig: Arrangement, pixels: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return points (n, 3) mm of camera ``pixels`` (n, 2) at depths ``z`` (n,) mm, and their
    projector pixels (n, 2).

    Projector pixels may be outside its image; NaN where a distortion cannot be inverted or a point
    is behind a device.
    """
    points, projector = np.empty((len(z), 3)), np.empty((len(z), 2))
    _view_all(rig, pixels, z, points, projector)
    return points, projector


def select_depth_axis(rig: Arrangement, volume: Volume) -> Axis:
    """Return the projector axis whose coordinate changes more with depth, in the median over the
    volume."""
    _, later = view_pixels(rig, volume.pixels, 1.001 * volume.z)
    across, down = np.nanmedian(np.abs(later - volume.projector), axis=0)
    return "y" if down > across else "x"


@dataclass(frozen=True, eq=False)
class BestMotion:
    """Least-squares estimator of a small rigid motion from errors of points.

    Errors (3 n,) times ``weights`` (3 n, 6) are three translations (mm), and three rotations about
    ``centre`` (3,) mm times ``arm`` mm.
    """

    weights: Floats
    centre: Floats
    arm: float

    @classmethod
    def fit(cls, points: Floats, fitted: Mask | None = None) -> "BestMotion":
        """Build the estimator for ``points`` (n, 3) mm; only those in ``fitted`` (n,) bool have
        weights.

        Raises InputError for fewer than three points.
        """
        chosen = np.ones(len(points), bool) if fitted is None else np.asarray(fitted, bool)
        if np.count_nonzero(chosen) < 3:
            raise InputError(
                f"{np.count_nonzero(chosen)} points were given", "a rigid motion needs three"
            )
        centre = points[chosen].mean(axis=0)
        arm = max(rms(points[chosen] - centre), 1e-12)
        held = _motion_basis(points, centre, arm) * np.repeat(chosen, 3)[:, None]
        return cls(np.linalg.lstsq(held.T @ held, held.T, rcond=None)[0].T, centre, arm)

    def displace(self, points: Floats) -> Floats:
        """Return the displacements (3 n, 6) of points (n, 3) mm by the six motions; x, y, z of each
        point in turn."""
        return _motion_basis(points, self.centre, self.arm)


def remove_rigid_motion(
    whitened: np.ndarray, points: Floats, fitted: Mask | None = None
) -> np.ndarray:
    """Remove the common rigid motion, to which measurements of a shape are invariant, from
    ``whitened`` (m, 3 n).

    The columns are x, y, z of the first of ``points`` (n, 3) mm, then of the next; pass a Jacobian
    by the unknowns transposed. The motion is the best fit to all points, or to those that are
    ``fitted`` (n,) bool, and is removed from all. Raises InputError where fewer than three points
    are fitted.
    """
    motion = BestMotion.fit(points, fitted)
    weights, moved = (
        each.astype(whitened.dtype) for each in (motion.weights, motion.displace(points))
    )
    return whitened - (whitened @ weights) @ moved.T


def sigma_3d(whitened: np.ndarray) -> Floats:
    """Return the 3D standard deviation (n,) mm of each point from a factor (m, 3 n) of the points'
    covariance."""
    squares = np.einsum("mn,mn->n", whitened, whitened, dtype=np.float64)
    return np.sqrt(squares.reshape(-1, 3).sum(axis=1))


def _motion_basis(points: Floats, centre: Floats, arm: float) -> Floats:
    """Return the displacements (3 n, 6) of points (n, 3) by translations and by rotations about
    ``centre``."""
    J = motion_jacobian((points - centre) / arm)
    return J[:, :, [3, 4, 5, 0, 1, 2]].reshape(-1, 6)


@dataclass(frozen=True, eq=False)
class SigmaMap:
    """Standard deviation of z for one axis: ``nodes`` (nv, nu, nz) float32 mm, evenly spaced over
    the image and from ``near`` to ``far`` mm."""

    nodes: Floats32
    near: float
    far: float

    def interpolate(self, points: np.ndarray) -> Floats32:
        """Interpolate at the organised points (h, w, 3) mm of the whole image; returns (h, w)
        float32 mm, NaN at NaN.

        The logarithm is interpolated linearly, since the value grows hundredfold where support
        ends.
        """
        out = np.empty(points.shape[:2], np.float32)
        z = np.ascontiguousarray(points[..., 2], np.float32)
        run_rows(_interpolate, len(z), z, np.log(self.nodes), self.near, self.far, out)
        return out


def compute_sigma_map(bundle: Bundle, axis: Axis, near: float, far: float) -> SigmaMap:
    """Compute the calibration's uncertainty of depths measured through one axis, in about a second.

    The rigid motion removed is that of the working volume's supported points.
    """
    rig = bundle.state.rig
    reference = working_volume(rig, bundle.depth_range_mm, 7, 5, 4, bundle.area)
    motion = BestMotion.fit(reference.points, _select_fitted(bundle, reference))
    jacobian = bundle.point_jacobian(axis, reference.pixels, reference.z)
    moved = bundle.whiten(jacobian) @ motion.weights.astype(np.float32)
    width, height = (int(n) for n in rig.camera.size)
    across, down, deep = NODES
    axes = [np.linspace(0, height - 1, down), np.linspace(0, width - 1, across)]
    v, u, z = np.meshgrid(*axes, np.linspace(near, far, deep), indexing="ij")
    pixels, nodes = np.column_stack([u.ravel(), v.ravel()]), z.ravel()
    jacobian = bundle.point_jacobian(axis, pixels, nodes)[2::3]
    jacobian.data[~np.isfinite(jacobian.data)] = 0.0
    places = Volume(pixels, nodes, *view_pixels(rig, pixels, nodes))
    by_motion = motion.displace(places.points)[2::3].astype(np.float32)
    depths = bundle.whiten(jacobian) - moved @ by_motion.T
    sigma = np.sqrt(np.einsum("mn,mn->n", depths, depths)) * extrapolation_factor(bundle, places)
    unknown = np.isnan(sigma) | (abs(jacobian).sum(axis=1).A1 == 0)
    sigma, unknown = sigma.reshape(u.shape), unknown.reshape(u.shape)
    # a measured pixel may be next to a node outside the projector's view
    nearest = scipy.ndimage.distance_transform_edt(
        unknown, return_distances=False, return_indices=True
    )
    return SigmaMap(np.ascontiguousarray(sigma[tuple(nearest)], np.float32), near, far)


def volume_sigmas(bundle: Bundle, axis: Axis, volume: Volume) -> Floats:
    """Return the 3D standard deviation (n,) mm of a volume's points, measured through one axis.

    The rigid motion of the supported points is removed.
    """
    whitened = bundle.whiten(bundle.point_jacobian(axis, volume.pixels, volume.z))
    sigma = sigma_3d(remove_rigid_motion(whitened, volume.points, _select_fitted(bundle, volume)))
    return sigma * extrapolation_factor(bundle, volume)


def extrapolation_factor(bundle: Bundle, places: Volume) -> Floats:
    """Return the factors (n,) by which the priors underestimate the standard deviations at
    ``places``.

    1 inside the calibrated region; elsewhere the ``persistence_ratio`` of the field that no pose
    illuminated there, the larger one of two.
    """
    factor = np.ones(len(places.z))
    pixels = places.pixels, places.projector
    for device, px, cells in zip(bundle.state.rig[:2], pixels, bundle.illuminated, strict=True):
        beyond = ~in_illuminated_cells(device, px, cells)
        factor[beyond] = np.maximum(factor[beyond], persistence_ratio(device, cells))
    return factor


def persistence_ratio(device: Device, illuminated: Mask) -> float:
    """Return the standard deviation of sums of a field's second differences, over that of
    independent ones; at least 1.

    The sums are over neighbouring cells that are all ``illuminated`` (rows, columns) bool.
    """
    c = device.coefficients
    known = scipy.ndimage.minimum_filter(
        np.pad(illuminated, ((0, 1), (0, 1)), mode="edge"), 2, mode="nearest"
    )
    whole = scipy.ndimage.binary_erosion(
        known, np.ones((EXTRAPOLATED_CELLS, EXTRAPOLATED_CELLS), bool)
    )
    if not whole.any():
        return 1.0
    across, down = np.diff(c[:, 1:-1], 2, axis=2), np.diff(c[:, :, 1:-1], 2, axis=1)
    each, together = 0.0, 0.0
    for differences in (*across, *down):
        each += float(np.mean(differences[known] ** 2))
        together += float(
            np.mean(scipy.ndimage.uniform_filter(differences, EXTRAPOLATED_CELLS)[whole] ** 2)
        )
    return max(1.0, EXTRAPOLATED_CELLS * float(np.sqrt(together / max(each, 1e-300))))


def summarise_volume_sigma(bundle: Bundle) -> VolumeSigma:
    """Summarise the 3D uncertainty of the working volume's points."""
    rig = bundle.state.rig
    volume = working_volume(rig, bundle.depth_range_mm, area=bundle.area)
    axis = select_depth_axis(rig, volume)
    fitted = _select_fitted(bundle, volume)
    sigma = volume_sigmas(bundle, axis, volume)
    worst = int(np.argmax(sigma))
    u, v = volume.pixels[worst].tolist()
    return VolumeSigma(
        median=float(np.median(sigma[fitted])),
        p95=float(np.percentile(sigma[fitted], 95)),
        worst=float(sigma[worst]),
        worst_at=(u, v, float(volume.z[worst])),
        supported=float(np.mean(volume.supported(rig, *bundle.illuminated))),
        depths_mm=(float(volume.z.min()), float(volume.z.max())),
        axis=axis,
    )


def _select_fitted(bundle: Bundle, volume: Volume) -> Mask:
    """Select the points (n,) bool for the fit of the rigid motion: the supported ones, or all if
    these are too few."""
    supported = volume.supported(bundle.state.rig, *bundle.illuminated)
    is_enough = np.count_nonzero(supported) >= MIN_FITTED_POINTS
    return supported if is_enough else np.ones_like(supported)


@kernel()
def _interpolate(first, last, z, logs, near, far, out):
    """Fill ``out`` (h, w) with the exponential of ``logs`` (nv, nu, nz) interpolated linearly at
    depths z (h, w)."""
    height, width = z.shape
    down, across, deep = logs.shape
    per_mm, deepest = np.float32((deep - 1.0) / (far - near)), np.float32(deep - 1.0001)
    start, zero = np.float32(near), np.float32(0.0)
    per_column = np.float32((across - 1.0001) / max(width - 1, 1))
    for v in range(first, last):
        y = v * (down - 1.0001) / max(height - 1, 1)
        j = int(y)
        rest = np.float32(y - j)
        table = logs[j] + rest * (logs[j + 1] - logs[j])  # at this row
        for u in range(width):
            depth = (z[v, u] - start) * per_mm
            x = np.float32(u) * per_column
            if np.isnan(depth):
                out[v, u] = np.nan
                continue
            depth = min(max(depth, zero), deepest)
            k, i = int(depth), int(x)
            fz, fx = depth - np.float32(k), x - np.float32(i)
            left = table[i, k] + fz * (table[i, k + 1] - table[i, k])
            right = table[i + 1, k] + fz * (table[i + 1, k + 1] - table[i + 1, k])
            out[v, u] = np.exp(left + fx * (right - left))


@kernel()
def _view_all(rig, pixels, depths, points, projector):
    """Fill ``points`` (n, 3) mm and ``projector`` (n, 2) px of camera pixels (n, 2) at depths (n,)
    mm."""
    basis = np.zeros((4, 4))
    for n in range(depths.shape[0]):
        x, y = undistort_pixel(rig.camera, pixels[n, 0], pixels[n, 1], basis)
        z = depths[n]
        points[n, 0], points[n, 1], points[n, 2] = x * z, y * z, z
        projector[n, 0], projector[n, 1] = project_point(rig, x, y, z, basis)
