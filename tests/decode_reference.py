"""Decoding in NumPy: the definition that the kernels must reproduce."""

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.decoding_task import prepare_decoding
from slviewer.fringe.frame_light import FrameLight
from slviewer.fringe.kernels_spikes import SpikeRules, spike_rules
from slviewer.fringe.layout import Layout
from slviewer.fringe.levels import cell_misfit
from slviewer.fringe.phase import Noise, PhaseMap, Reason
from slviewer.fringe.phase_shifting import (
    TWO_PI,
    add_ripples,
    bit_heights,
    complete_map,
    dark_limit,
    dark_sigmas,
    decode_cell,
    detect_border_pixels,
    estimate_level_errors,
    phase_shift,
    read_code,
    unwrap,
)
from slviewer.fringe.sequence import Axis, PatternSequence


def decode_reference(
    sequence: PatternSequence, stack: np.ndarray, axis: Axis, light: FrameLight | None = None
) -> PhaseMap:
    """Decode one axis without kernels, like `decode.decode`: same wrapped phase to 1e-5 rad,
    absolute to 1e-4 rad."""
    task = prepare_decoding(sequence, stack, axis, light)
    layout, stack, noise, white = task.layout, task.stack, task.noise, task.white
    if not layout.shifts:
        phase, modulation, background, inconsistent, dark = _decode_gray_alone(layout, stack, noise)
        wrapped = np.full_like(phase, np.nan)
        weakest, saturated = modulation, np.zeros(phase.shape, bool)
    else:
        shifted = [
            phase_shift(stack, shift.indices, layout.sign, layout.offset_rad)
            for shift in layout.shifts
        ]
        wrapped, modulation, background, _ = shifted[-1]
        weakest = np.minimum.reduce([b for _, b, _, _ in shifted])
        saturated = np.logical_or.reduce(
            [(peak >= white) & (a + b >= white) for _, b, a, peak in shifted]
        )
        if layout.numbers_periods:
            order, inconsistent = _decode_period_order(
                layout, stack, wrapped, modulation, background
            )
        else:
            cell = decode_cell(layout, stack, modulation, background) if layout.gray else None
            ripples, misfit = estimate_level_errors(task)
            wrapped_all = add_ripples([psi for psi, _, _, _ in shifted], ripples)
            order, inconsistent = _unwrap_by_levels(layout, wrapped_all, cell, misfit)
        phase = (wrapped + TWO_PI * order).astype(np.float32)
        dark = np.zeros(phase.shape, bool)
    dark |= weakest < dark_limit(background, noise, task.full_scale, dark_sigmas(layout))
    reason = np.select(
        [saturated, dark, inconsistent],
        [Reason.SATURATED, Reason.DARK, Reason.INCONSISTENT],
        Reason.VALID,
    ).astype(np.uint8)
    phase[reason != Reason.VALID] = np.nan
    phase, reason = repair_spikes(layout, phase, reason)
    return complete_map(task, (phase, wrapped, modulation, background, reason))


