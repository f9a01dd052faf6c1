"""Sample of a capture's pixels, each with a neighbour on either side."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.examination import limits
from slviewer.fringe.cosines import estimate_roughness
from slviewer.fringe.layout import white_level
from slviewer.fringe.sequence import Axis, PatternSequence


@dataclass(frozen=True, eq=False)
class Sample:
    """Grey levels of p pixels and of their neighbours, in all n frames.

    ``levels`` (n, 3, p) float32: of the neighbour before each pixel, the pixel, and the neighbour
    behind it, along the direction of the image in which the axis varies. ``place`` (p, 2): row and
    column as shares of the image, -0.5 to 0.5. ``swing`` (p,): range of levels over the frames.
    ``direction``: index of the direction in ``place``. The first ``few`` pixels are a small sample
    of all. ``reach_px``: distance between the two neighbours of a pixel.
    """

    levels: np.ndarray
    place: np.ndarray
    swing: np.ndarray
    direction: int
    few: int
    reach_px: int

    def part(self, pixels: slice | np.ndarray) -> "Sample":
        """Return the sample of some pixels."""
        levels, place, swing = self.levels[:, :, pixels], self.place[pixels], self.swing[pixels]
        return replace(self, levels=levels, place=place, swing=swing)


@dataclass(frozen=True, eq=False)
class CaptureSample:
    """Samples by axis, of those whose patterns vary over the view.

    ``lit``: share of the image that varies with the patterns; ``saturated``: share that is
    saturated too often to be used; ``noise``: grey levels by which neighbours differ; ``swing``:
    median range of a pixel's levels over the frames; ``white``: level at which the camera clips.
    """

    by_axis: dict[Axis, Sample]
    lit: float
    saturated: float
    noise: float
    swing: float
    white: float

    @property
    def is_usable(self) -> bool:
        """Whether the pixels of each axis are enough to be judged."""
        counts = [sample.levels.shape[2] for sample in self.by_axis.values()]
        return self.lit >= limits.LEAST_LIT and min(counts, default=0) >= limits.FEWEST_PIXELS


def sample_capture(sequence: PatternSequence, stack: np.ndarray) -> CaptureSample:
    """Sample the frames (n, h, w) of a capture on a grid, without pixels that clip often."""
    coded = [i for i, frame in enumerate(sequence.frames) if frame.axis]
    height, width = stack.shape[1:]
    reach = max(1, min(limits.REACH_PX, min(height, width) // 40))
    count = min(int(np.sqrt(limits.CENTRES * height / width)), height)
    rows = np.unique(np.linspace(reach, height - 1 - reach, max(count, 1)).astype(int))
    columns = np.linspace(reach, width - 1 - reach, min(limits.CENTRES // len(rows), width))
    columns = np.unique(columns.astype(int))
    around = [(0, 0), (0, -reach), (0, reach), (-reach, 0), (reach, 0)]
    cross = np.stack(
        [stack[:, rows + dv][:, :, columns + du].reshape(len(stack), -1) for dv, du in around],
        axis=1,
    ).astype(np.float32)  # (n, 5, p)
    high, low = _list_extremes(cross[coded])
    white = white_level(sequence, stack, coded)
    some = stack[coded[:: max(1, len(coded) // 6)]][:, rows[::8]].astype(np.float32)
    noise = estimate_roughness(some.reshape(len(some), -1), width)
    least = max(limits.DARK_SHARE * white, limits.DARK_SIGMAS * noise)
    # a lamp that is switched on makes all pixels vary, but in one group of frames only
    groups = _group_frames(sequence)
    ranges = [np.subtract(*_list_extremes(cross[own])) for own in groups]
    lit = high - low > least
    lit &= np.sum([r > least for r in ranges], axis=0) >= min(2, len(groups))
    often = (cross[coded] >= white).mean(axis=0).max(axis=0) > limits.OFTEN_CLIPPED
    # Gray code alone is read where it is saturated
    excluded = often & any(sequence.phase_shifts(axis) for axis in sequence.axes)
    usable, swing = lit.all(axis=0) & ~excluded, (high - low)[0]
    place = np.stack(
        np.meshgrid(rows / (height - 1) - 0.5, columns / (width - 1) - 0.5, indexing="ij"), -1
    )
    by_axis: dict[Axis, Sample] = {}
    for axis in sequence.axes:
        own = cross[[i for i in coded if sequence.frames[i].axis == axis]][:, :, usable]
        across, along = (float(np.abs(own[:, a] - own[:, a + 1]).sum()) for a in (1, 3))
        if max(across, along) < limits.VARIES * noise * own[:, 0].size:
            continue  # all pixels see the same coordinate
        order = [1, 0, 2] if across >= along else [3, 0, 4]
        chosen, few = _choose_pixels(own[:, order], swing[usable])
        chosen = np.flatnonzero(usable)[chosen]
        by_axis[axis] = Sample(
            cross[:, order][:, :, chosen], place.reshape(-1, 2)[chosen], swing[chosen],
            order[0] // 2 ^ 1, few, 2 * reach,
        )  # fmt: skip
    shares = float(lit[0].mean()), float(often.mean())
    return CaptureSample(by_axis, *shares, noise, float(np.median(swing)), white)


def _group_frames(sequence: PatternSequence) -> list[list[int]]:
    """Return the frames of each axis and period, and of its bits, in which a pixel's levels
    differ."""
    groups = list[list[int]]()
    for axis in sequence.axes:
        groups += [list(steps) for _, steps in sequence.phase_shifts(axis)]
        bits = [i for i, f in enumerate(sequence.frames) if f.axis == axis and f.kind != "phase"]
        groups += [bits] if len(bits) > 1 else []
    return groups


def _list_extremes(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the second largest and the second smallest level (...) of frames (n, ...): one frame
    that shows something else lights pixels that the patterns do not reach.

    Of few frames, the largest and the smallest: the second ones may be equal in a sound capture.
    """
    if len(levels) < limits.FEW_FRAMES:
        return levels.max(axis=0), levels.min(axis=0)
    high, low = levels[:2].max(axis=0), levels[:2].min(axis=0)
    second_high, second_low = low.copy(), high.copy()
    for frame in levels[2:]:
        np.maximum(second_high, np.minimum(high, frame), out=second_high)
        np.maximum(high, frame, out=high)
        np.minimum(second_low, np.maximum(low, frame), out=second_low)
        np.minimum(low, frame, out=low)
    return second_high, second_low


def _choose_pixels(levels: np.ndarray, swing: np.ndarray) -> tuple[np.ndarray, int]:
    """Choose pixels evenly, and more where a frame changes from one neighbour to the other: edges
    of wide stripes are few, and all that is known about them.

    ``levels`` (n, 3, p), ``swing`` (p,). Second, the size of the small sample at the beginning.
    """
    pixels = np.random.default_rng(0).permutation(len(swing))
    steep = np.abs(levels[:, 2] - levels[:, 0])[:, pixels] > limits.STEEP * swing[pixels]
    edges = [pixels[np.flatnonzero(frame)[: limits.PER_FRAME]] for frame in steep]
    part = limits.COARSE
    few = [pixels[: limits.EVEN // part], *(e[: limits.PER_FRAME // part] for e in edges)]
    first = list(dict.fromkeys(np.concatenate(few).tolist()))
    every = np.unique(np.concatenate([pixels[: limits.EVEN], *edges]))
    return np.array([*first, *np.setdiff1d(every, first)], int), len(first)
