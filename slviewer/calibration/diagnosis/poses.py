"""Faults of single poses, and which poses must be excluded."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from slviewer.calibration.diagnosis.evidence import Evidence, PoseEvidence
from slviewer.calibration.diagnosis.verdict import Cause, Finding, Severity
from slviewer.fringe.suspect import LIGHT_FAULTS

COMMON_SHARE = 0.5
"""Share of the poses from which on a fault is common, not that of single poses."""
FEW_POSES = 6
"""Poses below which a calibration without the faulty ones stays doubtful."""
MOVED_PX = (0.12, 0.3)
"""A board that moved by less did not, by more did; in between, one that moved several times as much as it usually does.
"""
_MOTION_RATIO = 5.0
_RESIDUAL_RATIO = 4.0  # times the usual residual, beyond which a device disagrees

ORDERS: dict[Cause, str] = {
    "frame-lag": "the camera is one image behind the projector",
    "missing-frame": "a frame is missing, and those that follow came too early",
    "frame-order": "frames show patterns that are not theirs",
}
"""The ways in which frames are out of order, in words."""


def reason_to_exclude(pose: PoseEvidence, limit_px: float) -> str:
    """Reason to exclude a pose whose board was read; empty where it is fit."""
    order = frame_order(pose)
    if order:
        sentence = next((s.sentence for s in pose.suspects if s.fault not in (*LIGHT_FAULTS, "strange")), "")
        return f"its frames are out of order ({sentence or ORDERS[order]}): capture the pose again"
    if pose.moved_px > limit_px:
        return f"the board moved by {pose.moved_px:.2f} px during capture: hold it still, and capture the pose again"
    if pose.numbering:
        return f"its features are {pose.numbering}: uncover the whole board, and capture the pose again"
    return ""


def motion_limit_px(poses: Sequence[PoseEvidence]) -> float:
    """px: apparent motion of a board that stood still, estimated from these poses."""
    moved = [pose.moved_px for pose in poses if np.isfinite(pose.moved_px)]
    return float(np.clip(_MOTION_RATIO * np.median(moved), *MOVED_PX)) if moved else MOVED_PX[1]


def frame_order(pose: PoseEvidence) -> Cause | None:
    """How the frames of a pose are out of order, if they are."""
    orders: dict[str, Cause] = {cause: cause for cause in ORDERS} | {"duplicate-frame": "frame-order"}
    for contradiction in pose.contradictions[:1]:
        if contradiction.cause in orders:
            return orders[contradiction.cause]
    faults = Counter(s.fault for s in pose.suspects)
    if pose.displaced > 0 or (faults["lag"] and pose.displaced >= 0):
        return "frame-lag"
    if pose.displaced < 0 or faults["dropped"]:
        return "missing-frame"
    return "frame-order" if faults["late"] + faults["early"] + faults["swapped"] else None


def find_faulty_poses(e: Evidence) -> Iterator[Finding]:
    """Poses that are misnumbered, moved, or disagree with the others."""
    sentences: dict[Cause, dict[str, str]] = {"board-numbering": {}, "moved": {}, "outlier": {}}
    most_moved = motion_limit_px(e.poses)
    for pose in e.poses:
        if frame_order(pose):
            continue
        if pose.numbering:
            sentences["board-numbering"][pose.name] = f"in {pose.name} the board's features are {pose.numbering}"
        elif pose.moved_px > most_moved:
            sentences["moved"][pose.name] = (
                f"{pose.name}: the board moved by {pose.moved_px:.2f} px while it was captured"
            )
    for name, stray in e.solution.strayed.items() if e.solution else ():
        if name in e.set_aside or any(name in poses for poses in sentences.values()):
            continue
        camera, projector = (
            (_RESIDUAL_RATIO * max(usual, 0.02) for usual in e.solution.usual_px) if e.solution else (0.0, 0.0)
        )
        if stray.camera_px < camera and stray.projector_px > projector:
            sentences["moved"][name] = (
                f"{name}: what the projector shows lies {min(stray.projector_px, 999):.1f} px from where the camera "
                "sees the board: it moved while it was captured"
            )
        else:
            sentences["outlier"][name] = (
                f"{name} disagrees with the other poses by {min(stray.camera_px, 999):.1f} px in the camera and "
                f"{min(stray.projector_px, 999):.1f} px in the projector"
            )
    for cause, poses in sentences.items():
        if poses:
            names = tuple(poses)
            sentence = "; ".join(list(poses.values())[:3]) + (f"; and {len(poses) - 3} more" if len(poses) > 3 else "")
            how = severity_of(e, names, is_excluded=e.solution is not None)
            yield Finding(cause, how, f"{sentence}; excluded", _REMEDIES[cause], names)


_REMEDIES: dict[Cause, str] = {
    "board-numbering": "uncover the whole board, and capture the pose again",
    "moved": "hold the board still until all frames are taken, and capture the pose again",
    "outlier": "look at its picture, and capture the pose again",
}


def severity_of(e: Evidence, names: tuple[str, ...], is_excluded: bool) -> Severity:
    """How bad it is that these poses are faulty; ``is_excluded``: the fit does without them."""
    if len(names) >= COMMON_SHARE * len(e.poses):
        return "rejected"
    left = len(e.solution.used) if e.solution else 0
    return "note" if is_excluded and left >= FEW_POSES and len(names) <= 0.25 * len(e.poses) else "doubtful"


def was_refused(e: Evidence, name: str) -> bool:
    """Whether a pose could not be read."""
    return any(pose.name == name and pose.refused for pose in e.poses)


def list_poses(e: Evidence, names: tuple[str, ...]) -> str:
    """In which poses, in words."""
    if len(names) == len(e.poses):
        return "in every pose"
    return f"in {names[0]}" if len(names) == 1 else f"in {len(names)} of {len(e.poses)} poses"
