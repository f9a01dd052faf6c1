"""How well a measurement repeats itself, which says nothing of how true it is."""

from collections.abc import Iterable

import numpy as np

from slviewer.errors import InputError
from slviewer.records.acceptance import StillCaptures

CAPTURES = 10
LEAST_CAPTURES = 3


def repeatability(measured: Iterable[tuple[np.ndarray, np.ndarray]]) -> StillCaptures:
    """Repeatability of captures given as (z, sigma_z), each (h, w) mm, NaN where invalid.

    Raises InputError for fewer than three captures, captures of different size, and for no pixel
    that all measured.
    """
    pairs = [(np.asarray(z, np.float32), np.asarray(sigma, np.float32)) for z, sigma in measured]
    count, shapes = len(pairs), {z.shape for z, _ in pairs}
    if len(shapes) > 1:
        raise InputError(
            f"captures of {' and '.join(map(str, shapes))} pixels do not repeat each other"
        )
    if count < LEAST_CAPTURES:
        raise InputError(
            f"{count} captures show no repeatability: take {CAPTURES} of the same still object"
        )
    depths, noise = (np.stack(maps) for maps in zip(*pairs, strict=True))
    depths -= depths[0].copy()  # small, so that squares keep their digits
    sigma = depths.std(axis=0, ddof=1)
    always = np.isfinite(sigma)
    if not always.any():
        raise InputError(
            "no pixel was measured in every capture: leave the object where it is, and in view"
        )
    levels = depths[:, always].mean(axis=1, dtype=np.float64)
    return StillCaptures(
        count,
        int(np.count_nonzero(always)),
        float(np.median(sigma[always])),
        float(np.percentile(sigma[always], 95)),
        float(np.nanmedian(np.sqrt((noise[:, always] ** 2).mean(axis=0)))),
        float(np.ptp(levels)),
    )
