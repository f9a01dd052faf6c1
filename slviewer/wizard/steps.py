"""The nine steps, in order: what to do now, what each waits for, what is wrong. Adding a step is adding an entry.

Everything here follows from the session's files and the rig.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from slviewer.calibration.soundness import MIN_POSES
from slviewer.pipeline.models import POSES_FOR_PIXELWISE
from slviewer.session.atomic import megabytes
from slviewer.wizard.snapshot import RigView, SessionView, Space, StepView

COVERED, MANY_POSES = 0.75, 15
"""Share of the coverage's goal, or number of poses, from which on the poses are enough."""
Brightness = Literal["", "saturated", "dim"]


@dataclass(frozen=True)
class Facts:
    """What the steps go by; `session` is None until one is open."""

    session: SessionView | None
    rig: RigView
    space: Space | None
    brightness: Brightness = ""

    @property
    def good_poses(self) -> int:
        """Poses that a calibration can use."""
        poses = self.session.poses if self.session else ()
        return sum(pose.state in ("good", "used", "left out") for pose in poses)

    @property
    def scans(self) -> int:
        """Scans with an up-to-date cloud."""
        scans = self.session.scans if self.session else ()
        return sum(scan.purpose == "scan" and scan.cloud == "fresh" for scan in scans)

    @property
    def calibrated(self) -> bool:
        return self.session is not None and self.session.calibration is not None


@dataclass(frozen=True)
class Step:
    """`blocked(facts)`: why it cannot be done yet, or empty; `done(facts)`; `now(facts)`: what to do, in a sentence;
    `wrong(facts)`: what is wrong, and how to mend it.
    """

    key: str
    title: str
    blocked: Callable[[Facts], str]
    done: Callable[[Facts], bool]
    now: Callable[[Facts], str]
    wrong: Callable[[Facts], Iterator[str]]


def views(facts: Facts) -> tuple[StepView, ...]:
    """Every step as the panels show it."""
    found = []
    for step in STEPS:
        because = step.blocked(facts)
        state: Literal["blocked", "ready", "done"] = "blocked" if because else "done" if step.done(facts) else "ready"
        found.append(StepView(step.key, step.title, step.now(facts), state, because, tuple(step.wrong(facts))))
    return tuple(found)


def _no_session(facts: Facts) -> str:
    return "" if facts.session else "Open a session first, or make a new one."


def _devices(facts: Facts) -> Iterator[str]:
    """What stands in the way of a capture."""
    if facts.rig.state == "lost" and facts.rig.camera is None:
        yield f"The rig cannot be used: {facts.rig.fault}. Try it again in the step Rig, or choose another."
    elif facts.rig.state == "lost":
        yield f"The rig is lost: {facts.rig.fault}. It is tried again every two seconds."
    if facts.space is not None and not facts.space.enough:
        needs = megabytes(facts.space.capture_bytes or 0)
        yield f"{megabytes(facts.space.free_bytes)} are free on the disk and a capture needs {needs}: free some space."


def _light(facts: Facts) -> Iterator[str]:
    if facts.brightness == "saturated":
        yield "Parts of the image are saturated: lower the exposure, or close the aperture."
    elif facts.brightness == "dim":
        yield "The image is dim: raise the exposure, or open the aperture."


def _rig_now(facts: Facts) -> str:
    if facts.rig.state == "none":
        return "Choose your camera and projector, or the simulated rig."
    if facts.rig.state == "opening":
        return "The rig is being opened."
    return "Focus both devices on the same place, and set the exposure so that nothing is saturated."


def _rig_wrong(facts: Facts) -> Iterator[str]:
    yield from _devices(facts)
    yield from _light(facts)


def _target_blocked(facts: Facts) -> str:
    return _no_session(facts)


def _target_now(facts: Facts) -> str:
    if facts.session is None or not facts.session.target:
        return "Choose the board that you have, or print one to scale and measure it."
    return f"Hold the board {facts.session.target} in view: it is drawn over the preview when it is seen."


def _poses_blocked(facts: Facts) -> str:
    if why := _no_session(facts):
        return why
    assert facts.session is not None
    if not facts.session.target:
        return "Choose the target first."
    if facts.rig.state == "none" and not facts.session.poses:
        return "Choose a rig first, or import captures below."
    return ""


def _poses_done(facts: Facts) -> bool:
    covered = (
        facts.session is not None and facts.session.coverage is not None and facts.session.coverage.share > COVERED
    )
    # cells that the projector never reaches cannot be covered: many poses are enough too
    sure = facts.session is not None and facts.session.enough
    enough = sure or covered or facts.good_poses >= MANY_POSES or facts.rig.state == "none"
    return facts.good_poses >= POSES_FOR_PIXELWISE and enough


