"""Frames of other programs are decoded to known coordinates, or what is wrong is named."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.proofs.codes import DESCRIPTIONS, KINDS, draw_folders, judge, prove_codes

pytestmark = pytest.mark.computes
_SEED = 491


UNSEEN = pytest.mark.xfail(reason="half a period along y is explained as flicker", strict=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "description",
    [pytest.param(name, marks=UNSEEN if name == "offset" else ()) for name in DESCRIPTIONS],
)
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
