"""Multi-frequency decoding, compiled; defined by `tests/decode_reference.py`."""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.kernels import (
    ENDLESS,
    HALF,
    NAN,
    TURN,
    TURN_REST,
    ZERO,
    allocate_five,
    allocate_three,
    arctan2,
    is_dark_squared,
    select_period,
    select_reason,
    sums_row,
)
from slviewer.fringe.kernels_coded import UNDECIDED, WEAK, WEAKER
from slviewer.geometry.jit import fma, kernel

PER_RAD = 1 / (2 * np.pi)


class Ladder(NamedTuple):
    """Levels by which several periods are unwrapped to one absolute phase.

    ``weights`` (levels, m) of the m wrapped phases and ``periods`` (levels,) px describe the
    levels, longest first. ``misfit``, and ``ripples`` (m, k) that are added to the wrapped phases:
    see `phase_shifting.estimate_level_errors`; ``cell_misfit``: see `levels.cell_misfit`.

    The first level begins at ``low`` px, or, where there are Gray ``bits``, is unwrapped by the
    cells that they number: frames (b,), most significant bit first, and of their ``inverses``, -1
    for none. Cells of ``cell`` px begin at ``origin``; ``mean``: see `threshold`.
    """

    weights: np.ndarray
    periods: np.ndarray
    low: float
    misfit: float
    cell_misfit: float
    bits: np.ndarray
    inverses: np.ndarray
    origin: float
    cell: float
    mean: float
    ripples: np.ndarray


@numba.njit(inline="always")
def read_cell_bits(stack, row, x, threshold, bits, inverses, heights):
    """Read the Gray bits of a pixel, whose ``heights`` (b,) it fills; return their code, the
    highest and the lowest."""
    code, bit, top, bottom = 0, 0, ZERO, ZERO
    for b in range(len(bits)):
        value = np.float32(stack[bits[b], row, x])
        height = value - threshold
        if inverses[b] >= 0:
            height = (value - np.float32(stack[inverses[b], row, x])) * HALF
        bit ^= int(height > 0)
        code = 2 * code + bit
        heights[b], top, bottom = height, max(top, height), min(bottom, height)
    return code, top, bottom


@numba.njit
def cell_row(stack, row, B, A, ladder, heights, cell, worst):
    """Compute the coordinates px of the cells of one row that the bits number, or of the border
    that a pixel is at.

    Fills ``cell`` (w,) and ``worst`` (w,): infinite where a bit that does not change at the border
    is undecided, else 0.
    """
    bits, inverses = ladder.bits, ladder.inverses
    last = len(bits) - 1
    mean = np.float32(ladder.mean)
    for x in range(len(cell)):
        code, top, bottom = read_cell_bits(stack, row, x, A[x], bits, inverses, heights)
        contrast = max(top / (1 - mean), -bottom / mean)
        middle = (HALF - mean) * contrast
        zeros, ones = 0, 0
        while zeros <= last and not (code >> zeros) & 1:
            zeros += 1
        while ones <= last and (code >> ones) & 1:
            ones += 1
        lower = abs(heights[last - zeros] - middle) if zeros <= last else ENDLESS
        upper = abs(heights[last - ones] - middle) if ones <= last else ENDLESS
        least = ENDLESS
        for b in range(len(bits)):
            if b != last - zeros and b != last - ones:
                least = min(least, abs(heights[b]))
        near = WEAK * contrast
        part = 0.5
        if upper < near and upper < WEAKER * lower:
            part = 1.0
        elif lower < near and lower < WEAKER * upper:
            part = 0.0
        cell[x] = ladder.origin + ladder.cell * (code + part)
        worst[x] = ENDLESS if least < UNDECIDED * B[x] else ZERO


@numba.njit(inline="always")
def levels_row(
    psi, ladder, weakest, A, clipped, scale, cell, coordinate, order, own, worst, phase, reason
):
    """Compute the absolute phase and the reason of one row from its (m, w) wrapped phases.

    ``coordinate`` ... ``worst`` (w,) are buffers.

    ``cell``: the coordinates px (w,) near which the first level's are, with ``worst`` infinite
    where they are not known; empty where the first level begins at ``low`` instead. ``weakest``:
    the smallest square of a modulation. float32 represents a coordinate to some 1e-4 px, enough to
    separate whole periods; the phase itself is never computed from a coordinate. Loops run along
    the row, which the compiler turns into vector instructions.
    """
    count, width = psi.shape
    low, misfit = np.float32(ladder.low), np.float32(ladder.misfit)
    for level in range(len(ladder.periods)):
        length, per_px = np.float32(ladder.periods[level]), np.float32(1.0 / ladder.periods[level])
        single, several, to_px = 0, 0, ladder.periods[level] * PER_RAD
        for i in range(count):
            if ladder.weights[level, i] != 0.0:
                single, several = i, several + 1
        if several == 1:  # a period of its own
            source, per_rad = psi[single], np.float32(ladder.weights[level, single] * to_px)
        else:  # the beat of some
            source, per_rad = own, np.float32(to_px)
            for x in range(width):
                own[x] = ZERO
            for i in range(count):
                weight, wrapped = np.float32(ladder.weights[level, i]), psi[i]
                for x in range(width):
                    own[x] = fma(weight, wrapped[x], own[x])
        if level == 0 and len(cell):
            per_misfit = np.float32(ladder.misfit / ladder.cell_misfit)
            for x in range(width):
                position = source[x] * per_rad
                turns = (cell[x] - position) * per_px
                whole = np.rint(turns)
                order[x] = whole
                worst[x] = max(worst[x], abs(turns - whole) * per_misfit)
                coordinate[x] = fma(whole, length, position)
        elif level == 0:
            for x in range(width):
                position = source[x] * per_rad
                whole = ZERO - np.floor((position - low) * per_px)
                order[x], worst[x] = whole, ZERO
                coordinate[x] = fma(whole, length, position)
        else:
            for x in range(width):
                position = source[x] * per_rad
                turns = (coordinate[x] - position) * per_px
                whole = np.rint(turns)
                order[x] = whole
                worst[x] = max(worst[x], abs(turns - whole))
                coordinate[x] = fma(whole, length, position)
    finest = psi[count - 1]
    for x in range(width):
        dark, unclear = is_dark_squared(weakest[x], A[x], scale), worst[x] > misfit
        reason[x] = select_reason(dark, clipped[x], unclear)
        absolute = fma(order[x], TURN, fma(order[x], TURN_REST, finest[x]))
        phase[x] = NAN if dark | clipped[x] | unclear else absolute


