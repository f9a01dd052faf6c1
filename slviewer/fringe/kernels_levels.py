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


@kernel(parallel=True)
def unwrap_levels(wrapped, weights, periods, low, misfit, background, weakest, clipped, scale, phase, reason):
    """Absolute phase of the finest period from (m, h, w) ``wrapped`` phases, longest period first.

    ``weights`` (levels, m) and ``periods`` (levels,) px describe the levels; ``low`` px is where the first is cut.
    """
    count, height, width = wrapped.shape
    for row in numba.prange(height):
        for x in range(width):
            coordinate, order, worst = 0.0, 0.0, 0.0
            for level in range(len(periods)):
                angle = 0.0
                for i in range(count):
                    angle += weights[level, i] * np.float64(wrapped[i, row, x])
                own = angle * (periods[level] / TWO_PI)
                if level == 0:
                    order = -np.floor((own - low) / periods[level])
                else:
                    turns = (coordinate - own) / periods[level]
                    order = np.rint(turns)
                    worst = max(worst, abs(turns - order))
                coordinate = own + order * periods[level]
            dark, unclear = is_dark(weakest[row, x], background[row, x], scale), worst > misfit
            reason[row, x] = verdict(dark, clipped[row, x], unclear)
            absolute = np.float32(wrapped[count - 1, row, x] + TWO_PI * order)
            phase[row, x] = np.float32(np.nan) if dark | clipped[row, x] | unclear else absolute
