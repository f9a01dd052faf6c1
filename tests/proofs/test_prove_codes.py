"""Frames of other programs are decoded to known coordinates, or what is wrong is named."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.proofs.codes import DESCRIPTIONS, KINDS, draw_folders, judge, prove_codes

pytestmark = pytest.mark.computes
_SEED = 491


MISJUDGED = [
    (9101, "offset", 1), (9101, "bits turned", 0), (9101, "inverses exchanged", 1),
    (9101, "period", 3), (9104, "period", 3), (9104, "names", 3), (9104, "late", 3),
    (9104, "offset", 4), (9104, "axes", 1), (9201, "sign", 0), (9201, "white and black", 2),
    (9201, "names", 10), (9201, "late", 13), (9201, "right", 22),
    (9401, "late", 18), (9401, "names", 13),
]  # fmt: skip
"""Seed, description, and index of folders that were decoded wrongly in silence, refused though they
are right, or blamed for something else."""


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "description", "index"), MISJUDGED)
def test_folders_that_were_misjudged(
    seed: int, description: str, index: int, tmp_path: Path
) -> None:
    *_, folder = draw_folders(seed, description, index + 1)
    kind, text = judge(folder, tmp_path)
    assert kind == "right" or (description != "right" and kind == "said"), text


@pytest.mark.slow
@pytest.mark.parametrize("description", DESCRIPTIONS)
def test_a_folder_is_decoded_or_its_fault_is_named(description: str, tmp_path: Path) -> None:
    for i, folder in enumerate(draw_folders(_SEED, description, 2)):
        kind, text = judge(folder, tmp_path / f"{i}")
        assert kind in KINDS[:3], f"{kind} [{folder.form}]: {text}"


def test_faults_are_told_apart(tmp_path: Path) -> None:
    """Judge a sound folder, one whose truth is another, and one whose fault has another name."""
    (folder,) = draw_folders(_SEED, "right", 1)
    assert judge(folder, tmp_path / "right")[0] == "right"
    moved = {axis: each + 3.0 for axis, each in folder.scene.coordinates.items()}
    scene = replace(folder.scene, coordinates=moved)
    assert judge(replace(folder, scene=scene), tmp_path / "moved")[0] == "SILENT"
    (folder,) = draw_folders(_SEED, "missing", 1)
    assert judge(folder, tmp_path / "missing")[0] == "said"
    assert judge(replace(folder, reasons=("glare",)), tmp_path / "named")[0] == "WRONG REASON"


@pytest.mark.slow
def test_all_descriptions_are_proved() -> None:
    proof = prove_codes(0.05, 3, lambda done, doing: None)
    assert set(proof.record["descriptions"]) == {*DESCRIPTIONS}
    assert not proof.record.get("fault"), proof.text()
