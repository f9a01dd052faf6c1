"""Residuals that repeat with the fringe, and residuals beyond noise: measured, named, and part of
the verdict."""

from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts
from splined_rig import BOARD, PERIOD, SAMPLE_PX, observation, poses, rig

from slviewer.calibration.diagnosis.evidence import (
    AxisEvidence,
    Evidence,
    PoseEvidence,
    Ripple,
    SolutionEvidence,
)
from slviewer.calibration.diagnosis.rules import diagnose_period, diagnose_ripple, judge_splined
from slviewer.calibration.diagnosis.solution import measure_ripple, measure_solution
from slviewer.calibration.observe import Observation, Samples
from slviewer.calibration.splined.residual_noise import Noise, estimate_noise
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.presets import p18, phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.calibrate import calibrate
from slviewer.records.verdict import Finding, Verdict
from slviewer.session.store import Session
from slviewer.simulation.boards import printed_board
from slviewer.simulation.plans import target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

pytestmark = pytest.mark.computes


@pytest.fixture(scope="module")
def seen() -> list[Observation]:
    true = rig(seed=2)  # with local distortion, which is no ripple
    return [observation(true, pose, f"pose_{i:02d}") for i, pose in enumerate(poses(true, 6))]


@pytest.fixture(scope="module")
def stereo(seen: list[Observation]) -> StereoModel:
    return calibrate_stereo(seen, rig(seed=2).projector.size, str(BOARD))


def with_ripple(o: Observation, px: float, waves: int) -> Observation:
    """Samples whose coordinates are off by ``px`` RMS, ``waves`` times a period."""
    assert o.samples is not None
    error = px * np.sqrt(2) * np.sin(2 * np.pi * waves * o.samples.projector / PERIOD)
    return replace(
        o, samples=Samples(o.samples.camera, o.samples.projector + error, o.samples.sigma)
    )


@pytest.mark.parametrize("waves", [1, 3, 4])
def test_a_ripple_is_measured_beside_what_lenses_leave(seen, stereo, waves: int) -> None:
    clean = measure_ripple(seen, stereo)
    assert set(clean) == {"x", "y"} and max(r.rms_px for r in clean.values()) < 0.5 * SAMPLE_PX
    depth = clean["x"].depth_mm
    # dz / du = z^2 / (f b)
    pinhole = depth**2 / (stereo.rig.projector.K[0, 0] * np.linalg.norm(rig(seed=2).t))
    assert 500 < depth < 700 and clean["x"].mm_per_px == pytest.approx(pinhole, rel=0.25)
    for found in measure_ripple([with_ripple(o, 0.05, waves) for o in seen], stereo).values():
        assert found.waves == waves and found.noise_px == pytest.approx(SAMPLE_PX)
        assert found.rms_px == pytest.approx(0.05, rel=0.1)


@pytest.fixture(scope="module")
def solution(seen, stereo) -> SolutionEvidence:
    return measure_solution(seen, stereo)


def evidence(
    solution: SolutionEvidence, ripple: dict, steps: int, period_seen: float = PERIOD
) -> Evidence:
    axes = {axis: AxisEvidence(PERIOD, steps, 1.0, 0.0, np.nan, period_seen) for axis in "xy"}
    turn = ((1.0, 0.0), (0.0, 1.0))
    return Evidence(
        str(BOARD),
        (912, 1140),
        tuple(PoseEvidence(name, axes=axes, turn=turn) for name in solution.used),
        solution=replace(solution, ripple=ripple),
    )


def ripple(rms_px: float, waves: int, noise_px: float = 0.1) -> Ripple:
    return Ripple(rms_px, waves, noise_px, mm_per_px=1.6, depth_mm=600.0)


def test_as_many_waves_as_steps_are_gamma_and_few_are_changing_light(solution) -> None:
    (found,) = diagnose_ripple(evidence(solution, {"x": ripple(0.4, 3)}, 3))
    assert (found.cause, found.severity) == ("gamma", "doubtful")
    assert not missing_facts(found.observation, 3, "0.40 px", "0.640 mm", "0.10 px", "0.160 mm")
    (found,) = diagnose_ripple(evidence(solution, {"x": ripple(0.4, 1)}, 8))
    assert (found.cause, found.severity) == ("residuals", "doubtful") and "exposure" in found.text()


