"""What was deleted or replaced is listed, and comes back in exchange for what has its name now."""

from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts

from slviewer.cli import main
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.store import Session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session with a capture in the trash, twice, and two results that a third one replaced."""
    folder = tmp_path / "session"
    sequence = PatternSequence((96, 64), tuple(phase_steps("x", 4, 16.0)))
    with Session.create(folder) as session:
        for value in (1, 2, 3):
            frames = np.full((4, 6, 8), value, np.uint8)
            session.save_capture("scan_01", "scan", sequence, frames, source="", force=True)
        for name in ("stereo", "splined"):
            session.save_result(f"calibration/{name}", {"age": "old"}, {})
        with session.together():
            session.trash_result("calibration/stereo")
            session.trash_result("calibration/splined")
            session.save_result("calibration/stereo", {"age": "imported"}, {})
    return folder


def test_the_trash_is_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["restore", str(folder)]) == 0
    lines = capsys.readouterr().out.split("---\n")[1].splitlines()
    assert [line.split()[:2] for line in lines if line.startswith("scan_01")] == [
        ["scan_01", "capture"]
    ] * 2
    assert {line.split()[0] for line in lines} == {
        "scan_01",
        "calibration/stereo",
        "calibration/splined",
    }


def test_what_has_the_name_now_takes_its_place_in_the_trash(folder: Path) -> None:
    assert main(["restore", str(folder), "calibration/*"]) == 0
    with Session.open(folder) as session:
        ages = {name: session.load_result(name)[0]["age"] for name in session.result_names()}
        assert ages == {"calibration/stereo": "old", "calibration/splined": "old"}
    assert main(["restore", str(folder), "calibration/stereo"]) == 0
    with Session.open(folder) as session:
        assert session.load_result("calibration/stereo")[0]["age"] == "imported"


def test_one_of_several_versions_is_named_by_its_folder(folder: Path) -> None:
    with Session.open(folder) as session:
        assert session.load_capture("scan_01").frames.max() == 3
        first = session.trashed()[-1]
    assert main(["restore", str(folder), "scan_01"]) == 0
    with Session.open(folder) as session:
        assert session.load_capture("scan_01").frames.max() == 2
    assert main(["restore", str(folder), first.place.name]) == 0
    with Session.open(folder) as session:
        assert session.load_capture("scan_01").frames.max() == 1
        assert len(session.trashed()) == 4


def test_an_unknown_name_changes_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["restore", str(folder), "scan_02"]) == 1
    assert not missing_facts(capsys.readouterr().err, "'scan_02'")
    with Session.open(folder) as session:
        assert session.load_capture("scan_01").frames.max() == 3
