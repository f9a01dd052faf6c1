"""The order in which the rules are applied to the evidence of a calibration, and the rules on the
set of poses.

A rule yields the findings of one cause. Faults of the frames come first, as nothing that follows
can be trusted; then wrong descriptions; then single poses; then the set of poses as a whole. The
stages after a rejecting finding are not run, as their findings could be its consequences.
"""

from collections.abc import Callable, Iterator

from slviewer.calibration.diagnosis.capture_rules import (
    diagnose_board_size,
    diagnose_description,
    diagnose_frame_order,
    diagnose_gamma,
    diagnose_mirroring,
    diagnose_period,
    diagnose_ripple,
    diagnose_saturation,
)
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.poses import FEW_POSES, diagnose_single_poses
from slviewer.calibration.soundness import MIN_POSES, MIN_TILT_SPREAD_DEG
from slviewer.calibration.stereo import MAX_FOCAL_SIGMA
from slviewer.records.verdict import Finding, Verdict

MIN_TILT_DEG = 15.0
MAX_FOCAL_UNCERTAINTY = 0.02
HIGH_REPROJECTION_PX = 1.0


def diagnose_pose_count(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where fewer poses are usable than a calibration needs."""
    count = (
        len(e.solution.used)
        if e.solution
        else len([p for p in e.usable if p.name not in e.excluded])
    )
    if count >= FEW_POSES:
        return
    refused = [f"{pose.name}: {pose.refused}" for pose in e.poses if pose.refused]
    because = f" ({'; '.join(refused[:3])})" if refused else ""
    yield Finding(
        "too-few-poses",
        "rejected" if count < MIN_POSES else "doubtful",
        f"{count} usable pose{'s' * (count != 1)} of {len(e.poses)}{because}",
        f"capture the board in more positions and tilts: {FEW_POSES} at least, and a dozen is"
        " better",
    )


def diagnose_parallel_poses(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where the boards of all poses are nearly parallel."""
    solved = None if e.tilts_undetermined else e.solution
    spread = solved.tilt_spread_deg if solved else e.tilt_spread_deg
    if not spread < MIN_TILT_DEG or len(e.usable) < MIN_POSES:
        return
    rejected = spread < MIN_TILT_SPREAD_DEG or solved is None or bool(e.refusal)
    yield Finding(
        "parallel-poses",
        "rejected" if rejected else "doubtful",
        f"all {len(e.solution.used if e.solution else e.usable)} poses are nearly parallel "
        f"(tilts differ by {spread:.1f} degrees, and should by {MIN_TILT_DEG:.0f} at least)",
        "tilt the board by 15 to 30 degrees, in different directions",
    )


def diagnose_empty_corners(e: Evidence) -> Iterator[Finding]:
    """Yield a finding where no pose covers a corner of the image."""
    if e.solution is not None and e.solution.empty_corners:
        corners = e.solution.empty_corners
        *others, last = corners
        where = f"{', '.join(others)} and {last}" if others else last
        yield Finding(
            "empty-corner",
            "doubtful",
            f"no pose reaches the {where} of the image, where lenses bend the most",
            f"capture poses that reach into the {where}",
        )


def diagnose_uncertainty(e: Evidence) -> Iterator[Finding]:
    """Yield findings on a large reprojection error, and on focal lengths that the poses leave
    uncertain.

    With a large reprojection error an uncertain focal length is at most doubtful: it may be a
    consequence.
    """
    if e.solution is None:
        return
    is_misfit = e.solution.reprojection_px > HIGH_REPROJECTION_PX
    if is_misfit:
        yield Finding(
            "residuals",
            "rejected" if e.refusal else "doubtful",
            f"the reprojection error is {e.solution.reprojection_px:.1f} px",
            "check that the board is flat, in focus and held still, and look at the poses with the"
            " largest residuals",
        )
    for device, sigma in e.solution.focal_sigma.items():
        if not sigma < MAX_FOCAL_UNCERTAINTY:
            yield Finding(
                "uncertain",
                "doubtful" if is_misfit or sigma < MAX_FOCAL_SIGMA else "rejected",
                f"the poses, whose tilts differ by {e.solution.tilt_spread_deg:.0f} degrees, leave"
                f" the {device}'s focal length uncertain by {100 * sigma:.1f} %",
                "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
            )


Rule = Callable[[Evidence], Iterator[Finding]]

STAGES: tuple[tuple[Rule, ...], ...] = (
    (diagnose_frame_order, diagnose_saturation),
    (diagnose_mirroring, diagnose_period, diagnose_description, diagnose_board_size),
    (
        diagnose_single_poses,
        diagnose_gamma,
        diagnose_ripple,
        diagnose_pose_count,
        diagnose_parallel_poses,
        diagnose_empty_corners,
        diagnose_uncertainty,
    ),
)


def judge_evidence(evidence: Evidence) -> Verdict:
    """Judge the evidence of a calibration; the verdict's findings start with the root cause."""
    findings: list[Finding] = []
    for stage in STAGES:
        findings += [finding for rule in stage for finding in rule(evidence)]
        if any(finding.severity == "rejected" for finding in findings):
            return Verdict.of(findings)
    if evidence.refusal:
        sentence, _, remedy = evidence.refusal.partition(": ")
        remedy = remedy or "capture the poses again, and check each before the next"
        findings.append(Finding("residuals", "rejected", sentence, remedy))
    return Verdict.of(findings)
