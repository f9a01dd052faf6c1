"""The nine steps, in order: what to do now, what each waits for, which problems there are. A step
is one function.

Everything here follows from the session's files and the rig.
"""

from collections.abc import Callable

from slviewer.calibration.pixelwise import POSES_FOR_PIXELWISE
from slviewer.calibration.stereo import MIN_POSES
from slviewer.records.merge import MIN_OVERLAP
from slviewer.records.record import format_count
from slviewer.records.verification import Verification
from slviewer.session.atomic import format_bytes
from slviewer.session.names import join_names
from slviewer.wizard.snapshot import (
    CalibrationView,
    SessionView,
    Snapshot,
    StepState,
    StepView,
)

COVERED, MANY_POSES = 0.75, 15
"""Share of the coverage's goal, or number of poses, from which on the poses are enough."""


Outlook = tuple[str, bool, str, list[str]]
"""Of a step: why it cannot be done yet, or empty; whether it is done; what to do, in one sentence;
what is wrong, and how to correct it."""


def views(now: Snapshot) -> tuple[StepView, ...]:
    """Evaluate every step for the panels: its state, instruction and problems."""
    made, passing = [], set(_device_problems(now))
    for key, look in STEPS.items():
        blocked, done, instruction, problems = look(now)
        state: StepState = "blocked" if blocked else "done" if done else "ready"
        title = key.capitalize()
        doubtful = state == "done" and not passing.issuperset(problems)
        made.append(StepView(key, title, instruction, state, blocked, tuple(problems), doubtful))
    return tuple(made)


def list_activities(now: Snapshot) -> list[tuple[str, float | None]]:
    """List what runs, for the line of state, each with the share done, None where it is not
    known."""
    job, capture, found = now.job, now.rig.capture, list[tuple[str, float | None]]()
    if capture:
        waiting = f", {capture.waiting} waiting" if capture.waiting else ""
        text = f"Capturing {capture.name}: frame {capture.frame} of {capture.frames}{waiting}"
        if capture.stage:
            text = f"{capture.name}: {capture.stage}{waiting}"
        found.append((text, capture.frame / max(capture.frames, 1)))
    if job:
        waiting = f", {job.waiting} waiting" if job.waiting else ""
        stage = f": {job.stage}" if job.stage else ""
        found.append((f"{job.name}{stage}{waiting} ({job.seconds:.0f} s)", job.share))
    if now.content.pending_plan:
        seconds = f" ({now.planning_s:.0f} s)"
        found.append((f"Computing the next pose, for which Place board waits{seconds}", None))
    if now.preparing is not None:
        text = f"Compiling for this computer, once, {100 * now.preparing:.0f} %"
        found.append((f"{text}: the first pose and calibration wait for it", now.preparing))
    return found


def describe_awaited(now: Snapshot, key: str, hands_free: str = "") -> str:
    """Return what a step waits for, for the line of state, and so why its buttons are grey.
    `hands_free`: what that capture waits for."""
    rig, step = now.rig, now.step(key)
    if rig.capture or now.is_busy:
        return "Buttons that start other work are grey until it ends."
    if step.blocked_by:
        return step.blocked_by
    if key in ("poses", "verify", "scan") and rig.state != "open":
        return _RIG_AWAITED[rig.state]
    if key == "poses" and now.hands_free:
        return hands_free
    return f"Waits for you: {_ACTIONS[key]}."


_RIG_AWAITED = {
    "none": "Captures wait for a rig: choose one in the step Rig.",
    "opening": "Captures wait for the rig: it is being opened.",
    "lost": "Captures wait for the rig: its connection is tried every two seconds.",
}
_ACTIONS = {
    "rig": "choose and check the rig",
    "target": "choose the board, and use it",
    "poses": "hold the board still, and press Capture pose (key C)",
    "calibrate": "press Calibrate, or look at the result",
    "verify": "put a plate or a sphere in view and capture it, or continue to Scan",
    "scan": "put the object in view, and press Capture scan",
    "merge": "choose the scans, and press Merge",
    "measure": "choose a tool, and click on the surface",
    "export": "choose what to write",
}
"""{step: what the operator does next in it}."""


