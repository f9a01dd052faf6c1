"""Requests and what becomes of them, on a small simulated rig: faults, resuming, decisions,
hands-free."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from faulty_rig import FaultyRigs
from wizard_events import HANG_S, SPARING, last_notice, until, wait_until_open

from slviewer.pipeline.operation import Job
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import PreviewView, Snapshot

pytestmark = pytest.mark.computes

RIG = {"driver": "simulated", "scale": 0.25, "seed": 0}
TARGET = "circles:21x16:9"
ROOT = Path(__file__).parents[3]


@pytest.fixture
def rigs() -> FaultyRigs:
    return FaultyRigs()


@pytest.fixture
def operator(tmp_path: Path, rigs: FaultyRigs) -> Iterator[Operator]:
    with Operator(tmp_path / "session", RIG, set_up=rigs, timing=SPARING) as operator:
        operator.choose_target(TARGET)
        wait_until_open(operator)
        yield operator


def states(snapshot: Snapshot) -> dict[str, str]:
    assert snapshot.session is not None
    return {pose.name: pose.state for pose in snapshot.session.poses}


def test_requests_that_cannot_be_granted_become_notices() -> None:
    with Operator() as operator:
        for request, facts in (
            (operator.capture_pose, ["session"]),
            (operator.calibrate, ["session"]),
            (lambda: operator.open_session("/proc/nowhere/session"), ["/proc/nowhere/session"]),
            (lambda: operator.open_session(" "), ["folder", "enter"]),
            (
                lambda: operator.choose_rig({"driver": "no such"}),
                ["driver", "no such", "simulated"],
            ),
            (lambda: operator.choose_rig({"scale": 1}), ["scale", 1, "camera"]),
            (lambda: operator.set_exposure(-1), ["exposure", -1]),
            (lambda: operator.export("nonsense"), ["session"]),  # type: ignore[arg-type]
            (lambda: operator.place("board"), ["simulated rig"]),
        ):
            assert request() is False
            refused = operator.wait_until_idle()
            assert (
                missing_facts(last_notice(refused), *facts) == []
                and refused.notices[-1].level == "error"
            )
        assert (
            operator.snapshot().session is None
            and operator.snapshot().step("poses").state == "blocked"
        )


def test_poses_are_judged_kept_and_found_again(
    operator: Operator, rigs: FaultyRigs, tmp_path: Path
) -> None:
    versions: list[int] = []
    operator.subscribe(lambda snapshot: versions.append(snapshot.version))
    before = operator.wait_until_idle()
    assert (
        before.session is not None
        and before.session.suggestion is not None
        and before.world is not None
    )
    assert before.space is not None and before.space.capture_bytes == 32 * 400 * 300
    for _ in range(2):
        assert operator.place_at_suggestion() and operator.capture_pose()
        after = operator.wait_until_idle()
        assert after.session is not None and after.world is not None
        judged = after.session.poses[-1]
        assert (
            judged.state == "good"
            and judged.thumbnail[:2] == b"\xff\xd8"
            and judged.T_camera_board is not None
        )
        np.testing.assert_allclose(judged.T_camera_board, after.world.T_camera_object, atol=12)
    assert versions == sorted(set(versions)) and len(versions) > 5
    # a board that is not seen is refused, in words, and the suggestion changes
    T = np.eye(4)
    T[:3, 3] = [60, -60, 560]
    assert operator.place("board", T) and operator.capture_pose()
    refused = operator.wait_until_idle()
    assert states(refused) == {"pose_01": "good", "pose_02": "good", "pose_03": "refused"}
    assert missing_facts(last_notice(refused), "pose_03", refused.pose("pose_03").why) == []  # type: ignore[union-attr]
    assert refused.notices[-1].section == "target-poses" and "board" in refused.pose("pose_03").why  # type: ignore[union-attr]
    assert operator.exclude("pose_02", "blurred") and operator.rename("pose_01", "<b>first</b>")
    decided = operator.wait_until_idle()
    operator.close()
    with Operator(tmp_path / "session", set_up=rigs, timing=SPARING) as again:
        wait_until_open(again)
        resumed = again.wait_until_idle()
        assert resumed.session is not None and decided.session is not None
        assert (
            states(resumed)
            == states(decided)
            == {
                "pose_01": "good",
                "pose_02": "excluded",
                "pose_03": "refused",
            }
        )
        assert [(s.key, s.state, s.instruction) for s in resumed.steps] == [
            (s.key, s.state, s.instruction) for s in decided.steps
        ]
        assert resumed.rig.name == decided.rig.name and resumed.session.target == TARGET
        for a, b in zip(resumed.session.poses, decided.session.poses, strict=True):
            assert a.thumbnail == b.thumbnail and a.why == b.why
        np.testing.assert_array_equal(
            resumed.session.coverage.cells, decided.session.coverage.cells
        )  # type: ignore[union-attr]
        # what was decided can be undone, retaken, deleted
        assert again.include("pose_02") and again.delete("pose_03")
        assert again.session is not None
        first = again.session.load_capture("pose_01").hash
        assert again.place_at_suggestion() and again.retake_pose("pose_01")
        retaken = again.wait_until_idle()
        assert states(retaken) == {"pose_01": "good", "pose_02": "good"}
        assert retaken.next_undo == "retake <b>first</b>"
        new = again.session.load_capture("pose_01").hash
        assert again.undo() and states(again.wait_until_idle()) == states(retaken)
        assert again.session.load_capture("pose_01").hash == first
        assert again.redo() and states(again.wait_until_idle()) == states(retaken)
        assert again.session.load_capture("pose_01").hash == new != first
        assert len(list((tmp_path / "session" / "trash").iterdir())) >= 2
        # another target: what was judged by the old one is judged anew
        assert again.choose_target("circles:20x16:9")
        assert set(states(again.wait_until_idle()).values()) == {"refused"}


@pytest.mark.parametrize("fault", [pytest.param("timeout", marks=pytest.mark.slow), "unplugged"])
def test_a_device_that_fails_leaves_no_half_capture(
    operator: Operator, rigs: FaultyRigs, fault
) -> None:
    store = operator.session
    assert store is not None and operator.place_at_suggestion()
    rigs.faults.plan(fault, 12)
    assert operator.capture_pose()
    assert operator.wait_for(
        lambda s: any(not missing_facts(n.text, "13 of 32") for n in s.notices), HANG_S
    )
    assert operator.wait_for(lambda s: s.notices[-1].level == "good" and s.rig.fault == "", HANG_S)
    assert store.capture_names() == [] and list((store.folder / "captures").iterdir()) == []
    wait_until_open(operator)
    assert operator.capture_pose()
    assert states(operator.wait_until_idle()) == {"pose_01": "good"}


@pytest.mark.process
@pytest.mark.slow
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
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    assert any(line.strip().isdecimal() and int(line) > 3 for line in process.stdout)
    process.kill()
    process.wait()
    with Operator(tmp_path / "session", timing=SPARING) as operator:
        wait_until_open(operator)
        survived = states(operator.wait_until_idle())
        assert survived["pose_01"] == "good" and set(survived) <= {"pose_01", "pose_02"}
        assert operator.capture_pose()
        assert set(states(operator.wait_until_idle()).values()) == {"good"}


@pytest.mark.slow
def test_hands_free_captures_a_board_that_is_held_still_and_moves_on(tmp_path: Path) -> None:
    timing = replace(SPARING, previews_per_s=10.0, hold_s=0.2, count_s=0.3)
    previews: list[PreviewView] = []
    with Operator(tmp_path / "session", RIG, timing=timing) as operator:
        operator.choose_target(TARGET)
        wait_until_open(operator)
        operator.subscribe(lambda s: None, previews.append)
        operator.place_at_suggestion()
        operator.set_hands_free(True)
        captured = operator.wait_for(lambda s: states(s).get("pose_01") == "good", HANG_S)
        counted = [preview.countdown_s for preview in previews if preview.countdown_s is not None]
        assert (
            captured is not None
            and captured.hands_free
            and counted
            and all(0 < c <= 0.3 for c in counted)
        )
        first = captured.world
        # the simulated board, which nobody holds, moves on to the next place
        assert operator.wait_for(lambda s: states(s).get("pose_02") == "good", HANG_S)
        assert operator.set_hands_free(False)
        second = operator.wait_until_idle().world
        assert first and second
        moved_mm = second.T_camera_object[:3, 3] - first.T_camera_object[:3, 3]
        assert np.linalg.norm(moved_mm) > 5


def test_a_plane_is_not_captured_while_the_board_is_surely_in_view(operator: Operator) -> None:
    def refusal(**options: bool) -> str:
        """What a capture of a plane lacks; there is no calibration yet."""
        assert not operator.capture_scan(purpose="plane", **options)
        return last_notice(operator.wait_until_idle())

    assert operator.place_at_suggestion()
    until(lambda: missing_facts(refusal(), "board", "in view") == [])  # once it is detected
    assert missing_facts(refusal(anyway=True), "calibrate") == []
    operator.place("plane")  # the latest image still shows the board
    assert missing_facts(refusal(), "calibrate") == []


def test_a_session_is_opened_for_one_operator_and_changed_for_another(
    operator: Operator, tmp_path: Path
) -> None:
    with Operator() as other:
        assert not other.open_session(tmp_path / "session")
        assert (
            missing_facts(last_notice(other.wait_until_idle()), tmp_path / "session", os.getpid())
            == []
        )
    assert not operator.capture_scan() and operator.notices()
    assert operator.open_session(tmp_path / "second") and operator.session is not None
    assert operator.notices() == ()  # those of the first session
    assert operator.session.folder == tmp_path / "second"
    Session.open(tmp_path / "session", write=True).close()
    view = operator.wait_until_idle()
    assert view.session is not None and view.session.target == "" and view.rig.state == "open"
    assert operator.session.decision("rig") == RIG
    assert not operator.choose_target("charuco:8x6:30")
    assert missing_facts(last_notice(operator.wait_until_idle()), "ChArUco") == []
    assert (
        not operator.capture_pose()
        and missing_facts(last_notice(operator.wait_until_idle()), "target") == []
    )
    assert (
        not operator.capture_scan()
        and missing_facts(last_notice(operator.wait_until_idle()), "calibrate") == []
    )
    assert (
        not operator.calibrate()
        and not operator.undo_merge()
        and not operator.verify(["x"], "plane")
    )


@pytest.mark.slow
def test_a_deleted_pose_can_be_brought_back(operator: Operator) -> None:
    operator.capture_pose()
    operator.wait_until_idle()
    operator.delete("pose_01")
    gone = operator.wait_until_idle().session
    assert (
        gone is not None
        and gone.poses == ()
        and gone.deleted_poses == ("pose_01",)
        and gone.deleted_scans == ()
    )
    operator.undelete("pose_01")
    back = operator.wait_until_idle()
    assert back.session is not None and back.session.deleted_poses == ()
    assert states(back) == {"pose_01": "good"} and not any(
        notice.level == "error" for notice in back.notices
    )
    operator.undelete("pose_01")
    assert missing_facts(last_notice(operator.wait_until_idle()), "deleted", "pose_01") == []


def test_a_session_whose_board_is_of_a_missing_plugin_is_opened_and_says_so(tmp_path: Path) -> None:
    with Session.create(tmp_path / "session") as session:
        session.decide("target", "aprilgrid:6x6:88")
    with Operator(tmp_path / "session", RIG, timing=SPARING) as operator:
        view = operator.wait_until_idle().session
        assert view is not None and view.target == ""
        assert any("aprilgrid:6x6:88" in fault and "plugin" in fault for fault in view.faults)
        assert operator.choose_target(TARGET)
        view = operator.wait_until_idle().session
        assert view is not None and view.target == TARGET and not view.faults


def test_work_that_the_end_of_the_program_interrupted_is_named(tmp_path: Path) -> None:
    seen = list[str]()
    with Operator(tmp_path / "session") as operator:

        def work(job: Job) -> str:
            """Note what the session remembers to run."""
            seen.append(job.store.decision("running"))
            return "done"

        operator._work("Testing", work)
        operator.wait_until_idle()
        assert seen == ["Testing"] and operator.session is not None
        assert operator.session.decision("running") is None
        operator.session.decide("running", "Calibrating")  # as a process that is killed leaves it
    for notices in (1, 0):
        with Operator(tmp_path / "session") as operator:
            texts = [each.text for each in operator.notices() if "interrupted" in each.text]
            assert len(texts) == notices
            assert all(missing_facts(text, "Calibrating", "again") == [] for text in texts)
