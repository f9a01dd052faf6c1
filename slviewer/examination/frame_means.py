"""Means of frames that equal light makes equal, over the image and over its rows.

They show light that varies whatever the patterns are: a response that is not linear, blur and
motion imitate it at the pixels, but hardly in these means.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from slviewer.examination import limits
from slviewer.fringe.frame_light import FrameLight, list_shifts
from slviewer.fringe.sequence import PatternSequence


def evaluate_waves(row: np.ndarray, light: FrameLight) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine of the light's wave at rows (p,), -0.5 to 0.5."""
    angle = 2 * np.pi * light.cycles * (row + 0.5)
    return np.cos(angle), np.sin(angle)


def measure_unequal_means(
    sequence: PatternSequence, stack: np.ndarray, light: FrameLight
) -> np.ndarray:
    """Measure the relative standard deviation (3, g) of each of g groups of means that are equal
    under equal light: as captured, and without the light's gains and room light; and that of the
    gains, which room light would have to balance where the means do not vary.

    A surface that moves, and blur, imitate varying light, but not in these means.
    """
    means = _measure_means(stack)
    # without the light of the room the mean is smaller, and the differences are the same
    equalized = (means - light.room * means.mean()) / light.gain
    pairs = ((means, means), (equalized, means), (light.gain, light.gain))
    groups = [*_list_equal_sums(sequence)]
    spreads = [
        [np.std(values[g].sum(axis=1)) / whole[g].sum(axis=1).mean() for g in groups]
        for values, whole in pairs
    ]
    return np.array(spreads).reshape(3, -1)


def measure_drift(sequence: PatternSequence, stack: np.ndarray) -> float:
    """Return by how much the logarithm of the light grows from frame to frame; 0 where the means
    do not show it, or it is too little to be reported.

    What imitates gains depends on the pattern, and a drift of the light on time alone: the means of
    a bit and its inverse, and of all steps of a period, are equal whatever they show.
    """
    *_, last = [np.empty((0, 0), int), *_list_equal_sums(sequence)]
    shifts = list_shifts(sequence)
    equal = shifts if len(shifts) > 1 else [*last]
    if len(equal) < 2 or len(equal[0]) < 2:
        return 0.0
    means = _measure_means(stack)
    time = np.array([np.mean(members) for members in equal])
    logs = np.log([max(means[[*members]].mean(), 1e-6) for members in equal])
    rate, start = np.polyfit(time, logs, 1)
    if len(equal) > 2:
        left, whole = np.std(logs - rate * time - start), np.std(logs)
        is_steady = left < limits.LEFT_BY_DRIFT * whole
    else:  # a line fits two: it goes on within each of them
        slope = _measure_slope(np.log(np.maximum(means, 1e-6)), equal)
        is_steady = abs(slope - rate) < abs(rate) / 2
    return float(rate) if is_steady and abs(rate) * len(stack) > limits.REPORTED else 0.0


def _measure_slope(logs: np.ndarray, groups: Sequence[Sequence[int]]) -> float:
    """Return by how much the logarithm of the means (n,) grows from step to step within periods,
    beside a cosine of their number, which few fringes in view leave; NaN for three steps."""
    products = np.zeros(2)
    for group in groups:
        turns = 2 * np.pi * np.arange(len(group)) / len(group)
        basis = np.linalg.qr(np.stack([np.ones(len(group)), np.cos(turns), np.sin(turns)], 1))[0]
        step = np.arange(len(group)) - basis @ (basis.T @ np.arange(len(group)))
        products += step @ logs[[*group]], step @ step
    return float(products[0] / products[1]) if products[1] > 1e-9 else np.nan


def _measure_means(stack: np.ndarray) -> np.ndarray:
    """Return the mean grey level (n,) of each image."""
    return stack[:, :: limits.MEAN_ROWS, :: limits.MEAN_COLUMNS].mean(axis=(1, 2))


def shows_wave(sequence: PatternSequence, stack: np.ndarray, light: FrameLight) -> bool:
    """Return whether the means of image rows vary among frames that are equal under equal light as
    the light's wave does: gamma imitates a wave at the pixels, but not in the mean over fringes."""
    rows = stack[:, :, :: limits.MEAN_COLUMNS].mean(axis=2)
    waves = np.stack(evaluate_waves(np.linspace(-0.5, 0.5, rows.shape[1]), light))
    products = {kind: np.zeros(3) for kind in limits.SEEN_OF_ROWS}
    for group in _list_equal_sums(sequence):
        first = sequence.frames[group[0, 0]]
        if group.shape[1] > 2 or (first.kind == "phase" and first.axis == "y"):
            continue  # a whole period averages a wave, and fringes are along the rows
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
    """Yield groups (g, m) of frames whose sums of m means are equal: steps of the finest period of
    an axis where many fringes are in view, bits with their inverses, and all steps of periods; the
    last group has the most equal ones."""
    for axis in sequence.axes:
        for _, steps in sequence.phase_shifts(axis)[-1:]:
            yield np.array(steps)[:, None]
    bits = [i for axis in sequence.axes for i in sequence.bits("gray", axis)]
    inverse = [i for axis in sequence.axes for i in sequence.bits("inverse", axis)]
    if bits and len(bits) == len(inverse):
        yield np.array([bits, inverse]).T
    shifts = list_shifts(sequence)
    if len(shifts) > 1 and len({*map(len, shifts)}) == 1:
        yield np.array(shifts)
