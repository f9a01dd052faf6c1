"""Decoding of the frames of a capture to a phase map, by kernels."""

import math

import numpy as np

from slviewer.fringe import (
    kernels,
    kernels_coded,
    kernels_gray,
    kernels_levels,
    kernels_spikes,
    limits,
)
from slviewer.fringe.decoding_task import prepare_decoding
from slviewer.fringe.frame_light import FrameLight
from slviewer.fringe.kernels_spikes import spike_rules
from slviewer.fringe.layout import Layout, axis_layout, check_stack
from slviewer.fringe.levels import (
    cell_misfit,
    code_cell_px,
    layout_levels,
    lowest_coordinate,
    unambiguous_px,
)
from slviewer.fringe.phase import Noise, PhaseMap
from slviewer.fringe.phase_shifting import (
    code_bits,
    complete_map,
    dark_sigmas,
    estimate_level_errors,
    phase_shift,
)
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.fringe.threshold import MIDDLE, fringe_mean


def decode(
    sequence: PatternSequence,
    stack: np.ndarray,
    axis: Axis,
    light: FrameLight | None = None,
    *,
    mask_indirect: bool = True,
) -> PhaseMap:
    """Decode the phase map of one axis from the (n, h, w) uint8 or uint16 frames of a sequence.

    A pixel is masked, with a reason, rather than given a doubtful phase. The phase error that gamma
    causes with three or four steps (see `aliased_harmonics`) is corrected. ``light``: of the
    frames; where it differs between them, they are decoded as they would be under equal light; as
    captured if None. ``mask_indirect``: mask pixels of much indirect light, see `indirect_light`.
    Raises InputError when the frames are not those of the sequence, or cannot give an absolute
    phase.
    """
    task = prepare_decoding(sequence, stack, axis, light)
    layout, stack = task.layout, task.stack
    scale = grey_scale(layout, task.noise, task.full_scale)._replace(white=task.white)
    maps = _allocate_maps(stack.shape[1:])
    if not layout.shifts:
        kernels_gray.decode_gray(stack, scale, _pack_gray_rules(layout), maps)
    elif layout.numbers_periods:
        mean = fringe_mean(layout, stack) if layout.is_plain else MIDDLE
        coded = pack_shifts(layout), scale, code_rules(layout, mean)
        kernels.decode_rows(kernels_coded.coded_rows, stack, coded, maps)
    else:
        ladder = pack_levels(layout, fringe_mean(layout, stack) if layout.gray else MIDDLE)
        ripples, misfit = estimate_level_errors(task)
        ladder = ladder._replace(ripples=ripples, misfit=misfit)
        levels = pack_shifts(layout), ladder, scale
        kernels.decode_rows(kernels_levels.levels_rows, stack, levels, maps)
    _repair_spikes(layout, maps[0], maps[-1])
    return complete_map(task, maps, mask_indirect)


def texture(sequence: PatternSequence, stack: np.ndarray) -> np.ndarray:
    """Return an image of the scene under white light, (h, w) of the stack's dtype.

    The texture frame, else the white frame, else the background of the first axis' finest phase
    steps, else the brightest level of each pixel.
    """
    check_stack(sequence, stack)
    for kind in ("texture", "white"):
        for i, frame in enumerate(sequence.frames):
            if frame.kind == kind:
                return stack[i].copy()
    for axis in sequence.axes:
        if sequence.periods_px(axis):
            shift = axis_layout(sequence, axis).shifts[-1]
            _, _, background, _ = phase_shift(stack, shift.indices, sequence.sign(axis))
            return np.rint(background).astype(stack.dtype)
    return stack.max(axis=0)


