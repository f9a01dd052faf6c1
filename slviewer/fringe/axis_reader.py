"""The frames of one axis under a hypothesis, and what a sample of pixels reads of them: bits and phases."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from typing import Any, TypeVar

import numpy as np

from slviewer.fringe.line_sample import LineSample
from slviewer.fringe.residual_sample import cosine_columns
from slviewer.fringe.sequence import Axis, Kind, PatternSequence

Result = TypeVar("Result")

DECIDED = 0.2
"""Of the swing, that a bit must lie away from the middle to be read."""
DECIDED_SIGMAS = 3.0
"""And so many standard deviations of the noise."""
FEWEST_PIXELS = 500
COARSE_PIXELS = 8_000
"""Of a sample, that refute most hypotheses: the length of a mean unit vector is known to 0.02."""
RECENT = 8
INSIDE = 0.35
"""Of the swing: farther from the middle lies the inside of a stripe. Blurred stripes seen through a gamma of 2.2 lie
0.28 from the middle."""


@dataclass(frozen=True)
class AxisFrames:
    """Which image shows what, of one axis: image indices, None where the image is not there.

    ``extent`` None where the projector's size is not known. ``shifts``: (period, images by step), longest period first.
    ``bits`` most significant first, the complementary bit last; ``inverse`` like ``bits``, or empty. ``inverted``: bits
    and their inverses are exchanged. ``gamma``: the exponent by which the light was curved.
    """

    extent: int | None
    sign: int
    offset_rad: float
    origin_px: float
    cell_px: float
    shifts: tuple[tuple[float, tuple[int | None, ...]], ...]
    bits: tuple[int | None, ...]
    inverse: tuple[int | None, ...]
    complementary: bool
    inverted: bool = False
    gamma: float = 1.0

    @property
    def fringe(self) -> tuple[float, tuple[int | None, ...]] | None:
        """The period that is compared with the Gray code, the one most like its cells; None for Gray code alone."""
        return min(self.shifts, key=lambda shift: abs(np.log(shift[0] / self.cell_px)), default=None)

    def cell_of(self, count: int) -> float:
        """px: width of the cells that the first ``count`` bits number."""
        return self.cell_px * 2.0 ** (len(self.bits) - self.complementary - count)


def described_frames(
    sequence: PatternSequence, axis: Axis, images: Sequence[int | None] | None = None
) -> AxisFrames:  # fmt: skip
    """The frames of an axis as a sequence has them, frame i shown in image ``images[i]``."""

    def images_of(steps: Iterable[int]) -> tuple[int | None, ...]:
        """Image of each frame; None for a missing one."""
        return tuple(i if images is None else images[i] for i in steps)

    def shown(kind: Kind) -> tuple[int | None, ...]:
        """Images of the frames of one kind, by bit."""
        return images_of(sorted(sequence.find(kind, axis), key=lambda i: sequence.frames[i].bit))

    complementary = shown("complementary")
    return AxisFrames(
        extent=sequence.extent(axis) if sequence.projector_size else None,
        sign=sequence.sign(axis),
        offset_rad=sequence.offset_rad(axis),
        origin_px=sequence.origin_px(axis),
        cell_px=sequence.gray_cell(axis),
        shifts=tuple((period, images_of(steps)) for period, steps in sequence.phase_shifts(axis)),
        bits=shown("gray") + complementary,
        inverse=shown("inverse"),
        complementary=bool(complementary),
    )


def reversed_bits(frames: AxisFrames, with_complementary: bool = False) -> AxisFrames:
    """The same with the Gray bits from the least significant to the most; the complementary bit stays in its place, or
    comes first."""
    if with_complementary:
        return replace(frames, bits=frames.bits[::-1])
    last = frames.bits[len(frames.bits) - frames.complementary :]
    gray = frames.bits[: len(frames.bits) - frames.complementary]
    return replace(frames, bits=(*gray[::-1], *last), inverse=frames.inverse[::-1])


class AxisReader:
    """Reads bits and phases of a sample, each once for all hypotheses."""

    def __init__(self, sample: LineSample, indices: list[int]) -> None:
        chosen = sample.frames[indices] if indices else np.zeros((1, sample.frames.shape[1]), np.float32)
        high, low = chosen.max(axis=0), chosen.min(axis=0)
        swing = high - low
        self.illuminated = swing > sample.least_swing
        self.seen = np.flatnonzero(self.illuminated)
        self.frames = sample.frames[:, self.seen]
        self.swing = swing[self.seen]
        self.middle = (high[self.seen] + low[self.seen]) / 2
        self.line, self.place = sample.line[self.seen], sample.place[self.seen]
        self.adjacent = (np.diff(self.place) == 1) & (np.diff(self.line) == 0)
        self._across = (self.line >= sample.rows)[1:]
        self._sample, self._indices = sample, indices
        # Each is asked for again by every hypothesis.
        self.bit, self.opposed = cache(self._read_bit), cache(self._measure_opposed)
        self._in_view = cache(self._vary_enough)
        # Hypotheses that follow each other share the code or the phase: pixels are kept of the last few alone.
        self._results: dict[Callable[..., Any], Callable[..., Any]] = {}
        self._wave, self._unwrapped = lru_cache(RECENT)(self._fit_wave), lru_cache(RECENT)(self._unwrap_wave)

    def recall(self, compute: Callable[..., Result], *arguments: Hashable, most: int | None = None) -> Result:
        """Return ``compute(self, *arguments)``, computed once; of the last ``most`` arguments only, if given."""
        if compute not in self._results:
            self._results[compute] = lru_cache(most)(partial(compute, self))
        return self._results[compute](*arguments)  # type: ignore[no-any-return]

    @cached_property
    def coarse(self) -> "AxisReader":
        """A reader of some of the pixels, which are no neighbours of each other."""
        sample = self._sample
        count = sample.frames.shape[1]
        some = np.sort(np.random.default_rng(0).permutation(count)[:COARSE_PIXELS])
        thinned = replace(sample, frames=sample.frames[:, some], line=sample.line[some], place=sample.place[some])
        return AxisReader(thinned, self._indices)

    @cached_property
    def gaps(self) -> np.ndarray:
        """(p,) how many gaps come before each pixel."""
        return np.concatenate([[0], np.cumsum(~self.adjacent)])

    def is_in_view(self, frames: AxisFrames) -> bool:
        """Whether enough pixels vary between the images that are taken to be of this axis."""
        assumed = (*frames.bits, *frames.inverse, *(i for _, steps in frames.shifts for i in steps))
        return self._in_view(frozenset(i for i in assumed if i is not None))

    def _vary_enough(self, images: frozenset[int]) -> bool:
        """Whether at least ``FEWEST_PIXELS`` pixels vary between these images."""
        rows, count = sorted(images), 0
        for first in range(0, len(self.swing) if rows else 0, COARSE_PIXELS):
            swing = np.ptp(self.frames[rows, first : first + COARSE_PIXELS], axis=0)
            count += int(np.count_nonzero(swing > self._sample.least_swing))
            if count >= FEWEST_PIXELS:
                return True
        return False

    def _measure_opposed(self, image: int | None, inverse: int | None) -> float:
        """Share of the pixels inside stripes of both images that are bright in one alone; NaN for few pixels."""
        if image is None or inverse is None:
            return np.nan
        first, second = self.frames[image] - self.middle, self.frames[inverse] - self.middle
        inside = np.minimum(np.abs(first), np.abs(second)) > INSIDE * self.swing
        weight = self.swing * inside
        share = float(weight[(first > 0) != (second > 0)].sum() / max(float(weight.sum()), 1e-9))
        return share if np.count_nonzero(inside) >= FEWEST_PIXELS else np.nan

    def _read_bit(self, image: int | None, inverse: int | None) -> tuple[np.ndarray, np.ndarray, float, float]:
        """(p,) bool value, (p,) bool decided, share decided, mean stripe width in px."""
        high = self.middle if image is None else self.frames[image]
        low = self.middle if inverse is None else self.frames[inverse]
        both = image is not None and inverse is not None
        height = (high - low) * np.float32(0.5 if both else 1.0)
        noise = self._sample.noise * (0.71 if both else 1.0)
        decided = np.abs(height) > np.maximum(DECIDED * self.swing, DECIDED_SIGMAS * noise)
        value = height > 0
        return value, decided, float(decided.mean()) if decided.size else 0.0, self._mean_stripe_width(value)

    def _mean_stripe_width(self, value: np.ndarray) -> float:
        """Mean width in px of stripes, along the rows or the columns, whichever is less."""
        edges = (value[1:] != value[:-1]) & self.adjacent
        across = int(np.count_nonzero(self._across))
        edges_across = int(np.count_nonzero(edges & self._across))
        edges_along = int(np.count_nonzero(edges)) - edges_across
        parts = ((across, edges_across), (len(self._across) - across, edges_along))
        return min((pixels / (1 + crossed) for pixels, crossed in parts if pixels), default=0.0)

    def phasor(self, images: tuple[int | None, ...], frames: AxisFrames) -> np.ndarray | None:
        """(p,) complex64 modulation e^(i phase); None with fewer than three of the steps."""
        wave = self._wave(images, frames.gamma)
        if wave is None:
            return None
        turned = np.exp(-1j * frames.offset_rad).astype(np.complex64)
        return (wave if frames.sign < 0 else np.conj(wave)) * turned

    def unwrapped_phase(self, images: tuple[int | None, ...], frames: AxisFrames) -> np.ndarray:
        """(p,) phase in rad, unwrapped from pixel to pixel along each line, of steps that have a `phasor`."""
        return -frames.sign * self._unwrapped(images, frames.gamma)

    def _fit_wave(self, images: tuple[int | None, ...], gamma: float) -> np.ndarray | None:
        """(p,) complex64: `phasor` for a negative sign, without an offset."""
        steps = [k for k, image in enumerate(images) if image is not None]
        there = [image for image in images if image is not None]
        if len(steps) < 3:
            return None
        weights = np.linalg.pinv(cosine_columns(np.array(steps), len(images), 1))[1:].astype(np.float32)
        consecutive = there == list(range(there[0], there[0] + len(there)))
        levels = self.frames[there[0] : there[-1] + 1] if consecutive else self.frames[there]
        if gamma != 1.0:
            dark = self.middle - self.swing / 2
            levels = np.maximum((levels - dark) / np.maximum(self.swing, 1e-6), 0) ** np.float32(1 / gamma)
            levels = levels * self.swing
        cosine, sine = weights @ levels
        wave = np.empty(len(cosine), np.complex64)
        wave.real, wave.imag = cosine, sine
        return wave

    def _unwrap_wave(self, images: tuple[int | None, ...], gamma: float) -> np.ndarray:
        """(p,) `unwrapped_phase` for a negative sign."""
        wave = self._wave(images, gamma)
        assert wave is not None
        return np.concatenate([[0.0], np.cumsum(np.angle(wave[1:] * np.conj(wave[:-1])), dtype=np.float64)])
