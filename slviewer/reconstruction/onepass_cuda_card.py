"""What lies on a CUDA device for one pass: coefficients, frames, maps and kernels, a twin of
`onepass_kernels` and of `fringe.kernels`. Imported only where there is a device.

A kernel is compiled for one sequence, so that loops over steps and bits have a known length and are
unrolled, and for one way to measure depth, with one thread a pixel. Everything is float32 but the
sums that `fringe.kernels_levels` takes in float64, and the absolute phase.
"""

import math
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from slviewer.fringe import kernels_spikes, limits
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
from slviewer.fringe.kernels_spikes import INVALID, TURN, UNCHANGED, UP, SpikeRules, spike_rules
from slviewer.fringe.layout import Layout
from slviewer.fringe.phase_shifting import dark_sigmas
from slviewer.geometry.cuda_device import device_function
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import MARGIN, ray_depth
from slviewer.reconstruction.onepass import LightLevels, OnePass, PassResult
from slviewer.reconstruction.onepass_kernels import Maps, pixelwise_point, splined_point

# its own annotations are not those of what a kernel may call
cuda: Any = import_module("numba.cuda")

THREADS = 256
"""Of a block: eight warps, which leave every scheduler of a multiprocessor with work, whatever
registers they need."""
TWO_PI = 2 * math.pi
NOISE_A, NOISE_B, DARK_LEVELS, DARK_SIGMAS, WHITE, MEAN = range(6)
"""What a light is, float32: see `fringe.kernels.Scale`, and `threshold` for the mean."""


