"""Stereo with a correction for each camera pixel, anchored to the board poses of the calibration.

The Letter's pixels learn depth from planes that stereo itself reconstructed, and its rational form is biased outside
the calibrated depths. Here a pixel's ray meets the board plane of the calibration's pose, stereo says which projector
coordinate belongs there, and what the measured one lacks is a quadratic in the coordinate, ``e = a0 + a1 s + a2 s^2``,
added before stereo's exact inversion. To first order that is the rational family, without its bias. A Gaussian prior
on (a0, a1, a2), estimated from all pixels, holds those that saw few poses.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange

from slviewer.calibration.correction import MIN_POSES, QuadraticSums
from slviewer.calibration.observe import AXES, Observation
from slviewer.calibration.pixelwise import best_axis
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import depth_per_px, points_from_depth, triangulate

REACH = 1.5
"""How far beyond the coordinates it was calibrated with, in lengths of their range, a pixel still measures."""
FADING = 0.75
"""How far beyond them, in half lengths of the calibrated depths, a correction goes on to change: neighbouring parts of
a lens err alike, and distant ones do not."""
PLANE_ROUNDS = 3
PLANE_PIXELS = 8_000
"""Pixels by which the planes are laid; more do not move them."""


@dataclass(frozen=True)
class Correction:
    """One axis: ``coefficients`` (3, h, w) float32 px, a0 ... a2 of ``s = (c - centre)/half``; NaN where no pose was
    seen.

    c is the measured projector coordinate in px; ``centre`` and ``half`` (h, w) put the calibrated depths at -1 ... 1.
    ``poses`` (h, w) uint16; ``least`` and ``most`` (h, w) px, the coordinates a pixel saw; ``rms_px`` (h, w) what the
    correction leaves over. ``prior`` (3, 3) px^2 is the coefficients' covariance over the pixels, ``noise_px`` the
    standard deviation of one pose's e.
    """

    coefficients: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    poses: np.ndarray
    least: np.ndarray
    most: np.ndarray
    rms_px: np.ndarray
    prior: np.ndarray
    noise_px: float


@dataclass(frozen=True)
class AnchoredModel:
    """Stereo's ``rig``, and each pixel's correction of the projector coordinate by axis.

    Corrections are in projector px, so that captures of any fringe period are measured alike.
    """

    rig: StereoRig
    corrections: Mapping[Axis, Correction]

    name = "anchored"

    @property
    def axes(self) -> tuple[Axis, ...]:
        return tuple(self.corrections)

    def points(self, phase: PhaseMap) -> np.ndarray:
        """(h, w, 3) float32 mm; NaN where the phase is invalid, no pose was seen, or too far from those that were."""
        c = self.corrections[phase.axis]
        corrected = np.empty(phase.phase.shape)
        per_rad = phase.period_px / (2 * np.pi)
        _correct(phase.phase, per_rad, c.coefficients, c.centre, c.half, c.least, c.most, REACH, FADING, corrected)
        z = triangulate(self.rig, corrected, phase.axis)
        return points_from_depth(self.rig.camera.rays(), z)

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise; the correction's own slope is some thousandths."""
        per_px = depth_per_px(self.rig, phase.axis, points[..., 2].astype(float))
        return (per_px * (phase.period_px / (2 * np.pi)) * phase.sigma_phase).astype(np.float32)

    def median_rms_px(self, axis: Axis) -> float:
        """What the corrections leave over, in projector px: the median over the pixels."""
        return float(np.nanmedian(self.corrections[axis].rms_px))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat named arrays, for saving."""
        keys = Correction.__annotations__
        return {f"{axis}_{key}": np.asarray(getattr(c, key)) for axis, c in self.corrections.items() for key in keys}

    def to_dict(self) -> dict[str, Any]:
        """What is not an array, JSON-able."""
        return {"rig": self.rig.to_dict(), "axes": list(self.axes)}

    @classmethod
    def restored(cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "AnchoredModel":
        """The inverse of ``to_dict`` and ``to_arrays``."""
        corrections = {}
        for axis in data["axes"]:
            values: dict[str, Any] = {key: arrays[f"{axis}_{key}"] for key in Correction.__annotations__}
            corrections[axis] = Correction(**values | {"noise_px": float(values["noise_px"])})
        return cls(StereoRig.from_dict(data["rig"]), corrections)


def calibrate_anchored(
    observations: Sequence[Observation],
    stereo: StereoModel,
    poses: Mapping[str, np.ndarray] | None = None,
    progress: Callable[[float], None] | None = None,
) -> AnchoredModel:
    """Each pixel's correction for each captured axis, from the poses that the stereo calibration used.

    ``poses`` map board to camera (4, 4): a better calibration's, where there is one; by default stereo's own. Each
    board's tilt and depth are then refined until its pixels agree with those of the other poses. Raises
    CalibrationRejected when no pixel saw the board in at least 4 poses.
    """
    poses = stereo.poses if poses is None else poses
    used = [o for o in observations if o.name in poses]
    if stereo.depth_range_mm is None:
        raise CalibrationRejected("the stereo calibration was made elsewhere, without poses to anchor pixels to")
    if len(used) < MIN_POSES:
        raise CalibrationRejected(
            f"{len(used)} usable poses, and a pixel needs at least {MIN_POSES}: capture the board in more positions"
        )
    axes: list[Axis] = [axis for axis in stereo.axes if all(axis in o.surfaces for o in used)]
    planes = {o.name: poses[o.name][:3, 2] / (poses[o.name][:3, 2] @ poses[o.name][:3, 3]) for o in used}
    planes = _refined(used, stereo, planes, best_axis(used, stereo))
    corrections: dict[Axis, Correction] = {}
    for k, axis in enumerate(axes):
        grid = _Grid.of(stereo, axis)
        sums = QuadraticSums(grid.centre, grid.half)
        for i, o in enumerate(used):
            u0, v0, u1, v1 = o.box
            expected = grid.expected(planes[o.name], (slice(v0, v1), slice(u0, u1)))
            sums.add(_measured(o, axis), expected, (v0, u0))
            if progress:
                progress((k + (i + 1) / len(used)) / len(axes))
        found = sums.solve()
        corrections[axis] = Correction(
            found.coefficients, grid.centre, grid.half, sums.poses, sums.least, sums.most,
            found.rms_px, found.prior, found.noise_px,
        )  # fmt: skip
    return AnchoredModel(stereo.rig, corrections)


@dataclass(frozen=True)
class _Grid:
    """Every so many pixels of the camera, and what stereo expects along one axis where their rays meet a plane.

    Planes are (3,) vectors p with ``p . (x/z, y/z, 1) = 1/z``, per mm. ``rays`` (h, w, 2); ``centre`` and ``half``
    (h, w) float32 px put the coordinates at the calibrated depths at -1 ... 1.
    """

    rig: StereoRig
    axis: Axis
    rays: np.ndarray
    centre: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, stereo: StereoModel, axis: Axis, step: int = 1) -> "_Grid":
        assert stereo.depth_range_mm is not None
        rays = stereo.rig.camera.rays()[step // 2 :: step, step // 2 :: step]
        near, far = (
            stereo.rig.project(np.dstack([rays * z, np.full(rays.shape[:2], z)]))[..., AXES.index(axis)]
            for z in stereo.depth_range_mm
        )
        centre, half = ((near + far) / 2).astype(np.float32), ((near - far) / 2).astype(np.float32)
        return cls(stereo.rig, axis, rays, centre, half)

    def expected(self, plane: np.ndarray, part: tuple[slice, slice] = (slice(None), slice(None))) -> np.ndarray:
        """(h', w') px."""
        rays = self.rays[part]
        with np.errstate(divide="ignore"):
            z = 1 / (rays @ plane[:2] + plane[2])
        return self.rig.project(np.dstack([rays * z[..., None], z]))[..., AXES.index(self.axis)]


def _measured(o: Observation, axis: Axis) -> np.ndarray:
    """(h', w') float64 px over the observation's box: the smoothed projector coordinate."""
    return o.smoothed_phase(axis) * (o.periods_px[axis] / (2 * np.pi))


