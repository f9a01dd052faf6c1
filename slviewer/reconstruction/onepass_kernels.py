"""Frames to points in one pass: a row's phase is unwrapped, measured and written while it is in the cache.

Decoding is that of `fringe.kernels`, row by row; depth is that of the models, ``z = (c0 + c1 s)/(1 + c2 s)`` of what a
phase has beyond a reference, in float32.
"""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.kernels import coded_row, is_clipped, shift_row
from slviewer.fringe.kernels_levels import levels_row
from slviewer.geometry.jit import kernel

ROWS = 4
"""Image rows that one turn of a thread takes: room for intermediate results is asked for once."""


class Order(NamedTuple):
    """Which frames mean what. ``frames`` by period, longest first, and step; period i is those from ``starts[i]``.
    ``others``: frames that only tell how bright the camera's white is."""

    frames: np.ndarray
    starts: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    gray: np.ndarray
    inverse: np.ndarray
    complementary: int
    texture: int
    others: np.ndarray


class Ladder(NamedTuple):
    """How several periods become one absolute phase; see `kernels_levels.unwrap_levels`."""

    weights: np.ndarray
    periods: np.ndarray
    low: float
    misfit: float


class Depths(NamedTuple):
    """A calibration. ``c`` (5, h, w) float32: c0, c1, c2 for ``s = gain phase - centre``, and the ray's x and y.

    Pixelwise: ``bounds`` (2, h, w) float32 hold the least and the largest s that a pixel measures, ``grid`` is empty.
    Splined: ``grid`` (nv, nu, nz) float32 mm corrects the depth, ``step`` px and 1 / ``per_mm`` mm apart from depth
    ``near``; ``bounds`` are empty.
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
    """What is written, (h, w) each, and ``points`` (h, w, 3); see `onepass.Scan`."""

    phase: np.ndarray
    reason: np.ndarray
    modulation: np.ndarray
    points: np.ndarray
    sigma_z: np.ndarray
    texture: np.ndarray


@kernel(parallel=True)
def sweep(stack, order, ladder, rules, scale, depths, maps, peaks):
    """Fill ``maps`` from the frames (n, h, w); ``peaks`` (blocks of rows,) int32 with the largest grey levels, where it
    is not empty.

    The parts are functions of their own, whose results lie in arrays of their own: the compiler then takes a tenth of
    the time, and knows that nothing overlaps.
    """
    _, height, width = stack.shape
    count = len(order.starts) - 1
    per_step = np.float32(2.0 / (order.starts[count] - order.starts[count - 1]))
    for block in numba.prange((height + ROWS - 1) // ROWS):
        first, last = block * ROWS, min((block + 1) * ROWS, height)
        A = np.empty((ROWS, width), np.float32)
        if len(order.gray):
            _coded(stack, order, rules, scale, first, last, A, maps)
        else:
            _levels(stack, order, ladder, scale, first, last, A, maps)
        if depths.grid.size:
            _splined(first, last, A, depths, scale, per_step, maps)
        else:
            _pixelwise(first, last, A, depths, scale, per_step, maps)
        _texture(stack, order, first, last, A, maps)
        if len(peaks):
            peaks[block] = _brightest(stack, order, first, last)


@kernel()
def _coded(stack, order, rules, scale, first, last, background, maps):
    width = stack.shape[2]
    psi, B, A = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    peak, least, top = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    bottom, contrast = np.empty(width, np.float32), np.empty(width, np.float32)
    code, doubtful = np.empty(width, np.int32), np.empty(width, np.bool_)
    phase, reason = np.empty(width, np.float32), np.empty(width, np.uint8)
    for row in range(first, last):
        shift_row(stack, order.frames, order.cosines, order.sines, row, psi, B, A, peak)
        coded_row(
            stack, order.gray, order.inverse, order.complementary, row, scale, rules, psi, B, A, peak,
            code, least, top, bottom, contrast, doubtful, phase, reason,
        )  # fmt: skip
        _keep(row, row - first, phase, reason, B, A, background, maps)


@kernel()
def _levels(stack, order, ladder, scale, first, last, background, maps):
    count, width = len(order.starts) - 1, stack.shape[2]
    psi, B, A = np.empty((count, width), np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    peak, weakest, clipped = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.bool_)
    turns, own = np.empty(width, np.float64), np.empty(width, np.float64)
    position, worst = np.empty(width, np.float64), np.empty(width, np.float64)
    phase, reason = np.empty(width, np.float32), np.empty(width, np.uint8)
    for row in range(first, last):
        for x in range(width):
            weakest[x], clipped[x] = np.float32(np.inf), False
        for i in range(count):
            a, b = order.starts[i], order.starts[i + 1]
            shift_row(stack, order.frames[a:b], order.cosines[a:b], order.sines[a:b], row, psi[i], B, A, peak)
            for x in range(width):
                weakest[x] = min(weakest[x], B[x])
                clipped[x] |= is_clipped(B[x], A[x], peak[x], scale)
        levels_row(
            psi, ladder.weights, ladder.periods, ladder.low, ladder.misfit, weakest, A, clipped, scale,
            position, turns, own, worst, phase, reason,
        )  # fmt: skip
        _keep(row, row - first, phase, reason, B, A, background, maps)


@numba.njit(inline="always")
def _keep(row, here, phase, reason, B, A, background, maps):
    for x in range(len(phase)):
        maps.phase[row, x] = phase[x]
    for x in range(len(phase)):
        maps.reason[row, x] = reason[x]
    for x in range(len(phase)):
        maps.modulation[row, x] = B[x]
    for x in range(len(phase)):
        background[here, x] = A[x]


@numba.njit(inline="always")
def _noise(A, B, scale, per_step):
    """Standard deviation of the phase, rad, at a background and modulation."""
    variance = np.float32(scale.noise_a) + np.float32(scale.noise_b) * A
    return np.divide(np.sqrt(variance * per_step), max(B, np.float32(1e-6)))


@kernel()
def _pixelwise(first, last, background, depths, scale, per_step, maps):
    """Points and their depth noise, by each pixel's own rational function."""
    one, zero, none = np.float32(1), np.float32(0), np.float32(np.nan)
    gain, centre, c = np.float32(depths.gain), np.float32(depths.centre), depths.c
    width = maps.phase.shape[1]
    z, slope = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(first, last):
        phase, A, B = maps.phase[row], background[row - first], maps.modulation[row]
        c0, c1, c2, ray_x, ray_y = c[0, row], c[1, row], c[2, row], c[3, row], c[4, row]
        least, largest = depths.bounds[0, row], depths.bounds[1, row]
        points, sigma = maps.points[row], maps.sigma_z[row]
        for x in range(width):
            s = gain * phase[x] - centre
            per = np.divide(one, one + c2[x] * s)
            depth = (c0[x] + c1[x] * s) * per
            z[x] = depth if (s >= least[x]) & (s <= largest[x]) & (depth > zero) else none
            slope[x] = abs(c1[x] - c0[x] * c2[x]) * per * per * gain
        for x in range(width):
            sigma[x] = slope[x] * _noise(A[x], B[x], scale, per_step)
        for x in range(width):
            points[x, 0], points[x, 1], points[x, 2] = ray_x[x] * z[x], ray_y[x] * z[x], z[x]


