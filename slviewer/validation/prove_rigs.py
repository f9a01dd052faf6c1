"""One simulated rig calibrated with every model, and what each then measures of the Letter's planes and spheres.

All of it happens in memory, one capture after another: a full-size session of so many would fill a disk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from time import perf_counter
from typing import Literal

import numpy as np

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.observe import Observation, observe
from slviewer.calibration.pixelwise import calibrate_pixelwise
from slviewer.calibration.splined.model import calibrate_splined
from slviewer.errors import InputError
from slviewer.evaluation.compare import Comparison, compare
from slviewer.evaluation.letter import DEPTH_RANGE_MM, SPHERE_RADIUS_MM
from slviewer.evaluation.plane import evaluate_plane
from slviewer.evaluation.sphere import SphereResult, evaluate_sphere
from slviewer.fringe.decode import texture
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.pipeline.simulate import TARGET
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import Model
from slviewer.simulation.boards import BoardShape
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene, Spheres
from slviewer.simulation.truth import PerfectModel
from slviewer.target.board import Board
from slviewer.target.detect import detect

COVERED = 6
"""Poses that a pixel must have seen the board in to be scored."""
FLOOR = PerfectModel.name
JUDGED = ("stereo", "splined", FLOOR)
"""Scored over the pixels that all three measure; other models over those of them that they measure too."""


@dataclass(frozen=True)
class RigCase:
    """A simulated rig of the Letter's kind, and the board that it is calibrated with."""

    name: str
    seed: int = 0
    fine: bool = False
    local_distortion_px: float | None = None
    shape: BoardShape = field(default_factory=BoardShape)

    def rig(self, scale: float) -> SimulatedRig:
        """At so many times the Letter's resolution."""
        texture: Literal["coarse", "fine"] = "fine" if self.fine else "coarse"
        return letter(scale, self.seed, local_distortion_px=self.local_distortion_px, texture=texture)


BENT = BoardShape(bow_x_mm=0.1, bow_y_mm=0.1, twist_mm=0.05, misplaced_mm=0.02)


def cases(seed: int = 0) -> tuple[RigCase, ...]:
    """The default rig and five others; another seed makes six others of the same kinds."""
    return (
        RigCase("coarse", seed),
        RigCase("fine", seed + 1, fine=True),
        RigCase("coarse, bent board", seed + 2, shape=BENT),
        RigCase("fine and strong, bent board", seed + 3, fine=True, local_distortion_px=0.2, shape=BENT),
        RigCase("coarse again", seed + 4),
        RigCase("none", seed + 5, local_distortion_px=0.0),
    )


@dataclass(frozen=True)
class PlaneFigures:
    """``region``: where most of the plane lies. ``rms_mm`` by model, the floor included; ``predicted_mm``: the floor as
    the splined model predicts it. ``kept``: share of the pixels to be scored that the splined model measures."""

    region: str
    rms_mm: Mapping[str, float]
    predicted_mm: float
    pixels: int
    kept: float


@dataclass(frozen=True)
class RigFigures:
    """What one rig came to: planes by name, and errors in mm by model, of spheres' radii and of the spacings of their
    centres. ``seconds`` by stage."""

    case: RigCase
    planes: Mapping[str, PlaneFigures]
    radius_mm: Mapping[str, Mapping[str, float]]
    spacing_mm: Mapping[str, Mapping[str, float]]
    seconds: Mapping[str, float]

    def mean_mm(self, model: str, region: str | None = None) -> float:
        """Mean plane RMS of a model, of one region or of all; NaN where no plane lies there."""
        chosen = [p.rms_mm[model] for p in self.planes.values() if region in (None, p.region)]
        return float(np.mean(chosen)) if chosen else float("nan")

    @property
    def predicted_mm(self) -> float:
        """Mean of the predicted floors."""
        return float(np.mean([p.predicted_mm for p in self.planes.values()]))


