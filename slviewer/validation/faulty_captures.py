"""Simulated target poses, and the faults that are put into them one at a time.

Target poses are rendered once, and disturbed afterwards where a fault allows it; all of it happens
in memory.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.poses import FEW_POSES
from slviewer.calibration.observe import Smoothing
from slviewer.fringe.decode import texture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import AXES, gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.poses import DecodedPose, Judged, read_pose
from slviewer.records.verdict import Cause
from slviewer.simulation.boards import BoardShape, Pose, printed_board
from slviewer.simulation.hostile_frames import delay_frames, drop_frame, show_instead
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
FrameChange = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class FaultBench:
    """A rig, a board, and its captures, each rendered and examined when it is first needed."""

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
        frames = [
            frame
            for axis in AXES
            for frame in (
                *phase_steps(axis, self.steps, PERIOD_PX),
                *gray_bits(axis, BITS),
                Frame("texture"),
            )
        ]
        return PatternSequence(self.rig.projector.size, tuple(frames))

    @cached_property
    def poses(self) -> list[Pose]:
        """Target poses that reach the image's corners."""
        return target_poses(self.rig, self.board, self.count)

    def frames(self, i: int) -> np.ndarray:
        """Return the frames (n, h, w) uint8 of the i-th pose without a fault, cached."""
        if i not in self._frames:
            self._frames[i] = self.render(self.poses[i], i)
        return self._frames[i]

    def render(
        self, pose: Pose, seed: int, exposure: float = 1.0, reverse: Axis | None = None
    ) -> np.ndarray:
        """(n, h, w) uint8: a capture of the board at a pose, in so many times the usual light, with
        the patterns of one axis reversed.
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
        self,
        i: int,
        frames: np.ndarray,
        sequence: PatternSequence | None = None,
        board: Board | None = None,
    ) -> Judged:
        """Read a capture with its evidence; ``sequence`` and ``board`` as described to the
        program."""
        name, sequence, board = f"pose_{i + 1:02d}", sequence or self.sequence, board or self.board
        phases = decode_frames(name, sequence, frames)
        pose = DecodedPose(name, sequence, frames, phases, texture(sequence, frames), board)
        return read_pose(pose, Smoothing())

    def examine_clean(self, count: int | None = None) -> list[Judged]:
        """Read all captures, or the first ``count``, without a fault; cached."""
        wanted = range(self.count if count is None else count)
        for i in wanted:
            if i not in self._examined:
                frames = self._frames.get(i)
                self._examined[i] = self.examine(
                    i, self.render(self.poses[i], i) if frames is None else frames
                )
        return [self._examined[i] for i in wanted]

    def attempt(
        self, captures: Sequence[Judged], board: Board | None = None
    ) -> DiagnosedCalibration:
        """Calibrate from examined captures."""
        observations = [each.observation for each in captures if each.observation is not None]
        evidence = [each.evidence for each in captures if each.evidence is not None]
        return calibrate_with_diagnosis(
            observations, evidence, self.rig.projector.size, board or self.board
        )

    def attempt_disturbed(
        self,
        change: FrameChange = lambda frames: frames,
        sequence: PatternSequence | None = None,
        board: Board | None = None,
        **rendering: Any,
    ) -> DiagnosedCalibration:
        """The calibration from ``EVERY`` captures, all with their frames changed, another
        description, or rendered otherwise."""
        captures = [
            self.examine(
                i,
                change(self.render(pose, i, **rendering) if rendering else self.frames(i)),
                sequence,
                board,
            )
            for i, pose in enumerate(self.poses[:EVERY])
        ]
        return self.attempt(captures, board)

    def attempt_with(self, i: int, frames: np.ndarray) -> DiagnosedCalibration:
        """Calibrate from all captures, with the frames (n, h, w) of the i-th replaced."""
        captures = self.examine_clean()
        captures[i] = self.examine(i, frames)
        return self.attempt(captures)


def _describe_periods(bench: FaultBench, **period_px: float) -> DiagnosedCalibration:
    """Diagnosed calibration with described fringe periods that are wrong, {axis: described
    period}."""
    frames = [
        replace(f, period_px=period_px[f.axis]) if f.kind == "phase" and f.axis in period_px else f
        for f in bench.sequence.frames
    ]
    return bench.attempt_disturbed(sequence=replace(bench.sequence, frames=tuple(frames)))


def _describe_board(bench: FaultBench, columns: int, rows: int) -> DiagnosedCalibration:
    """The diagnosed calibration with a described board of another size than the captured one."""
    return bench.attempt_disturbed(board=replace(bench.board, columns=columns, rows=rows))


def _renumber_features(bench: FaultBench, order: FrameChange) -> DiagnosedCalibration:
    """The diagnosed calibration with one pose's features reordered; ``order`` maps (rows, columns)
    indices."""
    captures = bench.examine_clean()
    observation = captures[2].observation
    assert observation is not None
    columns, rows = bench.board.features
    turned = order(np.arange(columns * rows).reshape(rows, columns)).ravel()
    slopes = None if observation.slopes is None else observation.slopes[turned]
    wrong = replace(
        observation,
        camera=observation.camera[turned],
        projector=observation.projector[turned],
        slopes=slopes,
    )
    captures[2] = replace(captures[2], observation=wrong)
    return bench.attempt(captures)


def _move_board(bench: FaultBench, by_mm: Sequence[float], share: float) -> DiagnosedCalibration:
    """The diagnosed calibration with one pose whose board moved after ``share`` of the frames."""
    pose, frames = bench.poses[2], bench.frames(2).copy()
    from_frame = round(share * len(frames))
    frames[from_frame:] = bench.render(Pose(pose.R, pose.t + np.array(by_mm)), 2)[from_frame:]
    return bench.attempt_with(2, frames)


def _apply_gamma(bench: FaultBench, gamma: float) -> DiagnosedCalibration:
    """The diagnosed calibration from captures of a projector with this gamma."""
    light = replace(bench.rig.light, gamma=gamma)
    return replace(bench, rig=replace(bench.rig, light=light)).attempt_disturbed()


def _tilt_boards_alike(
    bench: FaultBench, tilt_deg: float, spread_deg: float
) -> DiagnosedCalibration:
    """The diagnosed calibration from boards that are all tilted alike, within ``spread_deg``."""
    rng = np.random.default_rng(5)
    middle = (bench.board.points.min(0) + bench.board.points.max(0)) / 2
    captures = []
    for i in range(FEW_POSES):  # fewer would be a fault of its own
        pose = bench.poses[i]
        R = rotation(np.radians([tilt_deg, 0, 0]) + np.radians(spread_deg) * rng.uniform(-1, 1, 3))
        place = 0.7 * (pose.to_camera(middle) * [1, 1, 0]) + [0, 0, pose.to_camera(middle)[2]]
        captures.append(bench.examine(i, bench.render(Pose(R, place - R @ middle), i)))
    return bench.attempt(captures)


def _avoid_corner(bench: FaultBench) -> DiagnosedCalibration:
    """The diagnosed calibration from poses of which none reaches the image's top right."""
    wide = replace(bench, count=MANY)
    width, height = bench.rig.camera.size
    captures = []
    for i, pose in enumerate(wide.poses):
        u, v = bench.rig.camera.project(pose.to_camera(bench.board.points)).T
        if np.mean((u > 0.78 * width) & (v < 0.3 * height)) == 0:
            captures.append(wide.examine(i, wide.render(pose, i)))
    return wide.attempt(captures)


