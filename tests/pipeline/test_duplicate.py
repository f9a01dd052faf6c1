"""A new session with the calibration of another: usable as it is, without its scans."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from slviewer.errors import InputError, SessionError
from slviewer.pipeline.duplicate import duplicate_calibration
from slviewer.pipeline.import_cloud import import_cloud
from slviewer.pipeline.models import available_models
from slviewer.session.store import Session
from slviewer.wizard.session_reader import read_overview


def test_duplicate_has_a_fresh_calibration_and_no_scan(recorded: Path, tmp_path: Path) -> None:
    source = tmp_path / "bracket"
    shutil.copytree(recorded / "session", source)
    with Session.open(source, write=True) as old:
        poses = old.capture_names("calibration")
        old.exclude(poses[0])
        old.decide("names", {"scan_01": "the part"})
        models = available_models(old)
    before = read_overview(source)
    assert duplicate_calibration(source, tmp_path / "bracket-2") == poses
    shutil.rmtree(source)  # what is linked stays
    with Session.open(tmp_path / "bracket-2", write=True) as new:
        assert new.capture_names() == poses and list(new.excluded()) == [poses[0]]
        assert available_models(new) == models and new.decision("names") is None
        assert all(new.state_of(f"calibration/{model}") == "fresh" for model in models)
        assert new.load_capture(poses[1]).verify()
        new.exchange({poses[1]: None})
    after = read_overview(tmp_path / "bracket-2")
    assert (before.verdict, before.is_calibrated) == (after.verdict, after.is_calibrated)
    assert before.holds.startswith("8 poses, ") and after.holds == "7 poses, 0 scans"
    assert before.thumbnail and after.thumbnail and not after.fault


def test_duplicate_of_nothing_leaves_nothing(tmp_path: Path) -> None:
    Session.create(tmp_path / "empty").close()
    with pytest.raises(InputError, match="no calibration"):
        duplicate_calibration(tmp_path / "empty", tmp_path / "copy")
    with pytest.raises(SessionError):
        duplicate_calibration(tmp_path / "none", tmp_path / "copy")
    assert [each.name for each in tmp_path.iterdir()] == ["empty"]
    assert read_overview(tmp_path / "empty").holds == "0 poses, 0 scans"

    (tmp_path / "empty" / "session.json").write_text("{")
    assert "session.json" in read_overview(tmp_path / "empty").fault


def test_overview_of_imported_clouds_has_no_picture(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "part.xyz", np.random.default_rng(0).normal((0, 0, 500), 20, (500, 3)))
    with Session.create(tmp_path / "clouds") as session:
        import_cloud(session, [tmp_path / "part.xyz"])
    overview = read_overview(tmp_path / "clouds")
    assert "1 scan" in overview.holds and not overview.thumbnail