@numba.njit(inline="always")
def allocate_levels(width):
    """Allocate the buffers of a row: whether clipped, and eight of float32."""
    a, b, c, d, e = allocate_five(width)
    f, g, h = allocate_three(width)
    return np.empty(width, np.bool_), a, b, c, d, e, f, g, h


@numba.njit(inline="always")
def phases_row(stack, shifts, scale, row, psi, out, B, A, peak, buffers):
    """Compute the wrapped phases of all periods of one row, and modulation and background of the
    finest.

    Fills ``psi`` (m, w), ``out`` (the finest wrapped phase), modulation ``B`` and background ``A``
    (w,); ``clipped`` and ``weakest`` of the ``buffers`` are of all periods. The other periods'
    modulations are compared as squares, which avoids their roots.
    """
    clipped, weakest, _, _, _, _, cosine, sine, total = buffers
    width, white = stack.shape[2], np.float32(scale.white)
    for x in range(width):
        weakest[x], clipped[x] = ENDLESS, False
    for i in range(len(shifts.steps)):  # the finest is last, and its values stay
        steps = select_period(shifts, i)
        sums_row(stack, steps, row, cosine, sine, total, peak)
        first, wrapped = stack[steps.first, row], psi[i]
        per_two = np.float32(2 / steps.steps)
        per_one = np.float32(1 / steps.steps)
        counted = np.float32(steps.counted)
        for x in range(width):
            wrapped[x] = arctan2(ZERO - sine[x], cosine[x])
            level = np.float32(first[x])
            middle = fma(total[x] - counted * level, per_one, level)
            squared = fma(cosine[x], cosine[x], sine[x] * sine[x]) * (per_two * per_two)
            rest = max(white - middle, ZERO)
            A[x] = middle
            weakest[x] = min(weakest[x], squared)
            clipped[x] |= (np.float32(peak[x]) >= white) & (squared >= rest * rest)
    finest = psi[len(psi) - 1]
    for x in range(width):
        out[x] = finest[x]
        B[x] = np.sqrt(fma(cosine[x], cosine[x], sine[x] * sine[x])) * per_two


@numba.njit
def add_ripple_row(psi, ripple):
    """Add a ripple, given from -pi to pi, to the wrapped phases (w,) of one period."""
    last = len(ripple) - 1
    per_rad = last * PER_RAD
    for x in range(len(psi)):
        place = (psi[x] + np.pi) * per_rad
        k = min(max(int(place), 0), last - 1)
        psi[x] += ripple[k] + np.float32(place - k) * (ripple[k + 1] - ripple[k])


@kernel()
def levels_rows(
    stack, shifts, ladder, scale, first, phase, wrapped, modulation, background, reason
):
    """Decode rows from ``first`` on by several periods, each with its own phase steps, and Gray
    cells, if any; see `kernels.decode_rows`. The five maps, of the finest period, contain only
    these rows."""
    count, width, bits = len(shifts.steps), stack.shape[2], len(ladder.bits)
    psi = np.empty((count, width), np.float32)
    peak = np.empty(width, stack.dtype)
    buffers = allocate_levels(width)
    clipped, weakest, coordinate, order, own, worst, _, _, _ = buffers
    heights, cell = np.empty(bits, np.float32), np.empty(width if bits else 0, np.float32)
    for i in range(len(phase)):
        B, A = modulation[i], background[i]
        phases_row(stack, shifts, scale, first + i, psi, wrapped[i], B, A, peak, buffers)
        if ladder.ripples.shape[1]:
            for k in range(count):
                add_ripple_row(psi[k], ladder.ripples[k])
        if bits:
            cell_row(stack, first + i, B, A, ladder, heights, cell, worst)
        levels_row(
            psi,
            ladder,
            weakest,
            A,
            clipped,
            scale,
            cell,
            coordinate,
            order,
            own,
            worst,
            phase[i],
            reason[i],
        )
