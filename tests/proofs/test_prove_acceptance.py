"""What an acceptance test must not pass, by the proof's own situations."""

import numpy as np
import pytest

from tests.proofs.acceptance import (
    FAULTS,
    judge_situation,
    make_rig,
    prove_acceptance,
)

pytestmark = pytest.mark.computes
QUICK = ("ball, right", "plate, right", "ball, deep dent", "bar, flat", "plate, bent corner")


def judge(fault: str, seed: int) -> tuple[str, str]:
    rng = np.random.default_rng([seed, FAULTS.index(fault)])
    return judge_situation(fault, make_rig(240), rng)


@pytest.mark.parametrize("fault", QUICK)
def test_only_right_artefacts_pass(fault: str) -> None:
    truth, decision = judge(fault, 3)
    assert decision == "pass" if truth == "right" else decision != "pass"


@pytest.mark.parametrize("fault", ["ball, covered fault", "bar, sparse", "ball, same place"])
def test_what_was_not_seen_does_not_pass(fault: str) -> None:
    assert judge(fault, 4)[1] in ("undecided", "refused", "fail")


@pytest.mark.slow
def test_no_situation_passes_wrongly() -> None:
    proof = prove_acceptance(0.05, 5, lambda done, doing: None)
    assert proof.holds, proof.text()
