"""What lies on a CUDA device for one pass: coefficients, frames, maps and kernels. Imported only
where there is one."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numba import cuda

from slviewer.fringe import limits
from slviewer.fringe.kernels_spikes import spike_rules
from slviewer.fringe.reference import dark_sigmas
from slviewer.geometry.cuda_device import device_function
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import MARGIN, ray_depth
from slviewer.reconstruction.onepass import LightLevels, PassResult, PassTask
from slviewer.reconstruction.onepass_cuda_spikes import spike_kernels
from slviewer.reconstruction.onepass_cuda_sweep import frame_slots, sweep_kernel
from slviewer.reconstruction.pixel_depths import INVALID, pixelwise_point, splined_point

THREADS = 256
"""Of a block: eight warps, which leave every scheduler of a multiprocessor with work, whatever
registers they need."""


class Card:
    """Buffers and kernels on the CUDA device for one job and one dtype of frames, uint8 or uint16.

    All that it does is queued in ``stream``; only `fetch` waits. Errors are those of numba's CUDA.
    """

    def __init__(self, job: PassTask, dtype: np.dtype) -> None:
        layout, deep = job.layout, dtype == np.uint16
        pixels = job.shape[0] * job.shape[1]
        self.dtype, self._dark_sigmas = dtype, dark_sigmas(layout)
        slots = frame_slots(layout)
        slots += [i for i in job.frames if i not in slots] if deep else []
        measure, c, extra = _depths(job)
        rules = spike_rules(layout)
        self._is_plain, self._shaded = rules.is_plain, job.is_shaded
        self._sweep = sweep_kernel(job, len(slots), measure, deep)
        self._spikes = spike_kernels(rules, job.shape, measure)

        self.stream = cuda.stream()
        self._grid = -(-pixels // THREADS), THREADS, self.stream
        self._c = cuda.to_device(np.ascontiguousarray(c.reshape(len(c), pixels)))
        self._extra = cuda.to_device(np.ascontiguousarray(extra))
        self._frames = cuda.device_array(len(slots) * pixels, dtype)
        self._list_runs = [
            (first, last, self._frames[at * pixels : (at + last - first) * pixels])
            for at, first, last in _list_runs(slots)
        ]
        self._phase, self._modulation, self._sigma_z = (
            cuda.device_array(pixels, np.float32) for _ in range(3)
        )
        self._phase_map = self._phase.reshape(job.shape)
        self._points = cuda.device_array((pixels, 3), np.float32)
        self._reason, self._words = (cuda.device_array(pixels, np.uint8) for _ in range(2))
        self._texture = cuda.device_array(pixels if self._shaded else 1, dtype)
        self._deep, self._none = deep, np.zeros(1, np.int32)
        self._highest = cuda.to_device(self._none)

    @property
    def bytes_moved(self) -> int:
        """Bytes that the first pass reads and writes in the device's memory, each number once."""
        read = self._frames, self._c, self._extra
        written = (
            self._phase,
            self._modulation,
            self._sigma_z,
            self._points,
            self._reason,
            self._texture,
        )
        return sum(array.size * array.dtype.itemsize for array in (*read, *written))

    def load(self, frames: np.ndarray) -> None:
        """Copy the frames (n, h, w) that are read, each once."""
        for first, last, room in self._list_runs:
            room.copy_to_device(frames[first:last].reshape(-1), stream=self.stream)

    def sweep(self, light: LightLevels) -> None:
        """Run the first pass over the loaded frames."""
        if self._deep:
            self._highest.copy_to_device(self._none, stream=self.stream)
        numbers = (
            *light.noise,
            limits.DARK_LEVELS * light.white / 255,
            self._dark_sigmas,
            light.white,
            light.mean,
        )
        self._sweep[self._grid](
            self._frames, tuple(np.float32(number) for number in numbers), self._c, self._extra,
            self._phase,
            self._reason, self._modulation, self._points, self._sigma_z, self._texture,
            self._highest,
        )  # fmt: skip

    def repair_spikes(self) -> None:
        """Run the second pass on the device: see `OnePass.repair_spikes`."""
        list_moves, move, list_masked, mask = self._spikes
        if self._is_plain:
            list_moves[self._grid](self._phase_map, self._words)
            move[self._grid](
                self._words, self._c, self._extra, self._phase, self._points, self._sigma_z
            )
        list_masked[self._grid](self._phase_map, self._words)
        mask[self._grid](self._words, self._phase, self._reason, self._points, self._sigma_z)

    def fetch(self, scan: PassResult) -> int:
        """Copy the maps into a scan's arrays, the texture only where it is computed from fringes;
        returns the largest grey level, 0 for uint8 frames."""
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


def _depths(job: PassTask) -> tuple[Callable[..., Any], np.ndarray, np.ndarray]:
    """Return the device function (pixel, phase, c, extra) that measures a pixel like
    `pixel_depths`, and two arrays: ``c`` (m, h, w) of the camera's pixels, and ``extra``. The pixel
    is a uint64, so that indices are not tested for their sign."""
    width, d = job.shape[1], job.depths
    if isinstance(d, StereoRig):
        extra = np.zeros((6, 10))
        for row, numbers in zip(
            extra, (*d.R, d.t, d.projector.parameters, d.projector.size), strict=True
        ):
            row[: len(numbers)] = numbers
        return (
            _compile_stereo(0 if job.axis == "x" else 1, job.layout.period_px),
            np.moveaxis(d.camera.rays(), 2, 0),
            extra,
        )
    gain, centre, near, per_mm = (
        np.float32(number) for number in (d.gain, d.centre, d.near, d.per_mm)
    )
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


def _list_runs(slots: list[int]) -> Iterator[tuple[int, int, int]]:
    """Return (slot, first frame, frame after the last) of each run of consecutive frames of the
    capture."""
    at = 0
    for k in range(1, len(slots) + 1):
        if k == len(slots) or slots[k] != slots[k - 1] + 1:
            yield at, slots[at], slots[k - 1] + 1
            at = k
