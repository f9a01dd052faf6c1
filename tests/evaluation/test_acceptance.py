"""Acceptance tests on a simulated rig whose calibration is the truth, or wrong by a known scale."""

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from artefact_places import bar_places, plane_places, sphere_places
from facts import missing_facts, raises

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.evaluation.acceptance import (
    FLATNESS,
    FORM,
    K_95,
    SIZE,
    SPACING,
    Artefact,
    Limits,
    conclude_test,
    decide,
    make_length_error,
    measure_artefact,
    narrowest_range,
    repeatability,
)
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.records.acceptance import Contribution, ErrorBudget, SurfaceEvidence
from slviewer.records.record import render_text
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres
from slviewer.simulation.truth import rig_record

EXAMPLES = Path(__file__).parents[2] / "assets" / "artefacts"
SIMULATED = letter(0.25, seed=1, local_distortion_px=0)
R2 = (500.0, 700.0)
GIVEN = {
    "kind": "ball-bar",
    "calibrated": {
        "spacing_mm": 100.0, "spacing_U_mm": 0.002, "diameter_mm": 38.1, "diameter_U_mm": 0.001,
        "form_mm": 0.002, "form_U_mm": 0.001, "expansion_ppm_K": 11.5, "expansion_U_ppm_K": 1.0,
    },
    "measured": {"temperature_C": 20.0, "temperature_U_K": 0.2, "captures": ["bar_*"]},
}  # fmt: skip


def true_model(longer: float = 0.0) -> StereoModel:
    """The simulated rig as a calibration, its baseline longer than it is by a share."""
    record = rig_record(SIMULATED)
    lenses = [
        Lens(np.array(record[name]["K"]), np.array(record[name]["D"]), tuple(record[name]["size"]))
        for name in ("camera", "projector")
    ]
    return StereoModel.from_rig(
        StereoRig(*lenses, np.array(record["R"]), np.array(record["t"]) * (1 + longer))
    )


RIG = true_model().rig
SEQUENCE = one_axis(p18(SIMULATED.projector.size), "x")


def phases_of(scene, seed, rig=SIMULATED):
    return {"x": decode(SEQUENCE, Renderer(rig, scene).capture(SEQUENCE, seed), "x")}


def bar(T: np.ndarray, spacing: float = 100.0) -> Spheres:
    return Spheres(T[:3, 3] + spacing / 2 * np.array([[-1.0], [1.0]]) * T[:3, 0], 19.05)


@cache
def places_of_the_bar():
    return bar_places(RIG, R2, 100.0, 38.1)


@pytest.fixture(scope="module")
def bars():
    """(words, phases) of the ball bar in its seven places."""
    return [
        (p.words, phases_of(bar(p.T_camera_artefact), i)) for i, p in enumerate(places_of_the_bar())
    ]


def outcome(artefact, bars, model):
    return conclude_test(
        artefact,
        "stereo",
        [
            measure_artefact(artefact, reconstruct_cloud(model, p), words, words, R2)
            for words, p in bars
        ],
    )


@pytest.fixture(scope="module")
def true_test(bars):
    return outcome(Artefact.from_dict(GIVEN), bars, true_model())


@pytest.mark.slow
@pytest.mark.computes
def test_the_true_rig_measures_a_ball_bar_to_its_noise(true_test):
    for position in true_test.positions:
        spacing, size, form = (position.error(name) for name in (SPACING, SIZE, FORM))
        assert abs(spacing.error_mm) < 2 * max(spacing.U_mm, 0.005)
        assert abs(size.error_mm) < 0.05
        for rms, floor in zip(position.rms_mm, position.floor_mm, strict=True):
            assert 0.8 * floor < rms < 1.35 * floor
        assert 3.0 * min(position.rms_mm) < form.within_95_mm[1] < 4.6 * max(position.rms_mm)
        assert form.within_95_mm[1] < form.within_997_mm[1]
        assert 0.0005 < spacing.U_mm < 0.05
    assert abs(true_test.scale.ppm) < 1.5 * true_test.scale.U_ppm
    assert 10 < true_test.scale.U_ppm < 150
    assert true_test.lacks == []
    assert [p.incidence["R1"] for p in true_test.positions].count(100.0) == 1


