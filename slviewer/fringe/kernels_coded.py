"""Decoding of Gray code with a phase shift, compiled; defined by `tests/decode_reference.py`."""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.kernels import (
    ENDLESS,
    HALF,
    NAN,
    ONE,
    PER_TURN,
    QUARTER,
    THREE_QUARTERS,
    TURN,
    TURN_REST,
    ZERO,
    allocate_five,
    is_clipped,
    is_dark,
    prefetch_row,
    select_period,
    select_reason,
    shift_row,
)  # fmt: skip
from slviewer.geometry.jit import fma, kernel

EDGE, FAR_EDGE = np.float32(limits.EDGE), np.float32(1 - limits.EDGE)
WEAK = np.float32(limits.WEAK_BIT / 2)
WEAKER = np.float32(limits.WEAKER)
UNDECIDED = np.float32(limits.UNDECIDED_BIT)


class CodeRules(NamedTuple):
    """Frames and origin of a Gray code that numbers the periods of a phase shift.

    ``gray``, ``inverse``: frames of the bits, most significant first, and of their inverses, or
    none; ``complementary``: that of the complementary bit, or -1. Code 0 begins ``origin_turns``
    periods from phase 0; ``mean``: see `threshold`.
    """

    gray: np.ndarray
    inverse: np.ndarray
    complementary: int
    origin_turns: float
    mean: float


@numba.njit
def read_bit(value, level, digit, over_least, under_most, at_one, at_nought, full):
    """Read one Gray bit: return the next binary digit and the updated extremes of the samples so
    far.

    The digit is the parity of all Gray bits so far. The extremes, see `code_row`, are the least
    sample above the level and the largest below it, and the last samples at a 1 and at a 0.
    """
    over = value > level
    one = np.uint8(digit ^ np.uint8(over))
    over_least = min(over_least, value if over else full)
    under_most = max(under_most, under_most if over else value)
    return (
        one,
        over_least,
        under_most,
        value if one != 0 else at_one,
        at_nought if one != 0 else value,
    )


@numba.njit(inline="always")
def code_row(stack, frames, inverses, row, threshold, code, least, top, bottom, lower, upper):
    """Read the binary code of one image row, and the heights of its bits above their threshold.

    Fills ``code`` (w,) and, in grey levels (w,): ``least``, the smallest height in size; ``top``,
    the highest, at least 0; ``bottom``, the lowest, at most 0; and the heights of the bits that
    change at the ``lower`` and at the ``upper`` edge of the code.

    From k - 1 to k the Gray bit changes at whose place k has its last binary 1; from k to k + 1
    that of its last 0. A code without such a bit has no such edge: infinite.
    """
    if len(inverses):
        opposed_code_row(stack, frames, inverses, row, code, least, top, bottom, lower, upper)
    else:
        plain_code_row(stack, frames, row, threshold, code, least, top, bottom, lower, upper)


@numba.njit(inline="always")
def opposed_code_row(stack, frames, inverses, row, code, least, top, bottom, lower, upper):
    """Read the binary code of one image row from bits and their inverses, see `code_row`."""
    width = stack.shape[2]
    digits = np.zeros(width, np.uint8)
    for x in range(width):
        code[x] = 0
        top[x] = bottom[x] = ZERO
        least[x] = lower[x] = upper[x] = ENDLESS
    for b in range(len(frames)):
        frame, inverse = stack[frames[b], row], stack[inverses[b], row]
        for x in range(width):
            height = (np.float32(frame[x]) - np.float32(inverse[x])) * HALF
            one = np.uint8(digits[x] ^ np.uint8(height > 0))
            at_lower, at_upper = lower[x], upper[x]
            digits[x] = one
            code[x] = np.int32(np.int32(code[x] + code[x]) | np.int32(one))
            least[x] = min(least[x], abs(height))
            top[x] = max(top[x], height)
            bottom[x] = min(bottom[x], height)
            lower[x] = height if one != 0 else at_lower
            upper[x] = at_upper if one != 0 else height


