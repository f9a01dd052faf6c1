"""The nine steps, in order: what to do now, what each waits for, which problems there are. A step
is one entry.

Everything here follows from the session's files and the rig.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from slviewer.calibration.stereo import MIN_POSES
from slviewer.evaluation.render import format_count
from slviewer.pipeline.capture import Space
from slviewer.pipeline.models import POSES_FOR_PIXELWISE
from slviewer.records.merge import MIN_OVERLAP
from slviewer.records.verification import Verification
from slviewer.session.atomic import format_bytes
from slviewer.session.names import join_names
from slviewer.wizard.snapshot import Brightness, RigView, SessionView, StepState, StepView

COVERED, MANY_POSES = 0.75, 15
"""Share of the coverage's goal, or number of poses, from which on the poses are enough."""
_EMPTY = SessionView(Path(), "", "")


@dataclass(frozen=True)
class Facts:
    """State that the steps depend on; `session` is None until one is open."""

    session: SessionView | None = None
    rig: RigView = field(default_factory=RigView)
    space: Space | None = None
    brightness: Brightness = ""

    @property
    def content(self) -> SessionView:
        """The session's content, which is empty until one is open."""
        return self.session or _EMPTY

    @property
    def scans(self) -> int:
        """Number of scans with an up-to-date cloud."""
        return sum(scan.purpose == "scan" and scan.cloud == "fresh" for scan in self.content.scans)


@dataclass(frozen=True)
class Step:
    """Definition of one step: functions of the facts that give its state and texts.

    `blocked(facts)`: why it cannot be done yet, or empty; `done(facts)`; `instruction(facts)`: what
    to do, in one sentence; `problems(facts)`: what is wrong, and how to correct it.
    """

    key: str
    title: str
    blocked: Callable[[Facts], str]
    done: Callable[[Facts], bool]
    instruction: Callable[[Facts], str]
    problems: Callable[[Facts], Iterator[str]] = lambda facts: iter(())


def views(facts: Facts) -> tuple[StepView, ...]:
    """Evaluate every step for the panels: its state, instruction and problems."""
    made = []
    for step in STEPS:
        blocked = step.blocked(facts)
        state: StepState = "blocked" if blocked else "done" if step.done(facts) else "ready"
        instruction, problems = step.instruction(facts), tuple(step.problems(facts))
        made.append(StepView(step.key, step.title, instruction, state, blocked, problems))
    return tuple(made)


def _no_session(facts: Facts) -> str:
    """Return the instruction to open a session where none is open; else empty."""
    return "" if facts.session else "Open or create a session first."


def _device_problems(facts: Facts) -> Iterator[str]:
    """Yield problems of rig, disk space and image brightness that prevent or degrade a capture."""
    if facts.rig.state == "lost" and facts.rig.camera is None:
        yield (
            f"The rig cannot be used: {facts.rig.fault}. Try again in the step Rig, or choose"
            " another."
        )
    elif facts.rig.state == "lost":
        yield f"The connection to the rig is lost: {facts.rig.fault}. Retrying every two seconds."
    if facts.space and not facts.space.enough:
        needs, free = (
            format_bytes(facts.space.capture_bytes or 0),
            format_bytes(facts.space.free_bytes),
        )
        yield f"{free} are free on the disk and a capture needs {needs}: free some space."
    if facts.brightness == "saturated":
        yield "Parts of the image are saturated: lower the exposure, or close the aperture."
    elif facts.brightness == "dim":
        yield "The image is dim: raise the exposure, or open the aperture."


def _rig_instruction(facts: Facts) -> str:
    """Return the instruction of the step Rig."""
    if facts.rig.state == "none":
        return "Choose your camera and projector, or the simulated rig."
    if facts.rig.state == "opening":
        return "Opening the devices."
    return "Focus camera and projector on the object, and set the exposure below saturation."


def _target_instruction(facts: Facts) -> str:
    """Return the instruction of the step Target."""
    if not facts.content.target:
        return "Choose your board, or print one and measure its scale bar."
    return f"Hold the board {facts.content.target} in view until it is detected."


def _poses_blocked(facts: Facts) -> str:
    """Return why poses cannot be captured yet: no session, target or rig; else empty."""
    if facts.session is None:
        return _no_session(facts)
    if not facts.session.target:
        return "Choose the target first."
    if facts.rig.state == "none" and not facts.session.poses:
        return "Choose a rig first, or import captures below."
    return ""


def _poses_done(facts: Facts) -> bool:
    """Whether the poses suffice, by number and by predicted sigma or coverage."""
    session = facts.content
    return session.good_poses >= POSES_FOR_PIXELWISE and (
        # cells that the projector never reaches cannot be covered: many poses are enough too
        session.good_poses >= MANY_POSES
        or facts.rig.state == "none"
        or session.enough
        or (session.coverage is not None and session.coverage.share > COVERED)
    )


