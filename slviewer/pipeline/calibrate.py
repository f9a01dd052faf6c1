"""From a session's target poses to calibrations, and the verdict on them, which is stored too."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from slviewer import __version__
from slviewer.calibration.camera import CameraCalibration, calibrate_camera
from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration, calibrate_with_diagnosis
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.rules import judge_evidence, judge_splined
from slviewer.calibration.known_camera import UNSTATED_SIGMA, KnownCamera
from slviewer.calibration.observe import Smoothing
from slviewer.calibration.pixelwise import MIN_POSES, PixelwiseModel, calibrate_pixelwise
from slviewer.calibration.splined.model import (
    SplinedModel,
    calibrate_projector,
    calibrate_splined,
)
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import (
    CalibrationRejected,
    DetectionError,
    InputError,
    SessionError,
    UsageError,
)
from slviewer.examination.light import look_at
from slviewer.fringe.decode import texture
from slviewer.fringe.image_area import measure_picture_area
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.raw_image import describe_mosaic
from slviewer.fringe.sequence import PatternSequence, Size
from slviewer.geometry.lens import Lens
from slviewer.inputs import Input
from slviewer.pipeline.capture_phases import capture_texture, convert_to_8bit, decode_or_explain
from slviewer.pipeline.models import (
    MODELS,
    Model,
    ModelName,
    available_models,
    describe_model,
    preferred_model,
    save_compiled,
    save_model,
    save_projector,
    save_verdict,
    trash_models,
    warn_if_frame_changed,
)
from slviewer.pipeline.operation import (
    Found,
    Job,
    Progress,
    SessionLike,
    Warn,
    ignore_progress,
    ignore_warnings,
    load_record,
    match_names,
    opened_or_made,
    operation,
    part,
    stage,
)
from slviewer.pipeline.poses import (
    DecodedPose,
    Judged,
    cut_area,
    detect_in_area,
    read_pose,
    read_stored_poses,
)
from slviewer.records.calibration import SECOND_CAMERA, ModelCalibration
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import Verdict
from slviewer.session.capture import Capture
from slviewer.session.exporters import write_calibration
from slviewer.session.importers.camera_file import read_camera_file
from slviewer.session.importers.images import read_image, warn_of_unread
from slviewer.session.importers.imported import images_by_name
from slviewer.session.layout import is_session
from slviewer.session.store import Session
from slviewer.target.board import Board, Detection

SmoothingKind = Literal["spline", "polynomial"]
_OF_PAIR = {"projector": SECOND_CAMERA}
LENS = "lens/camera"
"""The session's copy of the camera's calibration that a file stated."""


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
        camera: File with a calibration of the camera, where that of its lens starts: of
            --camera-only, OpenCV, NumPy, ROS, Kalibr, MATLAB, COLMAP, Metashape or calib.io.
        fix_camera: Keep the lens of that file as it is, so that few poses of little tilt are
            enough.

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
    degree: Annotated[int, Input(0, 10)] = 5
    cells_across: int | None = None
    replace_all: bool = False
    camera: Path | str | None = None
    fix_camera: bool = False

    def __post_init__(self) -> None:
        if self.fix_camera and self.camera is None:
            raise UsageError(
                "--fix-camera keeps the lens of a file",
                "name it with --camera, or omit --fix-camera",
            )

    @property
    def step_2(self) -> Smoothing:
        """The Letter's step 2."""
        return Smoothing(self.smoothing, self.degree)

    @property
    def method(self) -> "CalibrateSettings":
        """The settings without the choice of models and poses, and without the name of a file."""
        return replace(
            self,
            models=(),
            poses=(),
            exclude=(),
            replace_all=False,
            camera=LENS if self.camera else None,
        )


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

    # which target poses, and a camera that is known
    names, excluded = choose_poses(store, settings, job.warn)
    first = store.load_capture(names[0])
    camera = _load_camera(store, settings, first.size, job.warn)

    # their frames to features, and these to a stereo calibration with its verdict
    diagnosed = _diagnose_poses(
        _warn_of_notes(read_stored_poses(store, names, board, settings.step_2), job.warn),
        len(names),
        first.sequence,
        first.other_size or first.sequence.projector,
        board,
        excluded,
        part(job.progress, 0, 0.65),
        camera,
    )
    diagnosed = replace(diagnosed, verdict=_name_devices(diagnosed.verdict, first))
    if diagnosed.stereo is None:
        save_verdict(store, diagnosed.verdict, names)

    # the models that start from it
    result = _fit_models(diagnosed, settings, part(job.progress, 0.66, 0.97), job.warn, excluded)
    result = replace(result, verdict=_name_devices(result.verdict, first))
    projector = _fit_projector(result.splined, diagnosed, first, job.warn)

    # all of them take the place of the session's models in one step
    job.progress(0.97, "saving")
    inputs = store.input_hashes(*result.stereo.poses, *([LENS] if camera else []))
    used = replace(settings, camera=LENS if camera else None)  # the session's own copy
    with store.together():
        if (
            result.is_rejected
            or settings.replace_all
            or _changes_calibration(store, inputs, settings)
        ):
            made = {model.name for model in result.models}  # others would be of another calibration
            trash_models(store, [name for name in available_models(store) if name not in made])
        for model in result.models:
            verdict = result.verdict if model is result.stereo else None
            found = describe_model(model, verdict, inputs)
            record = msgspec.structs.replace(found.record, second_camera=first.second is not None)
            yield replace(found, record=record, settings=used)
            save_compiled(store, model)
        if projector is not None:
            save_projector(store, projector)
        save_verdict(store, result.verdict, names)
    if result.is_rejected:
        raise rejection_error(result.verdict, is_saved=True)
    warn_if_frame_changed(store, before, job.warn)
    job.progress(1.0, "calibrated")


