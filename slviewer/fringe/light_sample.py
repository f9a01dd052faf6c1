"""Sample of the pixels from which the light of each frame is estimated."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.cosines import estimate_roughness, fit_cosine
from slviewer.fringe.layout import white_level
from slviewer.fringe.sequence import Indices, Kind, PatternSequence

ROWS, COLUMNS = 48, 88
"""Sampled rows and columns: rows enough for eight cycles of flicker, pixels enough to know a gain
to 0.1 %."""
AROUND = (-6, -3, 2, 5)
"""px: the interior of a Gray stripe has its own class at these distances, along rows and columns.
Narrower stripes are blurred, and have none."""
DECIDED = 0.3
"""Distance of a stripe's inside from its threshold, as a share of half the contrast."""
SHOWN = 0.03
"""Share of the pixels that must be bright in a Gray frame of an axis that was shown."""
MIN_PIXELS = 60
OFFSETS = np.linspace(-8, 8, 161)
"""Offsets, in modulations, of a bit without an inverse from the fringes' mean, due to room
light."""
SHARPER = (1.0, 1.25, 1.5, 2.0)
"""Distances, in modulations, of the bit's levels from that offset: blur reduces fringes more than
stripes."""
LEAST_OFFSET = 0.2
"""Of the modulation; blur and shading move a frame by less."""


@dataclass(frozen=True, eq=False)
class LightSample:
    """Samples (n, p) float32 grey levels of all n frames at p pixels.

    ``row`` and ``column`` (p,): position in the image, 0 to 1. ``shifts``: the frames of each phase
    shift, by step. ``coded``: the Gray, white and black frames (c,); ``interior`` and ``bright``
    (c, p) bool: where such a frame shows the interior of a stripe, and whether that is bright.
    ``partner`` (c,): for bits and inverses, the index in ``coded`` of the other, else -1.
    ``amplitudes`` (s, p): half of the projector's light, in grey levels, from each phase shift, or
    from the Gray code. ``roughness``: grey levels by which neighbours differ.
    """

    frames: np.ndarray
    row: np.ndarray
    column: np.ndarray
    shifts: tuple[Indices, ...]
    coded: Indices
    partner: Indices
    interior: np.ndarray
    bright: np.ndarray
    amplitudes: np.ndarray
    roughness: float

    def albedo(self, changes: Sequence[int]) -> np.ndarray:
        """Return grey levels (p,) in proportion to the albedo, from frames between which no light
        ``changes``."""
        if not self.shifts:
            return _compute_half_range(self.frames, self.coded, self.partner, changes)
        return self.amplitudes[steady_shift(self.shifts, changes)]


