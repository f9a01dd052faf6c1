"""The sampled pixels from which the light of each frame is estimated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.layout import white_level
from slviewer.fringe.residual_sample import fit_cosine, roughness
from slviewer.fringe.sequence import PatternSequence

ROWS, COLUMNS = 48, 88
"""Sampled rows and columns: rows enough for eight cycles of flicker, pixels enough to know a gain to 0.1 %."""
AROUND = (-6, -3, 2, 5)
"""px: the interior of a Gray stripe has its own class at these distances, along rows and columns. Narrower stripes
are blurred, and have none."""
DECIDED = 0.3
"""Distance of a stripe's inside from its threshold, as a share of half the contrast."""
SHOWN = 0.03
"""Share of the pixels that must be bright in a Gray frame of an axis that was shown."""
MIN_PIXELS = 60


@dataclass(frozen=True, eq=False)
class LightSample:
    """Samples (n, p) float32 grey levels of all n frames at p pixels.

    ``row`` and ``column`` (p,) reach from 0 to 1 across the image. ``shifts``: the frames of each phase shift, by
    step. ``coded``: the Gray, white and black frames (c,); ``interior`` and ``bright`` (c, p) bool: where such a frame
    shows the inside of a stripe, and whether that is bright. ``partner`` (c,): for bits and inverses, the place in
    ``coded`` of the other, else -1. ``amplitudes`` (s, p): half of what the projector adds, in grey levels, as each
    phase shift shows it, or the Gray code. ``roughness``: grey levels by which neighbours differ.
    """

    frames: np.ndarray
    row: np.ndarray
    column: np.ndarray
    shifts: tuple[tuple[int, ...], ...]
    coded: tuple[int, ...]
    partner: tuple[int, ...]
    interior: np.ndarray
    bright: np.ndarray
    amplitudes: np.ndarray
    roughness: float

    def albedo(self, changes: Sequence[int]) -> np.ndarray:
        """(p,) grey levels, in proportion to what the scene reflects, of frames between which no light ``changes``."""
        return self.amplitudes[undisturbed(self.shifts, changes)]


