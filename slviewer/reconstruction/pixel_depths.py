"""Depth of one pixel from its phase, by the fast models: compiled for the processor and for CUDA
devices alike.

A function takes the pixel's number ``i`` (row by row), its phase in rad, and arrays of the camera's
n pixels. It returns (x, y, z, |dz/dphi|), mm and mm/rad; points that are not measured are NaN.
Arrays, ``gain``, ``centre`` and what belongs to the grid are those of `onepass_kernels.Depths`.
"""

import math

import numba
import numpy as np

ZERO, ONE, INVALID = np.float32(0), np.float32(1), np.float32(math.nan)


@numba.njit
def pixelwise_point(i, phase, c, bounds, gain, centre):
    """Return (x, y, z, |dz/dphi|) of a pixel by its rational function alone; ``c`` (5, n),
    ``bounds`` (2, n)."""
    s, z, slope = _rational_depth(i, phase, c, gain, centre)
    if not (s >= bounds[0, i] and s <= bounds[1, i] and z > ZERO):
        z = INVALID
    return c[3, i] * z, c[4, i] * z, z, slope


@numba.njit
def splined_point(i, phase, c, grid, gain, centre, width, step, near, per_mm):
    """Return (x, y, z, |dz/dphi|) of a pixel by its rational function and the trilinear correction
    of the ``grid`` (nv, nu, nz); ``c`` (5, n)."""
    _, z, slope = _rational_depth(i, phase, c, gain, centre)
    depth = (z - near) * per_mm
    if not (depth >= ZERO and depth <= np.float32(grid.shape[2] - 1.0001)):
        return INVALID, INVALID, INVALID, slope
    v = np.int64(i) // width
    u, per_px = np.int64(i) - v * width, np.float32(1.0 / step)
    down, right = np.float32(v % step) * per_px, np.float32(u % step) * per_px
    j, q, k, one = np.uint64(v // step), np.uint64(u // step), np.uint64(depth), np.uint64(1)
    rest = depth - np.float32(k)
    z += (
        _blend_rows(grid, j, q, k, down, rest) * (ONE - right)
        + _blend_rows(grid, j, q + one, k, down, rest) * right
    )
    return c[3, i] * z, c[4, i] * z, z, slope


@numba.njit
def _rational_depth(i, phase, c, gain, centre):
    """(s, z, |dz/dphi|) of ``z = (c0 + c1 s)/(1 + c2 s)`` with ``s = gain phase - centre``."""
    s = gain * phase - centre
    c0, c1, c2 = c[0, i], c[1, i], c[2, i]
    per = ONE / (ONE + c2 * s)
    return s, (c0 + c1 * s) * per, abs(c1 - c0 * c2) * per * per * gain


@numba.njit
def _blend_rows(grid, j, q, k, down, rest):
    """Interpolate the grid at column ``q`` between rows ``j``, ``j + 1`` and layers ``k``, ``k +
    1``."""
    row, layer = j + np.uint64(1), k + np.uint64(1)
    a = grid[j, q, k] + down * (grid[row, q, k] - grid[j, q, k])
    b = grid[j, q, layer] + down * (grid[row, q, layer] - grid[j, q, layer])
    return a + rest * (b - a)