class Card:
    """Buffers and kernels on the CUDA device for one pass and one dtype of frames, uint8 or uint16.

    All that it does is queued in ``stream``; only `fetch` waits. Errors are those of numba's CUDA.
    """

    def __init__(self, job: OnePass, dtype: np.dtype) -> None:
        pixels = job.shape[0] * job.shape[1]
        self.dtype, self._deep, self._shaded = dtype, dtype == np.uint16, job.texture < 0
        self._dark_sigmas, self._rules = dark_sigmas(job.layout), spike_rules(job.layout)
        slots = frame_slots(job.layout)
        slots += [i for i in job.frames if i not in slots] if self._deep else []
        measure, c, extra = _depths(job)
        self._sweep = sweep_kernel(job, len(slots), measure, self._deep)
        self._spikes = spike_kernels(self._rules, job.shape, measure)

        self.stream = cuda.stream()
        self._grid = -(-pixels // THREADS), THREADS, self.stream
        self._c = cuda.to_device(np.ascontiguousarray(c.reshape(len(c), pixels)))
        self._extra = cuda.to_device(np.ascontiguousarray(extra))
        self._frames = cuda.device_array(len(slots) * pixels, dtype)
        # runs of consecutive frames of the capture
        breaks = np.flatnonzero(np.diff(slots) != 1) + 1
        self._runs = [
            (run, self._frames[at * pixels : (at + len(run)) * pixels])
            for at, run in zip([0, *breaks.tolist()], np.split(slots, breaks), strict=True)
        ]
        phase, modulation, sigma_z = (cuda.device_array(pixels, np.float32) for _ in range(3))
        reason, self._words = (cuda.device_array(pixels, np.uint8) for _ in range(2))
        points = cuda.device_array((pixels, 3), np.float32)
        texture = cuda.device_array(pixels if self._shaded else 1, dtype)
        self._maps = Maps(phase, reason, modulation, points, sigma_z, texture)
        self._phase_map = phase.reshape(job.shape)
        self._none = np.zeros(1, np.int32)
        self._highest = cuda.to_device(self._none)

    @property
    def bytes_moved(self) -> int:
        """Bytes that the first pass reads and writes in the device's memory, each number once."""
        arrays = self._frames, self._c, self._extra, *self._maps
        return sum(array.size * array.dtype.itemsize for array in arrays)

    def load(self, frames: np.ndarray) -> None:
        """Copy the frames (n, h, w) that are read, each once."""
        for run, room in self._runs:
            room.copy_to_device(frames[run[0] : run[-1] + 1].reshape(-1), stream=self.stream)

    def sweep(self, light: LightLevels) -> None:
        """Run the first pass over the loaded frames."""
        if self._deep:
            self._highest.copy_to_device(self._none, stream=self.stream)
        dark = limits.DARK_LEVELS * light.white / 255
        numbers = *light.noise, dark, self._dark_sigmas, light.white, light.mean
        lights = tuple(map(np.float32, numbers))
        self._sweep[self._grid](
            self._frames, lights, self._c, self._extra, *self._maps, self._highest
        )

    def repair_spikes(self) -> None:
        """Run the second pass on the device: see `OnePass.repair_spikes`."""
        list_changes, change = self._spikes
        phase, reason, _, points, sigma_z, _ = self._maps
        for masking in (False, True) if self._rules.is_plain else (True,):
            list_changes[self._grid](self._phase_map, masking, self._words)
            change[self._grid](
                self._words, masking, self._c, self._extra, phase, reason, points, sigma_z
            )

    def fetch(self, scan: PassResult) -> int:
        """Copy the maps into a scan's arrays, the texture only where it is computed from fringes;
        returns the largest grey level, 0 for uint8 frames."""
        highest = np.zeros(1, np.int32)
        pairs = [*zip(self._maps, scan.maps, strict=True), (self._highest, highest)]
        for there, here in pairs:
            if self._shaded or here is not scan.texture:
                there.copy_to_host(here.reshape(there.shape), stream=self.stream)
        self.stream.synchronize()
        return int(highest[0])


def _depths(job: OnePass) -> tuple[Callable[..., Any], np.ndarray, np.ndarray]:
    """Return the device function (pixel, phase, c, extra) that measures a pixel like those of
    `onepass_kernels`, and two arrays: ``c`` (m, h, w) of the camera's pixels, and ``extra``. The
    pixel is a uint64, so that indices are not tested for their sign."""
    width, d = job.shape[1], job.depths
    if isinstance(d, StereoRig):
        extra = np.zeros((6, 10))
        extra[:3, :3], extra[3, :3] = d.R, d.t
        extra[4], extra[5, :2] = d.projector.parameters, d.projector.size
        measure = _compile_stereo(0 if job.axis == "x" else 1, job.layout.period_px)
        return measure, np.moveaxis(d.camera.rays(), 2, 0), extra
    gain, centre, near, per_mm = map(np.float32, (d.gain, d.centre, d.near, d.per_mm))
    if d.grid.size:
        splined, step = device_function(splined_point), d.step

        @cuda.jit(device=True)
        def measure_splined(i, phase, c, grid):
            """Return (x, y, z, |dz/dphi|) of pixel ``i`` at a phase, by the splined model's
            grid."""
            return splined(i, phase, c, grid, gain, centre, width, step, near, per_mm)

        return measure_splined, d.c, d.grid
    pixelwise = device_function(pixelwise_point)

    @cuda.jit(device=True)
    def measure_pixelwise(i, phase, c, bounds):
        """Return (x, y, z, |dz/dphi|) of pixel ``i`` at a phase, by its rational function."""
        return pixelwise(i, phase, c, bounds, gain, centre)

    return measure_pixelwise, d.c, d.bounds.reshape(2, -1)


def _compile_stereo(row: int, period_px: float) -> Callable[..., Any]:
    """Compile the device function that triangulates a pixel by `geometry.triangulation` in float64;
    ``c`` (2, n): the camera's rays; ``extra`` (6, 10): the rows of R, t, the projector's
    parameters, and its size."""
    px_per_rad, depth_of = np.float32(period_px / (2 * np.pi)), device_function(ray_depth)

    @cuda.jit(device=True)
    def measure(i, phase, c, extra):
        """Return (x, y, z, |dz/dphi|) of pixel ``i`` at a phase, by triangulation; NaN where it
        fails."""
        measured, extent = np.float64(phase * px_per_rad), extra[5, row]
        if not (-0.5 - MARGIN * extent <= measured <= (1.0 + MARGIN) * extent - 0.5):
            return INVALID, INVALID, INVALID, INVALID
        u, v = c[0, i], c[1, i]
        z, _, slope = depth_of(u, v, measured, 0.0, extra[:3], extra[3], extra[4], row, extra[5])
        if z != z:
            return INVALID, INVALID, INVALID, INVALID
        return (
            np.float32(u * z),
            np.float32(v * z),
            np.float32(z),
            px_per_rad * np.float32(abs(1.0 / slope)),
        )

    return measure


def spike_kernels(
    rules: SpikeRules, shape: tuple[int, int], measure: Callable[..., Any]
) -> tuple[Any, ...]:
    """Kernels (list what is to be changed, change it): move pixels by a period, or, where
    ``masking``, mask them.

    The first takes the phase (h, w) and fills ``words`` (n,) uint8; the second takes maps
    flattened. ``measure`` is one of `_depths`. What changes is listed before the first pixel is
    changed, because each one's neighbours vote with the phase that they had.
    """
    pixels, width = shape[0] * shape[1], shape[1]
    per_cell = np.float32(1 / rules.cell_rad)
    is_suspect = device_function(kernels_spikes.is_suspect)
    period_change = device_function(kernels_spikes.period_change)
    masking_reason = device_function(kernels_spikes.masking_reason)

    @cuda.jit
    def list_changes(phase, masking, words):
        """Kernel: write one pixel's word: the reason to mask it, or whether it moves up or down a
        period; UNCHANGED without either."""
        i = cuda.grid(1)
        if i >= pixels:
            return
        row = i // width
        x = i - row * width
        words[i] = UNCHANGED
        if phase[row, x] == phase[row, x]:  # False for NaN
            suspect = is_suspect(phase, row, x, per_cell)
            if masking:
                words[i] = masking_reason(phase, row, x, suspect, rules)
            elif suspect:
                words[i] = period_change(phase, row, x, rules)

    @cuda.jit
    def change(words, masking, c, extra, phase, reason, points, sigma_z):
        """Kernel: change one pixel by its word: store the reason, set phase, point and sigma_z to
        NaN, or move the phase by one period and update its point and sigma_z."""
        i = cuda.grid(1)
        if i >= pixels or words[i] == UNCHANGED:
            return
        after, x, y, z, sigma = INVALID, INVALID, INVALID, INVALID, INVALID
        if masking:
            reason[i] = words[i]
        else:
            before, at = phase[i], np.uint64(i)
            after = before + (TURN if words[i] == UP else -TURN)
            _, _, _, old_slope = measure(at, before, c, extra)
            x, y, z, slope = measure(at, after, c, extra)
            sigma = sigma_z[i] * (slope / old_slope)
        phase[i], sigma_z[i] = after, sigma
        points[i, 0], points[i, 1], points[i, 2] = x, y, z

    return list_changes, change


def frame_slots(layout: Layout) -> list[int]:
    """The frames that are decoded, in the order in which the kernel reads them: phase steps,
    longest period first; Gray bits; their inverses; the complementary bit."""
    steps = [i for shift in layout.shifts for i in shift.indices]
    last = [] if layout.complementary is None else [layout.complementary]
    return [*steps, *layout.gray, *layout.inverse, *last]


def sweep_kernel(job: OnePass, slots: int, measure: Callable[..., Any], deep: bool) -> Any:
    """The kernel for one pass and one of the ways of `_depths` to measure depth.

    ``slots``: frames on the device, those of `frame_slots` first. ``deep``: the largest grey level
    of all is needed, as of uint16 frames. It takes frames of n pixels, (slots n,), the light, the
    two arrays of ``measure`` and what it writes: maps (n,), points (n, 3), and the largest grey
    level (1,) int32.
    """
    pixels, shaded = job.shape[0] * job.shape[1], job.texture < 0
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


def _count_steps(layout: Layout) -> list[int]:
    """Return the number of phase steps of each period."""
    return [len(shift.indices) for shift in layout.shifts]


def _compile_shift(layout: Layout, pixels: int) -> Any:
    """Compile the device function that returns wrapped phase, modulation, background and largest
    sample of one period's frames."""
    angles = np.concatenate([TWO_PI * layout.sign * np.arange(n) / n for n in _count_steps(layout)])
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
    steps, bits = layout.steps, len(layout.gray)
    inverses, complementary = bool(layout.inverse), not layout.is_plain
    stride, code_from, inverse_from = map(np.uint64, (pixels, steps, steps + bits))
    extra_at = np.uint64(steps + bits + len(layout.inverse))
    origin = np.float32(layout.gray_origin_px / layout.period_px)

    @cuda.jit(device=True)
    def correction(part, top, bottom, lower, upper, mean):
        """Return the correction (-1, 0 or 1) of a code whose bit that changes at the edge next to
        the pixel is weak."""
        contrast = max(top / (ONE - mean), -bottom / mean)
        middle, weak = (HALF - mean) * contrast, WEAK * contrast
        below, above = abs(lower - middle), abs(upper - middle)
        if part < EDGE and above < weak and above < WEAKER * below:
            return 1
        if part >= FAR_EDGE and below < weak and below < WEAKER * above:
            return -1
        return 0

    @cuda.jit(device=True)
    def decode(stack, i, light):
        """Return (absolute phase, reason, modulation, background) of pixel ``i``."""
        psi, B, A, peak = shift(stack, i, 0, steps)
        code, digit = 0, 0
        least, top, bottom, lower, upper = ENDLESS, ZERO, ZERO, ENDLESS, ENDLESS
        for b in range(bits):
            slot = np.uint64(b)
            height = np.float32(stack[(code_from + slot) * stride + i])
            if inverses:
                inverse = np.float32(stack[(inverse_from + slot) * stride + i])
                height = (height - inverse) * HALF
            else:
                height = height - A
            digit = digit ^ (1 if height > ZERO else 0)
            code = 2 * code + digit
            least = min(least, abs(height))
            top = max(top, height)
            bottom = min(bottom, height)
            # the bits that change at the edges of the code, see `kernels_coded.code_row`
            if digit:
                lower = height
            else:
                upper = height
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
            unclear = EDGE <= part < FAR_EDGE and least < UNDECIDED * B
            order = code + correction(part, top, bottom, lower, upper, light[MEAN])
        clipped = peak >= light[WHITE] and light[WHITE] <= A + B
        why = _verdict(B, A, clipped, unclear, light)
        absolute = np.float32(np.float64(psi) + TWO_PI * (np.float64(order) - np.float64(whole)))
        return absolute if why == VALID else NAN, why, B, A

    return decode


def _compile_levels(job: OnePass, pixels: int) -> Any:
    """Compile the device function that decodes a pixel by several periods: (absolute phase, reason,
    modulation, background)."""
    shift, ladder = _compile_shift(job.layout, pixels), job.ladder
    count, levels = len(job.layout.shifts), len(ladder.periods)
    starts = np.cumsum([0, *_count_steps(job.layout)]).astype(np.int32)
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
