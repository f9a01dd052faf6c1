"""Whether the splined calibration is as wrong as it says: simulated rigs, whose true space is known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.calibration.splined.model import SplinedModel, calibrate_splined
from slviewer.calibration.splined.uncertainty import volume_sigmas
from slviewer.calibration.splined.unknowns import Arrangement
from slviewer.calibration.splined.volume import Volume, depth_axis, motion_free, sigma_3d, view_pixels, working_volume
from slviewer.errors import CalibrationRejected
from slviewer.evaluation.render import render
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.feedback import Progress, ignore_progress, part
from slviewer.simulation.rig import SimulatedRig
from slviewer.validation.faulty_captures import FaultBench
from slviewer.validation.prove_rigs import RigCase, cases

POSES = 25
BAND = (0.7, 1.5)
"""Of predicted over true error, pooled over all rigs."""
GRID = (13, 10, 5)
"""Places compared: columns, rows, depths."""


@dataclass(frozen=True, eq=False)
class Honesty:
    """One calibration: at each place of its working volume, what it ``predicted`` (n,) mm and by how much it ``missed``
    (n,) mm, both in 3D without the rigid motion that fits the supported places best; ``supported`` (n,) bool."""

    name: str
    predicted: np.ndarray
    missed: np.ndarray
    supported: np.ndarray

    @property
    def below_two(self) -> float:
        """Share of the supported places that are off by less than two predicted standard deviations."""
        return float(np.mean((self.missed < 2 * self.predicted)[self.supported]))


@dataclass(frozen=True)
class UncertaintyProof:
    """What came of all rigs."""

    rigs: tuple[Honesty, ...]
    scale: float
    poses: int

    def ratio(self, supported: bool = True) -> float:
        """RMS predicted over RMS true error, pooled over the rigs: over supported places, or over all others."""
        return _ratio(self.rigs, supported)

    @property
    def holds(self) -> bool:
        """Whether the ratio over supported places lies in the band."""
        return BAND[0] <= self.ratio() <= BAND[1]

    def rows(self) -> list[dict[str, Any]]:
        """A row a rig, then the pooled one; mm."""
        pooled = {"pooled": self.rigs} if len(self.rigs) > 1 else {}
        groups: Mapping[str, tuple[Honesty, ...]] = {rig.name: (rig,) for rig in self.rigs} | pooled
        return [
            {
                "rig": name,
                "supported": float(np.mean(_joined(rigs, "supported"))),
                "predicted": _rms(rigs, "predicted", True),
                "true": _rms(rigs, "missed", True),
                "ratio": _ratio(rigs, True),
                "below_2_sigma": float(np.average([r.below_two for r in rigs], weights=[_count(r) for r in rigs])),
                "ratio_elsewhere": _ratio(rigs, False),
            }
            for name, rigs in groups.items()
        ]

    def text(self) -> str:
        """For people."""
        table = [
            {
                "rig": row["rig"],
                "supported %": round(100 * row["supported"], 1),
                "predicted um": round(1000 * row["predicted"], 1),
                "true um": round(1000 * row["true"], 1),
                "predicted / true": round(row["ratio"], 2),
                "below 2 sigma %": round(100 * row["below_2_sigma"], 1),
                "where no pose captures": round(row["ratio_elsewhere"], 2),
            }
            for row in self.rows()
        ]
        verdict = "lies" if self.holds else "does NOT lie"
        return (
            f"{render(table)}\npredicted over true 3D error, pooled over {len(self.rigs)} rigs of {self.poses} poses "
            f"at scale {self.scale:g}: {self.ratio():.2f} {verdict} between {BAND[0]} and {BAND[1]}; "
            f"where no pose captures {self.ratio(supported=False):.2f}"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values; ``ratio_elsewhere`` is None where poses support everything."""
        rows = [{key: None if value != value else value for key, value in row.items()} for row in self.rows()]
        return {"scale": self.scale, "poses": self.poses, "holds": self.holds, "ratio": self.ratio(), "rigs": rows}


