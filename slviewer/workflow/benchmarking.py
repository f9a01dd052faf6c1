"""How long the main stages take, beside what they cannot beat."""

import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import prange

from slviewer.evaluation.render import render
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import p18
from slviewer.fringe.reference import decode_reference
from slviewer.geometry.jit import kernel
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.workflow.calibrating import calibrate
from slviewer.workflow.feedback import Progress, part, unheard
from slviewer.workflow.simulating import TARGET, one_axis, simulate


@dataclass(frozen=True)
class Benchmark:
    """Stages as rows: seconds, and the ratio that matters."""

    rows: list[dict[str, Any]]
    peak_memory_gb: float | None

    def to_json(self) -> dict[str, Any]:
        """The rows as they are."""
        return {"stages": self.rows, "peak_memory_gb": self.peak_memory_gb}

    def text(self) -> str:
        """For people."""
        lines = [render(self.rows)]
        if self.peak_memory_gb is not None:
            lines.append(f"peak memory of the whole run {self.peak_memory_gb:.2f} GB")
        return "\n".join(lines)


def bench(*, calibration: bool = False, scale: float = 1.0, progress: Progress = unheard) -> Benchmark:
    """Time rendering and decoding of one axis of one pose; with ``calibration``, also that of 25 recorded poses."""
    progress(0.0, "rendering a pose")
    rig = letter(scale)
    sequence = one_axis(p18(rig.projector.size), "x")
    renderer = Renderer(rig, next(iter(letter_plan(rig, poses=3).values())))
    frames = renderer.capture(sequence)
    rendering = _median(lambda: renderer.capture(sequence), 3) / len(frames)
    progress(0.1, "decoding")
    coded = frames[:-1]  # without the texture
    out = np.empty((3, *frames.shape[1:]), np.float32)
    floor = _median(lambda: _touch(coded, out), 9)
    fast = _median(lambda: decode(sequence, frames, "x"), 5)
    defined = _median(lambda: decode_reference(sequence, frames, "x"), 1)
    size = f"{frames.shape[2]}x{frames.shape[1]}"
    rows: list[dict[str, Any]] = [
        _row(f"render one frame, {size}", rendering),
        _row(f"read {len(coded)} frames, write three maps: the floor", floor),
        _row(f"decode {len(coded)} frames, kernel", fast, fast / floor, defined / fast),
        _row(f"decode {len(coded)} frames, NumPy definition", defined, defined / floor),
    ]
    memory = None
    if calibration:
        with tempfile.TemporaryDirectory() as folder:
            session = Path(folder) / "session"
            simulate(session, scale=scale, progress=part(progress, 0.2, 0.7))
            start = time.perf_counter()
            calibrate(session, TARGET, progress=part(progress, 0.7, 1.0))
            rows.append(_row("calibrate 25 recorded poses, both axes, both models", time.perf_counter() - start))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        memory = peak / (1e9 if sys.platform == "darwin" else 1e6)
    progress(1.0, "measured")
    return Benchmark(rows, memory)


def _row(stage: str, seconds: float, to_floor: float | None = None, faster: float | None = None) -> dict[str, Any]:
    return {"stage": stage, "ms": 1e3 * seconds, "ratio to floor": to_floor, "ratio NumPy / kernel": faster}


def _median(work: Callable[[], object], times: int) -> float:
    work()  # compiled, and in the caches
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


@kernel(parallel=True)
def _touch(frames, out):
    """Reads every byte of frames (n, h, w) once and writes out (3, h, w): no decoder can do less."""
    for y in prange(frames.shape[1]):
        for x in range(frames.shape[2]):
            total = np.int32(0)
            for k in range(frames.shape[0]):
                total += frames[k, y, x]
            out[0, y, x] = total
            out[1, y, x] = total
            out[2, y, x] = total
