"""Simulated target poses, and the faults that are put into them one at a time.

Target poses are rendered once, and spoilt afterwards where a fault allows it; all of it happens in memory.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.attempt import Attempt, attempt_stereo
from slviewer.calibration.diagnosis.poses import FEW_POSES
from slviewer.calibration.diagnosis.verdict import Cause
from slviewer.calibration.observe import Smoothing
from slviewer.fringe.decode import texture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.poses import Judged, read_pose
from slviewer.simulation.boards import BoardShape, Pose, printed_board
from slviewer.simulation.hostile_frames import delay_frames, drop_frame, swap_groups
from slviewer.simulation.plans import rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.target.board import Board

BOARD = Board.parse("circles:21x16:9")
PERIOD_PX, BITS = 18.0, 7
POSES = 8
EVERY = 5
"""Poses that a fault of every one of them is put into; more would show the same."""
MANY = 18
"""Poses from which those that reach a corner are taken away."""


@dataclass(frozen=True, eq=False)
class FaultBench:
    """A rig, a board, and its captures, each rendered and examined when it is first asked for."""

    rig: SimulatedRig
    board: Board = BOARD
    count: int = POSES
    shape: BoardShape = field(default_factory=BoardShape)
    steps: int = 18
    _frames: dict[int, np.ndarray] = field(default_factory=dict, init=False, repr=False)
    _examined: dict[int, Judged] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def sequence(self) -> PatternSequence:
        """The Letter's, of so many phase steps: as many frames along x as along y."""
        frames: list[Frame] = []
        axes: tuple[Axis, ...] = ("x", "y")
        for axis in axes:
            frames += [*phase_steps(axis, self.steps, PERIOD_PX), *gray_bits(axis, BITS), Frame("texture")]
        return PatternSequence(self.rig.projector.size, tuple(frames))

    @cached_property
    def poses(self) -> list[Pose]:
        """Target poses that reach the image's corners."""
        return target_poses(self.rig, self.board, self.count)

    @property
    def every(self) -> range:
        """The poses that a fault of all of them is put into."""
        return range(min(self.count, EVERY))

    def frames(self, i: int) -> np.ndarray:
        """A clean capture of the i-th pose, kept to be spoilt."""
        if i not in self._frames:
            self._frames[i] = self.render(self.poses[i], i)
        return self._frames[i]

    def examine_clean(self, i: int) -> Judged:
        """The same, examined."""
        if i not in self._examined:
            frames = self._frames.get(i)
            self._examined[i] = self.examine(i, self.render(self.poses[i], i) if frames is None else frames)
        return self._examined[i]

    def render(self, pose: Pose, seed: int, exposure: float = 1.0, reverse: Axis | None = None) -> np.ndarray:
        """(n, h, w) uint8: a capture of the board at a pose, in so many times the usual light, with the patterns of one
        axis reversed.
        """
        renderer = Renderer(self.rig, printed_board(self.board, pose, self.shape, self.rig.seed))
        rng = np.random.default_rng([self.rig.seed, seed, 0xCA])
        width, height = self.rig.camera.size
        stack = np.empty((len(self.sequence.frames), height, width), np.uint8)
        for k, out in enumerate(stack):
            axis, levels = profile(self.sequence, k)
            keys = rng.integers(0, 2**32, 2, dtype=np.uint32)
            levels = levels[::-1] if axis is not None and axis == reverse else levels
            renderer.frame((axis, levels), keys, out, exposure=exposure * renderer.exposure)
        return stack

    def examine(
        self, i: int, frames: np.ndarray, sequence: PatternSequence | None = None, board: Board | None = None
    ) -> Judged:
        """The reading of a capture with its evidence; ``sequence`` and ``board`` as described to the program."""
        name, sequence, board = f"pose_{i + 1:02d}", sequence or self.sequence, board or self.board
        phases = decode_frames(name, sequence, frames)
        return read_pose(name, sequence, frames, phases, texture(sequence, frames), board, Smoothing(), examine=True)

    def attempt(self, captures: Sequence[Judged], board: Board | None = None) -> Attempt:
        """The calibration from examined captures."""
        observations = [each.observation for each in captures if each.observation is not None]
        evidence = [each.evidence for each in captures if each.evidence is not None]
        return attempt_stereo(observations, evidence, self.rig.projector.size, board or self.board)

    def examine_all(self) -> list[Judged]:
        """All captures without a fault, examined."""
        return [self.examine_clean(i) for i in range(self.count)]

    def examine_with(self, change: Callable[[np.ndarray], np.ndarray], only: int | None = None) -> list[Judged]:
        """All captures, or only one of them, with their frames spoilt."""
        if only is None:
            return [self.examine(i, change(self.frames(i))) for i in self.every]
        return [
            self.examine(i, change(self.frames(i))) if only == i else self.examine_clean(i) for i in range(self.count)
        ]


