"""Patterns of an axis as functions of the projector coordinate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.examination import limits
from slviewer.fringe.levels import find_common_range, longest_range
from slviewer.fringe.patterns import evaluate_bit
from slviewer.fringe.sequence import Axis, Frame, PatternSequence


@dataclass(frozen=True, eq=False)
class Atoms:
    """Values (k, u) float32 from 0, dark, to 1, bright, of the k frames of an axis at coordinates
    ``start_px + step_px * i``.

    ``frames`` (k,): their indices in the sequence; ``groups`` (k,): a number for all steps of one
    period, -1 for stripes and for even frames.
    """

    frames: list[int]
    groups: np.ndarray
    values: np.ndarray
    start_px: float
    step_px: float

    def at(self, coordinate: np.ndarray) -> np.ndarray:
        """Return the values (k, p) at coordinates (p,) px, interpolated."""
        place = (coordinate - self.start_px) / self.step_px
        place = np.clip(place, 0, self.values.shape[1] - 1.001)
        below = place.astype(int)
        part = (place - below).astype(np.float32)
        return self.values[:, below] * (1 - part) + self.values[:, below + 1] * part

    def displaced(self, motion_px: Sequence[float]) -> "Atoms":
        """Return the same of a pattern that is displaced by so many px in each of the frames."""
        place = np.arange(self.values.shape[1])
        shifts = np.array(motion_px) / self.step_px
        # between two steps of the table an edge of stripes would be blurred
        shifts = np.where(self.groups < 0, np.rint(shifts), shifts)
        moved = [
            np.interp(place + shift, place, values)
            for shift, values in zip(shifts, self.values, strict=True)
        ]
        return replace(self, values=np.array(moved, np.float32))

    def blurred(self, sigma_px: float) -> "Atoms":
        """Return the same with the edges of stripes blurred by a Gaussian of ``sigma_px``."""
        stripes = self.groups < 0
        if not sigma_px or not stripes.any():
            return self
        values, sigma = self.values.copy(), sigma_px / self.step_px
        values[stripes] = cv2.GaussianBlur(
            values[stripes], (0, 0), sigma, sigmaY=1e-3, borderType=cv2.BORDER_REPLICATE
        )
        return replace(self, values=values)

    def slope_at(self, coordinate: np.ndarray) -> np.ndarray:
        """Return the change (k, p) of the values per px at coordinates (p,) px."""
        return self.at(coordinate + 0.5) - self.at(coordinate - 0.5)


def tabulate_atoms(sequence: PatternSequence, axis: Axis) -> Atoms:
    """Tabulate the patterns of an axis over all coordinates that they distinguish."""
    frames = [i for i in sequence.select(axis) if sequence.frames[i].kind != "texture"]
    start, end, step = _find_range(sequence, axis)
    u = np.arange(start, end + step, step)
    values = [evaluate_frame(sequence, axis, sequence.frames[i], u) for i in frames]
    periods = sequence.periods_px(axis)
    kinds = [sequence.frames[i] for i in frames]
    groups = [periods.index(f.period_px) if f.kind == "phase" else -1 for f in kinds]
    return Atoms(frames, np.array(groups), np.stack(values).astype(np.float32), start, step)


def evaluate_frame(
    sequence: PatternSequence, axis: Axis, frame: Frame, u: np.ndarray
) -> np.ndarray:
    """Return the pattern of one frame, 0 to 1, at projector coordinates ``u`` px."""
    if frame.kind in ("white", "texture", "black"):
        return np.full(u.shape, float(frame.kind != "black"))
    if frame.kind == "phase":
        turns = u / frame.period_px + sequence.sign(axis) * frame.step / frame.steps
        return np.asarray(0.5 + 0.5 * np.cos(2 * np.pi * turns + sequence.offset_rad(axis)))
    half = frame.kind == "complementary"
    cells = (1 + half) * (u - sequence.origin_px(axis)) / sequence.gray_cell(axis)
    return evaluate_bit(sequence, frame, np.floor(cells).astype(np.int64)).astype(float)


def _find_range(sequence: PatternSequence, axis: Axis) -> tuple[float, float, float]:
    """Return the least and the largest coordinate that the patterns distinguish, and the step of
    the table, px."""
    periods, bits = sequence.periods_px(axis), len(sequence.find("gray", axis))
    extent = float(sequence.extent(axis)) if sequence.projector_size else inf
    if bits:
        cell = sequence.gray_cell(axis)
        step = periods[-1] / limits.STEPS_PER_PERIOD if periods else cell
        start = sequence.origin_px(axis) + step / 2  # edges are between two steps
        return start, start + min(2**bits * cell, limits.BEYOND_CODE * extent), step
    step = periods[-1] / limits.STEPS_PER_PERIOD
    if extent < inf:
        span = max(limits.BEYOND * extent, periods[0])
        start = -0.5 - (span - extent) / 2
        unambiguous = min(longest_range(periods), limits.FAR_BEYOND * extent)
        return start, start + max(span, unambiguous), step
    try:
        return -0.5, max(periods[0], find_common_range(periods)), step
    except InputError:
        return -0.5, periods[0], step
