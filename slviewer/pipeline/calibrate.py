"""From a session's target poses to calibrations."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, Literal, TypeVar

import numpy as np

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration
from slviewer.calibration.diagnosis.rules import judge_splined
from slviewer.calibration.observe import Observation, Smoothing
from slviewer.calibration.pixelwise import PixelwiseModel, calibrate_pixelwise
from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError, SessionError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.calibration_verdict import (
    calibrate_poses_with_evidence,
    calibrate_with_evidence,
    rejection_error,
    save_verdict,
)
from slviewer.pipeline.capture_phases import decode_or_explain, texture_8bit
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part, stage
from slviewer.pipeline.models import (
    Model,
    ModelName,
    available_models,
    describe_model,
    preferred_model,
    save_compiled,
    save_model,
    trash_models,
    warn_if_frame_changed,
)
from slviewer.pipeline.open_session import SessionLike, match_names, opened_or_made
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.poses import DecodedPose, Judged, read_pose
from slviewer.pipeline.stored_records import load_record
from slviewer.records.calibration import ModelCalibration
from slviewer.records.verdict import Verdict
from slviewer.session.store import Session
from slviewer.target.board import Board

DEFAULT_MODELS = ("stereo", "pixelwise", "splined")
SmoothingKind = Literal["spline", "polynomial"]
M = TypeVar("M", PixelwiseModel, SplinedModel)
Fit = Callable[[Sequence[Observation], StereoModel, Callable[[float], None]], M]


@dataclass(frozen=True)
class CalibrateSettings:
    """How target poses are calibrated.

    Args:
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
    default 26. ``replace_all``: move the session's models that are not made anew to its trash, also
    where they are of the same poses and settings.
    """

    UNRECORDED: ClassVar = ("replace_all",)
    target: str
    models: Sequence[ModelName] = ()
    poses: Sequence[str] = ()
    exclude: Sequence[str] = ()
    smoothing: SmoothingKind = "spline"
    degree: int = 5
    cells_across: int | None = None
    replace_all: bool = False

    @property
    def step_2(self) -> Smoothing:
        """The Letter's step 2."""
        return Smoothing(self.smoothing, self.degree)

    @property
    def method(self) -> "CalibrateSettings":
        """The settings without the choice of models and poses."""
        return replace(self, models=(), poses=(), exclude=(), replace_all=False)


@dataclass(frozen=True)
class CalibrationResult:
    """The models that were fitted, and the verdict on them. A model that was not fitted is None."""

    stereo: StereoModel
    pixelwise: PixelwiseModel | None = None
    splined: SplinedModel | None = None
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def best(self) -> Model:
        """The most accurate of the models: splined, else pixelwise, else stereo."""
        return self.splined or self.pixelwise or self.stereo

    @property
    def models(self) -> list[Model]:
        """The models that were fitted, the simplest first."""
        return [model for model in (self.stereo, self.pixelwise, self.splined) if model is not None]

    @property
    def is_rejected(self) -> bool:
        """Whether the verdict rejects the calibration."""
        return self.verdict.level == "rejected"


@operation("calibrate", ModelCalibration, CalibrateSettings)
def calibrate(job: Job, settings: CalibrateSettings) -> Iterator[Found[ModelCalibration]]:
    """Calibrate from the session's target poses, and report whether the calibration is good, and if
    not, why.

    One that is rejected ends with status 3; it is stored to be inspected, and not used.

    A pose that cannot be used is excluded with the reason. The verdict is saved beside the models.
    Raises CalibrationRejected with its reason: then stereo alone is stored to be inspected, and
    used only where the operator accepts that; where none could be made at all, what the session
    held stays.
    """
    store, board = job.store, Board.parse(settings.target)
    if not store.is_writable:
        raise SessionError(
            f"Cannot calibrate: {store.folder} is open for reading only. Close what writes to it."
        )
    before = preferred_model(store) if available_models(store) else ""
    names, excluded = _choose_poses(store, settings, job.warn)
    reading = part(job.progress, 0, 0.65)
    diagnosed = calibrate_with_evidence(store, names, board, settings.step_2, excluded, reading)
    if diagnosed.stereo is None:
        save_verdict(store, diagnosed.verdict, names)
        raise rejection_error(diagnosed.verdict, is_saved=False)
    result = _fit_models(diagnosed, settings, part(job.progress, 0.66, 0.97), job.warn, excluded)
    job.progress(0.97, "saving")
    inputs = store.input_hashes(*result.stereo.poses)
    with store.together():
        if (
            result.is_rejected
            or settings.replace_all
            or _changes_calibration(store, inputs, settings)
        ):
            made = {model.name for model in result.models}  # others would be of another calibration
            trash_models(store, [name for name in available_models(store) if name not in made])
        for model in result.models:
            yield describe_model(model, result.verdict if model is result.stereo else None, inputs)
            save_compiled(store, model)
        save_verdict(store, result.verdict, names)
    if result.is_rejected:
        raise rejection_error(result.verdict, is_saved=True)
    warn_if_frame_changed(store, before, job.warn)
    job.progress(1.0, "calibrated")