@pytest.mark.parametrize(("rms_px", "noise_px"), [(0.02, 0.1), (0.01, 0.02), (0.01, 0.0)])
def test_a_ripple_below_the_noise_or_of_no_size_is_no_finding(
    solution, rms_px: float, noise_px: float
) -> None:
    """0.01 px are 16 um in depth here: an undisturbed rig at its noise floor shows as much."""
    assert not list(diagnose_ripple(evidence(solution, {"x": ripple(rms_px, 3, noise_px)}, 3)))


def test_a_ripple_without_predicted_noise_is_named(solution) -> None:
    found = diagnose_ripple(
        evidence(solution, {"x": ripple(0.1, 1, 0.0), "y": ripple(0.4, 3, 0.0)}, 3)
    )
    assert [(f.cause, f.severity) for f in found] == [("gamma", "doubtful")]


def test_noise_is_predicted_where_every_pixel_is_black_in_a_step() -> None:
    rng = np.random.default_rng(0)
    x, steps = np.arange(320), np.arange(18)[:, None]
    light = ((1 + np.cos(2 * np.pi * (x / 32 + steps / 18))) / 2) ** 2.2
    for sigma in (1.1, 0.0):
        frames = 200 * light[:, None, :] + rng.normal(0, sigma, (18, 240, 320))
        stack = np.clip(np.rint(frames), 0, 255).astype(np.uint8)
        layout = axis_layout(PatternSequence((912, 1140), tuple(phase_steps("x", 18, 18.0))), "x")
        a, b = measure_noise(layout, stack, 255.0)
        assert a + 100 * b == pytest.approx(sigma**2 + 1 / 12, rel=0.15)


@pytest.mark.slow
def test_a_gamma_of_two_in_a_dark_room_is_named(tmp_path) -> None:
    """Every pixel of the boards is black in one of the 18 steps."""
    true = letter(0.2, 1, gamma=2.2)
    true = replace(
        true,
        light=replace(true.light, ambient=0.0, black=0.0),
        sensor=replace(true.sensor, dark_level=0.0),
    )
    sequence, board = p18(true.projector.size), Board.parse("circles:21x16:9")
    with Session.create(tmp_path / "session") as session:
        for i, pose in enumerate(target_poses(true, board, 8)):
            frames = Renderer(true, printed_board(board, pose)).capture(sequence, i)
            session.save_capture(
                f"pose_{i}", "calibration", sequence, frames, source="simulated", board=board
            )
    verdict = calibrate(tmp_path / "session", str(board), models=("stereo",)).only.verdict
    assert verdict is not None
    assert verdict.level == "doubtful" and "gamma" in verdict.causes


def test_a_ripple_is_not_taken_for_another_period(solution) -> None:
    """By 0.17 px the code seems to begin elsewhere in the fringe."""
    assert [f.cause for f in diagnose_period(evidence(solution, {}, 3, 13.4))] == ["fringe-period"]
    assert not list(diagnose_period(evidence(solution, {"x": ripple(0.27, 3)}, 3, 13.4)))


def test_residuals_beyond_noise_are_doubtful_and_never_good() -> None:
    rng = np.random.default_rng(0)
    sigma = np.full((4000, 2), 0.03)
    sound = estimate_noise(rng.normal(0, 0.01, (500, 2)), rng.normal(0, sigma), sigma)
    assert max(sound.ratio) < 1.1 and judge_splined(Verdict(), sound).level == "good"
    scattered = estimate_noise(rng.normal(0, 0.01, (500, 2)), rng.normal(0, sigma * (1, 10)), sigma)
    assert scattered.ratio[0] < 1.1 and scattered.ratio[1] == pytest.approx(10, rel=0.06)
    verdict = judge_splined(Verdict(), scattered)
    assert (
        verdict.level == "doubtful"
        and verdict.causes == ("residuals",)
        and "in y, 0.3" in verdict.reason
    )
    gamma = Verdict((Finding("gamma", "doubtful", "bent", "straighten"),))
    assert "probable cause: gamma" in judge_splined(gamma, scattered).findings[1].observation
    assert judge_splined(Verdict(), Noise(0.01, (2.4, 2.4), (2.401, 2.401))).level == "rejected"
