"""Rows of the benchmark: timing, memory floors, a CUDA device, and other programs."""

import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from timeit import repeat

import numpy as np

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.calibration.splined.compiled import DEPTHS, GRID_CELLS_ACROSS, CompiledAxis
from slviewer.calibration.splined.model import SplinedModel
from slviewer.evaluation.render import Row
from slviewer.fringe.decode import code_rules, grey_scale, pack_levels, pack_shifts
from slviewer.fringe.kernels import decode_rows
from slviewer.fringe.kernels_coded import coded_rows
from slviewer.fringe.kernels_levels import levels_rows
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.sequence import PatternSequence, Size
from slviewer.fringe.threshold import fringe_mean
from slviewer.geometry import cuda_device
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats, move_points, turn_about
from slviewer.geometry.vectors import unit_vectors
from slviewer.reconstruction.onepass import LightLevels
from slviewer.reconstruction.onepass_cuda import COMPARED, CudaPass
from slviewer.registration.pairwise import register_prepared
from slviewer.registration.scan import prepare_scan
from slviewer.registration.start import Candidate

TIMES = 15
FEW = 3
"""Times that a stage is measured at least, ..."""
LASTING_S = 1.0
"""... and until it took this long, or `TIMES`."""
Measure = Callable[[], float]
"""Does some work once, and returns its seconds."""


def row(
    stage: str,
    seconds: float,
    megabytes: float | None = None,
    floor: float | None = None,
    *,
    note: str = "",
    target: float | tuple[float, str] | None = None,
) -> Row:
    """One row of the table; ``floor`` in seconds, for the ratio.

    ``target``: the most seconds on two cores at 1600x1200, and how the table states them where not
    in milliseconds.
    """
    most_s, text = target if isinstance(target, tuple) else (target, "")
    if most_s is not None:
        text = text or (f"{1e3 * most_s:g} ms" if most_s < 1.0 else f"{most_s:g} s")
    return {
        "stage": stage,
        "ms": 1e3 * seconds,
        "MB": megabytes,
        "floor ms": None if floor is None else 1e3 * floor,
        "ratio to floor": None if floor is None else seconds / floor,
        "target": text,
        "holds": (
            "" if most_s is None or seconds != seconds else "yes" if seconds <= most_s else "no"
        ),
        "note": note,
    }


def time_beside(work: Measure, unit: Measure) -> tuple[float, float]:
    """Least seconds of some work and of its unit, measured in turns, which lessens the share of
    other programs."""
    work(), unit()  # compiled, and in the caches
    seconds: list[tuple[float, float]] = []
    while len(seconds) < FEW or (len(seconds) < TIMES and sum(map(sum, seconds)) < LASTING_S):
        seconds.append((work(), unit()))
    least, least_unit = map(min, zip(*seconds, strict=True))
    return least, least_unit


def median(work: Callable[[], object], times: int, warm: bool = True) -> float:
    """Median seconds, after a first run that is not counted where ``warm``."""
    if warm:
        work()
    return statistics.median(repeat(work, number=1, repeat=times))


def run_python(*arguments: str, **environment: str) -> str:
    """Run Python in a process of its own; returns its output, and raises CalledProcessError where
    it fails."""
    command, changed = [sys.executable, *arguments], {**os.environ, **environment}
    return subprocess.run(command, check=True, capture_output=True, text=True, env=changed).stdout


def megabytes(*arrays: np.ndarray) -> float:
    """Return the size of the arrays, MB."""
    return sum(a.nbytes for a in arrays) / 1e6


@kernel()
def move_bytes(first, last, frames, numbers, grey, single, triple):
    """Move as many bytes as a decoder does, to measure the memory bandwidth.

    Reads ``frames`` (n, h, w) and float32 ``numbers`` (m, h, w) once, and writes ``grey`` (k, h, w)
    of 8 or 16 bits, ``single`` (j, h, w) float32 and ``triple`` (i, h, w, 3) float32.
    """
    width = frames.shape[2]
    for y in range(first, last):
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


def allocate_floor(
    frames: np.ndarray, numbers: int, written: tuple[int, int, int]
) -> tuple[np.ndarray, ...]:
    """Allocate the arrays of `move_bytes`: ``numbers`` read beside the frames; ``written`` in its
    order."""
    shape, (greys, singles, triples) = frames.shape[1:], written
    return (
        frames,
        np.zeros((numbers, *shape), np.float32),
        np.zeros((greys, *shape), frames.dtype),
        np.zeros((singles, *shape), np.float32),
        np.zeros((triples, *shape, 3), np.float32),
    )


