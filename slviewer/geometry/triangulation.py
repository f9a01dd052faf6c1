"""Depth from one projector coordinate per camera pixel, exact under both lenses' distortion."""

import math
from collections.abc import Iterable
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.brown import distort_point
from slviewer.geometry.jit import kernel, read_only, run_rows
from slviewer.geometry.rig import StereoRig

Axis = Literal["x", "y"]
TOLERANCE_PX = 1e-7
"""How far the distorted projection of the result may be from the measured coordinate."""
MAX_STEPS = 25
_NOWHERE = (math.nan,) * 5
_NO_DEPTH = (math.nan, 0.0, math.nan)
CHUNK = 1024
MARGIN = 0.1
"""A point may fall outside the projector's image by this share of its width and height: a
calibration's own error is smaller, and points further out were never illuminated."""


def triangulate(rig: StereoRig, coordinate: np.ndarray, axis: Axis) -> np.ndarray:
    """Depth (h, w) float64 mm of each camera pixel from its projector column (axis x) or row (axis
    y).

    ``coordinate``: (h, w) px, NaN where invalid. Starts from Letter eq. 6, whose projector
    coordinate is normalised without undistorting it (that needs the other coordinate, not known
    yet), then Newton steps on z until the *distorted* projection meets the measured coordinate. NaN
    where the coordinate is invalid, the point would lie behind a device, more than a tenth outside
    the projector's image or past the fold of a lens, or the steps do not converge. Raises
    InputError where the map has not the camera's image size.
    """
    check_map(rig.camera.size, coordinate, "projector coordinates")
    z = _solve(rig, rig.camera.rays().reshape(-1, 2), np.asarray(coordinate).reshape(-1), axis)
    return z.reshape(np.shape(coordinate))


def triangulate_pixels(
    rig: StereoRig, pixels: np.ndarray, coordinate: np.ndarray, axis: Axis
) -> np.ndarray:
    """Points (n, 3) mm in the camera's frame of scattered camera pixels (n, 2) and their projector
    coordinate (n,) px.

    NaN rows under the same conditions as ``triangulate``.
    """
    rays = rig.camera.undistort(pixels)
    z = _solve(rig, rays, coordinate, axis)
    return np.column_stack([rays * z[:, None], z])