def _count_scans(now: Snapshot) -> int:
    """Return the number of scans with an up-to-date cloud."""
    return sum(scan.shape == "scan" and scan.cloud == "fresh" for scan in now.content.scans)


def _no_session(now: Snapshot) -> str:
    """Return the instruction to open a session where none is open; else empty."""
    return "" if now.session else "Open or create a session first."


def _no_target(now: Snapshot) -> str:
    """Return what is missing, a session or a target; else empty."""
    return _no_session(now) or ("" if now.content.target else "Choose the target first.")


def _no_calibration(now: Snapshot) -> str:
    """Return why there is no calibration to measure with, none or a rejected one; else empty."""
    calibration = now.content.calibration
    if calibration is None:
        return _no_session(now) or "Calibrate first."
    if not calibration.refused:
        return ""
    return (
        f"The calibration was rejected: {calibration.refused}. Calibrate again, or accept it in the"
        " step Calibrate."
    )


def _device_problems(now: Snapshot) -> list[str]:
    """List problems of rig, disk space and image brightness that prevent or degrade a capture."""
    rig, space, problems = now.rig, now.space, []
    if rig.state == "lost" and rig.camera is None:
        problems.append(
            f"The rig cannot be used: {rig.fault}. Try again in the step Rig, or choose another."
        )
    elif rig.state == "lost":
        problems.append(
            f"The connection to the rig is lost: {rig.fault}. Retrying every two seconds."
        )
    if space and not space.enough:
        free, needs = map(format_bytes, (space.free_bytes, space.capture_bytes or 0))
        problems.append(
            f"{free} are free on the disk and a capture needs {needs}: free some space."
        )
    if now.brightness == "saturated":
        problems.append(
            "Parts of the image are saturated: lower the exposure, or close the aperture."
        )
    elif now.brightness == "dim":
        problems.append("The image is dim: raise the exposure, or open the aperture.")
    return problems


def _stale_calibration(now: Snapshot) -> list[str]:
    """List whether the calibration is out of date."""
    calibration = now.content.calibration
    stale = calibration.stale if calibration else ""
    return [f"The calibration is out of date: {stale}."] if stale else []


def _rig(now: Snapshot) -> Outlook:
    """The devices are open."""
    state = now.rig.state
    if state == "none":
        instruction = "Choose your camera and projector, or the simulated rig."
    elif state == "opening":
        instruction = "Opening the devices."
    else:
        instruction = (
            "Focus camera and projector on the object, and set the exposure below saturation."
        )
    return "", state == "open", instruction, _device_problems(now)


def _target(now: Snapshot) -> Outlook:
    """A board is chosen."""
    target = now.content.target
    instruction = "Choose your board, or print one and measure its scale bar."
    if target:
        instruction = f"Hold the board {target} in view until it is detected."
    return _no_session(now), bool(target), instruction, []


def _poses(now: Snapshot) -> Outlook:
    """The poses suffice, by number and by predicted sigma or coverage; the last ones that were
    refused are problems."""
    session, n = now.content, now.content.good_poses
    blocked = _no_target(now)
    if not blocked and now.rig.state == "none" and not session.poses:
        blocked = "Choose a rig first, or import captures below."
    done = n >= POSES_FOR_PIXELWISE and (
        # cells that the projector never reaches cannot be covered: many poses are enough too
        n >= MANY_POSES
        or now.rig.state == "none"
        or session.enough
        or (session.coverage is not None and session.coverage.share > COVERED)
    )
    refused = [
        f"{pose.name} cannot be used: {pose.why}"
        for pose in session.poses[-3:]
        if pose.state == "refused"
    ]
    instruction = _describe_enough(session) if done else _describe_next_pose(now)
    return blocked, done, instruction, [*_device_problems(now), *refused]


