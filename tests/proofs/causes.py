"""Whether every fault of a calibration is named as its cause, and sound calibrations raise no
alarm.

Target poses are rendered once, and the faults are put into them one at a time, afterwards where a
fault allows it; all of it happens in memory.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.rules import FEW_POSES
from slviewer.calibration.observe import Smoothing
from slviewer.evaluation.render import Row
from slviewer.examination.light import look_at
from slviewer.fringe.decode import texture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.vectors import box_middle
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, track
from slviewer.pipeline.poses import DecodedPose, Judged, read_pose
from slviewer.records.verdict import Cause
from slviewer.simulation.boards import FLAT, BoardShape, Pose, printed_board
from slviewer.simulation.plans import rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.target.board import Board
from tests.proofs.hostile_frames import Frames, delay_frames, drop_frame
from tests.proofs.hostile_scenes import set_gamma
from tests.proofs.proof import Proof

BOARD = Board.parse("circles:21x16:9")
BOARDS = (
    BOARD,
    Board.parse("circles:14x11:13"),
    Board.parse("circles:17x13:11"),
    Board.parse("chessboard:10x7:18"),
)
"""That calibrations without a fault are made from in turn."""
POSES, CLEAN = 8, 20
"""Poses of a calibration, and calibrations without a fault."""
EVERY = 5
"""Poses that a fault of every one of them is put into; more would show the same."""
MANY = 18
"""Poses from which those that reach a corner are taken away."""
FrameChange = Callable[[Frames], Frames]


@dataclass(frozen=True, eq=False)
class FaultBench:
    """A rig, a board, and its captures, each rendered and examined when it is first needed."""

    rig: SimulatedRig
    board: Board = BOARD
    count: int = POSES
    shape: BoardShape = FLAT
    steps: int = 18
    _frames: dict[int, Frames] = field(default_factory=dict, init=False, repr=False)
    _examined: dict[int, Judged] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def sequence(self) -> PatternSequence:
        """The Letter's, of so many phase steps: as many frames along x as along y."""
        return p18(self.rig.projector.size, self.steps)

    @cached_property
    def poses(self) -> list[Pose]:
        """Target poses that reach the image's corners."""
        return target_poses(self.rig, self.board, self.count)

    def frames(self, i: int) -> Frames:
        """Return the frames (n, h, w) uint8 of the i-th pose without a fault, cached."""
        if i not in self._frames:
            self._frames[i] = self.render(self.poses[i], i)
        return self._frames[i]

    def render(
        self, pose: Pose, seed: int, exposure: float = 1.0, reverse: Axis | None = None
    ) -> Frames:
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
        frames: Frames,
        sequence: PatternSequence | None = None,
        board: Board | None = None,
    ) -> Judged:
        """Read a capture with its evidence; ``sequence`` and ``board`` as described to the
        program."""
        name, sequence, board = f"pose_{i + 1:02d}", sequence or self.sequence, board or self.board
        look = look_at(sequence, frames)
        phases = decode_frames(name, sequence, frames, look.light)
        pose = DecodedPose(name, sequence, look, phases, texture(sequence, frames), board)
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

    def attempt_clean(self, count: int | None = None) -> DiagnosedCalibration:
        """The calibration from all captures, or the first ``count``, without a fault."""
        return self.attempt(self.examine_clean(count))

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

    def attempt_with(self, i: int, frames: Frames) -> DiagnosedCalibration:
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


def _describe_board(bench: FaultBench, **size: Any) -> DiagnosedCalibration:
    """The diagnosed calibration with a described board of other columns or rows than the captured
    one."""
    return bench.attempt_disturbed(board=replace(bench.board, **size))


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


def _tilt_boards_alike(
    bench: FaultBench, tilt_deg: float, spread_deg: float
) -> DiagnosedCalibration:
    """The diagnosed calibration from boards that are all tilted alike, within ``spread_deg``."""
    rng = np.random.default_rng(5)
    middle = box_middle(bench.board.points)
    captures = []
    for i in range(FEW_POSES):  # fewer would be a fault of its own
        pose = bench.poses[i]
        R = rotation(np.radians([tilt_deg, 0, 0]) + np.radians(spread_deg) * rng.uniform(-1, 1, 3))
        place = pose.to_camera(middle) * [0.7, 0.7, 1]
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