@pytest.mark.slow
@pytest.mark.computes
def test_a_scale_error_of_200_ppm_is_found(bars, true_test):
    wrong = outcome(Artefact.from_dict(GIVEN), bars, true_model(200e-6))
    assert wrong.scale.ppm == pytest.approx(200, abs=wrong.scale.U_ppm)
    assert wrong.scale.ppm - true_test.scale.ppm == pytest.approx(200, abs=3)
    low, high = wrong.scale.within(K_95)
    assert low < 200 < high and wrong.scale.U_ppm < 150


@pytest.mark.slow
@pytest.mark.computes
def test_temperature_is_corrected(bars):
    warm = {**GIVEN, "measured": {**GIVEN["measured"], "temperature_C": 30.0}}
    cold, hot = (
        outcome(Artefact.from_dict(given), bars[:2], true_model()) for given in (GIVEN, warm)
    )
    assert cold.scale.ppm - hot.scale.ppm == pytest.approx(115, abs=0.5)
    assert hot.positions[0].error(SPACING).U_mm > cold.positions[0].error(SPACING).U_mm
    assert missing_facts("; ".join(hot.lacks), "2 of 7") == []


@pytest.mark.computes
@pytest.mark.parametrize(
    ("limit", "decision"), [(0.2, "pass"), (0.012, "undecided"), (1e-5, "fail")]
)
def test_decisions_heed_the_tests_own_uncertainty(true_test, limit, decision):
    unsure = Artefact.from_dict(
        {**GIVEN, "calibrated": {**GIVEN["calibrated"], "spacing_U_mm": 0.01}}
    )
    if decision == "fail":
        unsure = Artefact.from_dict(GIVEN)
    errors = [0.005, -0.003, 0.001]
    u = unsure.at_measurement(unsure.spacing)[1]
    assert decide([make_length_error(SPACING, "", error, u) for error in errors], limit) == decision
    judged = conclude_test(
        msgspec.structs.replace(unsure, limits=Limits(spacing_mm=limit)),
        "stereo",
        true_test.positions,
    )
    assert judged.decision in ("pass", "fail", "undecided")


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("count", [2, pytest.param(6, marks=pytest.mark.slow)])
def test_planes_are_flat_to_their_noise(count):
    artefact = Artefact.from_dict(tomllib.loads((EXAMPLES / "plane.toml").read_text()))
    found = []
    for i, place in enumerate(plane_places(RIG, R2)[:count]):
        T = place.T_camera_artefact
        plate = blank_board(Pose(T[:3, :3], T[:3, 3]), (140.0, 110.0))
        cloud = reconstruct_cloud(true_model(), phases_of(plate, 50 + i))
        found.append(measure_artefact(artefact, cloud, place.words, "plane", R2))
    test = conclude_test(artefact, "stereo", found)
    for position in found:
        assert position.rms_mm[0] == pytest.approx(position.floor_mm[0], rel=0.08)
        width = position.error(FLATNESS).within_95_mm[1]
        assert width == pytest.approx(2 * 1.96 * position.rms_mm[0], rel=0.2)
    assert test.scale is None and test.decision == "pass" and (test.lacks == []) == (count == 6)


@pytest.mark.computes
def test_places_are_seen_by_both_devices():
    bar_held, sphere_held = places_of_the_bar(), sphere_places(RIG, R2, 60.0)
    for place in bar_held + sphere_held:
        T = place.T_camera_artefact
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(
            T[:3, :3]
        ) == pytest.approx(1)
    assert len(bar_held) == 7 and len(plane_places(RIG, R2)) == 6
    depths = [place.T_camera_artefact[2, 3] for place in sphere_held]
    assert min(depths) < R2[0] and max(depths) > R2[1]
    with pytest.raises(InputError):
        bar_places(RIG, R2, 400.0, 38.1)