def _describe_enough(session: SessionView) -> str:
    """Return how accurate a calibration from the poses will be, and what may follow."""
    n, sigma_mm = session.good_poses, session.plan.sigma_mm if session.plan else None
    if sigma_mm is None:
        return f"{n} good poses cover the view: calibrate, or add more."
    predicted = f"predicted sigma {sigma_mm:.3f} mm, goal {session.wanted_mm:.3f} mm"
    if session.enough:
        return f"{n} good poses are enough ({predicted}): calibrate."
    return f"{n} good poses cover the view ({predicted}): add more, or calibrate."


def _describe_next_pose(now: Snapshot) -> str:
    """Return where to hold the board next."""
    session, capture = now.content, now.rig.capture
    number = 1 + session.good_poses + sum(pose.state == "judging" for pose in session.poses)
    if capture and capture.name.startswith("pose_"):
        number += now.pose(capture.name) is None
    if now.session is None:
        cameras = "both cameras" if now.rig.second else "camera"
        return f"Hold the board in view of {cameras} and projector."
    if session.pending_plan:
        action = "Computing the best next pose; or hold the board in any new place, and capture"
    elif session.suggestion:
        action = f"{session.suggestion.sentence}, and capture"
    else:
        action = "Hold the board and capture"
    return f"{action}: pose {number} of {max(POSES_FOR_PIXELWISE, number)} or more."


def _calibrate(now: Snapshot) -> Outlook:
    """There is a calibration that is up to date and not refused; good poses that it lacks are
    problems."""
    session, calibration, n = now.content, now.content.calibration, now.content.good_poses
    problems, blocked, done = _stale_calibration(now), "", False
    if calibration is None:
        blocked, instruction = _no_target(now), f"Calibrate from {format_count(n, 'pose')}."
        if not blocked and n < MIN_POSES:
            needed = f"at least {MIN_POSES} are needed: capture the board first."
            blocked = f"{format_count(n, 'good pose')} so far, {needed}"
    elif calibration.stale:
        instruction = f"Calibrate again from {n} poses."
    else:
        done, instruction = not calibration.refused, _describe_calibration(calibration)
        if added := sum(pose.state == "good" for pose in session.poses):
            problems.append(
                f"{format_count(added, 'good pose')} captured after the calibration: calibrate"
                " again to use them."
            )
    if calibration is None and MIN_POSES <= n < POSES_FOR_PIXELWISE:  # else its verdict says so
        problems.append(
            f"With fewer than {POSES_FOR_PIXELWISE} poses only the stereo model is reliable:"
            " capture more."
        )
    return blocked, done, instruction, problems


def _describe_calibration(calibration: CalibrationView) -> str:
    """Return the number of poses and the reprojection RMS, and what follows."""
    if calibration.refused:
        return "This calibration was rejected: correct what is listed below, and calibrate again."
    if not calibration.reprojection.rms_px:
        return "This calibration was imported: verify it next."
    return (
        f"Calibrated from {len(calibration.stereo.poses)} poses. Reprojection RMS of"
        f" {calibration.label}: {calibration.reprojection.rms_text}. Check outlying poses, then"
        " verify."
    )


def _verify(now: Snapshot) -> Outlook:
    """There is an up-to-date verification; those of an older calibration are problems."""
    records = now.content.list_records(Verification)
    stale = [each.name for each in records if each.stale]
    problems = [*_device_problems(now), *_stale_calibration(now)]
    if stale:
        problems.append(
            f"{join_names(stale, 3)} measured with an older calibration: measure again."
        )
    instruction = "Put a flat plate or a sphere in view, and capture it."
    if done := len(records) > len(stale):
        instruction = (
            "Compare RMS with the noise floor; capture planes and spheres at other depths."
        )
    return _no_calibration(now), done, instruction, problems


