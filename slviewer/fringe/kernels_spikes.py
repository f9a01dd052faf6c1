"""Spikes and lonely pixels, compiled; `reference_spikes` is what this must agree with.

Nearly every pixel agrees with its four neighbours, and is passed over at the speed of memory.
"""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import kernel

INCONSISTENT, OUTSIDE = np.uint8(Reason.INCONSISTENT), np.uint8(Reason.OUTSIDE)
TWO_PI = 2 * np.pi
PER_TURN = np.float32(1 / TWO_PI)


class SpikeRules(NamedTuple):
    """How a neighbourhood decides; see `limits`."""

    cell_rad: float
    plain: bool
    origin_rad: float
    edge: float
    window: int
    majority: float
    neighbours: int
    whole: float
    lonely: float
    lonely_neighbours: int
    low_rad: float
    high_rad: float
    repeat: float


@numba.njit(inline="always")
def suspects(phase, row, per_cell, suspect):
    """Fill ``suspect`` (w,): one of the four neighbours is missing, invalid, or half a cell or more away."""
    height, width = phase.shape
    if row == 0 or row == height - 1:
        for x in range(width):
            suspect[x] = True
        return
    over, own, under = phase[row - 1], phase[row], phase[row + 1]
    half = np.float32(0.5)
    for x in range(width):
        vertical = (abs((over[x] - own[x]) * per_cell) <= half) & (abs((under[x] - own[x]) * per_cell) <= half)
        suspect[x] = not vertical
    for x in range(1, width - 1):
        level = (abs((own[x - 1] - own[x]) * per_cell) <= half) & (abs((own[x + 1] - own[x]) * per_cell) <= half)
        suspect[x] |= not level
    suspect[0] = suspect[width - 1] = True


@numba.njit
def votes(phase, row, x, rules):
    """(valid, agree, above, below) neighbours in the window; see `reference_spikes`."""
    height, width = phase.shape
    per_cell, nearly = np.float32(1 / rules.cell_rad), np.float32(rules.whole)
    valid, agree, above, below = 0, 0, 0, 0
    for v in range(max(0, row - rules.window), min(height, row + rules.window + 1)):
        for u in range(max(0, x - rules.window), min(width, x + rules.window + 1)):
            cells = (phase[v, u] - phase[row, x]) * per_cell
            if (v == row and u == x) or np.isnan(cells):
                continue
            if rules.repeat < np.inf:
                cells -= np.float32(rules.repeat) * np.rint(cells * np.float32(1 / rules.repeat))
            nearest = np.rint(cells)
            valid += 1
            if nearest == 0:
                agree += 1
            elif abs(cells - nearest) < nearly:
                above += nearest == 1
                below += nearest == -1
    return valid, agree, above, below


@numba.njit
def at_edge(phase, rules):
    """Whether an absolute phase lies beside a code edge."""
    part = (phase - np.float32(rules.origin_rad)) * PER_TURN
    part -= np.floor(part)
    return part < np.float32(rules.edge) or part >= np.float32(1 - rules.edge)


@kernel(parallel=True)
def repair(phase, rules, out):
    """Fill ``out`` (h, w) with the phase, moved by a period where a clear majority at a code edge says so."""
    height, width = phase.shape
    per_cell = np.float32(1 / rules.cell_rad)
    for row in numba.prange(height):
        suspect = np.empty(width, np.bool_)
        suspects(phase, row, per_cell, suspect)
        for x in range(width):  # a slice would compile half as long again, for its shape check's message
            out[row, x] = phase[row, x]
        for x in range(width):
            if not suspect[x] or np.isnan(phase[row, x]) or not at_edge(phase[row, x], rules):
                continue
            valid, _, above, below = votes(phase, row, x, rules)
            if valid >= rules.neighbours:
                if above >= rules.majority * valid:
                    out[row, x] = phase[row, x] + np.float32(TWO_PI)
                elif below >= rules.majority * valid:
                    out[row, x] = phase[row, x] - np.float32(TWO_PI)


@kernel(parallel=True)
def settle(phase, reason, rules, out):
    """Fill ``out`` with the phase that stands, and mark the others in ``reason``; ``phase`` is only read."""
    height, width = phase.shape
    per_cell = np.float32(1 / rules.cell_rad)
    low, high = np.float32(rules.low_rad), np.float32(rules.high_rad)
    for row in numba.prange(height):
        suspect = np.empty(width, np.bool_)
        suspects(phase, row, per_cell, suspect)
        own = phase[row]
        for x in range(width):
            outside = (own[x] < low) | (own[x] > high)
            out[row, x] = np.float32(np.nan) if outside else own[x]
            reason[row, x] = OUTSIDE if outside else reason[row, x]
        for x in range(width):
            if not suspect[x] or np.isnan(own[x]):
                continue
            valid, agree, _, _ = votes(phase, row, x, rules)
            if valid < rules.lonely_neighbours or agree < rules.lonely * valid:
                out[row, x] = np.nan
                reason[row, x] = INCONSISTENT
