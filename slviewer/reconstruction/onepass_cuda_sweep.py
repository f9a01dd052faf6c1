"""Frames to points on a CUDA device, one thread a pixel: a twin of `onepass_kernels` and of
`fringe.kernels`.

A kernel is compiled for one sequence, so that loops over steps and bits have a known length and are
unrolled, and for one way to measure depth. Everything is float32 but the sums that
`fringe.kernels_levels` takes in float64, and the absolute phase. Imported only where there is a
device.
"""

import math
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from slviewer.fringe.kernels import (
    DARK,
    ENDLESS,
    HALF,
    INCONSISTENT,
    NAN,
    ONE,
    PER_TURN,
    QUARTER,
    SATURATED,
    THREE_QUARTERS,
    VALID,
    ZERO,
)
from slviewer.fringe.kernels_coded import EDGE, FAR_EDGE, UNDECIDED, WEAK, WEAKER
from slviewer.fringe.layout import Layout
from slviewer.reconstruction.onepass import PassTask

# its own annotations are not those of what a kernel may call
cuda: Any = import_module("numba.cuda")

TWO_PI = 2 * math.pi

NOISE_A, NOISE_B, DARK_LEVELS, DARK_SIGMAS, WHITE, MEAN = range(6)
"""What a light is, float32: see `fringe.kernels.Scale`, and `threshold` for the mean."""


def frame_slots(layout: Layout) -> list[int]:
    """The frames that are decoded, in the order in which the kernel reads them: phase steps,
    longest period first; Gray bits; their inverses; the complementary bit."""
    steps = [i for shift in layout.shifts for i in shift.indices]
    return [
        *steps,
        *layout.gray,
        *layout.inverse,
        *([] if layout.complementary is None else [layout.complementary]),
    ]


def sweep_kernel(job: PassTask, slots: int, measure: Callable[..., Any], deep: bool) -> Any:
    """The kernel for one job and one of `onepass_cuda_card`'s ways to measure depth.

    ``slots``: frames on the device, those of `frame_slots` first. ``deep``: the largest grey level
    of all is needed, as of uint16 frames. It takes frames of n pixels, (slots n,), the light, the
    two arrays of ``measure`` and what it writes: maps (n,), points (n, 3), and the largest grey
    level (1,) int32.
    """
    pixels, shaded = job.shape[0] * job.shape[1], job.is_shaded
    decode = _compile_coded(job.layout, pixels) if job.layout.gray else _compile_levels(job, pixels)
    per_step = np.float32(2.0 / job.layout.steps)
    least, stride = np.float32(1e-6), np.uint64(pixels)

    @cuda.jit
    def sweep(stack, light, c, extra, phase, reason, modulation, points, sigma_z, texture, highest):
        """Kernel: decode one pixel per thread, measure its point, and fill all maps."""
        i = np.uint64(cuda.grid(1))  # signed indices would be tested for counting from the end
        if i >= stride:
            return
        absolute, why, B, A = decode(stack, i, light)
        if deep:
            brightest = np.int32(0)
            at = i
            for _ in range(slots):
                brightest = max(brightest, np.int32(stack[at]))
                at = at + stride
            if brightest > highest[0]:  # perhaps an old value; the next line settles it
                cuda.atomic.max(highest, 0, brightest)
        x, y, z, sigma = NAN, NAN, NAN, NAN
        if why == VALID:
            x, y, z, slope = measure(i, absolute, c, extra)
            variance = light[NOISE_A] + light[NOISE_B] * A
            sigma = slope * (np.float32(math.sqrt(variance * per_step)) / max(B, least))
        phase[i] = absolute
        reason[i] = why
        modulation[i] = B
        points[i, 0] = x
        points[i, 1] = y
        points[i, 2] = z
        sigma_z[i] = sigma
        if shaded:
            texture[i] = np.int32(A + HALF)

    return sweep


