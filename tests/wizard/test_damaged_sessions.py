"""The wizard on damaged files: what is sound is shown, what is not is named, and the page shows the
present state."""

import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts, raises
from wizard_events import HANG_S, SPARING, list_texts

from slviewer.errors import SlviewerError
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.gui.app import run
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.publisher import Publisher
from slviewer.wizard.snapshot import RigView, Snapshot

SEQUENCE = PatternSequence((96, 64), tuple(phase_steps("x", 4, 16.0)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session of two scans and two poses, with a cloud, a merge and a verification as its
    results."""
    rng = np.random.default_rng(0)
    with Session.create(tmp_path / "session") as session:
        for name in ("scan_01", "scan_02", "pose_01", "pose_02"):
            frames = rng.integers(0, 255, (4, 30, 40), np.uint8)
            session.save_capture(
                name, "calibration" if "pose" in name else "scan", SEQUENCE, frames, source=""
            )
    return tmp_path / "session"


@pytest.fixture
def operator(folder: Path) -> Iterator[Operator]:
    with Operator(folder, timing=SPARING) as operator:
        operator.wait_until_idle(HANG_S)
        yield operator


def test_a_snapshot_that_fails_is_reported_and_built_again() -> None:
    faults: list[Exception] = [
        KeyError("target"),
        OSError(5, "Input/output error"),
        SlviewerError("it is damaged"),
    ]

    def build(version: int, session_changed: bool) -> Snapshot:
        if version > 1:
            assert session_changed
        if faults:
            raise faults.pop(0)
        return Snapshot(version, None, RigView(), None, None, (), (), None, False, "done")

    tested = Publisher(
        build, Snapshot(0, None, RigView(), None, None, (), (), None, False, ""), retry_s=0.05
    )
    shown: list[Snapshot] = []
    tested.listeners.add(shown.append)
    tested.start()
    tested.mark_changed()
    assert tested.wait_for(lambda snapshot: snapshot.autopilot == "done", HANG_S)
    tested.close()
    assert [snapshot.version for snapshot in shown] == [1, 2, 3, 4]
    assert missing_facts(shown[0].read_failure, "KeyError") == []
    assert missing_facts(shown[1].read_failure, "Input/output error") == []
    assert (shown[2].read_failure, shown[3].read_failure) == ("it is damaged", "")


def test_what_is_sound_is_shown_and_what_is_not_is_named(folder: Path) -> None:
    captures = folder / "captures"
    shutil.copytree(captures / "pose_01", captures / "pose_01 (copy)")
    (captures / "scan_02" / "capture.json").write_text("{")
    with Session.open(folder, write=True) as session:
        for name in (
            "clouds/scan_01",
            "merge/1",
            "verify/scan_01",
            "poses/pose_01",
            "calibration/stereo",
        ):
            session.save_result(name, {"inputs": {}}, {})
    for name in ("clouds/scan_01", "calibration/stereo"):
        (folder / "results" / name / "meta.json").write_text("{")
    with Operator(folder, timing=SPARING) as operator:
        shown = operator.wait_for(lambda snapshot: len(list_texts(operator, "error")) >= 6, HANG_S)
        assert shown is not None and shown.session is not None and not shown.read_failure
        session = shown.session
        assert [pose.name for pose in session.poses] == ["pose_01", "pose_02"]
        assert [scan.name for scan in session.scans] == ["scan_01"]
        faults = "\n".join(session.faults)
        for name in (
            "pose_01 (copy)",
            "captures/scan_02",
            "clouds/scan_01",
            "calibration/stereo",
            "merge/1",
            "verify/",
        ):
            assert name in faults
        assert set(session.faults) <= set(list_texts(operator, "error"))
        shutil.rmtree(captures / "pose_01 (copy)")
        assert operator.choose_target("circles:7x5:20")
        assert operator.wait_for(
            lambda s: not any("(copy)" in fault for fault in s.session.faults), HANG_S
        )  # type: ignore[union-attr]


def test_the_page_shows_the_present_state_while_a_file_is_damaged(
    operator: Operator, folder: Path
) -> None:
    (folder / "decisions.json").write_text("{")
    assert not operator.choose_target("circles:7x5:20")
    operator.show(autopilot="going on")
    failed = operator.wait_for(
        lambda snapshot: bool(snapshot.session and snapshot.session.faults), HANG_S
    )
    assert failed is not None and failed.session is not None
    assert (
        missing_facts(failed.session.faults[0], "decisions.json") == []
        and len(failed.session.scans) == 2
    )
    (folder / "decisions.json").write_text(json.dumps({"names": {"scan_01": "a vase"}}))
    assert operator.choose_target("circles:7x5:20")
    recovered = operator.wait_for(
        lambda snapshot: bool(snapshot.session and not snapshot.session.faults), HANG_S
    )
    assert recovered is not None and recovered.session is not None
    assert [scan.label for scan in recovered.session.scans] == ["a vase", "scan_02"]


def test_a_damaged_pose_is_refused_by_name(folder: Path) -> None:
    chunk = folder / "captures/pose_02/frames.zarr/c.1.0.0"
    chunk.write_bytes(bytes(chunk.stat().st_size))
    with Operator(folder, timing=SPARING) as operator:
        assert operator.choose_target("circles:7x5:20")
        operator.wait_until_idle(HANG_S)
        shown = operator.wait_for(
            lambda s: bool(s.pose("pose_02")) and s.pose("pose_02").state == "refused", HANG_S
        )  # type: ignore[union-attr]
        assert shown is not None
        assert missing_facts(shown.pose("pose_02").why, "frame 2 of 4", "damaged") == []  # type: ignore[union-attr]


def test_the_reason_why_the_wizard_cannot_start_is_stated(folder: Path) -> None:
    (folder / "session.json").write_text("{")
    with raises(SlviewerError, "session.json"):
        run(folder, open_browser=False)


def test_a_session_opens_whose_decisions_are_damaged(folder: Path) -> None:
    (folder / "decisions.json").write_text("{")
    with Operator(folder, timing=SPARING) as operator:
        shown = operator.wait_until_idle(HANG_S).session
        assert shown is not None and len(shown.scans) == 2
        assert any(not missing_facts(fault, "decisions.json") for fault in shown.faults)
        assert not operator.choose_target("circles:7x5:20")  # which would forget the others
    assert (folder / "decisions.json").read_text() == "{"


@pytest.mark.process  # for the name of the processor
def test_diagnostics_are_written_of_a_damaged_session(folder: Path) -> None:
    with Session.open(folder, write=True) as session:
        session.save_result("clouds/scan_01", {}, {})
    with Operator(folder, timing=SPARING) as operator:
        operator.wait_until_idle(HANG_S)
        (folder / "decisions.json").write_bytes(b"{\xff")
        (folder / "results/clouds/scan_01/meta.json").write_text("{")
        assert operator.diagnostic_bundle()
        operator.wait_until_idle(HANG_S)
        (bundle,) = (folder / "exports").glob("diagnostics_*.zip")
        with zipfile.ZipFile(bundle) as inside:
            assert inside.read("session/decisions.json").startswith(b"{")
            assert b"meta.json" in inside.read("session/results/clouds/scan_01.json")


def test_captures_that_were_completed_on_opening_are_reported(folder: Path) -> None:
    (folder / "captures/scan_02").rename(folder / "captures/.scan_02.done-1-0a")
    with Operator(folder, timing=SPARING) as operator:
        shown = operator.wait_until_idle(HANG_S).session
        assert shown is not None and [scan.name for scan in shown.scans] == ["scan_01", "scan_02"]
        assert any("scan_02" in notice.text for notice in operator.notices())
