"""Multi-frequency decoding, compiled; `reference` is what this must agree with."""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.kernels import is_clipped, is_dark, period, shift_row, verdict
from slviewer.geometry.jit import kernel

TWO_PI = 2 * np.pi


class Ladder(NamedTuple):
    """How several periods become one absolute phase; ``weights`` (levels, m) of the m wrapped
    phases and ``periods`` (levels,) px describe the levels, longest first; ``low`` px is where the first is cut."""

    weights: np.ndarray
    periods: np.ndarray
    low: float
    misfit: float


@numba.njit(inline="always")
def levels_row(psi, weights, periods, low, misfit, B, A, clipped, scale, coordinate, order, own, worst, phase, reason):
    """One row's absolute phase and reason from its (m, w) wrapped phases; ``coordinate`` ... ``worst`` (w,) are room.

    ``B`` is the weakest modulation. Loops run along the row, which the compiler turns into vector instructions.
    """
    count, width = psi.shape
    for x in range(width):
        worst[x] = 0.0
    for level in range(len(periods)):
        period = periods[level]
        per_px, per_rad = 1.0 / period, period / TWO_PI
        for x in range(width):
            own[x] = 0.0
        for i in range(count):
            weight = weights[level, i]
            if weight != 0.0:
                for x in range(width):
                    own[x] += weight * np.float64(psi[i, x])
        if level == 0:
            for x in range(width):
                position = own[x] * per_rad
                order[x] = -np.floor((position - low) * per_px)
                coordinate[x] = position + order[x] * period
        else:
            for x in range(width):
                position = own[x] * per_rad
                turns = (coordinate[x] - position) * per_px
                order[x] = np.rint(turns)
                worst[x] = max(worst[x], abs(turns - order[x]))
                coordinate[x] = position + order[x] * period
    for x in range(width):
        dark, unclear = is_dark(B[x], A[x], scale), worst[x] > misfit
        reason[x] = verdict(dark, clipped[x], unclear)
        absolute = np.float32(psi[count - 1, x] + TWO_PI * order[x])
        phase[x] = np.float32(np.nan) if dark | clipped[x] | unclear else absolute


@numba.njit(inline="always")
def levels_room(width):
    """Room for a row: weakest modulation, whether clipped, and four of float64."""
    weakest, clipped = np.empty(width, np.float32), np.empty(width, np.bool_)
    a, b = np.empty(width, np.float64), np.empty(width, np.float64)
    return weakest, clipped, a, b, np.empty(width, np.float64), np.empty(width, np.float64)


@numba.njit(inline="always")
def ladder_row(stack, shifts, ladder, scale, row, psi, B, A, peak, room, phase, reason):
    """One row's absolute phase, reason, modulation B and background A of the finest period, and all wrapped phases."""
    weakest, clipped, coordinate, order, own, worst = room
    width = stack.shape[2]
    for x in range(width):
        weakest[x], clipped[x] = np.float32(np.inf), False
    for i in range(len(shifts.steps)):  # the finest is last, and its values stay
        shift_row(stack, period(shifts, i), row, psi[i], B, A, peak)
        for x in range(width):
            weakest[x] = min(weakest[x], B[x])
            clipped[x] |= is_clipped(B[x], A[x], peak[x], scale)
    levels_row(
        psi, ladder.weights, ladder.periods, ladder.low, ladder.misfit, weakest, A, clipped, scale,
        coordinate, order, own, worst, phase, reason,
    )  # fmt: skip


@kernel(parallel=True)
def decode_levels(stack, shifts, ladder, scale, phase, wrapped, modulation, background, reason):
    """Several periods, each by its own phase steps; fills the five (h, w) maps, of the finest period."""
    _, height, width = stack.shape
    count = len(shifts.steps)
    for row in numba.prange(height):
        psi, peak = np.empty((count, width), np.float32), np.empty(width, stack.dtype)
        ladder_row(
            stack, shifts, ladder, scale, row, psi, modulation[row], background[row], peak, levels_room(width),
            phase[row], reason[row],
        )  # fmt: skip
        for x in range(width):
            wrapped[row, x] = psi[count - 1, x]
