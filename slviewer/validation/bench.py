"""Benchmark of the main stages, with lower bounds of their duration."""

import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation, Smoothing, smooth_axes
from slviewer.calibration.pixelwise import calibrate_pixelwise
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation.render import Row, render
from slviewer.examination.examine import examine
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import multifrequency, p18
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.geometry.jit import run_rows
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.models import load_model, load_stereo
from slviewer.pipeline.operation import Progress, ignore_progress, opened, part
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.simulate import TARGET, simulate
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.onepass import OnePass
from slviewer.records.record import to_plain
from slviewer.session import atomic
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.validation.bench_check import check_speed
from slviewer.validation.bench_live import LiveFigures, live_rate
from slviewer.validation.bench_rows import (
    PERIOD_PX,
    allocate_floor,
    fringes_row,
    gpu_rows,
    make_calibrations,
    median,
    megabytes,
    missing,
    move_bytes,
    prepare_kernel,
    registration_rows,
    row,
    time_beside,
)
from slviewer.validation.bench_scaling import time_scaling
from slviewer.validation.bench_wizard import time_wizard


@dataclass(frozen=True)
class Benchmark:
    """Stages as rows: milliseconds, MB moved, the floor, the ratios and the target. ``missing``:
    peers not there."""

    rows: list[Row]
    peak_memory_gb: float | None
    missing: tuple[str, ...] = ()
    live: LiveFigures | None = None
    failure: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the rows as plain values."""
        figures = {
            "stages": self.rows,
            "peak_memory_gb": self.peak_memory_gb,
            "missing": list(self.missing),
        }
        return figures if self.live is None else figures | {"live": to_plain(self.live)}

    def text(self) -> str:
        """Return a table for the terminal."""
        lines = [render(self.rows), *self.missing]
        if self.peak_memory_gb is not None:
            lines.append(f"peak memory of the whole run {self.peak_memory_gb:.2f} GB")
        if self.live is not None:
            lines.append(self.live.text())
        return "\n".join(lines)


def bench(
    *,
    check: bool = False,
    calibration: bool = False,
    live: bool = False,
    wizard: bool = False,
    scaling: bool = False,
    minutes: float = 0.5,
    scale: float = 1.0,
    progress: Progress = ignore_progress,
) -> Benchmark:
    """Time the main stages on this machine, beside what they cannot beat.

    Args:
        check: Compare instead the ratios of stages to floors and kernels with limits; status 1
            where one grew.
        calibration: Also simulate and calibrate 25 poses (minutes, and 3.5 GB of disk at full
            size).
        live: Also scan live, at half the resolution, with one viewer that draws and one that
            stalls.
        wizard: Time instead (ten minutes) what an operator waits for, at half the resolution,
            beside its targets.
        scaling: Time instead (minutes) how the work grows with pixels, target poses, scans and
            captures.
        minutes: How long to scan live.
        scale: Resolution of the camera, as a share of 1600x1200.
    """
    if check:
        rows = check_speed(scale, progress)
        grown = [str(each["stage"]) for each in rows if each["holds"] == "no"]
        failure = f"slower than their limits: {', '.join(grown)}" if grown else ""
        return Benchmark(rows, None, failure=failure)
    if wizard:
        return Benchmark(time_wizard(0.5 * scale, progress), None)
    if scaling:
        return Benchmark(time_scaling(progress), None)
    progress(0.0, "rendering a pose")
    rig = letter(scale)
    plan = letter_plan(rig, poses=3)
    sequence = one_axis(p18(rig.projector.size), "x")
    renderer = Renderer(rig, plan["pose_01"])
    frames = renderer.capture(sequence)
    rendering = median(lambda: renderer.capture(sequence), 3) / len(frames)
    size = f"{frames.shape[2]}x{frames.shape[1]}"
    rows = [row(f"render one frame, {size}", rendering, frames[0].nbytes / 1e6, target=0.015)]
    progress(0.1, "decoding")
    stage = f"decode {len(frames) - 1} frames"
    note = "phase, wrapped phase, modulation, background and reason, in arrays made before"
    decoding, kernel = _time_decoding(stage, sequence, frames, note, 2.5)
    examining = median(lambda: examine(sequence, frames), 5)
    rows += [
        *decoding,
        row(f"examine {len(frames)} frames", examining, target=0.04),
    ]
    progress(0.2, "measuring")
    rows += _time_measuring(sequence, frames)
    progress(0.3, "live")
    rows.append(_time_live(rig, renderer))
    progress(0.35, "peers")
    peers, absent = _time_peers(rig, renderer, kernel)
    memory = None
    if calibration:
        rows += _time_calibration(scale, part(progress, 0.4, 1.0))
        memory = _peak_memory()
    progress(1.0, "measured")
    streamed = live_rate(0.5 * scale, 60 * minutes, progress) if live else None
    return Benchmark(rows + peers, memory, absent, streamed)


def _peak_memory() -> float | None:
    """Return the most memory that this process ever used, GB; None where the system does not report
    it."""
    if sys.platform == "win32":
        return None
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e9 if sys.platform == "darwin" else 1e6
    )


def _time_decoding(
    stage: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    note: str,
    kernels: float | None = None,
) -> tuple[list[Row], float]:
    """Rows of decoding with the kernel alone and as a whole, and the seconds of the kernel.

    ``kernels``: how many times as long as the kernel the whole may take, where that is limited.
    """
    alone = _time_with_floor(prepare_kernel(sequence, frames), frames[:-1], 0, (1, 4, 0))
    whole = median(lambda: decode(sequence, frames, "x"), 5)
    target = None if kernels is None else (kernels * alone[0], f"{kernels:g} kernels")
    remark = "with the noise, spikes, all masks and new arrays"
    return [
        row(f"{stage}, kernel", *alone, note=note),
        row(stage, whole, note=remark, target=target),
    ], alone[0]


def _time_measuring(sequence: PatternSequence, frames: np.ndarray) -> list[Row]:
    """Rows of points from phases and of one fused pass, by both fast models, and of writing a
    file."""
    rows = []
    phase = decode(sequence, frames, "x")
    pixelwise, compiled, rays = make_calibrations(frames.shape[1:])
    fast = {
        "pixelwise": (13, lambda: pixelwise.points(phase)),  # coefficients of float64 count twice
        "splined": (6, lambda: compiled.depth(phase.phase, PERIOD_PX / (2 * np.pi), rays, True)),
    }
    for name, (numbers, work) in fast.items():
        timed = _time_with_floor(work, frames[:0], numbers, (0, 0, 1))
        rows.append(row(f"reconstruct from phases, {name}", *timed))
    one = OnePass(sequence, pixelwise, "x")
    scan = one.run(frames, one.light(frames))
    # a splined model with made-up values, of which only the arrays that one pass reads are filled
    splined = object.__new__(SplinedModel)
    vars(splined).update(rays=rays, _compiled={"x": compiled})
    repairing = median(lambda: one.repair_spikes(scan), 9)
    sampling = median(lambda: one.light(frames), 5)
    return [
        *rows,
        _time_one_pass(one, frames, 7),
        _time_one_pass(OnePass(sequence, splined, "x"), frames, 5),
        *gpu_rows(sequence, pixelwise, frames),
        row("second pass, over spikes", repairing, megabytes(scan.phase)),
        row("noise and fringe mean of a capture, sampled", sampling, target=1e-3),
        *_time_files(scan.cloud(), sequence, frames),
    ]


def _time_one_pass(one: OnePass, frames: np.ndarray, numbers: int) -> Row:
    """The row of the fused kernel, which reads ``numbers`` float32 of calibration a pixel and
    allocates nothing."""
    light = one.light(frames)
    scan = one.run(frames, light)
    timed = _time_with_floor(lambda: one.sweep(frames, light, scan), frames, numbers, (2, 3, 1))
    note = "frames to phase, points, depth noise, modulation and texture; spikes not repaired"
    stage = f"one pass over {len(frames)} frames, {one.model.name}"
    return row(stage, *timed, note=note, target=(1.3 * timed[2], "1.3 floors"))


def _time_with_floor(
    work: Callable[[], object], frames: np.ndarray, numbers: int, written: tuple[int, int, int]
) -> tuple[float, float, float]:
    """Seconds of some work, MB that it moves, and seconds of only moving them; ``written`` as
    `move_bytes` has them."""
    arrays = allocate_floor(frames, numbers, written)
    floor = partial(run_rows, move_bytes, frames.shape[1], *arrays)
    seconds, least = time_beside(partial(timeit, work, number=1), partial(timeit, floor, number=1))
    return seconds, megabytes(*arrays), least


def _time_live(rig: SimulatedRig, renderer: Renderer) -> Row:
    """The row of a live scan: recorded frames of axis x to arrays in one fused pass of the
    pixel-wise model."""
    sequence = one_axis(multifrequency(rig.projector.size, 4), "x")
    frames = renderer.capture(sequence)
    pixelwise, _, _ = make_calibrations(frames.shape[1:])
    one = OnePass(sequence, pixelwise, "x")
    scan = one.run(frames)
    seconds = median(lambda: one.run(frames, scan.light, scan), 15)
    stage, target = f"live: {len(frames) - 1} recorded frames to arrays", (1 / 60, "60 clouds/s")
    return row(stage, seconds, note=f"{1 / seconds:.0f} clouds/s", target=target)


def _time_peers(
    rig: SimulatedRig, renderer: Renderer, coded: float
) -> tuple[list[Row], tuple[str, ...]]:
    """Rows of other programs, and of registration; ``coded`` seconds took our kernel for phase
    steps and Gray code."""
    rows: list[Row] = []
    absent = tuple(filter(None, map(missing, ("fringes", "small-gicp"))))
    if not missing("fringes"):
        sequence = one_axis(multifrequency(rig.projector.size, 6), "x")
        frames = renderer.capture(sequence)
        count, size = len(frames) - 1, (frames.shape[2], frames.shape[1])
        note = (
            "absolute and wrapped phase, modulation, background and reason, in arrays made before"
        )
        rows, ours = _time_decoding(
            f"decode {count} frames of three periods", sequence, frames, note
        )
        rows += [fringes_row(25, size, coded), fringes_row(count, size, ours)]
    return rows + registration_rows(), absent


def _time_calibration(scale: float, progress: Progress) -> list[Row]:
    """Rows of the pixel-wise fit, one pass of the splined model, and calibrating a whole simulated
    session."""
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        simulate(session, scale=scale, progress=part(progress, 0.0, 0.5))
        whole = median(
            lambda: calibrate.run(session, CalibrateSettings(TARGET), part(progress, 0.5, 0.9)),
            1,
            warm=False,
        )
        with opened(session) as store:
            stereo = load_stereo(store)
            observations = load_observations(store, list(stereo.poses))
            shot = store.load_capture(next(iter(stereo.poses)))
            splined = load_model(store, "splined")
            assert isinstance(splined, SplinedModel)
            only_x = one_axis(shot.sequence, "x")
            passed = _time_one_pass(
                OnePass(only_x, splined, "x"), shot.stack()[: len(only_x.frames)], 5
            )
        fit, held = _time_fit(observations, stereo)
    note = f"steps 2 to 5, both axes, phases in memory; at most {held:.2f} GB beside them"
    return [
        row(f"pixel-wise fit of {len(observations)} poses", fit, note=note, target=5.0),
        passed,
        row("calibrate 25 recorded poses, both axes, all default models", whole, target=25.0),
    ]


def _time_fit(observations: list[Observation], stereo: StereoModel) -> tuple[float, float]:
    """Measure the seconds to smooth all poses' phases and fit the pixels to them, and the peak
    memory, GB."""
    rng = np.random.default_rng(0)
    measured = {
        (o.name, axis): (
            (o.smoothed_phase(axis) + rng.normal(0, 0.02, o.region.shape)).astype(np.float32)
        )
        for o in observations
        for axis in o.surfaces
    }

    def work() -> None:
        """Smooth the phases of all poses and fit the pixel-wise model to them."""
        smoothed = []
        for o in observations:
            pitch = (o.box[2] - o.box[0]) / len(o.points) ** 0.5
            weight = o.region.astype(float)
            weighted = {axis: (measured[o.name, axis], weight) for axis in o.surfaces}
            surfaces = smooth_axes(weighted, o.box, o.size[0], pitch, Smoothing())
            smoothed.append(replace(o, surfaces=surfaces))
        calibrate_pixelwise(smoothed, stereo)

    seconds = median(work, 2)
    tracemalloc.start()  # NumPy reports its arrays to it
    work()
    held = tracemalloc.get_traced_memory()[1] / 1e9
    tracemalloc.stop()
    return seconds, held


def _time_files(cloud: Cloud, sequence: PatternSequence, frames: np.ndarray) -> list[Row]:
    """Rows of saving a capture, and of writing a cloud with texture and noise as PLY, against
    writing as many bytes."""
    mask = cloud.mask
    with (
        tempfile.TemporaryDirectory() as folder,
        Session.create(Path(folder, "session")) as session,
    ):
        path, plain = Path(folder, "cloud.ply"), Path(folder, "plain")

        def export() -> None:
            """Write the cloud."""
            write_ply(path, cloud.measured, colours=cloud.colours(), scalars=cloud.sigmas(mask))

        save = partial(
            session.save_capture,
            "scan_01",
            "scan",
            sequence,
            frames,
            source="simulated",
            force=True,
        )
        rows = []
        for stage, work, read in (
            (f"write {np.count_nonzero(mask) / 1e6:.2f} M points as PLY", export, path.read_bytes),
            (f"save a capture of {len(frames)} frames", save, frames.tobytes),
        ):
            seconds, content = median(work, 3), read()
            copying = median(partial(atomic.replace_file, plain, content), 3)
            target = 1.5 * copying, "1.5 floors"
            rows.append(row(stage, seconds, len(content) / 1e6, copying, target=target))
    return rows
