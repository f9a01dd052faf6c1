"""Tests of a calibration: with artefacts that have certificates; with a later capture of its board,
for drift; and of each model on target poses that it was not made from.

A pose that is held out is measured from its smoothed phase, so that what remains is the
calibration's error and hardly any camera noise. The board itself is the standard: how flat it comes
out, how long, and how near its features lie to where they are on it when it is laid over them
without stretching.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from scipy.ndimage import map_coordinates

from slviewer.calibration.centres import move_to_centres
from slviewer.calibration.drift import (
    MIN_POSES,
    DriftReference,
    DriftView,
    build_reference,
    check_drift,
)
from slviewer.calibration.observe import Observation, observe
from slviewer.calibration.pixelwise import best_axis, calibrate_pixelwise
from slviewer.calibration.splined.model import calibrate_splined
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import CalibrationRejected, InputError, UsageError
from slviewer.evaluation.acceptance import (
    SIZE,
    SPACING,
    Artefact,
    conclude_test,
    measure_artefact,
    repeatability,
)
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.geometry.shapes import fit_plane
from slviewer.geometry.vectors import finite_rows, rms, rms_length
from slviewer.inputs import RADIUS, Input
from slviewer.pipeline.calibrate import CalibrateSettings
from slviewer.pipeline.capture_phases import (
    capture_texture,
    check_capture,
    decode_capture,
    look_at_capture,
    match_second,
)
from slviewer.pipeline.cloud_corrections import record_scale, scale_factor
from slviewer.pipeline.imported_calibration import check_calibration, check_imported
from slviewer.pipeline.models import (
    MODELS,
    Model,
    ModelName,
    available_models,
    device_centres,
    load_model,
    load_pair,
    load_stereo,
    preferred_model,
    warn_if_frame_changed,
    warn_of_calibration,
)
from slviewer.pipeline.operation import (
    Found,
    Job,
    Progress,
    list_records,
    load_record,
    match_names,
    operation,
    part,
    stage,
)
from slviewer.pipeline.poses import cut_area, detect_in_area, load_observations
from slviewer.pipeline.reconstruct import check_capture_sizes, reconstruct_captures, segment_board
from slviewer.reconstruction.axis_agreement import check_sizes
from slviewer.reconstruction.camera_match import epipolar_lines
from slviewer.records.acceptance import (
    AcceptanceTest,
    Contribution,
    Drift,
    ErrorBudget,
    HeldOutError,
    HeldOutPose,
    ModelComparison,
    PositionErrors,
)
from slviewer.records.calibration import ModelCalibration, TransformCheck
from slviewer.session.reading import read_toml
from slviewer.session.store import Session
from slviewer.target.board import Board

REFERENCE = "drift_floor"
Fit = Callable[[Sequence[Observation], StereoModel, Callable[[float], None]], Model]
FITS: dict[str, Fit] = {
    "stereo": lambda observations, stereo, progress: stereo,
    "pixelwise": calibrate_pixelwise,
    "splined": calibrate_splined,
}
"""How each model is made from the poses that stereo was made from."""
FOLDS = 5
LEAST_POSES = 5
"""Fewer poses cannot spare any: a pixel-wise fit takes four."""
LEAST_FEATURES = 12
BETTER = 0.98
"""A model must bring the error down to this share of a simpler one's to be recommended instead."""


@dataclass(frozen=True)
class AcceptSettings:
    """What a calibration is tested with.

    Args:
        artefact: TOML file with the values of the certificate, the captures that show the artefact,
            and the limits.
        model: Which calibration to test; by default the best one available.
        still: Captures (ten) of one still object, for the repeatability.
        apply_scale: Record the measured scale as a correction of later clouds.
    """

    artefact: Path | str
    model: ModelName | None = None
    still: Sequence[str] = ()
    apply_scale: bool = False


