"""Whether two cameras measure at their noise floor, whatever the projector between them does."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation, observe
from slviewer.calibration.splined.model import SplinedModel, calibrate_projector
from slviewer.fringe.decode import texture
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.shapes import fit_plane
from slviewer.geometry.vectors import rms
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, part, track
from slviewer.pipeline.simulate import TARGET
from slviewer.reconstruction.camera_match import epipolar_lines, match_cameras
from slviewer.reconstruction.projector_fill import fill_unseen
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.simulation.plans import letter_plan, rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.simulation.second_camera import second_camera
from slviewer.target.board import Board
from slviewer.target.detect import detect
from tests.perfect_model import PerfectModel
from tests.proofs.accuracy import FLOOR, covered_pixels, measure_shapes, spacing_errors
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import (
    calibrate_observed,
    calibrate_rendered,
    render_phase,
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
FILLED = "plane_01"
"""The nearest plane, of which the second camera sees the least."""
MUST_FILL = 100_000
"""Points of that plane, at least, at the full resolution."""
HONEST = 0.7, 1.3
"""RMS of the errors of filled points over their sigma."""
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
        phases = scan_both(actual, scene, scan_sequence(rig), number)[1]
        return match_cameras(*phases, epipolar_lines(own[1]))["x"]

    def scan_alone(actual: SimulatedRig, scene: Scene, number: int) -> PhaseMap:
        """Return the projector's columns, as scanned with a rig."""
        return render_phase(Renderer(actual, scene), "scan", number)

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
        planes, spheres = measure_shapes(
            models, covered_pixels(seen), plan, partial(scan, actual), report
        )
        means = {
            model: fmean(c.results[model].rms_mm for c, _ in planes.values()) for model in models
        }
        ratio = means["splined"] / means[FLOOR]
        spacing = max(map(abs, spacing_errors(spheres, "splined").values()))
        rows.append({"rig": name, **means, "splined / floor": ratio, "worst spacing mm": spacing})
        if name != "one camera, projector turned":
            checks.append(BandCheck(name, "splined over the floor", ratio, *OVER_FLOOR))
        if "turned" in name and "one" in name:
            checks.append(BandCheck(name, "a spacing's error, mm", spacing, MUST_SHIFT_MM, 100))
        elif "two" in name:
            checks.append(BandCheck(name, "a spacing's error, mm", spacing, 0, most))
    projector = calibrate_projector(own[1], own[2], rig.projector.size)
    fills = dict[str, dict[str, float]]()
    for name, actual in (("two cameras", rig), ("two cameras, projector turned", turned)):
        phase = scan_pair(actual, plan[FILLED], [*plan].index(FILLED))
        fills[name] = measure_fill(own[1], projector, phase)
    as_it_was, turned_since = fills.values()
    for what, band in (("filled", (MUST_FILL * scale**2, 1e9)), ("error / sigma", HONEST)):
        checks.append(BandCheck("two cameras", what, as_it_was[what], *band))
    checks.append(BandCheck("projector turned", "filled", turned_since["filled"], 0, 0))
    title = f"planes and spheres of the Letter at scale {scale:g}; the projector turned by 1 mrad"
    note = "; ".join(
        f"{name}: {each['filled']:.0f} points of {FILLED} filled"
        + f", their error is {each['error / sigma']:.2f} times their sigma" * (each["filled"] > 0)
        for name, each in fills.items()
    )
    return prove_checks(checks, scale, rows, {"rigs": rows, "fills": fills}, [title], [note])


def measure_fill(pair: SplinedModel, projector: SplinedModel, phase: PhaseMap) -> dict[str, float]:
    """Return how many points of a plane the projector fills that the second camera does not see,
    and the RMS of their distances from the plane through the others, over their sigma; NaN without
    any."""
    assert phase.light is not None
    cloud = reconstruct_cloud(pair, {phase.axis: phase})
    lit = reconstruct_cloud(projector, phase.light)
    whole = fill_unseen(cloud, lit, phase.reason == Reason.UNSEEN)
    filled = whole.mask & ~cloud.mask
    plane = fit_plane(cloud.measured)
    along_z = (whole.points[filled] @ plane.normal - plane.offset) / plane.normal[2]
    error = rms(along_z / whole.sigma[filled]) if filled.any() else math.nan
    return {"filled": float(np.count_nonzero(filled)), "error / sigma": error}


def scan_both(
    rig: SimulatedRig, scene: Scene, sequence: PatternSequence, number: int
) -> tuple[np.ndarray, tuple[PhaseMaps, PhaseMaps]]:
    """Return the first camera's frames (n, h, w), and the phases that both decode; the second one
    follows from the rig's seed, wherever its projector is."""
    first = Renderer(rig, scene).capture(sequence, number)
    second = second_camera(rig).capture(scene, sequence, number)
    return first, (
        decode_frames("first", sequence, first),
        decode_frames("second", sequence, second),
    )


def observe_pair(rig: SimulatedRig, scene: Scene, name: str, number: int) -> Observation:
    """The observation of a rendered target pose by both cameras, whose noise ``number`` seeds."""
    sequence, board = p18(rig.projector.size), Board.parse(TARGET)
    frames, (first, second) = scan_both(rig, scene, sequence, number)
    detection = detect(board, texture(sequence, frames))
    light = observe(name, board, detection, first)
    return replace(observe(name, board, detection, match_cameras(first, second)), light=light)
