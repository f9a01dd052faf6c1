"""Saturation below full scale: many samples at the brightest level that occurs."""

import numpy as np

WIDTHS = (1, 2, 4, 8)
"""Widths that a plateau may have, in parts of 255: JPEG and noise after the sensor widen it."""
LEAST_RANGE = 10
"""Widths that a pixel's levels must span, so that its fringe's crest is wider than one."""
ABOVE = 0.1
"""Samples above a plateau over those in it: noise and sharpening leave some."""
OVER_NEXT, OVER_NINE = 4.0, 0.6
"""Samples of a plateau over those of the next width below, and of the next nine: near its crest a
cosine has 2.4 and 0.46 times as many, and crests of several heights, or with noise, have less."""
BETWEEN = 0.2
"""Share of the samples of the brightest pixels that must lie between dark and bright: stripes have
none, and their white is not a plateau; a cosine of four times full scale has a fifth."""
COMB, OCCUPIED, COMPARED = 8.0, 0.25, 40
"""Largest over median bin of those compared below a plateau, above which the levels are too few to
be judged; and share of the bins below which they are."""
FEWEST_SAMPLES = 40
TAIL = 0.1
"""Share of a plateau's samples that lie below the level that is returned."""


def find_plateau(levels: np.ndarray, full_scale: float) -> float | None:
    """Return the level, below ``full_scale``, from which samples (n, p) of whole grey levels are
    saturated; None where no plateau shows.

    ``levels``: of p pixels in n frames of phase steps, or of one image (1, p), of which only a
    plateau of a single level shows: a scene may be evenly bright.
    """
    is_image = len(levels) == 1
    if not is_image and levels.size:  # frames that show something else may be evenly white
        crests = (levels > levels.max() - max(WIDTHS) * full_scale / 255).sum(axis=1)
        levels = levels[np.argsort(crests)[: len(levels) - len(levels) // 5]]
    top = int(levels.max(initial=0))
    span = levels.max(axis=0, initial=0) - levels.min(axis=0, initial=top)
    if top >= full_scale:
        return None
    for width in WIDTHS[: 1 if is_image else None]:
        step = width * full_scale / 255
        is_wide = span >= max(0.1 * top, LEAST_RANGE * step)
        own = levels if is_image else np.compress(is_wide, levels, axis=1)
        occurring = np.flatnonzero(counts := np.bincount(own.ravel(), minlength=1))
        # levels of fewer bits than the images have are further apart
        size = max(float(np.diff(occurring).min(initial=top)), full_scale / 255)
        bins = np.bincount(((top - occurring) / size).astype(np.intp), counts[occurring])
        end = size * _find_end(bins, width)
        if end and (is_image or _has_between(top - own.astype(np.int32), end)):
            reaching = np.cumsum(counts[: int(top - end) : -1])
            return float(top - np.searchsorted(reaching, (1 - TAIL) * reaching[-1]))
    return None


def _find_end(counts: np.ndarray, width: int) -> int:
    """Return the bin behind a plateau of ``width`` bins, by the samples in each from the brightest
    level down; 0 where there is none."""
    total = np.concatenate([[0], np.cumsum(counts[: 12 * max(WIDTHS)])])
    first = np.arange(2 * max(WIDTHS))[:, None]
    at = np.minimum(first + width * np.array([0, 1, 2, 10]), len(total) - 1)
    above, end, following, ninth = total[at].T
    own = end - above
    beside = np.maximum(OVER_NEXT * (following - end), OVER_NINE * (ninth - end))
    found = np.flatnonzero((own >= np.maximum(beside, FEWEST_SAMPLES)) & (above <= ABOVE * own))
    if not found.size:
        return 0
    stop = int(at[found[0], 1])
    below = counts[stop:][:COMPARED]
    if np.count_nonzero(below) < COMPARED * OCCUPIED:
        return 0
    is_comb = below.max() * COMB > max(own[found[0]], COMB * COMB * np.median(below))
    return 0 if is_comb else stop


def _has_between(below: np.ndarray, end: float) -> bool:
    """Return whether pixels that reach a plateau down to ``end``, by what their samples (n, p) are
    below the brightest level, show levels between it and their darkest."""
    below = below[:, below.min(axis=0, initial=1 << 16) < end]
    return ((below > end) & (below < 0.9 * below.max(axis=0))).sum() > BETWEEN * below.size