def _poses_now(facts: Facts) -> str:
    session = facts.session
    if session is None:
        return "Hold the board before the rig."
    if _poses_done(facts):
        foreseen = session.foreseen
        if foreseen is not None and foreseen.enough:
            reached = f"a predicted sigma of {foreseen.sigma_mm:.3f} mm, where {foreseen.wanted_mm:.3f} mm is wanted"
            return f"{facts.good_poses} good poses reach {reached}: enough. Calibrate."
        if foreseen is not None and foreseen.sigma_mm is not None:
            lack = f"a sigma of {foreseen.sigma_mm:.3f} mm is predicted, and {foreseen.wanted_mm:.3f} mm wanted"
            return f"{facts.good_poses} good poses cover the view; {lack}: add more, or calibrate."
        return f"{facts.good_poses} good poses cover the view: calibrate, or add more."
    suggestion = f"{session.suggestion.sentence}, and capture" if session.suggestion else "Hold the board and capture"
    if session.planning:
        suggestion = "Choosing where the board tells most; or hold it anywhere new, and capture"
    wanted = max(POSES_FOR_PIXELWISE, facts.good_poses + 1)
    return f"{suggestion}: pose {facts.good_poses + 1} of {wanted} or more."


def _poses_wrong(facts: Facts) -> Iterator[str]:
    yield from _devices(facts)
    yield from _light(facts)
    if facts.session is not None:
        for pose in facts.session.poses[-3:]:
            if pose.state == "refused":
                yield f"{pose.name} cannot be used: {pose.why}"


def _calibrate_blocked(facts: Facts) -> str:
    if why := _no_session(facts):
        return why
    if facts.calibrated:
        return ""
    if facts.session is not None and not facts.session.target:
        return "Choose the target first."
    if facts.good_poses < MIN_POSES:
        return f"{facts.good_poses} good poses so far, and {MIN_POSES} are needed at least: capture the board first."
    return ""


def _calibrate_done(facts: Facts) -> bool:
    calibration = facts.session.calibration if facts.session else None
    return calibration is not None and not calibration.stale and not calibration.refused


def _calibrate_now(facts: Facts) -> str:
    calibration = facts.session.calibration if facts.session else None
    if calibration is None:
        return f"Calibrate from {facts.good_poses} poses."
    if calibration.stale:
        return f"Calibrate again from {facts.good_poses} poses."
    if calibration.refused:
        return "This calibration was rejected, and is kept to look into: mend what is named below, and calibrate again."
    stereo = calibration.reprojection_px.get("stereo")
    figure = (
        "made elsewhere" if stereo is None else f"reprojection RMS {stereo:.3f} px from {len(calibration.poses)} poses"
    )
    return f"Calibrated, {figure}: look for poses that stand out, and verify next."


def _calibrate_wrong(facts: Facts) -> Iterator[str]:
    session = facts.session
    if session is None:
        return
    if session.calibration is not None:
        if session.calibration.stale:
            yield f"The calibration is out of date: {session.calibration.stale}."
        elif added := sum(pose.state == "good" for pose in session.poses):
            yield f"{added} good pose{'s' * (added != 1)} came after the calibration: calibrate again to use them."
    if MIN_POSES <= facts.good_poses < POSES_FOR_PIXELWISE:
        yield f"With fewer than {POSES_FOR_PIXELWISE} poses only the stereo model is trusted: capture more."


def _calibrated(facts: Facts) -> str:
    return _no_session(facts) or ("" if facts.calibrated else "Calibrate first.")


def _needs_calibration(facts: Facts) -> str:
    if why := _calibrated(facts):
        return why
    assert facts.session is not None and facts.session.calibration is not None
    if reason := facts.session.calibration.refused:
        return f"The calibration was rejected: {reason}. Calibrate again, or insist on it in the step Calibrate."
    return ""


def _capturing_wrong(facts: Facts) -> Iterator[str]:
    yield from _devices(facts)
    yield from _light(facts)
    calibration = facts.session.calibration if facts.session else None
    if calibration is not None and calibration.stale:
        yield f"The calibration is out of date: {calibration.stale}."


def _verify_done(facts: Facts) -> bool:
    return facts.session is not None and any(not row.stale for row in facts.session.verifications)


def _verify_now(facts: Facts) -> str:
    if _verify_done(facts):
        return "Compare RMS with the noise floor; add planes and spheres at other depths."
    return "Put a flat board or a sphere before the rig and capture it: the models are compared on it."


