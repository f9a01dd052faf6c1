"""What no stage can beat: passes that only read its bytes and write its results, and how times are taken."""

import statistics
from collections.abc import Callable
from timeit import repeat, timeit
from typing import Any

import numpy as np
from numba import prange

from slviewer.geometry.jit import kernel


def row(
    stage: str,
    seconds: float,
    megabytes: float | None = None,
    floor: float | None = None,
    definition: float | None = None,
    note: str = "",
    target: str = "",
) -> dict[str, Any]:
    """One row of the table; ``floor`` and ``definition`` in seconds, for the ratios. ``target``: what is aimed at, on
    two cores at 1600x1200."""
    return {
        "stage": stage,
        "ms": 1e3 * seconds,
        "MB": megabytes,
        "floor ms": None if floor is None else 1e3 * floor,
        "ratio to floor": None if floor is None else seconds / floor,
        "ratio NumPy / kernel": None if definition is None else definition / seconds,
        "target": target,
        "note": note,
    }


def time_beside(work: Callable[[], object], floor: Callable[[], object], times: int = 9) -> tuple[float, float]:
    """Least seconds of some work and of its floor, run in turns, which lessens the share of other programs."""
    work(), floor()  # compiled, and in the caches
    seconds = [(timeit(work, number=1), timeit(floor, number=1)) for _ in range(times)]
    return min(each[0] for each in seconds), min(each[1] for each in seconds)


def median(work: Callable[[], object], times: int, warm: bool = True) -> float:
    """Median seconds, after a first run that is not counted where ``warm``."""
    if warm:
        work()
    return statistics.median(repeat(work, number=1, repeat=times))


def fastest(work: Callable[[], object], times: int) -> float:
    """Least seconds, after a first run that is not counted."""
    work()
    return min(repeat(work, number=1, repeat=times))


def megabytes(*arrays: np.ndarray) -> float:
    """Size of the arrays, MB."""
    return sum(a.nbytes for a in arrays) / 1e6


@kernel(parallel=True)
def move_bytes(frames, numbers, grey, single, triple):
    """Reads ``frames`` (n, h, w) and float32 ``numbers`` (m, h, w) once, and writes ``grey`` (k, h, w) of 8 or 16 bits,
    ``single`` (j, h, w) float32 and ``triple`` (i, h, w, 3) float32."""
    width = frames.shape[2]
    for y in prange(frames.shape[1]):
        whole, broken = np.zeros(width, frames.dtype), np.zeros(width, np.float32)
        for k in range(frames.shape[0]):
            line = frames[k, y]
            for x in range(width):
                whole[x] ^= line[x]
        for k in range(numbers.shape[0]):
            values = numbers[k, y]
            for x in range(width):
                broken[x] += values[x]
        for k in range(grey.shape[0]):
            for x in range(width):
                grey[k, y, x] = whole[x]
        for k in range(single.shape[0]):
            for x in range(width):
                single[k, y, x] = broken[x]
        for k in range(triple.shape[0]):
            for x in range(width):
                triple[k, y, x, 0] = triple[k, y, x, 1] = triple[k, y, x, 2] = broken[x]
