"""Phase shift, compiled; defined by `tests/decode_reference.py`.

A row of the image at a time, so that sums and codes stay in the cache while each frame is read
once. Loops over a row have no branches and no library calls: the compiler turns them into vector
instructions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import (
    add_fixed_width,
    fma,
    prefetch,
    read_only,
    run_rows,
    subtract_fixed_width,
    to_signed,
)

VALID, DARK, SATURATED, INCONSISTENT = (
    np.uint8(r) for r in (Reason.VALID, Reason.DARK, Reason.SATURATED, Reason.INCONSISTENT)
)
ZERO, HALF, ONE, NAN, ENDLESS = (np.float32(number) for number in (0, 0.5, 1, np.nan, np.inf))
QUARTER, THREE_QUARTERS = np.float32(0.25), np.float32(0.75)
PER_TURN = np.float32(1 / (2 * np.pi))
TURN = np.float32(6.28125)
TURN_REST = np.float32(2 * np.pi - 6.28125)
"""2 pi in two parts: a whole number times the first is exact in float32."""
ROWS = 4
"""Image rows that a thread works on at a time, with one allocation of its buffers."""
LINE_BYTES = 64
"""Of the processor's cache."""
HALF_PI, PI = np.float32(np.pi / 2), np.float32(np.pi)


class Steps(NamedTuple):
    """Frames of a phase shift, four to a line, with the weights of their samples.

    Of a line (p, q, r, s) with weights a and b, a (p - r - q + s) is added to the cosines' sum and
    b (p - r + q - s) to the sines'. Steps k, n/2 - k, n/2 + k and n - k share their cosine and sine
    but for signs: one product serves four frames. The first frame stands in where there are fewer.
    ``first``: its index; ``counted``: how often all frames are read. ``turn_cosine`` and
    ``turn_sine``: of the phase offset, by which the sums are rotated back.
    """

    frames: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    first: int
    steps: int
    counted: int
    turn_cosine: float
    turn_sine: float


class Shifts(NamedTuple):
    """`Steps` of all periods, longest first.

    Period i has the lines ``starts[i]`` to ``starts[i + 1]``, and entry i of ``first``, ``steps``
    and ``counted``; the phase offset is that of all.
    """

    frames: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    starts: np.ndarray
    first: np.ndarray
    steps: np.ndarray
    counted: np.ndarray
    turn_cosine: float
    turn_sine: float


@numba.njit(inline="always")
def select_period(shifts, i):
    """Return the `Steps` of period ``i`` of packed shifts."""
    a, b = shifts.starts[i], shifts.starts[i + 1]
    lines = shifts.frames[a:b], shifts.cosines[a:b], shifts.sines[a:b]
    turn = shifts.turn_cosine, shifts.turn_sine
    return Steps(
        lines[0],
        lines[1],
        lines[2],
        shifts.first[i],
        shifts.steps[i],
        shifts.counted[i],
        turn[0],
        turn[1],
    )


class Scale(NamedTuple):
    """Grey levels that decide about a pixel: noise (a, b), DARK floor and sigmas, white level."""

    noise_a: float
    noise_b: float
    dark_levels: float
    dark_sigmas: float
    white: float


@numba.njit
def arctan2(y, x):
    """Return the float32 arctangent of y / x in rad, computed without branches; 0 where both are 0.

    Accurate to 3e-7 rad (Abramowitz and Stegun, 4.4.49).
    """
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


