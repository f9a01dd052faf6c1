"""Requests and what becomes of them, on a small simulated rig: faults, resuming, decisions, hands-free."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from faulty_rig import FaultyRigs

from slviewer.session.store import Session
from slviewer.wizard import acquisition, preview_watcher
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Snapshot

pytestmark = pytest.mark.computes

RIG = {"driver": "simulated", "scale": 0.25, "seed": 0}
TARGET = "circles:21x16:9"
ROOT = Path(__file__).parents[3]


@pytest.fixture
def rigs(monkeypatch: pytest.MonkeyPatch) -> FaultyRigs:
    monkeypatch.setattr(acquisition, "RETRY_S", 0.1)
    return FaultyRigs()


@pytest.fixture
def operator(tmp_path: Path, rigs: FaultyRigs) -> Iterator[Operator]:
    with Operator(tmp_path / "session", RIG, set_up=rigs) as operator:
        operator.choose_target(TARGET)
        opened(operator)
        yield operator


def opened(operator: Operator) -> None:
    assert operator.wait_for(lambda s: s.rig.state == "open", 60)


def last(snapshot: Snapshot) -> str:
    return snapshot.notices[-1].text if snapshot.notices else ""


def states(snapshot: Snapshot) -> dict[str, str]:
    assert snapshot.session is not None
    return {pose.name: pose.state for pose in snapshot.session.poses}


def test_requests_that_cannot_be_granted_become_notices() -> None:
    with Operator() as operator:
        for ask, says in (
            (operator.capture_pose, "no session is open"),
            (operator.calibrate, "no session is open"),
            (lambda: operator.open_session("/proc/nowhere/session"), "cannot be made"),
            (lambda: operator.choose_rig({"driver": "no such"}), "no driver is called 'no such'"),
            (lambda: operator.choose_rig({"scale": 1}), "set up"),
            (lambda: operator.set_exposure(-1), "impossible"),
            (lambda: operator.export("nonsense"), "no session is open"),  # type: ignore[arg-type]
            (lambda: operator.place("board"), "simulated rig"),
        ):
            assert ask() is False
            assert says in last(operator.wait_until_idle()), last(operator.wait_until_idle())
        assert operator.snapshot().session is None and operator.snapshot().step("poses").state == "blocked"


def test_poses_are_judged_kept_and_found_again(operator: Operator, rigs: FaultyRigs, tmp_path: Path) -> None:
    versions: list[int] = []
    operator.subscribe(lambda snapshot: versions.append(snapshot.version))
    before = operator.wait_until_idle()
    assert before.session is not None and before.session.suggestion is not None and before.world is not None
    assert before.space is not None and before.space.capture_bytes == 32 * 400 * 300
    for _ in range(2):
        assert operator.place_at_suggestion() and operator.capture_pose()
        after = operator.wait_until_idle()
        assert after.session is not None and after.world is not None
        judged = after.session.poses[-1]
        assert judged.state == "good" and judged.thumbnail[:2] == b"\xff\xd8" and judged.T_camera_board is not None
        np.testing.assert_allclose(judged.T_camera_board, after.world.T_camera_object, atol=12)
    assert versions == sorted(set(versions)) and len(versions) > 5
    # a board that is not seen is refused, in words, and the suggestion changes
    T = np.eye(4)
    T[:3, 3] = [60, -60, 560]
    assert operator.place("board", T) and operator.capture_pose()
    refused = operator.wait_until_idle()
    assert states(refused) == {"pose_01": "good", "pose_02": "good", "pose_03": "refused"}
    assert "pose_03 cannot be used" in last(refused) and "in view" in refused.pose("pose_03").why  # type: ignore[union-attr]
    assert operator.exclude("pose_02", "blurred") and operator.rename("pose_01", "<b>first</b>")
    decided = operator.wait_until_idle()
    operator.close()
    with Operator(tmp_path / "session", set_up=rigs) as again:
        opened(again)
        resumed = again.wait_until_idle()
        assert resumed.session is not None and decided.session is not None
        assert states(resumed) == states(decided) == {"pose_01": "good", "pose_02": "excluded", "pose_03": "refused"}
        assert [(s.key, s.state, s.instruction) for s in resumed.steps] == [
            (s.key, s.state, s.instruction) for s in decided.steps
        ]
        assert resumed.rig.name == decided.rig.name and resumed.session.target == TARGET
        for a, b in zip(resumed.session.poses, decided.session.poses, strict=True):
            assert a.thumbnail == b.thumbnail and a.why == b.why
        np.testing.assert_array_equal(resumed.session.coverage.cells, decided.session.coverage.cells)  # type: ignore[union-attr]
        # what was decided can be undone, retaken, deleted
        assert again.include("pose_02") and again.delete("pose_03")
        assert again.place_at_suggestion() and again.retake_pose("pose_01")
        mended = again.wait_until_idle()
        assert states(mended) == {"pose_01": "good", "pose_02": "good"}
        assert len(list((tmp_path / "session" / "trash").iterdir())) >= 2
        # another target: what was judged by the old one is judged anew
        assert again.choose_target("circles:20x16:9")
        assert set(states(again.wait_until_idle()).values()) == {"refused"}


@pytest.mark.parametrize("fault", ["timeout", "unplugged"])
def test_a_device_that_fails_leaves_no_half_capture(operator: Operator, rigs: FaultyRigs, fault) -> None:
    store = operator.session
    assert store is not None and operator.place_at_suggestion()
    rigs.faults.plan(fault, 12)
    assert operator.capture_pose()
    failed = operator.wait_for(lambda s: any("answers again" in n.text for n in s.notices), 60)
    assert failed is not None and any("13 of 32" in n.text for n in failed.notices)
    assert store.capture_names() == [] and list((store.folder / "captures").iterdir()) == []
    opened(operator)
    assert operator.capture_pose()
    assert states(operator.wait_until_idle()) == {"pose_01": "good"}


def test_a_capture_that_is_killed_leaves_every_earlier_pose(tmp_path: Path) -> None:
    code = f"""
