"""Whether suggested poses, followed with a hand-held board, lead to the noise floor, on simulated
rigs."""

from contextlib import suppress
from statistics import fmean
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.board_pose import solve_pose
from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.evaluation.render import Row
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.rigid import move_points
from slviewer.geometry.shapes import fit_plane
from slviewer.geometry.vectors import box_middle, rms
from slviewer.pipeline.operation import Progress, track
from slviewer.pipeline.simulate import TARGET
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import planes, rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.target.board import Board
from slviewer.wizard.pose_plan import PlanInput, PoseFeatures, plan_next_pose
from tests.perfect_model import PerfectModel
from tests.proofs.proof import Proof
from tests.rendered_calibration import (
    calibrate_observed,
    observe_rendered,
    render_phase,
)

BOARD = Board.parse(TARGET)
POSES, RIGS = 12, 5
MOST_OVER_FLOOR, LEAST_SUPPORTED = 1.3, 0.85
HAND_MM, HAND_DEG = 3.0, 2.0
"""Unsteadiness of a hand that holds a board: standard deviations along and about each axis."""
_TRIES = 50
_WAYS = ("guided", "random")


def prove_guidance(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate each of ``RIGS`` simulated rigs from ``POSES`` guided poses, and from as many drawn
    at random as the Letter's were; measure the Letter's ten planes with both. It holds where guided
    poses reach the floor and support the planes, in the mean over the rigs.
    """
    rows: list[Row] = []
    outcomes: list[dict[str, Any]] = []
    ways = {f"rig {k + 1} of {RIGS}, {way}": (seed + k, way) for k in range(RIGS) for way in _WAYS}
    for _, (rig_seed, way), report in track(progress, ways):
        if way == _WAYS[0]:
            rig = letter(scale, rig_seed)
            targets = [_render_plane(rig, name, 100 + i) for i, name in enumerate(planes())]
        start = perf_counter()
        observe = _observe_guided if way == "guided" else _observe_random
        observations, predicted = observe(rig, report)
        report(0.9, "calibrating")
        model = calibrate_observed(rig, observations)[1]
        measured = [_measure_plane(model, *target) for target in targets]
        rms_mm, floor_mm, supported, unmeasured = zip(*measured, strict=True)
        over_floor = fmean(rms_mm) / fmean(floor_mm)
        seconds = perf_counter() - start
        outcomes.append({
            "way": way, "seed": rig_seed, "poses": len(observations), "rms_mm": rms_mm,
            "floor_mm": floor_mm, "supported": supported, "unmeasured": sum(unmeasured),
            "predicted_sigma_mm": predicted, "over_floor": over_floor, "seconds": seconds,
        })  # fmt: skip
        rows.append({
            "poses": f"{len(observations)} {way}",
            "seed": rig_seed,
            "RMS mm": fmean(rms_mm),
            "floor mm": fmean(floor_mm),
            "over floor": over_floor,
            "worst plane": float(np.max(np.divide(rms_mm, floor_mm))),
            "supported %": 100 * fmean(supported),
            "not measured": sum(unmeasured),
            "s": round(seconds, 1),
        })  # fmt: skip
    means = {
        way: np.mean(
            [(o["over_floor"], fmean(o["supported"])) for o in outcomes if o["way"] == way], axis=0
        )
        for way in _WAYS
    }
    lines = [
        f"{way}: {over:.2f} times the floor, {100 * share:.0f} % supported"
        for way, (over, share) in means.items()
    ]
    over, share = means["guided"]
    holds = bool(over <= MOST_OVER_FLOOR and share >= LEAST_SUPPORTED)
    lines.append(
        f"wanted of guided poses: at most {MOST_OVER_FLOOR:g} times, at least"
        f" {100 * LEAST_SUPPORTED:g} %: {'reached' if holds else 'NOT reached'}"
    )
    return Proof(holds, scale, rows, {"outcomes": outcomes}, below=lines)


def _observe_random(rig: SimulatedRig, report: Progress) -> tuple[list[Observation], None]:
    """The observations of poses drawn at random like the Letter's; undetected ones are skipped."""
    observations = []
    for i, pose in enumerate(target_poses(rig, BOARD, POSES)):
        report(0.9 * i / POSES, f"pose {i + 1}")
        with suppress(InputError):
            observations.append(_observe_pose(rig, pose, i))
    return observations, None


def _observe_guided(rig: SimulatedRig, report: Progress) -> tuple[list[Observation], float | None]:
    """The observations of poses that the wizard suggests, and the sigma in mm that it predicts at
    the end."""
    rng = np.random.default_rng([rig.seed, 0x6D])
    observations: list[Observation] = []
    refused = 0
    while True:
        features = {o.name: _extract_features(o) for o in observations}
        planned = plan_next_pose(
            PlanInput(BOARD, rig.camera.size, rig.projector.size, features, refused=refused)
        )
        if len(observations) == POSES:
            return observations, planned.sigma_mm
        i = len(observations) + refused
        if planned.suggestion is None or refused > POSES:
            raise InputError(
                f"{refused} of {i} suggested poses could not be read, at {rig.camera.size} px"
            )
        pose = _vary_pose(rig, _solve_suggested_pose(rig, planned.suggestion.outline_px), rng)
        report(0.9 * len(observations) / POSES, f"pose {i + 1}")
        try:
            observations.append(_observe_pose(rig, pose, i))
        except InputError:
            refused += 1


def _observe_pose(rig: SimulatedRig, pose: Pose, number: int) -> Observation:
    """Render the board at a pose and observe it; raises InputError if it was not detected."""
    scene = printed_board(BOARD, pose, seed=rig.seed)
    return observe_rendered(rig, scene, f"pose_{number + 1:02d}", number)


def _extract_features(observation: Observation) -> PoseFeatures:
    """Features of one observation, and its median phase noise; NaN where that is unknown."""
    samples = observation.samples
    noise = np.nan if samples is None else float(np.nanmedian(samples.sigma))
    return PoseFeatures(observation.points, observation.camera, observation.projector, noise)


def _solve_suggested_pose(rig: SimulatedRig, outline_px: np.ndarray) -> np.ndarray:
    """T_camera_board (4, 4) at which the board fills an outline (4, 2) px that is drawn into the
    picture: what a hand follows, whatever the program believes of the lens."""
    rays = rig.camera.undistort(outline_px)
    T = solve_pose(BOARD.outline(), rays, np.eye(3), np.zeros(5), cv2.SOLVEPNP_IPPE)
    assert T is not None
    return T


def _vary_pose(rig: SimulatedRig, T_camera_board: np.ndarray, rng: np.random.Generator) -> Pose:
    """Sample a pose near the given one with every feature in view, as a hand moves the board until
    it is detected."""
    middle = box_middle(BOARD.points)
    centre = move_points(T_camera_board, middle[None])[0]
    for k in range(_TRIES):
        steady = 1 - k / _TRIES
        R = rotation(np.radians(steady * rng.normal(0, HAND_DEG, 3))) @ T_camera_board[:3, :3]
        pose = Pose(R, centre + steady * rng.normal(0, HAND_MM, 3) - R @ middle)
        points = pose.to_camera(BOARD.points)
        camera_px, illuminated = rig.camera.project(points), rig.project(points)
        margin = BOARD.pitch_mm / 4 * rig.camera.focal_px[0] * rig.camera.scale / points[:, 2:] + 2
        inside = ((camera_px > margin) & (camera_px < np.array(rig.camera.size) - 1 - margin)).all()
        if inside and ((illuminated > 0) & (illuminated < np.array(rig.projector.size) - 1)).all():
            break
    return pose


def _render_plane(
    rig: SimulatedRig, name: str, number: int
) -> tuple[PhaseMap, np.ndarray, np.ndarray]:
    """The phase of a rendered scan of the plane ``name``, whose noise ``number`` seeds, illuminated
    pixels (h, w), and the points (h, w, 3) mm that the true rig measures there."""
    renderer = Renderer(rig, planes()[name])
    phase = render_phase(renderer, name, number)
    exact = PerfectModel(rig).points(phase)
    return phase, renderer.truth().mask & phase.mask & np.isfinite(exact[..., 2]), exact


def _measure_plane(
    model: SplinedModel, phase: PhaseMap, illuminated: np.ndarray, exact: np.ndarray
) -> tuple[float, float, float, int]:
    """Plane RMS in mm by the model and by the true rig over the same illuminated pixels, outliers
    included, the share that poses support, and the number of pixels that the model does not measure
    at all."""
    points = model.points(phase, supported=False)
    known = illuminated & np.isfinite(points[..., 2])
    measured = (each[known].astype(float) for each in (points, exact))
    own, floor = (rms(fit_plane(each).distance(each)) for each in measured)
    supported = model.support(phase) & illuminated
    return (
        own,
        floor,
        float(supported.sum() / illuminated.sum()),
        int((illuminated & ~known).sum()),
    )