def _allocate_maps(shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return uninitialised maps (h, w) in one block of memory: four of float32, one of uint8.

    In blocks of their own each would end in small pages, and the system takes longer to provide
    thousands of these than the kernel to decode.
    """
    pixels = math.prod(shape)
    block = np.empty(17 * pixels, np.uint8)
    singles = block[: 16 * pixels].view(np.float32).reshape(4, *shape)
    return (*singles, block[16 * pixels :].reshape(shape))


def _repair_spikes(layout: Layout, phase: np.ndarray, reason: np.ndarray) -> None:
    """Move phases that were read on the wrong side of a code edge, and mask those without support,
    in place."""
    rules, marks = spike_rules(layout), kernels_spikes.allocate_marks(phase.shape)
    lists = kernels_spikes.allocate_lists(phase.shape)
    if rules.is_plain:
        kernels_spikes.list_changes(phase, rules, False, marks, *lists)
        kernels_spikes.move_phases(*lists, phase, marks)
    kernels_spikes.list_changes(phase, rules, True, marks, *lists)
    kernels_spikes.mask_phases(*lists, phase, reason)


def grey_scale(layout: Layout, noise: Noise, white: float) -> kernels.Scale:
    """Return the grey levels that decide about a pixel, from the noise (a, b) and the clipping
    level ``white``."""
    return kernels.Scale(*noise, limits.DARK_LEVELS * white / 255, dark_sigmas(layout), white)


def code_rules(layout: Layout, mean: float) -> kernels_coded.CodeRules:
    """Return the Gray bits of a layout whose code numbers periods; ``mean`` as
    `threshold.fringe_mean` returns it."""
    return kernels_coded.CodeRules(
        np.array(layout.gray, np.int64),
        np.array(layout.inverse, np.int64),
        -1 if layout.complementary is None else layout.complementary,
        layout.gray_origin_px / layout.period_px,
        mean,
    )


def _pack_gray_rules(layout: Layout) -> kernels_gray.GrayRules:
    """Return the Gray bits of a layout without phase steps."""
    return kernels_gray.GrayRules(
        np.array(layout.gray, np.int64),
        np.array(layout.inverse, np.int64),
        -1 if layout.white is None else layout.white,
        -1 if layout.black is None else layout.black,
        layout.gray_origin_px,
        layout.gray_cell_px,
        layout.extent - 0.5,
        np.sqrt(0.5 if layout.inverse else 1.5),
        layout.binary,
    )


def pack_shifts(layout: Layout) -> kernels.Shifts:
    """Pack the frames of all periods of a layout, and the cosines and sines that weight them, for
    the kernels."""
    frames, angles, half_turns, counted = [], [], [], []
    for shift in layout.shifts:
        n = len(shift.indices)
        half = n // 2
        if n % 2:  # less the first frame, steps k and n - k
            lines = [(k, 0, 0, n - k) for k in range(1, half + 1)]
        else:
            lines = [(0, 0, half, 0)] + [
                (k, half - k, half + k, n - k) for k in range(1, (half + 1) // 2)
            ]
            lines += [(half // 2, 0, half + half // 2, 0)] if half % 2 == 0 else []
        frames.append(np.array(shift.indices, np.int64)[np.array(lines)])
        angles.append(2 * np.pi * np.array([line[0] for line in lines]) / n)
        half_turns.append(n % 4 == 0)
        counted.append(n - 1 + sum(line.count(0) for line in lines))
    cosines = [np.cos(angle) for angle in angles]
    for cosine, vanishes in zip(cosines, half_turns, strict=True):
        cosine[-1] *= not vanishes  # a quarter of a turn, exactly
    return kernels.Shifts(
        np.concatenate(frames),
        np.concatenate(cosines).astype(np.float32),
        (layout.sign * np.sin(np.concatenate(angles))).astype(np.float32),
        np.cumsum([0, *map(len, frames)]),
        np.array([shift.indices[0] for shift in layout.shifts], np.int64),
        np.array([len(shift.indices) for shift in layout.shifts], np.int64),
        np.array(counted, np.int64),
        float(np.cos(layout.offset_rad)),
        float(np.sin(layout.offset_rad)),
    )


def pack_levels(layout: Layout, mean: float = MIDDLE) -> kernels_levels.Ladder:
    """Pack the levels of a layout for the kernels: periods, and cells that its Gray bits number.

    Without levels where bits number the periods. ``mean`` as `threshold.fringe_mean` returns it.
    """
    levels = () if layout.numbers_periods else layout_levels(layout)
    bits = code_bits(layout) if layout.numbers_cells else ()
    extent = min(layout.extent, unambiguous_px(layout)) if levels else 0.0
    return kernels_levels.Ladder(
        np.array([level.weights for level in levels], np.float64).reshape(
            len(levels), len(layout.shifts)
        ),
        np.array([level.period_px for level in levels], np.float64),
        lowest_coordinate(levels[0].period_px, extent) if levels and not bits else 0.0,
        limits.LEVEL_MISFIT,
        cell_misfit(layout) if levels else 0.0,
        np.array(bits, np.int64),
        np.array(
            [*layout.inverse, *[-1] * (len(bits) - len(layout.inverse))] if bits else [], np.int64
        ),
        layout.gray_origin_px,
        code_cell_px(layout),
        mean,
        np.zeros((len(layout.shifts), 0), np.float32),
    )
