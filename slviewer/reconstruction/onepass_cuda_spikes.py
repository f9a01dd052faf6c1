"""Spikes of one period and lonely pixels on a CUDA device: a twin of `onepass_spikes` and `fringe.kernels_spikes`.

What changes is found before the first pixel is changed, because each one's neighbours vote with the phase that they
had. Imported only where there is a device.
"""

import math
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from slviewer.fringe.kernels_spikes import SpikeRules
from slviewer.fringe.phase import Reason

cuda: Any = import_module("numba.cuda")  # its own annotations are not those of what a kernel may call

INCONSISTENT, OUTSIDE = np.uint8(Reason.INCONSISTENT), np.uint8(Reason.OUTSIDE)
NOTHING, UP, DOWN = np.uint8(0), np.uint8(1), np.uint8(2)
ONE_TURN, PER_TURN = np.float32(2 * math.pi), np.float32(0.5 / math.pi)
HALF, NONE = np.float32(0.5), np.float32(math.nan)


def spike_kernels(rules: SpikeRules, shape: tuple[int, int], measure: Callable[..., Any]) -> tuple[Any, ...]:
    """Kernels (find what is to move, move it, find what does not stand, mask it) for maps of ``shape``, flattened.

    Those that find fill ``words`` (n,) uint8; ``measure`` is one of `onepass_cuda_depths`.
    """
    height, width = shape
    window, neighbours, lonely_neighbours = int(rules.window), int(rules.neighbours), int(rules.lonely_neighbours)
    per_cell, nearly, edge, far_edge = (
        np.float32(number) for number in (1 / rules.cell_rad, rules.whole, rules.edge, 1 - rules.edge)
    )
    origin, low, high = (np.float32(number) for number in (rules.origin_rad, rules.low_rad, rules.high_rad))
    majority, lonely = float(rules.majority), float(rules.lonely)

    @cuda.jit(device=True)
    def is_suspect(phase, i, row, x):
        """One of the four neighbours is missing, invalid, or half a cell or more away."""
        if row == 0 or row == height - 1 or x == 0 or x == width - 1:
            return True
        own = phase[i]
        agrees = (
            abs((phase[i - width] - own) * per_cell) <= HALF
            and abs((phase[i + width] - own) * per_cell) <= HALF
            and abs((phase[i - 1] - own) * per_cell) <= HALF
            and abs((phase[i + 1] - own) * per_cell) <= HALF
        )
        return not agrees

    @cuda.jit(device=True)
    def votes(phase, i, row, x):
        own = phase[i]
        valid, agree, above, below = 0, 0, 0, 0
        for v in range(max(0, row - window), min(height, row + window + 1)):
            for u in range(max(0, x - window), min(width, x + window + 1)):
                cells = (phase[v * width + u] - own) * per_cell
                if (v == row and u == x) or cells != cells:
                    continue
                nearest = np.float32(round(cells))
                valid += 1
                if nearest == 0:
                    agree += 1
                elif abs(cells - nearest) < nearly:
                    if nearest == 1:
                        above += 1
                    elif nearest == -1:
                        below += 1
        return valid, agree, above, below

    @cuda.jit
    def find_moved(phase, words):
        i = cuda.grid(1)
        if i >= phase.shape[0]:
            return
        words[i] = NOTHING
        own = phase[i]
        row = i // width
        x = i - row * width
        if own != own or not is_suspect(phase, i, row, x):
            return
        part = (own - origin) * PER_TURN
        part = part - np.float32(math.floor(part))
        if part >= edge and part < far_edge:
            return
        valid, _, above, below = votes(phase, i, row, x)
        if valid < neighbours:
            return
        if above >= majority * valid:
            words[i] = UP
        elif below >= majority * valid:
            words[i] = DOWN

    @cuda.jit
    def move(words, c, extra, phase, points, sigma_z):
        i = cuda.grid(1)
        if i >= phase.shape[0] or words[i] == NOTHING:
            return
        before, at = phase[i], np.uint64(i)
        after = before + (ONE_TURN if words[i] == UP else -ONE_TURN)
        _, _, _, old_slope = measure(at, before, c, extra)
        x, y, z, slope = measure(at, after, c, extra)
        phase[i] = after
        points[i, 0] = x
        points[i, 1] = y
        points[i, 2] = z
        sigma_z[i] = sigma_z[i] * (slope / old_slope)

    @cuda.jit
    def find_refused(phase, words):
        i = cuda.grid(1)
        if i >= phase.shape[0]:
            return
        words[i] = NOTHING
        own = phase[i]
        if own != own:
            return
        row = i // width
        x = i - row * width
        if is_suspect(phase, i, row, x):
            valid, agree, _, _ = votes(phase, i, row, x)
            if valid < lonely_neighbours or agree < lonely * valid:
                words[i] = INCONSISTENT
                return
        if own < low or own > high:
            words[i] = OUTSIDE

    @cuda.jit
    def refuse(words, phase, reason, points, sigma_z):
        i = cuda.grid(1)
        if i >= phase.shape[0] or words[i] == NOTHING:
            return
        phase[i] = NONE
        reason[i] = words[i]
        points[i, 0] = NONE
        points[i, 1] = NONE
        points[i, 2] = NONE
        sigma_z[i] = NONE

    return find_moved, move, find_refused, refuse
