"""What lies on a CUDA device for one pass: coefficients, frames, maps and kernels. Imported only where there is one."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numba import cuda

from slviewer.fringe import limits
from slviewer.fringe.decode import spike_rules
from slviewer.fringe.reference import dark_sigmas
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction import onepass_cuda_depths as depths
from slviewer.reconstruction.onepass import Job, LightLevels, PassResult
from slviewer.reconstruction.onepass_cuda_spikes import spike_kernels
from slviewer.reconstruction.onepass_cuda_sweep import SweepPlan, sweep_kernel

THREADS = 256
"""Of a block: eight warps, which leave every scheduler of a multiprocessor with work, whatever registers they need."""


class Card:
    """One job and one kind of frames, uint8 or uint16, on the device.

    All that it does is queued in ``stream``; only `fetch` waits. Errors are those of numba's CUDA.
    """

    def __init__(self, job: Job, dtype: np.dtype) -> None:
        found, order = job.layout, job.order
        pixels, deep = job.shape[0] * job.shape[1], dtype == np.uint16
        self.dtype, self._dark_sigmas = dtype, dark_sigmas(found)
        slots = [*order.frames.tolist(), *found.gray, *found.inverse]
        slots += [] if found.complementary is None else [found.complementary]
        slots += order.others.tolist() if deep else []
        measure, c, extra = _depths(job)
        rules = spike_rules(found)
        self._plain, self._shaded = rules.plain, order.texture < 0
        others = len(order.others) if deep else 0
        self._sweep = sweep_kernel(_plan(job, others), pixels, measure, deep, self._shaded)
        self._mend = spike_kernels(rules, job.shape, measure)

        self.stream = cuda.stream()
        self._grid = -(-pixels // THREADS), THREADS, self.stream
        self._c = cuda.to_device(np.ascontiguousarray(c.reshape(len(c), pixels)))
        self._extra = cuda.to_device(np.ascontiguousarray(extra.ravel()))
        self._frames = cuda.device_array(len(slots) * pixels, dtype)
        self._runs = [
            (first, last, self._frames[at * pixels : (at + last - first) * pixels]) for at, first, last in _runs(slots)
        ]
        self._phase, self._modulation, self._sigma_z = (cuda.device_array(pixels, np.float32) for _ in range(3))
        self._points = cuda.device_array((pixels, 3), np.float32)
        self._reason, self._words = (cuda.device_array(pixels, np.uint8) for _ in range(2))
        self._texture = cuda.device_array(pixels if self._shaded else 1, dtype)
        self._deep, self._none = deep, np.zeros(1, np.int32)
        self._highest = cuda.to_device(self._none)

    @property
    def bytes_moved(self) -> int:
        """What the first pass reads and writes in the device's memory, each number once."""
        read = self._frames, self._c, self._extra
        written = self._phase, self._modulation, self._sigma_z, self._points, self._reason, self._texture
        return sum(array.size * array.dtype.itemsize for array in (*read, *written))

    def load(self, frames: np.ndarray) -> None:
        """Copy the frames (n, h, w) that are read, each once."""
        for first, last, room in self._runs:
            room.copy_to_device(frames[first:last].reshape(-1), stream=self.stream)

    def sweep(self, light: LightLevels) -> None:
        """The first pass over the frames that were loaded."""
        if self._deep:
            self._highest.copy_to_device(self._none, stream=self.stream)
        numbers = (*light.noise, limits.DARK_LEVELS * light.white / 255, self._dark_sigmas, light.white, light.mean)
        self._sweep[self._grid](
            self._frames, tuple(np.float32(number) for number in numbers), self._c, self._extra, self._phase,
            self._reason, self._modulation, self._points, self._sigma_z, self._texture, self._highest,
        )  # fmt: skip

    def mend(self) -> None:
        """The second: what `OnePass.mend` does."""
        find_moved, move, find_refused, refuse = self._mend
        if self._plain:
            find_moved[self._grid](self._phase, self._words)
            move[self._grid](self._words, self._c, self._extra, self._phase, self._points, self._sigma_z)
        find_refused[self._grid](self._phase, self._words)
        refuse[self._grid](self._words, self._phase, self._reason, self._points, self._sigma_z)

    def fetch(self, scan: PassResult) -> int:
        """Fill a scan's arrays, texture only where it is made of fringes; the largest grey level, 0 of uint8 frames."""
        pairs = [
            (self._points, scan.points),
            (self._phase, scan.phase),
            (self._reason, scan.reason),
            (self._sigma_z, scan.sigma_z),
            (self._modulation, scan.modulation),
            (self._highest, highest := np.zeros(1, np.int32)),
        ]
        if self._shaded:
            pairs.append((self._texture, scan.texture))
        for there, here in pairs:
            there.copy_to_host(here.reshape(there.shape), stream=self.stream)
        self.stream.synchronize()
        return int(highest[0])


def _plan(job: Job, others: int) -> SweepPlan:
    found, order, ladder = job.layout, job.order, job.ladder
    return SweepPlan(
        tuple(int(start) for start in order.starts),
        order.cosines,
        order.sines,
        len(found.gray),
        len(found.inverse),
        int(found.complementary is not None),
        others,
        found.gray_origin_px / found.period_px,
        limits.EDGE,
        limits.WEAK_BIT,
        limits.WEAKER,
        limits.UNDECIDED_BIT,
        ladder.weights,
        ladder.periods,
        ladder.low,
        ladder.misfit,
    )


def _depths(job: Job) -> tuple[Callable[..., Any], np.ndarray, np.ndarray]:
    """How a pixel is measured, and the two arrays that it needs; see `onepass_cuda_depths`."""
    (height, width), d = job.shape, job.depths
    if isinstance(d, StereoRig):
        extra = np.concatenate([d.R.ravel(), d.t, d.projector.parameters, np.array(d.projector.size, float)])
        px_per_rad = job.layout.period_px / (2 * np.pi)
        return depths.stereo(0 if job.axis == "x" else 1, px_per_rad), np.moveaxis(d.camera.rays(), 2, 0), extra
    if d.grid.size:
        measure = depths.splined(width, d.grid.shape, d.step, d.gain, d.centre, d.near, d.per_mm)
        return measure, d.c, d.grid
    return depths.pixelwise(width * height, d.gain, d.centre), d.c, d.bounds


def _runs(slots: list[int]) -> Iterator[tuple[int, int, int]]:
    """(slot, first frame, frame after the last) of frames that lie one after the other in the capture too."""
    at = 0
    for k in range(1, len(slots) + 1):
        if k == len(slots) or slots[k] != slots[k - 1] + 1:
            yield at, slots[at], slots[k - 1] + 1
            at = k
