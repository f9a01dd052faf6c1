"""Frames to points in one pass: a row's phase is unwrapped, measured and written while it is in the
cache.

Decoding is that of `fringe.kernels`, row by row; depth is that of the models, ``z = (c0 + c1 s)/(1
+ c2 s)`` of what a phase has beyond a reference, in float32.
"""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.calibration.splined.correction_grid import add_corrections, locate_layers
from slviewer.fringe.kernels import ONE, ROWS, ZERO
from slviewer.fringe.kernels_coded import coded_rows
from slviewer.fringe.kernels_levels import levels_rows
from slviewer.fringe.kernels_spikes import INVALID, TURN, UP
from slviewer.geometry.jit import fma, kernel
from slviewer.geometry.rays import fill_points


class Depths(NamedTuple):
    """A calibration. ``c`` (5, h, w) float32: c0, c1, c2 for ``s = gain phase - centre``, and the
    ray's x and y.

    Pixelwise: ``bounds`` (2, h, w) float32 hold the least and the largest s that a pixel measures,
    ``grid`` is empty. Splined: ``grid`` (nv, nu, nz) float32 mm corrects the depth, ``step`` px and
    1 / ``per_mm`` mm apart from depth ``near``; ``bounds`` are empty.
    """

    c: np.ndarray
    gain: float
    centre: float
    bounds: np.ndarray
    grid: np.ndarray
    step: int
    near: float
    per_mm: float


class Maps(NamedTuple):
    """Output arrays, (h, w) each, and ``points`` (h, w, 3); see `onepass.Scan`."""

    phase: np.ndarray
    reason: np.ndarray
    modulation: np.ndarray
    points: np.ndarray
    sigma_z: np.ndarray
    texture: np.ndarray