@operation("accept", AcceptanceTest, AcceptSettings)
def accept(job: Job, settings: AcceptSettings) -> Iterator[Found[AcceptanceTest]]:
    """Test a calibration with a ball bar, a sphere or a plane that has a certificate, against the
    operator's limits.

    The result stays in the session as ``acceptance/1``, ``acceptance/2``, ...
    """
    store, still = job.store, settings.still
    certified = read_artefact(settings.artefact)
    check_calibration(job)
    chosen = load_model(store, settings.model)
    name, factor = chosen.name, scale_factor(store, chosen.name)
    if settings.apply_scale and certified.kind == "plane":
        raise InputError(
            "the scale cannot be measured on a plane", "apply that of a ball bar or a sphere"
        )
    captures: dict[str, str] = {}  # {capture: position, its own name where several are in one}
    for position, pattern in certified.positions.items():
        matches = match_names(store.capture_names(), [pattern], "capture", InputError)
        captures |= {each: position if len(matches) == 1 else each for each in matches}
    check_capture_sizes(store, [*captures, *still])
    measuring = job.part(0.0, 0.5 if still else 0.9)
    test = conclude_test(
        certified, name, _measure_positions(measuring, certified, chosen, captures)
    )
    repeated = None
    if still:
        again = job.part(0.5, 0.95)
        repeats = reconstruct_captures(again, chosen, still, "repeating", examine=False)
        repeated = repeatability((cloud.points[..., 2], cloud.sigma_z) for *_, cloud in repeats)
    applied = record_scale(store, test) if settings.apply_scale else None
    found = msgspec.structs.replace(
        test,
        scale_factor=factor,
        scale_applied=applied,
        budget=_length_budget(certified, test, applied, load_drift_history(store)),
        repeatability=repeated,
        inputs=store.input_hashes(f"calibration/{name}", *captures, *still),
    )
    yield Found("", found)
    job.progress(1.0, "tested")


def _measure_positions(
    job: Job, certified: Artefact, chosen: Model, captures: Mapping[str, str]
) -> list[PositionErrors]:
    """Measure the artefact at each position, {capture: position}."""
    positions = list[PositionErrors]()
    depth_range = load_stereo(job.store).depth_range_mm
    projector = next((centres[1] for centres in device_centres(job.store)), None)
    for shot, frames, cloud in reconstruct_captures(job, chosen, list(captures), "measuring"):
        plate, name = None, shot.name
        if certified.kind == "plane" and shot.role == "calibration":
            plate = segment_board(job.store, shot, capture_texture(shot, frames), job.warn)
        try:
            positions.append(
                measure_artefact(
                    certified, cloud, captures[name], name, depth_range, plate, projector
                )
            )
        except InputError as error:
            raise error.within(name) from error
    return positions


def read_artefact(path: Path | str) -> Artefact:
    """The artefact that a TOML file describes."""
    given = read_toml(path)
    try:
        return Artefact.from_dict(given)
    except InputError as error:
        raise error.within(str(path)) from error


def _length_budget(
    artefact: Artefact, test: AcceptanceTest, applied: float | None, checks: Sequence[Drift]
) -> ErrorBudget | None:
    """Error budget of the artefact's length from the test and the drift checks; None where no
    length was measured."""
    scale = test.scale
    if scale is None:
        return None
    mm = scale.length_mm
    name = SIZE if artefact.spacing is None else SPACING
    errors = np.array([f.error_mm for p in test.positions for f in p.figures if f.property == name])
    noise = rms([p.noise_mm for p in test.positions])
    scatter = None if len(errors) < 2 else float(np.sqrt(max(errors.var(ddof=1) - noise**2, 0.0)))
    # known, not removed
    uncorrected_ppm = abs(scale.ppm) if applied is None and abs(scale.ppm) > scale.U_ppm else 0.0
    board = mm * 1e-6 * float(np.hypot(scale.u_ppm, uncorrected_ppm))
    warmth = mm * 1e-6 * artefact.calibrated.expansion_ppm_K * artefact.measured.temperature_U_K / 2
    drift, since = None, "no drift check of this calibration: run `slviewer check`"
    if checks:
        last = checks[-1]
        drift = mm * 1e-6 * float(np.hypot(last.scale_ppm, last.scale_sigma_ppm))
        since = f"the drift check of {last.capture}"
    return ErrorBudget(
        mm,
        [
            Contribution("phase noise", noise, "A", "the scatter of the points about their fits"),
            Contribution(
                "calibration", scatter, "A", f"the errors' scatter over {len(errors)} places"
            ),
            Contribution(
                "board scale",
                board,
                "B",
                "this test's scale" + (", which was left uncorrected" if uncorrected_ppm else ""),
            ),
            Contribution(
                "temperature",
                warmth,
                "B",
                f"{artefact.calibrated.expansion_ppm_K:g} ppm/K of the artefact",
            ),
            Contribution("drift", drift, "B", since),
        ],
    )


