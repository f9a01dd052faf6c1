"""Files of random form are read in full, or what is not read is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.proofs.file_variants.variant import Points
from tests.proofs.files import DRAWS, KINDS, judge, prove_files

_SEED = 49
_OF_CALIBRATIONS = list(DRAWS)[list(DRAWS).index("ros") :]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in _OF_CALIBRATIONS else [])
        for name in DRAWS
    ],
)
def test_a_file_is_read_or_what_is_not_read_is_named(name: str, tmp_path: Path) -> None:
    draw, _ = DRAWS[name]
    for child in np.random.SeedSequence(_SEED).spawn(4):
        variant = draw(np.random.default_rng(child))
        kind, text = judge(variant, tmp_path)
        assert kind in ("equal", "said"), f"{kind} [{variant.form}]: {text}"


def test_faults_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge a file whose truth is another, one whose reason is another, and a reader that fails."""
    variant = DRAWS["pts"][0](np.random.default_rng(_SEED))
    shifted = replace(variant, truth=Points(variant.truth.points + 0.001))
    assert judge(shifted, tmp_path)[0] == KINDS[2]
    unnamed = replace(variant, extras=[["nothing of this name"]])
    assert judge(unnamed, tmp_path)[0] == KINDS[2]
    short = replace(variant, content=variant.content[:-500], extras=(), reasons=("colour",))
    assert judge(short, tmp_path)[0] == KINDS[3]
    monkeypatch.setattr("tests.proofs.files.read_cloud", lambda path: 1 / 0)
    assert judge(variant, tmp_path)[0] == KINDS[4]


@pytest.mark.slow
@pytest.mark.computes
def test_all_formats_are_proved() -> None:
    proof = prove_files(0.1, 3, lambda done, doing: None)
    assert proof.holds, proof.text()
    assert set(proof.record["formats"]) >= {"ply", "pcd", "table", "ros", "opencv"}