@numba.njit
def prefetch_row(stack, frame, row):
    """Prefetch the next row of a frame while this one is processed.

    The processor itself prefetches one or two frames, not twenty.
    """
    if row + 1 < stack.shape[1]:
        line = stack[frame, row + 1]
        for x in range(0, len(line), LINE_BYTES // stack.itemsize):
            prefetch(line, x)


@numba.njit
def combine_samples(a, b, c, d):
    """Combine the samples (p, q, r, s) of a line of `Steps`: sum, p - r - q + s, p - r + q - s, and
    the largest."""
    ac = subtract_fixed_width(to_signed(a), to_signed(c))
    bd = subtract_fixed_width(to_signed(b), to_signed(d))
    total = add_fixed_width(
        add_fixed_width(to_signed(a), to_signed(b)), add_fixed_width(to_signed(c), to_signed(d))
    )
    return total, subtract_fixed_width(ac, bd), add_fixed_width(ac, bd), max(max(a, b), max(c, d))


@numba.njit
def add_four(a, b, c, d, cos_a, sin_a):
    """Return what one line adds to the sums of samples, cosines and sines, and its largest
    sample."""
    total, even, odd, peak = combine_samples(a, b, c, d)
    return np.float32(total), cos_a * np.float32(even), sin_a * np.float32(odd), peak


@numba.njit
def add_eight(a, b, c, d, e, f, g, h, cos_a, sin_a, cos_e, sin_e):
    """Return what two lines add to the sums of samples, cosines and sines, and their largest
    sample."""
    one, even, odd, peak = combine_samples(a, b, c, d)
    two, even_e, odd_e, peak_e = combine_samples(e, f, g, h)
    cosine = fma(cos_a, np.float32(even), cos_e * np.float32(even_e))
    sine = fma(sin_a, np.float32(odd), sin_e * np.float32(odd_e))
    return np.float32(add_fixed_width(one, two)), cosine, sine, max(peak, peak_e)


@numba.njit(inline="always")
def sums_row(stack, shift, row, cosine, sine, total, peak):
    """Sum the samples of one image row, weighted by cosines and sines; also the sum of all samples
    and the largest one.

    Fills ``cosine``, ``sine``, ``total`` (w,) float32, the last as the `Steps` count the samples,
    and ``peak`` (w,) of the frames' dtype.
    """
    width, lines = stack.shape[2], len(shift.cosines)
    # two lines to a pass: the sums are read and written less often
    for k in range(0, lines - 1, 2):
        i, j = shift.frames[k], shift.frames[k + 1]
        a, b, c, d = stack[i[0], row], stack[i[1], row], stack[i[2], row], stack[i[3], row]
        e, f, g, h = stack[j[0], row], stack[j[1], row], stack[j[2], row], stack[j[3], row]
        cos_a = shift.cosines[k]
        sin_a = shift.sines[k]
        cos_e = shift.cosines[k + 1]
        sin_e = shift.sines[k + 1]
        for q in range(4):
            prefetch_row(stack, i[q], row)
            prefetch_row(stack, j[q], row)
        if k == 0:
            for x in range(width):
                total[x], cosine[x], sine[x], peak[x] = add_eight(
                    a[x], b[x], c[x], d[x], e[x], f[x], g[x], h[x], cos_a, sin_a, cos_e, sin_e
                )
        else:
            for x in range(width):
                all_x, cos_x, sin_x, peak_x = add_eight(
                    a[x], b[x], c[x], d[x], e[x], f[x], g[x], h[x], cos_a, sin_a, cos_e, sin_e
                )
                total[x], cosine[x], sine[x] = total[x] + all_x, cosine[x] + cos_x, sine[x] + sin_x
                peak[x] = max(peak[x], peak_x)
    if lines % 2:
        k = lines - 1
        i, cos_a, sin_a = shift.frames[k], shift.cosines[k], shift.sines[k]
        a, b, c, d = stack[i[0], row], stack[i[1], row], stack[i[2], row], stack[i[3], row]
        for q in range(4):
            prefetch_row(stack, i[q], row)
        if k == 0:
            for x in range(width):
                total[x], cosine[x], sine[x], peak[x] = add_four(
                    a[x], b[x], c[x], d[x], cos_a, sin_a
                )
        else:
            for x in range(width):
                all_x, cos_x, sin_x, peak_x = add_four(a[x], b[x], c[x], d[x], cos_a, sin_a)
                total[x], cosine[x], sine[x] = total[x] + all_x, cosine[x] + cos_x, sine[x] + sin_x
                peak[x] = max(peak[x], peak_x)
    if shift.turn_sine != 0.0 or shift.turn_cosine < 0.0:
        turn, across = np.float32(shift.turn_cosine), np.float32(shift.turn_sine)
        for x in range(width):
            cos_x, sin_x = cosine[x], sine[x]
            cosine[x], sine[x] = turn * cos_x - across * sin_x, turn * sin_x + across * cos_x


@numba.njit(inline="always")
def allocate_three(width):
    """Allocate three rows of float32, see `allocate_five`."""
    return np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)