def _steps(layout: Layout) -> list[tuple[int, ...]]:
    """Return the frame indices of each period's phase steps."""
    return [shift.indices for shift in layout.shifts]


def _compile_shift(layout: Layout, pixels: int) -> Any:
    """Compile the device function that returns wrapped phase, modulation, background and largest
    sample of one period's frames."""
    angles = np.concatenate(
        [TWO_PI * layout.sign * np.arange(n) / n for n in map(len, _steps(layout))]
    )
    cosines, sines = (f(angles + layout.offset_rad).astype(np.float32) for f in (np.cos, np.sin))
    stride = np.uint64(pixels)

    @cuda.jit(device=True)
    def shift(stack, i, first, last):
        """Return (wrapped phase, modulation, background, largest sample) of pixel ``i`` from frames
        ``first`` to ``last``, the last one excluded."""
        cosine_of, sine_of = cuda.const.array_like(cosines), cuda.const.array_like(sines)
        at = i + np.uint64(first) * stride
        base = np.float32(stack[at])
        cosine, sine, total, peak = ZERO, ZERO, ZERO, base
        for k in range(first + 1, last):
            at = at + stride
            value = np.float32(stack[at])
            peak = max(peak, value)
            value = value - base
            cosine = cosine + cosine_of[k] * value
            sine = sine + sine_of[k] * value
            total = total + value
        steps = np.float32(last - first)
        wrapped = np.float32(math.atan2(ZERO - sine, cosine))
        length = np.float32(math.sqrt(cosine * cosine + sine * sine))
        return wrapped, length * (np.float32(2) / steps), base + total * (ONE / steps), peak

    return shift


@cuda.jit(device=True)
def _verdict(B, A, clipped, inconsistent, light):
    """Return the reason to mask a pixel, the first that applies: saturated, dark, inconsistent;
    VALID without one."""
    sigma = np.float32(math.sqrt(light[NOISE_A] + light[NOISE_B] * A))
    if clipped:
        return SATURATED
    if max(light[DARK_LEVELS], light[DARK_SIGMAS] * sigma) > B:
        return DARK
    return INCONSISTENT if inconsistent else VALID


def _compile_coded(layout: Layout, pixels: int) -> Any:
    """Compile the device function that decodes a pixel by Gray code: (absolute phase, reason,
    modulation, background)."""
    shift = _compile_shift(layout, pixels)
    steps, bits, inverses, complementary = (
        layout.steps,
        len(layout.gray),
        bool(layout.inverse),
        not layout.is_plain,
    )
    stride, code_from, inverse_from = (
        np.uint64(number) for number in (pixels, steps, steps + bits)
    )
    extra_at = np.uint64(steps + bits + len(layout.inverse))
    origin = np.float32(layout.gray_origin_px / layout.period_px)

    @cuda.jit(device=True)
    def height_of(stack, i, bit, threshold):
        """Return the signed grey level of a Gray code bit: half the difference to its inverse
        frame, or the level above the threshold."""
        slot = np.uint64(bit)
        value = np.float32(stack[(code_from + slot) * stride + i])
        if inverses:
            return (value - np.float32(stack[(inverse_from + slot) * stride + i])) * HALF
        return value - threshold

    @cuda.jit(device=True)
    def misread(stack, i, threshold, top, bottom, code, part, mean):
        """Return the correction (-1, 0 or 1) of a code whose bit that switches next to the pixel is
        weak."""
        contrast = max(top / (ONE - mean), -bottom / mean)
        middle = (HALF - mean) * contrast
        zeros, ones = 0, 0
        while zeros < bits and not (code >> zeros) & 1:
            zeros += 1
        while ones < bits and (code >> ones) & 1:
            ones += 1
        lower, upper = ENDLESS, ENDLESS
        if zeros < bits:
            lower = abs(height_of(stack, i, bits - 1 - zeros, threshold) - middle)
        if ones < bits:
            upper = abs(height_of(stack, i, bits - 1 - ones, threshold) - middle)
        weak = WEAK * contrast
        if part < HALF:
            return 1 if upper < weak and upper < WEAKER * lower else 0
        return -1 if lower < weak and lower < WEAKER * upper else 0

    @cuda.jit(device=True)
    def decode(stack, i, light):
        """Return (absolute phase, reason, modulation, background) of pixel ``i``."""
        psi, B, A, peak = shift(stack, i, 0, steps)
        code, digit = 0, 0
        least, top, bottom = ENDLESS, ZERO, ZERO
        for b in range(bits):
            height = height_of(stack, i, b, A)
            digit = digit ^ (1 if height > ZERO else 0)
            code = 2 * code + digit
            least = min(least, abs(height))
            top = max(top, height)
            bottom = min(bottom, height)
        turns = psi * PER_TURN - origin
        whole = np.float32(math.floor(turns))
        part = turns - whole
        if complementary:
            last = np.float32(stack[extra_at * stride + i]) - A
            half = 2 * code + (digit ^ (1 if last > ZERO else 0))
            middle = QUARTER <= part < THREE_QUARTERS
            order = (
                half >> 1 if middle else ((half + 1) >> 1) - (1 if part >= THREE_QUARTERS else 0)
            )
            unclear = (least if middle else abs(last)) < UNDECIDED * B
        else:
            beside = part < EDGE or part >= FAR_EDGE
            order = code
            unclear = not beside and least < UNDECIDED * B
            if beside:
                order = code + misread(stack, i, A, top, bottom, code, part, light[MEAN])
        clipped = peak >= light[WHITE] and light[WHITE] <= A + B
        why = _verdict(B, A, clipped, unclear, light)
        absolute = np.float32(np.float64(psi) + TWO_PI * (np.float64(order) - np.float64(whole)))
        return absolute if why == VALID else NAN, why, B, A

    return decode


