"""Grouping of the images of an undescribed capture: runs of phase steps, blocks of Gray bits, and
even light.

Every image is compared with the darkest and the brightest level of each pixel: stripes of a code
are at either end, phase steps have the same mean level in all pixels.
"""

from dataclasses import dataclass, field
from itertools import combinations, groupby, pairwise
from typing import Literal

import numpy as np

from slviewer.fringe.cosines import evaluate_cosine, fit_cosine, measure_concentration
from slviewer.fringe.sequence import Indices
from slviewer.session.importers.line_sample import LineSample

MOST_STEPS = 36
MOST_BITS = 16
MAX_SPREAD = 0.12
"""Largest standard deviation over the pixels of the mean of all steps, as a share of half the
swing; 0 for a cosine. Three bits of a code give 0.5, three of four steps 0.24."""
MIN_MIDDLE = 0.15
"""Share of the levels of phase steps in the middle half of the swing: a third of a cosine's, none
of a code's."""
MAX_COMMON = 0.9
"""Length of the phases' mean unit vector; above it the view would hold a quarter of a period at
most."""
MAX_MISFIT = 0.25
"""Largest residual of the steps from a curved response and noise, as a share of the amplitude.
Frames of another period give 0.7."""
COARSE_PIXELS, COARSE = 4_000, 1.25
"""Pixels on which images are compared with a cosine first, and the factor by which limits may be
exceeded there."""
DECIDED = 0.3
"""Distance from the middle, as a share of half the swing, from which a pixel is bright or dark."""
READABLE = 0.5
"""Share of decided pixels from which the stripes of a bit are wider than their blur."""
EVEN = 0.9
"""Share of pixels at the bright or the dark end from which an image shows no stripes."""
OPPOSITE = 0.9
"""Share of decided pixels that differ between a pattern and its inverse; two bits differ in about
half."""
OPPOSITE_BLURRED = -0.5
"""The correlation of a pattern and its inverse where blur decides few pixels."""
REACH = 16
"""px between two decided pixels of neighbouring stripes, across the blur of their edge."""
DROP = 0.6
"""An image with fewer edges than this share of those before begins another code; each finer bit has
about twice."""
FEWEST_EDGES = 20
"""Edges of stripes from which a share of them is known to a fifth."""
DIM = 0.25
"""Share of the brightest pixels' swing below which a pixel may show reflections of other
stripes."""

Even = Literal["white", "black"]
Doubt = tuple[Indices, str]
"""Images, and why it is doubtful what they show."""


@dataclass(frozen=True, eq=False)
class PhaseRun:
    """Images of all steps of a period.

    ``gradient`` (x, y): median phase gradient, rad per camera px, for a phase that rises by 2 pi /
    n from step to step; ``misfit``: rms residual of the cosine, as a share of the amplitude.
    """

    images: Indices
    gradient: tuple[float, float]
    misfit: float


@dataclass(frozen=True)
class Bit:
    """Image of stripes, or of even light (``even``), and its inverse, None without one.

    ``edges`` (x, y): edges per camera px along rows and along columns; ``count``: number of edges;
    ``is_readable``: whether most pixels are inside stripes.
    """

    image: int
    inverse: int | None
    edges: tuple[float, float]
    count: int
    is_readable: bool
    even: Even | None

    @property
    def images(self) -> Indices:
        """Image of the bit, then that of its inverse."""
        return (self.image,) if self.inverse is None else (self.image, self.inverse)


@dataclass(frozen=True)
class GrayBlock:
    """Bits of a Gray code, widest stripes first."""

    bits: tuple[Bit, ...]

    @property
    def images(self) -> Indices:
        """Images of all bits and inverses, in order of capture."""
        return tuple(sorted(image for bit in self.bits for image in bit.images))

    @property
    def direction(self) -> tuple[float, float]:
        """Edges per camera px (x, y) of the finest readable bit."""
        varying_bits = [bit for bit in self.bits if bit.is_readable and bit.even is None]
        return varying_bits[-1].edges


@dataclass(frozen=True, eq=False)
class FrameBlocks:
    """All images of a capture in blocks, and the images that fit no block.

    ``even``: images of even light, by index; ``doubts``: (images, text) of what does not fit.
    """

    runs: list[PhaseRun]
    codes: list[GrayBlock] = field(default_factory=list)
    even: dict[int, Even] = field(default_factory=dict)
    doubts: list[Doubt] = field(default_factory=list)


