"""The phase shift and its Gray code in one pass over the frames; `reference` is what they must agree with.

A row of the image at a time, so that sums and codes stay in the cache while each frame is read once. Loops over a row
have no branches and no library calls: the compiler turns them into vector instructions.
"""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import fma, kernel

VALID, DARK, SATURATED, INCONSISTENT = (
    np.uint8(r) for r in (Reason.VALID, Reason.DARK, Reason.SATURATED, Reason.INCONSISTENT)
)
PER_TURN = np.float32(1 / (2 * np.pi))
TURN = np.float32(6.28125)
TURN_REST = np.float32(2 * np.pi - 6.28125)
"""2 pi in two parts: a whole number times the first is exact in float32."""
HALF_PI, PI = np.float32(np.pi / 2), np.float32(np.pi)


class Steps(NamedTuple):
    """A phase shift's frames, four to a line: of (p, q, r, s) with weights a and b, a (p - r - q + s) is added to the
    cosines' sum and b (p - r + q - s) to the sines'.

    Steps k, n/2 - k, n/2 + k and n - k share their cosine and sine but for signs: one product serves four frames. The
    first frame stands in where there are fewer. ``first``: its index; ``counted``: how often all frames are read.
    """

    frames: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    first: int
    steps: int
    counted: int


class Shifts(NamedTuple):
    """The `Steps` of all periods, longest first: of period i, lines ``starts[i]`` to ``starts[i + 1]``, and
    entry i of ``first``, ``steps`` and ``counted``."""

    frames: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    starts: np.ndarray
    first: np.ndarray
    steps: np.ndarray
    counted: np.ndarray


@numba.njit(inline="always")
def period(shifts, i):
    """The `Steps` of one period."""
    a, b = shifts.starts[i], shifts.starts[i + 1]
    lines = shifts.frames[a:b], shifts.cosines[a:b], shifts.sines[a:b]
    return Steps(lines[0], lines[1], lines[2], shifts.first[i], shifts.steps[i], shifts.counted[i])


class Scale(NamedTuple):
    """Grey levels that decide about a pixel: noise (a, b), DARK floor and sigmas, white level."""

    noise_a: float
    noise_b: float
    dark_levels: float
    dark_sigmas: float
    white: float


class CodeRules(NamedTuple):
    """How Gray bits are read; see `limits`, and `threshold` for ``mean``."""

    origin_turns: float
    edge: float
    weak: float
    weaker: float
    mean: float
    undecided: float


@numba.njit(inline="always")
def arctan2(y, x):
    """float32 arctangent without branches, good to 3e-7 rad (Abramowitz and Stegun, 4.4.49); 0 where both are 0."""
    ax, ay = abs(x), abs(y)
    # np.divide: the operator would check for zero and raise, which no vector instruction can.
    a = np.divide(min(ax, ay), max(ax, ay) + np.float32(1e-30))
    s = a * a
    r = fma(np.float32(0.0028662257), s, np.float32(-0.0161657367))
    r = fma(r, s, np.float32(0.0429096138))
    r = fma(r, s, np.float32(-0.0752896400))
    r = fma(r, s, np.float32(0.1065626393))
    r = fma(r, s, np.float32(-0.1420889944))
    r = fma(r, s, np.float32(0.1999355085))
    r = fma(r, s, np.float32(-0.3333314528))
    r = fma(r * s, a, a)
    r = HALF_PI - r if ay > ax else r
    r = PI - r if x < 0 else r
    return -r if y < 0 else r


@numba.njit(inline="always")
def shift_row(stack, shift, row, wrapped, modulation, background, peak):
    """Wrapped phase, modulation, background and largest sample (of the frames' dtype) of one image row."""
    width = stack.shape[2]
    cosine, sine, total = np.zeros(width, np.float32), np.zeros(width, np.float32), np.zeros(width, np.float32)
    first = stack[shift.first, row]
    for x in range(width):
        peak[x] = first[x]
    for k in range(0, len(shift.cosines), 2):  # eight frames to a pass: the sums are read and written less often
        i, j = shift.frames[k], shift.frames[k + 1]
        a, b, c, d = stack[i[0], row], stack[i[1], row], stack[i[2], row], stack[i[3], row]
        e, f, g, h = stack[j[0], row], stack[j[1], row], stack[j[2], row], stack[j[3], row]
        cos_a, sin_a, cos_e, sin_e = shift.cosines[k], shift.sines[k], shift.cosines[k + 1], shift.sines[k + 1]
        for x in range(width):
            value_a, value_b, value_c, value_d = np.float32(a[x]), np.float32(b[x]), np.float32(c[x]), np.float32(d[x])
            value_e, value_f, value_g, value_h = np.float32(e[x]), np.float32(f[x]), np.float32(g[x]), np.float32(h[x])
            ac, bd, eg, fh = value_a - value_c, value_b - value_d, value_e - value_g, value_f - value_h
            total[x] += ((value_a + value_b) + (value_c + value_d)) + ((value_e + value_f) + (value_g + value_h))
            cosine[x] = fma(cos_a, ac - bd, fma(cos_e, eg - fh, cosine[x]))
            sine[x] = fma(sin_a, ac + bd, fma(sin_e, eg + fh, sine[x]))
            peak[x] = max(peak[x], max(max(max(a[x], b[x]), max(c[x], d[x])), max(max(e[x], f[x]), max(g[x], h[x]))))
    per_two, per_one, counted = np.float32(2 / shift.steps), np.float32(1 / shift.steps), np.float32(shift.counted)
    for x in range(width):
        wrapped[x] = arctan2(np.float32(0) - sine[x], cosine[x])
        modulation[x] = np.sqrt(fma(cosine[x], cosine[x], sine[x] * sine[x])) * per_two
        level = np.float32(first[x])
        background[x] = fma(total[x] - counted * level, per_one, level)