def _exchange_halves(frames: np.ndarray) -> np.ndarray:
    """Frames (n, h, w) with the first and the second half exchanged."""
    half = len(frames) // 2  # as many frames of one axis as of the other
    return show_instead(frames, range(2 * half), [*range(half, 2 * half), *range(half)])


FAULTS: Mapping[str, tuple[Cause, Callable[[FaultBench], DiagnosedCalibration]]] = {
    "x and y frames exchanged": (
        "axes-swapped",
        lambda bench: bench.attempt_disturbed(_exchange_halves),
    ),
    "columns from right to left": (
        "axis-reversed",
        lambda bench: bench.attempt_disturbed(reverse="x"),
    ),
    "rows from bottom to top": (
        "axis-reversed",
        lambda bench: bench.attempt_disturbed(reverse="y"),
    ),
    "period 18 described as 16": ("fringe-period", partial(_describe_periods, x=16.0, y=16.0)),
    "period 18 described as 20": ("fringe-period", partial(_describe_periods, x=20.0, y=20.0)),
    "period 18 described as 36": ("fringe-period", partial(_describe_periods, x=36.0, y=36.0)),
    "period 18 described as 16 along x": ("fringe-period", partial(_describe_periods, x=16.0)),
    "board of 20x16 given": ("board-size", lambda bench: _describe_board(bench, 20, 16)),
    "board of 21x15 given": ("board-size", lambda bench: _describe_board(bench, 21, 15)),
    "board of 22x16 given": ("board-size", lambda bench: _describe_board(bench, 22, 16)),
    "board transposed in one pose": (
        "board-numbering",
        lambda bench: _renumber_features(bench, np.transpose),
    ),
    "board shifted by a row in one pose": (
        "board-numbering",
        lambda bench: _renumber_features(bench, lambda index: np.roll(index, 1, axis=0)),
    ),
    "one pose moved between the axes": (
        "moved",
        lambda bench: _move_board(bench, (0.5, 0.2, 0.0), 0.5),
    ),
    "one pose moved among the frames of x": (
        "moved",
        lambda bench: _move_board(bench, (1.0, -0.5, 0.5), 0.18),
    ),
    "one pose moved a little": ("moved", lambda bench: _move_board(bench, (0.15, 0.0, 0.15), 0.5)),
    "lag of one frame": ("frame-lag", lambda bench: bench.attempt_disturbed(delay_frames)),
    "lag of one frame in one pose": (
        "frame-lag",
        lambda bench: bench.attempt_with(3, delay_frames(bench.frames(3))),
    ),
    "fifth frame missing": (
        "missing-frame",
        lambda bench: bench.attempt_disturbed(lambda frames: drop_frame(frames, 4)),
    ),
    "Gray bit missing": (
        "missing-frame",
        lambda bench: bench.attempt_disturbed(lambda frames: drop_frame(frames, -7)),
    ),
    "fifth frame missing in one pose": (
        "missing-frame",
        lambda bench: bench.attempt_with(3, drop_frame(bench.frames(3), 4)),
    ),
    "overexposed": ("saturation", lambda bench: bench.attempt_disturbed(exposure=1.8)),
    "much overexposed": ("saturation", lambda bench: bench.attempt_disturbed(exposure=4.0)),
    "gamma 2.2": ("gamma", lambda bench: _apply_gamma(bench, 2.2)),
    "boards facing the camera": (
        "parallel-poses",
        lambda bench: _tilt_boards_alike(bench, 0.0, 0.7),
    ),
    "boards tilted alike": ("parallel-poses", lambda bench: _tilt_boards_alike(bench, 20.0, 3.0)),
    "no pose in one corner": ("empty-corner", _avoid_corner),
    "two poses": ("too-few-poses", lambda bench: bench.attempt(bench.examine_clean(2))),
    "four poses": ("too-few-poses", lambda bench: bench.attempt(bench.examine_clean(4))),
}
"""{fault: (the cause that must be named first, the calibration with it)}."""