def _fit_projector(
    pair: SplinedModel | None, diagnosed: DiagnosedCalibration, pose: Capture, warn: Warn
) -> SplinedModel | None:
    """Return the projector of two cameras in their frame of reference, from poses with patterns
    along both axes; None, with a warning where it cannot be fitted, without."""
    if pair is None or not any(o.light for o in diagnosed.observations):
        return None
    with _warn_of_failure("projector's", MODELS, warn):
        return calibrate_projector(pair, diagnosed.observations, pose.sequence.projector)
    return None


def _name_devices(verdict: Verdict, pose: Capture) -> Verdict:
    """Return the verdict with the second camera named where it takes the projector's place."""
    return verdict if pose.second is None else verdict.rename(_OF_PAIR)


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
            "no target pose was given", "capture the board in at least three positions and tilts"
        )

    judged = _warn_of_notes(
        (
            read_pose(
                DecodedPose(
                    name,
                    sequence,
                    look,
                    decode_or_explain(name, sequence, look),
                    convert_to_8bit(texture(sequence, look.stack)),
                    board,
                ),
                settings.step_2,
            )
            for name, frames in poses.items()
            for look in (look_at(sequence, frames),)
        ),
        warn,
    )
    count, size = len(poses), sequence.projector
    diagnosed = _diagnose_poses(judged, count, sequence, size, board, {}, part(progress, 0, 0.65))
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


def choose_poses(
    store: Session, settings: CalibrateSettings, warn: Warn
) -> tuple[list[str], dict[str, str]]:
    """Return the target poses to calibrate from, and {pose: why} of those that are excluded, also
    of those whose frames are another's. Raises UsageError for a name or pattern that fits no target
    pose."""
    captures, faults = store.read_captures()
    for fault in faults.values():
        warn(f"not used: {fault}")
    names = [capture.name for capture in captures if capture.role == "calibration"]
    if not names:
        raise InputError(
            f"{store.folder} holds no target poses",
            "import some with --role calibration, or capture them first",
        )
    excluded = {
        name: f"excluded by the operator: {why}"
        for name, why in store.excluded().items()
        if name in names
    }
    if settings.poses:
        chosen = match_names(names, settings.poses, "target pose")
        why = "not among the poses that were named"
        excluded |= {name: why for name in names if name not in chosen}
    skipped = match_names(names, settings.exclude, "target pose")
    excluded |= dict.fromkeys(skipped, "excluded for this calibration")
    names = [name for name in names if name not in excluded]
    if not names:
        raise InputError("every target pose is excluded", "include some again")
    hashes = {capture.name: capture.hash for capture in captures}
    first = {hashes[name]: name for name in reversed(names)}
    copies = {
        name: f"its frames are those of {first[hashes[name]]}, which count once"
        for name in names
        if first[hashes[name]] != name
    }
    _warn_of_excluded(copies, (), warn)
    return [name for name in names if name not in copies], excluded | copies