@dataclass(frozen=True)
class CheckSettings:
    """What a calibration is checked with.

    Args:
        capture: Name of a capture, of any role, that shows the calibration's board; for one that
            was imported, of anything with patterns along both axes, of a board or of a sphere.
        target: For an imported calibration: the board in view; by default the session's.
        radius: For an imported calibration: radius of the sphere in view, mm.
    """

    capture: str
    target: str = ""
    radius: Annotated[float | None, RADIUS] = None


@operation("check", Drift, CheckSettings, others=(TransformCheck,))
def check(job: Job, settings: CheckSettings) -> Iterator[Found[Drift] | Found[TransformCheck]]:
    """Determine from one capture of the board whether the saved calibration is still good, and why
    if it is not; of one that was imported, whether R and T have the direction and the unit that
    they are taken to have.

    The session stores the answer as ``drift/1``, ``drift/2``, ..., that on an imported calibration
    as ``transform/1``, ... Raises DetectionError where the capture does not show the board,
    InputError where the calibration has too few poses for a decision.
    """
    store, capture = job.store, settings.capture
    shot = store.load_capture(capture)
    shot.require_frames("check")
    stereo = load_stereo(store)
    if not stereo.poses:
        yield Found("", check_imported(job, capture, settings.target, settings.radius))
        return
    if settings.target or settings.radius:
        raise UsageError("--target and --radius are for imported calibrations", "omit them")
    warn_of_calibration(store, job.warn)
    job.progress(0.0, f"reading {capture}")
    look = look_at_capture(shot)
    frames, decoded = look.stack, decode_capture(shot, look)
    check_capture(capture, shot.sequence, frames, decoded, files=shot.files)
    phases = match_second(shot, decoded, lambda _: epipolar_lines(load_pair(store)))
    check_sizes(capture, shot.size, shot.other_size, stereo.rig)
    board = Board.parse(stereo.board)
    image = cut_area(capture_texture(shot, frames), look.area)
    detection = detect_in_area(board, image, look.area, several=False)
    calibrated = CalibrateSettings(**load_record(store, ModelCalibration, "stereo").settings)
    observation = observe(capture, board, detection, phases, calibrated.step_2)
    job.progress(0.3, "fitting the calibration's own poses")
    drift = check_drift(
        _drift_reference(store, stereo, capture), DriftView.from_observation(observation)
    )
    before = load_drift_history(store)
    inputs = store.input_hashes(capture, "calibration/stereo")
    notes = ["earlier checks of this calibration:"] if before else []
    notes += [f"  {each.time[:16].replace('T', ' ')}  {each.summary()}" for each in before]
    yield Found("", msgspec.structs.replace(drift, inputs=inputs), notes=tuple(notes))
    job.progress(1.0, "checked")


def _drift_reference(store: Session, stereo: StereoModel, capture: str) -> DriftReference:
    """Load or build the drift reference from the calibration's poses except the capture; stored, as
    it is slow."""
    if capture not in stereo.poses:
        saved = store.decode_fresh(
            REFERENCE, lambda _, arrays: DriftReference.from_arrays(stereo.rig, arrays)
        )
        if saved is not None:
            return saved
    poses = [name for name in stereo.poses if name != capture]
    if len(poses) < MIN_POSES <= len(stereo.poses):
        raise InputError(
            f"{capture} is one of the calibration's own {len(stereo.poses)} poses, and the"
            f" {len(poses)} others are too few for a drift reference",
            "capture the board once more, and check that",
        )
    reference = build_reference(
        stereo.rig, [DriftView.from_observation(o) for o in load_observations(store, poses)]
    )
    if capture not in stereo.poses and store.is_writable:
        meta = {"inputs": store.input_hashes("calibration/stereo", *poses)}
        store.save_result(REFERENCE, meta, reference.to_arrays())
    return reference


def load_drift_history(store: Session) -> list[Drift]:
    """Load the drift checks of the session's present calibration, the oldest first."""
    now = store.input_hashes("calibration/stereo")["calibration/stereo"]
    checks = [each.record for each in list_records(store, Drift)]
    return [each for each in checks if each.inputs.get("calibration/stereo") == now]


