"""Each calibration measured on target poses that it was not made from."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from slviewer.calibration.centres import move_to_centres
from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import best_axis, calibrate_pixelwise
from slviewer.calibration.splined.model import calibrate_splined
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import CalibrationRejected, InputError, UsageError
from slviewer.evaluation.crossvalidation import FOLDS, gather_results, measure_held_out, split_folds
from slviewer.geometry.rigid import move_points
from slviewer.pipeline.feedback import Progress, part, stage
from slviewer.pipeline.models import (
    MODELS,
    ModelName,
    available_models,
    load_stereo,
    preferred_model,
    warn_if_frame_changed,
    warn_if_stale,
)
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.poses import load_observations
from slviewer.reconstruction.reconstruct import Model
from slviewer.records.model_comparison import HeldOutPose, ModelComparison

Fit = Callable[[Sequence[Observation], StereoModel, Callable[[float], None]], Model]
FITS: dict[str, Fit] = {
    "stereo": lambda observations, stereo, progress: stereo,
    "pixelwise": calibrate_pixelwise,
    "splined": calibrate_splined,
}
"""How each model is made from the poses that stereo was made from."""


@dataclass(frozen=True)
class ValidateSettings:
    """How models are compared.

    Args:
        models: Which models to compare; by default all there are. The recommended one is used where
            none is named.
        folds: Into how many parts the poses are split, each excluded once.
    """

    models: Sequence[ModelName] = ()
    folds: int = FOLDS


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
            "this calibration was made elsewhere, without target poses: calibrate here to"
            " cross-validate"
        )
    names = [name for name in MODELS if name in (settings.models or available_models(store))]
    if not names:
        raise UsageError(
            f"no model is called {', '.join(settings.models)}: use {', '.join(MODELS)}"
        )
    warn_if_stale(store, job.warn)
    observations = load_observations(store, list(stereo.poses))
    if missing := sorted(set(stereo.poses) - {o.name for o in observations}):
        raise InputError(
            f"the session no longer holds the observations of {', '.join(missing)}: run `slviewer"
            " calibrate` again"
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
            without = calibrate_stereo(training, stereo.rig.projector.size, stereo.board)
        except CalibrationRejected as error:
            raise InputError(
                f"without {', '.join(fold)} the rig cannot be calibrated, and no poses can be "
                f"excluded from the fit ({error}): capture more poses"
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
