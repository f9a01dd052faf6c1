"""Frame indices of one axis' pattern in a stack, and the conventions of its sequence."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.fringe.plateau import find_plateau
from slviewer.fringe.sequence import Axis, Indices, PatternSequence

WHITE_LEVELS = (255, 1023, 4095, 16383, 65535)
"""Full scale of the cameras whose grey levels arrive as uint16."""
LEFT_ALIGNED_WHITE = (65472, 65520, 65532)
"""Full scale of 10, 12 and 14 bits that fill a uint16 from its top."""
SAMPLED_ROWS, SAMPLED_PIXELS = 24, 4000
"""Of the phase steps, in which a plateau below full scale is searched."""
PREVIEWED = 400
"""Rows and columns of a single image in which it is searched."""
SAME_WIDTH = 1e-6
"""Relative difference up to which a Gray cell is a fringe period: over a thousand cells they part
by a hundredth px."""


@dataclass(frozen=True)
class Shift:
    """Period (px) of a phase shift, and the indices of its frames by step."""

    period_px: float
    indices: Indices


@dataclass(frozen=True)
class Layout:
    """Frame indices of one axis, and the conventions of its sequence.

    ``extent`` is that of the projector in px, infinite where its size is not known. ``shifts``
    longest period first; ``gray`` most significant bit first; ``inverse`` like ``gray``, or empty.
    ``relative``: whether a phase that is not absolute is acceptable. ``binary``: as in the
    sequence.
    """

    axis: Axis
    extent: float
    sign: int
    gray_origin_px: float
    shifts: tuple[Shift, ...]
    gray: Indices
    inverse: Indices
    complementary: int | None
    white: int | None
    black: int | None
    offset_rad: float = 0.0
    gray_cell_px: float = 1.0
    relative: bool = False
    binary: bool = False

    @property
    def period_px(self) -> float:
        """Finest period, px; the width of a cell for Gray code alone."""
        return self.shifts[-1].period_px if self.shifts else self.gray_cell_px

    @property
    def numbers_periods(self) -> bool:
        """Whether Gray bits number the periods of the one phase shift, edge to edge."""
        if len(self.shifts) != 1 or not self.gray:
            return False
        return abs(self.gray_cell_px - self.period_px) <= SAME_WIDTH * self.period_px

    @property
    def is_plain(self) -> bool:
        """Whether the order comes from a plain Gray code, whose edges coincide with the wraps of
        the phase."""
        return self.numbers_periods and self.complementary is None

    @property
    def numbers_cells(self) -> bool:
        """Whether Gray bits beside phase shifts number cells that are not a single shift's
        periods."""
        return bool(self.shifts and self.gray) and not self.numbers_periods

    @property
    def steps(self) -> int:
        """Number of phase steps of the finest period; 0 for Gray code alone."""
        return len(self.shifts[-1].indices) if self.shifts else 0

    @property
    def origin_rad(self) -> float:
        """Phase of the finest period, rad, at which Gray code 0 begins."""
        return 2 * np.pi * self.gray_origin_px / self.period_px


def axis_layout(sequence: PatternSequence, axis: Axis) -> Layout:
    """Return the layout of one axis. Raises InputError where its frames cannot give an absolute
    phase."""
    if axis not in sequence.axes:
        there = (
            f"use axis {sequence.axes[0]}"
            if sequence.axes
            else "phase steps or Gray bits are needed"
        )
        raise InputError(f"no frame carries a pattern along axis {axis}", there)
    shifts = tuple(Shift(*shift) for shift in sequence.phase_shifts(axis))
    complementary, white, black = (
        next(iter(sequence.find(kind, axis)), None) for kind in ("complementary", "white", "black")
    )
    layout = Layout(
        axis,
        np.inf if sequence.projector_size is None else sequence.extent(axis),
        sequence.sign(axis),
        sequence.origin_px(axis),
        shifts,
        sequence.bits("gray", axis),
        sequence.bits("inverse", axis),
        complementary,
        white,
        black,
        sequence.offset_rad(axis),
        sequence.gray_cell(axis),
        sequence.relative or sequence.projector_size is None,
        sequence.binary,
    )
    if sequence.binary and shifts:
        raise InputError(
            "plain binary numbers beside phase steps are not decoded: several of their bits change"
            " at the same place",
            "project Gray code",
            f"axis {axis}",
        )
    if not (shifts or layout.inverse or None not in (white, black)):
        raise InputError(
            "Gray code alone needs its inverses, or a white and a black frame",
            "add them",
            f"axis {axis}",
        )
    if layout.gray or complementary is not None:
        _check_code(layout)
    return layout


def check_stack(sequence: PatternSequence, stack: np.ndarray) -> None:
    """Raise InputError unless the stack is (n, h, w) uint8 or uint16 with one frame for each of the
    sequence."""
    if not isinstance(stack, np.ndarray):
        sizes = sorted({np.shape(frame) for frame in stack})
        raise InputError(
            f"the frames are not one array (their shapes: {sizes})", "stack frames of one size"
        )
    if stack.ndim != 3 or 0 in stack.shape:
        raise InputError(
            f"the stack has shape {stack.shape}", "give (frames, rows, columns), one channel"
        )
    if stack.dtype not in (np.uint8, np.uint16):
        raise InputError(f"the frames hold {stack.dtype} values", "give uint8 or uint16")
    if len(stack) != len(sequence.frames):
        raise InputError(
            f"{len(stack)} frames for a sequence of {len(sequence.frames)}",
            "give one image for each frame",
        )


def white_level(sequence: PatternSequence, stack: np.ndarray, indices: Sequence[int]) -> float:
    """Return the grey level at which the camera clips: `clip_level` of these frames of a capture
    (n, h, w), or the level below it at which its phase steps show a plateau.

    Raises InputError for frames that contradict the full scale that the sequence states.
    """
    stated = sequence.full_scale
    largest = (
        0
        if stack.dtype == np.uint8 and stated in (None, 255)
        else max(int(stack[i].max()) for i in indices)
    )
    if stated is not None and not largest <= stated <= np.iinfo(stack.dtype).max:
        raise InputError(
            f"full_scale is stated as {stated}, and the frames are {stack.dtype} and reach"
            f" {largest}",
            "correct it in the description of the images or in the driver of the camera, then"
            " import or capture again",
        )
    full_scale = clip_level(stack.dtype, largest, stated)
    steps = sample_phase_steps(sequence, stack)
    return find_plateau(steps, full_scale) or full_scale


def lowest_white(sequence: PatternSequence, samples: Sequence[np.ndarray]) -> int | None:
    """Return the level at which the camera clips by the `sample_phase_steps` of a capture's
    exposures: the lowest plateau below full scale, else the stated full scale."""
    largest = max(int(steps.max(initial=0)) for steps in samples)
    full_scale = clip_level(samples[0].dtype, largest, sequence.full_scale)
    found = [find_plateau(steps, full_scale) for steps in samples]
    plateaus = [int(level) for level in found if level]
    return min(plateaus, default=sequence.full_scale)


def sample_phase_steps(sequence: PatternSequence, frames: np.ndarray) -> np.ndarray:
    """Return the levels (k, p) of evenly spread pixels in the k phase steps of frames (n, h, w)."""
    steps = [i for i, frame in enumerate(sequence.frames) if frame.kind == "phase"]
    height, width = frames[0].shape
    rows = np.unique(np.linspace(0, height - 1, min(SAMPLED_ROWS, height)).astype(int))
    every = max(1, len(rows) * width // SAMPLED_PIXELS)
    samples = [frames[i][rows, ::every].ravel() for i in steps]
    return np.stack(samples) if samples else np.zeros((0, 0), frames[0].dtype)


def image_white(image: np.ndarray, full_scale: int | None = None) -> float:
    """Return the grey level at which the camera clips by one image (h, w) alone; ``full_scale`` as
    in `clip_level`."""
    clipped = clip_level(image.dtype, int(image.max(initial=0)), full_scale)
    rows, columns = (max(1, size // PREVIEWED) for size in image.shape)
    return find_plateau(image[::rows, ::columns].reshape(1, -1), clipped) or clipped


def clip_level(dtype: np.dtype, largest: int, full_scale: float | None = None) -> float:
    """Return the grey level at which a camera clips: ``full_scale`` where it is stated, 255 for
    uint8, for uint16 the full scale of the bit depth that ``largest``, the largest grey level in
    the frames, needs.
    """
    if full_scale is not None:
        return float(full_scale)
    if dtype == np.uint8:
        return 255.0
    if largest in LEFT_ALIGNED_WHITE:
        return float(largest)
    return float(next(level for level in WHITE_LEVELS if level >= largest))


def to_eight_bits(
    image: np.ndarray, full_scale: float | None = None, largest: int | None = None
) -> NDArray[np.uint8]:
    """Convert an image (h, w) or (h, w, 3), uint8 or uint16, to uint8: the upper eight of the
    camera's bits.

    ``full_scale`` as in `clip_level`; ``largest``: the largest grey level of the frame that the
    image is a part of, None: its own.
    """
    if image.dtype == np.uint8:
        return image
    white = int(
        clip_level(
            image.dtype, int(image.max(initial=0)) if largest is None else largest, full_scale
        )
    )
    shift = max(white.bit_length() - 8, 0)
    if white >> shift < 255:  # not all bits are used
        return np.asarray(cv2.convertScaleAbs(image, alpha=255 / white), np.uint8)
    return np.minimum(image >> shift, 255).astype(np.uint8)


def _check_code(layout: Layout) -> None:
    """Raise InputError where the Gray bits cannot number the whole axis."""
    where = f"axis {layout.axis}"
    if not layout.gray:
        raise InputError("a complementary bit without Gray bits says nothing", "add them", where)
    if layout.extent == np.inf:
        return
    cells = (layout.extent - 0.5 - layout.gray_origin_px) / layout.gray_cell_px
    if 2 ** len(layout.gray) < cells - 0.5:
        what = "periods" if layout.numbers_periods else f"cells of {layout.gray_cell_px:g} px"
        raise InputError(
            f"{len(layout.gray)} Gray bits number {2 ** len(layout.gray)} {what}, and"
            f" {layout.extent:g} px hold {cells:.0f}",
            "give the fringe period, gray_cell_px and the size of the projector that were used, or"
            " the missing bits",
            where,
        )
