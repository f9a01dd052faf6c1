"""The phase shift and its Gray code in one pass over the frames; `reference` is what they must agree with.

A row of the image at a time, so that sums and codes stay in the cache while each frame is read once. Loops over a row
have no branches and no library calls: the compiler turns them into vector instructions.
"""

from typing import NamedTuple

import numba
import numpy as np

from slviewer.fringe.phase import Reason
from slviewer.geometry.jit import kernel

VALID, DARK, SATURATED, INCONSISTENT = (
    np.uint8(r) for r in (Reason.VALID, Reason.DARK, Reason.SATURATED, Reason.INCONSISTENT)
)
TWO_PI = 2 * np.pi
PER_TURN = np.float32(1 / TWO_PI)
RUN = 32
"""Pixels that are passed over together where none of them is doubtful."""


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
    r = np.float32(0.0028662257) * s + np.float32(-0.0161657367)
    r = r * s + np.float32(0.0429096138)
    r = r * s + np.float32(-0.0752896400)
    r = r * s + np.float32(0.1065626393)
    r = r * s + np.float32(-0.1420889944)
    r = r * s + np.float32(0.1999355085)
    r = r * s + np.float32(-0.3333314528)
    r = r * s * a + a
    r = np.float32(np.pi / 2) - r if ay > ax else r
    r = np.float32(np.pi) - r if x < 0 else r
    return -r if y < 0 else r


@numba.njit(inline="always")
def shift_row(stack, frames, cosines, sines, row, wrapped, modulation, background, peak):
    """Wrapped phase, modulation, background and largest sample of one image row."""
    width = stack.shape[2]
    cosine, sine = np.zeros(width, np.float32), np.zeros(width, np.float32)
    first = stack[frames[0], row]
    for x in range(width):
        background[x] = np.float32(0)
        peak[x] = np.float32(first[x])
    for k in range(1, len(frames), 3):  # three frames to a pass: the sums are read and written less often
        # Beyond the last step the first one stands in: less itself it adds nothing.
        j = k + 1 if k + 1 < len(frames) else 0
        m = k + 2 if k + 2 < len(frames) else 0
        frame_k, frame_j, frame_m = stack[frames[k], row], stack[frames[j], row], stack[frames[m], row]
        cos_k, cos_j, cos_m = cosines[k], cosines[j], cosines[m]
        sin_k, sin_j, sin_m = sines[k], sines[j], sines[m]
        for x in range(width):
            value_k, value_j, value_m = np.float32(frame_k[x]), np.float32(frame_j[x]), np.float32(frame_m[x])
            peak[x] = max(max(peak[x], value_k), max(value_j, value_m))
            value_k -= np.float32(first[x])
            value_j -= np.float32(first[x])
            value_m -= np.float32(first[x])
            cosine[x] = cosine[x] + cos_k * value_k + cos_j * value_j + cos_m * value_m
            sine[x] = sine[x] + sin_k * value_k + sin_j * value_j + sin_m * value_m
            background[x] += value_k + value_j + value_m
    per_two, per_one = np.float32(2 / len(frames)), np.float32(1 / len(frames))
    for x in range(width):
        wrapped[x] = arctan2(np.float32(0) - sine[x], cosine[x])
        modulation[x] = np.sqrt(cosine[x] * cosine[x] + sine[x] * sine[x]) * per_two
        background[x] = np.float32(first[x]) + background[x] * per_one


@numba.njit(inline="always")
def is_dark(modulation, background, scale):
    """Whether the modulation is too small for the noise at this brightness."""
    sigma = np.sqrt(np.float32(scale.noise_a) + np.float32(scale.noise_b) * background)
    return modulation < max(np.float32(scale.dark_levels), np.float32(scale.dark_sigmas) * sigma)