def depth_per_px(rig: StereoRig, axis: Axis, z: np.ndarray) -> np.ndarray:
    """|dz/du_p| (h, w) float64, mm per projector px, along each camera pixel's ray at its depth
    ``z`` (h, w) mm.

    What a projector coordinate's uncertainty becomes in depth; NaN where z is, or where the point
    cannot be projected.
    """
    check_map(rig.camera.size, z, "depths")
    slopes = np.empty(np.size(z))
    rays = _as_read_only(rig.camera.rays().reshape(-1, 2))
    depths = _as_read_only(np.ravel(z))
    run_rows(
        _coordinate_slopes, len(slopes), rays, depths, *_projector(rig, axis), slopes,
        multiple=CHUNK,
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        return np.abs(1.0 / slopes).reshape(np.shape(z))


def points_from_depth(rays: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Camera-frame points (h, w, 3) float32 mm from rays (h, w, 2) and depths (h, w) mm: eq. 7,
    8."""
    points = np.empty((*z.shape, 3), dtype=np.float32)
    points[..., :2] = rays * z[..., None]
    # a pixel without a ray is invalid as a whole
    points[..., 2] = np.where(np.isnan(points[..., 0]), np.nan, z)
    return points


def _solve(rig: StereoRig, rays: np.ndarray, coordinate: np.ndarray, axis: Axis) -> np.ndarray:
    """Depths (n,) of rays (n, 2) at projector coordinates (n,)."""
    z = np.empty(len(rays))
    extent = np.array(rig.projector.size, dtype=np.float64)
    run_rows(
        _triangulate_all, len(z), _as_read_only(rays), _as_read_only(coordinate),
        *_projector(rig, axis), extent, z, multiple=CHUNK,
    )  # fmt: skip
    return z


def _projector(rig: StereoRig, axis: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return the projector as the kernels take it: R, t, the lens's parameters, and the index of
    the axis' coordinate, 0 for x (columns), 1 for y (rows)."""
    return rig.R.copy(), rig.t.copy(), rig.projector.parameters, 0 if axis == "x" else 1


def check_map(size: Iterable[float], values: np.ndarray, what: str) -> None:
    """Raise InputError unless a map has the size (width, height) of the camera's image."""
    width, height = map(int, size)
    if np.shape(values) != (height, width):
        raise InputError(
            f"A map of {what} of shape {np.shape(values)} was given, and the camera was calibrated"
            f" at {width}x{height} px",
            "use captures of the same camera, at the same resolution and without cropping.",
        )


def _as_read_only(values: np.ndarray) -> np.ndarray:
    """Convert to read-only contiguous float64: one array type for the kernels, so that they compile
    once."""
    return read_only(np.ascontiguousarray(values, dtype=np.float64))


@kernel()
def _rotate_ray(R, uc, vc):
    """Return the ray (uc, vc, 1) rotated by R."""
    return (
        R[0, 0] * uc + R[0, 1] * vc + R[0, 2],
        R[1, 0] * uc + R[1, 1] * vc + R[1, 2],
        R[2, 0] * uc + R[2, 1] * vc + R[2, 2],
    )


@kernel()
def _projection(z, a0, a1, a2, t, parameters, row):
    """Of the point at depth z: (measured coordinate, the other one, d(measured)/dz,
    d(undistorted)/dz, undistorted).

    The point is z a + t in the projector's frame, a = R (u_c, v_c, 1); NaN where it cannot be
    projected.
    """
    depth = z * a2 + t[2]
    if not (z > 0.0 and depth > 0.0):
        return _NOWHERE
    inverse = 1.0 / depth
    x, y = (z * a0 + t[0]) * inverse, (z * a1 + t[1]) * inverse
    if not x * x + y * y < parameters[9]:
        return _NOWHERE
    dx = (a0 * t[2] - t[0] * a2) * inverse * inverse
    dy = (a1 * t[2] - t[1] * a2) * inverse * inverse
    xd, yd, dxx, dxy, dyy = distort_point(x, y, parameters)
    u, v = parameters[0] * xd + parameters[2], parameters[1] * yd + parameters[3]
    if row == 0:
        return u, v, parameters[0] * (dxx * dx + dxy * dy), parameters[0] * dx, x
    return v, u, parameters[1] * (dxy * dx + dyy * dy), parameters[1] * dy, y


@kernel()
def ray_depth(uc, vc, measured, shift, R, t, parameters, row, extent):
    """(depth of one ray, undistorted minus distorted normalised coordinate there, px a mm of
    depth); NaN as ``triangulate`` says.

    ``shift``: initial value of the second.
    """
    a0, a1, a2 = _rotate_ray(R, uc, vc)
    a = a0 if row == 0 else a1
    reading = (measured - parameters[2 + row]) / parameters[row]
    up = reading + shift
    denominator = a - a2 * up
    if denominator == 0.0:
        return _NO_DEPTH
    z = -(t[row] - t[2] * up) / denominator  # Letter eq. 6; rows 2 and 3 of M for axis y
    u, other, slope, straight, undistorted = _projection(z, a0, a1, a2, t, parameters, row)
    error = measured - u
    for _ in range(MAX_STEPS):
        if abs(error) <= TOLERANCE_PX:
            size = extent[1 - row]
            if not -0.5 - MARGIN * size <= other <= (1.0 + MARGIN) * size - 0.5:
                return _NO_DEPTH
            # where distortion turns the coordinate back along the ray, two depths share it:
            # ambiguous, so invalid
            return (z if slope * straight > 0.0 else math.nan), undistorted - reading, slope
        if not abs(error) < math.inf or slope == 0.0:
            return _NO_DEPTH
        step = error / slope
        damping = 1.0
        while True:  # shorten the step until it stays in view and comes nearer
            nz = z + damping * step
            nu, other, slope, straight, undistorted = _projection(
                nz, a0, a1, a2, t, parameters, row
            )
            if abs(measured - nu) < abs(error):
                break
            damping *= 0.5
            if damping < 1e-3:
                return _NO_DEPTH
        z, error = nz, measured - nu
    return _NO_DEPTH


@kernel()
def _triangulate_all(first, last, rays, coordinate, R, t, parameters, row, extent, z):
    """Fill ``z`` (n,) mm with the depths of rays (n, 2) at projector coordinates (n,); NaN where
    there is none."""
    size = extent[row]
    low, high = -0.5 - MARGIN * size, (1.0 + MARGIN) * size - 0.5
    for chunk in range(first, last, CHUNK):
        # the neighbour's distortion is a guess that saves a step or two; a chunk's first ray has
        # none
        shift = 0.0
        for i in range(chunk, min(chunk + CHUNK, last)):
            uc, vc, measured = rays[i, 0], rays[i, 1], coordinate[i]
            z[i] = np.nan
            if low <= measured <= high:  # False for NaN
                z[i], new, _ = ray_depth(uc, vc, measured, shift, R, t, parameters, row, extent)
                if np.isnan(z[i]) and shift != 0.0:
                    z[i], new, _ = ray_depth(uc, vc, measured, 0.0, R, t, parameters, row, extent)
                shift = new


@kernel()
def _coordinate_slopes(first, last, rays, depths, R, t, parameters, row, slopes):
    """Fill ``slopes`` (n,) with d(projector coordinate)/dz in px per mm of rays (n, 2) at depths
    (n,) mm."""
    for i in range(first, last):
        a0, a1, a2 = _rotate_ray(R, rays[i, 0], rays[i, 1])
        _, _, slopes[i], _, _ = _projection(depths[i], a0, a1, a2, t, parameters, row)
