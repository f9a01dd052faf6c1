"""Multi-frequency decoding, compiled; `reference` is what this must agree with."""

import numba
import numpy as np

from slviewer.fringe.kernels import is_clipped, is_dark, shift_row, verdict
from slviewer.geometry.jit import kernel

TWO_PI = 2 * np.pi


@kernel(parallel=True)
def decode_shift(stack, shift, cosines, sines, scale, wrapped, modulation, background, weakest, clipped):
    """One period: fills three maps, lowers ``weakest`` (h, w) and sets ``clipped`` (h, w) where this period is."""
    _, height, width = stack.shape
    for row in numba.prange(height):
        peak = np.empty(width, np.float32)
        B, A = modulation[row], background[row]
        shift_row(stack, shift, cosines, sines, row, wrapped[row], B, A, peak)
        for x in range(width):
            weakest[row, x] = min(weakest[row, x], B[x])
            clipped[row, x] |= is_clipped(B[x], A[x], peak[x], scale)


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


@kernel(parallel=True)
def unwrap_levels(wrapped, weights, periods, low, misfit, background, weakest, clipped, scale, phase, reason):
    """Absolute phase of the finest period from (m, h, w) ``wrapped`` phases, longest period first.

    ``weights`` (levels, m) and ``periods`` (levels,) px describe the levels; ``low`` px is where the first is cut.
    """
    count, height, width = wrapped.shape
    for row in numba.prange(height):
        psi = np.empty((count, width), np.float32)  # neighbours in memory, for the vector instructions
        for i in range(count):
            for x in range(width):
                psi[i, x] = wrapped[i, row, x]
        coordinate, order = np.empty(width, np.float64), np.empty(width, np.float64)
        own, worst = np.empty(width, np.float64), np.empty(width, np.float64)
        levels_row(
            psi, weights, periods, low, misfit, weakest[row], background[row], clipped[row], scale,
            coordinate, order, own, worst, phase[row], reason[row],
        )  # fmt: skip
