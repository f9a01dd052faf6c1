"""Whether suggested poses, followed with a hand-held board, lead to the noise floor, on simulated
rigs."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from time import perf_counter

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.rigid import move_points, transform_from_rvec
from slviewer.geometry.shapes import fit_plane
from slviewer.geometry.vectors import box_middle, rms
from slviewer.pipeline.feedback import Progress, part
from slviewer.pipeline.simulate import TARGET
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import planes, rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.truth import PerfectModel
from slviewer.target.board import Board
from slviewer.validation.proof import Proof, track
from slviewer.validation.rendered_calibration import (
    calibrate_observed,
    observe_rendered,
    render_phase,
)
from slviewer.wizard.pose_plan import PlanInput, PoseFeatures, plan_next_pose

BOARD = Board.parse(TARGET)
POSES, RIGS = 12, 5
MOST_OVER_FLOOR, LEAST_SUPPORTED = 1.3, 0.85
HAND_MM, HAND_DEG = 3.0, 2.0
"""Unsteadiness of a hand that holds a board: standard deviations along and about each axis."""
_TRIES = 50
_WAYS = ("guided", "random")


@dataclass(frozen=True)
class WayFigures:
    """One rig calibrated from ``poses`` chosen in one ``way``, by plane: RMS of the model and of
    the true rig over the same illuminated pixels, mm, and the share of these that poses support;
    ``unmeasured`` pixels of all planes.
    """

    way: str
    seed: int
    poses: int
    rms_mm: tuple[float, ...]
    floor_mm: tuple[float, ...]
    supported: tuple[float, ...]
    unmeasured: int
    predicted_sigma_mm: float | None
    over_floor: float
    seconds: float


def prove_guidance(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate each of ``RIGS`` simulated rigs from ``POSES`` guided poses, and from as many drawn
    at random as the Letter's were; measure the Letter's ten planes with both.
    """
    figures: list[WayFigures] = []
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
        rms, floor, supported, unmeasured = zip(
            *(_measure_plane(model, t) for t in targets), strict=True
        )
        over_floor = fmean(rms) / fmean(floor)
        seconds = perf_counter() - start
        figures.append(
            WayFigures(way, rig_seed, len(observations), rms, floor, supported, sum(unmeasured),
            predicted,
                       over_floor, seconds)
        )  # fmt: skip
    return judge_guidance(figures, scale)


def judge_guidance(figures: Sequence[WayFigures], scale: float) -> Proof:
    """The proof: whether guided poses reach the floor and support the planes, in the mean over the
    rigs."""
    rows = [
        {
            "poses": f"{each.poses} {each.way}",
            "seed": each.seed,
            "RMS mm": fmean(each.rms_mm),
            "floor mm": fmean(each.floor_mm),
            "over floor": each.over_floor,
            "worst plane": float(np.max(np.divide(each.rms_mm, each.floor_mm))),
            "supported %": 100 * fmean(each.supported),
            "not measured": each.unmeasured,
            "s": round(each.seconds, 1),
        }
        for each in figures
    ]
    means = {
        way: np.mean(
            [(each.over_floor, fmean(each.supported)) for each in figures if each.way == way],
            axis=0,
        )
        for way in _WAYS
    }
    lines = [
        f"{way}: {over:.2f} times the floor, {100 * share:.0f} % supported"
        for way, (over, share) in means.items()
    ]
    over, share = means["guided"]
    holds = bool(over <= MOST_OVER_FLOOR and share >= LEAST_SUPPORTED)
    wanted = (
        f"wanted of guided poses: at most {MOST_OVER_FLOOR:g} times, at least"
        f" {100 * LEAST_SUPPORTED:g} %"
    )
    lines.append(f"{wanted}: {'reached' if holds else 'NOT reached'}")
    return Proof(holds, scale, rows, {"outcomes": figures}, below=lines)


def _observe_random(rig: SimulatedRig, report: Progress) -> tuple[list[Observation], None]:
    """The observations of poses drawn at random like the Letter's; undetected ones are skipped."""
    observations = [
        _observe_pose(rig, pose, i, part(report, 0.9 * i / POSES, 0.9))
        for i, pose in enumerate(target_poses(rig, BOARD, POSES))
    ]
    return [each for each in observations if each is not None], None


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
        observation = _observe_pose(
            rig, pose, i, part(report, 0.9 * len(observations) / POSES, 0.9)
        )
        if observation is None:
            refused += 1
        else:
            observations.append(observation)


def _observe_pose(
    rig: SimulatedRig, pose: Pose, number: int, report: Progress
) -> Observation | None:
    """Render the board at a pose and observe it; None if it was not detected."""
    report(0.0, f"pose {number + 1}")
    try:
        return observe_rendered(
            rig, printed_board(BOARD, pose, seed=rig.seed), f"pose_{number + 1:02d}", number
        )
    except InputError:
        return None


def _extract_features(observation: Observation) -> PoseFeatures:
    """Features of one observation, and its median phase noise; NaN where that is unknown."""
    noise = (
        np.nan if observation.samples is None else float(np.nanmedian(observation.samples.sigma))
    )
    return PoseFeatures(observation.points, observation.camera, observation.projector, noise)


def _solve_suggested_pose(rig: SimulatedRig, outline_px: np.ndarray) -> np.ndarray:
    """T_camera_board (4, 4) at which the board fills an outline (4, 2) px that is drawn into the
    picture: what a hand follows, whatever the program believes of the lens."""
    rays = rig.camera.undistort(outline_px)
    _, turn, t = cv2.solvePnP(
        BOARD.outline(), rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    return transform_from_rvec(turn, t)


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


@dataclass(frozen=True, eq=False)
class _TargetPlane:
    """A plane's phase, illuminated pixels (h, w), and the points (h, w, 3) mm that the true rig
    measures there."""

    phase: PhaseMap
    illuminated: np.ndarray
    exact: np.ndarray


def _render_plane(rig: SimulatedRig, name: str, number: int) -> _TargetPlane:
    """A rendered scan of the plane ``name``, whose noise ``number`` seeds, and its true points."""
    renderer = Renderer(rig, planes()[name])
    phase = render_phase(renderer, name, number)
    exact = PerfectModel(rig).points(phase)
    return _TargetPlane(
        phase, renderer.truth().mask & phase.mask & np.isfinite(exact[..., 2]), exact
    )


def _measure_plane(model: SplinedModel, target: _TargetPlane) -> tuple[float, float, float, int]:
    """Plane RMS in mm by the model and by the true rig over the same illuminated pixels, the share
    that poses support, and the number of pixels that the model does not measure at all."""
    points = model.points(target.phase, supported=False)
    known = target.illuminated & np.isfinite(points[..., 2])
    supported = model.support(target.phase) & target.illuminated
    return (
        _compute_plane_rms(points[known]),
        _compute_plane_rms(target.exact[known]),
        float(supported.sum() / target.illuminated.sum()),
        int((target.illuminated & ~known).sum()),
    )


def _compute_plane_rms(points: np.ndarray) -> float:
    """Plane RMS in mm over all points (n, 3), outliers included."""
    points = points.astype(float)
    return rms(fit_plane(points).distance(points))
