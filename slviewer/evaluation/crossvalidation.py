"""How well each calibration measures target poses that it was not made from.

A pose that is held out is measured from its smoothed phase, so that what remains is the
calibration's error and hardly any camera noise. The board itself is the standard: how flat it comes
out, how long, and how near its features lie to where they are on it when it is laid over them
without stretching.
"""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import map_coordinates

from slviewer.calibration.observe import AXES, Observation
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.geometry.shapes import fit_plane
from slviewer.geometry.vectors import finite_rows, rms, rms_length
from slviewer.reconstruction.reconstruct import Model
from slviewer.records.model_comparison import HeldOutError, HeldOutPose, ModelComparison

FOLDS = 5
LEAST_POSES = 5
"""Fewer poses cannot spare any: a pixel-wise fit takes four."""
LEAST_FEATURES = 12
BETTER = 0.98
"""A model must bring the error down to this share of a simpler one's to be recommended instead."""


def split_folds(depths_mm: Mapping[str, float], folds: int = FOLDS) -> tuple[tuple[str, ...], ...]:
    """Deal the poses into folds in the order of their depths, so that each fold holds near and far
    ones.

    Raises InputError for fewer than ``LEAST_POSES`` poses.
    """
    if len(depths_mm) < LEAST_POSES:
        raise InputError(
            f"{len(depths_mm)} target poses, and none can be spared of fewer than {LEAST_POSES}:"
            " capture more poses to compare the models on poses that they were not made from"
        )
    if folds < 2:
        raise InputError(f"{folds} folds leave no pose out of any calibration: use 2 or more")
    ordered = sorted(depths_mm, key=lambda name: depths_mm[name])
    count = min(folds, len(ordered))
    return tuple(tuple(ordered[k::count]) for k in range(count))


def smoothed_phases(observation: Observation) -> dict[Axis, PhaseMap]:
    """Return phase maps over the board alone, from the stored smoothed phase of a pose."""
    width, height = observation.size
    u0, v0, u1, v1 = observation.box
    phases: dict[Axis, PhaseMap] = {}
    for axis in (a for a in AXES if a in observation.surfaces):
        phase = np.full((height, width), np.nan, np.float32)
        phase[v0:v1, u0:u1] = observation.smoothed_phase(axis)
        illuminated = np.isfinite(phase).astype(np.float32)
        reason = np.where(illuminated > 0, Reason.VALID, Reason.DARK).astype(np.uint8)
        phases[axis] = PhaseMap(
            axis,
            observation.periods_px[axis],
            phase,
            np.full_like(phase, np.nan),
            illuminated,
            illuminated,
            reason,
            (1.0, 0.0),
            18,
        )
    return phases


def measure_held_out(
    models: Mapping[str, Model], observation: Observation, axis: Axis, rig: StereoRig
) -> dict[str, HeldOutPose]:
    """Measure the errors of each model on a pose, all from the same axis and over the pixels and
    features that all of them measure; empty where these are too few, or the pose lacks the axis.
    ``rig`` converts millimetres to pixels.
    """
    phase = smoothed_phases(observation).get(axis)
    if phase is None:
        return {}
    clouds = {name: np.asarray(model.points(phase)) for name, model in models.items()}
    common = np.logical_and.reduce([np.isfinite(points[..., 2]) for points in clouds.values()])
    features = {
        name: _interpolate(np.where(common[..., None], points, np.nan), observation.camera)
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
            f"no model could be made without some of the poses ({why}): capture more poses"
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


def _interpolate(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 3): an organised cloud (h, w, 3) at pixels (n, 2), linear between its own; NaN beside
    invalid ones."""
    v_u = pixels[:, ::-1].T
    maps = (
        map_coordinates(points[..., k].astype(float), v_u, order=1, cval=np.nan) for k in range(3)
    )
    return np.stack(list(maps), axis=1)
