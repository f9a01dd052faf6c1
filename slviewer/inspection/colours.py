"""Deviations as colours."""

import numpy as np

from slviewer.errors import InputError

EXCLUDED_COLOUR = (150, 154, 160)
_AT = np.array([-1.0, -0.6, -0.25, 0.0, 0.25, 0.6, 1.0])
_RGB = np.array(
    [
        (26, 54, 140),
        (48, 126, 208),
        (150, 205, 232),
        (236, 238, 226),
        (250, 205, 120),
        (232, 112, 52),
        (150, 18, 38),
    ],
    np.float64,
)
"""From too little (blue) through none (near white) to too much (red): distinguishable with any
colour vision."""


def deviation_colours(signed: np.ndarray, limit: float) -> np.ndarray:
    """(n, 3) uint8 RGB of deviations (n,) mm from -limit to limit and beyond; grey for NaN."""
    if not limit > 0:
        raise InputError(f"A range of {limit:g} mm was given for the colours: give a positive one.")
    share = np.clip(np.nan_to_num(np.asarray(signed, np.float64) / limit), -1, 1)
    colours = np.stack([np.interp(share, _AT, _RGB[:, k]) for k in range(3)], axis=-1)
    colours[~np.isfinite(signed)] = EXCLUDED_COLOUR
    return np.asarray(np.round(colours), np.uint8)


def colour_limit(signed: np.ndarray, tolerance_mm: float | None = None) -> float:
    """Return half the range of the colour scale, mm: the tolerance, or the value that contains 99.5
    % of the points."""
    if tolerance_mm is not None:
        return tolerance_mm
    known = np.abs(signed[np.isfinite(signed)])
    return max(float(np.percentile(known, 99.5)), 1e-6) if known.size else 1.0
