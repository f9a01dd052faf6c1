"""How a case of the hostile rig is judged, and three of them through the program's own path."""

import json
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError, UsageError
from tests.proofs.hostile import (
    CaseRun,
    Figures,
    MeasuredScan,
    choose_cases,
    fit_gauge,
    judge_case,
    prove_hostile,
    score,
)
from tests.proofs.hostile_rig import FAULTS

FLOOR = Figures(0.06, 0.06, 0.003, 0.99)
GOOD = Figures(0.07, 0.06, 0.004, 0.98)
NOISY = Figures(0.3, 0.3, 0.003, 0.98)
WRONG = Figures(0.3, 0.06, 0.4, 0.98)
EMPTY = Figures(0.06, 0.06, 0.003, 0.5)
RIGHT, OTHER = frozenset({"flicker"}), frozenset({"projector-size"})


def outcome(figures, *named, severity="medium", error=None):
    run = CaseRun(Path(), FAULTS["flicker"], severity, [], list(named), error)
    return judge_case(run, figures, FLOOR)[0]


def test_cases_are_judged_by_errors_and_by_what_was_said():
    assert outcome(GOOD) == outcome(GOOD, RIGHT) == "measured"
    assert outcome(GOOD, OTHER) == outcome(WRONG, OTHER) == "WRONG REASON"
    assert outcome(WRONG) == "SILENTLY WRONG" and outcome(WRONG, OTHER, RIGHT) == "degraded, warned"
    assert outcome(NOISY) == "noisier as predicted" and outcome(EMPTY) == "UNEXPLAINED LOSS"
    assert (
        outcome(NOISY, severity="mild") == outcome(EMPTY, RIGHT, severity="mild") == "TURNED AWAY"
    )
    assert outcome(WRONG, severity="mild") == "SILENTLY WRONG"
    assert outcome(None, RIGHT, error=InputError("no")) == "refused"
    assert (
        outcome(None, error=InputError("9 % of the codes lie outside the projector"))
        == "WRONG REASON"
    )
    assert outcome(None, error=ValueError("shapes")) == "CRASH"


def test_a_rigid_motion_is_no_error_and_a_bend_is_one():
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.uniform(-80, 80, (4000, 2)), rng.uniform(550, 650, 4000)])
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    noise = rng.normal(0, 0.05, truth.shape) * [0, 0, 1]
    moved = (truth - [3, 4, 5]) @ turn + noise @ turn
    measured = [MeasuredScan(moved, truth, np.full(4000, 0.05), np.ones(4000, bool), 5000)]
    figures = score(measured, fit_gauge(measured))
    assert 0.045 < figures.rms_mm < 0.051 and figures.predicted_mm == pytest.approx(0.05)
    assert figures.gross < 0.006 and figures.coverage == 0.8
    bent = moved + 1e-4 * (truth[:, :1] ** 2) * [0, 0, 1]
    measured = [MeasuredScan(bent, truth, np.full(4000, 0.05), np.ones(4000, bool), 5000)]
    assert score(measured, fit_gauge(measured)).gross > 0.3


def test_cases_are_chosen_by_name():
    assert len(choose_cases()) >= 60 and len({name for name, _, _ in choose_cases()}) >= 22
    assert choose_cases(["jpeg:mild"]) == [
        ("jpeg", "mild", "scan"),
        ("jpeg", "mild", "calibration"),
    ]
    assert len(choose_cases(["gamma::scan", "flicker"])) == 9
    with raises(UsageError, "jpg"):
        choose_cases(["jpg"])


@pytest.mark.computes
@pytest.mark.slow
def test_three_cases_end_to_end():
    proof = prove_hostile(
        0.15,
        cases=["vignetting:mild:scan", "dropped-frame:medium:scan", "hand:mild:scan"],
        splined=False,
    )
    data = json.loads(json.dumps(proof.to_json()))
    by_fault = {case["fault"]: case for case in data["cases"]}
    vignetting, dropped = by_fault["vignetting"], by_fault["dropped-frame"]
    assert vignetting["outcome"] == by_fault["hand"]["outcome"] == "measured", proof.text()
    assert vignetting["floor"]["gross"] < 0.01 and vignetting["floor"]["coverage"] > 0.95
    assert 0.02 < vignetting["figures"]["rms_mm"] < 0.12
    assert dropped["figures"] is None and dropped["messages"]
    assert data["holds"] == proof.holds and len(data["cases"]) == 3