def _compile_levels(job: PassTask, pixels: int) -> Any:
    """Compile the device function that decodes a pixel by several periods: (absolute phase, reason,
    modulation, background)."""
    shift, ladder = _compile_shift(job.layout, pixels), job.ladder
    count, levels = len(job.layout.shifts), len(ladder.periods)
    starts = np.cumsum([0, *map(len, _steps(job.layout))]).astype(np.int32)
    weights, periods = ladder.weights, ladder.periods
    per_px, per_rad = 1.0 / periods, periods / TWO_PI
    low, misfit = float(ladder.low), float(ladder.misfit)

    @cuda.jit(device=True)
    def decode(stack, i, light):
        """Return (absolute phase, reason, modulation, background) of pixel ``i``."""
        begin, weight_of = cuda.const.array_like(starts), cuda.const.array_like(weights)
        period_of = cuda.const.array_like(periods)
        turns_of, px_of = cuda.const.array_like(per_px), cuda.const.array_like(per_rad)
        psi = cuda.local.array(count, np.float32)
        weakest, clipped, A, B = ENDLESS, False, ZERO, ZERO
        for p in range(count):
            wrapped, B, A, peak = shift(stack, i, begin[p], begin[p + 1])
            psi[p] = wrapped
            weakest = min(weakest, B)
            clipped = clipped or (peak >= light[WHITE] and light[WHITE] <= A + B)
        coordinate, order, worst = 0.0, 0.0, 0.0
        for level in range(levels):
            own = 0.0
            for p in range(count):
                own = own + weight_of[level, p] * np.float64(psi[p])
            position = own * px_of[level]
            if level == 0:
                order = -np.float64(math.floor((position - low) * turns_of[level]))
            else:
                turns = (coordinate - position) * turns_of[level]
                order = np.float64(round(turns))
                worst = max(worst, abs(turns - order))
            coordinate = position + order * period_of[level]
        why = _verdict(weakest, A, clipped, worst > misfit, light)
        absolute = np.float32(np.float64(psi[count - 1]) + TWO_PI * order)
        return absolute if why == VALID else NAN, why, B, A

    return decode