@kernel()
def _splined(first, last, background, depths, scale, per_step, maps):
    """The same by the compiled splined model: the rational function, then what the grid adds to it.

    Loops without look-ups run in the processor's wide registers; unsigned indices are taken as they are, where signed
    ones would be tested for counting from the end.
    """
    one, zero, none = np.float32(1), np.float32(0), np.float32(np.nan)
    gain, centre, c, grid, step = np.float32(depths.gain), np.float32(depths.centre), depths.c, depths.grid, depths.step
    near, per_mm = np.float32(depths.near), np.float32(depths.per_mm)
    width, layers, next_one = maps.phase.shape[1], np.uint32(grid.shape[2]), np.uint32(1)
    deepest, per_px = np.float32(grid.shape[2] - 1.0001), np.float32(1.0 / step)
    table, slope = np.empty(grid.shape[1] * grid.shape[2], np.float32), np.empty(width, np.float32)
    z, cell, rest = np.empty(width, np.float32), np.empty(width, np.int32), np.empty(width, np.float32)
    for row in range(first, last):
        phase, A, B = maps.phase[row], background[row - first], maps.modulation[row]
        c0, c1, c2, ray_x, ray_y = c[0, row], c[1, row], c[2, row], c[3, row], c[4, row]
        points, sigma = maps.points[row], maps.sigma_z[row]
        j = row // step
        down = np.float32(row - j * step) * per_px
        above, below = grid[j].ravel(), grid[j + 1].ravel()
        for i in range(len(above)):
            table[i] = above[i] + down * (below[i] - above[i])  # the grid at this row
        for x in range(width):
            s = gain * phase[x] - centre
            per = np.divide(one, one + c2[x] * s)
            rational = (c0[x] + c1[x] * s) * per
            depth = (rational - near) * per_mm
            measured = (depth >= zero) & (depth <= deepest)
            depth = depth if measured else zero
            k = np.int32(depth)
            z[x], cell[x], rest[x] = rational if measured else none, k, depth - np.float32(k)
            slope[x] = abs(c1[x] - c0[x] * c2[x]) * per * per * gain
        for x in range(width):
            sigma[x] = slope[x] * _noise(A[x], B[x], scale, per_step)
        for i in range(grid.shape[1] - 1):
            start = i * step
            for q in range(min(step, width - start)):
                here = np.uint32(start + q)
                at = np.uint32(i) * layers + np.uint32(cell[here])
                right, deep = np.float32(q) * per_px, rest[here]
                a = table[at] + deep * (table[at + next_one] - table[at])
                b = table[at + layers] + deep * (table[at + layers + next_one] - table[at + layers])
                z[here] += a + right * (b - a)
        for x in range(width):
            points[x, 0], points[x, 1], points[x, 2] = ray_x[x] * z[x], ray_y[x] * z[x], z[x]


@kernel()
def _texture(stack, order, first, last, background, maps):
    for row in range(first, last):
        if order.texture >= 0:
            seen = stack[order.texture, row]
            for x in range(len(seen)):
                maps.texture[row, x] = seen[x]
        else:
            for x in range(stack.shape[2]):
                maps.texture[row, x] = np.int32(background[row - first, x] + np.float32(0.5))


@kernel()
def _brightest(stack, order, first, last):
    """The largest grey level of some rows, in the frames that the axis is decoded from."""
    highest = np.int32(0)
    for frames in (order.frames, order.gray, order.inverse, order.others):
        for k in range(len(frames)):
            for row in range(first, last):
                levels = stack[frames[k], row]
                for x in range(len(levels)):
                    highest = max(highest, np.int32(levels[x]))
    return highest
