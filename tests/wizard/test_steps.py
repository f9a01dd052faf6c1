"""What each step waits for, follows from the session and the rig alone."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from facts import missing_facts

from slviewer.calibration.next_pose import Coverage, nominal_lens
from slviewer.calibration.stereo import MIN_POSES, StereoModel
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.capture import Space
from slviewer.records.merge import DepthCheck, Reconstruction
from slviewer.target.board import Board
from slviewer.wizard.pose_plan import PlanInput, PosePlan
from slviewer.wizard.snapshot import (
    Brightness,
    CalibrationView,
    CaptureProgress,
    JobView,
    PoseView,
    RigView,
    ScanView,
    SessionView,
    Snapshot,
)
from slviewer.wizard.steps import STEPS, describe_awaited, list_activities, views

OPEN = RigView(state="open", name="bench", camera=(400, 300), projector=(912, 1140))
EMPTY = SessionView(Path("s"), "", "complementary")
LENS = nominal_lens((400, 300))


def planned(covered: bool, sigma_mm: float | None = None) -> PosePlan:
    """Of ten poses, over the whole view or nowhere."""
    n = 4 if covered else 0
    coverage = Coverage(np.full((3, 4), n), np.full(3, n), np.full(5, n), (400.0, 700.0))
    return PosePlan(
        LENS, {f"pose_{i}": np.eye(4) for i in range(10)}, coverage, None, 0.024, sigma_mm
    )


def poses(n: int, state="good", why: str = "") -> tuple[PoseView, ...]:
    return tuple(PoseView(f"pose_{i}", state, why, None, None, None, b"") for i in range(n))


def calibration(stale: str = "") -> CalibrationView:
    rig = StereoRig(LENS, LENS, np.eye(3), np.array([180.0, 0, 0]))
    poses = {"pose_0": np.eye(4)}
    stereo = StereoModel(
        rig, "circles:9x7:20", ("x",), {"stereo": 0.1}, poses, {}, {}, (400.0, 600.0), {}
    )
    return CalibrationView(stereo, stereo.reprojection, ("stereo",), "stereo", stale)


def seen(
    session: SessionView | None,
    rig: RigView,
    space: Space | None = None,
    brightness: Brightness = "",
) -> Snapshot:
    return Snapshot(session=session, rig=rig, space=space, brightness=brightness)


def states(facts: Snapshot) -> dict[str, str]:
    return {view.key: view.state for view in views(facts)}


def test_the_way_through_the_wizard() -> None:
    blocked = dict.fromkeys(
        ("calibrate", "verify", "scan", "merge", "measure", "export"), "blocked"
    )
    assert states(seen(None, RigView(), None)) == {
        "rig": "ready",
        "target": "blocked",
        "poses": "blocked",
        **blocked,
    }
    assert states(seen(EMPTY, OPEN, None)) == {
        "rig": "done",
        "target": "ready",
        "poses": "blocked",
        **blocked,
    }
    aimed = replace(EMPTY, target="circles:9x7:20")
    assert states(seen(aimed, OPEN, None)) == {
        "rig": "done",
        "target": "done",
        "poses": "ready",
        **blocked,
    }
    few = replace(aimed, poses=poses(2))
    blocked_by = next(v for v in views(seen(few, OPEN, None)) if v.key == "calibrate").blocked_by
    assert missing_facts(blocked_by, 2, MIN_POSES) == []
    enough = replace(aimed, poses=poses(10), plan=planned(True))
    reached = states(seen(enough, OPEN, None))
    assert (reached["poses"], reached["calibrate"], reached["verify"]) == (
        "done",
        "ready",
        "blocked",
    )
    done = states(seen(replace(enough, calibration=calibration()), OPEN, None))
    assert (
        done["calibrate"] == "done" and done["verify"] == done["scan"] == done["export"] == "ready"
    )
    assert done["merge"] == done["measure"] == "blocked"
    stale = seen(
        replace(enough, calibration=calibration("pose_1 was excluded since: calibrate again")),
        OPEN,
        None,
    )
    assert states(stale)["calibrate"] == "ready"
    assert (
        missing_facts(
            next(v for v in views(stale) if v.key == "calibrate").problems[0], "pose_1", "excluded"
        )
        == []
    )


def test_recorded_scans_are_counted_whether_they_are_reconstructed_or_not() -> None:
    def scan(k: int, cloud: Literal["absent", "fresh", "stale"]) -> ScanView:
        return ScanView(f"scan_{k}", f"scan {k}", "scan", "", cloud, Reconstruction(), b"")

    scans = (scan(0, "fresh"), scan(1, "stale"), *(scan(k, "absent") for k in range(2, 19)))
    session = replace(EMPTY, target="circles:9x7:20", calibration=calibration(), scans=scans)
    assert len(session.pending_scans) == 18
    plane = ScanView("plane_01", "plane", "scan", "", "absent", Reconstruction(), b"")
    assert replace(session, scans=(plane,)).pending_scans == ()
    found = {view.key: view for view in views(seen(session, OPEN))}
    assert missing_facts(found["scan"].instruction, "19 scans", "1 reconstructed") == []
    assert found["merge"].state == "blocked"
    assert missing_facts(found["merge"].blocked_by, "19 scans", "1 is", "reconstruct") == []
    assert "capture" not in found["merge"].blocked_by
    alone = replace(session, scans=scans[:1])
    (merge,) = (view for view in views(seen(alone, OPEN)) if view.key == "merge")
    assert "another side" in merge.blocked_by


def test_a_scan_outside_the_calibrated_depths_leaves_its_step_doubtful() -> None:
    def scan(name: str, outside: float) -> ScanView:
        depths = DepthCheck((400.0, 600.0), outside, 610.0, 700.0, 0.1, True)
        figures = Reconstruction(model="splined", axis="x", points=900, depths=depths)
        return ScanView(name, name, "scan", "", "fresh", figures, b"")

    session = replace(EMPTY, target="circles:9x7:20", poses=poses(10), calibration=calibration())
    inside = replace(session, scans=(scan("one", 0.0),))
    both = replace(session, scans=(scan("one", 0.0), scan("two", 0.9)))
    for facts, doubtful in ((inside, False), (both, True)):
        view = next(v for v in views(seen(facts, OPEN, None, "saturated")) if v.key == "scan")
        assert (view.state, view.is_doubtful) == ("done", doubtful)
    assert missing_facts(view.problems[-1], "two", "calibrated depths") == []


def test_a_rejected_calibration_is_not_used_unless_one_insists() -> None:
    rejected = replace(calibration(), rejected="pose_3 moved by 0.9 px: take the pose again")
    facts = seen(
        replace(EMPTY, target="circles:9x7:20", poses=poses(10), calibration=rejected), OPEN, None
    )
    found = {view.key: view for view in views(facts)}
    assert {found[key].state for key in ("verify", "scan", "merge")} == {"blocked"}
    assert missing_facts(found["scan"].blocked_by, "pose_3", "0.9 px") == []
    assert missing_facts(found["verify"].blocked_by, "pose_3", "0.9 px", "accept") == []
    assert found["calibrate"].state == "ready"
    assert missing_facts(found["calibrate"].instruction, "rejected") == []
    accepts_rejected = replace(
        facts, session=replace(facts.session, calibration=replace(rejected, is_pinned=True))
    )  # type: ignore[type-var]
    assert (
        states(accepts_rejected)["scan"] == "ready"
        and states(accepts_rejected)["calibrate"] == "done"
    )


def test_a_recorded_session_needs_no_rig() -> None:
    recorded = replace(EMPTY, target="circles:9x7:20", poses=poses(9))
    assert states(seen(recorded, RigView(), None))["poses"] == "done"
    assert states(seen(recorded, RigView(), None))["calibrate"] == "ready"


def test_every_step_says_in_one_sentence_what_to_do_and_what_is_wrong() -> None:
    session = replace(
        EMPTY, target="t", poses=poses(4, "refused", "12 of 336 circles found: lower the exposure")
    )
    lost = replace(OPEN, state="lost", fault="the camera is gone: plug it in")
    facts = seen(session, lost, Space(1_000_000, 10_000_000), "saturated")
    for view in views(facts):
        assert (
            view.instruction
            and view.instruction[0].isupper()
            and view.instruction.endswith(".")
            and "\n" not in view.instruction
        )
        assert all(len(sentence) > 20 and "\n" not in sentence for sentence in view.problems)
    wrong = " ".join(next(v for v in views(facts) if v.key == "poses").problems)
    assert missing_facts(wrong, "plug it in", "1.0 MB", "10.0 MB", "saturated", "12 of 336") == []


def test_poses_that_cover_the_view_may_still_lack_accuracy() -> None:
    covering = replace(EMPTY, target="circles:9x7:20", poses=poses(10), plan=planned(True))
    assert missing_facts(views(seen(covering, OPEN, None))[2].instruction, 10, "calibrate") == []
    lacking = replace(covering, plan=planned(True, 0.03), wanted_mm=0.024)
    assert (
        missing_facts(
            views(seen(lacking, OPEN, None))[2].instruction, "0.030 mm", "0.024 mm", "add more"
        )
        == []
    )
    enough = replace(lacking, wanted_mm=0.031)
    instruction = views(seen(enough, OPEN, None))[2].instruction
    assert enough.enough and missing_facts(instruction, "0.030 mm", "0.031 mm", "calibrate") == []
    assert missing_facts(instruction, "add more") == ["add more"]
    pending = PlanInput(Board.parse("circles:9x7:20"), (400, 300), (912, 1140), {})
    few = replace(lacking, poses=poses(3), plan=planned(False), pending_plan=pending)
    assert missing_facts(views(seen(few, OPEN, None))[2].instruction, "computing", "pose 4") == []


def test_next_pose_counts_those_that_are_judged_and_captured() -> None:
    few = replace(EMPTY, target="circles:9x7:20", poses=poses(2) + poses(1, "judging"))
    assert missing_facts(views(seen(few, OPEN))[2].instruction, "pose 4") == []
    capturing = replace(OPEN, capture=CaptureProgress("pose_04", 3, 32, 0))
    assert missing_facts(views(seen(few, capturing))[2].instruction, "pose 5") == []


def test_state_names_what_runs_and_what_is_awaited() -> None:
    few = replace(EMPTY, target="circles:9x7:20", poses=poses(2))
    idle = seen(few, OPEN)
    idle = replace(idle, steps=views(idle))
    assert list_activities(idle) == []
    awaited = {key: describe_awaited(idle, key) for key in STEPS}
    assert all(awaited.values())
    assert missing_facts(awaited["poses"], "Capture pose") == []
    assert awaited["calibrate"] == idle.step("calibrate").blocked_by
    assert describe_awaited(replace(idle, hands_free=True), "poses", "hold it") == "hold it"
    for rig, fact in ((RigView(), "choose"), (RigView("opening"), "opened")):
        assert missing_facts(describe_awaited(replace(idle, rig=rig), "poses"), fact) == []
    job = JobView("Processing pose_02", 0.4, "reading pose_02", 7.2, False, True, 1)
    capturing = replace(OPEN, capture=CaptureProgress("pose_03", 8, 32, 0))
    plan = PlanInput(Board.parse("circles:9x7:20"), (400, 300), (912, 1140), {})
    busy = replace(
        idle,
        rig=capturing,
        job=job,
        session=replace(few, pending_plan=plan),
        planning_s=3.0,
        preparing=0.5,
    )
    (capture, share), (work, _), (plan_text, none), (compiling, half) = list_activities(busy)
    assert missing_facts(capture, "pose_03", 8, 32) == [] and (share, half) == (0.25, 0.5)
    assert missing_facts(work, "pose_02", "7 s", "1 waiting") == []
    assert missing_facts(plan_text, "Place board", "3 s") == [] and none is None
    assert missing_facts(compiling, "50 %") == []
    assert missing_facts(describe_awaited(busy, "poses"), "grey") == []