@numba.njit(inline="always")
def is_dark(modulation, background, scale):
    """Whether the modulation is too small for the noise at this brightness."""
    sigmas = np.float32(scale.dark_sigmas)
    variance = np.float32(scale.noise_a) + np.float32(scale.noise_b) * background
    levels = np.float32(scale.dark_levels)
    return modulation * modulation < max(levels * levels, sigmas * sigmas * variance)


@numba.njit(inline="always")
def is_clipped(modulation, background, peak, scale):
    """Whether the fringe reaches the white level, in a sample and as fitted: noise alone does not do both."""
    return (np.float32(peak) >= np.float32(scale.white)) & (background + modulation >= np.float32(scale.white))


@numba.njit(inline="always")
def verdict(dark, clipped, inconsistent):
    """The first reason that applies: what is clipped in all its frames has no modulation, yet is not dark."""
    unclipped = DARK if dark else (INCONSISTENT if inconsistent else VALID)
    return SATURATED if clipped else unclipped


@numba.njit(inline="always")
def bit_height(stack, frames, inverses, bit, row, x, threshold):
    """Grey levels by which a Gray bit lies above its threshold."""
    value = np.float32(stack[frames[bit], row, x])
    if len(inverses):
        return (value - np.float32(stack[inverses[bit], row, x])) * np.float32(0.5)
    return value - threshold


@numba.njit(inline="always")
def code_row(stack, frames, inverses, row, threshold, code, least, top, bottom, lower, upper):
    """One row's binary code, and of its bits' heights above their threshold the least in size, the highest and the
    lowest, and those of the bits that change at the ``lower`` and at the ``upper`` edge of the code.

    From k - 1 to k the Gray bit changes at whose place k has its last binary 1; from k to k + 1 that of its last 0. A
    code without such a bit has no such edge: infinite.
    """
    width = stack.shape[2]
    none, nothing = np.float32(np.inf), np.float32(0)
    digit = np.zeros(width, np.uint8)
    for x in range(width):
        code[x] = 0
    if len(inverses):
        for x in range(width):
            top[x] = bottom[x] = nothing
            least[x] = lower[x] = upper[x] = none
        for b in range(len(frames)):
            frame, inverse = stack[frames[b], row], stack[inverses[b], row]
            for x in range(width):
                height = (np.float32(frame[x]) - np.float32(inverse[x])) * np.float32(0.5)
                one = np.uint8(digit[x] ^ np.uint8(height > 0))
                at_lower, at_upper = lower[x], upper[x]
                digit[x] = one
                code[x] = np.int32(np.int32(code[x] + code[x]) | np.int32(one))
                least[x] = min(least[x], abs(height))
                top[x] = max(top[x], height)
                bottom[x] = min(bottom[x], height)
                lower[x] = height if one != 0 else at_lower
                upper[x] = at_upper if one != 0 else height
        return
    # Against one threshold the frames' own numbers can be compared: four times as many fit a register.
    grey = stack.dtype.type
    full = grey(65535 if stack.itemsize == 2 else 255)
    level, bits = np.empty(width, stack.dtype), np.empty(width, np.uint8)
    over_least, under_most = np.empty(width, stack.dtype), np.zeros(width, stack.dtype)
    most, fewest = np.zeros(width, stack.dtype), np.empty(width, stack.dtype)
    at_one, at_nought = np.zeros(width, stack.dtype), np.zeros(width, stack.dtype)
    for x in range(width):
        level[x] = grey(np.int32(threshold[x]))
        over_least[x] = fewest[x] = full
    for start in range(0, len(frames), 8):
        last = min(start + 8, len(frames))
        for x in range(width):
            bits[x] = 0
        for b in range(start, last):
            frame = stack[frames[b], row]
            for x in range(width):
                value, at_lower, at_upper = frame[x], at_one[x], at_nought[x]
                over = value > level[x]
                one = np.uint8(digit[x] ^ np.uint8(over))  # the binary digit is the parity of all Gray bits so far
                digit[x] = one
                bits[x] = np.uint8(np.uint8(bits[x] + bits[x]) | one)
                over_least[x] = min(over_least[x], value if over else full)
                under_most[x] = max(under_most[x], grey(0) if over else value)
                most[x] = max(most[x], value)
                fewest[x] = min(fewest[x], value)
                at_one[x] = value if one != 0 else at_lower
                at_nought[x] = at_upper if one != 0 else value
        more, ones = np.int32(1 << (last - start)), np.int32((1 << len(frames)) - 1)
        for x in range(width):
            code[x] = np.int32(np.int32(code[x] * more) + np.int32(bits[x]))
    for x in range(width):
        level_x, nearest_over, nearest_under = threshold[x], np.float32(over_least[x]), np.float32(under_most[x])
        above = nearest_over - level_x if most[x] > level[x] else none
        below = level_x - nearest_under if fewest[x] <= level[x] else none
        least[x] = min(above, below)
    for x in range(width):
        level_x, highest, lowest = threshold[x], np.float32(most[x]), np.float32(fewest[x])
        top[x], bottom[x] = max(nothing, highest - level_x), min(nothing, lowest - level_x)
    for x in range(width):
        level_x, one_x, nought_x = threshold[x], np.float32(at_one[x]), np.float32(at_nought[x])
        lower[x] = one_x - level_x if code[x] != 0 else none
        upper[x] = nought_x - level_x if code[x] != ones else none


