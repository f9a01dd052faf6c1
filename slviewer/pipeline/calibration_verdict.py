"""The verdict on a session's calibration: made with it, kept beside it, and asked before it is used."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.rules import judge_evidence
from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.calibration.observe import Observation, Smoothing
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.feedback import Progress
from slviewer.pipeline.models import VERDICT, available, save_stereo
from slviewer.pipeline.poses import Judged, judge_all
from slviewer.records import from_plain
from slviewer.session.store import Session
from slviewer.target.board import Board


def attempt(
    store: Session,
    names: Sequence[str],
    board: Board,
    smoothing: Smoothing,
    left_out: Mapping[str, str],
    progress: Progress,
) -> DiagnosedCalibration:
    """Read and examine the target poses, calibrate stereo from them, and judge it. ``left_out``: poses that the
    operator excluded.
    """
    sequence = store.load_capture(names[0]).sequence
    poses = judge_all(store, names, board, smoothing, examine=True)
    return attempt_poses(poses, len(names), sequence, board, left_out, progress)


def attempt_poses(
    poses: Iterable[Judged],
    count: int,
    sequence: PatternSequence,
    board: Board,
    left_out: Mapping[str, str],
    progress: Progress,
) -> DiagnosedCalibration:
    """Calibrate stereo from ``count`` target poses as they are read, and judge it; ``left_out`` as in ``attempt``."""
    if contradiction := contradicting(sequence):
        evidence = Evidence(str(board), sequence.projector, (), contradiction=contradiction)
        return DiagnosedCalibration(judge_evidence(evidence), evidence, None, (), dict(left_out))
    observations: list[Observation] = []
    evidence_of_poses = []
    refused = dict(left_out)
    for i, pose in enumerate(poses, 1):
        progress(i / count, f"read {pose.name}")
        if pose.observation is None:
            refused[pose.name] = pose.refused
        else:
            observations.append(pose.observation)
        if pose.evidence is not None:
            evidence_of_poses.append(pose.evidence)
    result = calibrate_with_diagnosis(observations, evidence_of_poses, sequence.projector, board, refused)
    if result.stereo is None:
        return result
    return replace(result, stereo=replace(result.stereo, excluded=result.excluded))


def contradicting(sequence: PatternSequence) -> str:
    """Why fringes and Gray code of a sequence cannot belong together; empty where they can."""
    for axis in sequence.axes:
        if sequence.periods_px(axis) and sequence.find("gray", axis):
            try:
                axis_layout(sequence, axis)
            except InputError as error:
                return str(error)
    return ""


def keep_rejected(store: Session, stereo: StereoModel, settings: Mapping[str, Any], verdict: Verdict) -> None:
    """Make a rejected calibration the session's own, to look into; models of before, of other poses, are trashed."""
    for name in available(store):
        store.trash_result(f"calibration/{name}")
    save_stereo(store, stereo, store.input_hashes(*stereo.poses), settings, verdict)


def save_verdict(store: Session, verdict: Verdict, poses: Sequence[str]) -> None:
    """Keep what was said of an attempt to calibrate from these poses, whether or not anything came of it."""
    store.save_result(VERDICT, {"verdict": verdict.to_json(), "inputs": store.input_hashes(*poses)}, {})


def last_verdict(store: Session) -> Verdict | None:
    """What was said of the last calibration that was tried, also if none came of it; None where nothing was."""
    if not store.has_result(VERDICT):
        return None
    return from_plain(store.load_result(VERDICT, only=())[0]["verdict"], Verdict)


def rejected(verdict: Verdict, kept: bool) -> CalibrationRejected:
    """The error to raise for a rejected calibration; ``kept``: the session holds it, to look into."""
    first, more = verdict.findings[0], len(verdict.findings) - 1
    others = f" (and {more} more finding{'s' * (more != 1)})" if more else ""
    kept_words = "; the calibration is kept to look into, and not used" if kept else ""
    return CalibrationRejected(f"{first.text()}{others}{kept_words}")
