"""How verdicts on parts are counted."""

from dataclasses import replace

import pytest

from tests.proofs.part_cases import CaseSetup
from tests.proofs.parts import (
    JudgedCase,
    judge_part_case,
    prove_parts,
    summarize_parts,
)

RIGHT = CaseSetup(0, 0, "pins", "none", 0.0, "full", "none", "imported")
WRONG = replace(RIGHT, fault="moved", size=5.0)


def judged(setup, verdict, *, in_view=True, right=None):
    return JudgedCase(setup, verdict, False, in_view, 1.0, 9, right, right, (), "", 0.1)


@pytest.mark.parametrize(
    ("setup", "verdict", "outcome"),
    [
        (RIGHT, "pass", "right"),
        (RIGHT, "fail", "FALSE FAIL"),
        (RIGHT, "refused", "refused"),
        (WRONG, "pass", "FALSE PASS"),
        (WRONG, "fail", "right"),
        (WRONG, "undecided", "undecided"),
    ],
)
def test_outcomes(setup, verdict, outcome) -> None:
    assert judged(setup, verdict).outcome == outcome
    assert judged(WRONG, "pass", in_view=False).outcome == "not in view"


def test_claim_holds_only_without_false_verdicts() -> None:
    good = [judged(RIGHT, "pass"), judged(WRONG, "fail", right=True)]
    assert summarize_parts(good, 1.0).holds
    for bad in (judged(WRONG, "pass"), judged(RIGHT, "fail"), judged(WRONG, "fail", right=False)):
        proof = summarize_parts([*good, bad], 1.0)
        assert not proof.holds and repr(bad.setup) in proof.text()


@pytest.mark.computes
def test_a_plain_case_is_judged() -> None:
    assert judge_part_case(replace(RIGHT, seed=1)).verdict in ("pass", "undecided")


@pytest.mark.slow
@pytest.mark.computes
def test_no_wrong_part_passes_and_no_right_one_fails() -> None:
    proof = prove_parts(0.04, 5, lambda share, message: None)
    false = [line for line in proof.text().splitlines() if line.startswith("FALSE")]
    assert not false and len(proof.record["cases"]) > 40, proof.text()