class BlockReader:
    """Reader of the normalised levels (n, p) of the pixels that vary: -1 the darkest of all images,
    1 the brightest."""

    def __init__(self, sample: LineSample) -> None:
        """Select the pixels of ``sample`` that vary, and normalise their levels."""
        high, low = sample.frames.max(axis=0), sample.frames.min(axis=0)
        swing = high - low
        self.illuminated = swing > sample.least_swing
        if self.illuminated.any():  # dim pixels show noise and reflections of other stripes
            self.illuminated &= swing > DIM * float(np.quantile(swing[self.illuminated], 0.95))
        pixels = np.flatnonzero(self.illuminated)
        self.levels = (
            2 * (sample.frames[:, pixels] - low[pixels]) / np.maximum(swing[pixels], 1e-6) - 1
        ).astype(np.float32)
        line, place = sample.line[pixels], sample.place[pixels]
        self.line, self.place, self.across = line, place, line >= sample.rows
        self.adjacent = (np.diff(place) == 1) & (np.diff(line) == 0)
        some = np.sort(np.random.default_rng(0).permutation(len(pixels))[:COARSE_PIXELS])
        self._coarse = self.levels[:, some]
        self._in_middle = (
            np.mean(np.abs(self.levels) < 0.5, axis=1)
            if len(pixels)
            else np.zeros(len(self.levels))
        )

    @property
    def count(self) -> int:
        """Number of sampled pixels that vary."""
        return self.levels.shape[1]

    def phasor(self, images: Indices) -> np.ndarray:
        """Fit modulation * e^(i phase), (p,) complex64, to images that are equidistant steps.

        The phase rises with the step.
        """
        return fit_cosine(self.levels[list(images)])[1]

    def run(self, images: Indices) -> PhaseRun | None:
        """Return the images as a run of all steps of one period; None if they are not."""
        rows = list(images)
        if float(self._in_middle[rows].mean()) < MIN_MIDDLE or not _is_cosine(
            self._coarse[rows], COARSE
        ):
            return None
        levels = self.levels[rows]
        # Three images fit any cosine, also a bit with its inverse and even light.
        if len(images) == 3 and any(self.are_opposite(a, b) for a, b in combinations(images, 2)):
            return None
        if not _is_cosine(levels):
            return None
        phasor = fit_cosine(levels)[1]
        step = np.angle(phasor[1:] * np.conj(phasor[:-1]))
        along, across = (
            float(np.median(step[self.adjacent & part]))
            for part in (~self.across[1:], self.across[1:])
        )
        return PhaseRun(images, (along, across), _measure_misfit(levels))

    def bit(self, image: int, inverse: int | None) -> Bit:
        """Measure the stripes of an image, compared with its inverse where there is one."""
        level = (
            self.levels[image]
            if inverse is None
            else (self.levels[image] - self.levels[inverse]) / 2
        )
        decided = np.abs(level) > DECIDED
        bright = float(np.mean(level > DECIDED))
        dark = float(np.mean(level < -DECIDED))
        even: Even | None = "white" if bright > EVEN else "black" if dark > EVEN else None
        decided_pixels = np.flatnonzero(decided)
        near = (np.diff(self.place[decided_pixels]) <= REACH) & (
            np.diff(self.line[decided_pixels]) == 0
        )
        edge = near & np.diff(level[decided_pixels] > 0)
        across = self.across[decided_pixels[1:]]
        total = np.array([np.count_nonzero(~self.across), np.count_nonzero(self.across)])
        x, y = np.array(
            [np.count_nonzero(edge & ~across), np.count_nonzero(edge & across)]
        ) / np.maximum(total, 1)
        return Bit(
            image,
            inverse,
            (float(x), float(y)),
            int(edge.sum()),
            float(decided.mean()) > READABLE,
            even,
        )

    def are_opposite(self, first: int, second: int) -> bool:
        """Return whether one image is the inverse of the other."""
        a, b = self.levels[first], self.levels[second]
        decided = (np.abs(a) > DECIDED) & (np.abs(b) > DECIDED)
        if decided.mean() > READABLE:
            return float(np.mean(a[decided] * b[decided] < 0)) > OPPOSITE
        if a.std() < 1e-3 or b.std() < 1e-3:
            return False
        return float(np.corrcoef(a, b)[0, 1]) < OPPOSITE_BLURRED


def _is_cosine(levels: np.ndarray, tolerance: float = 1.0) -> bool:
    """Return whether levels (n, p) are n steps of a cosine of many phases, within ``tolerance``
    times the limits."""
    if float(np.std(levels.mean(axis=0))) > MAX_SPREAD * tolerance:
        return False
    phasor = fit_cosine(levels)[1]
    is_weak = float(np.median(np.abs(phasor))) < DECIDED / tolerance
    if is_weak or _measure_misfit(levels) > MAX_MISFIT * tolerance:
        return False
    return 1 - measure_concentration(phasor) >= (1 - MAX_COMMON) / tolerance


def _measure_misfit(levels: np.ndarray) -> float:
    """Return the rms residual of a cosine fitted to levels (n, p), as a share of its median
    amplitude."""
    background, phasor = fit_cosine(levels)
    residual = levels - evaluate_cosine(background, phasor, len(levels))
    return float(np.sqrt(np.mean(residual**2))) / max(float(np.median(np.abs(phasor))), 1e-6)


