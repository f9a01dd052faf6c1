"""From frames to a cloud in one pass over them, as fast as memory allows: for live scanning and for
many captures."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.pixelwise import MAX_EXTRAPOLATION, PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe import kernels_spikes as spikes
from slviewer.fringe.decode import code_rules, grey_scale, pack_levels, pack_shifts
from slviewer.fringe.layout import Layout, axis_layout, check_stack, clip_level, white_level
from slviewer.fringe.levels import unambiguous_px
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.fringe.threshold import MIDDLE, fringe_mean
from slviewer.geometry import cuda_device
from slviewer.geometry.jit import read_only, run_rows
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import check_map
from slviewer.reconstruction import onepass_kernels as kernels
from slviewer.reconstruction.cloud import Cloud

Fast = PixelwiseModel | SplinedModel | StereoModel


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

    @property
    def maps(self) -> kernels.Maps:
        """The arrays as the compiled kernels take them."""
        return kernels.Maps(*(getattr(self, name) for name in kernels.Maps._fields))

    def cloud(self) -> Cloud:
        """Return the organised cloud; it shares this scan's arrays."""
        return Cloud(self.points, self.axis, self.model, self.sigma_z, self.texture)


class OnePass:
    """Reconstruct the frames of one axis in one pass, by a pixelwise or a splined calibration, with
    prepared tables.

    The results are those of `fringe.decode.decode` and the model's ``points``. Raises InputError
    for other models, an axis that sequence or model lacks, and Gray code without phase steps.

    ``shape``: (h, w) of the frames that the calibration belongs to; ``frames``: those that the axis
    is decoded from; ``texture``: the one that shows the scene under white light, or -1; ``depths``:
    the calibration as the kernels take it.
    """

    def __init__(self, sequence: PatternSequence, model: Fast, axis: Axis) -> None:
        self.sequence, self.model, self.axis = sequence, model, axis
        self.layout = one_pass_layout(sequence, axis)
        if axis not in model.axes:
            raise InputError(
                f"The {model.name} calibration has no axis {axis}", "choose another axis."
            )
        self.depths, self.shape = self._pack_depths()
        kinds = [frame.kind for frame in sequence.frames]
        white = (kinds.index(kind) for kind in ("texture", "white") if kind in kinds)
        self.frames, self.texture = sequence.select(axis), next(white, -1)
        self._shifts, self.ladder = pack_shifts(self.layout), pack_levels(self.layout)
        self._lists = spikes.allocate_lists(self.shape)
        self._marks = spikes.allocate_marks(self.shape)

    def _pack_depths(self) -> tuple[kernels.Depths | StereoRig, tuple[int, int]]:
        """Return the calibration as the kernels take it, and the size (h, w) of its frames."""
        if isinstance(self.model, PixelwiseModel):
            depths = _pixelwise(self.model, self.axis, self.layout.period_px)
        elif isinstance(self.model, SplinedModel):
            depths = _splined(self.model, self.axis, self.layout.period_px)
        else:
            raise InputError(
                f"A {self.model.name} calibration measures no cloud in one pass",
                "use the pixelwise or the splined one.",
            )
        _, height, width = depths.c.shape
        return depths, (height, width)

    def light(self, frames: np.ndarray) -> LightLevels:
        """Estimate noise and light levels of frames (n, h, w) from a sample of their pixels; of
        uint16 frames the largest grey level is searched in all of them."""
        self._check(frames)
        white = white_level(self.sequence, frames, self.frames)
        mean = fringe_mean(self.layout, frames) if self.layout.is_plain else MIDDLE
        return LightLevels(measure_noise(self.layout, frames, white), mean, white)

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
            self.ladder,
            code_rules(self.layout, scan.light.mean),
            grey_scale(self.layout, scan.light.noise, scan.light.white),
            self.depths,
            scan.maps,
            self.texture,
            np.array(self.frames),
            peaks,
            multiple=kernels.ROWS,
        )
        # a camera may turn out to have more bits than it seemed
        if deep and (higher := self._raise_white(frames, scan, int(peaks.max()))):
            return self.sweep(frames, higher, scan)
        return scan

    def repair_spikes(self, scan: PassResult) -> None:
        """The second pass, over few pixels: spikes of one period are moved, lonely and outside
        pixels masked."""
        rules, maps = spikes.spike_rules(self.layout), scan.maps
        (columns, words, counts), marks = self._lists, self._marks
        if rules.is_plain:
            spikes.list_changes(scan.phase, rules, False, marks, columns, words, counts)
            spikes.move_phases(columns, words, counts, scan.phase, marks)
            kernels.measure_moved(columns, words, counts, self.depths, maps)
        spikes.list_changes(scan.phase, rules, True, marks, columns, words, counts)
        spikes.mask_phases(columns, words, counts, scan.phase, scan.reason)
        kernels.mask_points(columns, counts, maps)

    def _check(self, frames: np.ndarray) -> None:
        """Raise InputError unless the frames (n, h, w) fit the sequence and the calibrated
        resolution."""
        check_stack(self.sequence, frames)
        check_map(self.shape[::-1], frames[0], "grey levels")

    def _raise_white(self, frames: np.ndarray, scan: PassResult, peak: int) -> LightLevels | None:
        """Return the light of frames whose largest grey level shows that the camera clips above the
        white of the scan's; None where it does not."""
        white = scan.light.white
        if peak <= white or clip_level(frames.dtype, peak, self.sequence.full_scale) <= white:
            return None
        light = self.light(frames)
        return light if light.white > white else None

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
                "The arrays to write into belong to other frames",
                "leave them out, and new ones are made.",
            )
        return frames, scan

    def _allocate(self, dtype: np.dtype, light: LightLevels) -> PassResult:
        """Return a result with uninitialised arrays of the camera's size, the texture of
        ``dtype``."""
        single = np.float32
        points = cuda_device.allocate_frames((*self.shape, 3), single)
        phase, reason, sigma_z, modulation, texture = (
            cuda_device.allocate_frames(self.shape, kind)
            for kind in (single, np.uint8, single, single, dtype)
        )
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
    raise InputError(f"{what} is not measured in one pass", "decode and reconstruct it")


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
    bounds, gain = np.empty((2, 0, 0), np.float32), period_px / (2 * np.pi)
    grid = fast.supported_grid
    return kernels.Depths(c, gain, fast.centre, bounds, grid, fast.step, fast.near, per_mm)
