"""From frames to a cloud in one pass over them, as fast as memory allows: for live scanning and for
many captures."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slviewer.calibration.pixelwise import MAX_EXTRAPOLATION, PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.fringe import kernels_spikes as spikes
from slviewer.fringe.decode import code_rules, grey_scale, pack_levels, pack_shifts
from slviewer.fringe.kernels_levels import Ladder
from slviewer.fringe.layout import Layout, axis_layout, check_stack, clip_level, white_level
from slviewer.fringe.levels import unambiguous_px
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.fringe.threshold import MIDDLE, fringe_mean
from slviewer.geometry.jit import read_only, run_rows
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction import onepass_kernels as kernels
from slviewer.reconstruction.cloud import Cloud


@dataclass(frozen=True)
class LightLevels:
    """Noise and light levels of a rig's frames: ``noise`` (a, b) and ``mean`` as returned by
    `measure_noise` and `fringe_mean`, and the grey level ``white`` at which the camera clips. They
    change with the camera's settings.
    """

    noise: tuple[float, float]
    mean: float
    white: float


@dataclass(frozen=True, eq=False)
class PassResult:
    """Maps of one pass on the camera's pixel grid; the next pass into the same arrays overwrites
    them.

    ``points`` (h, w, 3) float32 mm, NaN where invalid; ``phase`` (h, w) float32 rad, absolute, NaN
    where ``reason`` (uint8, a `fringe.phase.Reason`) is not VALID; ``sigma_z`` float32 mm, the
    depth's noise where there is a phase; ``modulation`` float32 grey levels; ``texture`` of the
    frames' dtype: the scene under white light. ``light`` is what the pixels were judged by.
    """

    axis: Axis
    model: str
    points: np.ndarray
    phase: np.ndarray
    reason: np.ndarray
    sigma_z: np.ndarray
    modulation: np.ndarray
    texture: np.ndarray
    light: LightLevels

    def cloud(self) -> Cloud:
        """Return the organised cloud; it shares this scan's arrays."""
        return Cloud(self.points, self.axis, self.model, self.sigma_z, self.texture)


@dataclass(frozen=True, eq=False)
class PassTask:
    """Description of the work that a device is prepared for: the ``shape`` (h, w) of a camera's
    frames, their layout, all ``frames`` that the axis is decoded from, whether the texture is the
    background of the fringes (``is_shaded``), and the calibration."""

    shape: tuple[int, int]
    axis: Axis
    layout: Layout
    frames: tuple[int, ...]
    ladder: Ladder
    depths: kernels.Depths | StereoRig
    is_shaded: bool


