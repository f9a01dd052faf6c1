"""Whether two cameras measure at their noise floor, whatever the projector between them does."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from statistics import fmean
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation, observe
from slviewer.evaluation.fit import Comparison
from slviewer.fringe.decode import texture
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, part
from slviewer.pipeline.simulate import TARGET
from slviewer.reconstruction.camera_match import epipolar_lines, match_cameras
from slviewer.reconstruction.reconstruct import Model
from slviewer.records.verification import Shape
from slviewer.simulation.plans import letter_plan, rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene, Spheres
from slviewer.simulation.second_camera import second_camera
from slviewer.simulation.truth import PerfectModel
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.validation.proof import BandCheck, Proof, prove_checks, track
from slviewer.validation.prove_accuracy import FLOOR, compare_fits, covered_pixels
from slviewer.validation.rendered_calibration import (
    calibrate_observed,
    calibrate_rendered,
    scan_sequence,
)

POSES = 16
TURN_RAD = 0.001
"""By which the projector turns between calibration and scan."""
OVER_FLOOR = (0.9, 1.15)
"""Of the splined model's RMS over the floor, in the mean over the planes."""
SPACING_MM = 0.02
"""At half the resolution and above; below, fewer and coarser pixels determine a calibration."""
MUST_SHIFT_MM = 0.1
"""What the turn does to the spacings of one camera, at least: else nothing turned."""
Scan = Callable[[SimulatedRig, Scene, int], PhaseMap]


def prove_cameras(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate the Letter's rig with a second camera, and without; measure its planes and spheres
    with both, as it was calibrated and with the projector turned."""
    rig = letter(scale, seed)
    plan = letter_plan(rig, poses=POSES)
    turn = rotation(np.array([0.0, TURN_RAD, 0.0]))
    turned = replace(rig, R=turn @ rig.R, t=turn @ rig.t)
    pair = second_camera(rig).pair(rig)
    poses = {name: scene for name, scene in plan.items() if name.startswith("pose_")}
    observations = [
        observe_pair(rig, scene, name, i)
        for i, (name, scene, _) in enumerate(track(progress, poses, 0.0, 0.35))
    ]
    own = calibrate_observed(pair, observations)
    alone = calibrate_rendered(rig, plan, part(progress, 0.4, 0.6))

    def scan_pair(actual: SimulatedRig, scene: Scene, number: int) -> PhaseMap:
        """Return the second camera's columns, as scanned with a rig."""
        sequence = scan_sequence(rig)
        seen = decode_both(sequence, capture_both(actual, scene, sequence, number))
        return match_cameras(*seen, epipolar_lines(own[1]))["x"]

    def scan_alone(actual: SimulatedRig, scene: Scene, number: int) -> PhaseMap:
        """Return the projector's columns, as scanned with a rig."""
        sequence = scan_sequence(rig)
        frames = Renderer(actual, scene).capture(sequence, number)
        return decode_frames("scan", sequence, frames)["x"]

    cases: dict[str, tuple[SimulatedRig, Any, Scan, SimulatedRig]] = {
        "two cameras": (pair, own, scan_pair, rig),
        "two cameras, projector turned": (pair, own, scan_pair, turned),
        "one camera": (rig, alone, scan_alone, rig),
        "one camera, projector turned": (rig, alone, scan_alone, turned),
    }
    rows, checks = [], []
    most = SPACING_MM * max(1.0, 0.5 / scale) ** 2
    for name, (true, (stereo, splined, seen), scan, actual), report in track(
        progress, cases, 0.6, 1.0
    ):
        models = {"stereo": stereo, "splined": splined, FLOOR: PerfectModel(true)}
        row = measure_shapes(models, covered_pixels(seen), plan, partial(scan, actual), report)
        rows.append({"rig": name, **row})
        ratio, spacing = row["splined / floor"], row["worst spacing mm"]
        if name != "one camera, projector turned":
            checks.append(BandCheck(name, "splined over the floor", ratio, *OVER_FLOOR))
        if "turned" in name and "one" in name:
            checks.append(BandCheck(name, "a spacing's error, mm", spacing, MUST_SHIFT_MM, 100))
        elif "two" in name:
            checks.append(BandCheck(name, "a spacing's error, mm", spacing, 0, most))
    title = f"planes and spheres of the Letter at scale {scale:g}; the projector turned by 1 mrad"
    return prove_checks(checks, scale, rows, {"rigs": rows}, [title])


def capture_both(
    rig: SimulatedRig, scene: Scene, sequence: PatternSequence, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames (n, h, w) of both cameras; the second one follows from the rig's seed,
    wherever its projector is."""
    first = Renderer(rig, scene).capture(sequence, number)
    return first, second_camera(rig).capture(scene, sequence, number)


def decode_both(
    sequence: PatternSequence, frames: tuple[np.ndarray, np.ndarray]
) -> tuple[dict[Axis, PhaseMap], dict[Axis, PhaseMap]]:
    """Return the phases that both cameras decode."""
    first, second = frames
    return decode_frames("first", sequence, first), decode_frames("second", sequence, second)


def observe_pair(rig: SimulatedRig, scene: Scene, name: str, number: int) -> Observation:
    """The observation of a rendered target pose by both cameras, whose noise ``number`` seeds."""
    sequence, board = p18(rig.projector.size), Board.parse(TARGET)
    frames = capture_both(rig, scene, sequence, number)
    matched = match_cameras(*decode_both(sequence, frames))
    return observe(name, board, detect(board, texture(sequence, frames[0])), matched)


def measure_shapes(
    models: Mapping[str, Model],
    covered: np.ndarray,
    plan: Mapping[str, Scene],
    scan: Callable[[Scene, int], PhaseMap],
    progress: Progress,
) -> dict[str, float]:
    """Return the mean RMS of the planes by model, and the largest error of a spacing of spheres."""
    shapes = {key: scene for key, scene in plan.items() if key.startswith(("plane_", "sphere_"))}
    planes, centres = list[Comparison](), dict[str, tuple[Spheres, Comparison]]()
    for key, scene, _ in track(progress, shapes):
        shape: Shape = "sphere" if isinstance(scene, Spheres) else "plane"
        found, _ = compare_fits(models, scan(scene, [*plan].index(key)), covered, shape)
        if isinstance(scene, Spheres):
            centres[key] = scene, found
        else:
            planes.append(found)
    means = {name: fmean(each.results[name].rms_mm for each in planes) for name in models}
    errors = [
        math.dist(*(each.results["splined"].sphere.centre for each in (one, other)))
        - math.dist(a.centres[0], b.centres[0])
        for (a, one), (b, other) in combinations(centres.values(), 2)
    ]
    return {
        **means,
        "splined / floor": means["splined"] / means[FLOOR],
        "worst spacing mm": max(map(abs, errors)),
    }
