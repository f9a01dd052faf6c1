"""Detection of coded frames that are alike although they should differ, and of uneven white and
black frames."""

import numpy as np

from slviewer.fringe.axis_agreement import REACH
from slviewer.fringe.axis_reader import INSIDE
from slviewer.fringe.line_sample import LineSample, coded_frames
from slviewer.fringe.sequence import Axis, PatternSequence

FEWEST = 500
"""Number of pixels below which frames are not compared."""
ALIKE = 0.04
"""Squared difference of two images over the variance of the pattern that one shows: between two
patterns of a code, which have no edge in common, it is 1 and more."""
LEAST_PATTERN = 0.05
"""Standard deviation of the pattern as a share of the contrast; below it images are evenly
illuminated, or blurred."""
DECIDED, SHARP = 0.2, 0.5
"""Distance from the middle, as a share of the contrast, from which a pixel is not an edge; and
share of such pixels in an image whose stripes are not blurred: blurred ones of two patterns may
look alike."""
FEWEST_EDGES = 30
EVEN = 0.25
"""Mean distance from the middle, as a share of the contrast, of an image that is white (above) or
black (below)."""


class FrameLikeness:
    """Comparison of the frames of a capture by their levels: -0.5 the darkest of each pixel, 0.5
    the brightest."""

    def __init__(self, sequence: PatternSequence, sample: LineSample) -> None:
        """Normalise the levels of the pixels of ``sample`` that vary and are not clipped."""
        self._sequence = sequence
        even = [i for i, frame in enumerate(sequence.frames) if frame.kind in ("white", "black")]
        self._images = sorted({*coded_frames(sequence), *even})
        high, low = (extreme(sample.frames[self._images], axis=0) for extreme in (np.max, np.min))
        pixels = np.flatnonzero((high - low > sample.least_swing) & (high < sample.white))
        contrast = (high - low)[pixels]
        self._levels = (sample.frames[:, pixels] - (high + low)[pixels] / 2) / np.maximum(
            contrast, 1e-6
        )
        self._weight = contrast / max(float(np.sum(contrast)), 1e-6)
        self._finest = {axis: self._select_finest_opposed_bit(axis) for axis in sequence.axes}
        self._near = (np.diff(sample.place[pixels]) <= REACH[0]) & (
            np.diff(sample.line[pixels]) == 0
        )

    def repeated(self) -> list[tuple[int, int]]:
        """Return pairs (i, j < i) of images of which i repeats j although another pattern is
        described.

        Phase steps are compared with other frames only: among themselves neighbours differ little.
        """
        if len(self._weight) < FEWEST:
            return []
        root = np.sqrt(self._weight)
        weighted = self._levels[self._images] * root
        product = (weighted @ weighted.T).astype(np.float64)
        square = np.diagonal(product)
        difference = square[:, None] + square - 2 * product
        variance = square - (weighted @ root).astype(np.float64) ** 2
        pairs = []
        for a, i in enumerate(self._images):
            for b, j in reversed([*enumerate(self._images[:a])]):
                if difference[a, b] < ALIKE and self._are_alike(
                    i, j, float(difference[a, b]), float(variance[a])
                ):
                    pairs.append((i, j))
                    break
        return pairs

    def is_even(self, index: int, image: int | None) -> bool:
        """Return whether a white or black frame is bright or dark in this image.

        True for other frames, or without an image.
        """
        kind = self._sequence.frames[index].kind
        if image is None or kind not in ("white", "black") or len(self._weight) < FEWEST:
            return True
        mean = float(self._weight @ self._levels[image])
        return mean > EVEN if kind == "white" else mean < -EVEN

    def _are_alike(self, i: int, j: int, difference: float, variance: float) -> bool:
        """Return whether image ``i`` shows the pattern of image ``j``, beyond what blur
        explains."""
        frames = self._sequence.frames
        if frames[i].kind == frames[j].kind == "phase":
            return False
        if self._are_opposite(i, j):
            return True
        if variance < LEAST_PATTERN**2:
            return False
        return self._is_copy(i, j) or (difference < ALIKE * variance and self._is_striped(i))

    def _is_copy(self, i: int, j: int) -> bool:
        """Return whether two images are equal in every grey level."""
        return bool(np.array_equal(self._levels[i], self._levels[j]))

    def copied(self, i: int) -> int | None:
        """Return the latest earlier image that image ``i`` equals in every grey level; None if
        there is none.

        Evenly illuminated images may be equal without noise.
        """
        earlier = [j for j in self._images if j < i] if len(self._weight) >= FEWEST else []
        return next((j for j in reversed(earlier) if self._is_copy(i, j)), None)

    def _is_striped(self, i: int) -> bool:
        """Return whether an image shows stripes that are not blurred."""
        bright = self._levels[i] > 0
        edges = np.count_nonzero((bright[1:] != bright[:-1]) & self._near)
        return bool(edges >= FEWEST_EDGES and np.mean(np.abs(self._levels[i]) > DECIDED) > SHARP)

    def _select_finest_opposed_bit(self, axis: Axis) -> int:
        """Return the finest bit of an axis that differs from its inverse; -1 if none does.

        Blur makes finer ones one grey.
        """
        images = {
            kind: {self._sequence.frames[i].bit: i for i in self._sequence.find(kind, axis)}
            for kind in ("gray", "inverse")
        }
        bits = images["gray"].keys() & images["inverse"].keys()
        opposed = (
            b
            for b in bits
            if self._measure_difference(images["gray"][b], images["inverse"][b]) > ALIKE
        )
        return max(opposed, default=-1)

    def _measure_difference(self, i: int, j: int) -> float:
        """Return the weighted mean squared difference of two images, relative to the contrast."""
        return float(self._weight @ (self._levels[i] - self._levels[j]) ** 2)

    def _are_opposite(self, i: int, j: int) -> bool:
        """Return whether two frames are described as bright and dark, and their images are not
        blurred to one grey."""
        a, b = self._sequence.frames[i], self._sequence.frames[j]
        if {a.kind, b.kind} not in ({"gray", "inverse"}, {"white", "black"}) or (a.axis, a.bit) != (
            b.axis,
            b.bit,
        ):
            return False
        if a.axis is not None and a.bit > self._finest[a.axis]:
            return False
        return bool(np.mean(np.abs(self._levels[i]) > INSIDE) > SHARP)
