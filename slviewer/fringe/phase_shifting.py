"""Phase shifting, Gray bits and levels in NumPy, for what needs them of a few pixels, and what is
common to every decoded map."""

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.aliased_harmonics import (
    MOST_STEPS,
    AliasedHarmonics,
    correct_harmonics,
    estimate_aliased_harmonics,
)
from slviewer.fringe.cosines import FEWEST, select_rows
from slviewer.fringe.decoding_task import DecodingTask
from slviewer.fringe.indirect_light import mask_indirect_light
from slviewer.fringe.layout import Layout
from slviewer.fringe.levels import (
    code_cell_px,
    layout_levels,
    lowest_coordinate,
    required_modulation,
    unambiguous_px,
    unwrap_levels,
)
from slviewer.fringe.phase import Noise, PhaseMap
from slviewer.fringe.scatter import with_scatter
from slviewer.fringe.sequence import Indices
from slviewer.fringe.threshold import fringe_mean

TWO_PI = 2 * np.pi
LEVEL_PIXELS = 4000
"""Pixels from which the agreement of several periods is estimated."""
AGREEMENT = 0.02
"""Loss, 1 less the mean cosine of a step, of levels that agree: a scatter of 3 % of a period."""
MOST_LOSS = 0.3
"""Loss up to which ripples account for levels: a scatter of an eighth of a period."""
AMPLITUDES = np.linspace(-0.4, 0.4, 33)
"""Of ripples that are tried: a gamma of 2.2 has one of 0.29 in three steps."""
_ARGUMENTS = np.linspace(-np.pi, np.pi, 1025)


def complete_map(
    task: DecodingTask, maps: tuple[np.ndarray, ...], mask_indirect: bool = True
) -> PhaseMap:
    """Return the phase map of decoded ``maps`` (phase, wrapped phase, modulation, background,
    reason), each (h, w).

    With ``mask_indirect`` pixels of much indirect light are masked, see `indirect_light`. The phase
    is corrected for gamma, grey levels are those of the capture, and the scatter of the phase is
    measured.
    """
    layout, factor, (a, b) = task.layout, task.factor, task.noise
    if mask_indirect:
        mask_indirect_light(task, maps)
    phase, wrapped, modulation, background, reason = maps
    harmonics = estimate_aliased_harmonics(layout, task.stack, task.white, task.noise)
    phase, wrapped = correct_harmonics(harmonics, layout, phase, wrapped)
    if factor != 1:
        per_level = np.float32(1 / factor)
        modulation, background = modulation * per_level, background * per_level
    phase_map = PhaseMap(
        layout.axis,
        layout.period_px,
        phase,
        wrapped,
        modulation,
        background,
        reason,
        (a / factor**2, b / factor),
        layout.steps,
        unambiguous_px(layout),
        harmonics.error_rad,
    )
    return with_scatter(phase_map)


