"""Figures follow their units, and sentences stay, in sessions that are the same rig."""

import pytest

from tests.proofs.laws import LAWS, PARTS, Law, compare_records, prove_laws

pytestmark = pytest.mark.computes

BASE = {
    "rms_mm": 0.02,
    "sigma_volume_mm": {"median": 0.03, "supported": 0.8},
    "quantities": [{"name": "area", "value": 90.0, "unit": "%", "sigma": None}],
    "warnings": ["the worst of 3 poses is 0.2 mm off"],
    "excluded": 500,
}


def test_a_law_tells_figures_that_follow_it_from_others() -> None:
    law = Law("larger", 10.0)
    scaled = BASE | {"rms_mm": 0.2, "sigma_volume_mm": {"median": 0.3, "supported": 0.8}}
    assert not list(compare_records(law, BASE, scaled))
    wrong = scaled | {"rms_mm": 0.02, "excluded": 520, "warnings": ["it scatters"]}
    assert [each.place for each in compare_records(law, BASE, wrong)] == [
        "excluded",
        "rms_mm",
        "warnings.0",
    ]
    (missing,) = compare_records(law, BASE, {k: v for k, v in scaled.items() if k != "warnings"})
    assert missing.place == ".warnings" and missing.found == "nothing"


def test_a_law_of_a_part_that_never_changes_expects_its_note_and_no_other() -> None:
    law = PARTS[0]
    note, other = ({"cause": cause, "severity": "note"} for cause in ("constant-pixels", "gamma"))
    base = {"stereo": {"verdict": {"findings": [], "level": "good"}}}

    def changed(*findings: dict[str, str]) -> dict[str, object]:
        return {"stereo": {"verdict": {"findings": [*findings], "level": "good"}}}

    assert not list(compare_records(law, base, changed(note)))
    assert len(list(compare_records(law, base, changed()))) == 1
    assert len(list(compare_records(law, base, changed(note, other)))) == 1
    assert len(list(compare_records(Law("as it is"), base, changed(note)))) == 1


@pytest.mark.slow
def test_what_never_changes_is_no_image() -> None:
    laws = [law for law in PARTS if law.name in ("grey bars beside it", "dead column")]
    assert len(laws) == 2
    proof = prove_laws(0.25, 4, lambda share, stage: None, laws)
    assert proof.holds, proof.text()


@pytest.mark.slow
def test_a_pose_that_is_there_twice_changes_no_verdict() -> None:
    laws = [law for law in LAWS if law.name == "each pose twice"]
    assert len(laws) == 1
    proof = prove_laws(0.25, 4, lambda share, stage: None, laws)
    assert proof.holds, proof.text()


def test_a_law_of_other_pixels_compares_lengths_and_sentences() -> None:
    law = Law("enlarged", resamples=True)
    assert not list(compare_records(law, BASE, BASE | {"excluded": 2000}))
    (wrong,) = compare_records(law, BASE, BASE | {"excluded": 2000, "rms_mm": 0.1})
    assert wrong.place == "rms_mm"


def test_a_law_of_copies_ignores_what_is_known_of_these_alone() -> None:
    law = Law("twice", repeats=True)
    base = {"residuals": {"pose_1": 0.5}, "used": ["pose_1"], "found": [{"name": "pose_1"}]}
    again = {
        "residuals": {"pose_1": 0.5, "pose_1_again": 0.5},
        "used": ["pose_1", "pose_1_again"],
        "found": [{"name": "pose_1"}, {"name": "pose_1_again"}],
    }
    assert not list(compare_records(law, base, again))
    assert list(compare_records(law, base, again | {"residuals": {"pose_1_again": 0.5}}))


@pytest.mark.slow
def test_a_world_of_another_size_gives_the_same_figures_in_its_unit() -> None:
    laws = [law for law in LAWS if law.scale in (0.05, 50.0)]
    assert len(laws) == 2
    proof = prove_laws(0.25, 4, lambda share, stage: None, laws)
    assert proof.holds, proof.text()
