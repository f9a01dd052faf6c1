"""Mask of the pixels at which something moved while a short capture was taken."""

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.jit import kernel, run_rows

SIGMAS = 5.0
PART = 0.1
"""A contradiction of so many standard deviations of its noise, and this part of the modulation
besides, is motion: some 0.2 rad from one frame to the next."""
_SPARSE = 8  # step of the rows and columns from which the projector's second harmonic is estimated


def mask_motion(
    sequence: PatternSequence,
    frames: np.ndarray,
    axis: Axis,
    phase: np.ndarray,
    modulation: np.ndarray,
    noise: tuple[float, float],
    points: np.ndarray,
) -> None:
    """Set `points` (h, w, 3) to NaN where the frames (n, h, w) that they were made of contradict
    each other.

    The frames of every period have the same mean, the background, at a pixel without motion; and
    where the finest has an even number of steps, its frames added with alternating signs leave
    nothing but noise and what the projector adds evenly everywhere, its second harmonic, which is
    measured from all pixels and subtracted.

    `phase` (h, w) rad, NaN where there is none, `modulation` (h, w) grey levels and `noise` are
    those that decoding the axis gave, as a `PhaseMap` has them. Raises InputError where the finest
    period has an odd number of steps.
    """
    shifts = axis_layout(sequence, axis).shifts
    finest = np.array(shifts[-1].indices, np.int64)
    if len(finest) % 2:
        raise InputError(
            f"{len(finest)} steps of the finest period do not reveal motion", "use an even number"
        )
    begins = np.cumsum([0, *(len(shift.indices) for shift in shifts)])
    indices = np.concatenate([np.array(shift.indices, np.int64) for shift in shifts])
    signs = np.where(np.arange(len(finest)) % 2, -1.0, 1.0).astype(np.float32) / np.float32(
        len(finest)
    )
    some = (slice(None, None, _SPARSE),) * 2
    alternation = np.tensordot(signs, frames[(slice(None), *some)][finest], 1)
    shape = modulation[some] * np.cos(2 * phase[some])
    valid = np.isfinite(shape)
    power = float((shape[valid] ** 2).sum())
    harmonic = (
        float((shape[valid] * alternation[valid]).sum()) / power
        if power > 0 and len(finest) == 4
        else 0.0
    )
    few, many = (extreme(len(shift.indices) for shift in shifts) for extreme in (min, max))
    run_rows(
        _mask_moving_pixels, len(points), frames, indices, begins, signs, modulation, phase,
        np.float32(harmonic), np.float32(noise[0]), np.float32(noise[1]),
        np.float32(SIGMAS * np.sqrt(1 / few + 1 / many)),
        np.float32(SIGMAS / np.sqrt(len(finest))), np.float32(PART), points,
    )  # fmt: skip


@kernel()
def _mask_moving_pixels(
    first,
    last,
    frames,
    indices,
    begins,
    signs,
    modulation,
    phase,
    harmonic,
    a,
    b,
    mean,
    alternating,
    part,
    points,
):
    """Kernel of `mask_motion`: set `points` (h, w, 3) to NaN where frames of a pixel contradict
    each other.

    ``mean``, ``alternating``: limits of the two contradictions, in standard deviations of a frame's
    noise.
    """
    width = modulation.shape[1]
    groups = len(begins) - 1
    for row in range(first, last):
        lowest, highest = np.empty(width, np.float32), np.empty(width, np.float32)
        total, alternation = np.empty(width, np.float32), np.zeros(width, np.float32)
        for g in range(groups):
            total[:] = 0.0
            share = np.float32(1.0) / np.float32(begins[g + 1] - begins[g])
            for i in range(begins[g], begins[g + 1]):
                sign = signs[i - begins[g]] if g == groups - 1 else np.float32(0.0)
                frame = frames[indices[i], row]
                for x in range(width):
                    level = np.float32(frame[x])
                    total[x] += share * level
                    alternation[x] += sign * level
            for x in range(width):
                lowest[x] = total[x] if g == 0 else min(lowest[x], total[x])
                highest[x] = total[x] if g == 0 else max(highest[x], total[x])
        for x in range(width):
            B = modulation[row, x]
            noise = np.sqrt(max(a + b * total[x], np.float32(0.0)))
            known = harmonic * B * np.cos(np.float32(2.0) * phase[row, x])
            moved = (highest[x] - lowest[x] > mean * noise + part * B) | (
                abs(alternation[x] - known) > alternating * noise + part * B
            )
            if moved:
                points[row, x, 0] = points[row, x, 1] = points[row, x, 2] = np.nan
