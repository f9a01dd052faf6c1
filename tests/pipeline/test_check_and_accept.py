"""The drift check and the acceptance test on sessions: what is kept, told and applied."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from artefact_places import Place, bar_places
from copies import copy_session
from facts import missing_facts, raises
from sound_checks import save_sound_checks

from slviewer.errors import InputError
from slviewer.fringe.presets import complementary, p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.accept import REFERENCE, accept, check, load_drift_history
from slviewer.pipeline.cloud_corrections import scale_factor
from slviewer.pipeline.imported_verdict import judge_imported, list_transform_checks
from slviewer.pipeline.models import load_stereo
from slviewer.pipeline.operation import next_name, save_record
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.calibration import TransformCheck
from slviewer.session.store import Session
from slviewer.simulation.boards import printed_board
from slviewer.simulation.plans import rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres
from slviewer.target.board import Board

pytestmark = pytest.mark.computes

BOARD = Board.parse("circles:21x16:9")
ARTEFACT = """
kind = "ball-bar"
name = "bar"
certificate = "K 1"
[calibrated]
spacing_mm = {spacing}
spacing_U_mm = 0.001
diameter_mm = 38.1
diameter_U_mm = 0.001
expansion_ppm_K = 11.5
expansion_U_ppm_K = 1.0
[measured]
temperature_C = 20.0
temperature_U_K = 0.1
captures = ["bar_*"]
[limits]
spacing_mm = {limit}
"""


def bar(place: Place) -> Spheres:
    T = place.T_camera_artefact
    return Spheres(T[:3, 3] + np.array([[-50.0], [50.0]]) * T[:3, 0], 19.05)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    """A session whose imported calibration is the truth, with seven bars."""
    folder = tmp_path_factory.mktemp("accept") / "session"
    rig = letter(0.25, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, place in enumerate(bar_places(load_stereo(store).rig, (500.0, 700.0), 100.0, 38.1)):
            renderer = Renderer(rig, bar(place))
            store.save_capture(
                f"bar_{i}", "scan", sequence, renderer.capture(sequence, i), source="simulated"
            )
        save_sound_checks(store)
    return folder


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A session with an imported calibration alone."""
    with Session.create(tmp_path / "session") as store:
        save_true_stereo(store, letter(0.25))
    return tmp_path / "session"


@pytest.fixture
def still(measured: Path, tmp_path: Path) -> Path:
    """A copy of the seven bars, with four more captures of the first one."""
    folder, rig = (
        Path(shutil.copytree(measured, tmp_path / "session")),
        letter(0.25, seed=2, local_distortion_px=0),
    )
    sequence = one_axis(p18(rig.projector.size), "x")
    with Session.open(folder, write=True) as store:
        place = bar_places(load_stereo(store).rig, (500.0, 700.0), 100.0, 38.1)[0]
        renderer = Renderer(rig, bar(place))
        for k in range(4):
            frames = renderer.capture(sequence, 100 + k)
            store.save_capture(f"still_{k}", "scan", sequence, frames, source="simulated")
        save_sound_checks(store)
    return folder


def artefact(folder: Path, spacing: float = 100.0, limit: float = 0.1) -> Path:
    path = folder / "bar.toml"
    path.write_text(ARTEFACT.format(spacing=spacing, limit=limit))
    return path


@pytest.mark.slow
def test_accept_finds_a_scale_and_applies_it_on_request(still, tmp_path):
    measured = still
    short = artefact(tmp_path, 100.0 / (1 + 500e-6))  # against a certificate that says 500 ppm less
    found = accept(measured, short, still=[f"still_{k}" for k in range(4)])
    first = found.only
    scale = first.scale
    assert scale.ppm == pytest.approx(500, abs=2 * scale.u_ppm) and 2 * scale.u_ppm < 200
    assert first.scale_applied is None and not missing_facts(found.text(), "--apply-scale")
    assert first.repeatability.sigma_mm == pytest.approx(first.repeatability.predicted_mm, rel=0.15)
    assert first.budget.unknown == ["drift"] and first.budget.U_mm > 2e-6 * scale.ppm * 99
    applied = accept(measured, short, apply_scale=True).only
    assert applied.scale_applied == pytest.approx(1 / (1 + 1e-6 * scale.ppm), abs=1e-9)
    again = accept(measured, short).only
    assert again.scale_factor == applied.scale_applied and abs(again.scale.ppm) < 1
    assert again.budget.U_mm < first.budget.U_mm
    with Session.open(measured) as store:
        assert scale_factor(store, "stereo") == applied.scale_applied
        kept = store.load_result("scale/stereo")[0]
        assert kept["certificate"] == "K 1" and kept["captures"] == [f"bar_{i}" for i in range(7)]
        assert len([n for n in store.result_names() if n.startswith("acceptance/")]) == 3
    assert again.decision in ("pass", "undecided", "fail")


@pytest.mark.parametrize(("spacing", "decision"), [(100.0, "pass"), (101.0, "fail")])
def test_accept_decides(measured, tmp_path, spacing, decision):
    assert accept(measured, artefact(tmp_path, spacing, 0.2)).only.decision == decision


def test_accept_names_what_is_missing(bare, tmp_path):
    path = artefact(tmp_path)
    path.write_text(path.read_text().replace("bar_*", "beam_*"))
    with raises(InputError, "'beam_*'"):
        accept(bare, path)
    path.write_text("kind = ")
    with raises(InputError, path.name, "TOML"):
        accept(bare, path)


@pytest.fixture
def calibrated(recorded: Path, tmp_path: Path) -> Path:
    """A copy of the recorded session: its target poses, and their calibration."""
    folder, others = tmp_path / "session", shutil.ignore_patterns("object_*", "plane_*", "sphere_*")
    return copy_session(recorded / "session", folder, ignore=others)


