"""A stereo calibration that is judged: what may spoil it is kept out of the fit, and what came of it gets a verdict."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.centres import calibrate_centred
from slviewer.calibration.diagnosis.evidence import Evidence, PoseEvidence
from slviewer.calibration.diagnosis.numbering import consistent_marks, misnumbered
from slviewer.calibration.diagnosis.poses import most_moved_px, unfit
from slviewer.calibration.diagnosis.rules import judged
from slviewer.calibration.diagnosis.solution import solution_evidence
from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.calibration.observe import Observation
from slviewer.calibration.soundness import MIN_POSES, nominal_tilt_spread_deg
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.target.board import Board


@dataclass(frozen=True)
class Attempt:
    """What came of it. ``stereo``: the calibration; of a rejected one what there is to look into, None for nothing.
    ``observations``: the poses that it used, circles at their centres. ``left_out``: the others, and why.
    ``warning``: what else the operator should know.
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
    """Calibrate from the poses that were read, and judge it by what all ``poses`` say, also those that were not.

    ``left_out``: poses kept out beforehand, and why.
    """
    observations, warning = consistent_marks(board, observations)
    poses = [_numbered(pose, board, observations) for pose in poses]
    set_aside = _set_aside(poses, observations)
    kept = [o for o in observations if o.name not in set_aside]
    out = {**(left_out or {}), **set_aside}
    refusal = ""
    stereo: StereoModel | None
    try:
        stereo, used = calibrate_centred(kept, projector, str(board), out)
    except CalibrationRejected as error:
        refusal = str(error)
        stereo, used = _whatever_there_is(kept, projector, board, out)
    evidence = Evidence(
        board=str(board),
        projector=projector,
        poses=tuple(poses),
        set_aside=set_aside,
        refusal=refusal,
        tilt_spread_deg=nominal_tilt_spread_deg(kept),
        solution=None if stereo is None else solution_evidence(kept, stereo),
    )
    verdict = judged(evidence)
    left_out = dict(stereo.left_out if stereo else out)
    for finding in verdict.findings:  # which knows more of a pose than the fit that found it out
        if finding.cause in ("moved", "outlier", "board-numbering") and len(finding.poses) == 1:
            left_out |= {name: finding.text() for name in finding.poses if name in left_out and name not in out}
    return Attempt(verdict, evidence, stereo, tuple(used), left_out, warning)


def _whatever_there_is(
    observations: Sequence[Observation], projector: tuple[int, int], board: Board, left_out: Mapping[str, str]
) -> tuple[StereoModel | None, list[Observation]]:
    """A solution to look into, and the poses it used; none where it is no rig at all."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of boards that lie behind a device
            stereo, used = calibrate_centred(observations, projector, str(board), left_out, strict=False)
    except CalibrationRejected:
        return None, []
    seen = all(np.isfinite(px) for px in stereo.reprojection_rms_px.values())
    return (stereo, used) if seen and stereo.depth_range_mm is not None else (None, [])


def _numbered(pose: PoseEvidence, board: Board, observations: Sequence[Observation]) -> PoseEvidence:
    seen = next((o for o in observations if o.name == pose.name), None)
    return pose if seen is None else replace(pose, numbering=misnumbered(board, seen.points, seen.camera))


def _set_aside(poses: Sequence[PoseEvidence], observations: Sequence[Observation]) -> dict[str, str]:
    """Poses that were read and must not count; none where few would be left: it is no fault of single poses then."""
    read = {o.name for o in observations}
    limit = most_moved_px(poses)
    out = {pose.name: why for pose in poses if pose.name in read and (why := unfit(pose, limit))}
    return out if len(read) - len(out) >= max(MIN_POSES, len(read) / 2) else {}