def measure_rig(case: RigCase, scale: float, poses: int, progress: Progress = ignore_progress) -> RigFigures:
    """Calibrate a rig from ``poses`` rendered captures of its board, and measure ten planes and six spheres with it."""
    rig = case.rig(scale)
    board = Board.parse(TARGET)
    plan = letter_plan(rig, board, poses, case.shape)
    both = p18(rig.projector.size)
    numbers = {name: i for i, name in enumerate(plan)}
    targets = {name: scene for name, scene in plan.items() if name.startswith("pose_")}
    shapes = {name: scene for name, scene in plan.items() if name.startswith(("plane_", "sphere_"))}
    total = len(targets) + len(shapes)
    begun = perf_counter()
    observations: list[Observation] = []
    for name, scene in targets.items():
        progress(0.8 * len(observations) / total, f"{case.name}: {name}")
        observations.append(observe_scene(name, rig, scene, board, both, numbers[name]))
    rendered = perf_counter()
    progress(0.8 * len(targets) / total, f"{case.name}: calibrating")
    stereo, observations = calibrate_centres(observations, rig.projector.size, TARGET)
    models: dict[str, Model] = {"stereo": stereo}
    models["pixelwise"] = calibrate_pixelwise(observations, stereo)
    adjusting = perf_counter()
    models["splined"] = calibrate_splined(observations, stereo)
    adjusted = perf_counter()
    models[FLOOR] = PerfectModel(rig)
    covered = covered_pixels(observations)
    only_x = one_axis(both, "x")
    found: dict[str, Comparison] = {}
    kept: dict[str, float] = {}
    for i, (name, scene) in enumerate(shapes.items()):
        progress(0.2 + 0.8 * (len(targets) + i) / total, f"{case.name}: {name}")
        phase = decode_frames(name, only_x, Renderer(rig, scene).capture(only_x, numbers[name]))["x"]
        found[name], kept[name] = scored(models, phase, covered, isinstance(scene, Spheres))
    measured = perf_counter()
    return RigFigures(
        case,
        {name: _plane(found[name], kept[name]) for name in shapes if name.startswith("plane_")},
        *_round(found, {name: scene for name, scene in shapes.items() if isinstance(scene, Spheres)}),
        {
            "rendering and reading": rendered - begun,
            "splined": adjusted - adjusting,
            "measuring": measured - adjusted,
            "in all": measured - begun,
        },
    )


def covered_pixels(observations: Sequence[Observation]) -> np.ndarray:
    """(h, w) bool: the camera's pixels that saw the board in as many poses as scoring asks for."""
    width, height = observations[0].size
    poses = np.zeros((height, width), int)
    for o in observations:
        u0, v0, u1, v1 = o.box
        poses[v0:v1, u0:u1] += o.region
    return np.asarray(poses >= COVERED)


def scored(
    models: Mapping[str, Model], phase: PhaseMap, covered: np.ndarray, is_round: bool
) -> tuple[Comparison, float]:
    """Every model's fit to one capture over the covered pixels, and the share of these that splined measures."""
    clouds = {}
    for name, model in models.items():
        points = model.points(phase)
        sigma = model.sigma_z(phase, points)
        clouds[name] = Cloud(np.where(covered[..., None], points, np.float32(np.nan)), phase.axis, name, sigma)
    judged = {name: clouds[name] for name in JUDGED}
    comparison = compare(
        "sphere" if is_round else "plane",
        judged,
        phase.illuminated,
        depth_range=DEPTH_RANGE_MM,
        radius=SPHERE_RADIUS_MM if is_round else None,
    )
    found = comparison.results["splined"]
    for name in [name for name in clouds if name not in JUDGED]:
        points, sigma = clouds[name].points, clouds[name].sigma_z
        try:
            comparison.results[name] = (
                evaluate_sphere(points, comparison.common, sigma, SPHERE_RADIUS_MM, found.sphere)
                if isinstance(found, SphereResult)
                else evaluate_plane(points, comparison.common, sigma, found.plane)
            )
        except InputError:
            continue  # it measures nothing there
    to_score = int(np.count_nonzero(comparison.region & clouds["stereo"].mask & clouds[FLOOR].mask))
    return comparison, int(np.count_nonzero(comparison.common)) / max(to_score, 1)


def observe_scene(
    name: str, rig: SimulatedRig, scene: Scene, board: Board, sequence: PatternSequence, number: int
) -> Observation:
    """The observation of a rendered target pose, the capture of that number of its rig."""
    frames = Renderer(rig, scene).capture(sequence, number)
    return observe(name, board, detect(board, texture(sequence, frames)), decode_frames(name, sequence, frames))


def _plane(comparison: Comparison, kept: float) -> PlaneFigures:
    shares = comparison.incidence or {}
    splined = comparison.results["splined"]
    return PlaneFigures(
        max(shares, key=lambda region: shares[region]),
        {name: result.rms_mm for name, result in comparison.results.items()},
        splined.noise_floor_mm,
        splined.points,
        kept,
    )


def _round(
    found: Mapping[str, Comparison], scenes: Mapping[str, Spheres]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Errors of the radii and of the spacings, mm, by model."""
    radii: dict[str, dict[str, float]] = {}
    centres: dict[str, dict[str, np.ndarray]] = {}
    for name, scene in scenes.items():
        for model, result in found[name].results.items():
            assert isinstance(result, SphereResult)
            radii.setdefault(model, {})[name] = result.radius_mm - scene.radius_mm
            centres.setdefault(model, {})[name] = result.sphere.centre
    gaps: dict[str, dict[str, float]] = {}
    for model, places in centres.items():
        for a, b in combinations(places, 2):
            known = float(np.linalg.norm(scenes[a].centres[0] - scenes[b].centres[0]))
            gaps.setdefault(model, {})[f"{a} - {b}"] = float(np.linalg.norm(places[a] - places[b])) - known
    return radii, gaps