Fault = Callable[[FaultBench], Attempt]


def _described(**change: Any) -> Fault:
    """Fringes of other periods than the description says: {axis: described period}."""

    def attempt(bench: FaultBench) -> Attempt:
        frames = tuple(
            replace(f, period_px=change[f.axis]) if f.kind == "phase" and f.axis in change else f
            for f in bench.sequence.frames
        )
        sequence = replace(bench.sequence, frames=frames)
        return bench.attempt([bench.examine(i, bench.frames(i), sequence) for i in bench.every])

    return attempt


def _given(columns: int, rows: int) -> Fault:
    """A board of another size than the one that was captured."""

    def attempt(bench: FaultBench) -> Attempt:
        board = replace(bench.board, columns=columns, rows=rows)
        return bench.attempt([bench.examine(i, bench.frames(i), board=board) for i in bench.every], board)

    return attempt


def _renumbered(order: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Features of one pose in another order; ``order`` turns (rows, columns) indices."""

    def attempt(bench: FaultBench) -> Attempt:
        captures = bench.examine_all()
        seen = captures[2].observation
        assert seen is not None
        columns, rows = bench.board.features
        turned = order(np.arange(columns * rows).reshape(rows, columns)).ravel()
        slopes = None if seen.slopes is None else seen.slopes[turned]
        wrong = replace(seen, camera=seen.camera[turned], projector=seen.projector[turned], slopes=slopes)
        captures[2] = replace(captures[2], observation=wrong)
        return bench.attempt(captures)

    return attempt


def _moved(by_mm: Sequence[float], share: float) -> Fault:
    """One pose whose board is elsewhere after this share of the frames."""

    def attempt(bench: FaultBench) -> Attempt:
        pose, frames = bench.poses[2], bench.frames(2).copy()
        from_frame = round(share * len(frames))
        frames[from_frame:] = bench.render(Pose(pose.R, pose.t + np.array(by_mm)), 2)[from_frame:]
        captures = bench.examine_all()
        captures[2] = bench.examine(2, frames)
        return bench.attempt(captures)

    return attempt


def _with_changed_frames(change: Callable[[np.ndarray], np.ndarray], only: int | None = None) -> Fault:
    return lambda bench: bench.attempt(bench.examine_with(change, only))


def _rendered(**change: Any) -> Fault:
    def attempt(bench: FaultBench) -> Attempt:
        return bench.attempt([bench.examine(i, bench.render(bench.poses[i], i, **change)) for i in bench.every])

    return attempt


def _gamma(gamma: float) -> Fault:
    def attempt(bench: FaultBench) -> Attempt:
        light = replace(bench.rig.light, gamma=gamma)
        curved = replace(bench, rig=replace(bench.rig, light=light))
        return curved.attempt([curved.examine(i, curved.render(bench.poses[i], i)) for i in bench.every])

    return attempt


def _parallel(tilt_deg: float, spread_deg: float) -> Fault:
    """All boards tilted alike, but for a hand's unsteadiness."""

    def attempt(bench: FaultBench) -> Attempt:
        rng = np.random.default_rng(5)
        middle = (bench.board.points.min(0) + bench.board.points.max(0)) / 2
        captures = []
        for i in range(FEW_POSES):  # fewer would be a fault of its own
            pose = bench.poses[i]
            R = rotation(np.radians([tilt_deg, 0, 0]) + np.radians(spread_deg) * rng.uniform(-1, 1, 3))
            place = 0.7 * (pose.to_camera(middle) * [1, 1, 0]) + [0, 0, pose.to_camera(middle)[2]]
            captures.append(bench.examine(i, bench.render(Pose(R, place - R @ middle), i)))
        return bench.attempt(captures)

    return attempt


def _without_corner(bench: FaultBench) -> Attempt:
    """Poses of which none reaches the image's top right."""
    wide = replace(bench, count=MANY)
    width, height = bench.rig.camera.size
    captures = []
    for i, pose in enumerate(wide.poses):
        u, v = bench.rig.camera.project(pose.to_camera(bench.board.points)).T
        if np.mean((u > 0.78 * width) & (v < 0.3 * height)) == 0:
            captures.append(wide.examine(i, wide.render(pose, i)))
    return wide.attempt(captures)


def _few(count: int) -> Fault:
    return lambda bench: bench.attempt([bench.examine_clean(i) for i in range(count)])


def _exchange_halves(frames: np.ndarray) -> np.ndarray:
    half = len(frames) // 2  # as many frames of one axis as of the other
    return swap_groups(frames, range(half), range(half, 2 * half))


FAULTS: Mapping[str, tuple[Cause, Fault]] = {
    "x and y frames exchanged": (
        "axes-swapped",
        _with_changed_frames(_exchange_halves),
    ),
    "columns from right to left": ("axis-reversed", _rendered(reverse="x")),
    "rows from bottom to top": ("axis-reversed", _rendered(reverse="y")),
    "period 18 described as 16": ("fringe-period", _described(x=16.0, y=16.0)),
    "period 18 described as 20": ("fringe-period", _described(x=20.0, y=20.0)),
    "period 18 described as 36": ("fringe-period", _described(x=36.0, y=36.0)),
    "period 18 described as 16 along x": ("fringe-period", _described(x=16.0)),
    "board of 20x16 given": ("board-size", _given(20, 16)),
    "board of 21x15 given": ("board-size", _given(21, 15)),
    "board of 22x16 given": ("board-size", _given(22, 16)),
    "board transposed in one pose": ("board-numbering", _renumbered(lambda index: index.T)),
    "board shifted by a row in one pose": ("board-numbering", _renumbered(lambda index: np.roll(index, 1, axis=0))),
    "one pose moved between the axes": ("moved", _moved((0.5, 0.2, 0.0), 0.5)),
    "one pose moved among the frames of x": ("moved", _moved((1.0, -0.5, 0.5), 0.18)),
    "one pose moved a little": ("moved", _moved((0.15, 0.0, 0.15), 0.5)),
    "lag of one frame": ("frame-lag", _with_changed_frames(delay_frames)),
    "lag of one frame in one pose": ("frame-lag", _with_changed_frames(delay_frames, 3)),
    "fifth frame missing": ("missing-frame", _with_changed_frames(lambda frames: drop_frame(frames, 4))),
    "Gray bit missing": ("missing-frame", _with_changed_frames(lambda frames: drop_frame(frames, -7))),
    "fifth frame missing in one pose": ("missing-frame", _with_changed_frames(lambda frames: drop_frame(frames, 4), 3)),
    "overexposed": ("saturation", _rendered(exposure=1.8)),
    "much overexposed": ("saturation", _rendered(exposure=4.0)),
    "gamma 2.2": ("gamma", _gamma(2.2)),
    "boards facing the camera": ("parallel-poses", _parallel(0.0, 0.7)),
    "boards tilted alike": ("parallel-poses", _parallel(20.0, 3.0)),
    "no pose in one corner": ("empty-corner", _without_corner),
    "two poses": ("too-few-poses", _few(2)),
    "four poses": ("too-few-poses", _few(4)),
}
"""{what is wrong: (the cause that must be named first, how it comes about)}."""