class OnePass:
    """Reconstruct the frames of one axis in one pass, by a pixelwise or a splined calibration, with
    prepared tables.

    The results are those of `fringe.decode.decode` and the model's ``points``. Raises InputError
    for other models, an axis that sequence or model lacks, and Gray code without phase steps.
    """

    def __init__(
        self, sequence: PatternSequence, model: PixelwiseModel | SplinedModel, axis: Axis
    ) -> None:
        self.sequence, self.model, self.axis = sequence, model, axis
        self._layout = one_pass_layout(self.sequence, self.axis)
        if self.axis not in self.model.axes:
            raise InputError(
                f"The {self.model.name} calibration has no axis {self.axis}: choose another axis."
            )
        if isinstance(self.model, PixelwiseModel):
            self._depths = _pixelwise(self.model, self.axis, self._layout.period_px)
        elif isinstance(self.model, SplinedModel):
            self._depths = _splined(self.model, self.axis, self._layout.period_px)
        else:
            raise InputError(
                f"A {self.model.name} calibration measures no cloud in one pass: use the pixelwise"
                " or the splined one."
            )
        self._texture = texture_frame(self.sequence)
        self._shifts = pack_shifts(self._layout)
        self._ladder = pack_levels(self._layout)
        self._lists = spikes.allocate_lists(self.shape)

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the frames that the calibration belongs to."""
        _, height, width = self._depths.c.shape
        return height, width

    def light(self, frames: np.ndarray) -> LightLevels:
        """Estimate noise and light levels of frames (n, h, w) from a sample of their pixels; of
        uint16 frames the largest grey level is searched in all of them."""
        self._check(frames)
        white = white_level(self.sequence, frames, self.sequence.select(self.axis))
        mean = fringe_mean(self._layout, frames) if self._layout.is_plain else MIDDLE
        return LightLevels(measure_noise(self._layout, frames, white), mean, white)

    def run(
        self, frames: np.ndarray, light: LightLevels | None = None, out: PassResult | None = None
    ) -> PassResult:
        """The scan of frames (n, h, w) uint8 or uint16, spikes repaired.

        ``light``: of earlier frames of the same rig; None measures it from these. ``out``: an
        earlier scan of frames like these, whose arrays are used again; None makes new ones.
        """
        scan = self.sweep(frames, light, out)
        self.repair_spikes(scan)
        return scan

    def sweep(
        self, frames: np.ndarray, light: LightLevels | None = None, out: PassResult | None = None
    ) -> PassResult:
        """Run the first pass over frames: every pixel by itself; each frame is read once."""
        frames, scan = self._begun(frames, light, out)
        deep = frames.dtype == np.uint16
        peaks = np.zeros(-(-self.shape[0] // kernels.ROWS) if deep else 0, np.int32)
        run_rows(
            kernels.sweep_rows,
            self.shape[0],
            read_only(frames),
            self._shifts,
            self._ladder,
            code_rules(self._layout, scan.light.mean),
            grey_scale(self._layout, scan.light.noise, scan.light.white),
            self._depths,
            _collect_maps(scan),
            self._texture,
            np.array(self.sequence.select(self.axis)),
            peaks,
            multiple=kernels.ROWS,
        )
        # a camera may turn out to have more bits than it seemed
        if (
            deep
            and clip_level(frames.dtype, int(peaks.max()), self.sequence.full_scale)
            > scan.light.white
        ):
            return self.sweep(frames, self.light(frames), scan)
        return scan

    def repair_spikes(self, scan: PassResult) -> None:
        """The second pass, over few pixels: spikes of one period are moved, lonely and outside
        pixels masked."""
        rules, maps = spikes.spike_rules(self._layout), _collect_maps(scan)
        columns, words, counts = self._lists
        if rules.is_plain:
            spikes.list_changes(scan.phase, rules, False, columns, words, counts)
            spikes.move_phases(columns, words, counts, scan.phase)
            kernels.measure_moved(columns, words, counts, self._depths, maps)
        spikes.list_changes(scan.phase, rules, True, columns, words, counts)
        spikes.mask_phases(columns, words, counts, scan.phase, scan.reason)
        kernels.mask_points(columns, counts, maps)

    def _check(self, frames: np.ndarray) -> None:
        """Raise InputError unless the frames (n, h, w) fit the sequence and the calibrated
        resolution."""
        check_stack(self.sequence, frames)
        if frames.shape[1:] != self.shape:
            height, width = self.shape
            raise InputError(
                f"Frames of {frames.shape[2]}x{frames.shape[1]} px were given, and the camera was"
                f" calibrated at {width}x{height}: use captures of the same camera, at the same"
                " resolution and without cropping."
            )

    def _empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """Return an uninitialised array."""
        return np.empty(shape, dtype)

    def _begun(
        self, frames: np.ndarray, light: LightLevels | None, out: PassResult | None
    ) -> tuple[np.ndarray, PassResult]:
        """Return the checked, contiguous frames and the arrays to write into."""
        self._check(frames)
        frames = np.ascontiguousarray(frames)
        light = light or self.light(frames)
        scan = self._allocate(frames.dtype, light) if out is None else replace(out, light=light)
        if scan.texture.dtype != frames.dtype or scan.points.shape[:2] != self.shape:
            raise InputError(
                "The arrays to write into belong to other frames: leave them out, and new ones are"
                " made."
            )
        return frames, scan

    def _allocate(self, dtype: np.dtype, light: LightLevels) -> PassResult:
        """Return a result with uninitialised arrays of the camera's size, the texture of
        ``dtype``."""
        phase, sigma_z, modulation = (self._empty(self.shape, np.float32) for _ in range(3))
        points, reason = (
            self._empty((*self.shape, 3), np.float32),
            self._empty(self.shape, np.uint8),
        )
        texture = self._empty(self.shape, dtype)
        return PassResult(
            self.axis, self.model.name, points, phase, reason, sigma_z, modulation, texture, light
        )


def one_pass_layout(sequence: PatternSequence, axis: Axis) -> Layout:
    """The layout of one axis. Raises InputError for a sequence that takes more than one pass to
    decode."""
    layout = axis_layout(sequence, axis)
    if not layout.shifts:
        what = "Gray code without phase steps"
    elif layout.numbers_cells:
        what = "Gray code whose cells are not the periods of one phase shift"
    elif np.isfinite(unambiguous_px(layout)):
        what = "A relative phase"
    else:
        return layout
    raise InputError(f"{what} is not measured in one pass: decode and reconstruct it")


def _collect_maps(scan: PassResult) -> kernels.Maps:
    """Return the arrays of a result as the compiled kernels take them."""
    return kernels.Maps(
        scan.phase, scan.reason, scan.modulation, scan.points, scan.sigma_z, scan.texture
    )


def texture_frame(sequence: PatternSequence) -> int:
    """The frame that shows the scene under white light, or -1."""
    kinds = [frame.kind for frame in sequence.frames]
    return next((kinds.index(kind) for kind in ("texture", "white") if kind in kinds), -1)


def _pixelwise(model: PixelwiseModel, axis: Axis, period_px: float) -> kernels.Depths:
    """Return a pixelwise model's coefficients about the middle of all phases, where float32
    represents depths to some 1e-5 mm."""
    fit = model.fits[axis]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        low, high = fit.phase_min.astype(float), fit.phase_max.astype(float)
        is_calibrated = np.isfinite(low) & np.isfinite(high)
        middle = float(np.median(0.5 * (low + high)[is_calibrated])) if is_calibrated.any() else 0.0
        margin = MAX_EXTRAPOLATION * (high - low)
        bounds = np.stack([low - margin - middle, high + margin - middle]).astype(np.float32)
        c0, c1, c2, c3, c4 = fit.coefficients
        scale = 1 + c2 * middle
        c = np.stack([(c0 + c1 * middle) / scale, c1 / scale, c2 / scale, c3, c4]).astype(
            np.float32
        )
    grid = np.empty((0, 0, 0), np.float32)
    return kernels.Depths(c, period_px / model.periods_px[axis], middle, bounds, grid, 1, 0.0, 0.0)


def _splined(model: SplinedModel, axis: Axis, period_px: float) -> kernels.Depths:
    """Return a splined model's compiled coefficients; pixels outside the calibrated region are
    masked."""
    fast = model.fast_axis(axis)
    c = np.concatenate([fast.coefficients, model.single_rays])
    per_mm = (fast.supported_grid.shape[2] - 1) / (fast.far - fast.near)
    bounds = np.empty((2, 0, 0), np.float32)
    return kernels.Depths(
        c,
        period_px / (2 * np.pi),
        fast.centre,
        bounds,
        fast.supported_grid,
        fast.step,
        fast.near,
        per_mm,
    )
