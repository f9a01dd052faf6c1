"""Gray cells beside phase shifts that are not their periods, compiled; `reference` is what this must agree with."""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.kernels import ROWS
from slviewer.fringe.kernels_coded import UNDECIDED, WEAK, WEAKER
from slviewer.fringe.kernels_levels import allocate_levels, levels_row, phases_row
from slviewer.geometry.jit import kernel


class CellRules(NamedTuple):
    """The frames of Gray ``bits``, most significant first, and of their ``inverses``, -1 for none. Cells of ``cell`` px
    begin at ``origin``; ``mean``: see `threshold`."""

    bits: np.ndarray
    inverses: np.ndarray
    origin: float
    cell: float
    mean: float


@numba.njit
def cell_row(stack, row, B, A, rules, heights, cell, worst):
    """One row's coordinates px of the cells that the bits name, or of the border that a pixel lies at; ``worst`` is
    infinite where a bit that is not the border's is undecided, else 0."""
    bits, inverses = rules.bits, rules.inverses
    last = len(bits) - 1
    mean, half, nothing = np.float32(rules.mean), np.float32(0.5), np.float32(0)
    for x in range(len(cell)):
        code, bit, top, bottom = 0, 0, nothing, nothing
        for b in range(len(bits)):
            value = np.float32(stack[bits[b], row, x])
            height = value - A[x]
            if inverses[b] >= 0:
                height = (value - np.float32(stack[inverses[b], row, x])) * half
            bit ^= int(height > 0)
            code = 2 * code + bit
            heights[b], top, bottom = height, max(top, height), min(bottom, height)
        contrast = max(top / (1 - mean), -bottom / mean)
        middle = (half - mean) * contrast
        zeros, ones = 0, 0
        while zeros <= last and not (code >> zeros) & 1:
            zeros += 1
        while ones <= last and (code >> ones) & 1:
            ones += 1
        lower = abs(heights[last - zeros] - middle) if zeros <= last else np.float32(np.inf)
        upper = abs(heights[last - ones] - middle) if ones <= last else np.float32(np.inf)
        least = np.float32(np.inf)
        for b in range(len(bits)):
            if b != last - zeros and b != last - ones:
                least = min(least, abs(heights[b]))
        near = WEAK * contrast
        part = 0.5
        if upper < near and upper < WEAKER * lower:
            part = 1.0
        elif lower < near and lower < WEAKER * upper:
            part = 0.0
        cell[x] = rules.origin + rules.cell * (code + part)
        worst[x] = np.float32(np.inf) if least < UNDECIDED * B[x] else nothing


@kernel(parallel=True)
def decode_cells(stack, shifts, ladder, scale, rules, phase, wrapped, modulation, background, reason):
    """One or several periods, the first of whose levels the Gray bits make absolute; fills the five (h, w) maps, of the
    finest period."""
    count, height, width = len(shifts.steps), stack.shape[1], stack.shape[2]
    for block in numba.prange((height + ROWS - 1) // ROWS):
        psi, peak, room = np.empty((count, width), np.float32), np.empty(width, stack.dtype), allocate_levels(width)
        clipped, weakest, coordinate, order, own, worst, _, _, _ = room
        heights, cell = np.empty(len(rules.bits), np.float32), np.empty(width, np.float32)
        for row in range(block * ROWS, min((block + 1) * ROWS, height)):
            B, A = modulation[row], background[row]
            phases_row(stack, shifts, scale, row, psi, wrapped[row], B, A, peak, room)
            cell_row(stack, row, B, A, rules, heights, cell, worst)
            levels_row(
                psi, ladder, weakest, A, clipped, scale, cell, coordinate, order, own, worst, phase[row], reason[row]
            )