from slviewer.wizard.operator import Operator
operator = Operator({str(tmp_path / "session")!r}, {RIG!r})
operator.choose_target({TARGET!r})
operator.wait_for(lambda s: s.rig.state == "open", 60)
operator.place_at_suggestion()
operator.capture_pose()
operator.wait_until_idle()
operator.choose_patterns("p18")
operator.subscribe(lambda s: print(s.rig.capture.frame if s.rig.capture else "", flush=True))
operator.capture_pose()
operator.wait_until_idle()
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert any(line.strip().isdecimal() and int(line) > 3 for line in process.stdout)
    process.kill()
    process.wait()
    with Operator(tmp_path / "session") as operator:
        opened(operator)
        survived = states(operator.wait_until_idle())
        assert survived["pose_01"] == "good" and set(survived) <= {"pose_01", "pose_02"}
        assert operator.capture_pose()
        assert set(states(operator.wait_until_idle()).values()) == {"good"}


def test_hands_free_captures_a_board_that_is_held_still(operator: Operator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview_watcher.HandsFree, "HOLD_S", 0.2)
    monkeypatch.setattr(preview_watcher.HandsFree, "COUNT_S", 0.3)
    counted: list[float] = []
    operator.subscribe(lambda s: None, lambda p: counted.append(p.countdown_s) if p.countdown_s is not None else None)
    operator.place_at_suggestion()
    operator.set_hands_free(True)
    found = operator.wait_for(lambda s: states(s).get("pose_01") == "good", 60)
    assert found is not None and found.hands_free and counted and all(0 < c <= 0.3 for c in counted)
    time.sleep(0.8)  # held there, it is not captured again
    assert operator.set_hands_free(False)
    assert list(states(operator.wait_until_idle())) == ["pose_01"]


def test_a_session_is_opened_for_one_operator_and_changed_for_another(operator: Operator, tmp_path: Path) -> None:
    with Operator() as other:
        assert not other.open_session(tmp_path / "session")
        assert "open for writing in" in last(other.wait_until_idle())
    assert operator.open_session(tmp_path / "second") and operator.session is not None
    assert operator.session.folder == tmp_path / "second"
    Session.open(tmp_path / "session", write=True).close()
    view = operator.wait_until_idle()
    assert view.session is not None and view.session.target == "" and view.rig.state == "open"
    assert operator.session.decision("rig") == RIG
    assert not operator.choose_target("charuco:8x6:30") and "ChArUco" in last(operator.wait_until_idle())
    assert not operator.capture_pose() and "choose the target first" in last(operator.wait_until_idle())
    assert not operator.capture_scan() and "calibrate first" in last(operator.wait_until_idle())
    assert not operator.calibrate() and not operator.undo_merge() and not operator.verify(["x"], "plane")


def test_a_deleted_pose_can_be_brought_back(operator: Operator) -> None:
    operator.capture_pose()
    operator.wait_until_idle()
    operator.delete("pose_01")
    gone = operator.wait_until_idle().session
    assert gone is not None and gone.poses == () and gone.deleted_poses == ("pose_01",) and gone.deleted_scans == ()
    operator.undelete("pose_01")
    back = operator.wait_until_idle()
    assert back.session is not None and back.session.deleted_poses == ()
    assert states(back) == {"pose_01": "good"} and not any(notice.level == "error" for notice in back.notices)
    operator.undelete("pose_01")
    assert "no deleted capture 'pose_01'" in last(operator.wait_until_idle())


def test_a_session_whose_board_is_of_a_missing_plugin_is_opened_and_says_so(tmp_path: Path) -> None:
    with Session.create(tmp_path / "session") as session:
        session.decide("target", "aprilgrid:6x6:88")
    with Operator(tmp_path / "session", RIG) as operator:
        view = operator.wait_until_idle().session
        assert view is not None and view.target == ""
        assert any("aprilgrid:6x6:88" in fault and "plugin" in fault for fault in view.faults)
        assert operator.choose_target(TARGET)
        view = operator.wait_until_idle().session
        assert view is not None and view.target == TARGET and not view.faults