def _verify_wrong(facts: Facts) -> Iterator[str]:
    yield from _capturing_wrong(facts)
    stale = sorted({row.capture for row in facts.session.verifications if row.stale}) if facts.session else []
    if stale:
        were = "was" if len(stale) == 1 else "were"
        yield f"{', '.join(stale)} {were} measured with an older calibration: measure again."


def _scan_now(facts: Facts) -> str:
    if facts.scans == 0:
        return "Put the object before the rig and capture it."
    return f"{facts.scans} scan{'s' * (facts.scans != 1)}: turn or move the object for another, or merge them next."


def _scan_wrong(facts: Facts) -> Iterator[str]:
    yield from _capturing_wrong(facts)
    for scan in facts.session.scans if facts.session else ():
        if scan.cloud == "stale":
            yield f"{scan.label} was reconstructed with an older calibration: reconstruct it again."


def _merge_blocked(facts: Facts) -> str:
    if why := _needs_calibration(facts):
        return why
    if facts.scans < 2 and not (facts.session and facts.session.merge):
        return "Merging takes two scans of one object at least: scan it again from elsewhere."
    return ""


def _merge_done(facts: Facts) -> bool:
    return facts.session is not None and facts.session.merge is not None and not facts.session.merge.stale


def _merge_now(facts: Facts) -> str:
    if _merge_done(facts):
        return "Look at how the scans lie on each other; undo if they do not, or measure next."
    return "Choose the scans, and the one whose place the others take."


def _merge_wrong(facts: Facts) -> Iterator[str]:
    merge = facts.session.merge if facts.session else None
    if merge is not None and merge.stale:
        yield "The merge came from scans or a calibration that have changed since: merge again."
    if merge is not None:
        for name, (rms, overlap, _) in merge.pairs.items():
            if overlap < 0.3:
                yield f"{name} overlaps by {100 * overlap:.0f} % only (RMS {rms:.2f} mm): scan with more overlap."


def _measure_blocked(facts: Facts) -> str:
    if why := _needs_calibration(facts):
        return why
    session = facts.session
    surfaces = session is not None and (session.merge or any(scan.cloud == "fresh" for scan in session.scans))
    if not surfaces and not (session and session.measurements):
        return "Measuring takes a scan: capture one, or reconstruct one that was recorded."
    return ""


def _measure_done(facts: Facts) -> bool:
    return facts.session is not None and any(not measured.stale for measured in facts.session.measurements)


def _measure_now(facts: Facts) -> str:
    if _measure_done(facts):
        assert facts.session is not None
        kept = sum(not measured.stale for measured in facts.session.measurements)
        return f"{kept} measurement{'s are' if kept != 1 else ' is'} kept for the report: add others, or export next."
    return "Choose a surface and a tool, and click on what you want to know; or export next."


def _measure_wrong(facts: Facts) -> Iterator[str]:
    stale = [measured.name for measured in facts.session.measurements if measured.stale] if facts.session else []
    if stale:
        named = ", ".join(stale[:3]) + (f" and {len(stale) - 3} more" if len(stale) > 3 else "")
        yield f"{named}: what {'it was' if len(stale) == 1 else 'they were'} measured on has changed; measure again."


def _export_now(facts: Facts) -> str:
    exports = facts.session.exports if facts.session else ()
    if exports:
        return f"{len(exports)} file{'s' * (len(exports) != 1)} to download; write others if you need them."
    return "Choose what to write: a cloud, a mesh, the calibration, the report."


def _nothing(facts: Facts) -> Iterator[str]:
    return iter(())


STEPS = (
    Step("rig", "Rig", lambda f: "", lambda f: f.rig.state == "open", _rig_now, _rig_wrong),
    Step(
        "target",
        "Target",
        _target_blocked,
        lambda f: bool(f.session and f.session.target),
        _target_now,
        _nothing,
    ),
    Step("poses", "Poses", _poses_blocked, _poses_done, _poses_now, _poses_wrong),
    Step("calibrate", "Calibrate", _calibrate_blocked, _calibrate_done, _calibrate_now, _calibrate_wrong),
    Step("verify", "Verify", _needs_calibration, _verify_done, _verify_now, _verify_wrong),
    Step("scan", "Scan", _needs_calibration, lambda f: f.scans > 0, _scan_now, _scan_wrong),
    Step("merge", "Merge", _merge_blocked, _merge_done, _merge_now, _merge_wrong),
    Step("measure", "Measure", _measure_blocked, _measure_done, _measure_now, _measure_wrong),
    Step(
        "export",
        "Export",
        _calibrated,
        lambda f: bool(f.session and f.session.exports),
        _export_now,
        _nothing,
    ),
)