def _decode_period_order(
    layout: Layout,
    stack: np.ndarray,
    wrapped: np.ndarray,
    modulation: np.ndarray,
    background: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the periods to add to the wrapped phase, and where this order is inconsistent, (h, w)
    each."""
    code, bit, heights = read_code(layout, stack, layout.gray, background)
    least = np.min(np.abs(heights), axis=0)
    turns = wrapped * np.float32(1 / TWO_PI) - np.float32(layout.gray_origin_px / layout.period_px)
    whole = np.floor(turns)
    part = turns - whole  # of a period, since the code edge
    undecided = np.float32(limits.UNDECIDED_BIT) * modulation
    middle = (part >= 0.25) & (part < 0.75)
    if layout.complementary is not None:
        last = bit_heights(layout, stack, layout.complementary, background)
        half = 2 * code + (bit ^ (last > 0))
        # Near an order's edge the half-period cells on both sides count as one; the phase decides
        # between them.
        order = np.where(middle, half >> 1, ((half + 1) >> 1) - (part >= 0.75))
        inconsistent = np.where(middle, least, np.abs(last)) < undecided
    else:
        ahead, behind, _ = detect_border_pixels(layout, stack, code, heights)
        order = (
            code
            + (ahead & (part < np.float32(limits.EDGE)))
            - (behind & (part >= np.float32(1 - limits.EDGE)))
        )
        inner = (part >= np.float32(limits.EDGE)) & (part < np.float32(1 - limits.EDGE))
        inconsistent = inner & (least < undecided)
    return order - whole, inconsistent


def _unwrap_by_levels(
    layout: Layout,
    wrapped: list[np.ndarray],
    cell: tuple[np.ndarray, np.ndarray] | None,
    misfit: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the periods to add to the finest wrapped phase, and where levels or cell are
    inconsistent, (h, w) each.

    ``cell``: see `decode_cell`, None without Gray code; ``misfit``: see `estimate_level_errors`.
    """
    order, turns = unwrap(layout, wrapped, None if cell is None else cell[0])
    inconsistent = np.zeros(order.shape, bool) if cell is None else cell[1]
    for k, each in enumerate(turns):
        largest = cell_misfit(layout) if cell is not None and k == 0 else misfit
        inconsistent = inconsistent | (np.abs(each - np.rint(each)) > largest)
    return order, inconsistent


def _decode_gray_alone(
    layout: Layout, stack: np.ndarray, noise: Noise
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return phase, modulation, background, inconsistent and dark, (h, w) each, from Gray bits
    alone.

    One undecided bit whose two readings are neighbouring columns puts the pixel on the border
    between them.
    """
    modulation, background = measure_gray_contrast(layout, stack)
    part_of_sigma = np.sqrt(0.5 if layout.inverse else 1.5)
    sigma = np.sqrt(np.float32(noise[0]) + np.float32(noise[1]) * background) * np.float32(
        part_of_sigma
    )
    limit = np.maximum(
        np.float32(limits.GRAY_UNDECIDED_SIGMAS) * sigma,
        np.float32(limits.GRAY_UNDECIDED_PART) * modulation,
    )
    code, other = np.zeros(modulation.shape, np.int32), np.zeros(modulation.shape, np.int32)
    bit, flipped = np.zeros_like(code), np.zeros_like(code)
    doubts = np.zeros_like(code)
    for i in layout.gray:
        height = bit_heights(layout, stack, i, background)
        doubt = np.abs(height) < limit
        if layout.binary:
            bit, flipped = np.zeros_like(code), np.zeros_like(code)
        bit ^= height > 0
        flipped ^= (height > 0) ^ doubt
        code, other = 2 * code + bit, 2 * other + flipped
        doubts += doubt
    inconsistent = (doubts > 1) | (np.abs(code - other) > 1)
    # At the projector's ends only a part of a cell may have been shown.
    cell, origin = layout.gray_cell_px, layout.gray_origin_px
    start, end = (
        origin + cell * np.minimum(code, other),
        origin + cell * (np.maximum(code, other) + 1.0),
    )
    first, last = np.maximum(start, -0.5), np.minimum(end, layout.extent - 0.5)
    centre = 0.5 * np.where(first < last, first + last, start + end)
    phase = (TWO_PI / cell * centre).astype(np.float32)
    return phase, modulation, background, inconsistent, doubts >= limits.DARK_BITS


def measure_gray_contrast(layout: Layout, stack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return modulation and background (h, w) float32 of Gray code alone, in grey levels.

    Half of white - black and their mean, or else from the bits and their inverses.
    """
    if layout.white is not None and layout.black is not None:
        white, black = (stack[i].astype(np.float32) for i in (layout.white, layout.black))
        return (white - black) * np.float32(0.5), (white + black) * np.float32(0.5)
    modulation = np.zeros(stack.shape[1:], np.float32)
    background = np.zeros(stack.shape[1:], np.float32)
    for i, j in zip(layout.gray, layout.inverse, strict=True):
        gray, inverse = stack[i].astype(np.float32), stack[j].astype(np.float32)
        modulation += np.abs(gray - inverse)
        background += gray + inverse
    scale = np.float32(0.5 / len(layout.gray))
    return modulation * scale, background * scale


def repair_spikes(
    layout: Layout, phase: np.ndarray, reason: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return phase and reason, (h, w) each, new arrays, corrected by each pixel's neighbourhood.

    A plain Gray code may be read on the wrong side of its edge: where a clear majority of the
    neighbours indicates this, such a pixel is moved by the one period. A pixel that still has too
    few supporting neighbours is INCONSISTENT. A depth step has enough neighbours on its own side,
    and is not changed.
    """
    rules = spike_rules(layout)
    phase, reason = phase.copy(), reason.copy()
    if rules.is_plain:
        v, u, votes = _count_votes(phase, rules)
        part = (phase[v, u] - np.float32(rules.origin_rad)) * np.float32(1 / TWO_PI)
        part -= np.floor(part)
        at_edge = (part < np.float32(limits.EDGE)) | (part >= np.float32(1 - limits.EDGE))
        enough = at_edge & (votes["valid"] >= limits.SPIKE_NEIGHBOURS)
        for word, shift in (("above", 1), ("below", -1)):
            move = enough & (votes[word] >= limits.SPIKE_MAJORITY * votes["valid"])
            phase[v[move], u[move]] += np.float32(shift * TWO_PI)
    v, u, votes = _count_votes(phase, rules)
    lonely = (votes["valid"] < limits.LONELY_NEIGHBOURS) | (
        votes["agree"] < limits.LONELY * votes["valid"]
    )
    reason[v[lonely], u[lonely]] = Reason.INCONSISTENT
    with np.errstate(invalid="ignore"):
        reason[(reason == Reason.VALID) & ((phase < rules.low_rad) | (phase > rules.high_rad))] = (
            Reason.OUTSIDE
        )
    return np.where(reason == Reason.VALID, phase, np.float32(np.nan)), reason


def _count_votes(
    phase: np.ndarray, rules: SpikeRules
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return row and column of the pixels that differ from one of their four neighbours, and the
    votes of their window.

    ``valid`` neighbours; those that ``agree``; those that are just one cell ``above``, ``below``.
    The phase is known modulo ``rules.repeat`` cells.
    """
    margin, repeat = limits.WINDOW, rules.repeat
    padded = np.pad(phase, margin, constant_values=np.nan)
    per_cell = np.float32(1 / rules.cell_rad)
    centre = padded[margin:-margin, margin:-margin]
    suspect = np.zeros(phase.shape, bool)
    with np.errstate(invalid="ignore"):
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            near = padded[
                margin + dv : margin + dv + phase.shape[0],
                margin + du : margin + du + phase.shape[1],
            ]
            suspect |= ~(np.abs(np.rint((near - centre) * per_cell)) < 0.5)
        v, u = np.nonzero(suspect & np.isfinite(phase))
        votes = {word: np.zeros(len(v), np.int32) for word in ("valid", "agree", "above", "below")}
        for dv, du in np.ndindex(2 * margin + 1, 2 * margin + 1):
            if dv == du == margin:
                continue
            cells = (padded[v + dv, u + du] - phase[v, u]) * per_cell
            if np.isfinite(repeat):
                cells -= np.float32(repeat) * np.rint(cells * np.float32(1 / repeat))
            nearest = np.rint(cells)
            whole = np.abs(cells - nearest) < np.float32(limits.WHOLE_PERIOD)
            votes["valid"] += np.isfinite(cells)
            votes["agree"] += nearest == 0
            votes["above"] += whole & (nearest == 1)
            votes["below"] += whole & (nearest == -1)
    return v, u, votes