def sample_light(
    sequence: PatternSequence, stack: np.ndarray, gain: np.ndarray | None = None, *, coarse: bool = False
) -> LightSample | None:
    """The sample of a capture (n, h, w); None where too few pixels see the pattern unclipped.

    ``gain`` (n,) of the frames, as far as it is known, keeps bits and inverses of unequal light apart. ``coarse``: an
    eighth of the pixels.
    """
    height, width = stack.shape[1:]
    margin = max(map(abs, AROUND))
    if min(height, width) <= 2 * margin + 8:
        return None
    rows, columns = (
        np.unique(np.linspace(margin, size - 1 - margin, min(count, size)).astype(int))
        for size, count in ((height, ROWS // 2 if coarse else ROWS), (width, COLUMNS // 4 if coarse else COLUMNS))
    )
    row, column = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    shifts = _shifts(sequence)
    phased = [i for shift in shifts for i in shift]
    coded = tuple(i for i, f in enumerate(sequence.frames) if f.kind not in ("phase", "texture"))
    used = [*phased, *coded]
    frames = np.zeros((len(stack), len(row)), np.float32)
    for i in used:
        frames[i] = stack[i][row, column]
    white = white_level(stack, used)
    run = columns[0] + np.arange(width - 2 * margin)
    rough = roughness(np.stack([stack[i][rows[::4, None], run] for i in used[:4]]).astype(np.float32), len(run))
    limit = max(limits.DARK_LEVELS * white / 255, limits.DARK_SIGMAS * rough)
    if phased:
        amplitudes = np.stack([np.abs(fit_cosine(frames[list(shift)])[1]) for shift in shifts])
        seen = np.count_nonzero(amplitudes > limit, axis=1)
        if seen.max() < MIN_PIXELS:
            return None
        shown = np.flatnonzero(seen > 0.5 * seen.max())  # an axis that was not shown, or is out of view, is no witness
        amplitudes, shifts = amplitudes[shown], tuple(shifts[s] for s in shown)
        phased = [i for shift in shifts for i in shift]
        valid = (amplitudes.min(axis=0) > limit) & (frames[phased].max(axis=0) < white)
    else:
        amplitudes = estimate_albedo(sequence, frames)[None]
        valid = amplitudes[0] > limit
    if np.count_nonzero(valid) < MIN_PIXELS:  # too few for statistics
        return None
    row, column, frames = row[valid], column[valid], frames[:, valid]
    partner = _partners(sequence, coded)
    amplitudes = amplitudes[:, valid]
    interior, bright = _interiors(
        sequence, stack, frames, coded, partner, row, column, gain, DECIDED * amplitudes[-1], phased
    )
    if coded:
        interior &= frames[list(coded)] < white
    return LightSample(
        frames,
        (row / (height - 1)).astype(np.float32),
        (column / (width - 1)).astype(np.float32),
        shifts,
        coded,
        partner,
        interior,
        bright,
        amplitudes,
        rough,
    )


def estimate_albedo(sequence: PatternSequence, frames: np.ndarray, changes: Sequence[int] = ()) -> np.ndarray:
    """float32 of the shape of one of the ``frames`` (n, ...): half of what the projector adds, in grey levels.

    The modulation of a phase shift between whose frames no light ``changes``, or half the range of the coded frames.
    """
    shifts = _shifts(sequence)
    if shifts:
        chosen = np.stack([frames[i] for i in shifts[undisturbed(shifts, changes)]]).astype(np.float32)
        return np.abs(fit_cosine(chosen.reshape(len(chosen), -1))[1]).reshape(frames.shape[1:])
    coded = [frames[i].astype(np.float32) for i, f in enumerate(sequence.frames) if f.kind != "texture"]
    return 0.5 * (np.maximum.reduce(coded) - np.minimum.reduce(coded))


def undisturbed(shifts: Sequence[Sequence[int]], changes: Sequence[int]) -> int:
    """The place of the last shift between whose frames no light ``changes``; -1, the last, where there is none."""
    return next(
        (s for s in reversed(range(len(shifts))) if not any(min(shifts[s]) < k <= max(shifts[s]) for k in changes)), -1
    )


def _shifts(sequence: PatternSequence) -> tuple[tuple[int, ...], ...]:
    out = []
    for axis in sequence.axes:
        for period in sequence.periods_px(axis):
            frames = [i for i in sequence.find("phase", axis) if sequence.frames[i].period_px == period]
            out.append(tuple(sorted(frames, key=lambda i: sequence.frames[i].step)))
    return tuple(out)


def _partners(sequence: PatternSequence, coded: tuple[int, ...]) -> tuple[int, ...]:
    place = {(sequence.frames[i].kind, sequence.frames[i].axis, sequence.frames[i].bit): k for k, i in enumerate(coded)}
    other = {"gray": "inverse", "inverse": "gray"}
    return tuple(
        place.get((other.get(f.kind, ""), f.axis, f.bit), -1) for f in (sequence.frames[i] for i in coded)  # type: ignore[arg-type]
    )  # fmt: skip


def _interiors(
    sequence: PatternSequence,
    stack: np.ndarray,
    frames: np.ndarray,
    coded: tuple[int, ...],
    partner: tuple[int, ...],
    row: np.ndarray,
    column: np.ndarray,
    gain: np.ndarray | None,
    least: np.ndarray,
    phased: list[int],
) -> tuple[np.ndarray, np.ndarray]:
    """(c, p) bool each: where a coded frame shows a stripe's inside, and whether it is bright."""
    gain = np.ones(len(stack)) if gain is None else gain
    ends = [i for i in coded if sequence.frames[i].kind in ("white", "black")]
    reference = phased or (ends if len(ends) > 1 else list(coded))
    threshold = np.mean([frames[i] / np.float32(gain[i]) for i in reference], axis=0)
    around = [(0, 0), *((0, d) for d in AROUND), *((d, 0) for d in AROUND)]
    interior, bright = (np.zeros((len(coded), len(row)), bool) for _ in range(2))
    for k, (i, other) in enumerate(zip(coded, partner, strict=True)):
        kind = sequence.frames[i].kind
        if kind in ("white", "black"):
            interior[k], bright[k] = True, kind == "white"
            continue
        if other > -1 and other < k:
            interior[k], bright[k] = interior[other], ~bright[other]
            continue
        above = np.empty((len(around), len(row)), bool)
        for m, (down, right) in enumerate(around):
            level = stack[i][row + down, column + right] / np.float32(gain[i])
            if other > -1:
                above[m] = level > stack[coded[other]][row + down, column + right] / np.float32(gain[coded[other]])
            else:
                above[m] = level > threshold
        reference_level = frames[coded[other]] / np.float32(gain[coded[other]]) if other > -1 else threshold
        decided = np.abs(frames[i] / np.float32(gain[i]) - reference_level) > least
        bright[k], interior[k] = above[0], (above == above[0]).all(axis=0) & decided
    for axis in sequence.axes:
        own = [k for k, i in enumerate(coded) if sequence.frames[i].axis == axis]
        if own and not (interior[own] & bright[own]).mean(axis=1).max() > SHOWN:
            interior[own] = False  # the axis was not shown, or is out of view
    return interior, bright
