"""Stereo calibration with diagnosis: exclude unfit poses, calibrate, and judge the result."""

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.diagnosis.evidence import Evidence, PoseEvidence
from slviewer.calibration.diagnosis.numbering import (
    describe_misnumbering,
    place_by_neighbours,
    reconcile_marks,
)
from slviewer.calibration.diagnosis.rules import (
    judge_evidence,
    motion_limit_px,
    reason_to_exclude,
)
from slviewer.calibration.diagnosis.solution import measure_solution
from slviewer.calibration.known_camera import CameraCheck, KnownCamera
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import (
    MIN_POSES,
    StereoModel,
    foreshortened_tilt_deg,
    nominal_tilt_spread_deg,
)
from slviewer.errors import CalibrationRejected
from slviewer.records.verdict import Verdict
from slviewer.target.board import Board


@dataclass(frozen=True)
class DiagnosedCalibration:
    """A stereo calibration with the verdict on it and the evidence for the verdict.

    ``stereo``: the calibrated model; of a rejected calibration a solution for inspection, or None
    where there is none. ``observations``: the poses that it used, circles at their centres.
    ``excluded``: the other poses, with the reason. ``warning``: a further message for the operator,
    or "".
    """

    verdict: Verdict
    evidence: Evidence
    stereo: StereoModel | None
    observations: tuple[Observation, ...]
    excluded: Mapping[str, str]
    warning: str = ""


def calibrate_with_diagnosis(
    observations: Sequence[Observation],
    poses: Sequence[PoseEvidence],
    projector: tuple[int, int],
    board: Board,
    excluded: Mapping[str, str] | None = None,
    camera: KnownCamera | None = None,
) -> DiagnosedCalibration:
    """Calibrate camera and projector from the readable poses, and judge the result.

    ``observations``: the readable poses; ``poses``: the evidence of all poses, unreadable ones
    included; ``projector``: its (width, height) px; ``excluded``: poses excluded beforehand, with
    the reason; ``camera``: a known one. A calibration that cannot be made is returned with a
    rejecting verdict, not raised.
    """
    observations, warning = reconcile_marks(board, place_by_neighbours(observations))
    readable = {o.name: o for o in observations}
    poses = [
        replace(pose, numbering=describe_misnumbering(board, o.points, o.camera))
        if (o := readable.get(pose.name))
        else pose
        for pose in poses
    ]
    unfit = _select_unfit_poses(poses, readable)
    fit = [o for o in observations if o.name not in unfit]
    excluded_before = {**(excluded or {}), **unfit}
    refusal = None
    stereo: StereoModel | None
    try:
        stereo, used = calibrate_centres(fit, projector, str(board), excluded_before, camera=camera)
    except CalibrationRejected as error:
        refusal = error.with_traceback(None)
        stereo, used = _solve_unchecked(fit, projector, board, excluded_before, camera)
    evidence = Evidence(
        board=str(board),
        projector=projector,
        poses=tuple(poses),
        excluded=unfit,
        refusal=refusal,
        tilt_spread_deg=nominal_tilt_spread_deg(fit),
        foreshortened_deg=foreshortened_tilt_deg(fit),
        solution=None if stereo is None else measure_solution(fit, stereo),
        is_camera_fixed=camera is not None and camera.is_fixed,
        camera=None if stereo is None else _check_camera(used, stereo, projector, board),
    )
    verdict = judge_evidence(evidence)
    reasons = dict(stereo.excluded if stereo else excluded_before)
    for finding in verdict.findings:  # the finding is more specific than the fit's reason
        if finding.cause in ("moved", "outlier", "board-numbering") and len(finding.poses) == 1:
            by_fit = [
                name for name in finding.poses if name in reasons and name not in excluded_before
            ]
            reasons |= dict.fromkeys(by_fit, finding.text())
    return DiagnosedCalibration(verdict, evidence, stereo, tuple(used), reasons, warning)


def _solve_unchecked(
    observations: Sequence[Observation],
    projector: tuple[int, int],
    board: Board,
    excluded: Mapping[str, str],
    camera: KnownCamera | None,
) -> tuple[StereoModel | None, list[Observation]]:
    """Solve the rig without checks, for diagnosis only.

    Returns the model and the poses that it used; (None, []) where there is no solution or its
    residuals are not finite.
    """
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of boards that lie behind a device
            stereo, used = calibrate_centres(
                observations, projector, str(board), excluded, strict=False, camera=camera
            )
    except CalibrationRejected:
        return None, []
    is_finite = all(np.isfinite(px) for px in stereo.reprojection_rms_px.values())
    return (stereo, used) if is_finite and stereo.depth_range_mm is not None else (None, [])


def _check_camera(
    used: Sequence[Observation], stereo: StereoModel, projector: tuple[int, int], board: Board
) -> CameraCheck | None:
    """Compare a fixed camera with a calibration of both devices from the same poses; None without
    one."""
    known = stereo.known_camera
    if known is None:
        return None
    free, _ = _solve_unchecked(used, projector, board, {}, replace(known, is_fixed=False))
    focal = known.lens.K[0, 0]
    stated = known.focal_sigma_px / focal
    if free is None:
        return CameraCheck(known.name, 0.0, np.inf, stated)
    return CameraCheck(
        known.name,
        float(np.mean(np.diag(free.rig.camera.K)[:2] / np.diag(known.lens.K)[:2]) - 1),
        free.focal_sigma_px["camera"] / focal,
        stated,
        (stereo.reprojection_rms_px["camera"], free.reprojection_rms_px["camera"]),
    )


def _select_unfit_poses(poses: Sequence[PoseEvidence], readable: Collection[str]) -> dict[str, str]:
    """Return the readable poses to exclude from the fit, with the reason.

    Empty where fewer than MIN_POSES or half of the poses would remain: the fault is then common to
    all of them.
    """
    limit = motion_limit_px(poses)
    unfit = {
        pose.name: why
        for pose in poses
        if pose.name in readable and (why := reason_to_exclude(pose, limit))
    }
    return unfit if len(readable) - len(unfit) >= max(MIN_POSES, len(readable) / 2) else {}
