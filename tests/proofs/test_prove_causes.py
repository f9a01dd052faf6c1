"""Faults injected into simulated captures are called by their names; a share of what `prove_causes`
runs."""

import json
from functools import cache, partial

import pytest
from facts import missing_facts

from slviewer.pipeline.operation import ignore_progress
from tests.proofs import causes
from tests.proofs.causes import FAULTS, FaultBench
from tests.proofs.proof import Proof

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
FEW = ("two poses",)
"""Few captures are rendered and read; `tests/calibration/test_diagnosis.py` judges the evidence of
the others."""
REST = tuple(fault for fault in ALL if fault not in FEW)


@cache
def prove(faults: tuple[str, ...]) -> Proof:
    """The proof of some faults, and of a clean calibration beside REST."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(causes, "FAULTS", {name: FAULTS[name] for name in faults})
        patch.setattr(causes, "FaultBench", partial(FaultBench, steps=6))
        patch.setattr(causes, "POSES", 7)
        patch.setattr(causes, "CLEAN", int(faults == REST))
        return causes.prove_causes(0.15, 0, ignore_progress)


def test_every_cause_has_a_fault_here() -> None:
    assert {cause for cause, _ in FAULTS.values()} == {FAULTS[name][0] for name in ALL}


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    "fault", [*FEW, *(pytest.param(fault, marks=pytest.mark.slow) for fault in REST)]
)
def test_each_cause_is_named_first(fault: str) -> None:
    proof = prove(FEW if fault in FEW else REST)
    case = next(case for case in proof.record["cases"] if case["fault"] == fault)
    assert case["causes"][0] == FAULTS[fault][0], case
    assert case["findings"][0][-1] not in ".:"
    # one pose is excluded, and the others are sound
    assert (case["level"] == "good") == (fault in SINGLE)


@pytest.mark.computes
@pytest.mark.slow
def test_clean_calibrations_raise_no_alarm() -> None:
    clean = [case for case in prove(REST).record["cases"] if case["cause"] is None]
    assert [(case["causes"], case["level"]) for case in clean] == [([], "good")]


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize(
    "faults", [FEW, pytest.param(REST, marks=pytest.mark.slow)], ids=["few", "rest"]
)
def test_the_table_counts_what_was_named(faults: tuple[str, ...]) -> None:
    proof, clean = prove(faults), int(faults == REST)
    count = len(faults) + clean
    assert proof.holds and missing_facts(proof.text(), f"{count} of {count}") == []
    data = json.loads(json.dumps(proof.to_json()))
    assert data["holds"] and data["confusion"].get("none", {}) == ({"none": 1} if clean else {})
    assert all(list(row) == [cause] for cause, row in data["confusion"].items())