def calibrate_frames(
    sequence: PatternSequence,
    poses: Mapping[str, np.ndarray],
    target: str,
    *,
    models: Sequence[str] = (),
    smoothing: SmoothingKind = "spline",
    degree: int = 5,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> CalibrationResult:
    """Calibrate from the frames of target poses in memory; nothing is saved.

    ``poses``: {name: (n, h, w) uint8 or uint16}, the frames of each pose in the order of
    ``sequence``. ``target`` and the options as in ``calibrate``. Raises CalibrationRejected with
    the reason where the poses make no sound calibration.
    """
    settings = CalibrateSettings(target, models, smoothing=smoothing, degree=degree)
    board = Board.parse(target)
    if not poses:
        raise InputError(
            "no target pose was given: capture the board in at least three positions and tilts"
        )

    def read() -> Iterator[Judged]:
        """Yield the examined pose of each set of frames, decoded one after the other."""
        for name, frames in poses.items():
            phases = decode_or_explain(name, sequence, frames)
            pose = DecodedPose(
                name, sequence, frames, phases, texture_8bit(sequence, frames), board
            )
            yield read_pose(pose, settings.step_2)

    diagnosed = calibrate_poses_with_evidence(
        read(), len(poses), sequence, board, {}, part(progress, 0, 0.65)
    )
    if diagnosed.stereo is None:
        raise rejection_error(diagnosed.verdict, is_saved=False)
    result = _fit_models(diagnosed, settings, part(progress, 0.66, 1.0), warn)
    if result.is_rejected:
        raise rejection_error(result.verdict, is_saved=False)
    return result


def save_calibration(session: SessionLike, result: CalibrationResult) -> None:
    """Save the models of ``result`` in a session, which is created where there is none; those that
    it held before are moved to its trash."""
    with opened_or_made(session) as store, store.together():
        trash_models(store, available_models(store))
        for model in result.models:
            save_model(store, model, result.verdict if model is result.stereo else None)


def _choose_poses(
    store: Session, settings: CalibrateSettings, warn: Warn
) -> tuple[list[str], dict[str, str]]:
    """Return the target poses to calibrate from, and {pose: why} of those that are excluded."""
    captures, faults = store.read_captures()
    for fault in faults.values():
        warn(f"not used: {fault}")
    names = [capture.name for capture in captures if capture.role == "calibration"]
    if not names:
        raise InputError(
            f"{store.folder} holds no target poses: import some with --role calibration, or capture"
            " them first"
        )
    excluded = {
        name: f"excluded by the operator: {why}"
        for name, why in store.excluded().items()
        if name in names
    }
    excluded |= _reasons_to_exclude(names, settings.poses, settings.exclude)
    names = [name for name in names if name not in excluded]
    if not names:
        raise InputError("every target pose is excluded: include some again")
    return names, excluded


def _changes_calibration(
    store: Session, inputs: Mapping[str, str], settings: CalibrateSettings
) -> bool:
    """Return whether the session's models belong to a calibration from other captures or settings,
    if any."""
    if "stereo" not in available_models(store):
        return True
    before = load_record(store, ModelCalibration, "stereo")
    if not before.settings or before.inputs != dict(inputs):
        return True
    return CalibrateSettings(**before.settings).method != settings.method


def _fit_models(
    diagnosed: DiagnosedCalibration,
    settings: CalibrateSettings,
    progress: Progress,
    warn: Warn,
    excluded: Container[str] = (),
) -> CalibrationResult:
    """Fit the models that follow from a stereo calibration; return them with the verdict on all:
    stereo alone where that rejects them.

    Warns of poses that were excluded, but for those ``excluded`` before, and of what is doubtful.
    """
    stereo = diagnosed.stereo
    assert stereo is not None
    if diagnosed.verdict.level == "rejected":
        return CalibrationResult(stereo, verdict=diagnosed.verdict)
    if diagnosed.warning:
        warn(diagnosed.warning)
    for name, why in stereo.excluded.items():
        if name not in excluded:
            warn(f"{name} is excluded: {why}")
    for finding in diagnosed.verdict.findings:
        if finding.severity == "doubtful":
            warn(finding.text())
    result = _fit_after_stereo(stereo, diagnosed.observations, settings, progress, warn)
    verdict = (
        judge_splined(diagnosed.verdict, result.splined.bundle.noise)
        if result.splined
        else diagnosed.verdict
    )
    for finding in verdict.findings:
        if finding not in diagnosed.verdict.findings:
            warn(finding.text())
    return (
        CalibrationResult(stereo, verdict=verdict)
        if verdict.level == "rejected"
        else replace(result, verdict=verdict)
    )


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
    stereo: StereoModel,
    observations: Sequence[Observation],
    settings: CalibrateSettings,
    progress: Progress,
    warn: Warn,
) -> CalibrationResult:
    """Fit the models that follow from stereo; one that cannot be fitted is a warning, and stops no
    other."""
    models = settings.models or DEFAULT_MODELS

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
    fit_splined = partial(calibrate_splined, cells_across=settings.cells_across)
    splined = fit("splined", fit_splined, pixelwise_end, 1.0, "joint adjustment")
    for name, why in splined.bundle.excluded.items() if splined else ():
        warn(f"{name} is excluded from the splined model: it {why}")
    return CalibrationResult(stereo, pixelwise, splined)