def _poses_instruction(facts: Facts) -> str:
    """Return the instruction of the step Poses: the suggested next pose, or that there are
    enough."""
    session, n = facts.content, facts.content.good_poses
    if facts.session is None:
        return "Hold the board in view of camera and projector."
    if _poses_done(facts):
        sigma_mm = session.plan.sigma_mm if session.plan else None
        if sigma_mm is None:
            return f"{n} good poses cover the view: calibrate, or add more."
        predicted = f"predicted sigma {sigma_mm:.3f} mm, goal {session.wanted_mm:.3f} mm"
        if session.enough:
            return f"{n} good poses are enough ({predicted}): calibrate."
        return f"{n} good poses cover the view ({predicted}): add more, or calibrate."
    if session.pending_plan:
        action = "Computing the best next pose; or hold the board in any new place, and capture"
    elif session.suggestion:
        action = f"{session.suggestion.sentence}, and capture"
    else:
        action = "Hold the board and capture"
    return f"{action}: pose {n + 1} of {max(POSES_FOR_PIXELWISE, n + 1)} or more."


def _poses_problems(facts: Facts) -> Iterator[str]:
    """Yield device problems, and which of the last three poses were refused and why."""
    yield from _device_problems(facts)
    for pose in facts.content.poses[-3:]:
        if pose.state == "refused":
            yield f"{pose.name} cannot be used: {pose.why}"


def _calibrate_blocked(facts: Facts) -> str:
    """Return why calibrating is not possible yet: no session, target or too few poses; else
    empty."""
    if facts.session is None:
        return _no_session(facts)
    if facts.content.calibration:
        return ""
    if not facts.session.target:
        return "Choose the target first."
    if (n := facts.content.good_poses) < MIN_POSES:
        return f"{n} good poses so far, at least {MIN_POSES} are needed: capture the board first."
    return ""


def _calibrate_done(facts: Facts) -> bool:
    """Whether there is a calibration that is up to date and not refused."""
    calibration = facts.content.calibration
    return calibration is not None and not calibration.stale and not calibration.refused


def _calibrate_instruction(facts: Facts) -> str:
    """Return the instruction of the step Calibrate, with the number of poses and the reprojection
    RMS."""
    calibration, n = facts.content.calibration, facts.content.good_poses
    if calibration is None:
        return f"Calibrate from {n} poses."
    if calibration.stale:
        return f"Calibrate again from {n} poses."
    if calibration.refused:
        return "This calibration was rejected: correct what is listed below, and calibrate again."
    rms = calibration.stereo.reprojection_rms_px.get("stereo")
    if rms is None:
        return "This calibration was imported: verify it next."
    poses = len(calibration.stereo.poses)
    return (
        f"Calibrated from {poses} poses, reprojection RMS {rms:.3f} px: check outlying poses, then"
        " verify."
    )


def _calibrate_problems(facts: Facts) -> Iterator[str]:
    """Yield why to calibrate again, and a warning where there are poses for the stereo model
    only."""
    session = facts.content
    if session.calibration:
        if session.calibration.stale:
            yield f"The calibration is out of date: {session.calibration.stale}."
        elif added := sum(pose.state == "good" for pose in session.poses):
            yield (
                f"{format_count(added, 'good pose')} captured after the calibration: calibrate"
                " again to use them."
            )
    if MIN_POSES <= session.good_poses < POSES_FOR_PIXELWISE:
        yield (
            f"With fewer than {POSES_FOR_PIXELWISE} poses only the stereo model is reliable:"
            " capture more."
        )


def _not_calibrated(facts: Facts) -> str:
    """Return what is missing, a session or a calibration; else empty."""
    return _no_session(facts) or ("" if facts.content.calibration else "Calibrate first.")


def _no_usable_calibration(facts: Facts) -> str:
    """Return why there is no calibration to measure with, none or a rejected one; else empty."""
    if facts.content.calibration is None:
        return _not_calibrated(facts)
    if reason := facts.content.calibration.refused:
        return (
            f"The calibration was rejected: {reason}. Calibrate again, or accept it in the step"
            " Calibrate."
        )
    return ""


def _capture_problems(facts: Facts) -> Iterator[str]:
    """Yield device problems, and whether the calibration is out of date."""
    yield from _device_problems(facts)
    if facts.content.calibration and facts.content.calibration.stale:
        yield f"The calibration is out of date: {facts.content.calibration.stale}."


def _verify_done(facts: Facts) -> bool:
    """Whether there is an up-to-date verification."""
    return any(not each.stale for each in facts.content.list_records(Verification))


def _verify_instruction(facts: Facts) -> str:
    """Return the instruction of the step Verify."""
    if _verify_done(facts):
        return "Compare RMS with the noise floor; capture planes and spheres at other depths."
    return "Put a flat plate or a sphere in view, and capture it."