def phase_shift(
    stack: np.ndarray, indices: Indices, sign: int, offset_rad: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return wrapped phase (rad), modulation, background and largest sample of one period, float32
    (h, w) each.

    ``sign`` and ``offset_rad`` are the sequence's.
    """
    n = len(indices)
    first = stack[indices[0]].astype(np.float32)
    cosine, sine, total = np.zeros_like(first), np.zeros_like(first), np.zeros_like(first)
    peak = first.copy()
    for k, i in enumerate(indices):
        frame = stack[i].astype(np.float32)
        np.maximum(peak, frame, out=peak)
        frame -= first  # cancels in the sums, which are then exact in float32
        cosine += np.float32(np.cos(TWO_PI * k / n)) * frame
        sine += np.float32(np.sin(TWO_PI * k / n)) * frame
        total += frame
    sine *= np.float32(sign)
    if offset_rad:
        turn, across = np.float32(np.cos(offset_rad)), np.float32(np.sin(offset_rad))
        cosine, sine = turn * cosine - across * sine, turn * sine + across * cosine
    wrapped = np.arctan2(0 - sine, cosine)  # a zero without sign, for pi rather than -pi
    return (
        wrapped,
        np.hypot(cosine, sine) * np.float32(2 / n),
        first + total * np.float32(1 / n),
        peak,
    )


def dark_sigmas(layout: Layout) -> float:
    """Return the modulation, in standard deviations of a grey level, below which a pixel is
    DARK."""
    if layout.numbers_periods or not layout.shifts:
        return limits.DARK_SIGMAS
    steps = min(len(shift.indices) for shift in layout.shifts)
    return max(limits.DARK_SIGMAS, required_modulation(layout_levels(layout), steps))


def dark_limit(background: np.ndarray, noise: Noise, white: float, sigmas: float) -> np.ndarray:
    """Return the modulation (h, w) float32, grey levels, below which a pixel is DARK."""
    sigma = np.sqrt(np.float32(noise[0]) + np.float32(noise[1]) * background)
    return np.maximum(np.float32(limits.DARK_LEVELS * white / 255), np.float32(sigmas) * sigma)


def bit_heights(layout: Layout, stack: np.ndarray, index: int, threshold: np.ndarray) -> np.ndarray:
    """Return the grey levels (h, w) float32 by which a bit is above its threshold.

    Half of gray - inverse where there is an inverse.
    """
    frame = stack[index].astype(np.float32)
    if index in layout.gray and layout.inverse:
        inverse = stack[layout.inverse[layout.gray.index(index)]].astype(np.float32)
        return (frame - inverse) * np.float32(0.5)
    return frame - threshold


def read_code(
    layout: Layout, stack: np.ndarray, bits: Indices, background: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the binary number (h, w) int32 that Gray bits encode, its last digit, and the bits'
    heights (b, h, w)."""
    heights = np.stack([bit_heights(layout, stack, i, background) for i in bits])
    # a binary digit is the parity of all Gray bits so far
    digits = np.logical_xor.accumulate(heights > 0)
    places = 1 << np.arange(len(bits), dtype=np.int32)[::-1]
    return np.tensordot(places, digits.astype(np.int32), 1), digits[-1].astype(np.int32), heights


def detect_border_pixels(
    layout: Layout, stack: np.ndarray, code: np.ndarray, heights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a pixel is at the upper and at the lower border of its cell, (h, w) bool each.

    Third, the least height (h, w) of the bits that change at neither border. The bit that is near
    the middle of black and white determines the border.
    """
    top = np.maximum(heights.max(axis=0), np.float32(0))
    bottom = np.minimum(heights.min(axis=0), np.float32(0))
    mean = np.float32(fringe_mean(layout, stack))
    contrast = np.maximum(top / (1 - mean), -bottom / mean)
    middle = (np.float32(0.5) - mean) * contrast
    lower, upper, least = (np.full(code.shape, np.inf, np.float32) for _ in range(3))
    for from_least, height in enumerate(heights[::-1]):
        # From k - 1 to k the Gray bit changes whose number, from the least, is the count of
        # trailing zeros of k; from k to k + 1 that of its trailing ones.
        low_bits = code & ((2 << from_least) - 1)
        at_lower, at_upper = low_bits == 1 << from_least, low_bits == (1 << from_least) - 1
        lower = np.where(at_lower, np.abs(height - middle), lower)
        upper = np.where(at_upper, np.abs(height - middle), upper)
        least = np.where(at_lower | at_upper, least, np.minimum(least, np.abs(height)))
    weak, weaker = np.float32(limits.WEAK_BIT / 2) * contrast, np.float32(limits.WEAKER)
    return (
        (upper < weak) & (upper < weaker * lower),
        (lower < weak) & (lower < weaker * upper),
        least,
    )


def decode_cell(
    layout: Layout, stack: np.ndarray, modulation: np.ndarray, background: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinate px of the cell that the Gray bits number, and where it is undecided,
    (h, w) each.

    The coordinate is the middle of the cell, or its border where the bit that changes there is near
    the middle of black and white. It is undecided where any other bit is.
    """
    code, _, heights = read_code(layout, stack, code_bits(layout), background)
    ahead, behind, least = detect_border_pixels(layout, stack, code, heights)
    part = np.where(ahead, 1.0, np.where(behind, 0.0, 0.5))
    undecided = least < np.float32(limits.UNDECIDED_BIT) * modulation
    return layout.gray_origin_px + code_cell_px(layout) * (code + part), undecided


def code_bits(layout: Layout) -> Indices:
    """Return the frames of all Gray bits, the most significant first and the complementary one
    last."""
    return (*layout.gray, *(() if layout.complementary is None else (layout.complementary,)))


def unwrap(
    layout: Layout, wrapped: list[np.ndarray], near: np.ndarray | None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return order and turns of `levels.unwrap_levels` for the levels of a layout."""
    levels = layout_levels(layout)
    low = lowest_coordinate(levels[0].period_px, min(layout.extent, unambiguous_px(layout)))
    return unwrap_levels(levels, wrapped, low, near)[1:]


def estimate_level_errors(task: DecodingTask) -> tuple[np.ndarray, float]:
    """Estimate how gamma disturbs the steps from level to level; returns ripples and misfit.

    Ripples (m, 1025) float32, rad, are to be added to the m wrapped phases from -pi to pi: those of
    longer periods of three or four steps, with the amplitude for which the levels agree best; (m,
    0) where none makes them agree, twice as well at least. Misfit, in periods:
    `limits.LEVEL_MISFIT`, or less where the levels scatter by so much that a wrong order were as
    likely as 1 in 1000.
    """
    layout, stack = task.layout, task.stack
    none = np.zeros((len(layout.shifts), 0), np.float32)
    stack = np.ascontiguousarray(
        stack[:, select_rows(stack.shape[1], stack.shape[2], LEVEL_PIXELS)]
    )
    shifted = [
        phase_shift(stack, shift.indices, layout.sign, layout.offset_rad) for shift in layout.shifts
    ]
    valid = np.ones(stack.shape[1:], bool)
    for _, B, A, peak in shifted:
        dark = dark_limit(A, task.noise, task.full_scale, dark_sigmas(layout))
        valid &= (dark <= B) & (peak < task.white)
    near = decode_cell(layout, stack, *shifted[-1][1:3])[0][valid] if layout.gray else None
    wrapped = [psi[valid] for psi, _, _, _ in shifted]
    if len(wrapped[0]) < FEWEST or len(layout_levels(layout)) < 2:
        return none, limits.LEVEL_MISFIT

    best, turns = fit_ripples(layout, wrapped, near)
    sigma = 1.4826 * np.median(np.abs(turns - np.rint(turns)), axis=1).max()
    return best, float(np.clip(0.5 - np.log(1000) * sigma**2, 0.02, limits.LEVEL_MISFIT))


def fit_ripples(
    layout: Layout, wrapped: list[np.ndarray], near: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ripples that `estimate_level_errors` describes, and with them the steps between
    the levels (levels, p), in periods, whole where they agree; of the phases ``wrapped``, m of p
    pixels, and the coordinates ``near`` which their Gray cells are."""

    def measure_turns(ripples: np.ndarray) -> np.ndarray:
        """Return the steps."""
        turns = unwrap(layout, add_ripples(wrapped, ripples), near)[1]
        return np.array(turns[layout.gray != () :])

    def measure_loss(ripples: np.ndarray) -> float:
        """Return by how much the steps disagree, 0 to 2."""
        return float(1 - np.cos(TWO_PI * measure_turns(ripples)).mean(axis=1).min())

    steps = [len(shift.indices) for shift in layout.shifts[:-1]]
    best = np.zeros((len(layout.shifts), 0), np.float32)
    least = max(min(measure_loss(best) / 2, MOST_LOSS), AGREEMENT)
    for d in AMPLITUDES if least > AGREEMENT and min(steps) <= MOST_STEPS else ():
        ripples = np.zeros((len(steps) + 1, len(_ARGUMENTS)), np.float32)
        for ripple, n in zip(ripples, steps, strict=False):  # the finest has its own correction
            if n <= MOST_STEPS:
                ripple[:] = AliasedHarmonics(n, d, d).correction(_ARGUMENTS + layout.offset_rad)
        if (loss := measure_loss(ripples)) < least:
            best, least = ripples, loss
    return best, measure_turns(best)


def add_ripples(wrapped: list[np.ndarray], ripples: np.ndarray) -> list[np.ndarray]:
    """Add ripples, see `estimate_level_errors`, to the wrapped phases of all periods."""
    if not ripples.size:
        return wrapped
    return [
        psi + np.interp(psi, _ARGUMENTS, ripple).astype(np.float32)
        for psi, ripple in zip(wrapped, ripples, strict=True)
    ]