def prove_uncertainty(
    scale: float = 0.5, *, rigs: int = 6, poses: int = POSES, seed: int = 0, progress: Progress = ignore_progress
) -> UncertaintyProof:
    """Calibrate so many rigs of different lenses and boards from rendered captures, and compare what each predicts of
    its errors with these. ``scale``: resolution of the camera, as a share of the Letter's.

    Raises CalibrationRejected where one cannot be calibrated.
    """
    chosen = [case for first in range(seed, seed + rigs, 6) for case in cases(first)][:rigs]
    found = []
    for k, case in enumerate(chosen):
        doing = part(progress, k / rigs, (k + 1) / rigs)
        rig = case.rig(scale)
        found.append(compare_with_truth(case.name, calibrated(case, rig, poses, doing), rig))
    progress(1.0, "proven")
    return UncertaintyProof(tuple(found), scale, poses)


def calibrated(case: RigCase, rig: SimulatedRig, poses: int, progress: Progress = ignore_progress) -> SplinedModel:
    """The splined model from rendered target poses."""
    bench = FaultBench(rig, count=poses, shape=case.shape)
    captures = []
    for i in range(poses):
        progress(0.7 * i / poses, f"{case.name}: pose {i + 1} of {poses}")
        captures.append(bench.examine_clean(i))
    attempt = bench.attempt(captures)
    if attempt.stereo is None:
        raise CalibrationRejected(f"{case.name}: {attempt.verdict.reason}")
    progress(0.7, f"{case.name}: calibrating")
    return calibrate_splined(attempt.observations, attempt.stereo)


def compare_with_truth(name: str, model: SplinedModel, true: SimulatedRig) -> Honesty:
    """What a calibration of a simulated rig predicts of its errors over the working volume, and what they are."""
    bundle, rig = model.bundle, model.rig
    columns, rows, depths = GRID
    volume = working_volume(rig, bundle.depth_range_mm, columns=columns, rows=rows, depths=depths)
    axis = depth_axis(rig, volume)
    errors = true_errors(true, rig, volume, axis)
    known = np.isfinite(errors).all(axis=1)
    volume = Volume(*(each[known] for each in (volume.pixels, volume.z, volume.points, volume.projector)))
    supported = volume.supported(rig, bundle.camera_poses > 0, bundle.projector_poses > 0)
    predicted = volume_sigmas(bundle, axis, volume)
    missed = sigma_3d(motion_free(errors[known].reshape(1, -1), volume.points, supported))
    return Honesty(name, predicted, missed, supported)


def true_errors(true: SimulatedRig, rig: Arrangement, volume: Volume, axis: Axis) -> np.ndarray:
    """(n, 3) mm: where the calibrated ``rig`` puts what camera pixels really see at the volume's depths, less where
    that is. NaN where a lens has no answer."""
    row = 0 if axis == "x" else 1
    rays = np.column_stack([true.camera.undistort(volume.pixels), np.ones(len(volume.z))])
    really = rays * volume.z[:, None]
    measured = true.project(really)[:, row]
    z = volume.z.copy()
    for _ in range(6):  # Newton, the slope from a step of a ten-thousandth
        here, there = (view_pixels(rig, volume.pixels, depths)[1][:, row] for depths in (z, 1.0001 * z))
        z = z + 1e-4 * z * (measured - here) / (there - here)
    return view_pixels(rig, volume.pixels, z)[0] - really


def _joined(rigs: tuple[Honesty, ...], what: str) -> np.ndarray:
    return np.concatenate([getattr(rig, what) for rig in rigs])


def _rms(rigs: tuple[Honesty, ...], what: str, supported: bool) -> float:
    chosen = _joined(rigs, what)[_joined(rigs, "supported") == supported]
    return float(np.sqrt(np.mean(chosen**2))) if chosen.size else float("nan")


def _ratio(rigs: tuple[Honesty, ...], supported: bool) -> float:
    return _rms(rigs, "predicted", supported) / _rms(rigs, "missed", supported)


def _count(rig: Honesty) -> int:
    return int(np.count_nonzero(rig.supported))
