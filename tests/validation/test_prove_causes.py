"""Faults injected into simulated captures are called by their names; a share of what `prove_causes` runs."""

import json

import pytest

from slviewer.validation.faulty_captures import FAULTS
from slviewer.validation.proof import Proof
from slviewer.validation.prove_causes import prove_causes

pytestmark = pytest.mark.computes

SINGLE = (
    "board transposed in one pose",
    "board shifted by a row in one pose",
    "one pose moved between the axes",
    "fifth frame missing in one pose",
)
SHARE = (
    "x and y frames exchanged",
    "columns from right to left",
    "period 18 described as 16",
    "board of 20x16 given",
    "lag of one frame",
    "overexposed",
    "gamma 2.2",
    "boards facing the camera",
    "no pose in one corner",
    "two poses",
)
"""With SINGLE, of each cause one way or two in which it comes about."""
ALL = SINGLE + SHARE


@pytest.fixture(scope="module")
def proof() -> Proof:
    return prove_causes(0.15, faults=ALL, clean=1, poses=7, steps=6)


@pytest.mark.parametrize("fault", ALL)
def test_each_cause_is_named_first(proof: Proof, fault: str) -> None:
    case = next(case for case in proof.record["cases"] if case["fault"] == fault)
    assert case["causes"][0] == FAULTS[fault][0], case
    assert case["findings"][0][-1] not in ".:"
    assert (case["level"] == "good") == (fault in SINGLE)  # one pose is excluded, and the others are sound


def test_clean_calibrations_raise_no_alarm(proof: Proof) -> None:
    clean = [case for case in proof.record["cases"] if case["cause"] is None]
    assert [(case["causes"], case["level"]) for case in clean] == [([], "good")]


def test_the_table_says_it_all(proof: Proof) -> None:
    assert proof.holds and f"{len(ALL) + 1} of {len(ALL) + 1} named rightly" in proof.text()
    data = json.loads(json.dumps(proof.to_json()))
    assert data["holds"] and data["confusion"]["none"] == {"none": 1}
    assert all(list(row) == [cause] for cause, row in data["confusion"].items())
    assert {cause for cause, _ in FAULTS.values()} == {cause for cause, _ in (FAULTS[name] for name in ALL)}
