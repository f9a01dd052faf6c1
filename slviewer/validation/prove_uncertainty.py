"""Whether the splined calibration predicts its own errors, on simulated rigs with known truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.splined.uncertainty import volume_sigmas
from slviewer.calibration.splined.unknowns import Arrangement
from slviewer.calibration.splined.volume import (
    Volume,
    remove_rigid_motion,
    select_depth_axis,
    sigma_3d,
    view_pixels,
    working_volume,
)
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.feedback import Progress
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.rig import SimulatedRig
from slviewer.validation.proof import Proof, root_mean_square, track
from slviewer.validation.prove_accuracy import rig_cases
from slviewer.validation.rendered_calibration import calibrate_rendered

POSES = 25
BAND = (0.7, 1.5)
"""Of predicted over true error, pooled over all rigs."""
GRID = (13, 10, 5)
"""Places compared: columns, rows, depths."""


@dataclass(frozen=True, eq=False)
class PredictedErrors:
    """One calibration: ``predicted`` (n,) mm and ``true`` (n,) mm errors over its working volume,
    in 3D without the rigid motion that fits the supported places best; ``supported`` (n,) bool."""

    predicted: np.ndarray
    true: np.ndarray
    supported: np.ndarray

    def row(self, rig: str) -> dict[str, Any]:
        """The figures in mm; NaN where target poses support everything."""
        inside, elsewhere = self.supported, ~self.supported
        predicted, true, predicted_elsewhere, true_elsewhere = (
            root_mean_square(errors[places])
            for places in (inside, elsewhere)
            for errors in (self.predicted, self.true)
        )
        return {
            "rig": rig,
            "supported": float(np.mean(inside)),
            "predicted": predicted,
            "true": true,
            "ratio": predicted / true,
            "below_2_sigma": float(np.mean((self.true < 2 * self.predicted)[inside])),
            "ratio_elsewhere": predicted_elsewhere / true_elsewhere,
        }


def prove_uncertainty(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate rigs of different lenses and boards from rendered captures, and compare what each
    predicts of its errors with these. ``scale``: resolution of the camera, as a share of the
    Letter's.

    Raises CalibrationRejected where one cannot be calibrated.
    """
    rigs = {}
    for name, case, report in track(progress, {case.name: case for case in rig_cases(seed)}):
        rig = case.rig(scale)
        plan = letter_plan(rig, poses=POSES, shape=case.shape)
        rigs[name] = compare_with_truth(calibrate_rendered(rig, plan, report)[1], rig)
    return judge_uncertainty(rigs, scale, POSES)


def judge_uncertainty(rigs: Mapping[str, PredictedErrors], scale: float, poses: int) -> Proof:
    """The proof: whether the ratio of predicted to true errors, pooled over the rigs, lies in
    ``BAND``."""
    fields = zip(*(vars(each).values() for each in rigs.values()), strict=True)
    pooled = PredictedErrors(*map(np.concatenate, fields)).row("pooled")
    rows = [each.row(name) for name, each in rigs.items()] + ([pooled] if len(rigs) > 1 else [])
    table = [
        {
            "rig": row["rig"],
            "supported %": 100 * row["supported"],
            "predicted um": round(1000 * row["predicted"], 1),
            "true um": round(1000 * row["true"], 1),
            "predicted / true": round(row["ratio"], 2),
            "below 2 sigma %": round(100 * row["below_2_sigma"], 1),
            "where no pose captures": round(row["ratio_elsewhere"], 2),
        }
        for row in rows
    ]
    holds = BAND[0] <= pooled["ratio"] <= BAND[1]
    line = (
        f"predicted over true 3D error, pooled over {len(rigs)} rigs of {poses} poses at scale"
        f" {scale:g}: {pooled['ratio']:.2f} {'lies' if holds else 'does NOT lie'} between {BAND[0]}"
        f" and {BAND[1]}; where no pose captures {pooled['ratio_elsewhere']:.2f}"
    )
    return Proof(
        holds, scale, table, {"poses": poses, "ratio": pooled["ratio"], "rigs": rows}, below=[line]
    )


def compare_with_truth(model: SplinedModel, true: SimulatedRig) -> PredictedErrors:
    """The errors that a calibration of a simulated rig predicts over the working volume, and its
    true ones."""
    bundle, rig = model.bundle, model.rig
    columns, rows, depths = GRID
    volume = working_volume(rig, bundle.depth_range_mm, columns=columns, rows=rows, depths=depths)
    axis = select_depth_axis(rig, volume)
    errors = true_errors(true, rig, volume, axis)
    known = np.isfinite(errors).all(axis=1)
    volume = Volume(
        *(each[known] for each in (volume.pixels, volume.z, volume.points, volume.projector))
    )
    supported = volume.supported(rig, bundle.camera_poses > 0, bundle.projector_poses > 0)
    predicted = volume_sigmas(bundle, axis, volume)
    return PredictedErrors(
        predicted,
        sigma_3d(remove_rigid_motion(errors[known].reshape(1, -1), volume.points, supported)),
        supported,
    )


def true_errors(true: SimulatedRig, rig: Arrangement, volume: Volume, axis: Axis) -> np.ndarray:
    """(n, 3) mm: the point that the calibrated ``rig`` measures for camera pixels at the volume's
    depths, less the true one; NaN where a lens has no answer."""
    row = 0 if axis == "x" else 1
    rays = np.column_stack([true.camera.undistort(volume.pixels), np.ones(len(volume.z))])
    points = rays * volume.z[:, None]
    measured = true.project(points)[:, row]
    z = volume.z.copy()
    for _ in range(6):  # Newton, the slope from a step of a ten-thousandth
        here, there = (
            view_pixels(rig, volume.pixels, depths)[1][:, row] for depths in (z, 1.0001 * z)
        )
        z = z + 1e-4 * z * (measured - here) / (there - here)
    return view_pixels(rig, volume.pixels, z)[0] - points