@numba.njit(inline="always")
def is_clipped(modulation, background, peak, scale):
    """Whether the fringe reaches the white level, in a sample and as fitted: noise alone does not do both."""
    return (peak >= np.float32(scale.white)) & (background + modulation >= np.float32(scale.white))


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
def code_row(stack, frames, inverses, row, threshold, code, least, top, bottom):
    """One row's binary code, the least distance of a bit from its threshold, and the highest and lowest bit."""
    width = stack.shape[2]
    if len(inverses):
        digit = np.zeros(width, np.int32)
        for x in range(width):
            code[x] = 0
            least[x] = np.float32(np.inf)
            top[x] = bottom[x] = np.float32(0)
        for b in range(len(frames)):
            frame, inverse = stack[frames[b], row], stack[inverses[b], row]
            for x in range(width):
                height = (np.float32(frame[x]) - np.float32(inverse[x])) * np.float32(0.5)
                digit[x] ^= np.int32(height > 0)
                code[x] = 2 * code[x] + digit[x]
                least[x] = min(least[x], abs(height))
                top[x] = max(top[x], height)
                bottom[x] = min(bottom[x], height)
        return
    # Against one threshold the frames' own numbers can be compared: four times as many fit a register.
    grey = stack.dtype.type
    full = grey(65535 if stack.itemsize == 2 else 255)
    level, bits = np.empty(width, stack.dtype), np.empty(width, np.uint8)
    over_least, under_most = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    most, fewest = np.empty(width, stack.dtype), np.empty(width, stack.dtype)
    for x in range(width):
        level[x] = grey(np.int32(threshold[x]))
        over_least[x] = fewest[x] = full
        under_most[x] = most[x] = grey(0)
        code[x] = 0
    for start in range(0, len(frames), 8):
        last = min(start + 8, len(frames))
        for x in range(width):
            bits[x] = 0
        for b in range(start, last):
            frame = stack[frames[b], row]
            for x in range(width):
                over = frame[x] > level[x]
                bits[x] = (bits[x] << 1) | np.uint8(over)
                over_least[x] = min(over_least[x], frame[x] if over else full)
                under_most[x] = max(under_most[x], grey(0) if over else frame[x])
                most[x] = max(most[x], frame[x])
                fewest[x] = min(fewest[x], frame[x])
        for x in range(width):  # each binary digit is the parity of all Gray bits down to it
            bits[x] ^= bits[x] >> 1
            bits[x] ^= bits[x] >> 2
            bits[x] ^= bits[x] >> 4
        turned, more = np.int32((1 << (last - start)) - 1), np.int32(1 << (last - start))
        for x in range(width):
            code[x] = code[x] * more + (np.int32(bits[x]) ^ (turned * (code[x] & np.int32(1))))
    none = np.float32(np.inf)
    for x in range(width):
        above = np.float32(over_least[x]) - threshold[x] if most[x] > level[x] else none
        below = threshold[x] - np.float32(under_most[x]) if fewest[x] <= level[x] else none
        least[x] = min(above, below)
        top[x] = max(np.float32(0), np.float32(most[x]) - threshold[x])
        bottom[x] = min(np.float32(0), np.float32(fewest[x]) - threshold[x])


@numba.njit
def misread(stack, frames, inverses, row, x, threshold, contrast, code, part, rules):
    """+1 or -1 where the bit nearest the middle and the phase disagree about the side of a code edge, else 0."""
    last = len(frames) - 1
    zeros, ones = 0, 0
    while zeros <= last and not (code >> zeros) & 1:
        zeros += 1
    while ones <= last and (code >> ones) & 1:
        ones += 1
    # Codes 0 and 2^bits - 1 have no lower and no upper edge.
    lower, upper = np.float32(np.inf), np.float32(np.inf)
    middle = (np.float32(0.5) - np.float32(rules.mean)) * contrast
    if zeros <= last:
        lower = abs(bit_height(stack, frames, inverses, last - zeros, row, x, threshold) - middle)
    if ones <= last:
        upper = abs(bit_height(stack, frames, inverses, last - ones, row, x, threshold) - middle)
    weak, weaker = np.float32(rules.weak / 2) * contrast, np.float32(rules.weaker)
    if part < np.float32(0.5):
        return 1 if upper < weak and upper < weaker * lower else 0
    return -1 if lower < weak and lower < weaker * upper else 0