@kernel()
def sweep_rows(
    start, stop, stack, shifts, ladder, rules, scale, depths, maps, texture, frames, peaks
):
    """Fill rows of ``maps`` from the stack (n, h, w); frame ``texture`` shows the scene under white
    light, -1 for none.

    ``peaks`` (blocks of rows,) int32, where it is not empty: the largest grey levels of the
    ``frames`` (k,).

    The parts are functions of their own, whose results lie in arrays of their own: the compiler
    then takes a tenth of the time, and knows that nothing overlaps.
    """
    width = stack.shape[2]
    per_step = np.float32(2.0 / shifts.steps[-1])
    background, wrapped = np.empty((ROWS, width), np.float32), np.empty((ROWS, width), np.float32)
    for first in range(start, stop, ROWS):
        last = min(first + ROWS, stop)
        A, psi = background[: last - first], wrapped[: last - first]
        phase = maps.phase[first:last]
        B = maps.modulation[first:last]
        reason = maps.reason[first:last]
        if len(rules.gray):
            coded_rows(stack, shifts, scale, rules, first, phase, psi, B, A, reason)
        else:
            levels_rows(stack, shifts, ladder, scale, first, phase, psi, B, A, reason)
        _measure(first, last, A, depths, scale, per_step, maps)
        _fill_texture(stack, texture, first, last, A, maps)
        if len(peaks):
            peaks[first // ROWS] = _brightest(stack, frames, first, last)


@kernel()
def _measure(first, last, background, depths, scale, per_step, maps):
    """Compute points and their depth noise by each pixel's rational function, and the grid's
    correction, if any."""
    one, zero, none = np.float32(1), np.float32(0), np.float32(np.nan)
    gain = np.float32(depths.gain)
    centre = np.float32(depths.centre)
    c = depths.c
    grid = depths.grid
    # the phase's standard deviation is the square root of the noise's variance times 2/n, over the
    # modulation
    squared, least_B = per_step * gain * gain, np.float32(1e-6)
    noise_a, noise_b = np.float32(scale.noise_a) * squared, np.float32(scale.noise_b) * squared
    near = np.float32(depths.near)
    per_mm = np.float32(depths.per_mm)
    deepest = np.float32(grid.shape[2] - 1.0001)
    width = maps.phase.shape[1]
    z = np.empty(width, np.float32)
    cell = np.empty(width, np.int32)
    rest = np.empty(width, np.float32)
    for row in range(first, last):
        phase, A, B = maps.phase[row], background[row - first], maps.modulation[row]
        c0, c1, c2, ray_x, ray_y = c[0, row], c[1, row], c[2, row], c[3, row], c[4, row]
        sigma = maps.sigma_z[row]
        for x in range(width):
            s = fma(gain, phase[x], -centre)
            below, contrast = fma(c2[x], s, one), max(B[x], least_B)
            both = np.divide(one, below * contrast)  # one division for two
            per = contrast * both
            z[x] = fma(c1[x], s, c0[x]) * per
            slope = abs(c1[x] - c0[x] * c2[x]) * per * per * (below * both)
            sigma[x] = slope * np.sqrt(fma(noise_b, A[x], noise_a))
        if grid.size:
            for x in range(width):
                inside, cell[x], rest[x] = locate_layers(z[x], near, per_mm, deepest)
                z[x] = z[x] if inside else none
            add_corrections(z, cell, rest, grid, depths.step, row)
        else:
            least, largest = depths.bounds[0, row], depths.bounds[1, row]
            for x in range(width):
                s = fma(gain, phase[x], -centre)
                z[x] = z[x] if (s >= least[x]) & (s <= largest[x]) & (z[x] > zero) else none
        fill_points(ray_x, ray_y, z, maps.points[row])


@kernel()
def _fill_texture(stack, texture, first, last, background, maps):
    """Fill the texture with the frame ``texture``, or the background of the fringes where it is
    -1."""
    for row in range(first, last):
        if texture >= 0:
            seen = stack[texture, row]
            for x in range(len(seen)):
                maps.texture[row, x] = seen[x]
        else:
            for x in range(stack.shape[2]):
                maps.texture[row, x] = np.int32(background[row - first, x] + np.float32(0.5))


@kernel()
def _brightest(stack, frames, first, last):
    """Return the largest grey level of some rows of the frames."""
    highest = np.int32(0)
    for frame in frames:
        for row in range(first, last):
            levels = stack[frame, row]
            for x in range(len(levels)):
                highest = max(highest, np.int32(levels[x]))
    return highest


@kernel()
def measure_moved(columns, words, counts, depths, maps):
    """Measure again the pixels whose phases `kernels_spikes.move_phases` has moved."""
    width = maps.phase.shape[1]
    for row in range(len(counts)):
        for k in range(counts[row]):
            x = columns[row, k]
            i, phase = row * width + x, maps.phase[row, x]
            before = phase - (TURN if words[row, k] == UP else -TURN)
            _, _, _, old = _measure_pixel(i, before, width, depths)
            a, b, z, new = _measure_pixel(i, phase, width, depths)
            maps.points[row, x, 0], maps.points[row, x, 1], maps.points[row, x, 2] = a, b, z
            maps.sigma_z[row, x] *= new / old


@numba.njit
def _measure_pixel(i, phase, width, depths):
    """Return (x, y, z, |dz/dphi|) of a pixel by the calibration's own function."""
    gain, centre, c = np.float32(depths.gain), np.float32(depths.centre), depths.c.reshape(5, -1)
    if depths.grid.size:
        near, per_mm = np.float32(depths.near), np.float32(depths.per_mm)
        return splined_point(
            i, phase, c, depths.grid, gain, centre, width, depths.step, near, per_mm
        )
    return pixelwise_point(i, phase, c, depths.bounds.reshape(2, -1), gain, centre)


@kernel()
def mask_points(columns, counts, maps):
    """Invalidate points and sigma_z at the pixels, ``counts`` per row in ``columns``, that
    ``mask_phases`` masked."""
    for row in range(len(counts)):
        for k in range(counts[row]):
            x = columns[row, k]
            maps.points[row, x, 0] = maps.points[row, x, 1] = maps.points[row, x, 2] = INVALID
            maps.sigma_z[row, x] = INVALID


# A pixel's depth from its phase, compiled for the processor and for CUDA devices alike. A function
# takes the pixel's number ``i`` (row by row), its phase in rad, and arrays of the camera's n
# pixels. It returns (x, y, z, |dz/dphi|), mm and mm/rad; points that are not measured are NaN.
# Arrays, ``gain``, ``centre`` and what belongs to the grid are those of `Depths`.


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
