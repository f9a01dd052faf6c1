"""Rendering of the images that the projector shows."""

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis, Frame, PatternSequence


def render_pattern(sequence: PatternSequence, index: int) -> np.ndarray:
    """Render frame ``index`` as the projector shows it: (height, width) uint8."""
    width, height = sequence.projector
    axis, row = profile(sequence, index)
    shown = row[:, None] if axis == "y" else row[None, :]
    return np.ascontiguousarray(np.broadcast_to(shown, (height, width)))


def profile(sequence: PatternSequence, index: int) -> tuple[Axis | None, np.ndarray]:
    """Return the axis along which frame ``index`` varies, and its uint8 grey levels along it.

    A frame without an axis gives (None, one level per projector column). Cosines span 0 ... 255,
    bits are 0 or 255. Where the sequence has a table of `levels`, it is applied to the cosines.
    """
    if not 0 <= index < len(sequence.frames):
        raise InputError(f"frame {index} of {len(sequence.frames)} does not exist", "count from 0")
    frame = sequence.frames[index]
    if frame.axis is None or frame.kind in ("white", "black", "texture"):
        return None, np.full(sequence.projector[0], 0 if frame.kind == "black" else 255, np.uint8)
    if frame.kind == "phase":
        u = np.arange(sequence.extent(frame.axis), dtype=np.float64)
        turns = u / frame.period_px + sequence.sign(frame.axis) * frame.step / frame.steps
        angle = 2 * np.pi * turns + sequence.offset_rad(frame.axis)
        cosine = np.floor(127.5 + 127.5 * np.cos(angle) + 0.5).astype(np.uint8)
        return frame.axis, (
            cosine if sequence.levels is None else np.array(sequence.levels, np.uint8)[cosine]
        )
    return frame.axis, np.where(_compute_gray_bit(sequence, frame.axis, frame), 255, 0).astype(
        np.uint8
    )


def _compute_gray_bit(sequence: PatternSequence, axis: Axis, frame: Frame) -> np.ndarray:
    """Return the Gray bit, (extent,) bool, at the centre of each projector column or row. Raises
    InputError."""
    bits = len(sequence.find("gray", axis))
    cell, origin = sequence.gray_cell(axis), sequence.origin_px(axis)
    half = frame.kind == "complementary"
    # A column belongs to the cell that holds its left edge plus half a pixel, less the origin's own
    # half.
    u = np.arange(sequence.extent(axis), dtype=np.float64) - origin - 0.5
    code = np.floor((2 if half else 1) * u / cell + 1e-9).astype(np.int64)
    if code.min() < 0 or code.max() >= 1 << (bits + half):
        raise InputError(
            f"{bits} Gray bits cannot number {sequence.extent(axis)} px from {origin:g} px on in"
            f" cells of {cell:g} px",
            "use more bits, or the origin -0.5",
        )
    return evaluate_bit(sequence, frame, code)


def evaluate_bit(sequence: PatternSequence, frame: Frame, code: np.ndarray) -> np.ndarray:
    """Return whether a frame of a code is bright, bool, in the cells of these numbers, int; of a
    complementary one the cells are half as wide."""
    assert frame.axis is not None
    is_half = frame.kind == "complementary"
    place = 0 if is_half else len(sequence.find("gray", frame.axis)) - 1 - frame.bit
    shown = code if sequence.binary else code ^ (code >> 1)
    return np.asarray((shown >> place) & 1 == (frame.kind != "inverse"))
