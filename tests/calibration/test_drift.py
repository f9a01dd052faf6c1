"""The drift check against rigs whose projector has moved by a known amount, or not at all."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from facts import missing_facts, raises
from simulated_views import BOARD, moved, poses, seen

from slviewer.calibration.drift import (
    MIN_POSES,
    DriftReference,
    DriftView,
    build_reference,
    check_drift,
)
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.records.acceptance import Drift
from slviewer.records.record import from_plain, render_text, to_plain
from slviewer.simulation.boards import Pose
from slviewer.simulation.rig import letter

pytestmark = [pytest.mark.computes, pytest.mark.slow]

RIG = letter(0.5, seed=3)
FEW = 6  # later poses where a movement is looked for: it is seen in every one


@cache  # at its first use, not wherever tests are collected
def later() -> list[Pose]:
    return poses(RIG, 20, seed=77)


def view(rig, pose, name, **how) -> DriftView:
    return DriftView.from_observation(seen(rig, pose, name, **how))


def build(rig, count, seed) -> tuple[StereoModel, DriftReference]:
    observations = [seen(rig, pose, f"pose_{i}") for i, pose in enumerate(poses(rig, count, seed))]
    model = calibrate_stereo(observations, rig.projector.size, str(BOARD))
    views = [DriftView.from_observation(o) for o in observations if o.name in model.poses]
    return model, build_reference(model.rig, views)


@pytest.fixture(scope="module")
def reference():
    model, found = build(RIG, 12, seed=3)
    kept = DriftReference.from_arrays(model.rig, found.to_arrays())  # as a session keeps it
    assert np.array_equal(kept.sigmas, found.sigmas)
    return kept


def checked(reference, rig, i, name="later", **how) -> Drift:
    return check_drift(reference, view(rig, later()[i], f"{name}_{i}", **how))


@pytest.mark.parametrize("seed", [11, 21])
def test_few_poses_raise_no_false_alarm(seed):
    """Their own scatter may be explained by one kind of observations without any error."""
    rig = letter(0.25, seed=seed)
    _, found = build(rig, 8, seed)
    later = [check_drift(found, view(rig, pose, "later")) for pose in poses(rig, 10, seed=77)]
    assert [d.verdict for d in later] == ["still good"] * 10


def test_an_unmoved_rig_raises_no_alarm(reference):
    found = [checked(reference, RIG, i) for i in range(2 * FEW)]
    assert [d.verdict for d in found] == ["still good"] * len(found)
    assert sum(d.chance < 0.05 for d in found) <= 3  # chance is what it says
    assert np.mean([d.chance for d in found]) == pytest.approx(0.5, abs=0.3)


@pytest.mark.parametrize(
    ("what", "how"),
    [
        ("nod", {"turn_mrad": (0.05, 0, 0)}),
        ("pan", {"turn_mrad": (0, 0.05, 0)}),
        ("roll", {"turn_mrad": (0, 0, 0.05)}),
        ("baseline", {"baseline_mm": 0.010}),
    ],
)
def test_small_movements_are_seen(reference, what, how):
    rig = moved(RIG, **how)
    found = [checked(reference, rig, i, what) for i in range(FEW)]
    assert [d.verdict for d in found] == ["recalibrate"] * FEW
    assert all(what in d.reasons[0] for d in found if d.reasons)


def test_what_is_said_of_a_movement_is_right(reference):
    pan = checked(reference, moved(RIG, (0, 0.2, 0)), 1)
    assert pan.turn_mrad[1] == pytest.approx(0.2, abs=4 * pan.turn_sigma_mrad[1])
    assert 500 < abs(pan.scale_ppm) < 1000 and pan.scale_sigma_ppm < 30
    nod = checked(reference, moved(RIG, (0.2, 0, 0)), 1)
    assert abs(nod.across_px) == pytest.approx(0.2e-3 * 2800, rel=0.05)
    assert abs(nod.scale_ppm) < 300
    longer = checked(reference, moved(RIG, baseline_mm=0.2), 1)
    assert longer.baseline_mm == pytest.approx(0.2, abs=4 * longer.baseline_sigma_mm)
    assert longer.scale_ppm == pytest.approx(-1e6 * 0.2 / 180, rel=0.1)


def test_one_axis_says_what_it_cannot_see(reference):
    still = checked(reference, RIG, 2, axes=("x",))
    assert still.verdict == "still good" and still.across_px is None
    assert any(missing_facts(sentence, "nod", "axis x") == [] for sentence in still.unseen)
    assert not any(missing_facts(sentence, "pan") == [] for sentence in still.unseen)
    assert checked(reference, moved(RIG, (0, 0.05, 0)), 2, axes=("x",)).verdict == "recalibrate"
    assert checked(reference, moved(RIG, (0.05, 0, 0)), 2, axes=("x",)).verdict == "still good"


def test_a_refocused_lens_is_no_movement(reference):
    fx, fy = RIG.projector.focal_px
    k1, *others = RIG.projector.brown
    other = replace(
        RIG, projector=replace(RIG.projector, focal_px=(fx, fy * 1.002), brown=(k1 + 0.05, *others))
    )
    found = checked(reference, other, 3)
    assert found.verdict == "recalibrate"
    assert missing_facts(found.reasons[0], "lens", f"{found.misfit_px:.3f}") == []


def test_an_answer_survives_json(reference):
    found = checked(reference, moved(RIG, (0.05, 0.05, 0)), 4)
    assert from_plain(json.loads(json.dumps(to_plain(found))), Drift) == found
    assert found.verdict == "recalibrate" and found.reasons
    assert (
        missing_facts(
            "\n".join(map(render_text, Drift.tables({"1": found}))), found.verdict, *found.reasons
        )
        == []
    )


def test_too_few_poses_set_no_floor(reference):
    views = [
        DriftView.from_observation(seen(RIG, pose, "few")) for pose in later()[: MIN_POSES - 1]
    ]
    with raises(InputError, MIN_POSES - 1, MIN_POSES):
        build_reference(reference.rig, views)