def sample_light(
    sequence: PatternSequence,
    stack: np.ndarray,
    gain: np.ndarray | None = None,
    *,
    coarse: bool = False,
) -> LightSample | None:
    """Sample the frames of a capture (n, h, w); None where too few pixels see the pattern
    unclipped.

    ``gain`` (n,): known gains of the frames, by which bits and inverses of unequal light are
    separated; ``coarse``: an eighth of the pixels.
    """
    height, width = stack.shape[1:]
    margin = max(map(abs, AROUND))
    if min(height, width) <= 2 * margin + 8:
        return None
    rows, columns = (
        np.unique(np.linspace(margin, size - 1 - margin, min(count, size)).astype(int))
        for size, count in (
            (height, ROWS // 2 if coarse else ROWS),
            (width, COLUMNS // 4 if coarse else COLUMNS),
        )
    )
    row, column = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    shifts = list_shifts(sequence)
    coded = tuple(i for i, f in enumerate(sequence.frames) if f.kind not in ("phase", "texture"))
    used = [*sum(shifts, ()), *coded]
    frames = np.zeros((len(stack), len(row)), np.float32)
    for i in used:
        frames[i] = stack[i][row, column]
    white = white_level(sequence, stack, used)
    run = columns[0] + np.arange(width - 2 * margin)
    smooth = np.stack([stack[i][rows[::4, None], run] for i in used[:4]]).astype(np.float32)
    rough = estimate_roughness(smooth, len(run))
    limit = max(limits.DARK_LEVELS * white / 255, limits.DARK_SIGMAS * rough)
    if shifts:
        amplitudes = np.stack([np.abs(fit_cosine(frames[list(shift)])[1]) for shift in shifts])
        pixel_counts = np.count_nonzero(amplitudes > limit, axis=1)
        if pixel_counts.max() < MIN_PIXELS:
            return None
        # excludes an axis that was not shown, or is out of view
        shown = np.flatnonzero(pixel_counts > 0.5 * pixel_counts.max())
        amplitudes, shifts = amplitudes[shown], tuple(shifts[s] for s in shown)
        valid = (amplitudes.min(axis=0) > limit) & (frames[[*sum(shifts, ())]].max(axis=0) < white)
    else:
        amplitudes = estimate_albedo(sequence, frames)[None]
        valid = amplitudes[0] > limit
    if np.count_nonzero(valid) < MIN_PIXELS:  # too few for statistics
        return None
    row, column, frames, amplitudes = (
        row[valid],
        column[valid],
        frames[:, valid],
        amplitudes[:, valid],
    )
    gain = np.ones(len(stack)) if gain is None else gain
    pixels = _CodedPixels(
        sequence, stack, coded, _match_partner_frames(sequence, coded), row, column, gain
    )
    interior, bright = _detect_stripe_interiors(
        pixels, frames, sum(shifts, ()), DECIDED * amplitudes[-1]
    )
    interior &= frames[list(coded)] < white
    return LightSample(
        frames,
        (row / (height - 1)).astype(np.float32),
        (column / (width - 1)).astype(np.float32),
        shifts,
        coded,
        pixels.partner,
        interior,
        bright,
        amplitudes,
        rough,
    )


def estimate_albedo(
    sequence: PatternSequence, frames: np.ndarray, changes: Sequence[int] = ()
) -> np.ndarray:
    """Return half of the projector's light in grey levels, float32 of the shape of one of the
    ``frames`` (n, ...).

    The modulation of a phase shift between whose frames no light ``changes``, or half the range of
    the coded frames between two changes.
    """
    shifts = list_shifts(sequence)
    if shifts:
        chosen = np.stack([frames[i] for i in shifts[steady_shift(shifts, changes)]]).astype(
            np.float32
        )
        return np.abs(fit_cosine(chosen.reshape(len(chosen), -1))[1]).reshape(frames.shape[1:])
    coded = tuple(i for i, f in enumerate(sequence.frames) if f.kind != "texture")
    return _compute_half_range(frames, coded, _match_partner_frames(sequence, coded), changes)


def _compute_half_range(
    frames: np.ndarray, coded: Sequence[int], partner: Sequence[int], changes: Sequence[int]
) -> np.ndarray:
    """Return half the difference, float32 grey levels, of bright and dark among the ``coded``
    frames.

    This is the largest difference between a bit and its inverse, which see the same room light;
    without inverses, the range of the longest run of frames between two ``changes``.
    """
    pairs = [(i, coded[k]) for i, k in zip(coded, partner, strict=True) if k > -1]
    if pairs:
        differences = np.maximum.reduce([cv2.absdiff(frames[i], frames[j]) for i, j in pairs])
        # OpenCV makes columns of vectors
        return np.float32(0.5) * differences.reshape(frames.shape[1:])
    ends = [0, *changes, len(frames)]
    longest = max(([i for i in coded if a <= i < b] for a, b in pairwise(ends)), key=len)
    high, low = (
        extreme.reduce([frames[i] for i in longest]) for extreme in (np.maximum, np.minimum)
    )
    return np.float32(0.5) * (high - low)


def steady_shift(shifts: Sequence[Sequence[int]], changes: Sequence[int]) -> int:
    """Return the index of the last shift between whose frames no light ``changes``.

    -1, the last, where there is none.
    """
    return next(
        (
            s
            for s in reversed(range(len(shifts)))
            if not any(min(shifts[s]) < k <= max(shifts[s]) for k in changes)
        ),
        -1,
    )


def list_shifts(sequence: PatternSequence) -> tuple[Indices, ...]:
    """Return the frames of every phase-shifted period, of all axes."""
    return tuple(steps for axis in sequence.axes for _, steps in sequence.phase_shifts(axis))


def _match_partner_frames(sequence: PatternSequence, coded: Indices) -> Indices:
    """Return for each coded frame the index in ``coded`` of its inverse, or of the bit that it
    inverts.

    -1 without one.
    """
    frames = [sequence.frames[i] for i in coded]
    place: dict[Any, int] = {(f.kind, f.axis, f.bit): k for k, f in enumerate(frames)}
    other = {"gray": "inverse", "inverse": "gray"}
    return tuple(place.get((other.get(f.kind), f.axis, f.bit), -1) for f in frames)


@dataclass(frozen=True, eq=False)
class _CodedPixels:
    """Sampled pixels of the ``coded`` frames (c,) of a stack, at ``row`` and ``column`` (p,), px.

    ``partner`` (c,): see `LightSample`; ``gain`` (n,): of all frames of the stack.
    """

    sequence: PatternSequence
    stack: np.ndarray
    coded: Indices
    partner: Indices
    row: np.ndarray
    column: np.ndarray
    gain: np.ndarray

    def kind(self, k: int) -> Kind:
        """Return the kind of a coded frame."""
        return self.sequence.frames[self.coded[k]].kind

    def is_even(self, k: int) -> bool:
        """Return whether a coded frame is white or black."""
        return self.kind(k) in ("white", "black")

    def level(self, k: int, down: int = 0, right: int = 0) -> np.ndarray:
        """Return the grey levels (p,) float32 of a coded frame over its gain, so many px beside the
        pixels."""
        i = self.coded[k]
        return np.asarray(
            self.stack[i][self.row + down, self.column + right] / np.float32(self.gain[i])
        )

    def levels_around(self, k: int) -> np.ndarray:
        """Return the levels of a coded frame at the pixels and at all distances ``AROUND`` them,
        (9, p)."""
        beside = [self.level(k, 0, d) for d in AROUND] + [self.level(k, d) for d in AROUND]
        return np.stack([self.level(k), *beside])


def _detect_stripe_interiors(
    pixels: _CodedPixels, frames: np.ndarray, phased: Sequence[int], least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where each coded frame shows the interior of a stripe, and whether it is bright: (c,
    p) bool each.

    ``frames`` (n, p): levels of all frames; ``phased``: the phase-shifted ones, whose mean is the
    threshold; ``least`` (p,): grey levels from the threshold that an interior needs.
    """
    thresholds = _estimate_thresholds(pixels, frames, phased, least)
    interior, bright = np.zeros((2, len(pixels.coded), len(least)), bool)
    for k, other in enumerate(pixels.partner):
        if pixels.is_even(k):
            interior[k], bright[k] = True, pixels.kind(k) == "white"
        elif -1 < other < k:
            interior[k], bright[k] = interior[other], ~bright[other]
        else:
            height = pixels.levels_around(k) - (
                thresholds[k] if other < 0 else pixels.levels_around(other)
            )
            above = height > 0
            bright[k], interior[k] = (
                above[0],
                (above == above[0]).all(axis=0) & (np.abs(height[0]) > least),
            )
    _exclude_blurred_stripes(pixels, interior, bright)
    return interior, bright


def _estimate_thresholds(
    pixels: _CodedPixels, frames: np.ndarray, phased: Sequence[int], least: np.ndarray
) -> dict[int, np.ndarray]:
    """Return the levels (p,) between dark and bright stripes of each bit without a partner."""
    coded = pixels.coded
    ends = [i for k, i in enumerate(coded) if pixels.is_even(k)]
    reference = phased or (ends if len(ends) > 1 else coded)
    threshold: np.ndarray = np.mean(
        [frames[i] / np.float32(pixels.gain[i]) for i in reference], axis=0
    )
    alone = [k for k, other in enumerate(pixels.partner) if other < 0 and not pixels.is_even(k)]
    if not phased:
        return dict.fromkeys(alone, threshold)
    offsets = _estimate_room_offsets([pixels.level(k) - threshold for k in alone], least / DECIDED)
    return {k: threshold + offset for k, offset in zip(alone, offsets, strict=True)}


def _exclude_blurred_stripes(
    pixels: _CodedPixels, interior: np.ndarray, bright: np.ndarray
) -> None:
    """Set ``interior`` (c, p) False for axes that were not shown, and stripes finer than those
    without an inside."""
    frames = [pixels.sequence.frames[i] for i in pixels.coded]
    for axis in pixels.sequence.axes:
        own = [k for k, frame in enumerate(frames) if frame.axis == axis]
        if own and not (interior[own] & bright[own]).mean(axis=1).max() > SHOWN:
            interior[own] = False  # the axis was not shown, or is out of view
        # Finer stripes have no inside either: they are blurred to one grey.
        bits = sorted(
            (k for k in own if frames[k].kind in ("gray", "inverse")), key=lambda k: frames[k].bit
        )
        fine = np.flatnonzero(interior[bits].mean(axis=1) < SHOWN)
        if fine.size:
            interior[bits[fine[0] :]] = False


def _estimate_room_offsets(levels: list[np.ndarray], modulation: np.ndarray) -> list[float]:
    """Estimate the room light of each frame, in grey levels, where it could make dark stripes
    appear bright; else 0.

    This is the offset that the pixels have in common besides plus or minus the ``modulation`` (p,).
    ``levels``: grey levels (p,) of each frame above the mean of the fringes. Frames that are dark,
    or bright, throughout do not determine it.
    """
    some = np.s_[:: max(1, len(modulation) // 1000)]
    modulation = modulation[some]
    unit = float(np.median(modulation))
    tried = (OFFSETS * unit).astype(np.float32)[:, None]
    best, offsets = np.inf, [0.0] * len(levels)
    distances = [np.abs(level[some] - tried) for level in levels]
    buffer = np.empty((len(tried), len(modulation)), np.float32)
    for sharper in SHARPER:
        misfits = []
        for distance in distances:
            np.subtract(distance, np.float32(sharper) * modulation, out=buffer)
            misfits.append(np.abs(buffer, out=buffer).mean(axis=1))
        least = [int(np.argmin(misfit + 1e-3 * np.abs(tried[:, 0]))) for misfit in misfits]
        if (
            total := sum(float(misfit[k]) for misfit, k in zip(misfits, least, strict=True))
        ) < best:
            best, offsets = total, [float(tried[k, 0]) for k in least]
    shares = [np.mean(level[some] > offset) for level, offset in zip(levels, offsets, strict=True)]
    return [
        offset if abs(offset) > LEAST_OFFSET * unit and SHOWN < share < 1 - SHOWN else 0.0
        for offset, share in zip(offsets, shares, strict=True)
    ]
