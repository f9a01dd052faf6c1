"""The second pass of `OnePass` on a CUDA device, by the rules of `fringe.kernels_spikes`.

What changes is listed before the first pixel is changed, because each one's neighbours vote with
the phase that they had. Imported only where there is a device.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from slviewer.fringe import kernels_spikes
from slviewer.fringe.kernels_spikes import INVALID, TURN, UNCHANGED, UP, SpikeRules
from slviewer.geometry.cuda_device import device_function

# its own annotations are not those of what a kernel may call
cuda: Any = import_module("numba.cuda")


def spike_kernels(
    rules: SpikeRules, shape: tuple[int, int], measure: Callable[..., Any]
) -> tuple[Any, ...]:
    """Kernels (list what is to be moved by a period, move it, list what is to be masked, mask it).

    Those that list take the phase (h, w) and fill ``words`` (n,) uint8; the others take maps
    flattened. ``measure`` is one of `onepass_cuda_card`.
    """
    height, width = shape
    per_cell = np.float32(1 / rules.cell_rad)
    is_suspect, period_change, masking_reason = (
        device_function(rule)
        for rule in (
            kernels_spikes.is_suspect,
            kernels_spikes.period_change,
            kernels_spikes.masking_reason,
        )
    )

    @cuda.jit
    def list_moves(phase, words):
        """Kernel: write to ``words`` (h w,) for each suspect pixel whether its phase moves up or
        down a period."""
        i = cuda.grid(1)
        if i < height * width:
            row = i // width
            x = i - row * width
            words[i] = UNCHANGED
            # False for NaN
            if phase[row, x] == phase[row, x] and is_suspect(phase, row, x, per_cell):
                words[i] = period_change(phase, row, x, rules)

    @cuda.jit
    def move(words, c, extra, phase, points, sigma_z):
        """Kernel: move the phases listed in ``words`` by one period, and update their points and
        sigma_z."""
        i = cuda.grid(1)
        if i >= height * width or words[i] == UNCHANGED:
            return
        before, at = phase[i], np.uint64(i)
        after = before + (TURN if words[i] == UP else -TURN)
        _, _, _, old_slope = measure(at, before, c, extra)
        x, y, z, slope = measure(at, after, c, extra)
        phase[i] = after
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
        sigma_z[i] = sigma_z[i] * (slope / old_slope)

    @cuda.jit
    def list_masked(phase, words):
        """Kernel: write to ``words`` (h w,) the reason to mask each pixel, or UNCHANGED."""
        i = cuda.grid(1)
        if i < height * width:
            row = i // width
            x = i - row * width
            words[i] = UNCHANGED
            if phase[row, x] == phase[row, x]:
                words[i] = masking_reason(phase, row, x, is_suspect(phase, row, x, per_cell), rules)

    @cuda.jit
    def mask(words, phase, reason, points, sigma_z):
        """Kernel: mask the pixels listed in ``words``: store the reason, set phase, point and
        sigma_z to NaN."""
        i = cuda.grid(1)
        if i >= height * width or words[i] == UNCHANGED:
            return
        phase[i], reason[i] = INVALID, words[i]
        points[i, 0] = points[i, 1] = points[i, 2] = sigma_z[i] = INVALID

    return list_moves, move, list_masked, mask
