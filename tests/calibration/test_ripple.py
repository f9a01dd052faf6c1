"""Residuals that repeat with the fringe, and residuals beyond noise: measured, named, and part of the verdict."""

from dataclasses import replace

import numpy as np
import pytest
from splined_rig import BOARD, PERIOD, SAMPLE_PX, observation, poses, rig

from slviewer.calibration.diagnosis.capture_rules import diagnose_period, diagnose_ripple
from slviewer.calibration.diagnosis.evidence import AxisEvidence, Evidence, PoseEvidence
from slviewer.calibration.diagnosis.ripple import Ripple, measure_ripple
from slviewer.calibration.diagnosis.solution import measure_solution
from slviewer.calibration.diagnosis.verdict import Finding, Verdict, judge_splined
from slviewer.calibration.observe import Observation, Samples
from slviewer.calibration.splined.residual_noise import Noise, estimate_noise
from slviewer.calibration.stereo import StereoModel, calibrate_stereo


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
    return replace(o, samples=Samples(o.samples.camera, o.samples.projector + error, o.samples.sigma))


@pytest.mark.parametrize("waves", [1, 3, 4])
def test_a_ripple_is_measured_beside_what_lenses_leave(seen, stereo, waves: int) -> None:
    clean = measure_ripple(seen, stereo)
    assert set(clean) == {"x", "y"} and max(r.rms_px for r in clean.values()) < 0.5 * SAMPLE_PX
    for found in measure_ripple([with_ripple(o, 0.05, waves) for o in seen], stereo).values():
        assert found.waves == waves and found.noise_px == pytest.approx(SAMPLE_PX)
        assert found.rms_px == pytest.approx(0.05, rel=0.1)


def evidence(seen, stereo, ripple: dict, steps: int, period_seen: float = PERIOD) -> Evidence:
    solution = replace(measure_solution(seen, stereo), ripple=ripple)
    axes = {axis: AxisEvidence(PERIOD, steps, 1.0, 0.0, np.nan, period_seen) for axis in "xy"}
    turn = ((1.0, 0.0), (0.0, 1.0))
    return Evidence(
        str(BOARD), (912, 1140), tuple(PoseEvidence(o.name, axes=axes, turn=turn) for o in seen), solution=solution
    )


def test_as_many_waves_as_steps_are_gamma_and_few_are_changing_light(seen, stereo) -> None:
    (found,) = diagnose_ripple(evidence(seen, stereo, {"x": Ripple(0.4, 3, 0.4, 0.1)}, 3))
    assert (found.cause, found.severity) == ("gamma", "doubtful")
    assert "repeats 3 times" in found.sentence and "0.40 px" in found.sentence and "0.10 px" in found.sentence
    (found,) = diagnose_ripple(evidence(seen, stereo, {"x": Ripple(0.4, 1, 0.4, 0.1)}, 8))
    assert (found.cause, found.severity) == ("residuals", "doubtful") and "exposure" in found.text()
    assert not list(diagnose_ripple(evidence(seen, stereo, {"x": Ripple(0.02, 3, 0.02, 0.1)}, 3)))


def test_a_ripple_is_not_taken_for_another_period(seen, stereo) -> None:
    """By 0.17 px the code seems to begin elsewhere in the fringe."""
    assert [f.cause for f in diagnose_period(evidence(seen, stereo, {}, 3, 13.4))] == ["fringe-period"]
    assert not list(diagnose_period(evidence(seen, stereo, {"x": Ripple(0.27, 3, 0.27, 0.1)}, 3, 13.4)))


def test_residuals_beyond_noise_are_doubtful_and_never_good() -> None:
    rng = np.random.default_rng(0)
    sigma = np.full((4000, 2), 0.03)
    sound = estimate_noise(rng.normal(0, 0.01, (500, 2)), rng.normal(0, sigma), sigma)
    assert max(sound.ratio) < 1.1 and judge_splined(Verdict(), sound).level == "good"
    scattered = estimate_noise(rng.normal(0, 0.01, (500, 2)), rng.normal(0, sigma * (1, 10)), sigma)
    assert scattered.ratio[0] < 1.1 and scattered.ratio[1] == pytest.approx(10, rel=0.06)
    verdict = judge_splined(Verdict(), scattered)
    assert verdict.level == "doubtful" and verdict.causes == ("residuals",) and "in y, 0.3" in verdict.reason
    gamma = Verdict((Finding("gamma", "doubtful", "bent", "straighten"),))
    assert "probable cause: gamma" in judge_splined(gamma, scattered).findings[1].sentence
    assert judge_splined(Verdict(), Noise(0.01, (2.4, 2.4), (2.401, 2.401))).level == "rejected"
