"""A planned rig: its prediction agrees with the simulation, and with what optics says."""

import json

import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.cli import main
from slviewer.errors import InputError
from slviewer.operations.plan_rig import (
    PlannedLight,
    _read_camera,
    _read_projector,
    plan_rig,
    predict_rig,
)

BUDGETS = (
    ("webcam-1080p", "pocket-720p", 500.0),
    ("global-shutter-2mp", "projector-1080p", 600.0),
    ("machine-vision-5mp", "lightcrafter4500", 600.0),
)


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    ("camera", "projector", "distance"),
    [BUDGETS[0], *(pytest.param(*budget, marks=pytest.mark.slow) for budget in BUDGETS[1:])],
)
@pytest.mark.parametrize(
    "how",
    [
        {},
        pytest.param({"steps": 4, "reflectance": 0.3}, marks=pytest.mark.slow),
        pytest.param({"period": 24.0, "baseline": 100.0, "ambient": 0.4}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_simulation_measures_what_is_predicted(camera, projector, distance, how):
    planned = plan_rig(camera, projector, distance, check=True, **how)
    assert planned.measured == pytest.approx(planned.expected, rel=0.15)
    assert 0.002 < planned.expected < 1.0
    assert "simulated" in planned.text()


def predict(*given):
    """The plan, its usable range looked for at the distance alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slviewer.operations.plan_rig._DEPTHS", np.ones(1))
        return predict_rig(*given)


def planned(camera, projector, distance, baseline=200.0, *, lens=None, light=None, period_px=None):
    devices = _read_camera(camera, lens)[0], _read_projector(projector)[0]
    return predict(*devices, distance, baseline, light or PlannedLight(), period_px)


def test_noise_follows_baseline_distance_and_steps():
    def sigma(distance=600.0, **how):
        return planned("global-shutter-2mp", "projector-1080p", distance, **how).sigma_middle

    assert sigma(baseline=60, period_px=16) / sigma(baseline=120, period_px=16) == pytest.approx(
        2, rel=0.05
    )
    assert sigma(light=PlannedLight(4)) / sigma(light=PlannedLight(16)) == pytest.approx(
        2, rel=1e-6
    )
    # of similar triangles every length grows with the distance, and so does the error; the blur of
    # a pupil does not
    assert sigma(1200.0, baseline=400) / sigma(baseline=200) == pytest.approx(2, rel=0.06)


def test_the_recommended_period_has_the_least_noise():
    # a period that neither the camera's pixels nor the grey levels limit
    camera, _ = _read_camera("machine-vision-5mp", 25.0)
    projector, _ = _read_projector("projector-1080p")
    blurred = type(projector)(**{**vars(projector), "blur_px": 2.0})
    best = predict(camera, blurred, 600.0, 240.0, PlannedLight()).period_px
    sigmas = {
        p: predict(camera, blurred, 600.0, 240.0, PlannedLight(), p).sigma_middle
        for p in np.arange(8.0, 26.0)
    }
    assert 10 < best < 20 and abs(min(sigmas, key=sigmas.__getitem__) - best) <= 1


def test_fields_follow_the_lens_and_the_throw():
    plan = planned("1600x1200:60deg", "1000x500:2", 500.0, 1.0)
    assert plan.camera_field[0] == pytest.approx(2 * 500 * np.tan(np.radians(30)), rel=1e-6)
    assert plan.projector_field == pytest.approx((250, 125), rel=1e-4)
    assert plan.camera_px == pytest.approx(plan.camera_field[0] / 1600)
    assert plan.coverage == pytest.approx(250 * 125 / np.prod(plan.camera_field), rel=0.05)
    wide, narrow = (
        planned("global-shutter-2mp", "projector-1080p", 600.0, lens=f) for f in (8.0, 16.0)
    )
    assert wide.camera_field[0] == pytest.approx(2 * narrow.camera_field[0])


@pytest.mark.computes
def test_advice_names_what_is_wrong():
    planned = plan_rig("webcam-1080p", "lightcrafter4500", 500.0, baseline=50.0, reflectance=0.1)
    advice = " ".join(planned.advice())
    assert not missing_facts(
        advice, f"{100 * planned.plan.coverage:.0f} %", "baseline", "modulation"
    )
    assert plan_rig("global-shutter-2mp", "projector-1080p", 600.0).advice() == []


@pytest.mark.parametrize(
    ("camera", "projector", "distance", "how", "fact"),
    [
        ("a-camera", "pocket-720p", 500, {}, "a-camera"),
        ("webcam-1080p", "1x1", 500, {}, "1x1"),
        ("webcam-1080p", "pocket-720p", -5, {}, "-5"),
        ("webcam-1080p", "pocket-720p", 500, {"lens": 8.0}, "lens"),
        ("webcam-1080p", "pocket-720p", 500, {"baseline": 5000.0}, "5000"),
        ("webcam-1080p", "pocket-720p", 500, {"steps": 2}, "2"),
        ("100x100:179.99", "100x100:20", 500, {"baseline": 1490.0}, "0.00436332"),
    ],
)
def test_impossible_plans_are_refused(camera, projector, distance, how, fact):
    with raises(InputError, fact):
        plan_rig(camera, projector, distance, **how)


@pytest.mark.computes
def test_the_command_prints_the_plan_and_json(capsys, tmp_path):
    result = tmp_path / "plan.json"
    assert main(["plan-rig", "webcam-1080p", "pocket-720p", "500", "--json", str(result)]) == 0
    printed = capsys.readouterr()
    assert not missing_facts(printed.out + printed.err, "noise", "mm")
    assert 0.01 < json.loads(result.read_text())["plan"]["sigma_middle"] < 0.1
