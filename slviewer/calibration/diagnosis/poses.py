"""Rules on single poses: frame order, motion, numbering, and residuals; and the poses to exclude
before a fit."""

from collections.abc import Iterator, Sequence

import numpy as np

from slviewer.calibration.diagnosis.evidence import Evidence, ExcludedPose, PoseEvidence
from slviewer.records.verdict import Cause, Finding, Severity

COMMON_SHARE = 0.5
"""Least share of the poses with which a fault counts as common to all."""
FEW_POSES = 6
"""A calibration from fewer poses is doubtful."""
MOTION_LIMITS_PX = (0.12, 0.3)
"""Least and largest value of the limit beyond which a board has moved."""
_MOTION_RATIO = 5.0  # of that limit over the poses' median motion
_RESIDUAL_RATIO = 4.0  # of the largest plausible residual over the poses' median

ORDERS: dict[Cause, str] = {
    "frame-lag": "the camera is one image behind the projector",
    "missing-frame": "a frame is missing, and those that follow came too early",
    "frame-order": "frames show patterns that are not theirs",
}
"""Descriptions of the causes by which frames are out of order."""
_ORDER_CAUSES: dict[Cause, Cause] = {
    **{cause: cause for cause in ORDERS}, "duplicate-frame": "frame-order"
}  # fmt: skip


def reason_to_exclude(pose: PoseEvidence, limit_px: float) -> str:
    """Return the reason to exclude a pose whose board was read; "" where it is fit.

    ``limit_px``: the largest motion of a board at rest.
    """
    order = classify_frame_order(pose)
    if order:
        sentence = next((f.sentence for f in pose.findings if f.cause in _ORDER_CAUSES), "")
        return f"its frames are out of order ({sentence or ORDERS[order]}): capture the pose again"
    if pose.moved_px > limit_px:
        return (
            f"the board moved by {pose.moved_px:.2f} px during capture: hold it still, and capture"
            " the pose again"
        )
    if pose.numbering:
        return (
            f"its features are {pose.numbering}: uncover the whole board, and capture the pose"
            " again"
        )
    return ""


def motion_limit_px(poses: Sequence[PoseEvidence]) -> float:
    """Estimate the largest apparent motion, in px, of a board at rest, from the median motion over
    the poses."""
    motions = [pose.moved_px for pose in poses if np.isfinite(pose.moved_px)]
    return (
        float(np.clip(_MOTION_RATIO * np.median(motions), *MOTION_LIMITS_PX))
        if motions
        else MOTION_LIMITS_PX[1]
    )


def classify_frame_order(pose: PoseEvidence) -> Cause | None:
    """Return the cause by which the frames of a pose are out of order; None where they are in
    order."""
    for finding in pose.findings:
        if finding.cause in _ORDER_CAUSES:
            return _ORDER_CAUSES[finding.cause]
    # the white frame, which decoding does not need
    if pose.displaced:
        return "frame-lag" if pose.displaced > 0 else "missing-frame"
    return None


def list_ordered_poses(e: Evidence) -> list[PoseEvidence]:
    """List the poses whose frames are in order."""
    return [pose for pose in e.poses if not classify_frame_order(pose)]


def diagnose_single_poses(e: Evidence) -> Iterator[Finding]:
    """Yield a finding each for the poses that are misnumbered, that moved, and that disagree with
    the others."""
    sentences: dict[Cause, dict[str, str]] = {"board-numbering": {}, "moved": {}, "outlier": {}}
    limit_px = motion_limit_px(e.poses)
    for pose in list_ordered_poses(e):
        if pose.numbering:
            sentences["board-numbering"][pose.name] = (
                f"in {pose.name} the board's features are {pose.numbering}"
            )
        elif pose.moved_px > limit_px:
            sentences["moved"][pose.name] = (
                f"{pose.name}: the board moved by {pose.moved_px:.2f} px while it was captured"
            )
    if e.solution is not None:
        explained = {*e.excluded, *sentences["board-numbering"], *sentences["moved"]}
        for name, residuals in e.solution.excluded.items():
            if name not in explained:
                cause, sentence = _explain_residuals(name, residuals, e.solution.median_pose_rms_px)
                sentences[cause][name] = sentence
    for cause, poses in sentences.items():
        if poses:
            names = tuple(poses)
            sentence = "; ".join(list(poses.values())[:3]) + (
                f"; and {len(poses) - 3} more" if len(poses) > 3 else ""
            )
            severity = rate_severity(e, names, is_excluded=e.solution is not None)
            yield Finding(cause, severity, f"{sentence}; excluded", _REMEDIES[cause], names)


def _explain_residuals(
    name: str, residuals: ExcludedPose, median_px: tuple[float, float]
) -> tuple[Cause, str]:
    """Return the cause of an excluded pose's residuals, given the poses' median residuals, and a
    sentence on them."""
    camera_limit, projector_limit = (_RESIDUAL_RATIO * max(px, 0.02) for px in median_px)
    camera_px, projector_px = min(residuals.camera_px, 999), min(residuals.projector_px, 999)
    if camera_px < camera_limit and projector_px > projector_limit:
        return (
            "moved",
            (
                f"{name}: the projector's coordinates are {projector_px:.1f} px off the board that"
                " the camera sees: it moved while it was captured"
            ),
        )
    return (
        "outlier",
        (
            f"{name} disagrees with the other poses by {camera_px:.1f} px in the camera and"
            f" {projector_px:.1f} px in the projector"
        ),
    )


_REMEDIES: dict[Cause, str] = {
    "board-numbering": "uncover the whole board, and capture the pose again",
    "moved": "hold the board still until all frames are captured, and capture the pose again",
    "outlier": "look at its picture, and capture the pose again",
}


def rate_severity(e: Evidence, names: tuple[str, ...], is_excluded: bool) -> Severity:
    """Rate a fault of the poses ``names`` by their share of all poses; ``is_excluded``: the fit
    excluded them."""
    if len(names) >= COMMON_SHARE * len(e.poses):
        return "rejected"
    used = len(e.solution.used) if e.solution else 0
    return (
        "note"
        if is_excluded and used >= FEW_POSES and len(names) <= 0.25 * len(e.poses)
        else "doubtful"
    )


def was_refused(e: Evidence, name: str) -> bool:
    """Whether the board or the phase of a pose could not be read."""
    return any(pose.name == name and pose.refused for pose in e.poses)


def format_poses(e: Evidence, names: tuple[str, ...]) -> str:
    """Format the poses of a finding for its message: "in every pose", "in pose_03", "in 4 of 12
    poses"."""
    if len(names) == len(e.poses):
        return "in every pose"
    return f"in {names[0]}" if len(names) == 1 else f"in {len(names)} of {len(e.poses)} poses"