def _scan(now: Snapshot) -> Outlook:
    """There is a scan with an up-to-date cloud; clouds of an older calibration are problems."""
    scans, instruction = _count_scans(now), "Put the object in view, and capture it."
    pending = len(now.content.pending_scans)
    if pending and not now.is_busy:
        instruction = (
            f"{format_count(scans + pending, 'scan')}, {scans or 'none'} reconstructed: reconstruct"
            " the others, or capture more."
        )
    elif scans:
        instruction = (
            f"{format_count(scans, 'scan')}: turn or move the object for another, or merge"
            " them next."
        )
    stale = [
        f"{scan.label} was reconstructed with an older calibration: reconstruct it again."
        for scan in now.content.scans
        if scan.cloud == "stale"
    ]
    outside = [
        scan.label
        for scan in now.content.scans
        if scan.cloud == "fresh" and scan.purpose == "scan" and not scan.figures.is_good
    ]
    if outside:
        stale.append(f"{join_names(outside, 3)}: outside the calibrated depths.")
    problems = [*_device_problems(now), *_stale_calibration(now), *stale]
    return _no_calibration(now), scans > 0, instruction, problems


def _merge(now: Snapshot) -> Outlook:
    """There is an up-to-date merge; scans whose overlap is too small are problems."""
    merge, blocked, problems = now.content.merge, _no_calibration(now), list[str]()
    done = merge is not None and not merge.stale
    instruction = "Choose the scans and the reference, and merge."
    if done:
        instruction = "Check the alignment; undo the merge if it is wrong, or measure next."
    if merge is None:
        scans, pending = _count_scans(now), len(now.content.pending_scans)
        if not blocked and scans < 2 <= scans + pending:
            blocked = (
                f"Merging needs at least two reconstructed scans: of {scans + pending} scans"
                f" {scans or 'none'} {'are' if scans != 1 else 'is'}. Reconstruct the others."
            )
        elif not blocked and scans < 2:
            blocked = (
                "Merging needs at least two scans of one object: scan it again from another side."
            )
        return blocked, done, instruction, problems
    if merge.stale:
        problems.append("Scans or calibration have changed since this merge: merge again.")
    problems += [
        f"{name} overlaps by only {100 * pair.overlap:.0f} % (RMS {pair.rms_mm:.2f} mm): "
        "scan with more overlap."
        for name, pair in merge.record.pairs.items()
        if pair.rms_mm is not None and pair.overlap < MIN_OVERLAP
    ]
    return blocked, done, instruction, problems


def _measure(now: Snapshot) -> Outlook:
    """There is an up-to-date measurement; those whose surface has changed are problems."""
    session, blocked, problems = now.content, _no_calibration(now), []
    stale = [measured.label for measured in session.measurements if measured.stale]
    has_surface = session.merge or any(scan.cloud == "fresh" for scan in session.scans)
    if not (blocked or session.measurements or has_surface):
        blocked = "Measuring needs a scan: capture one, or reconstruct a recorded one."
    if stale:
        problems = [f"{join_names(stale, 3)}: the measured surface has changed; measure again."]
    instruction = "Choose a surface and a tool, then click in the 3D view; or export next."
    if done := len(session.measurements) - len(stale):
        instruction = f"{format_count(done, 'measurement')}: add more, or export next."
    return blocked, done > 0, instruction, problems


def _export(now: Snapshot) -> Outlook:
    """There is a file; a rejected calibration can be exported too."""
    exports, blocked = now.content.exports, ""
    if now.content.calibration is None:
        blocked = _no_calibration(now)
    instruction = "Choose what to write: a cloud, a mesh, the calibration, the report."
    if exports:
        instruction = f"{format_count(len(exports), 'file')} to download."
    return blocked, bool(exports), instruction, []


STEPS: dict[str, Callable[[Snapshot], Outlook]] = {
    "rig": _rig,
    "target": _target,
    "poses": _poses,
    "calibrate": _calibrate,
    "verify": _verify,
    "scan": _scan,
    "merge": _merge,
    "measure": _measure,
    "export": _export,
}
"""The steps by their keys, in order."""