def prepare_kernel(sequence: PatternSequence, frames: np.ndarray) -> Callable[[], object]:
    """Return the decoding of axis x into arrays made before, with the noise known, and without a
    look at neighbours."""
    layout = axis_layout(sequence, "x")
    scale = grey_scale(layout, measure_noise(layout, frames, 255.0), 255.0)
    maps = tuple(np.zeros(frames.shape[1:], dtype) for dtype in (*[np.float32] * 4, np.uint8))
    shifts = pack_shifts(layout)
    if not layout.gray:
        ladder = pack_levels(layout)
        return lambda: decode_rows(levels_rows, frames, (shifts, ladder, scale), maps)
    rules = code_rules(layout, fringe_mean(layout, frames))
    return lambda: decode_rows(coded_rows, frames, (shifts, scale, rules), maps)


def make_calibrations(shape: tuple[int, ...]) -> tuple[PixelwiseModel, CompiledAxis, np.ndarray]:
    """Coefficients of a plausible rig: their values do not change the time."""
    height, width = shape
    v, u = np.mgrid[:height, :width] / width
    ones = np.ones(shape, np.float32)
    c = np.stack([300 + 16 * u, 1.3 * ones, -2e-4 * ones, (u - 0.5) / 2, (v - 0.4) / 2])
    fit = PixelFit(
        c,
        np.zeros((3, *shape), np.float32),
        np.full(shape, 25, np.uint16),
        30 * ones,
        250 * ones,
        ones,
    )
    near, far = 200.0, 1000.0
    step = max(2, -(-max(width, height) // GRID_CELLS_ACROSS))
    grid = np.zeros(((height - 1) // step + 2, (width - 1) // step + 2, DEPTHS), np.float32)
    centred = np.stack([500 + 16 * u, 0.45 * ones, -1e-4 * ones]).astype(np.float32)
    compiled = CompiledAxis(centred, 455.5, grid, grid, step, near, far)
    return PixelwiseModel({"x": fit}, {"x": PERIOD_PX}, {}, "x"), compiled, c[3:].astype(np.float32)


PERIOD_PX = 18.0
AHEAD = 8
"""Copies that keep the device busy while what is measured is queued: it then waits for no
Python."""
COPIED = 256 << 20
"""Bytes of each of them: a card's memory takes 0.1 ms for these, and Python less to queue one."""


def gpu_rows(
    sequence: PatternSequence,
    model: PixelwiseModel | SplinedModel,
    frames: np.ndarray,
) -> list[Row]:
    """One pass over frames (n, h, w) of axis x: the kernel alone, then a whole cloud, repaired,
    with copies there and back; nothing without a device."""
    cuda_device.use_device()
    name = cuda_device.find_device()
    if name is None:
        return []
    one = CudaPass(sequence, model, "x")
    here = cuda_device.allocate_frames(frames.shape, frames.dtype)
    here[:] = frames
    for _ in range(COMPARED):  # with the processor
        scan = one.run(here)
    if cuda_device.find_device() is None:  # it failed, with a warning
        return []
    alone, least, moved = _time_kernel(one, here, scan.light)
    stage, fast = f"one pass over {len(frames)} frames, {model.name}, {name}", moved / least / 1e9
    note = f"{least / alone:.0%} of the {fast:.0f} GB/s of a copy on the device"
    rows = [row(f"{stage}: kernel", alone, moved / 1e6, least, note=note)]
    for memory, stack in (("page-locked", here), ("ordinary", frames)):
        whole = median(partial(one.run, stack, scan.light, scan), TIMES)
        note = f"{1 / whole:.0f} clouds/s, frames in {memory} memory"
        rows.append(row(f"{stage}: with copies", whole, note=note))
    cuda_device.use_device(False)
    return rows


def _time_kernel(one: CudaPass, frames: np.ndarray, light: LightLevels) -> tuple[float, float, int]:
    """(seconds of the first pass, seconds of a copy on the device that moves as much, bytes moved),
    by its clock."""
    from numba import cuda

    card = one.card(frames.dtype)
    card.load(frames)
    source, target, busy, idle = (
        cuda.device_array(size, np.uint8) for size in 2 * [card.bytes_moved // 2] + 2 * [COPIED]
    )
    marks = [cuda.event() for _ in range(3)]
    durations = []
    for _ in range(TIMES):
        for _ in range(AHEAD):
            idle.copy_to_device(busy, stream=card.stream)
        marks[0].record(card.stream)
        target.copy_to_device(source, stream=card.stream)
        marks[1].record(card.stream)
        card.sweep(light)
        marks[2].record(card.stream)
        card.stream.synchronize()
        durations.append((marks[0].elapsed_time(marks[1]), marks[1].elapsed_time(marks[2])))
    # simulators return 0
    copied, swept = (max(1e-3 * statistics.median(ms), 1e-9) for ms in zip(*durations, strict=True))
    return swept, copied, card.bytes_moved


INSTALL = "pip install 'slviewer[bench]'"


def missing(package: str) -> str:
    """Text on how to install a missing peer package; empty if it is installed."""
    try:
        version(package)
    except PackageNotFoundError:
        return f"{package} is not installed, and is not compared with: {INSTALL}"
    return ""


def fringes_row(frames: int, size: Size, ours: float) -> Row:
    """Decoding by `fringes` of as many frames of (width, height), shared among three periods;
    ``ours`` seconds took our kernel. It makes its arrays itself: brightness and modulation of each
    period, and coordinates.
    """
    from fringes import Fringes

    width, height = size
    coder = Fringes()
    coder.X = coder.Y = 912
    coder.D, coder.K, coder.v = 1, 3, [1, 8, 57]
    coder.N = [frames // 3 + (i < frames % 3) for i in range(3)]
    levels = (
        np.random.default_rng(0).integers(0, 256, (int(coder.T), height, width)).astype(np.uint8)
    )
    seconds = median(lambda: coder.decode(levels), 3)
    note = (
        f"{seconds / ours:.0f} times our kernel; three periods, coordinates from them, in arrays of"
        " its own"
    )
    return row(f"decode {len(levels)} frames, fringes {version('fringes')}", seconds, note=note)


@dataclass(frozen=True, eq=False)
class ReliefPair:
    """Two noisy clouds of one relief, 1.4 M points each, of which the second is moved by 4 degrees
    and 5 mm; ``true_transform`` (4, 4) moves it back."""

    points: np.ndarray
    normals: np.ndarray
    moved: np.ndarray
    moved_normals: np.ndarray
    true_transform: np.ndarray

    @classmethod
    def make(cls) -> "ReliefPair":
        """Return the pair with its noise of a fixed seed."""
        (points, normals), (moved, moved_normals) = _make_relief(0, 0.0), _make_relief(1, 0.037)
        turn = np.radians(4.0) * np.array([1.0, 0.5, 2.0]) / 2.29
        truth = turn_about(turn, moved.mean(0), np.array([3.0, -3.0, 2.6]))
        back = np.linalg.inv(truth).astype(np.float64)
        return cls(
            points, normals, move_points(truth, moved), moved_normals @ truth[:3, :3].T, back
        )

    def align(self) -> Floats:
        """Align by the program's registration, with its checks of the result."""
        clouds = ("scan", self.moved, self.moved_normals), ("reference", self.points, self.normals)
        with ThreadPoolExecutor() as threads:  # as `register_all` does
            scan, reference = threads.map(lambda cloud: prepare_scan(*cloud), clouds)
        size, initial = min(scan.size, reference.size), Candidate(np.eye(4), "initial")
        return register_prepared(scan, reference, size, initial).T_reference_scan


def registration_rows() -> list[Row]:
    """Aligning the clouds of a `ReliefPair`: ours, then `small-gicp`."""
    pair = ReliefPair.make()
    points, moved, true_transform = pair.points, pair.moved, pair.true_transform
    count = f"{len(points) / 1e6:.2f} M points"

    def time_alignment(
        stage: str, align: Callable[[], Floats], note: str, target: float | None = None
    ) -> Row:
        """The row of an alignment (4, 4), with its largest error over the scan, in um."""
        few = moved[::997]
        worst = np.linalg.norm(
            move_points(align(), few) - move_points(true_transform, few), axis=1
        ).max()
        return row(stage, median(align, 3), target=target, note=f"{1e3 * worst:.1f} um off, {note}")

    rows = [time_alignment(f"align {count}", pair.align, "with checks of the result", 0.6)]
    if missing("small-gicp"):
        return rows
    import small_gicp

    def theirs() -> np.ndarray:
        """Align by small_gicp's generalised ICP."""
        return np.asarray(
            small_gicp.align(
                points.astype(np.float64),
                moved.astype(np.float64),
                registration_type="GICP",
                downsampling_resolution=0.5,
                max_correspondence_distance=8.0,
                num_threads=2,
            ).T_target_source
        )

    note = "generalised ICP, voxels of 0.5 mm, two threads, without checks of the result"
    return [
        *rows,
        time_alignment(f"align {count}, small-gicp {version('small-gicp')}", theirs, note),
    ]


def _make_relief(seed: int, shift_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) mm of a relief of 150 x 150 mm with noise of 0.03 mm, and its normals (n, 3)
    towards the camera; the grid of the pixels is shifted by ``shift_mm``."""
    u = np.linspace(-75.0, 75.0, 1183) + shift_mm
    x, y = np.meshgrid(u, u)
    z = (
        6 * np.sin(x / 9) * np.cos(y / 11)
        + 3 * np.sin((x + y) / 5)
        + 12 * np.exp(-((x - 20) ** 2 + y**2) / 200)
    )
    slope_y, slope_x = np.gradient(z, u, u)
    normals = np.stack([slope_x, slope_y, -np.ones_like(z)], -1)
    noise = 0.03 * np.random.default_rng(seed).standard_normal(z.shape)
    points, normals = np.stack([x, y, 600.0 + z + noise], -1), unit_vectors(normals)
    return points.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3).astype(np.float32)
