"""The splined calibration as a model: points from phase, what supports them, and how sure they are."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slviewer.calibration.observe import AXES, Observation
from slviewer.calibration.splined.bundle import Bundle, adjust
from slviewer.calibration.splined.compiled import Compiled, compile_axis, pixel_rays
from slviewer.calibration.splined.evidence import LEAST_SIGMA_PX
from slviewer.calibration.splined.fields import undistort
from slviewer.calibration.splined.uncertainty import SigmaMap, sigma_map
from slviewer.calibration.splined.unknowns import Arrangement, lens_of
from slviewer.calibration.splined.volume import is_lit
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rig import StereoRig

NEAR, FAR = 0.7, 1.4
"""Of the nearest and the farthest calibrated depth: between them points are measured."""


@dataclass(frozen=True, eq=False)
class SplinedModel:
    """The joint adjustment, compiled when first used (about a second an axis at full size).

    Pixels that look through cells of camera or projector that no target pose lit are masked, unless asked for.
    """

    bundle: Bundle

    name = "splined"

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Both, whichever a capture holds: the adjustment compared both."""
        return AXES

    @property
    def rig(self) -> Arrangement:
        return self.bundle.state.rig

    @property
    def depths_mm(self) -> tuple[float, float]:
        """Nearest and farthest depth that is measured."""
        near, far = self.bundle.depth_range_mm
        return NEAR * near, FAR * far

    @cached_property
    def pinholes(self) -> StereoRig:
        """Both lenses without their displacement fields, and their arrangement."""
        return StereoRig(lens_of(self.rig.camera), lens_of(self.rig.projector), self.rig.R, self.rig.t)

    def residuals_over_noise(self, axis: Axis) -> float:
        """How many times their predicted noise the target poses' phases scatter by; 1 where noise explains them."""
        return self.bundle.noise.ratio[AXES.index(axis)]

    @property
    def residual_px(self) -> float:
        """The same of both axes, whichever is larger: how far, in projector px, points miss their epipolar lines."""
        return max(self.excess_px(axis) for axis in AXES)

    def sight(self, pixels: np.ndarray, projector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted normalised coordinates (n, 2) of camera ``pixels`` (n, 2) and ``projector`` pixels (n, 2); NaN
        where no target pose supports one of them."""
        rays = undistort(self.rig.camera, pixels), undistort(self.rig.projector, projector)
        known = is_lit(self.rig.camera, pixels, self.bundle.camera_poses > 0) & is_lit(
            self.rig.projector, projector, self.bundle.projector_poses > 0
        )
        return np.where(known[:, None], rays[0], np.nan), np.where(known[:, None], rays[1], np.nan)

    @cached_property
    def rays(self) -> np.ndarray:
        """(2, h, w) float64: the undistorted normalised point that each pixel sees."""
        return pixel_rays(self.rig)

    @cached_property
    def _single_rays(self) -> np.ndarray:
        return self.rays.astype(np.float32)

    @cached_property
    def _compiled(self) -> dict[Axis, Compiled]:
        return {}

    @cached_property
    def _sigma_maps(self) -> dict[Axis, SigmaMap]:
        return {}

    def compiled(self, axis: Axis) -> Compiled:
        """The fast form of one axis."""
        if axis not in self._compiled:
            lit = self.bundle.camera_poses > 0, self.bundle.projector_poses > 0
            self._compiled[axis] = compile_axis(self.rig, axis, self.rays, self.depths_mm, lit)
        return self._compiled[axis]

    def points(self, phase: PhaseMap, supported: bool = True) -> np.ndarray:
        """(h, w, 3) float32 mm; NaN where the phase is invalid, beyond ``depths_mm`` or, if only ``supported`` points
        are wanted, where no pose lit what the pixel looks through."""
        self._check(phase)
        px_per_rad = phase.period_px / (2 * np.pi)
        return self.compiled(phase.axis).depth(phase.phase, px_per_rad, self._single_rays, supported)

    def support(self, phase: PhaseMap) -> np.ndarray:
        """(h, w) bool: measured pixels that target poses support, in the camera and in the projector."""
        return np.isfinite(self.points(phase)[..., 2])

    def depth_per_rad(self, phase: PhaseMap) -> np.ndarray:
        """(h, w) float32: |dz/dphi| mm/rad at the phases measured."""
        self._check(phase)
        px_per_rad = phase.period_px / (2 * np.pi)
        return self.compiled(phase.axis).depth_per_px(phase.phase, px_per_rad) * np.float32(px_per_rad)

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``; NaN where points are."""
        sigma = self.depth_per_rad(phase) * phase.sigma_phase
        return np.where(np.isfinite(points[..., 2]), sigma, np.nan).astype(np.float32)

    def excess_px(self, axis: Axis) -> float:
        """Projector px that phases of the target poses scatter by beyond their predicted noise (1 sigma): what disturbs
        the phase there disturbs it in every capture."""
        excess = float(self.bundle.noise.excess_px[AXES.index(axis)])
        return excess if excess > 2 * LEAST_SIGMA_PX else 0.0  # the least that an estimate can be means none

    def sigma_map(self, axis: Axis) -> SigmaMap:
        """What the calibration leaves uncertain of depths through one axis, wherever points are measured."""
        if axis not in self._sigma_maps:
            self._sigma_maps[axis] = sigma_map(self.bundle, axis, *self.depths_mm)
        return self._sigma_maps[axis]

    def sigma_calibration(self, axis: Axis, points: np.ndarray) -> np.ndarray:
        """(h, w) float32 mm: standard deviation of depth that the calibration leaves, rigid motion apart; NaN where the
        organised points (h, w, 3) are. It is the same in every scan, and averages out in none. Where residuals exceed
        their noise it is larger by that ratio, for what they consist of then is not independent."""
        return self.sigma_map(axis).at(points) * np.float32(self.residuals_over_noise(axis))

    def to_dict(self) -> dict[str, Any]:
        """What is not an array, JSON-able."""
        return self.bundle.to_dict()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat named arrays, for saving."""
        return self.bundle.to_arrays()

    @classmethod
    def restored(cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "SplinedModel":
        """The inverse of ``to_dict`` and ``to_arrays``."""
        return cls(Bundle.restored(data, arrays))

    def _check(self, phase: PhaseMap) -> None:
        width, height = (int(n) for n in self.rig.camera.size)
        if phase.phase.shape != (height, width):
            raise InputError(
                f"A phase map of shape {phase.phase.shape} was given, and the camera was calibrated at "
                f"{width}x{height} px: use captures of the same camera, at the same resolution and without cropping."
            )


def calibrate_splined(
    observations: Sequence[Observation], stereo: StereoModel, progress: Callable[[float], None] | None = None
) -> SplinedModel:
    """The splined model from the poses that the stereo calibration used.

    Raises InputError where poses lack an axis, and CalibrationRejected where they contradict each other.
    """
    return SplinedModel(adjust(observations, stereo, progress))