@numba.njit(inline="always")
def plain_code_row(stack, frames, row, threshold, code, least, top, bottom, lower, upper):
    """Read the binary code of one image row from bits and their threshold, see `code_row`.

    Above one threshold the brightest and the darkest sample decide ``top`` and ``bottom``, the
    nearest ones on either side ``least``, and the last ones at a 1 and at a 0 the edges. So only
    these samples are kept while the bits are read, as the frames' own numbers, of which four times
    as many fit a register as of floats, and heights are computed from them at the end. ``bits``
    holds the digits of up to eight bits, which are then appended to the code.
    """
    width = stack.shape[2]
    grey = stack.dtype.type
    full = grey(65535 if stack.itemsize == 2 else 255)
    level, bits = np.empty(width, stack.dtype), np.empty(width, np.uint8)
    over_least, under_most = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    most, fewest = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    at_one, at_nought = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    for x in range(width):
        level[x] = grey(np.int32(threshold[x]))  # rounded down: over it is over the threshold
        over_least[x] = fewest[x] = full
        under_most[x] = most[x] = at_one[x] = at_nought[x] = grey(0)
        bits[x] = code[x] = 0
    for start in range(0, len(frames), 8):
        last = min(start + 8, len(frames))
        if (last - start) % 2:  # an odd bit first
            frame = stack[frames[start], row]
            prefetch_row(stack, frames[start], row)
            for x in range(width):
                value, digit = frame[x], np.uint8(bits[x] & 1)
                one, over_least[x], under_most[x], at_one[x], at_nought[x] = read_bit(
                    value,
                    level[x],
                    digit,
                    over_least[x],
                    under_most[x],
                    at_one[x],
                    at_nought[x],
                    full,
                )
                bits[x] = np.uint8(np.uint8(bits[x] + bits[x]) | one)
                most[x], fewest[x] = max(most[x], value), min(fewest[x], value)
        for b in range(start + (last - start) % 2, last, 2):  # two bits to a pass
            frame, other = stack[frames[b], row], stack[frames[b + 1], row]
            prefetch_row(stack, frames[b], row)
            prefetch_row(stack, frames[b + 1], row)
            for x in range(width):
                value, after, digit = frame[x], other[x], np.uint8(bits[x] & 1)
                one, least_x, most_x, one_x, nought_x = read_bit(
                    value,
                    level[x],
                    digit,
                    over_least[x],
                    under_most[x],
                    at_one[x],
                    at_nought[x],
                    full,
                )
                two, over_least[x], under_most[x], at_one[x], at_nought[x] = read_bit(
                    after, level[x], one, least_x, most_x, one_x, nought_x, full
                )
                so_far = np.uint8(np.uint8(bits[x] + bits[x]) | one)
                bits[x] = np.uint8(np.uint8(so_far + so_far) | two)
                most[x] = max(most[x], max(value, after))
                fewest[x] = min(fewest[x], min(value, after))
        # append the digits
        more, held = np.int32(1 << (last - start)), np.uint8((1 << (last - start)) - 1)
        for x in range(width):
            code[x] = np.int32(np.int32(code[x] * more) + np.int32(np.uint8(bits[x] & held)))
    # the heights above the threshold of the samples that were kept
    for x in range(width):
        level_x = threshold[x]
        nearest_over = np.float32(over_least[x])
        nearest_under = np.float32(under_most[x])
        above = nearest_over - level_x if most[x] > level[x] else ENDLESS
        below = level_x - nearest_under if fewest[x] <= level[x] else ENDLESS
        least[x] = min(above, below)
    for x in range(width):
        level_x, highest, lowest = threshold[x], np.float32(most[x]), np.float32(fewest[x])
        top[x], bottom[x] = max(ZERO, highest - level_x), min(ZERO, lowest - level_x)
    ones = np.int32((1 << len(frames)) - 1)
    for x in range(width):
        level_x, one_x, nought_x = threshold[x], np.float32(at_one[x]), np.float32(at_nought[x])
        lower[x] = one_x - level_x if code[x] != 0 else ENDLESS
        upper[x] = nought_x - level_x if code[x] != ones else ENDLESS


@numba.njit(inline="always")
def coded_row(stack, row, scale, rules, psi, B, A, peak, code, buffers, phase, reason):
    """Compute the absolute phase and the reason of one image row from the output of `shift_row`.

    ``code`` (w,) int32 and ``buffers`` from `allocate_five` are buffers.
    """
    width = stack.shape[2]
    least, top, bottom, lower, upper = buffers
    code_row(stack, rules.gray, rules.inverse, row, A, code, least, top, bottom, lower, upper)
    origin = np.float32(rules.origin_turns)
    per_mean, per_rest = np.float32(1 / rules.mean), np.float32(1 / (1 - rules.mean))
    off_middle = np.float32(0.5 - rules.mean)
    if rules.complementary >= 0:
        extra = stack[rules.complementary, row]
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            last = np.float32(extra[x]) - A[x]
            cell = np.int32(
                np.int32(code[x] + code[x]) + np.int32(np.int32(code[x] & 1) ^ np.int32(last > 0))
            )
            middle = (part >= QUARTER) & (part < THREE_QUARTERS)
            beside = np.int32(np.int32(np.int32(cell + 1) >> 1) - np.int32(part >= THREE_QUARTERS))
            order = np.int32(cell >> 1) if middle else beside
            unclear = (least[x] if middle else abs(last)) < UNDECIDED * B[x]
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = select_reason(dark, clipped, unclear)
            periods = np.float32(order) - whole
            absolute = fma(periods, TURN, fma(periods, TURN_REST, psi[x]))
            phase[x] = NAN if dark | clipped | unclear else absolute
    else:
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            unclear = (least[x] < UNDECIDED * B[x]) & (part >= EDGE) & (part < FAR_EDGE)
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = select_reason(dark, clipped, unclear)
            # On a blurred edge the bit nearest the middle and the phase may disagree about the
            # side: the phase decides.
            contrast = max(top[x] * per_rest, ZERO - bottom[x] * per_mean)
            below = abs(lower[x] - off_middle * contrast)
            above = abs(upper[x] - off_middle * contrast)
            ahead = (part < EDGE) & (above < WEAK * contrast) & (above < WEAKER * below)
            behind = (part >= FAR_EDGE) & (below < WEAK * contrast) & (below < WEAKER * above)
            periods = np.float32(code[x]) - whole
            periods += ONE if ahead else ZERO
            periods -= ONE if behind else ZERO
            absolute = fma(periods, TURN, fma(periods, TURN_REST, psi[x]))
            phase[x] = NAN if dark | clipped | unclear else absolute


@kernel()
def coded_rows(stack, shifts, scale, rules, first, phase, wrapped, modulation, background, reason):
    """Decode rows from ``first`` on by a phase shift of one period with a plain or complementary
    Gray code, see `kernels.decode_rows`; the five maps contain only these rows."""
    width, steps = stack.shape[2], select_period(shifts, 0)
    peak = np.empty(width, stack.dtype)
    code = np.empty(width, np.int32)
    buffers = allocate_five(width)
    for i in range(len(phase)):
        row, psi, B, A = first + i, wrapped[i], modulation[i], background[i]
        shift_row(stack, steps, row, psi, B, A, peak)
        coded_row(stack, row, scale, rules, psi, B, A, peak, code, buffers, phase[i], reason[i])