def capture_board(folder: Path, name: str) -> None:
    """Capture the board later: with the rig as it was (same), turned by 0.2 mrad (panned), or along
    one_axis alone."""
    rig = letter(0.25)  # the recorded one
    both, turn = complementary(rig.projector.size, steps=4), rotation(np.array([0.0, 2e-4, 0.0]))
    pose = target_poses(replace(rig, seed=6), BOARD, 3)[0]
    moved = replace(rig, R=turn @ rig.R, t=turn @ rig.t) if name == "panned" else rig
    sequence = one_axis(both, "x") if name == "one_axis" else both
    frames = Renderer(moved, printed_board(BOARD, pose)).capture(sequence, 50)
    with Session.open(folder, write=True) as store:
        store.save_capture(name, "scan", sequence, frames, source="simulated")


@pytest.mark.slow
def test_check_finds_a_projector_that_was_turned(calibrated: Path) -> None:
    capture_board(calibrated, "panned")
    panned = check(calibrated, "panned").only
    assert panned.verdict == "recalibrate" and not missing_facts(panned.reasons[0], "pan")
    with Session.open(calibrated) as store:
        assert load_drift_history(store) == [panned] and store.state_of(REFERENCE) == "fresh"


@pytest.mark.slow
def test_one_of_eight_poses_cannot_be_checked_by_the_others(calibrated: Path) -> None:
    with raises(InputError, "pose_03", "own 8 poses", "7 others", "once more"):
        check(calibrated, "pose_03")


@pytest.mark.slow
def test_check_answers_and_remembers(calibrated: Path) -> None:
    for name in ("same", "panned", "one_axis"):
        capture_board(calibrated, name)
    first = check(calibrated, "same")
    assert first.only.verdict == "still good" and first.notes == ()
    second = check(calibrated, "panned")
    panned = second.only
    assert panned.verdict == "recalibrate" and not missing_facts(panned.reasons[0], "pan")
    assert not missing_facts(
        second.text(), "same", "still good", f"{panned.scale_ppm:.0f}".replace("-", "−")
    )
    single = check(calibrated, "one_axis").only
    assert single.verdict == "still good" and any(
        not missing_facts(s, "axis x") for s in single.unseen
    )
    with Session.open(calibrated) as store:
        assert [each.capture for each in load_drift_history(store)] == [
            "same",
            "panned",
            "one_axis",
        ]
        assert load_drift_history(store)[1] == panned
        assert store.state_of(REFERENCE) == "fresh"


def test_check_of_an_imported_calibration_by_one_axis_names_what_it_takes(measured):
    found = check(measured, "bar_0").only
    assert found.answer == "undecided" and not found.is_good
    assert not missing_facts(found.remedy, "both axes", "--target", "--radius")
    with Session.open(measured) as store:
        assert list_transform_checks(store)[-1] == found


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({}, ()),
        ({"T": 0.1}, ("cm", "--unit")),
        pytest.param({"T": 1 / 25.4}, ("inch",), marks=pytest.mark.slow),
        ({"inverted": 1.0}, ("R", "T", "inverted")),
    ],
)
def test_a_board_along_one_axis_checks_an_imported_calibration(tmp_path, changes, facts):
    rig = letter(0.25, seed=3, local_distortion_px=0)
    R, t = (rig.R.T, -rig.R.T @ rig.t) if "inverted" in changes else (rig.R, rig.t)
    sequence = one_axis(p18(rig.projector.size), "x")
    with Session.create(tmp_path / "session") as store:
        save_true_stereo(store, rig, R=R, T=t * changes.get("T", 1.0))
        meta = store.load_meta("calibration/stereo")
        given = {key: meta[key] for key in ("imported", "camera", "projector", "inputs")}
        store.save_result("calibration/stereo", {**given, "source": "rig.yml"}, {})
        renderer = Renderer(rig, printed_board(BOARD, target_poses(rig, BOARD, 1)[0], seed=3))
        frames = renderer.capture(sequence, 1)
        store.save_capture("board", "scan", sequence, frames, source="simulated")
        save_sound_checks(store)
        found = check(store, "board", target="circles:21x16:9").only
        level = judge_imported(store).level
    assert found.answer == ("disagrees" if facts else "agrees"), found.summary()
    assert level == ("rejected" if facts else "good") and not missing_facts(found.remedy, *facts)
    assert found.scale == pytest.approx(1 / changes.get("T", 1.0), rel=0.01) or "inverted" in facts


def test_the_last_check_that_knows_a_length_decides(bare):
    with Session.open(bare, write=True) as store:
        meta = store.load_meta("calibration/stereo")
        given = {key: meta[key] for key in ("imported", "camera", "projector", "inputs")}
        store.save_result("calibration/stereo", {**given, "source": "rig.yml"}, {})
        inputs = store.input_hashes("calibration/stereo")

        def level(answer: str, evidence: str, scale: float | None) -> str:
            found = TransformCheck(
                capture="a", answer=answer, evidence=evidence, scale=scale, inputs=inputs,
                depth_mm=600.0,
            )  # fmt: skip
            save_record(store, next_name(store, TransformCheck), found, {})
            return judge_imported(store).level

        assert judge_imported(store).level == "doubtful"
        assert level("undecided", "single axis", None) == "doubtful"
        assert level("disagrees", "two axes", None) == "rejected"
        assert level("agrees", "two axes", None) == "good"
        assert level("disagrees", "board", 10.0) == "rejected"
        assert level("agrees", "two axes", None) == "rejected"
        assert level("agrees", "sphere", 1.0) == "good"
