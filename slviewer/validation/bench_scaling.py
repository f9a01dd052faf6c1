"""How time and memory grow with pixels, target poses, scans merged and captures of a session."""

import shutil
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np

from slviewer.calibration.observe import Observation, observe
from slviewer.calibration.splined.model import calibrate_splined
from slviewer.calibration.stereo import calibrate_stereo
from slviewer.errors import InputError
from slviewer.fringe.decode import decode, texture
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.operations.batch import batch
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, track
from slviewer.pipeline.simulate import TARGET, save_true_stereo
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.multiway import Starts, register_all
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.simulation.turning import STEPS, turning
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.validation.bench_rows import Row, median, row, run_python
from slviewer.wizard.pose_plan import Planner
from slviewer.wizard.session_reader import SessionReader
from slviewer.wizard.snapshot import RigView

MEGAPIXELS = (0.5, 2.0, 8.0, 24.0)
WHOLE_MEGAPIXELS = (2.0, 8.0, 24.0)
"""Of captures that are read, decoded, reconstructed and written."""
POSES = (10, 40, 200)
SCANS = (6, 12, 25, 50)
"""From five on, consecutive ones are registered, and two further pairs of each."""
CAPTURES = (50, 200, 1000)
WORKERS = (1, 2, 4)
BATCH = 8
"""Captures of a batch."""
MOST_MB = 16_000.0
SCALE = 0.25
"""Of the rig that poses and scans are rendered with."""
NOISE_MM = 0.02
SLOW_S = 1.0
"""What takes longer is measured once."""
LINEAR = 1.05
"""Largest exponent that counts as linear."""


def time_scaling(progress: Progress) -> list[Row]:
    """Rows of each size, with the largest memory of its arrays, and of each kind the exponent of
    its growth."""
    rig = letter(SCALE)
    plan = letter_plan(rig, poses=max(POSES))
    scene = plan["pose_01"]
    kinds: dict[str, Callable[[], list[Row]]] = {
        "pixels": partial(_time_pixels, rig, scene),
        "captures of a session": partial(_time_captures, rig, scene),
        "scans": partial(_time_scans, rig),
        "reading poses": partial(_time_poses, rig, plan),
        "whole captures": partial(_time_whole_captures, scene),
        "batches": partial(_time_batches, scene),
    }
    rows = [row for _, measure, _ in track(progress, kinds) for row in measure()]
    progress(1.0, "measured")
    return rows


def _measure_growth(
    kind: str, sizes: tuple[float, ...], work: Callable[[float], Callable[[], object]]
) -> list[Row]:
    """Time ``work(size)()`` for each size; the last row's note is what ``_describe_growth`` says of
    all of them."""
    seconds, rows = [], []
    for size in sizes:
        run = work(size)
        tracemalloc.start()  # NumPy reports its arrays to it
        run()  # the first time, which also compiles
        memory = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        once = median(run, 1, False)
        seconds.append(once if once > SLOW_S else median(run, 5, False))
        rows.append(row(f"{kind}: {size:g}", seconds[-1], memory))
    rows[-1]["note"] = _describe_growth(sizes, seconds)
    return rows


def _describe_growth(sizes: tuple[float, ...], seconds: list[float]) -> str:
    """The exponent fitted to the seconds of all sizes, in words."""
    exponent = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
    verdict = "linear or better" if exponent <= LINEAR else "more than linear"
    return f"grows with the power {exponent:.2f}: {verdict}"


def _time_pixels(rig: SimulatedRig, scene: Any) -> list[Row]:
    """Rows of decoding 25 frames of several sizes, which are resized from rendered ones."""
    sequence = scan_sequence(rig)
    frames = Renderer(rig, scene).capture(sequence)

    def decode_size(size: float) -> Callable[[], object]:
        """Return the decoding of frames with so many megapixels."""
        scale = np.sqrt(1e6 * size / frames[0].size)
        large = np.stack([cv2.resize(frame, None, fx=scale, fy=scale) for frame in frames])
        return lambda: decode(sequence, large, "x")

    return _measure_growth("decode 25 frames, MP", MEGAPIXELS, decode_size)


def _time_captures(rig: SimulatedRig, scene: Any) -> list[Row]:
    """Rows of the wizard's snapshot of a session with so many captures."""
    with tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder:
        sequence = scan_sequence(rig)
        frames = Renderer(rig, scene).capture(sequence)
        with Session.open_or_create(Path(folder, "session")) as session:
            first = session.save_capture(
                "pose_001", "calibration", sequence, frames, source="simulated", board=TARGET
            )
            planner = Planner(lambda: None)

            def read_session(count: float) -> Callable[[], object]:
                """Return the reading of the session, filled up to so many captures."""
                for number in range(len(session.capture_names()) + 1, int(count) + 1):
                    shutil.copytree(first.folder, first.folder.parent / f"pose_{number:03d}")
                reader = SessionReader(session, planner)
                return lambda: reader.read(RigView(), None)

            rows = _measure_growth("snapshot of a session, captures", CAPTURES, read_session)
            planner.close()
    return rows


