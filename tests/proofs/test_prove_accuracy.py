"""Accuracy proved: a small rig from images to figures, and that bad figures do not pass."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from facts import missing_facts

from slviewer.fringe.decode import decode
from slviewer.fringe.presets import AXES, gray_bits, p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.operation import ignore_progress
from slviewer.simulation.boards import BoardShape
from slviewer.simulation.plans import letter_plan, planes
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.target.board import Board
from slviewer.validation import bench_scaling
from tests import rendered_calibration
from tests.perfect_model import PerfectModel
from tests.proofs import accuracy
from tests.proofs.accuracy import (
    FLOOR,
    PlaneFigures,
    RigFigures,
    judge_accuracy,
    prove_accuracy,
    rig_cases,
)
from tests.proofs.proof import Proof

TARGET = "circles:14x11:13"
SHAPES = ("plane_03", "sphere_3", "sphere_4")
"""Inside the calibrated depths, where a few poses already suffice."""


def few_steps(projector: tuple[int, int]) -> PatternSequence:
    """A third of the usual phase steps."""
    frames = [
        f for a in AXES for f in (*phase_steps(a, 6, 18.0), *gray_bits(a, 7), Frame("texture"))
    ]
    return PatternSequence(projector, tuple(frames))


@pytest.fixture(scope="module")
def proof() -> Proof:
    """The proof of one rig, from fewer and coarser poses than it usually has."""
    calibrate = partial(rendered_calibration.calibrate_splined, cells_across=8)

    def small_plan(rig: SimulatedRig, poses: int, shape: BoardShape) -> dict[str, Scene]:
        plan = letter_plan(rig, Board.parse(TARGET), 8, shape)
        return {name: plan[name] for name in plan if name[:5] == "pose_" or name in SHAPES}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendered_calibration, "TARGET", TARGET)
        patch.setattr(bench_scaling, "TARGET", TARGET)
        patch.setattr(bench_scaling, "p18", few_steps)
        patch.setattr(rendered_calibration, "calibrate_splined", calibrate)
        patch.setattr(accuracy, "letter_plan", small_plan)
        patch.setattr(accuracy, "rig_cases", lambda *of: {"coarse": rig_cases(*of)["coarse"]})
        return prove_accuracy(0.15, 0, ignore_progress)


@pytest.mark.computes
@pytest.mark.slow
def test_a_rig_is_measured_from_its_images(proof: Proof) -> None:
    (rig,) = proof.record["rigs"]
    (plane,) = rig.planes.values()
    assert plane.region == "R2" and plane.pixels > 8_000 and 0.9 < plane.measured <= 1
    assert 0.03 < plane.rms_mm[FLOOR] < 0.09
    assert 0.97 < plane.rms_mm["splined"] / plane.rms_mm[FLOOR] < 1.15
    assert plane.rms_mm["stereo"] > 2 * plane.rms_mm["splined"]
    assert plane.predicted_mm == pytest.approx(plane.rms_mm[FLOOR], rel=0.05)
    assert set(plane.rms_mm) == {"stereo", "pixelwise", "splined", FLOOR}
    errors = rig.radius_error_mm[FLOOR]
    assert set(errors) == {"sphere_3", "sphere_4"} and 0 < max(map(abs, errors.values())) < 0.05
    assert 0 < abs(rig.spacing_error_mm[FLOOR]["sphere_3 - sphere_4"]) < 0.05
    assert (
        json.loads(json.dumps(proof.to_json()))["rigs"][0]["planes"]["plane_03"]["region"] == "R2"
    )


@pytest.mark.computes
def test_the_perfect_instrument_errs_by_noise_alone() -> None:
    rig = letter(0.15, seed=3)
    scene = planes()["plane_05"]
    renderer = Renderer(rig, scene)
    sequence = p18(rig.projector.size)
    frames, truth = renderer.capture(sequence), renderer.truth()
    phases = {axis: decode(sequence, frames, axis) for axis in ("x", "y")}
    model = PerfectModel(rig)
    inside = truth.mask.copy()
    inside[1:-1, 1:-1] &= (
        truth.mask[:-2, 1:-1] & truth.mask[2:, 1:-1] & truth.mask[1:-1, :-2] & truth.mask[1:-1, 2:]
    )
    points = model.points(phases["x"])
    error = (points - truth.points)[..., 2] / model.sigma_z(phases["x"], points)
    scored = inside & np.isfinite(error) & (np.abs(error) < 6)
    assert np.count_nonzero(scored) > 0.97 * np.count_nonzero(inside)
    assert np.std(error[scored]) == pytest.approx(1, abs=0.1) and abs(np.mean(error[scored])) < 0.1
    # what a model without noise measures is the truth itself
    exact = replace(
        phases["x"], phase=(truth.projector[..., 0] * 2 * np.pi / 18).astype(np.float32)
    )
    found = model.points(exact)[inside & exact.mask]
    assert np.max(np.abs(found - truth.points[inside & exact.mask])) < 0.01


def figures(
    splined=1.0, predicted=1.0, radius=0.004, spacing=0.01, measured=1.0, distorted=True
) -> RigFigures:
    """A rig whose planes come out so many times the floor."""
    rms = {"stereo": 0.2, "pixelwise": 0.08, "splined": 0.04 * splined, FLOOR: 0.04}
    planes = {
        f"plane_{i}": PlaneFigures(region, rms, 0.04 * predicted, 50_000, measured)
        for i, region in enumerate(("R1", "R2", "R3"))
    }
    return RigFigures(
        "a rig",
        0,
        distorted,
        planes,
        {"splined": {"sphere_1": 0.001, "sphere_2": -radius}},
        {"splined": {"sphere_1 - sphere_2": -spacing}},
        1.0,
    )


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, ""),
        ({"splined": 1.15}, "R2"),
        ({"splined": 0.8}, "R1"),
        ({"predicted": 0.85}, "predicted floor"),
        ({"radius": 0.02}, "radius"),
        ({"radius": float("nan")}, "radius"),
        ({"spacing": 0.05}, "spacing"),
        ({"measured": 0.8}, "pixels"),
        ({"distorted": False, "splined": 5.3}, "splined over stereo"),
    ],
)
def test_what_misses_its_band_is_said(change: dict, missed: str) -> None:
    proof = judge_accuracy([figures(**change)], 0.25)
    failed = [check["what"] for check in proof.record["checks"] if not check["holds"]]
    assert proof.holds == (not missed) == (not failed)
    assert not missed or any(missing_facts(what, missed) == [] for what in failed)
    assert missing_facts(proof.text(), *failed) == []
    assert json.loads(json.dumps(proof.to_json()))["holds"] == proof.holds