def _changes_calibration(
    store: Session, inputs: Mapping[str, str], settings: CalibrateSettings
) -> bool:
    """Return whether the session's models belong to a calibration from other captures or settings,
    if any."""
    if "stereo" not in available_models(store):
        return True
    before = load_record(store, ModelCalibration, "stereo")
    if not before.settings or before.inputs != inputs:
        return True
    return CalibrateSettings(**before.settings).method != settings.method


def _load_camera(
    store: Session, settings: CalibrateSettings, size: Size, warn: Warn
) -> KnownCamera | None:
    """Load the camera that the settings name for images of ``size`` (width, height) px, and save it
    in the session, from where a repetition loads it; None where they name none."""
    if settings.camera is None:
        return None
    if str(settings.camera) == LENS and store.has_result(LENS):
        meta = store.load_result(LENS)[0]
    else:
        file = read_camera_file(settings.camera, size)
        for note in file.notes:
            warn(f"{file.name}: {note}")
        meta = {
            "content": file.content,
            "name": file.name,
            "lens": to_plain(file.lens),
            "focal_sigma": file.focal_sigma,
        }
        store.save_result(LENS, meta, {})
    lens, sigma = from_plain(meta["lens"], Lens), meta["focal_sigma"]
    if sigma is None and settings.fix_camera:
        warn(
            f"{meta['name']} states no uncertainty: {100 * UNSTATED_SIGMA:g} % of the focal length"
            " are assumed"
        )
    focal_sigma_px = float(lens.K[0, 0]) * (UNSTATED_SIGMA if sigma is None else sigma)
    return KnownCamera(lens, meta["name"], settings.fix_camera, focal_sigma_px)


def _warn_of_notes(poses: Iterable[Judged], warn: Warn) -> Iterator[Judged]:
    """Yield poses, and warn of what else they show."""
    for pose in poses:
        if pose.note:
            warn(f"{pose.name}: {pose.note}")
        yield pose


def _diagnose_poses(
    poses: Iterable[Judged],
    count: int,
    sequence: PatternSequence,
    other_size: Size,
    board: Board,
    excluded: Mapping[str, str],
    progress: Progress,
    camera: KnownCamera | None = None,
) -> DiagnosedCalibration:
    """Calibrate stereo from ``count`` target poses as they are read, and judge it. ``excluded``:
    {pose: why}; ``camera``: a known one; ``other_size``: px of the projector or second camera."""
    try:
        for axis in sequence.axes:
            if sequence.periods_px(axis) and sequence.find("gray", axis):
                axis_layout(sequence, axis)
    except InputError as error:  # its periods and its Gray code conflict
        evidence = Evidence(str(board), other_size, (), contradiction=error)
        return DiagnosedCalibration(judge_evidence(evidence), evidence, None, (), dict(excluded))
    judged = list[Judged]()
    for pose in poses:
        judged.append(pose)
        progress(len(judged) / count, f"read {pose.name}")
    refused = {pose.name: pose.refused for pose in judged if pose.observation is None}
    # its matrices are narrow: more threads gain nothing, and occupy the cores while they wait
    with threadpool_limits(1, user_api="blas"):
        result = calibrate_with_diagnosis(
            [pose.observation for pose in judged if pose.observation is not None],
            [pose.evidence for pose in judged if pose.evidence is not None],
            other_size,
            board,
            {**excluded, **refused},
            camera,
        )
    if result.stereo is None:
        return result
    return replace(result, stereo=replace(result.stereo, excluded=result.excluded))