def split_folds(depths_mm: Mapping[str, float], folds: int = FOLDS) -> tuple[tuple[str, ...], ...]:
    """Deal the poses into folds in the order of their depths, so that each fold holds near and far
    ones.

    Raises InputError for fewer than ``LEAST_POSES`` poses.
    """
    if len(depths_mm) < LEAST_POSES:
        raise InputError(
            f"{len(depths_mm)} target poses, and none can be spared of fewer than {LEAST_POSES}",
            "capture more poses to compare the models on poses that they were not made from",
        )
    if folds < 2:
        raise InputError(f"{folds} folds leave no pose out of any calibration", "use 2 or more")
    ordered = sorted(depths_mm, key=lambda name: depths_mm[name])
    count = min(folds, len(ordered))
    return tuple(tuple(ordered[k::count]) for k in range(count))


def map_board_phase(observation: Observation, axis: Axis) -> PhaseMap:
    """Return the phase map over the board alone, from the stored smoothed phase of a pose."""
    width, height = observation.size
    u0, v0, u1, v1 = observation.box
    phase = np.full((height, width), np.nan, np.float32)
    phase[v0:v1, u0:u1] = observation.smoothed_phase(axis)
    illuminated = np.isfinite(phase).astype(np.float32)
    return PhaseMap(
        axis,
        observation.periods_px[axis],
        phase,
        np.full_like(phase, np.nan),
        illuminated,
        illuminated,
        np.where(illuminated > 0, Reason.VALID, Reason.DARK).astype(np.uint8),
        (1.0, 0.0),
        18,
    )


def measure_held_out(
    models: Mapping[str, Model], observation: Observation, axis: Axis, rig: StereoRig
) -> dict[str, HeldOutPose]:
    """Measure the errors of each model on a pose, all from the same axis and over the pixels and
    features that all of them measure; empty where these are too few, or the pose lacks the axis.
    ``rig`` converts millimetres to pixels.
    """
    if axis not in observation.surfaces:
        return {}
    phase = map_board_phase(observation, axis)
    clouds = {name: np.asarray(model.points(phase)) for name, model in models.items()}
    common = np.logical_and.reduce([np.isfinite(points[..., 2]) for points in clouds.values()])
    features = {
        name: interpolate_points(np.where(common[..., None], points, np.nan), observation.camera)
        for name, points in clouds.items()
    }
    read = finite_rows(*features.values())
    if np.count_nonzero(read) < LEAST_FEATURES:
        return {}
    board = observation.points[read]
    results = {}
    for name, points in clouds.items():
        measured, X = points[common].astype(float), features[name][read]
        placed, middle = move_points(fit_rigid(board, X), board), X.mean(0)
        scale = np.sum((placed - middle) * (X - middle)) / np.sum((placed - middle) ** 2)
        results[name] = HeldOutPose(
            plane_mm=rms(fit_plane(measured).distance(measured)),
            board_mm=rms_length(X - placed),
            scale_ppm=1e6 * (float(scale) - 1),
            camera_px=rms_length(rig.camera.project(X) - rig.camera.project(placed)),
            projector_px=rms_length(rig.project(X) - rig.project(placed)),
            pixels=len(measured),
            depth_mm=float(X[:, 2].mean()),
        )
    return results


def gather_results(
    poses: Mapping[str, Mapping[str, HeldOutPose]],
    folds: tuple[tuple[str, ...], ...],
    failed: Mapping[str, str],
) -> ModelComparison:
    """Combine the results of the folds, {model: {pose: ...}}, in the order of simplicity; models
    that failed are not among them.

    Raises InputError where no model could be judged.
    """
    judged = {
        model: dict(measured)
        for model, measured in poses.items()
        if measured and model not in failed
    }
    if not judged:
        why = "; ".join(f"{model}: {reason}" for model, reason in failed.items())
        raise InputError(
            f"no model could be made without some of the poses ({why})", "capture more poses"
        )
    models = {
        model: HeldOutError(
            *(
                rms([getattr(each, name) for each in measured.values()])
                for name in HeldOutError.__struct_fields__
            )
        )
        for model, measured in judged.items()
    }
    return ModelComparison(
        recommended=_recommend(models),
        models=models,
        poses=judged,
        folds=folds,
        failed=dict(failed),
    )


def _recommend(models: Mapping[str, HeldOutError]) -> str:
    """Return the model with the least error on boards, of nearly equal ones the simplest, which
    comes first."""
    chosen, *others = models
    for model in others:
        if models[model].board_mm < BETTER * models[chosen].board_mm:
            chosen = model
    return chosen


