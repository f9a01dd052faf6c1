"""Threshold of Gray bits relative to the middle of black and white."""

import numpy as np

from slviewer.fringe.layout import Layout
from slviewer.fringe.noise import sample

MIDDLE = 0.5
FARTHEST = 0.3
"""Largest distance of the share from the middle: beyond it, the estimate is wrong rather than an
effect of gamma."""


def fringe_mean(layout: Layout, stack: np.ndarray) -> float:
    """Return the mean of the fringes relative to black (0) and white (1): 0.5 without gamma, 0.37
    at a gamma of 2.2.

    Bits without inverses are thresholded at this mean, so that a blurred edge moves towards the
    dark side where it is below the middle. Blur does not change the mean, hence one value is valid
    for the whole image: the median over sampled pixels with both a black and a white bit. 0.5 where
    there are inverses, or no such pixels.
    """
    if layout.inverse or not (layout.shifts and layout.gray):
        return MIDDLE
    fringes, bits = (sample(stack, indices) for indices in (layout.shifts[-1].indices, layout.gray))
    mean, swing = fringes.mean(axis=0, dtype=np.float32), 0.25 * np.ptp(fringes, axis=0)
    above, below = bits.max(axis=0) - mean, mean - bits.min(axis=0)
    both = (above > swing) & (below > swing) & (swing > 1)
    if np.count_nonzero(both) < 100:
        return MIDDLE
    share = float(np.median(below[both] / (above[both] + below[both])))
    return share if abs(share - MIDDLE) < FARTHEST else MIDDLE