@numba.njit(inline="always")
def five(width):
    """Five rows of float32; arrays of their own, so that the compiler knows that none overlap."""
    a, b, c = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    return a, b, c, np.empty(width, np.float32), np.empty(width, np.float32)


@numba.njit(inline="always")
def coded_row(stack, gray, inverse, complementary, row, scale, rules, psi, B, A, peak, code, room, phase, reason):
    """One row's absolute phase and reason from what ``shift_row`` left; ``code`` (w,) int32 and what `five`
    gives are room."""
    width = stack.shape[2]
    least, top, bottom, lower, upper = room
    code_row(stack, gray, inverse, row, A, code, least, top, bottom, lower, upper)
    origin, undecided = np.float32(rules.origin_turns), np.float32(rules.undecided)
    edge, far_edge = np.float32(rules.edge), np.float32(1 - rules.edge)
    per_mean, per_rest = np.float32(1 / rules.mean), np.float32(1 / (1 - rules.mean))
    off_middle, weak, weaker = np.float32(0.5 - rules.mean), np.float32(rules.weak / 2), np.float32(rules.weaker)
    none, quarter = np.float32(np.nan), np.float32(0.25)
    if complementary >= 0:
        extra = stack[complementary, row]
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            last = np.float32(extra[x]) - A[x]
            cell = np.int32(np.int32(code[x] + code[x]) + np.int32(np.int32(code[x] & 1) ^ np.int32(last > 0)))
            middle = (part >= quarter) & (part < np.float32(0.75))
            beside = np.int32(np.int32(np.int32(cell + 1) >> 1) - np.int32(part >= np.float32(0.75)))
            order = np.int32(cell >> 1) if middle else beside
            unclear = (least[x] if middle else abs(last)) < undecided * B[x]
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = verdict(dark, clipped, unclear)
            periods = np.float32(order) - whole
            absolute = fma(periods, TURN, fma(periods, TURN_REST, psi[x]))
            phase[x] = none if dark | clipped | unclear else absolute
    else:
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            unclear = (least[x] < undecided * B[x]) & (part >= edge) & (part < far_edge)
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = verdict(dark, clipped, unclear)
            # On a blurred edge the bit nearest the middle and the phase may disagree about the side: the phase decides.
            contrast = max(top[x] * per_rest, np.float32(0) - bottom[x] * per_mean)
            below, above = abs(lower[x] - off_middle * contrast), abs(upper[x] - off_middle * contrast)
            ahead = (part < edge) & (above < weak * contrast) & (above < weaker * below)
            behind = (part >= far_edge) & (below < weak * contrast) & (below < weaker * above)
            periods = np.float32(code[x]) - whole
            periods += np.float32(1) if ahead else np.float32(0)
            periods -= np.float32(1) if behind else np.float32(0)
            absolute = fma(periods, TURN, fma(periods, TURN_REST, psi[x]))
            phase[x] = none if dark | clipped | unclear else absolute


@kernel(parallel=True)
def decode_coded(
    stack, shift, gray, inverse, complementary, scale, rules, phase, wrapped, modulation, background, reason
):
    """Phase shift with a plain (``complementary`` < 0) or complementary Gray code; fills the five (h, w) maps.

    ``phase`` is NaN where ``reason`` is not VALID, here as in the other kernels.
    """
    _, height, width = stack.shape
    for row in numba.prange(height):
        peak, code = np.empty(width, stack.dtype), np.empty(width, np.int32)
        room = five(width)
        psi, B, A = wrapped[row], modulation[row], background[row]
        shift_row(stack, shift, row, psi, B, A, peak)
        coded_row(
            stack, gray, inverse, complementary, row, scale, rules, psi, B, A, peak, code, room, phase[row], reason[row]
        )
