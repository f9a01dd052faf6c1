"""The splined calibration as a model: points from phase, what supports them, and their
uncertainty."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NotRequired, TypedDict

import numpy as np

from slviewer.calibration.board_pose import solve_device
from slviewer.calibration.known_camera import CameraCheck
from slviewer.calibration.next_pose import nominal_lens
from slviewer.calibration.observe import AXES, Observation
from slviewer.calibration.splined.adjust import adjust_bundle
from slviewer.calibration.splined.bundle import Bundle, PoseFit
from slviewer.calibration.splined.compiled import CompiledAxis, compile_axis, pixel_rays
from slviewer.calibration.splined.residual_noise import MIN_SIGMA_PX, Noise
from slviewer.calibration.splined.uncertainty import (
    SigmaMap,
    compute_sigma_map,
    select_depth_axis,
    summarise_volume_sigma,
    working_volume,
)
from slviewer.calibration.splined.unknowns import (
    Arrangement,
    Device,
    State,
    board_frame,
    board_heights,
    in_illuminated_cells,
    pinhole_lens,
    undistort,
)
from slviewer.calibration.stereo import DEVICES, StereoModel
from slviewer.errors import InputError
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis, Size
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Mask, move_points, rigid_transform
from slviewer.geometry.triangulation import check_map
from slviewer.geometry.vectors import finite_rows, rms
from slviewer.records.calibration import SplinedFit, VolumeSigma
from slviewer.records.record import from_plain, to_plain

_BUNDLE_ARRAYS = ("points", "camera_poses", "projector_poses")
NEAR, FAR = 0.7, 1.4
"""Of the nearest and the farthest calibrated depth: between them points are measured."""


@dataclass(frozen=True, eq=False)
class SplinedModel:
    """The splined calibration: a bundle adjustment with spline displacement fields, compiled on
    first use.

    Pixels in cells of camera or projector that no target pose illuminated are masked by default.
    """

    bundle: Bundle

    name = "splined"

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Both axes, as the adjustment uses both."""
        return AXES

    @property
    def rig(self) -> Arrangement:
        """Both devices with their displacement fields, and their relative pose."""
        return self.bundle.state.rig

    @property
    def depths_mm(self) -> tuple[float, float]:
        """Nearest and farthest measurable depth."""
        near, far = self.bundle.depth_range_mm
        return NEAR * near, FAR * far

    @cached_property
    def pinholes(self) -> StereoRig:
        """Both lenses without their displacement fields, and their relative pose."""
        camera, projector = map(pinhole_lens, self.rig[:2])
        return StereoRig(camera, projector, self.rig.R, self.rig.t)

    def residuals_over_noise(self, axis: Axis) -> float:
        """Return the ratio of the residuals of an axis to their predicted noise; 1 where noise
        explains them."""
        return self.bundle.noise.ratio[AXES.index(axis)]

    @property
    def residual_px(self) -> float:
        """Standard deviation in projector px beyond noise, of the axis where it is larger (see
        ``excess_px``)."""
        return max(self.excess_px(axis) for axis in AXES)

    def undistort_pairs(
        self, pixels: np.ndarray, projector: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return undistorted normalised coordinates (n, 2) of camera ``pixels`` (n, 2) and
        ``projector`` pixels (n, 2).

        NaN where no target pose illuminated the cell of one of them.
        """
        camera, device = self.rig[:2]
        illuminated = self.bundle.illuminated
        unknown = ~in_illuminated_cells(camera, pixels, illuminated[0])
        unknown |= ~in_illuminated_cells(device, projector, illuminated[1])
        rays = undistort(camera, pixels), undistort(device, projector)
        rays[0][unknown] = rays[1][unknown] = np.nan
        return rays

    @cached_property
    def device_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted normalised coordinates (h, w, 2) of each pixel of both devices."""
        width, height = (int(n) for n in self.rig.projector.size)
        pixels = grid_points(np.arange(width), np.arange(height))
        seen = undistort(self.rig.projector, pixels).reshape(height, width, 2)
        return np.moveaxis(self.rays, 0, 2), seen

    @cached_property
    def rays(self) -> np.ndarray:
        """(2, h, w) float64: undistorted normalised coordinates of each pixel."""
        return pixel_rays(self.rig)

    @cached_property
    def single_rays(self) -> np.ndarray:
        """``rays`` in single precision."""
        return self.rays.astype(np.float32)

    @cached_property
    def _compiled(self) -> dict[Axis, CompiledAxis]:
        """Cache of ``fast_axis``."""
        return {}

    @cached_property
    def _sigma_maps(self) -> dict[Axis, SigmaMap]:
        """Cache of ``sigma_map``."""
        return {}

    def compile_depth(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Compile the axis along which depth is measured, and its uncertainty; `restore_compiled`
        takes the result."""
        axis = select_depth_axis(self.rig, working_volume(self.rig, self.bundle.depth_range_mm))
        arrays = {"sigma": self.sigma_map(axis).nodes, "rays": self.single_rays}
        data: dict[str, Any] = {"axis": axis}
        for name, value in vars(self.fast_axis(axis)).items():
            (arrays if isinstance(value, np.ndarray) else data)[name] = value
        return data, arrays

    def restore_compiled(self, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Take what `compile_depth` of the same calibration returned, which takes seconds to
        compute."""
        axis, values = data["axis"], {**data, **arrays}
        self._compiled[axis] = CompiledAxis(*(values[field.name] for field in fields(CompiledAxis)))
        self._sigma_maps[axis] = SigmaMap(arrays["sigma"], data["near"], data["far"])
        vars(self)["single_rays"] = arrays["rays"]

    def fast_axis(self, axis: Axis) -> CompiledAxis:
        """Return the compiled form of one axis; cached."""
        if axis not in self._compiled:
            self._compiled[axis] = compile_axis(
                self.rig, axis, self.rays, self.depths_mm, self.bundle.illuminated
            )
        return self._compiled[axis]

    def points(self, phase: PhaseMap, supported: bool = True) -> np.ndarray:
        """Return the points (h, w, 3) float32 mm of a phase map, in the camera's frame.

        NaN where the phase is invalid, beyond ``depths_mm``, and, if ``supported``, in cells that
        no target pose illuminated.
        """
        check_map(self.rig.camera.size, phase.phase, "phases")
        return self.fast_axis(phase.axis).depth(
            phase.phase, phase.px_per_rad, self.single_rays, supported
        )

    def support(self, phase: PhaseMap) -> Mask:
        """(h, w) bool: measured pixels in cells that target poses illuminated, in camera and
        projector."""
        return np.isfinite(self.points(phase)[..., 2])

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``; NaN where
        points are."""
        check_map(self.rig.camera.size, phase.phase, "phases")
        mm_per_px = self.fast_axis(phase.axis).depth_per_px(phase.phase, phase.px_per_rad)
        sigma = mm_per_px * np.float32(phase.px_per_rad) * phase.sigma_phase
        return np.where(np.isfinite(points[..., 2]), sigma, np.nan).astype(np.float32)

    def excess_px(self, axis: Axis) -> float:
        """Return the standard deviation in projector px of the residuals beyond their predicted
        noise; 0 if none."""
        excess = float(self.bundle.noise.excess_px[AXES.index(axis)])
        # the least that an estimate can be means none
        return excess if excess > 2 * MIN_SIGMA_PX else 0.0

    def sigma_map(self, axis: Axis) -> SigmaMap:
        """Return the map of the depth uncertainty by the calibration, for depths measured through
        one axis; cached."""
        if axis not in self._sigma_maps:
            self._sigma_maps[axis] = compute_sigma_map(self.bundle, axis, *self.depths_mm)
        return self._sigma_maps[axis]

    def sigma_calibration(self, axis: Axis, points: np.ndarray) -> np.ndarray:
        """Return the standard deviation (h, w) float32 mm of depth by the calibration, without
        common rigid motion.

        NaN where the organised ``points`` (h, w, 3) are. It is systematic: the same in every scan.
        Where residuals exceed their noise it is increased by that ratio, as they are not
        independent then.
        """
        return self.sigma_map(axis).interpolate(points) * np.float32(
            self.residuals_over_noise(axis)
        )

    @cached_property
    def sigma_volume(self) -> VolumeSigma:
        """Uncertainty of the working volume, as ``uncertainty.summarise_volume_sigma`` returns
        it."""
        return summarise_volume_sigma(self.bundle)

    def describe(self) -> SplinedFit:
        """Return the figures of the adjustment."""
        bundle, noise = self.bundle, self.bundle.noise
        local = [rms(device.coefficients[:, 1:-1, 1:-1]) for device in self.rig[:2]]
        camera, projector = bundle.illuminated
        if bundle.area is not None:
            camera = camera[bundle.area.contains_cells(camera.shape)]
        lit = [float(np.mean(cells)) for cells in (camera, projector)]
        height = board_heights(bundle.points, board_frame(bundle.points), bundle.state.heights)
        used = [fit for name, fit in bundle.fits.items() if name not in bundle.excluded]
        return SplinedFit(
            steps=bundle.steps,
            residuals_over_noise=dict(zip(AXES, noise.ratio, strict=True)),
            noise_px={"camera": noise.camera_px, **dict(zip(AXES, noise.sample_px, strict=True))},
            local_distortion_rms_px=dict(zip(DEVICES, local, strict=True)),
            board_height_mm=(float(height.min()), float(height.max())),
            board_offsets_rms_mm=rms(bundle.state.offsets),
            cells_lit=dict(zip(DEVICES, lit, strict=True)),
            sigma_volume_mm=self.sigma_volume,
            weights={
                name: (fit.camera_trust, fit.projector_trust) for name, fit in bundle.fits.items()
            },
            pose_rms_px={
                name: (fit.camera_rms_px, fit.projector_rms_px) for name, fit in bundle.fits.items()
            },
            pattern_px={
                "camera": rms([fit.camera_pattern_px for fit in used]),
                "projector": rms([fit.projector_pattern_px for fit in used]),
            },
            excluded=dict(bundle.excluded),
            turned=tuple(bundle.half_turned_poses),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that are not arrays, as JSON types."""
        bundle = self.bundle
        keys = ("poses", "noise", "strengths", "fits", "depth_range_mm", "steps")
        data: dict[str, Any] = to_plain(
            {key: getattr(bundle, key) for key in keys}
            | {"turned": bundle.half_turned_poses, "left_out": bundle.excluded}
            | ({"camera": bundle.camera} if bundle.camera else {})
        )
        return data

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving; the factor packed, in float32."""
        bundle = self.bundle
        rig, *own = bundle.state
        arrays = {
            f"{name}_{key}": value
            for name, device in zip(DEVICES, rig[:2], strict=True)
            for key, value in device._asdict().items()
        }
        arrays |= dict(zip(State._fields[1:], own, strict=True))
        arrays |= {name: getattr(bundle, name) for name in _BUNDLE_ARRAYS}
        if bundle.area is not None:
            arrays |= bundle.area.to_arrays()
        return arrays | {"R": rig.R, "t": rig.t, "factor": bundle.packed_factor}

    @classmethod
    def from_arrays(
        cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> "SplinedModel":
        """Return the model that ``to_dict`` and ``to_arrays`` saved. Raises InputError that names
        an invalid field."""
        saved = from_plain(data, _SavedModel)
        a = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        camera, projector = (
            Device(*(a[f"{name}_{key}"] for key in Device._fields)) for name in DEVICES
        )
        rig = Arrangement(camera, projector, a["R"], a["t"])
        bundle = Bundle(
            state=State(rig, *(a[name] for name in State._fields[1:])),
            poses=saved["poses"],
            **{name: a[name] for name in _BUNDLE_ARRAYS},
            noise=saved["noise"],
            strengths=saved["strengths"],
            fits=saved["fits"],
            excluded=saved["left_out"],
            depth_range_mm=saved["depth_range_mm"],
            packed_factor=a["factor"],
            steps=saved["steps"],
            half_turned_poses=saved.get("turned", ()),
            camera=saved.get("camera"),
            area=ImageArea.from_arrays(a),
        )
        return cls(bundle)


class _SavedModel(TypedDict):
    """What `SplinedModel.to_dict` returns, without the entries that older versions lack."""

    poses: tuple[str, ...]
    noise: Noise
    strengths: tuple[float, float]
    fits: dict[str, PoseFit]
    depth_range_mm: tuple[float, float]
    steps: int
    left_out: dict[str, str]
    turned: NotRequired[tuple[str, ...]]
    camera: NotRequired[CameraCheck]


def calibrate_splined(
    observations: Sequence[Observation],
    stereo: StereoModel,
    progress: Callable[[float], None] | None = None,
    *,
    cells_across: int | None = None,
) -> SplinedModel:
    """Calibrate the splined model from the poses that the stereo calibration used.

    ``cells_across``: cells of each displacement field across its image; by default
    ``unknowns.CELLS_ACROSS``. Raises InputError where poses lack an axis, and CalibrationRejected
    where they contradict each other.
    """
    return SplinedModel(adjust_bundle(observations, stereo, progress, cells_across=cells_across))


def calibrate_projector(
    pair: SplinedModel, observations: Sequence[Observation], size: Size
) -> SplinedModel:
    """Calibrate the projector of two cameras, whose model is ``pair``, in their frame of reference:
    with the first camera, the board and its poses as they are there.

    ``observations``: those of both cameras; their ``light`` is of the projector, whose ``size`` is
    px. Its uncertainty is that of a camera and a projector calibrated from these poses alone.
    Raises CalibrationRejected where they do not determine the projector, and as
    ``calibrate_splined``.
    """
    bundle, used = pair.bundle, list[Observation]()
    for o in observations:
        if o.light is not None and o.name in bundle.poses and o.name not in bundle.excluded:
            points = bundle.numbered_points(o.name, o.points)
            used.append(replace(o.light, camera=o.camera, points=points))
    if not used:
        raise InputError("no target pose has patterns along both axes")
    at = [bundle.poses.index(o.name) for o in used]
    boards = map(rigid_transform, bundle.state.R_board[at], bundle.state.t_board[at])
    poses = {o.name: T for o, T in zip(used, boards, strict=True)}
    points = np.concatenate([move_points(poses[o.name], o.points) for o in used])
    pixels = np.concatenate([o.projector for o in used])
    seen = finite_rows(pixels)
    # what moved through the volume is one body, with points all over it
    solved = solve_device("projector", [points[seen]], [pixels[seen]], size, nominal_lens(size))
    (T,) = solved.poses
    rig = StereoRig(pair.pinholes.camera, solved.lens, T[:3, :3], T[:3, 3])
    start = replace(StereoModel.from_rig(rig), poses=poses)
    return SplinedModel(adjust_bundle(used, start, beside=bundle))
