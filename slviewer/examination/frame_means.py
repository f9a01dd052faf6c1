"""Means of frames that equal light makes equal, over the image and over its rows.

They show light that varies whatever the patterns are: a response that is not linear, blur and
motion imitate it at the pixels, but hardly in these means.
"""

from collections.abc import Iterator

import numpy as np

from slviewer.examination import limits
from slviewer.fringe.frame_light import FrameLight
from slviewer.fringe.sequence import PatternSequence


def evaluate_waves(row: np.ndarray, light: FrameLight) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine of the light's wave at rows (p,), -0.5 to 0.5."""
    angle = 2 * np.pi * light.cycles * (row + 0.5)
    return np.cos(angle), np.sin(angle)


def measure_unequal_means(
    sequence: PatternSequence, stack: np.ndarray, light: FrameLight
) -> tuple[float, float, float]:
    """Measure the largest relative standard deviation of means of frames equal under equal light:
    as captured, and without the light's gains and room light; and that of the gains, which room
    light would have to balance where the means do not vary.

    Equal are the steps of the finest period of an axis, and the sums of a bit and its inverse. A
    surface that moves, and blur, imitate varying light, but not in these means.
    """
    means = stack[:, :: limits.MEAN_ROWS, :: limits.MEAN_COLUMNS].mean(axis=(1, 2))
    # without the light of the room the mean is smaller, and the differences are the same
    equalized = (means - light.room * means.mean()) / light.gain
    spreads = []
    for values, whole in ((means, means), (equalized, means), (light.gain, light.gain)):
        spreads.append(
            max(
                (
                    float(np.std(values[group].sum(axis=1)) / whole[group].sum(axis=1).mean())
                    for group in _list_equal_sums(sequence)
                ),
                default=0.0,
            )
        )
    return spreads[0], spreads[1], spreads[2]


def shows_wave(sequence: PatternSequence, stack: np.ndarray, light: FrameLight) -> bool:
    """Return whether the means of image rows vary among frames that are equal under equal light as
    the light's wave does: gamma imitates a wave at the pixels, but not in the mean over fringes."""
    rows = stack[:, :, :: limits.MEAN_COLUMNS].mean(axis=2)
    waves = np.stack(evaluate_waves(np.linspace(-0.5, 0.5, rows.shape[1]), light))
    products = {kind: np.zeros(3) for kind in limits.SEEN_OF_ROWS}
    for group in _list_equal_sums(sequence):
        first = sequence.frames[group[0, 0]]
        if first.kind == "phase" and first.axis == "y":
            continue  # the fringes are along the rows
        sums = rows[group].sum(axis=1)
        excess = sums / np.maximum(sums.mean(axis=0), 1e-6) - 1
        seen = (excess - excess.mean(axis=1, keepdims=True)) @ waves.T * (2 / rows.shape[1])
        own = light.wave[group].mean(axis=1)
        own = own - own.mean(axis=0)
        products[first.kind] += np.sum(seen * own), np.sum(seen**2), np.sum(own**2)
    kind = "phase" if products["phase"].any() else "gray"
    (share, seen, own), (fewest, most) = products[kind], limits.SEEN_WAVE
    is_alike = share > 0 and share**2 > limits.SEEN_OF_ROWS[kind] * seen * own
    return bool(is_alike and fewest < share / own < most)


def _list_equal_sums(sequence: PatternSequence) -> Iterator[np.ndarray]:
    """Yield groups (g, 1 or 2) of frames whose means, or sums of means, are equal."""
    for axis in sequence.axes:
        for _, steps in sequence.phase_shifts(axis)[-1:]:
            yield np.array(steps)[:, None]
        bits, inverse = sequence.bits("gray", axis), sequence.bits("inverse", axis)
        if bits and len(bits) == len(inverse):
            yield np.array([bits, inverse]).T