def group_frames(reader: BlockReader) -> FrameBlocks:
    """Group the images into runs of phase steps, Gray codes and even light."""
    blocks = FrameBlocks(_detect_phase_runs(reader))
    steps = {image for run in blocks.runs for image in run.images}
    for are_steps, images in groupby(range(len(reader.levels)), steps.__contains__):
        if not are_steps:
            _split_segment(_pair_inverses(reader, list(images)), blocks)
    return blocks


def _detect_phase_runs(reader: BlockReader) -> list[PhaseRun]:
    """Detect runs of successive images that are all steps of one period."""
    runs, start, count = [], 0, len(reader.levels)
    while start < count:
        fitting = [
            run
            for n in range(3, min(MOST_STEPS, count - start) + 1)
            if (run := reader.run(tuple(range(start, start + n)))) is not None
        ]
        if fitting:
            # three steps fit anything
            runs.append(min(fitting, key=lambda run: run.misfit + 0.3 / len(run.images)))
            start = runs[-1].images[-1]
        start += 1
    return runs


def _pair_inverses(reader: BlockReader, images: list[int]) -> list[Bit]:
    """Return the bits of a segment, each with its inverse: the next image, or the one half a block
    later.

    Images without an inverse are returned as single bits.
    """
    bits = [reader.bit(image, None) for image in images]
    striped = [bit.image for bit in bits if bit.even is None]
    half = len(striped) // 2
    if (
        half > 1
        and len(striped) % 2 == 0
        and all(map(reader.are_opposite, striped[:half], striped[half:]))
    ):
        inverse = dict(zip(striped[:half], striped[half:], strict=True))
        return [
            reader.bit(bit.image, inverse.get(bit.image))
            for bit in bits
            if bit.image not in set(inverse.values())
        ]
    out: list[Bit] = []
    place = 0
    while place < len(images):
        here = bits[place : place + 2]
        # Stripes too fine to be read follow the pairs before them.
        blurred = (
            bool(out) and out[-1].inverse is not None and not any(bit.is_readable for bit in here)
        )
        if len(here) == 2 and (blurred or reader.are_opposite(here[0].image, here[1].image)):
            out.append(reader.bit(images[place], images[place + 1]))
            place += 1
        else:
            out.append(bits[place])
        place += 1
    return out


def _split_segment(bits: list[Bit], blocks: FrameBlocks) -> None:
    """Sort the images between two runs of phase steps into ``blocks``, in place."""
    striped = [bit for bit in bits if bit.even is None and bit.is_readable]
    rises = sum(b.count > a.count for a, b in pairwise(striped))
    is_reversed = 2 * rises < len(striped) - 1
    with_inverse = 2 * sum(bit.inverse is not None for bit in striped) > len(striped)
    waiting: list[Bit] = []
    block: list[Bit] = []
    for bit in bits[::-1] if is_reversed else bits:
        if bit.even is not None:
            waiting.append(bit)
            continue
        last = max((b.count for b in block if b.is_readable), default=0)
        if bit.is_readable and last > FEWEST_EDGES and bit.count < DROP * last:
            _add_block(block, blocks)
            block = []
        # Stripes grow finer within a code: what is even between two of its bits is a bit as well.
        block += waiting if block else _select_leading_bits(waiting, blocks.even, with_inverse)
        waiting = []
        block.append(bit)
    if block:
        _add_block(block, blocks)
    _record_even_images(waiting, blocks.even)


def _select_leading_bits(
    waiting: list[Bit], even: dict[int, Even], with_inverse: bool
) -> list[Bit]:
    """Return the most significant bits, black throughout the view, among the evenly illuminated
    images before a code.

    The other images are recorded in ``even``.
    """
    leading: list[Bit] = []
    while (
        waiting
        and waiting[-1].even == "black"
        and (waiting[-1].inverse is not None) == with_inverse
    ):
        leading.insert(0, waiting.pop())
    _record_even_images(waiting, even)
    return leading


def _record_even_images(bits: list[Bit], even: dict[int, Even]) -> None:
    """Record in ``even`` which images are evenly white or black, inverses included."""
    for bit in bits:
        assert bit.even is not None
        even[bit.image] = bit.even
        if bit.inverse is not None:
            even[bit.inverse] = "black" if bit.even == "white" else "white"


def _add_block(block: list[Bit], blocks: FrameBlocks) -> None:
    """Add successive bits to ``blocks`` as a Gray code, or as a doubt with the reason why they are
    none."""
    images = tuple(sorted(image for bit in block for image in bit.images))
    paired = {bit.inverse is not None for bit in block}
    readable = [bit for bit in block if bit.is_readable and bit.even is None]
    if not readable:
        blocks.doubts.append(
            (images, "they show neither phase steps, nor stripes of a code, nor even light")
        )
    elif len(block) > MOST_BITS:
        blocks.doubts.append(
            (images, f"{len(block)} bits of one code: no projector has so many lines")
        )
    elif len(paired) > 1:
        blocks.doubts.append(
            (images, "some of these bits are followed by their inverse, and some are not")
        )
    else:
        blocks.codes.append(GrayBlock(tuple(block)))