def _fit_models(
    diagnosed: DiagnosedCalibration,
    settings: CalibrateSettings,
    progress: Progress,
    warn: Warn,
    excluded: Iterable[str] = (),
) -> CalibrationResult:
    """Fit the models that follow from a stereo calibration; return them with the verdict on all:
    stereo alone where that rejects them. One that cannot be fitted is a warning, and stops no
    other.

    Warns of poses that were excluded, but for those ``excluded`` before, and of what is doubtful.
    Raises CalibrationRejected without a stereo calibration.
    """
    stereo, observations, verdict = diagnosed.stereo, diagnosed.observations, diagnosed.verdict
    if stereo is None:
        raise rejection_error(verdict, is_saved=False)
    if verdict.level == "rejected":
        return CalibrationResult(stereo, verdict=verdict)
    _warn_of_doubts(diagnosed, stereo, excluded, warn)
    few = next((each for each in verdict.findings if each.cause == "too-few-poses"), None)
    models = settings.models or MODELS
    pixelwise, splined, share = None, None, 0.0
    if "pixelwise" in models:
        share = 0.33 if "splined" in models else 1.0
        if few and len(observations) < MIN_POSES and len(models) > 1:
            more = msgspec.structs.replace(
                few, observation=f"{few.observation}; no pixel-wise model"
            )
            others = [each for each in verdict.findings if each is not few]
            verdict = Verdict.of([more, *others])
        else:
            with (
                _warn_of_failure("pixel-wise", models, warn),
                threadpool_limits(1, user_api="blas"),  # as for the diagnosis
            ):
                fitting = stage(progress, 0.0, share, "pixel-wise fit")
                pixelwise = calibrate_pixelwise(observations, stereo, fitting)
    if "splined" in models:
        with _warn_of_failure("splined", models, warn):
            fitting = stage(progress, share, 1.0, "joint adjustment")
            splined = calibrate_splined(
                observations, stereo, fitting, cells_across=settings.cells_across
            )
            _warn_of_excluded(splined.bundle.excluded, (), warn, " from the splined model: it")
            verdict = judge_splined(verdict, splined.bundle.noise, splined.bundle.camera)
    for finding in verdict.findings:
        if finding.severity != "note":
            warn(finding.text())
    if verdict.level == "rejected":
        return CalibrationResult(stereo, verdict=verdict)
    return CalibrationResult(stereo, pixelwise, splined, verdict)


def _warn_of_doubts(
    diagnosed: DiagnosedCalibration, stereo: StereoModel, excluded: Iterable[str], warn: Warn
) -> None:
    """Warn of what is doubtful, and of poses that are excluded although no finding says so."""
    if diagnosed.warning:
        warn(diagnosed.warning)
    doubts = [each for each in diagnosed.verdict.findings if each.severity == "doubtful"]
    stated = {name for each in doubts for name in each.poses if name in each.observation}
    _warn_of_excluded(stereo.excluded, stated.union(excluded), warn)


def _warn_of_excluded(
    excluded: Mapping[str, str], stated: Container[str], warn: Warn, model: str = ":"
) -> None:
    """Warn of poses that a calibration excluded, {name: why}, but for those already ``stated``."""
    for name, why in excluded.items():
        if name not in stated:
            warn(f"{name} is excluded{model} {why}")


@contextmanager
def _warn_of_failure(name: str, models: Sequence[str], warn: Warn) -> Iterator[None]:
    """Context manager that turns the failure of a fit into a warning, unless the model is the only
    one of ``models`` that is wanted."""
    try:
        yield
    except (CalibrationRejected, InputError) as error:
        if len(models) == 1:
            raise
        warn(f"no {name} model: {error}")


def rejection_error(verdict: Verdict, is_saved: bool) -> CalibrationRejected:
    """Return the error to raise for a rejected calibration; ``is_saved``: the session holds it for
    inspection."""
    first, more = verdict.findings[0], len(verdict.findings) - 1
    others = f" (and {more} more finding{'s' * (more != 1)})" if more else ""
    saved_note = "; the calibration is saved for inspection, and not used" if is_saved else ""
    return CalibrationRejected(f"{first.text()}{others}{saved_note}")