def interpolate_points(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 3): an organised cloud (h, w, 3) at pixels (n, 2), linear between its own; NaN beside
    invalid ones."""
    v_u = pixels[:, ::-1].T
    maps = (
        map_coordinates(points[..., k].astype(float), v_u, order=1, cval=np.nan) for k in range(3)
    )
    return np.stack(list(maps), axis=1)


@dataclass(frozen=True)
class ValidateSettings:
    """How models are compared.

    Args:
        models: Which models to compare; by default all there are. The recommended one is used where
            none is named.
        folds: Into how many parts the poses are split, each excluded once.
    """

    models: Sequence[ModelName] = ()
    folds: Annotated[int, Input(2, 1000)] = FOLDS


@operation("validate", ModelComparison, ValidateSettings)
def validate(job: Job, settings: ValidateSettings) -> Iterator[Found[ModelComparison]]:
    """Measure target poses with calibrations made without them, and recommend the best model.

    Nothing is decoded again: the session stores what it needs of the poses. The result stays in the
    session as ``validation/1``.
    """
    store = job.store
    stereo = load_stereo(store)
    if not stereo.poses:
        raise InputError(
            "this calibration was made elsewhere, without target poses",
            "calibrate here to cross-validate",
        )
    names = [name for name in MODELS if name in (settings.models or available_models(store))]
    if not names:
        raise UsageError(
            f"no model is called {', '.join(settings.models)}", f"use {', '.join(MODELS)}"
        )
    warn_of_calibration(store, job.warn)
    observations = load_observations(store, list(stereo.poses))
    if missing := sorted(set(stereo.poses) - {o.name for o in observations}):
        raise InputError(
            f"the session no longer holds the observations of {', '.join(missing)}",
            "run `slviewer calibrate` again",
        )
    compared = cross_validate(
        move_to_centres(observations, stereo), stereo, names, settings.folds, job.progress
    )
    for model, why in compared.failed.items():
        job.warn(f"{model} is not judged: {why}")
    judged = [f"calibration/{name}" for name in compared.models if name in available_models(store)]
    inputs = store.input_hashes(*stereo.poses, *dict.fromkeys(["calibration/stereo", *judged]))
    before = preferred_model(store)
    yield Found("1", msgspec.structs.replace(compared, inputs=inputs))
    warn_if_frame_changed(store, before, job.warn)
    job.progress(1.0, "validated")


def cross_validate(
    observations: Sequence[Observation],
    stereo: StereoModel,
    models: Sequence[str],
    folds: int,
    progress: Progress,
) -> ModelComparison:
    """Cross-validate models on observations, with circles at their centres, and their stereo
    calibration."""
    depths = {
        o.name: float(np.median(move_points(stereo.poses[o.name], o.points)[:, 2]))
        for o in observations
    }
    parts, steps = split_folds(depths, folds), len(models) + 1
    axis = best_axis(observations, stereo)
    failed: dict[str, str] = {}
    measured: dict[str, dict[str, HeldOutPose]] = {model: {} for model in models}
    for k, fold in enumerate(parts):
        report = part(progress, k / len(parts), (k + 1) / len(parts))
        training = [o for o in observations if o.name not in fold]
        try:
            without = calibrate_stereo(
                training, stereo.rig.projector.size, stereo.board, camera=stereo.known_camera
            )
        except CalibrationRejected as error:
            raise InputError(
                f"without {', '.join(fold)} the rig cannot be calibrated, and no poses can be"
                f" excluded from the fit ({error})",
                "capture more poses",
            ) from error
        fitted: dict[str, Model] = {}
        for i, name in enumerate(n for n in models if n not in failed):
            doing = f"{name} without fold {k + 1} of {len(parts)}"
            fitting = stage(report, i / steps, (i + 1) / steps, doing)
            try:
                fitted[name] = FITS[name](training, without, fitting)
            except (CalibrationRejected, InputError) as error:
                failed[name] = str(error)
        report(len(models) / steps, f"measuring fold {k + 1} of {len(parts)}")
        for held_out in (o for o in observations if o.name in fold):
            errors = measure_held_out(fitted, held_out, axis, stereo.rig)
            for name, held in errors.items():
                measured[name][held_out.name] = held
    return gather_results(measured, parts, failed)