def test_the_narrowest_interval_ignores_strays():
    values = np.r_[np.random.default_rng(0).normal(0, 1, 100_000), 50.0, -80.0]
    assert narrowest_range(values, 0.95) == pytest.approx(2 * 1.96, rel=0.02)
    assert narrowest_range(values, 0.997) == pytest.approx(2 * 2.97, rel=0.04)


@pytest.mark.parametrize("name", ["ball_bar_100", "sphere_196", "plane"])
def test_the_examples_are_valid(name):
    artefact = Artefact.from_dict(tomllib.loads((EXAMPLES / f"{name}.toml").read_text()))
    assert artefact.positions and artefact.limits != Limits()


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"kind": "cube"}, ["kind", "cube", "ball-bar", "sphere", "plane"]),
        ({"measured": {"temperature_C": 20.0, "temperature_U_K": 0.1}}, ["[measured]", "captures"]),
        ({"calibrated": {**GIVEN["calibrated"], "spacing_mm": -1}}, ["spacing_mm", -1]),
        ({"calibrated": {**GIVEN["calibrated"], "spacing_mm": "100"}}, ["spacing_mm", "'100'"]),
        (
            {"calibrated": {**GIVEN["calibrated"], "diameter_mm": [1.0, 2.0, 3.0]}},
            [3, "diameters", 2],
        ),
        ({"limits": {"colour": 1}}, ["[limits]", "colour"]),
    ],
)
def test_artefacts_that_make_no_sense_are_refused(change, facts):
    with raises(InputError, *facts):
        Artefact.from_dict({**GIVEN, **change})


def test_repeatability_is_the_noise_whatever_the_shape():
    rng = np.random.default_rng(4)
    shape = 600 + 20 * rng.random((60, 80))
    shape[:5] = np.nan
    noise = np.full((60, 80), 0.03)
    found = repeatability(
        (shape + 0.001 * k + rng.normal(0, 0.03, shape.shape), noise) for k in range(10)
    )
    assert found.sigma_mm == pytest.approx(0.03, rel=0.06) and found.predicted_mm == pytest.approx(
        0.03
    )
    assert found.wandering_mm == pytest.approx(0.009, abs=0.003)
    assert found.pixels == 55 * 80
    with raises(InputError, 2):
        repeatability([(shape, noise)] * 2)


def test_a_budget_adds_squares_and_names_what_is_unknown():
    found = ErrorBudget(
        100.0,
        [
            Contribution("a", 0.003, "A", ""),
            Contribution("b", 0.004, "B", ""),
            Contribution("drift", None, "B", ""),
        ],
    )
    assert found.U_mm == pytest.approx(0.010) and found.unknown == ["drift"]
    assert missing_facts(render_text(found.table()), "excludes", *found.unknown) == []


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("turn", [(0.0, 0.004, 0.0), (0.0, -0.006, 0.0)])
def test_a_projector_that_was_turned_does_not_pass(turn):
    R = cv2.Rodrigues(np.array(turn))[0]
    moved = replace(SIMULATED, R=R @ SIMULATED.R, t=R @ SIMULATED.t)
    bars = [
        (p.words, phases_of(bar(p.T_camera_artefact), i, moved))
        for i, p in enumerate(places_of_the_bar()[:3])
    ]
    limits = {"spacing_mm": 0.1, "size_mm": 0.1, "form_mm": 0.3}
    test = outcome(Artefact.from_dict({**GIVEN, "limits": limits}), bars, true_model())
    assert test.decision == "fail", test.judgements


def test_what_was_left_out_is_stated():
    whole = SurfaceEvidence(
        measured=0.97, covered=0.0, excluded=0.001, lowest_mm=-0.01, highest_mm=0.01
    )
    half = msgspec.structs.replace(whole, measured=0.62, covered=0.2)
    bent = msgspec.structs.replace(whole, excluded=0.08, lowest_mm=-0.7)
    assert whole.explain_gap(0.1) == "" and bent.explain_gap(1.0) == ""
    assert not missing_facts(half.explain_gap(0.1), "62 %", "20 %", "covered", "85 %")
    assert not missing_facts(bent.explain_gap(0.1), "8 %", "0.710 mm", "excluded")