@numba.njit(inline="always")
def coded_row(
    stack, gray, inverse, complementary, row, scale, rules, psi, B, A, peak,
    code, least, top, bottom, contrast, doubtful, phase, reason,
):  # fmt: skip
    """One row's absolute phase and reason from what ``shift_row`` left; ``code`` ... ``doubtful`` (w,) are room."""
    width = stack.shape[2]
    code_row(stack, gray, inverse, row, A, code, least, top, bottom)
    origin, undecided = np.float32(rules.origin_turns), np.float32(rules.undecided)
    edge, far_edge = np.float32(rules.edge), np.float32(1 - rules.edge)
    mean, over = np.float32(rules.mean), np.float32(1) - np.float32(rules.mean)
    reach = np.float32(abs(0.5 - rules.mean) + rules.weak / 2)
    if complementary >= 0:
        extra = stack[complementary, row]
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            last = np.float32(extra[x]) - A[x]
            half = 2 * code[x] + ((code[x] & 1) ^ np.int32(last > 0))
            middle = (part >= np.float32(0.25)) & (part < np.float32(0.75))
            beside = ((half + 1) >> 1) - np.int32(part >= np.float32(0.75))
            order = half >> 1 if middle else beside
            unclear = (least[x] if middle else abs(last)) < undecided * B[x]
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = verdict(dark, clipped, unclear)
            absolute = np.float32(psi[x] + TWO_PI * (order - whole))
            phase[x] = np.float32(np.nan) if dark | clipped | unclear else absolute
    else:
        for x in range(width):
            turns = psi[x] * PER_TURN - origin
            whole = np.floor(turns)
            part = turns - whole
            beside = (part < edge) | (part >= far_edge)
            unclear = (least[x] < undecided * B[x]) & (not beside)
            dark, clipped = is_dark(B[x], A[x], scale), is_clipped(B[x], A[x], peak[x], scale)
            reason[x] = verdict(dark, clipped, unclear)
            absolute = np.float32(psi[x] + TWO_PI * (code[x] - whole))
            phase[x] = np.float32(np.nan) if dark | clipped | unclear else absolute
            contrast[x] = max(np.divide(top[x], over), np.divide(-bottom[x], mean))
            doubtful[x] = beside & (least[x] < reach * contrast[x]) & (not (dark | clipped | unclear))
        for first in range(0, width, RUN):
            some = False
            for x in range(first, min(first + RUN, width)):
                some |= doubtful[x]
            if not some:
                continue
            for x in range(first, min(first + RUN, width)):  # the few pixels on a blurred edge
                if not doubtful[x]:
                    continue
                turns = psi[x] * PER_TURN - origin
                whole = np.floor(turns)
                order = code[x] + misread(
                    stack, gray, inverse, row, x, A[x], contrast[x], code[x], turns - whole, rules
                )
                phase[x] = np.float32(psi[x] + TWO_PI * (order - whole))


@kernel(parallel=True)
def decode_coded(
    stack,
    shift,
    cosines,
    sines,
    gray,
    inverse,
    complementary,
    scale,
    rules,
    phase,
    wrapped,
    modulation,
    background,
    reason,
):
    """Phase shift with a plain (``complementary`` < 0) or complementary Gray code; fills the five (h, w) maps.

    ``phase`` is NaN where ``reason`` is not VALID, here as in the other kernels.
    """
    _, height, width = stack.shape
    for row in numba.prange(height):
        peak, least = np.empty(width, np.float32), np.empty(width, np.float32)
        code, doubtful = np.empty(width, np.int32), np.empty(width, np.bool_)
        top, bottom, contrast = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
        psi, B, A = wrapped[row], modulation[row], background[row]
        shift_row(stack, shift, cosines, sines, row, psi, B, A, peak)
        coded_row(
            stack, gray, inverse, complementary, row, scale, rules, psi, B, A, peak,
            code, least, top, bottom, contrast, doubtful, phase[row], reason[row],
        )  # fmt: skip