def calibrate_camera_alone(
    source: Path | str,
    target: str,
    *,
    poses: Sequence[str] = (),
    exclude: Sequence[str] = (),
    out: Path | str | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> CameraCalibration:
    """Calibrate the camera from a folder of pictures, or from the target poses of a session; a
    session stays as it is.

    ``poses``, ``exclude``: names or patterns of pictures. ``out``: .yml, .xml or .json for OpenCV.
    Pictures in which the board is not detected are excluded with the reason. Raises
    CalibrationRejected for fewer than three.
    """
    board, source = Board.parse(target), Path(source)
    there: list[Capture] | list[Path]
    if is_session(source):
        with Session.open(source) as store:
            there = store.captures("calibration")
    elif source.is_dir():
        there = images_by_name(source)
    else:
        raise InputError(
            f"{source} is not a folder", "give a folder of pictures of the board, or a session"
        )
    for warning in warn_of_unread([each for each in there if isinstance(each, Path)]):
        warn(warning)
    pictures = {each.name: each for each in there}
    without = match_names([*pictures], exclude, "picture")
    chosen = match_names([*pictures], poses, "picture") if poses else [*pictures]
    chosen = [name for name in chosen if name not in without]
    if not chosen:
        raise InputError(f"{source} holds no picture to calibrate from", "name some")
    detections, excluded = dict[str, Detection](), dict[str, str]()
    area = measure_picture_area(_read_pictures(pictures, chosen), len(chosen))
    for i, name in enumerate(chosen):
        progress(i / len(chosen), f"detecting the board in {name}")
        image = _read_picture(pictures[name])
        try:
            detections[name] = detect_in_area(board, cut_area(image, area), area)
            for note in _list_notes(name, image, detections[name]):
                warn(note)
        except DetectionError as error:
            excluded[name] = str(error)
            warn(f"{name} is excluded: {error}")
    calibration = calibrate_camera(board, detections, area.size, excluded, area.describe_cut())
    if out is not None:
        entries = {
            "program": f"slviewer {__version__}",
            "target": calibration.board,
            "camera_size": np.array(calibration.lens.size),
            "K_camera": calibration.lens.K,
            "D_camera": calibration.lens.D,
            "focal_sigma_px": np.array(calibration.focal_sigma_px),
            "reprojection_rms_px_camera": calibration.rms_px,
            "verdict": calibration.verdict.level,
        }
        write_calibration(Path(out), entries, _MEANINGS)
    progress(1.0, "calibrated")
    return calibration


def _list_notes(name: str, image: np.ndarray, detection: Detection) -> list[str]:
    """Return warnings about a picture in which the board was detected."""
    mosaic = describe_mosaic(name, image[None]) if image.ndim == 2 else ""
    return [*filter(None, (mosaic, detection.note and f"{name}: {detection.note}"))]


def _read_pictures(
    pictures: Mapping[str, Capture | Path], names: Sequence[str]
) -> Iterator[np.ndarray]:
    """Yield the named pictures; raises InputError where one differs in size."""
    size: Size | None = None
    for name in names:
        image = _read_picture(pictures[name])
        height, width = image.shape[:2]
        if size is not None and size != (width, height):
            raise InputError(
                f"{name} is {width}x{height} px, others are {size[0]}x{size[1]}",
                "use pictures of one size",
            )
        size = width, height
        yield image


def _read_picture(source: Capture | Path) -> np.ndarray:
    """Return the picture (h, w) or (h, w, 3) RGB of a capture or a file."""
    if isinstance(source, Capture):
        return capture_texture(source, source.frames)
    image = read_image(source)
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image


_MEANINGS = {
    "camera_size": (
        "width and height of the image, px; pixel (0, 0) is the centre of the top left one"
    ),
    "K_camera": "intrinsics: fx 0 cx, 0 fy cy, 0 0 1, px",
    "D_camera": "distortion: k1 k2 p1 p2 k3, as OpenCV orders them",
    "focal_sigma_px": "standard deviations of fx and fy, px",
}
