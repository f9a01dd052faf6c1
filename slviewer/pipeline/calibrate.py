"""From a session's target poses to calibrations."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration
from slviewer.calibration.diagnosis.verdict import Verdict, judge_splined
from slviewer.calibration.observe import Observation, Smoothing
from slviewer.calibration.pixelwise import PixelwiseModel, calibrate_pixelwise
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.calibration_verdict import (
    calibrate_poses_with_evidence,
    calibrate_with_evidence,
    rejection_error,
    save_rejected,
    save_verdict,
)
from slviewer.pipeline.capture_phases import decode_frames, texture_8bit
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part, stage
from slviewer.pipeline.models import (
    ModelName,
    available_models,
    preferred_model,
    save_fitted,
    save_stereo,
    trash_models,
    warn_if_frame_changed,
)
from slviewer.pipeline.open_session import SessionLike, match_names, opened, opened_or_made
from slviewer.pipeline.pose_evidence import DecodedPose
from slviewer.pipeline.poses import Judged, read_pose
from slviewer.session.store import Session
from slviewer.target.board import Board

DEFAULT_MODELS = ("stereo", "pixelwise", "splined")
SmoothingKind = Literal["spline", "polynomial"]
M = TypeVar("M", PixelwiseModel, SplinedModel)
Fit = Callable[[Sequence[Observation], StereoModel, Callable[[float], None]], M]


@dataclass(frozen=True)
class CalibrationResult:
    """The models that ``calibrate`` fitted, and its verdict. A model that was not fitted is
    None."""

    stereo: StereoModel
    pixelwise: PixelwiseModel | None
    splined: SplinedModel | None = None
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def best(self) -> StereoModel | PixelwiseModel | SplinedModel:
        """The most accurate of the models: splined, else pixelwise, else stereo."""
        return self.splined or self.pixelwise or self.stereo

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``calibrate --json``."""
        rig = self.stereo.rig
        models: dict[str, Any] = {
            "stereo": {
                "reprojection_rms_px": dict(self.stereo.reprojection_rms_px),
                "K_camera": rig.camera.K.tolist(),
                "D_camera": rig.camera.D.tolist(),
                "K_projector": rig.projector.K.tolist(),
                "D_projector": rig.projector.D.tolist(),
                "R": rig.R.tolist(),
                "T": rig.t.tolist(),
            }
        }
        if self.pixelwise is not None:
            models["pixelwise"] = {
                "fit_rms_mm": self.pixelwise.median_rms_mm(self.pixelwise.axes[0]),
                "axes": {axis: self.pixelwise.median_rms_mm(axis) for axis in self.pixelwise.axes},
            }
        if self.splined is not None:
            models["splined"] = self.splined.summary()
        return {
            "models": models,
            "poses_used": list(self.stereo.poses),
            "poses_left_out": dict(self.stereo.excluded),
            "verdict": self.verdict.to_json(),
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        s = self.stereo
        rms, total = s.reprojection_rms_px, len(s.poses) + len(s.excluded)
        fc, fp = s.rig.camera.K, s.rig.projector.K
        sigma = s.focal_sigma_px
        near, far = s.depth_range_mm or (np.nan, np.nan)
        lines = [
            f"poses: {len(s.poses)} of {total} used, boards at {near:.0f}-{far:.0f} mm",
            *(f"  excluded: {name}: {why}" for name, why in s.excluded.items()),
            (
                f"stereo: reprojection RMS camera {rms['camera']:.3f} px, projector"
                f" {rms['projector']:.3f} px, stereo {rms['stereo']:.3f} px"
            ),
            (
                f"  camera focal length {fc[0, 0]:.1f}, {fc[1, 1]:.1f} px (+-"
                f" {sigma['camera']:.1f}); projector {fp[0, 0]:.1f}, {fp[1, 1]:.1f} px (+-"
                f" {sigma['projector']:.1f}); baseline {s.baseline_mm:.2f} mm"
            ),
        ]
        if s.features_excluded:
            lines.append(f"  {s.features_excluded} features excluded beyond 6 robust sigma")
        if self.pixelwise is not None:
            for axis in self.pixelwise.axes:
                fit = self.pixelwise.fits[axis]
                fitted = np.isfinite(fit.coefficients[0])
                fit_rms = self.pixelwise.median_rms_mm(axis)
                lines.append(
                    f"pixelwise {axis}: {100 * fitted.mean():.1f} % of the pixels fitted, in"
                    f" {np.median(fit.poses[fitted]):.0f} poses (median); fit RMS z"
                    f" {fit_rms['z']:.3f}, x {fit_rms['x']:.3f}, y {fit_rms['y']:.3f} mm (median)"
                )
        if self.splined is not None:
            lines.append(self.splined.text())
        lines.append(self.verdict.text())
        return "\n".join(lines)


def calibrate(
    session: SessionLike,
    target: str,
    *,
    models: Sequence[ModelName] = (),
    poses: Sequence[str] = (),
    exclude: Sequence[str] = (),
    smoothing: SmoothingKind = "spline",
    degree: int = 5,
    cells_across: int | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> CalibrationResult:
    """Calibrate from the session's target poses, and report whether the calibration is good, and if
    not, why.

    One that is rejected ends with status 3; it is stored to be inspected, and not used.

    Args:
        session: Session folder; with --camera-only also a folder of pictures of the board.
        target: circles:21x16:9 (columns x rows : pitch mm), acircles:..., chessboard:9x7:75 (inner
            corners : square mm), charuco:....
        models: Which models to fit; by default stereo, which is always made, the Letter's
            pixelwise, and splined.
        poses: Calibrate from these target poses alone: names, or patterns such as 'pose_0*'.
        exclude: Exclude these target poses, this time; the wizard excludes poses for good.
        smoothing: How the Letter's step 2 smooths a board's phase; the spline preserves the local
            distortion.
        degree: Degree of the polynomial, with --smoothing polynomial.

    ``cells_across``: cells of each of the splined model's displacement fields across its image, by
    default 26.

    A pose that cannot be used is excluded with the reason. The verdict is saved beside the models.
    Raises CalibrationRejected with its reason: then stereo alone is stored to be inspected, and
    used only where the operator accepts that; where none could be made at all, what the session
    held stays.
    """
    board = Board.parse(target)
    models = models or DEFAULT_MODELS
    step_2 = Smoothing(smoothing, degree)
    with opened(session, write=True) as store:
        excluded = store.excluded()
        before = preferred_model(store) if available_models(store) else ""
        captures, faults = store.read_captures()
        for fault in faults.values():
            warn(f"not used: {fault}")
        names = [capture.name for capture in captures if capture.role == "calibration"]
        if not names:
            raise InputError(
                f"{store.folder} holds no target poses: import some with --role calibration, or"
                " capture them first"
            )
        excluded_poses = {
            name: f"excluded by the operator: {why}"
            for name, why in excluded.items()
            if name in names
        }
        excluded_poses |= _reasons_to_exclude(names, poses, exclude)
        names = [name for name in names if name not in excluded_poses]
        if not names:
            raise InputError("every target pose is excluded: include some again")
        diagnosed = calibrate_with_evidence(
            store, names, board, step_2, excluded_poses, part(progress, 0, 0.65)
        )
        if diagnosed.stereo is None:
            save_verdict(store, diagnosed.verdict, names)
            raise rejection_error(diagnosed.verdict, is_saved=False)
        stereo = diagnosed.stereo
        settings = {
            "target": str(board),
            "smoothing": smoothing,
            "degree": degree,
            "models": list(models),
        }
        if cells_across is not None:
            settings["cells_across"] = cells_across
        if diagnosed.verdict.level == "rejected":
            save_rejected(store, stereo, settings, diagnosed.verdict, names)
            raise rejection_error(diagnosed.verdict, is_saved=True)
        fitting = part(progress, 0.66, 0.97)
        result = _fit_models(diagnosed, models, fitting, warn, excluded_poses, cells_across)
        if result.verdict.level == "rejected":
            save_rejected(store, stereo, settings, result.verdict, names)
            raise rejection_error(result.verdict, is_saved=True)
        progress(0.97, "saving")
        inputs = store.input_hashes(*stereo.poses)
        with store.together():
            if _changes_calibration(
                store, inputs, settings
            ):  # what is not made anew would be of another calibration
                trash_models(
                    store,
                    [name for name in available_models(store) if getattr(result, name) is None],
                )
            _save_models(store, result, inputs, settings)
            save_verdict(store, result.verdict, names)
        warn_if_frame_changed(store, before, warn)
        progress(1.0, "calibrated")
    return result


def calibrate_frames(
    sequence: PatternSequence,
    poses: Mapping[str, np.ndarray],
    target: str,
    *,
    models: Sequence[str] = (),
    smoothing: str = "spline",
    degree: int = 5,
    cells_across: int | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> CalibrationResult:
    """Calibrate from the frames of target poses in memory; nothing is saved.

    ``poses``: {name: (n, h, w) uint8 or uint16}, the frames of each pose in the order of
    ``sequence``. ``target`` and the options as in ``calibrate``. Raises CalibrationRejected with
    the reason where the poses make no sound calibration.
    """
    board, step_2 = Board.parse(target), Smoothing(smoothing, degree)
    if not poses:
        raise InputError(
            "no target pose was given: capture the board in at least three positions and tilts"
        )

    def read() -> Iterator[Judged]:
        """Yield the examined pose of each set of frames, decoded one after the other."""
        for name, frames in poses.items():
            phases = decode_frames(name, sequence, frames)
            pose = DecodedPose(
                name, sequence, frames, phases, texture_8bit(sequence, frames), board
            )
            yield read_pose(pose, step_2, examine=True)

    diagnosed = calibrate_poses_with_evidence(
        read(), len(poses), sequence, board, {}, part(progress, 0, 0.65)
    )
    if diagnosed.stereo is None or diagnosed.verdict.level == "rejected":
        raise rejection_error(diagnosed.verdict, is_saved=False)
    fitting = part(progress, 0.66, 1.0)
    result = _fit_models(
        diagnosed, models or DEFAULT_MODELS, fitting, warn, cells_across=cells_across
    )
    if result.verdict.level == "rejected":
        raise rejection_error(result.verdict, is_saved=False)
    return result


def save_calibration(session: SessionLike, result: CalibrationResult) -> None:
    """Save the models of ``result`` in a session, which is created where there is none; those that
    it held before are moved to its trash."""
    with opened_or_made(session) as store, store.together():
        trash_models(store, available_models(store))
        _save_models(store, result, {}, {})


def _changes_calibration(
    store: Session, inputs: Mapping[str, str], settings: Mapping[str, Any]
) -> bool:
    """Return whether the session's models belong to a calibration from other captures or settings,
    if any."""
    if "stereo" not in available_models(store):
        return True
    meta = store.load_result("calibration/stereo", only=())[0]
    before, now = ({**each, "models": ()} for each in (meta.get("settings", {}), settings))
    return meta["inputs"] != dict(inputs) or before != now


def _save_models(
    store: Session,
    result: CalibrationResult,
    inputs: Mapping[str, str],
    settings: Mapping[str, Any],
) -> None:
    """Save the stereo model with its verdict, and each other model that was fitted."""
    save_stereo(store, result.stereo, inputs, settings, result.verdict)
    for model in (result.pixelwise, result.splined):
        if model is not None:
            save_fitted(store, model, inputs, settings)


def _fit_models(
    diagnosed: DiagnosedCalibration,
    models: Sequence[str],
    progress: Progress,
    warn: Warn,
    excluded: Container[str] = (),
    cells_across: int | None = None,
) -> CalibrationResult:
    """Fit the models that follow from an accepted stereo calibration; return them with the verdict
    on all.

    Warns of poses that were excluded, but for those ``excluded`` before, and of what is doubtful.
    """
    stereo = diagnosed.stereo
    assert stereo is not None
    if diagnosed.warning:
        warn(diagnosed.warning)
    for name, why in stereo.excluded.items():
        if name not in excluded:
            warn(f"{name} is excluded: {why}")
    for finding in diagnosed.verdict.findings:
        if finding.severity == "doubtful":
            warn(finding.text())
    result = _fit_after_stereo(models, stereo, diagnosed.observations, progress, warn, cells_across)
    verdict = (
        judge_splined(diagnosed.verdict, result.splined.bundle.noise)
        if result.splined
        else diagnosed.verdict
    )
    for finding in verdict.findings:
        if finding not in diagnosed.verdict.findings:
            warn(finding.text())
    return replace(result, verdict=verdict)


def _reasons_to_exclude(
    names: Sequence[str], poses: Sequence[str], exclude: Sequence[str]
) -> dict[str, str]:
    """{pose: why} of the target poses that are not among ``poses``, where any are named, or that
    ``exclude`` names.

    Raises UsageError for a name or pattern that fits no target pose.
    """
    chosen = match_names(names, poses, "target pose") if poses else names
    out = {name: "not among the poses that were named" for name in names if name not in chosen}
    return out | dict.fromkeys(
        match_names(names, exclude, "target pose"), "excluded for this calibration"
    )


def _fit_after_stereo(
    models: Sequence[str],
    stereo: StereoModel,
    observations: Sequence[Observation],
    progress: Progress,
    warn: Warn,
    cells_across: int | None = None,
) -> CalibrationResult:
    """Fit the models that follow from stereo; one that cannot be fitted is a warning, and stops no
    other."""

    def fit(name: str, calibrate_model: Fit[M], start: float, end: float, doing: str) -> M | None:
        """Fit one model if it is requested; None, with a warning, where it cannot be fitted."""
        if name not in models:
            return None
        try:
            return calibrate_model(observations, stereo, stage(progress, start, end, doing))
        except (CalibrationRejected, InputError) as error:
            if len(models) == 1:
                raise
            warn(f"no {'pixel-wise' if name == 'pixelwise' else name} model: {error}")
            return None

    pixelwise_end = 0.0 if "pixelwise" not in models else 0.33 if "splined" in models else 1.0
    pixelwise = fit("pixelwise", calibrate_pixelwise, 0.0, pixelwise_end, "pixel-wise fit")
    fit_splined = partial(calibrate_splined, cells_across=cells_across)
    splined = fit("splined", fit_splined, pixelwise_end, 1.0, "joint adjustment")
    for name, why in splined.bundle.excluded.items() if splined else ():
        warn(f"{name} is excluded from the splined model: it {why}")
    return CalibrationResult(stereo, pixelwise, splined)
