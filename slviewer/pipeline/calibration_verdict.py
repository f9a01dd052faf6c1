"""The verdict on a session's calibration: made and stored with it, and checked before it is
used."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.rules import judge_evidence
from slviewer.calibration.observe import Observation, Smoothing
from slviewer.errors import CalibrationRejected, InputError
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.feedback import Progress
from slviewer.pipeline.models import VERDICT
from slviewer.pipeline.poses import Judged, read_stored_poses
from slviewer.records.plain import from_plain, to_plain
from slviewer.records.verdict import Verdict
from slviewer.session.store import Session
from slviewer.target.board import Board


def calibrate_with_evidence(
    store: Session,
    names: Sequence[str],
    board: Board,
    smoothing: Smoothing,
    excluded: Mapping[str, str],
    progress: Progress,
) -> DiagnosedCalibration:
    """Read and examine the target poses, calibrate stereo from them, and judge it. ``excluded``:
    {pose: why}."""
    sequence = store.load_capture(names[0]).sequence
    poses = read_stored_poses(store, names, board, smoothing)
    return calibrate_poses_with_evidence(poses, len(names), sequence, board, excluded, progress)


def calibrate_poses_with_evidence(
    poses: Iterable[Judged],
    count: int,
    sequence: PatternSequence,
    board: Board,
    excluded: Mapping[str, str],
    progress: Progress,
) -> DiagnosedCalibration:
    """Calibrate stereo from ``count`` target poses as they are read, and judge it. ``excluded``:
    {pose: why}."""
    if contradiction := describe_period_conflict(sequence):
        evidence = Evidence(str(board), sequence.projector, (), contradiction=contradiction)
        return DiagnosedCalibration(judge_evidence(evidence), evidence, None, (), dict(excluded))
    observations: list[Observation] = []
    evidence_of_poses = []
    refused = dict(excluded)
    for i, pose in enumerate(poses, 1):
        progress(i / count, f"read {pose.name}")
        if pose.observation is None:
            refused[pose.name] = pose.refused
        else:
            observations.append(pose.observation)
        if pose.evidence is not None:
            evidence_of_poses.append(pose.evidence)
    result = calibrate_with_diagnosis(
        observations, evidence_of_poses, sequence.projector, board, refused
    )
    if result.stereo is None:
        return result
    return replace(result, stereo=replace(result.stereo, excluded=result.excluded))


def describe_period_conflict(sequence: PatternSequence) -> str:
    """Describe why the fringe periods and the Gray code of a sequence conflict; empty where they do
    not."""
    for axis in sequence.axes:
        if sequence.periods_px(axis) and sequence.find("gray", axis):
            try:
                axis_layout(sequence, axis)
            except InputError as error:
                return str(error)
    return ""


def save_verdict(store: Session, verdict: Verdict, poses: Sequence[str]) -> None:
    """Save the verdict on an attempt to calibrate from these poses, whether or not it succeeded."""
    store.save_result(
        VERDICT, {"verdict": to_plain(verdict), "inputs": store.input_hashes(*poses)}, {}
    )


def load_last_verdict(store: Session) -> Verdict | None:
    """Load the verdict on the last attempt to calibrate, also a failed one; None before the
    first."""
    if not store.has_result(VERDICT):
        return None
    return store.decode_result(
        VERDICT, lambda meta, _: from_plain(meta["verdict"], Verdict), only=()
    )


def rejection_error(verdict: Verdict, is_saved: bool) -> CalibrationRejected:
    """Return the error to raise for a rejected calibration; ``is_saved``: the session holds it for
    inspection."""
    first, more = verdict.findings[0], len(verdict.findings) - 1
    others = f" (and {more} more finding{'s' * (more != 1)})" if more else ""
    saved_note = "; the calibration is saved for inspection, and not used" if is_saved else ""
    return CalibrationRejected(f"{first.text()}{others}{saved_note}")
