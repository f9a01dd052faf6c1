"""How long a CUDA device takes from frames to points, beside what its memory and its cable allow."""

import statistics
from typing import Any

import numpy as np

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry import cuda_device
from slviewer.reconstruction.onepass import LightLevels
from slviewer.reconstruction.onepass_cuda import CudaPass
from slviewer.validation.bench_floors import median, row

TIMES = 15
AHEAD = 8
"""Copies that keep the device busy while what is measured is queued: it then waits for no Python."""


def gpu_rows(
    sequence: PatternSequence, model: PixelwiseModel | SplinedModel, frames: np.ndarray
) -> list[dict[str, Any]]:
    """One pass over frames (n, h, w) of axis x: the kernel alone, then a whole cloud, repaired, with copies there and
    back; nothing without a device."""
    name = cuda_device.find_device()
    if name is None:
        return []
    one = CudaPass(sequence, model, "x")
    here = cuda_device.allocate_frames(frames.shape, frames.dtype)
    here[:] = frames
    scan = one.run(here)
    if cuda_device.find_device() is None:  # it failed, and that was told
        return []
    alone, least, moved = _kernel_alone(one, here, scan.light)
    whole = median(lambda: one.run(here, scan.light, scan), TIMES)
    ordinary = median(lambda: one.run(frames, scan.light, scan), TIMES)
    stage, fast = f"one pass over {len(frames)} frames, {model.name}, {name}", moved / least / 1e9
    note = f"{least / alone:.0%} of the {fast:.0f} GB/s of a copy on the device"
    return [
        row(f"{stage}: kernel", alone, moved / 1e6, least, note=note),
        row(f"{stage}: with copies", whole, note=f"{1 / whole:.0f} clouds/s, frames in page-locked memory"),
        row(f"{stage}: with copies", ordinary, note=f"{1 / ordinary:.0f} clouds/s, frames in ordinary memory"),
    ]


def _kernel_alone(one: CudaPass, frames: np.ndarray, light: LightLevels) -> tuple[float, float, int]:
    """(seconds of the first pass, seconds of a copy on the device that moves as much, bytes moved), by its clock."""
    from numba import cuda

    card = one.card(frames.dtype)
    card.load(frames)
    source, target = (cuda.device_array(card.bytes_moved // 2, np.uint8) for _ in range(2))
    marks = [cuda.event() for _ in range(3)]
    taken: list[tuple[float, float]] = []
    for _ in range(TIMES):
        for _ in range(AHEAD):
            target.copy_to_device(source, stream=card.stream)
        marks[0].record(card.stream)
        target.copy_to_device(source, stream=card.stream)
        marks[1].record(card.stream)
        card.sweep(light)
        marks[2].record(card.stream)
        card.stream.synchronize()
        taken.append((marks[0].elapsed_time(marks[1]), marks[1].elapsed_time(marks[2])))
    copied, swept = (max(1e-3 * statistics.median(ms), 1e-9) for ms in zip(*taken, strict=True))  # simulators tell 0
    return swept, copied, card.bytes_moved