FAULTS: Mapping[str, tuple[Cause, Callable[[FaultBench], DiagnosedCalibration]]] = {
    "x and y frames exchanged": (
        "axes-swapped",
        # as many frames of one axis as of the other
        lambda bench: bench.attempt_disturbed(lambda frames: delay_frames(frames, len(frames) / 2)),
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
    "board of 20x16 given": ("board-size", partial(_describe_board, columns=20)),
    "board of 21x15 given": ("board-size", partial(_describe_board, rows=15)),
    "board of 22x16 given": ("board-size", partial(_describe_board, columns=22)),
    "board transposed in one pose": (
        "board-numbering",
        partial(_renumber_features, order=np.transpose),
    ),
    "board shifted by a row in one pose": (
        "board-numbering",
        partial(_renumber_features, order=partial(np.roll, shift=1, axis=0)),
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
    "gamma 2.2": (
        "gamma",
        lambda bench: replace(bench, rig=set_gamma(bench.rig, 2.2, 0)).attempt_disturbed(),
    ),
    "boards facing the camera": (
        "parallel-poses",
        lambda bench: _tilt_boards_alike(bench, 0.0, 0.7),
    ),
    "boards tilted alike": ("parallel-poses", lambda bench: _tilt_boards_alike(bench, 20.0, 3.0)),
    "no pose in one corner": ("empty-corner", _avoid_corner),
    "two poses": ("too-few-poses", lambda bench: bench.attempt_clean(2)),
    "four poses": ("too-few-poses", lambda bench: bench.attempt_clean(4)),
}
"""{fault: (the cause that must be named first, the calibration with it)}."""


def prove_causes(scale: float, seed: int, progress: Progress) -> Proof:
    """Every fault in turn, then ``CLEAN`` calibrations of different rigs, poses and boards.

    ``scale``: resolution of the camera, as a share of the Letter's. A fault passes where the first
    finding is its cause, a clean calibration where there is none.
    """
    bench = FaultBench(letter(scale, seed), count=POSES)
    cases: dict[str, tuple[Cause | None, Callable[[], DiagnosedCalibration]]] = {
        name: (cause, partial(attempt, bench)) for name, (cause, attempt) in FAULTS.items()
    }
    for k in range(CLEAN):
        board, count, rig_seed = BOARDS[k % len(BOARDS)], POSES + k % 5, seed + 1 + k
        shape = BoardShape(misplaced_mm=0.01 * (k % 3))
        sound = FaultBench(letter(scale, rig_seed), board, count, shape)
        cases[f"clean, seed {rig_seed}, {board}, {count} poses"] = (None, sound.attempt_clean)
    rows: list[Row] = []
    record = []
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    for name, (cause, attempt), _ in track(progress, cases):
        start = perf_counter()
        verdict = attempt().verdict
        first = next(iter(verdict.causes), "none")
        confusion[cause or "none"][first] += 1
        rows.append({
            "fault": name,
            "cause": cause or "none",
            "named": ", ".join(verdict.causes) or "none",
            "verdict": verdict.level,
            "right": "yes" if first == (cause or "none") else "NO",
            "s": round(perf_counter() - start, 1),
        })  # fmt: skip
        record.append({
            "fault": name, "cause": cause, "causes": list(verdict.causes), "level": verdict.level,
            "reason": verdict.reason,
            "findings": [finding.observation for finding in verdict.findings],
        })  # fmt: skip
    right = sum(row["right"] == "yes" for row in rows)
    line = f"{right} of {len(rows)} named rightly, at scale {scale:g}"
    return Proof(
        right == len(rows), scale, rows, {"confusion": confusion, "cases": record}, below=[line]
    )
