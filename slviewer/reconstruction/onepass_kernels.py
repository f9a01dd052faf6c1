"""Frames to points in one pass: a row's phase is unwrapped, measured and written while it is in the
cache.

Decoding is that of `fringe.kernels`, row by row; depth is that of the models, ``z = (c0 + c1 s)/(1
+ c2 s)`` of what a phase has beyond a reference, in float32.
"""

from typing import NamedTuple

import numpy as np

from slviewer.calibration.splined.correction_grid import add_corrections, locate_layers
from slviewer.fringe.kernels import ROWS
from slviewer.fringe.kernels_coded import coded_rows
from slviewer.fringe.kernels_levels import levels_rows
from slviewer.fringe.kernels_spikes import INVALID, TURN, UP
from slviewer.geometry.jit import fma, kernel
from slviewer.geometry.rays import fill_points
from slviewer.reconstruction.pixel_depths import pixelwise_point, splined_point


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
        phase, B, reason = (
            maps.phase[first:last],
            maps.modulation[first:last],
            maps.reason[first:last],
        )
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
    gain, centre, c, grid = (
        np.float32(depths.gain),
        np.float32(depths.centre),
        depths.c,
        depths.grid,
    )
    # the phase's standard deviation is the square root of the noise's variance times 2/n, over the
    # modulation
    squared, least_B = per_step * gain * gain, np.float32(1e-6)
    noise_a, noise_b = np.float32(scale.noise_a) * squared, np.float32(scale.noise_b) * squared
    near, per_mm, deepest = (
        np.float32(depths.near),
        np.float32(depths.per_mm),
        np.float32(grid.shape[2] - 1.0001),
    )
    width = maps.phase.shape[1]
    z, cell, rest = (
        np.empty(width, np.float32),
        np.empty(width, np.int32),
        np.empty(width, np.float32),
    )
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
    width, gain, centre = maps.phase.shape[1], np.float32(depths.gain), np.float32(depths.centre)
    near, per_mm, c = np.float32(depths.near), np.float32(depths.per_mm), depths.c.reshape(5, -1)
    bounds = depths.bounds.reshape(2, -1)
    for row in range(len(counts)):
        for k in range(counts[row]):
            x = columns[row, k]
            i, phase = row * width + x, maps.phase[row, x]
            before = phase - (TURN if words[row, k] == UP else -TURN)
            if depths.grid.size:
                _, _, _, old = splined_point(
                    i, before, c, depths.grid, gain, centre, width, depths.step, near, per_mm
                )
                a, b, z, new = splined_point(
                    i, phase, c, depths.grid, gain, centre, width, depths.step, near, per_mm
                )
            else:
                _, _, _, old = pixelwise_point(i, before, c, bounds, gain, centre)
                a, b, z, new = pixelwise_point(i, phase, c, bounds, gain, centre)
            maps.points[row, x, 0], maps.points[row, x, 1], maps.points[row, x, 2] = a, b, z
            maps.sigma_z[row, x] *= new / old


@kernel()
def mask_points(columns, counts, maps):
    """Invalidate points and sigma_z at the pixels, ``counts`` per row in ``columns``, that
    ``mask_phases`` masked."""
    for row in range(len(counts)):
        for k in range(counts[row]):
            x = columns[row, k]
            maps.points[row, x, 0] = maps.points[row, x, 1] = maps.points[row, x, 2] = INVALID
            maps.sigma_z[row, x] = INVALID
