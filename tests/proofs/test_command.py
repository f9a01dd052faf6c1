"""`python -m tests.proofs`: what it runs, prints, and how it ends."""

import json
from dataclasses import dataclass
from typing import Any

import pytest

from tests.proofs import __main__ as prove

main = prove.main


@dataclass(frozen=True)
class Outcome:
    """A proof that took no time."""

    holds: bool

    def text(self) -> str:
        return "a table"

    def to_json(self) -> dict[str, Any]:
        return {"holds": self.holds}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[float, int]]:
    """Each proof that ran, with its scale and seed; causes are not named."""
    ran: dict[str, tuple[float, int]] = {}

    def stand_in(claim: str):
        def run(scale, *, seed, progress, **options):
            ran[claim] = scale, seed
            progress(1.0, "proven")
            return Outcome(claim != "causes")

        return run

    for claim in prove.CLAIMS:
        monkeypatch.setitem(prove.CLAIMS, claim, (prove.CLAIMS[claim][0], stand_in(claim)))
    return ran


def test_all_claims_are_proved_and_one_that_fails_is_named(asked, tmp_path, capsys) -> None:
    out = tmp_path / "figures.json"
    assert main(["--json", str(out)]) == 1
    said = capsys.readouterr()
    assert asked == {claim: (0.5 if claim == "hostile" else 1.0, 0) for claim in prove.CLAIMS}
    assert said.out.count("a table") == len(prove.CLAIMS) == said.out.count("pass  ") + 1
    assert "FAIL  faults called" in said.out
    assert {claim: proof["holds"] for claim, proof in json.loads(out.read_text()).items()} == {
        "accuracy": True,
        "boards": True,
        "cameras": True,
        "causes": False,
        "codes": True,
        "edges": True,
        "files": True,
        "guidance": True,
        "hand-eye": True,
        "hostile": True,
        "laws": True,
        "limits": True,
        "parts": True,
        "pipelines": True,
        "plan": True,
        "registration": True,
        "reports": True,
        "rigs": True,
        "shown": True,
        "surfaces": True,
        "uncertainty": True,
    }


def test_some_claims_at_reduced_scale(asked, capsys) -> None:
    assert main(["uncertainty", "accuracy", "--quick", "--seed", "7"]) == 0
    assert asked == {"accuracy": (prove.QUICK_SCALE, 7), "uncertainty": (prove.QUICK_SCALE, 7)}
    said = capsys.readouterr()
    assert "FAIL" not in said.out and said.err == ""
    with pytest.raises(SystemExit, match="2"):
        main(["everything"])
