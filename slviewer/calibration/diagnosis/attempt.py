"""Stereo calibration with diagnosis: exclude unfit poses, calibrate, and judge the result."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.diagnosis.evidence import Evidence, PoseEvidence
from slviewer.calibration.diagnosis.numbering import describe_misnumbering, reconcile_marks
from slviewer.calibration.diagnosis.poses import motion_limit_px, reason_to_exclude
from slviewer.calibration.diagnosis.rules import judge_evidence
from slviewer.calibration.diagnosis.solution import measure_solution
from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.calibration.observe import Observation
from slviewer.calibration.soundness import MIN_POSES, nominal_tilt_spread_deg
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.target.board import Board


@dataclass(frozen=True)
class Attempt:
    """Result of an attempt. ``stereo``: the calibration; of a rejected one the solution to inspect, None without one.
    ``observations``: the poses that it used, circles at their centres. ``left_out``: the others, and why.
    ``warning``: a further message for the operator.
    """

    verdict: Verdict
    evidence: Evidence
    stereo: StereoModel | None
    observations: tuple[Observation, ...]
    left_out: Mapping[str, str]
    warning: str = ""


def attempt_stereo(
    observations: Sequence[Observation],
    poses: Sequence[PoseEvidence],
    projector: tuple[int, int],
    board: Board,
    left_out: Mapping[str, str] | None = None,
) -> Attempt:
    """Calibrate from the readable poses, and judge the result by the evidence of all ``poses``, unreadable ones
    included.

    ``left_out``: poses excluded beforehand, and why.
    """
    observations, warning = reconcile_marks(board, observations)
    poses = [_check_numbering(pose, board, observations) for pose in poses]
    set_aside = _exclude_unfit(poses, observations)
    kept = [o for o in observations if o.name not in set_aside]
    out = {**(left_out or {}), **set_aside}
    refusal = ""
    stereo: StereoModel | None
    try:
        stereo, used = calibrate_centres(kept, projector, str(board), out)
    except CalibrationRejected as error:
        refusal = str(error)
        stereo, used = _solve_unchecked(kept, projector, board, out)
    evidence = Evidence(
        board=str(board),
        projector=projector,
        poses=tuple(poses),
        set_aside=set_aside,
        refusal=refusal,
        tilt_spread_deg=nominal_tilt_spread_deg(kept),
        solution=None if stereo is None else measure_solution(kept, stereo),
    )
    verdict = judge_evidence(evidence)
    left_out = dict(stereo.left_out if stereo else out)
    for finding in verdict.findings:  # the finding is more specific than the fit's reason
        if finding.cause in ("moved", "outlier", "board-numbering") and len(finding.poses) == 1:
            left_out |= {name: finding.text() for name in finding.poses if name in left_out and name not in out}
    return Attempt(verdict, evidence, stereo, tuple(used), left_out, warning)


def _solve_unchecked(
    observations: Sequence[Observation], projector: tuple[int, int], board: Board, left_out: Mapping[str, str]
) -> tuple[StereoModel | None, list[Observation]]:
    """An unchecked solution for diagnosis, and the poses it used; (None, []) where it is no valid rig."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of boards that lie behind a device
            stereo, used = calibrate_centres(observations, projector, str(board), left_out, strict=False)
    except CalibrationRejected:
        return None, []
    seen = all(np.isfinite(px) for px in stereo.reprojection_rms_px.values())
    return (stereo, used) if seen and stereo.depth_range_mm is not None else (None, [])


def _check_numbering(pose: PoseEvidence, board: Board, observations: Sequence[Observation]) -> PoseEvidence:
    seen = next((o for o in observations if o.name == pose.name), None)
    return pose if seen is None else replace(pose, numbering=describe_misnumbering(board, seen.points, seen.camera))


def _exclude_unfit(poses: Sequence[PoseEvidence], observations: Sequence[Observation]) -> dict[str, str]:
    """Readable poses to exclude, with reasons; none where too few would remain: the fault is then common to all
    poses."""
    read = {o.name for o in observations}
    limit = motion_limit_px(poses)
    out = {pose.name: why for pose in poses if pose.name in read and (why := reason_to_exclude(pose, limit))}
    return out if len(read) - len(out) >= max(MIN_POSES, len(read) / 2) else {}
