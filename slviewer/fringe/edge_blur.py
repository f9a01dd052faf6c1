"""Errors of the phase where the surface's brightness jumps: the effect of the camera's blur on the fringes.

A camera pixel receives light from a neighbourhood, and more of it from the brighter side: the pixel's phase is that of
a place displaced towards that side. For a Gaussian point spread of standard deviation s the displacement is s^2 grad(ln
B), B being the blurred modulation (Tweedie's formula), so that the phase is off by s^2 grad(phi) . grad(ln B): at
silhouettes, shadows and printed edges, by far more than noise.
"""

import math

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from slviewer.geometry.jit import kernel

TILES = (4, 5)
"""Rows and columns of tiles in which the blur is estimated: it may vary over the image."""
REACH = 8
"""px: half the width of the window whose contrast is compared with the steepest slope in it."""
CONTRAST = 0.3
"""Smallest contrast of an edge, as a share of the image's median modulation."""
NOISE_RANGE = 10.0
"""Smallest contrast of an edge in standard deviations; noise alone reaches some six in a window."""
EDGES = 10
"""Number of pixels at edges below which a tile has the blur of the whole image."""
SHARPEST = 0.35
"""Quantile of the edges' widths that is used: shading and printed gradients are wider than a blurred step."""
LEAST_PX = 0.3
"""Standard deviation of an ideal pixel's own aperture, 12 ** -0.5, rounded up."""
_STEP = math.sqrt(2 * math.pi)


def estimate_camera_blur(
    modulation: NDArray[np.float32], mask: NDArray[np.bool_], noise: float = 0.0
) -> NDArray[np.float32]:
    """Estimate the standard deviation, px, of the camera's point spread: (rows, columns) of `TILES` float32.

    From the steepness of the edges of the modulation (h, w) grey levels; the aperture of an ideal pixel where there are
    none. ``mask`` (h, w): pixels whose modulation is above noise, which set the scale of contrast. ``noise``: standard
    deviation of the modulation.
    """
    blur = np.full(TILES, LEAST_PX, np.float32)
    if np.count_nonzero(mask) < EDGES:
        return blur
    usual = float(np.median(modulation[mask][:: max(1, np.count_nonzero(mask) // 100_000)]))
    size = 2 * REACH + 1
    least = max(CONTRAST * usual, NOISE_RANGE * noise)
    slopes = [np.zeros_like(modulation), np.zeros_like(modulation)]
    slopes[0][:-1], slopes[1][:, :-1] = (np.abs(np.diff(modulation, axis=axis)) for axis in (0, 1))
    places, ranges, steepness = [], [], []
    for axis, window in enumerate((np.ones((size, 1), np.uint8), np.ones((1, size), np.uint8))):
        slope = slopes[axis]
        steepest = (slope == cv2.dilate(slope, window)) & (slope >= slopes[1 - axis]) & (slope > least / size)
        contrast = cv2.dilate(modulation, window) - cv2.erode(modulation, window)
        steepest &= contrast > least
        places.append(np.argwhere(steepest))
        ranges.append(contrast[steepest])
        steepness.append(slope[steepest])
    rows, columns = np.concatenate(places).T
    widths = np.concatenate(ranges) / (np.concatenate(steepness) * np.float32(_STEP))
    if not len(widths):
        return blur
    height, width = modulation.shape
    blur[:] = max(LEAST_PX, float(np.quantile(widths, SHARPEST)))
    tile = rows * TILES[0] // height * TILES[1] + columns * TILES[1] // width
    for k in range(TILES[0] * TILES[1]):
        here = widths[tile == k]
        if len(here) >= EDGES:
            blur.flat[k] = max(LEAST_PX, float(np.quantile(here, SHARPEST)))
    return blur


def edge_error(phase: NDArray[np.float32], modulation: NDArray[np.float32], noise: float = 0.0) -> NDArray[np.float32]:
    """Return the displacement of the ``phase`` (h, w) by the camera's blur: (h, w) float32 in its unit.

    NaN where the phase is. ``modulation`` (h, w) grey levels, of standard deviation ``noise``. Depth jumps and glossy
    edges add errors of their own.
    """
    sigma = cv2.resize(
        estimate_camera_blur(modulation, np.isfinite(phase), noise), phase.shape[::-1], interpolation=cv2.INTER_LINEAR
    )
    error = np.empty_like(phase)
    _compute_displacement(modulation, phase, sigma, np.float32(max(noise, 1e-3)), error)
    return error


@kernel(parallel=True)
def _compute_displacement(modulation, phase, sigma, noise, error):
    """Fill ``error`` (h, w) with s^2 abs(grad(phi) . grad(ln B)) less the part that noise causes.

    Slopes of B are taken over about half a standard deviation, of phi on its brighter side.
    """
    height, width = phase.shape
    for v in numba.prange(height):
        for u in range(width):
            if not np.isfinite(phase[v, u]):
                error[v, u] = np.nan
                continue
            here = max(modulation[v, u], noise)
            reach = max(1, int(np.float32(0.5) * (sigma[v, u] + np.float32(1))))
            first, right = max(u - reach, 0), min(u + reach, width - 1)
            top, bottom = max(v - reach, 0), min(v + reach, height - 1)
            span_u, span_v = np.float32(max(right - first, 1)), np.float32(max(bottom - top, 1))
            slope_u = _compute_log_ratio(modulation[v, right], modulation[v, first], here) / span_u
            slope_v = _compute_log_ratio(modulation[bottom, u], modulation[top, u], here) / span_v
            far = int(np.float32(2) * sigma[v, u]) + 1
            step_u, step_v = far if slope_u > 0 else -far, far if slope_v > 0 else -far
            along = _compute_slope(phase, v, u, 0, step_u)
            down = _compute_slope(phase, v, u, step_v, 0)
            shift = along * slope_u + down * slope_v
            by_noise = np.float32(2) * (noise / here) ** 2 * ((along / span_u) ** 2 + (down / span_v) ** 2)
            error[v, u] = np.sqrt(max(shift * shift - by_noise, np.float32(0))) * sigma[v, u] * sigma[v, u]


@kernel()
def _compute_log_ratio(a, b, between):
    """Return ln(a / b) of levels on both sides of ``between``, itself above 0.

    To first order for a small difference.
    """
    if abs(a - b) < np.float32(0.1) * between:
        return (a - b) / between
    least = np.float32(0.05) * between  # two and a half standard deviations outside of a straight edge
    return np.log(max(a, least) / max(b, least))


@kernel()
def _compute_slope(phase, v, u, step_v, step_u):
    """Return the slope of the phase per px, one to two steps from a pixel, on the brighter side of an edge.

    Nearer to the edge, blur has already flattened the phase. From the pixel itself where the surface ends before, 0
    where it has no neighbour.
    """
    height, width = phase.shape
    step = step_v + step_u
    near_v, near_u = v + step_v, u + step_u
    if not (0 <= near_v < height and 0 <= near_u < width):
        return np.float32(0)
    near = phase[near_v, near_u]
    far_v, far_u = near_v + step_v, near_u + step_u
    if 0 <= far_v < height and 0 <= far_u < width and np.isfinite(near) and np.isfinite(phase[far_v, far_u]):
        return (phase[far_v, far_u] - near) / np.float32(step)
    return (near - phase[v, u]) / np.float32(step) if np.isfinite(near) else np.float32(0)
