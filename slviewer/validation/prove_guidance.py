"""Whether a newcomer who follows the suggestions ends at the noise floor: in simulated rigs, held as a hand would."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.errors import InputError
from slviewer.evaluation.render import render
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.shapes import fit_plane
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.feedback import Progress, ignore_progress, part
from slviewer.records import to_plain
from slviewer.simulation.boards import Pose
from slviewer.simulation.plans import planes, rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.truth import PerfectModel
from slviewer.target.board import Board
from slviewer.validation.faulty_captures import BOARD, FaultBench
from slviewer.wizard.pose_plan import PlanInput, PoseFeatures, plan

POSES, RIGS = 12, 5
MOST_OVER_FLOOR, LEAST_SUPPORTED = 1.3, 0.85
HAND_MM, HAND_DEG = 3.0, 2.0
"""How far from a suggestion a hand holds a board: standard deviations along and about each axis."""
_TRIES = 50


@dataclass(frozen=True)
class Outcome:
    """Of one rig and one way to choose poses: mean plane RMS over all lit pixels of the ten planes and of the true rig
    mm, and the share of those pixels that poses support; then each plane's."""

    way: str
    seed: int
    poses: int
    rms_mm: tuple[float, ...]
    floor_mm: tuple[float, ...]
    supported: tuple[float, ...]
    unmeasured: int
    predicted_sigma_mm: float
    seconds: float

    @property
    def over_floor(self) -> float:
        """Mean RMS of the planes over their mean floor."""
        return float(np.mean(self.rms_mm) / np.mean(self.floor_mm))

    @property
    def share(self) -> float:
        """Of the illuminated pixels that are supported, in the mean over the planes."""
        return float(np.mean(self.supported))


@dataclass(frozen=True)
class GuidanceProof:
    """What came of all rigs."""

    outcomes: tuple[Outcome, ...]
    scale: float

    def mean(self, way: str) -> tuple[float, float]:
        """(RMS over the floor, share supported), in the mean over the rigs."""
        chosen = [o for o in self.outcomes if o.way == way]
        return float(np.mean([o.over_floor for o in chosen])), float(np.mean([o.share for o in chosen]))

    @property
    def holds(self) -> bool:
        """Whether guided poses reach the target."""
        over, share = self.mean("guided")
        return over <= MOST_OVER_FLOOR and share >= LEAST_SUPPORTED

    def text(self) -> str:
        """For people: a line a rig and way."""
        table: list[dict[str, Any]] = [
            {
                "poses": f"{o.poses} {o.way}",
                "seed": o.seed,
                "RMS mm": float(np.mean(o.rms_mm)),
                "floor mm": float(np.mean(o.floor_mm)),
                "over floor": o.over_floor,
                "worst plane": float(np.max(np.divide(o.rms_mm, o.floor_mm))),
                "supported %": 100 * o.share,
                "not measured": o.unmeasured,
                "s": round(o.seconds, 1),
            }
            for o in self.outcomes
        ]
        lines = []
        for way in dict.fromkeys(o.way for o in self.outcomes):
            over, share = self.mean(way)
            lines.append(f"{way}: {over:.2f} times the floor, {100 * share:.0f} % supported")
        wanted = f"wanted of guided poses: at most {MOST_OVER_FLOOR:g} times, at least {100 * LEAST_SUPPORTED:g} %"
        return "\n".join([render(table), *lines, f"{wanted}: {'reached' if self.holds else 'NOT reached'}"])

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scale": self.scale,
            "holds": self.holds,
            "outcomes": [to_plain(o) | {"over_floor": o.over_floor} for o in self.outcomes],
        }


def prove_guidance(
    scale: float = 1.0,
    *,
    rigs: int = RIGS,
    poses: int = POSES,
    steps: int = 18,
    seed: int = 0,
    ways: Sequence[str] = ("guided", "random"),
    progress: Progress = ignore_progress,
) -> GuidanceProof:
    """``rigs`` simulated rigs, each calibrated from so many guided ``poses``, and from as many that are drawn at random
    as the Letter's were; measured on the Letter's ten planes.
    """
    outcomes: list[Outcome] = []
    total = rigs * len(ways)
    for k in range(rigs):
        bench = FaultBench(letter(scale, seed + k), BOARD, poses, steps=steps)
        targets = _targets(bench)
        for way in ways:
            label = f"rig {k + 1} of {rigs}, {way}"
            report = part(progress, len(outcomes) / total, (len(outcomes) + 1) / total, label)
            begun = perf_counter()
            observations, predicted = _guided(bench, report) if way == "guided" else (_drawn(bench, report), np.nan)
            report(0.9, "calibrating")
            stereo, centred = calibrate_centres(observations, bench.rig.projector.size, str(BOARD))
            figures = _measured(calibrate_splined(centred, stereo), targets)
            outcomes.append(
                Outcome(way, bench.rig.seed, len(observations), *figures, predicted, perf_counter() - begun)
            )
    progress(1.0, "proven")
    return GuidanceProof(tuple(outcomes), scale)


