"""The second, sparse pass: spikes of one period and lonely pixels, mended where they are.

What `fringe.kernels_spikes` does from map to map, written into lists of the few pixels that change: all of them are
found before the first is changed, because each one's neighbours vote with the phase that they had.
"""

import numba
import numpy as np

from slviewer.fringe.kernels_spikes import INCONSISTENT, OUTSIDE, at_edge, suspects, votes
from slviewer.geometry.jit import kernel

TWO_PI = 2 * np.pi
RUN = 32
"""Pixels that are passed over together where none is suspect."""
NONE = np.uint8(0)


@numba.njit
def moved(phase, row, x, rules):
    """+1 or -1 where a clear majority of the neighbours is one period above or below a pixel at a code edge, else 0."""
    if not at_edge(phase[row, x], rules):
        return 0
    valid, _, above, below = votes(phase, row, x, rules)
    if valid < rules.neighbours:
        return 0
    if above >= rules.majority * valid:
        return 1
    return -1 if below >= rules.majority * valid else 0


@numba.njit
def refused(phase, row, x, suspect, low, high, rules):
    """The reason why a pixel's phase does not stand, or 0; neighbours are asked where one is ``suspect``."""
    if suspect:
        valid, agree, _, _ = votes(phase, row, x, rules)
        if valid < rules.lonely_neighbours or agree < rules.lonely * valid:
            return INCONSISTENT
    return OUTSIDE if phase[row, x] < low or phase[row, x] > high else NONE


@kernel(parallel=True)
def find(phase, rules, refusing, columns, words, counts):
    """List what changes: of row v, ``counts[v]`` pixels at ``columns[v]``, and their reason or period as ``words[v]``.

    ``refusing``: pixels that do not stand, else those to be moved by a period (``words`` 1 or 2, for up and down).
    """
    for row in numba.prange(phase.shape[0]):
        counts[row] = _find_row(phase, row, rules, refusing, columns[row], words[row])


@kernel()
def _find_row(phase, row, rules, refusing, columns, words):
    width = phase.shape[1]
    low, high = np.float32(rules.low_rad), np.float32(rules.high_rad)
    suspect, asked = np.empty(width, np.bool_), np.empty(width, np.bool_)
    suspects(phase, row, np.float32(1 / rules.cell_rad), suspect)
    own = phase[row]
    for x in range(width):
        suspect[x] &= own[x] == own[x]  # not NaN
        asked[x] = suspect[x] | (refusing & ((own[x] < low) | (own[x] > high)))
    found = 0
    for first in range(0, width, RUN):
        last = min(first + RUN, width)
        some = False
        for x in range(first, last):
            some |= asked[x]
        if not some:
            continue
        for x in range(first, last):
            if not asked[x]:
                continue
            word = refused(phase, row, x, suspect[x], low, high, rules) if refusing else moved(phase, row, x, rules)
            if word != 0:
                columns[found] = x
                words[found] = word if word > 0 else 2
                found += 1
    return found


@kernel()
def refuse(columns, words, counts, maps):
    """Mask what `find` listed."""
    none = np.float32(np.nan)
    for row in range(len(counts)):
        for i in range(counts[row]):
            x = columns[row, i]
            maps.phase[row, x], maps.reason[row, x], maps.sigma_z[row, x] = none, words[row, i], none
            maps.points[row, x, 0] = maps.points[row, x, 1] = maps.points[row, x, 2] = none


@kernel()
def move(columns, words, counts, depths, maps):
    """Move what `find` listed by a period, and measure it there."""
    one, none = np.float32(1), np.float32(np.nan)
    gain, centre, c = np.float32(depths.gain), np.float32(depths.centre), depths.c
    for row in range(len(counts)):
        for i in range(counts[row]):
            x = columns[row, i]
            before = gain * maps.phase[row, x] - centre
            maps.phase[row, x] += np.float32(TWO_PI if words[row, i] == 1 else -TWO_PI)
            s = gain * maps.phase[row, x] - centre
            slower = (one + c[2, row, x] * before) / (one + c[2, row, x] * s)
            z = (c[0, row, x] + c[1, row, x] * s) / (one + c[2, row, x] * s)
            z += correction(row, x, z, depths)
            if depths.grid.size == 0 and not (depths.bounds[0, row, x] <= s <= depths.bounds[1, row, x] and z > 0):
                z = none
            maps.points[row, x, 0], maps.points[row, x, 1] = c[3, row, x] * z, c[4, row, x] * z
            maps.points[row, x, 2] = z
            maps.sigma_z[row, x] *= slower * slower


@numba.njit
def correction(row, x, z, depths):
    """mm that the splined model's grid adds to one pixel's rational depth; NaN out of its reach."""
    grid = depths.grid
    if grid.size == 0:
        return np.float32(0)
    depth = (z - np.float32(depths.near)) * np.float32(depths.per_mm)
    if not 0 <= depth <= grid.shape[2] - 1.0001:
        return np.float32(np.nan)
    j, i, k = row // depths.step, x // depths.step, np.int64(depth)
    down, right = (row - j * depths.step) / depths.step, (x - i * depths.step) / depths.step
    deep = depth - k
    total = np.float64(0)
    for b in range(2):
        for a in range(2):
            near, far = grid[j + b, i + a, k], grid[j + b, i + a, k + 1]
            total += (down if b else 1 - down) * (right if a else 1 - right) * (near + deep * (far - near))
    return np.float32(total)