def _time_scans(rig: SimulatedRig) -> list[Row]:
    """Rows of registering scans of an object on a turntable that makes `STEPS` or more, with
    made-up noise."""
    rng, clouds = np.random.default_rng(0), {}
    steps = max(STEPS, *SCANS)
    for name, scene in turning(steps).items():
        points = Renderer(rig, scene).truth().points
        points[..., 2] += rng.normal(0, NOISE_MM, points.shape[:2])
        clouds[name] = Cloud(points, "x", "splined", np.full(points.shape[:2], NOISE_MM))
    names = list(clouds)

    def register(count: float) -> Callable[[], object]:
        """Return the registration of the first so many scans."""
        chosen = {name: clouds[name] for name in names[: int(count)]}
        angles = {name: 360.0 / steps * k for k, name in enumerate(chosen)}
        return lambda: register_all(chosen, names[0], Starts(table_deg=angles))

    return _measure_growth("register scans of a turn", SCANS, register)


def _time_poses(rig: SimulatedRig, plan: dict[str, Any]) -> list[Row]:
    """Rows of the stereo calibration and the joint adjustment of so many target poses."""
    observations: list[Observation] = []
    for name in (name for name in plan if name.startswith("pose_")):
        with suppress(InputError):  # no board is detected
            observations.append(observe_rendered(rig, plan[name], name, 0))

    def calibrate(count: float) -> Callable[[], object]:
        """Return the calibration from the first so many poses."""
        chosen = observations[: int(count)]

        return lambda: calibrate_splined(
            chosen, calibrate_stereo(chosen, rig.projector.size, TARGET)
        )

    return _measure_growth("calibrate poses, stereo and splined", POSES, calibrate)


_RECONSTRUCTED = """
import resource, sys, time
from slviewer.pipeline.reconstruct import reconstruct
begun = time.perf_counter()
reconstruct(sys.argv[1], "scan_01")
print(time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def _time_whole_captures(scene: Any) -> list[Row]:
    """Rows of reconstructing captures of several sizes from disk to PLY, with the peak memory of
    the process."""
    seconds, rows = [], []
    for megapixels in WHOLE_MEGAPIXELS:
        scale = float(np.sqrt(megapixels / 1.92))
        with tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder:
            save_scans(Path(folder, "session"), scale, scene, 1)
            for _ in range(2):  # the first compiles
                output = run_python("-c", _RECONSTRUCTED, str(Path(folder, "session")))
        lasted, peak = map(float, output.split()[-2:])
        seconds.append(lasted)
        memory = peak / (1e6 if sys.platform == "darwin" else 1e3)
        holds = {"target": f"{MOST_MB / 1e3:g} GB", "holds": "yes" if memory <= MOST_MB else "no"}
        stage = f"reconstruct a capture, MP: {megapixels:g}"
        rows.append(row(stage, lasted, memory) | holds)
    growth = _describe_growth(WHOLE_MEGAPIXELS, seconds)
    rows[-1]["note"] = f"{growth}; MB: peak of the whole process"
    return rows


def save_scans(session: Path, scale: float, scene: Any, count: int) -> None:
    """Make a session with the rig's true calibration and so many equal scans."""
    rig = letter(scale)
    sequence = scan_sequence(rig)
    frames = Renderer(rig, scene).capture(sequence)
    with Session.create(session) as store:
        save_true_stereo(store, rig)
        for number in range(1, count + 1):
            store.save_capture(f"scan_{number:02d}", "scan", sequence, frames, source="simulated")


def _time_batches(scene: Any) -> list[Row]:
    """Rows of a batch of captures on each number of workers, with their efficiency: the speed that
    each adds, beside that of one worker alone; empty without the packages that batches need."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        return []
    rows, seconds = list[Row](), list[float]()
    with tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder:
        session = Path(folder, "session")
        save_scans(session, 1.0, scene, BATCH)

        def reconstruct_all(scheduler: str) -> None:
            """Reconstruct the batch. Raises InputError where one of its captures failed."""
            if failed := batch([session], "reconstruct", scheduler=scheduler).failed:
                raise InputError(f"the batch cannot be timed: {next(iter(failed.values()))}")

        for workers in WORKERS:
            with (
                LocalCluster(
                    n_workers=workers, threads_per_worker=1, dashboard_address=None
                ) as cluster,
                Client(cluster, set_as_default=False),
            ):
                seconds.append(median(partial(reconstruct_all, cluster.scheduler_address), 1))
            cores = min(workers, numba.get_num_threads())
            efficiency = seconds[0] / seconds[-1] / cores
            note = f"efficiency {efficiency:.2f} on {cores} of the cores"
            rows.append(
                row(f"batch of {BATCH} captures, workers: {workers}", seconds[-1], note=note)
            )
    return rows


def observe_rendered(rig: SimulatedRig, scene: Scene, name: str, number: int) -> Observation:
    """The observation of a rendered target pose, whose noise ``number`` seeds. Raises InputError
    where no board is detected."""
    sequence = p18(rig.projector.size)
    frames = Renderer(rig, scene).capture(sequence, number)
    board = Board.parse(TARGET)
    return observe(
        name, board, detect(board, texture(sequence, frames)), decode_frames(name, sequence, frames)
    )


def scan_sequence(rig: SimulatedRig) -> PatternSequence:
    """The patterns of axis x alone, with which scans are captured."""
    return one_axis(p18(rig.projector.size), "x")