def _drawn(bench: FaultBench, report: Progress) -> list[Observation]:
    seen = []
    for i, pose in enumerate(target_poses(bench.rig, BOARD, bench.count)):
        report(0.9 * i / bench.count, f"pose {i + 1}")
        observation = bench.examine(i, bench.render(pose, i)).observation
        if observation is not None:
            seen.append(observation)
    return seen


def _guided(bench: FaultBench, report: Progress) -> tuple[list[Observation], float]:
    """Poses where the wizard asks for them, and the sigma that it predicts in the end."""
    rig, board = bench.rig, bench.board
    rng = np.random.default_rng([rig.seed, 0x6D])
    seen: list[Observation] = []
    refused = 0
    while True:
        features = {o.name: _features(o) for o in seen}
        planned = plan(PlanInput(board, rig.camera.size, rig.projector.size, features, refused=refused))
        if len(seen) == bench.count:
            return seen, np.nan if planned.sigma_mm is None else planned.sigma_mm
        i = len(seen) + refused
        report(0.9 * len(seen) / bench.count, f"pose {len(seen) + 1}")
        if planned.suggestion is None or refused > bench.count:
            raise InputError(f"{refused} of {i} suggested poses could not be read, at {rig.camera.size} px")
        pose = _held(rig, board, _asked(rig, board, planned.suggestion.outline_px), rng)
        observation = bench.examine(i, bench.render(pose, i)).observation
        if observation is None:
            refused += 1
        else:
            seen.append(observation)


def _features(seen: Observation) -> PoseFeatures:
    noise = np.nan if seen.samples is None else float(np.nanmedian(seen.samples.sigma))
    return PoseFeatures(seen.points, seen.camera, seen.projector, noise)


def _asked(rig: SimulatedRig, board: Board, outline_px: np.ndarray) -> np.ndarray:
    """T_camera_board (4, 4) at which the board fills an outline (4, 2) px that is drawn into the picture: what a hand
    follows, whatever the program believes of the lens."""
    rays = rig.camera.undistort(outline_px)
    _, turn, t = cv2.solvePnP(board.outline(), rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], t.ravel()
    return T


def _held(rig: SimulatedRig, board: Board, T: np.ndarray, rng: np.random.Generator) -> Pose:
    """About there, with every feature in view: a hand moves the board until the program says that it sees it."""
    middle = (board.points.min(0) + board.points.max(0)) / 2
    centre = T[:3, :3] @ middle + T[:3, 3]
    for k in range(_TRIES):
        steady = 1 - k / _TRIES
        R = rotation(np.radians(steady * rng.normal(0, HAND_DEG, 3))) @ T[:3, :3]
        pose = Pose(R, centre + steady * rng.normal(0, HAND_MM, 3) - R @ middle)
        points = pose.to_camera(board.points)
        seen, illuminated = rig.camera.project(points), rig.project(points)
        room = board.pitch_mm / 4 * rig.camera.focal_px[0] * rig.camera.scale / points[:, 2:] + 2
        inside = ((seen > room) & (seen < np.array(rig.camera.size) - 1 - room)).all()
        if inside and ((illuminated > 0) & (illuminated < np.array(rig.projector.size) - 1)).all():
            break
    return pose


@dataclass(frozen=True, eq=False)
class _Target:
    """A plane's phase, illuminated pixels (h, w), and the points (h, w, 3) that the true rig measures there."""

    phase: PhaseMap
    illuminated: np.ndarray
    exact: np.ndarray


def _targets(bench: FaultBench) -> list[_Target]:
    rig, found = bench.rig, []
    sequence = one_axis(bench.sequence, "x")
    for i, (name, scene) in enumerate(planes().items()):
        renderer = Renderer(rig, scene)
        truth = renderer.truth()
        phase = decode_frames(name, sequence, renderer.capture(sequence, 100 + i))["x"]
        exact = PerfectModel(rig).points(phase)
        found.append(_Target(phase, truth.mask & phase.mask & np.isfinite(exact[..., 2]), exact))
    return found


def _measured(
    model: SplinedModel, targets: Sequence[_Target]
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], int]:
    """Plane RMS by the model and by the true rig, over the same lit pixels, the share that poses support, and the
    pixels that the model does not measure at all."""
    rms, floor, supported = [], [], []
    unmeasured = 0
    for target in targets:
        points = model.points(target.phase, supported=False)
        known = target.illuminated & np.isfinite(points[..., 2])
        unmeasured += int(np.count_nonzero(target.illuminated & ~known))
        rms.append(_flatness(points[known]))
        floor.append(_flatness(target.exact[known]))
        supported.append(
            np.count_nonzero(model.support(target.phase) & target.illuminated) / np.count_nonzero(target.illuminated)
        )
    return tuple(rms), tuple(floor), tuple(supported), unmeasured


def _flatness(points: np.ndarray) -> float:
    """Plane RMS mm over all points, outliers included but for errors of whole fringes."""
    plane = fit_plane(points.astype(float))
    return float(np.sqrt(np.mean(plane.distance(points.astype(float)) ** 2)))