@numba.njit(inline="always")
def shift_row(stack, shift, row, wrapped, modulation, background, peak):
    """Compute wrapped phase, modulation, background and largest sample of one image row, (w,) each.

    ``peak`` is of the frames' dtype, the others are float32.
    """
    width, first = stack.shape[2], stack[shift.first, row]
    cosine, sine, total = allocate_three(width)
    sums_row(stack, shift, row, cosine, sine, total, peak)
    per_two = np.float32(2 / shift.steps)
    per_one = np.float32(1 / shift.steps)
    counted = np.float32(shift.counted)
    for x in range(width):
        wrapped[x] = arctan2(ZERO - sine[x], cosine[x])
        modulation[x] = np.sqrt(fma(cosine[x], cosine[x], sine[x] * sine[x])) * per_two
        level = np.float32(first[x])
        background[x] = fma(total[x] - counted * level, per_one, level)


@numba.njit
def is_dark(modulation, background, scale):
    """Return whether the modulation is too small for the noise at this brightness."""
    return is_dark_squared(modulation * modulation, background, scale)


@numba.njit
def is_dark_squared(squared, background, scale):
    """Return whether the modulation, given as its square, is too small for the noise at this
    brightness."""
    sigmas = np.float32(scale.dark_sigmas)
    variance = np.float32(scale.noise_a) + np.float32(scale.noise_b) * background
    levels = np.float32(scale.dark_levels)
    return squared < max(levels * levels, sigmas * sigmas * variance)


@numba.njit
def is_clipped(modulation, background, peak, scale):
    """Return whether the fringe reaches the white level, in a sample and as fitted: noise alone
    does not do both."""
    return (np.float32(peak) >= np.float32(scale.white)) & (
        background + modulation >= np.float32(scale.white)
    )


@numba.njit
def select_reason(dark, clipped, inconsistent):
    """Return the first reason that applies to a pixel, SATURATED, DARK, INCONSISTENT or VALID.

    A pixel that is clipped in all its frames has no modulation, yet is not dark.
    """
    unclipped = DARK if dark else (INCONSISTENT if inconsistent else VALID)
    return SATURATED if clipped else unclipped


@numba.njit(inline="always")
def bit_height(stack, frames, inverses, bit, row, x, threshold):
    """Return the grey levels by which a Gray bit is above its threshold."""
    value = np.float32(stack[frames[bit], row, x])
    if len(inverses):
        return (value - np.float32(stack[inverses[bit], row, x])) * HALF
    return value - threshold


@numba.njit(inline="always")
def allocate_five(width):
    """Allocate five rows of float32; separate arrays, so that the compiler knows that none
    overlap."""
    a, b, c = allocate_three(width)
    return a, b, c, np.empty(width, np.float32), np.empty(width, np.float32)


def decode_rows(
    kernel: Callable[..., Any],
    stack: np.ndarray,
    arguments: tuple[Any, ...],
    maps: tuple[np.ndarray, ...],
) -> None:
    """Decode all rows of a stack (n, h, w) by ``kernel(stack, *arguments, first row, *maps)``.

    Fills the five (h, w) ``maps``: phase, wrapped phase, modulation, background and reason. The
    phase is NaN where the reason is not VALID.
    """
    stack = read_only(stack)

    def decode(first: int, last: int) -> None:
        """Decode a range of rows."""
        kernel(stack, *arguments, first, *(map[first:last] for map in maps))

    run_rows(decode, stack.shape[1])