def _verify_problems(facts: Facts) -> Iterator[str]:
    """Yield capture problems, and verifications of an older calibration."""
    yield from _capture_problems(facts)
    records = facts.content.list_records(Verification)
    if stale := [each.name for each in records if each.stale]:
        yield f"{join_names(stale, 3)} measured with an older calibration: measure again."


def _scan_instruction(facts: Facts) -> str:
    """Return the instruction of the step Scan."""
    if facts.scans == 0:
        return "Put the object in view, and capture it."
    return (
        f"{format_count(facts.scans, 'scan')}: turn or move the object for another, or merge them"
        " next."
    )


def _scan_problems(facts: Facts) -> Iterator[str]:
    """Yield capture problems, and scans whose cloud is of an older calibration."""
    yield from _capture_problems(facts)
    for scan in facts.content.scans:
        if scan.cloud == "stale":
            yield f"{scan.label} was reconstructed with an older calibration: reconstruct it again."


def _merge_blocked(facts: Facts) -> str:
    """Return why merging is not possible yet: no usable calibration, or fewer than two scans; else
    empty."""
    if why := _no_usable_calibration(facts):
        return why
    if facts.scans < 2 and not facts.content.merge:
        return "Merging needs at least two scans of one object: scan it again from another side."
    return ""


def _merge_done(facts: Facts) -> bool:
    """Whether there is an up-to-date merge."""
    merge = facts.content.merge
    return merge is not None and not merge.stale


def _merge_instruction(facts: Facts) -> str:
    """Return the instruction of the step Merge."""
    if _merge_done(facts):
        return "Check the alignment; undo the merge if it is wrong, or measure next."
    return "Choose the scans and the reference, and merge."


def _merge_problems(facts: Facts) -> Iterator[str]:
    """Yield whether the merge is stale, and scans whose overlap is too small."""
    merge = facts.content.merge
    if merge is None:
        return
    if merge.stale:
        yield "Scans or calibration have changed since this merge: merge again."
    for name, pair in merge.record.pairs.items():
        if pair.overlap < MIN_OVERLAP:
            yield (
                f"{name} overlaps by only {100 * pair.overlap:.0f} % (RMS {pair.rms_mm:.2f} mm): "
                "scan with more overlap."
            )


def _measure_blocked(facts: Facts) -> str:
    """Return why measuring is not possible yet: no usable calibration or no scan; else empty."""
    if why := _no_usable_calibration(facts):
        return why
    session = facts.content
    if session.merge or session.measurements or any(s.cloud == "fresh" for s in session.scans):
        return ""
    return "Measuring needs a scan: capture one, or reconstruct a recorded one."


def _measure_done(facts: Facts) -> bool:
    """Whether there is an up-to-date measurement."""
    return any(not measured.stale for measured in facts.content.measurements)


def _measure_instruction(facts: Facts) -> str:
    """Return the instruction of the step Measure."""
    if n := sum(not measured.stale for measured in facts.content.measurements):
        return f"{format_count(n, 'measurement')}: add more, or export next."
    return "Choose a surface and a tool, then click in the 3D view; or export next."


def _measure_problems(facts: Facts) -> Iterator[str]:
    """Yield the stale measurements, whose surface has changed."""
    if stale := [measured.label for measured in facts.content.measurements if measured.stale]:
        yield f"{join_names(stale, 3)}: the measured surface has changed; measure again."


def _export_instruction(facts: Facts) -> str:
    """Return the instruction of the step Export."""
    if exports := facts.content.exports:
        return f"{format_count(len(exports), 'file')} to download."
    return "Choose what to write: a cloud, a mesh, the calibration, the report."


STEPS = (
    Step("rig", "Rig", lambda f: "", lambda f: f.rig.state == "open", _rig_instruction,
    _device_problems),
    Step("target", "Target", _no_session, lambda f: bool(f.content.target),
    _target_instruction),
    Step("poses", "Poses", _poses_blocked, _poses_done, _poses_instruction, _poses_problems),
    Step("calibrate", "Calibrate", _calibrate_blocked, _calibrate_done, _calibrate_instruction,
    _calibrate_problems),
    Step("verify", "Verify", _no_usable_calibration, _verify_done, _verify_instruction,
    _verify_problems),
    Step("scan", "Scan", _no_usable_calibration, lambda f: f.scans > 0, _scan_instruction,
    _scan_problems),
    Step("merge", "Merge", _merge_blocked, _merge_done, _merge_instruction, _merge_problems),
    Step("measure", "Measure", _measure_blocked, _measure_done, _measure_instruction,
    _measure_problems),
    Step("export", "Export", _not_calibrated, lambda f: bool(f.content.exports),
    _export_instruction),
)  # fmt: skip
