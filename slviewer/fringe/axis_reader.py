"""Frames of one axis under a hypothesis, and the bits and phases that are read from them at sampled
pixels."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from slviewer.fringe.line_sample import LineSample
from slviewer.fringe.residual_sample import cosine_columns
from slviewer.fringe.sequence import Axis, PatternSequence

Result = TypeVar("Result")
Images = tuple[int | None, ...]
"""Indices of the images of some frames, None where an image is missing."""

DECIDED = 0.2
"""Distance from the middle, as a share of the swing, from which a bit is decided."""
DECIDED_SIGMAS = 3.0
"""Distance from the middle, in standard deviations of the noise, that it must exceed as well."""
FEWEST_PIXELS = 500
COARSE_PIXELS = 8_000
"""Size of a small sample, which excludes most hypotheses: the length of a mean unit vector is
accurate to 0.02."""
RECENT = 8
INSIDE = 0.35
"""Distance from the middle, as a share of the swing, beyond which a pixel is inside a stripe. With
a gamma of 2.2, blurred stripes are 0.28 from the middle."""


@dataclass(frozen=True)
class AxisFrames:
    """Assignment of images to the frames of one axis: image indices, None where an image is
    missing.

    ``extent``: None where the projector's size is not known. ``shifts``: (period, images by step),
    longest period first. ``bits``: most significant first, the complementary bit last; ``inverse``:
    like ``bits``, or empty. ``inverted``: bits and their inverses are exchanged. ``gamma``:
    exponent of the response of the light to the grey level.
    """

    extent: int | None
    sign: int
    offset_rad: float
    origin_px: float
    cell_px: float
    shifts: tuple[tuple[float, Images], ...]
    bits: Images
    inverse: Images
    complementary: bool
    inverted: bool = False
    gamma: float = 1.0

    @property
    def fringe(self) -> tuple[float, Images] | None:
        """Period (px) and images of the shift that is compared with the Gray code: the one most
        like its cells.

        None for Gray code alone.
        """
        return min(
            self.shifts, key=lambda shift: abs(np.log(shift[0] / self.cell_px)), default=None
        )

    def cell_of(self, count: int) -> float:
        """Return the width, px, of the cells that the first ``count`` bits number."""
        return self.cell_px * 2.0 ** (len(self.bits) - self.complementary - count)


def described_frames(
    sequence: PatternSequence, axis: Axis, images: Sequence[int | None] | None = None
) -> AxisFrames:
    """Return the frames of an axis as a sequence describes them, frame i being shown in image
    ``images[i]``.

    ``images``: None where an image is missing; frame i is image i if no images are given.
    """

    def list_images(frames: Iterable[int]) -> Images:
        """Return the image of each frame; None for a missing one."""
        return tuple(i if images is None else images[i] for i in frames)

    complementary = list_images(sequence.bits("complementary", axis))
    return AxisFrames(
        extent=sequence.extent(axis) if sequence.projector_size else None,
        sign=sequence.sign(axis),
        offset_rad=sequence.offset_rad(axis),
        origin_px=sequence.origin_px(axis),
        cell_px=sequence.gray_cell(axis),
        shifts=tuple((period, list_images(steps)) for period, steps in sequence.phase_shifts(axis)),
        bits=list_images(sequence.bits("gray", axis)) + complementary,
        inverse=list_images(sequence.bits("inverse", axis)),
        complementary=bool(complementary),
    )


def reversed_bits(frames: AxisFrames, with_complementary: bool = False) -> AxisFrames:
    """Return the frames with their Gray bits in reverse order.

    The complementary bit stays last, or, ``with_complementary``, is reversed with the others and
    comes first.
    """
    if with_complementary:
        return replace(frames, bits=frames.bits[::-1])
    count = len(frames.bits) - frames.complementary
    return replace(
        frames, bits=frames.bits[:count][::-1] + frames.bits[count:], inverse=frames.inverse[::-1]
    )


class BitReading(NamedTuple):
    """Bit as it is read from its images.

    ``value`` and ``decided`` (p,) bool; ``share`` of decided pixels; ``stripe_px``: mean width of
    the stripes.
    """

    value: np.ndarray
    decided: np.ndarray
    share: float
    stripe_px: float


class AxisReader:
    """Reader of the bits and phases of sampled pixels, which caches results that several hypotheses
    share.

    ``bit`` and ``opposed`` are the cached `_read_bit` and `_measure_opposed`.
    """

    def __init__(self, sample: LineSample, indices: list[int]) -> None:
        """Select the pixels of ``sample`` that vary between the frames ``indices`` of the axis."""
        chosen = (
            sample.frames[indices] if indices else np.zeros((1, sample.frames.shape[1]), np.float32)
        )
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
        # Every hypothesis requests each of them again.
        self.bit, self.opposed = cache(self._read_bit), cache(self._measure_opposed)
        self._in_view = cache(self._has_varying_pixels)
        # Successive hypotheses share the code or the phase: pixels are cached for the last few
        # only.
        self._results: dict[Callable[..., Any], Callable[..., Any]] = {}
        self._wave, self._unwrapped = (
            lru_cache(RECENT)(self._fit_wave),
            lru_cache(RECENT)(self._unwrap_wave),
        )

    def recall(
        self, compute: Callable[..., Result], *arguments: Hashable, most: int | None = None
    ) -> Result:
        """Return ``compute(self, *arguments)``, cached; for the last ``most`` arguments only, if
        given."""
        if compute not in self._results:
            self._results[compute] = lru_cache(most)(partial(compute, self))
        return self._results[compute](*arguments)  # type: ignore[no-any-return]

    @cached_property
    def coarse(self) -> "AxisReader":
        """Reader of a random subset of the pixels, which are not neighbours of each other."""
        sample = self._sample
        count = sample.frames.shape[1]
        some = np.sort(np.random.default_rng(0).permutation(count)[:COARSE_PIXELS])
        thinned = replace(
            sample, frames=sample.frames[:, some], line=sample.line[some], place=sample.place[some]
        )
        return AxisReader(thinned, self._indices)

    @cached_property
    def gaps(self) -> np.ndarray:
        """(p,) number of gaps in the line of pixels before each pixel."""
        return np.concatenate([[0], np.cumsum(~self.adjacent)])

    def is_in_view(self, frames: AxisFrames) -> bool:
        """Return whether enough pixels vary between the images that a hypothesis assigns to this
        axis."""
        assumed = (*frames.bits, *frames.inverse, *(i for _, steps in frames.shifts for i in steps))
        return self._in_view(frozenset(i for i in assumed if i is not None))

    def _has_varying_pixels(self, images: frozenset[int]) -> bool:
        """Return whether at least ``FEWEST_PIXELS`` pixels vary between these images."""
        rows, count = sorted(images), 0
        for first in range(0, len(self.swing) if rows else 0, COARSE_PIXELS):
            swing = np.ptp(self.frames[rows, first : first + COARSE_PIXELS], axis=0)
            count += int(np.count_nonzero(swing > self._sample.least_swing))
            if count >= FEWEST_PIXELS:
                return True
        return False

    def _measure_opposed(self, image: int | None, inverse: int | None) -> float:
        """Return the share of pixels inside stripes of both images that are bright in only one of
        them.

        NaN for a missing image or too few pixels.
        """
        if image is None or inverse is None:
            return np.nan
        first, second = self.frames[image] - self.middle, self.frames[inverse] - self.middle
        inside = np.minimum(np.abs(first), np.abs(second)) > INSIDE * self.swing
        weight = self.swing * inside
        share = float(weight[(first > 0) != (second > 0)].sum() / max(float(weight.sum()), 1e-9))
        return share if np.count_nonzero(inside) >= FEWEST_PIXELS else np.nan

    def _read_bit(self, image: int | None, inverse: int | None) -> BitReading:
        """Read a bit from its image and its inverse.

        None where one is missing; the middle of each pixel's darkest and brightest level stands in
        for it.
        """
        high = self.middle if image is None else self.frames[image]
        low = self.middle if inverse is None else self.frames[inverse]
        both = image is not None and inverse is not None
        height = (high - low) * np.float32(0.5 if both else 1.0)
        noise = self._sample.noise * (0.71 if both else 1.0)
        decided = np.abs(height) > np.maximum(DECIDED * self.swing, DECIDED_SIGMAS * noise)
        value = height > 0
        share = float(decided.mean()) if decided.size else 0.0
        return BitReading(value, decided, share, self._measure_stripe_width(value))

    def _measure_stripe_width(self, value: np.ndarray) -> float:
        """Return the mean stripe width in px along the rows or along the columns, whichever is
        smaller."""
        edges = (value[1:] != value[:-1]) & self.adjacent
        across = int(np.count_nonzero(self._across))
        edges_across = int(np.count_nonzero(edges & self._across))
        edges_along = int(np.count_nonzero(edges)) - edges_across
        parts = ((across, edges_across), (len(self._across) - across, edges_along))
        return min((pixels / (1 + crossed) for pixels, crossed in parts if pixels), default=0.0)

    def phasor(self, images: Images, frames: AxisFrames) -> np.ndarray | None:
        """Return modulation * e^(i phase), (p,) complex64, at the sampled pixels, from the images
        of one phase shift as ``frames`` states sign, offset and gamma; None with fewer than three
        images."""
        wave = self._wave(images, frames.gamma)
        if wave is None:
            return None
        turned = np.exp(-1j * frames.offset_rad).astype(np.complex64)
        return (wave if frames.sign < 0 else np.conj(wave)) * turned

    def unwrapped_phase(self, images: Images, frames: AxisFrames) -> np.ndarray:
        """Return the phase (p,) in rad, unwrapped from pixel to pixel along each line.

        ``images``: steps that have a `phasor`.
        """
        return -frames.sign * self._unwrapped(images, frames.gamma)

    def _fit_wave(self, images: Images, gamma: float) -> np.ndarray | None:
        """Fit `phasor` (p,) complex64 for a negative phase sign and without offset; None for fewer
        than three steps."""
        steps = [k for k, image in enumerate(images) if image is not None]
        there = [image for image in images if image is not None]
        if len(steps) < 3:
            return None
        weights = np.linalg.pinv(cosine_columns(np.array(steps), len(images), 1))[1:].astype(
            np.float32
        )
        consecutive = there == list(range(there[0], there[0] + len(there)))
        levels = self.frames[there[0] : there[-1] + 1] if consecutive else self.frames[there]
        if gamma != 1.0:
            dark = self.middle - self.swing / 2
            levels = np.maximum((levels - dark) / np.maximum(self.swing, 1e-6), 0) ** np.float32(
                1 / gamma
            )
            levels = levels * self.swing
        cosine, sine = weights @ levels
        wave = np.empty(len(cosine), np.complex64)
        wave.real, wave.imag = cosine, sine
        return wave

    def _unwrap_wave(self, images: Images, gamma: float) -> np.ndarray:
        """Compute `unwrapped_phase` (p,) for a negative phase sign."""
        wave = self._wave(images, gamma)
        assert wave is not None
        return np.concatenate(
            [[0.0], np.cumsum(np.angle(wave[1:] * np.conj(wave[:-1])), dtype=np.float64)]
        )
