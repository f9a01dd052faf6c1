"""The grid of corrections to the rational function's depths, applied a row of the image at a time;
see `compiled`."""

import numpy as np
from numba import njit

from slviewer.geometry.jit import fma, kernel
from slviewer.geometry.rays import fill_points


@njit(inline="always")
def locate_layers(rational, near, per_mm, deepest):
    """Locate a depth of the rational function between two layers of the grid.

    Returns whether it is inside the grid, the first layer (-1 outside), and the fraction of the way
    to the next.
    """
    depth = (rational - near) * per_mm
    inside = (depth >= np.float32(0.0)) & (depth <= deepest)
    depth = depth if inside else np.float32(0.0)
    k = np.int32(depth)
    return inside, k if inside else np.int32(-1), depth - np.float32(k)


@njit(inline="always")
def _blend_rows(above, below, down, i, k):
    """Interpolate linearly between the rows ``above`` and ``below`` of the grid at column ``i`` and
    layer ``k``."""
    # an index with a sign would be tested for counting from the end
    column, layer = np.uint64(i), np.uint64(k)
    upper = above[column, layer]
    return fma(down, below[column, layer] - upper, upper)


@njit(inline="always")
def add_corrections(z, cell, rest, grid, step, row):
    """Add the grid to an image row's depths ``z`` (w,); ``cell`` int32 and ``rest`` (w,) as
    `locate_layers` has them.

    Where a surface is, the pixels of a grid cell lie between two or three layers, whose few numbers
    then serve all of them in the processor's wide registers; elsewhere each pixel looks up its own.
    """
    j = row // step
    per_px = np.float32(1.0 / step)
    down = np.float32(row - j * step) * per_px
    above, below = grid[j], grid[j + 1]
    for i in range(grid.shape[1] - 1):
        start = i * step
        stop = min(start + step, len(z))
        here, cells, part = z[start:stop], cell[start:stop], rest[start:stop]
        lowest, highest = np.uint32(grid.shape[2]), np.int32(-1)
        for q in range(len(here)):
            lowest = min(lowest, np.uint32(cells[q]))  # -1 is the largest of these
            highest = max(highest, cells[q])
        k, top = np.int64(lowest), np.int64(highest)
        if top < 0:
            continue
        if top <= k + 1:
            a0 = _blend_rows(above, below, down, i, k)
            a1 = _blend_rows(above, below, down, i, k + 1)
            a2 = _blend_rows(above, below, down, i, top + 1)
            b0 = _blend_rows(above, below, down, i + 1, k)
            b1 = _blend_rows(above, below, down, i + 1, k + 1)
            b2 = _blend_rows(above, below, down, i + 1, top + 1)
            for q in range(len(here)):
                first, deep = cells[q] == k, part[q]
                a = fma(deep, a1 - a0, a0) if first else fma(deep, a2 - a1, a1)
                b = fma(deep, b1 - b0, b0) if first else fma(deep, b2 - b1, b1)
                here[q] += fma(np.float32(q) * per_px, b - a, a)
        else:
            for q in range(len(here)):
                n, deep = np.int64(cells[q]), part[q]
                if n >= 0:
                    a = _blend_rows(above, below, down, i, n)
                    b = _blend_rows(above, below, down, i + 1, n)
                    a = fma(deep, _blend_rows(above, below, down, i, n + 1) - a, a)
                    b = fma(deep, _blend_rows(above, below, down, i + 1, n + 1) - b, b)
                    here[q] += fma(np.float32(q) * per_px, b - a, a)


@kernel()
def evaluate(first, last, phase, numbers, c, rays, grid, step, out):
    """Fill ``out`` (h, w, 3) mm from phases (h, w), all float32. ``numbers``: px per rad, the
    coordinate's centre px, the grid's first depth mm and its layers per mm; ``c``, ``grid`` and
    ``step`` as `Compiled` has them, ``rays`` (2, h, w)."""
    px_per_rad, centre, near, per_mm = numbers[0], numbers[1], numbers[2], numbers[3]
    one, none = np.float32(1.0), np.float32(np.nan)
    width, deepest = phase.shape[1], np.float32(grid.shape[2] - 1.0001)
    for v in range(first, last):
        z, rest = np.empty((2, width), np.float32)
        cell = np.empty(width, np.int32)
        for u in range(width):
            s = fma(px_per_rad, phase[v, u], -centre)
            rational = np.divide(fma(c[1, v, u], s, c[0, v, u]), fma(c[2, v, u], s, one))
            inside, cell[u], rest[u] = locate_layers(rational, near, per_mm, deepest)
            z[u] = rational if inside else none
        add_corrections(z, cell, rest, grid, step, v)
        fill_points(rays[0, v], rays[1, v], z, out[v])