def _refined(
    used: Sequence[Observation], stereo: StereoModel, planes: Mapping[str, np.ndarray], axis: Axis
) -> dict[str, np.ndarray]:
    """The planes of all poses, tilted and moved so that what the pixels' corrections leave over is least.

    A pose that stereo places some micrometres off shows in all of its pixels alike, and no pixel's own quadratic can
    tell that from noise. What all poses share stays as stereo has it.
    """
    width, height = used[0].size
    step = max(1, round((width * height / PLANE_PIXELS) ** 0.5))
    grid = _Grid.of(stereo, axis, step)
    rays = np.dstack([grid.rays, np.ones(grid.rays.shape[:2])])
    measured = {}
    for o in used:
        u0, v0, u1, v1 = o.box
        whole = np.full((height, width), np.nan)
        whole[v0:v1, u0:u1] = _measured(o, axis)
        measured[o.name] = whole[step // 2 :: step, step // 2 :: step]
    planes = dict(planes)
    for _ in range(PLANE_ROUNDS):
        sums = QuadraticSums(grid.centre, grid.half)
        expected = {name: grid.expected(planes[name]) for name in measured}
        for name, c in measured.items():
            sums.add(c, expected[name], (0, 0))
        a0, a1, a2 = sums.solve().coefficients
        for name, c in measured.items():
            s = (c - grid.centre) / grid.half
            left = expected[name] - c - (a0 + s * (a1 + s * a2))
            nudge = np.array([0.0, 0.0, 1e-8])
            slope = (grid.expected(planes[name] + nudge) - expected[name]) / nudge[2]
            told = np.isfinite(left) & np.isfinite(slope) & (sums.poses >= MIN_POSES)
            if np.count_nonzero(told) > 30:
                planes[name] = planes[name] - _least_absolute(slope[told][:, None] * rays[told], left[told])
    return planes


def _least_absolute(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x (3,) of A x = b, (n, 3) and (n,), by Cauchy's weights."""
    weight = np.ones(len(b))
    for _ in range(4):
        x = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        off = b - A @ x
        weight = 1 / np.sqrt(1 + (off / max(3 * 1.4826 * float(np.median(np.abs(off))), 1e-9)) ** 2)
    return np.asarray(x)


@kernel(parallel=True)
def _correct(phase, per_rad, a, centre, half, least, most, reach, fading, out):  # type: ignore[no-untyped-def]
    for v in prange(phase.shape[0]):
        for u in range(phase.shape[1]):
            c = per_rad * np.float64(phase[v, u])
            low, high = np.float64(least[v, u]), np.float64(most[v, u])
            margin = reach * (high - low)
            if not (c >= low - margin and c <= high + margin):
                out[v, u] = np.nan
                continue
            seen = min(max(c, low), high)
            s = (seen - centre[v, u]) / half[v, u]
            if seen != c:
                s += fading * np.tanh((c - seen) / (half[v, u] * fading))
            out[v, u] = c + a[0, v, u] + s * (a[1, v, u] + s * a[2, v, u])
