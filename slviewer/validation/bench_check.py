"""Check that stages stay as fast as they were made, by ratios that other computers share."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import process_time

import numba

from slviewer.evaluation.render import Row
from slviewer.examination.examine import examine
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.jit import run_rows
from slviewer.pipeline.operation import Progress, track
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.reconstruction.onepass import OnePass
from slviewer.session import atomic
from slviewer.session.ply import write_ply
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.validation.bench_rows import (
    Measure,
    ReliefPair,
    allocate_floor,
    make_calibrations,
    move_bytes,
    prepare_kernel,
    row,
    run_python,
    time_beside,
)
from slviewer.validation.bench_scaling import save_scans

LIMITS = {
    "decode, kernel / floor": 3.5,
    "decode, whole / kernel": 3.3,
    "examine a capture / kernel": 4.6,
    "noise and fringe mean, sampled / kernel": 0.32,
    "second pass, over spikes / kernel": 0.29,
    "one pass, pixelwise / floor": 3.3,
    "write points as PLY / floor": 4.5,
    "reconstruct again in the process / kernel": 86.0,
    "align 1.4 M points / kernel": 250.0,
    "`slviewer --help` / Python's start": 28.0,
    "`slviewer reconstruct` / Python's start": 310.0,
}
"""Largest ratio of each stage: 1.5 times what was measured when it was last made faster. Lower a
limit where its stage became faster; raise one only for what the stage now does more."""
_CLOCK = "import sys, time; {}; print(time.process_time())"
_COMMAND = "from slviewer.cli import main; main(sys.argv[1:])"


def check_speed(scale: float, progress: Progress) -> list[Row]:
    """Rows of the stages in `LIMITS`, at ``scale`` of 1600x1200, of which those that grew beyond
    their limit do not hold.

    Time is that of the processor, on one thread, least of several: other programs hardly change
    it. What grew is measured once more before it counts.
    """
    rows = []
    with _run_on_one_thread(), tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder:
        stages = _prepare_stages(scale, Path(folder))
        for stage, (work, unit), _ in track(progress, stages):
            limit = LIMITS[stage]
            seconds, least = time_beside(work, unit)
            if seconds > limit * least:
                seconds, least = map(min, (seconds, least), time_beside(work, unit))
            target = limit * least, f"at most {limit:g}"
            rows.append(row(stage, seconds, floor=least, target=target))
    return rows


@contextmanager
def _run_on_one_thread() -> Iterator[None]:
    """Let kernels run on the calling thread alone."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _clock(work: Callable[[], object]) -> Measure:
    """Return work that measures the processor's time of this process."""

    def measure() -> float:
        """Do the work once."""
        begun = process_time()
        work()
        return process_time() - begun

    return measure


def _clock_process(statement: str, *arguments: str) -> Measure:
    """Return work that runs a statement in a process of its own, which measures itself."""
    return lambda: float(run_python("-c", _CLOCK.format(statement), *arguments).split()[-1])


def _prepare_stages(scale: float, folder: Path) -> dict[str, tuple[Measure, Measure]]:
    """Return the work of each stage and of the unit that it is compared with."""
    rig = letter(scale)
    scene = letter_plan(rig, poses=3)["pose_01"]
    sequence = one_axis(p18(rig.projector.size), "x")
    frames = Renderer(rig, scene).capture(sequence)
    pixelwise, _, _ = make_calibrations(frames.shape[1:])
    one = OnePass(sequence, pixelwise, "x")
    light = one.light(frames)
    scan = one.run(frames, light)
    cloud, session = scan.cloud(), folder / "session"
    save_scans(session, scale, scene, 1)
    ply, plain = folder / "cloud.ply", folder / "plain"
    colours, scalars = cloud.colours(), cloud.sigmas(cloud.mask)
    export = partial(write_ply, ply, cloud.measured, colours=colours, scalars=scalars)
    export()
    kernel = _clock(prepare_kernel(sequence, frames))
    start = _clock_process("pass")

    def floor(numbers: int, written: tuple[int, int, int]) -> Measure:
        """Return the moving of the bytes of the frames and of arrays."""
        return _clock(
            partial(
                run_rows, move_bytes, frames.shape[1], *allocate_floor(frames, numbers, written)
            )
        )

    again = partial(reconstruct, session, "scan_01", out=folder / "again.ply")
    command = "reconstruct", str(session), "scan_01", "--out", str(folder / "command.ply")
    return {
        "decode, kernel / floor": (kernel, floor(0, (1, 4, 0))),
        "decode, whole / kernel": (_clock(partial(decode, sequence, frames, "x")), kernel),
        "examine a capture / kernel": (_clock(partial(examine, sequence, frames)), kernel),
        "noise and fringe mean, sampled / kernel": (_clock(partial(one.light, frames)), kernel),
        "second pass, over spikes / kernel": (_clock(partial(one.repair_spikes, scan)), kernel),
        "one pass, pixelwise / floor": (
            _clock(partial(one.sweep, frames, light, scan)),
            floor(7, (2, 3, 1)),
        ),
        "write points as PLY / floor": (
            _clock(export),
            _clock(partial(atomic.replace_file, plain, ply.read_bytes())),
        ),
        "reconstruct again in the process / kernel": (_clock(again), kernel),
        "align 1.4 M points / kernel": (_clock(ReliefPair.make().align), kernel),
        "`slviewer --help` / Python's start": (_clock_process(_COMMAND, "--help"), start),
        "`slviewer reconstruct` / Python's start": (_clock_process(_COMMAND, *command), start),
    }
