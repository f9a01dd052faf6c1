"""What the projector throws on a surface: profiles blurred by its optics, tabulated for the frame
kernel."""

from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtr

OVERSAMPLING = 8
"""Table entries per projector px; linear between them costs 2e-4 of an 18 px fringe's modulation,
and no phase."""

LEVELS = 9
"""Blurs that are tabulated, from sharpest to widest; linear between them."""

_MARGIN = 2  # px that a table holds beyond either end of the projector
OFFSET = _MARGIN * OVERSAMPLING
"""Entry i of a table is at (i - OFFSET) / OVERSAMPLING px."""


def blur_levels(blur_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(sigmas (LEVELS,), level (...) float32): tabulated sigmas that span `blur_px`, and where
    between them each lies.

    `blur_px` in projector columns; NaN gives level 0.
    """
    finite = blur_px[np.isfinite(blur_px)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (1.0, 1.0)
    high = max(high, low + 1e-3)
    sigmas = np.linspace(low, high, LEVELS)
    level = (LEVELS - 1) * (np.nan_to_num(blur_px, nan=low) - low) / (high - low)
    return sigmas, np.clip(level, 0, LEVELS - 1).astype(np.float32)


def blurred_profile(values: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Table (LEVELS, n OVERSAMPLING + 2 OFFSET) float32 of `values` (n,) in 0 ... 1, one per
    projector px, as light after the pixel's box and a Gaussian of each sigma (px).

    Beyond its ends the profile continues with its end values: `window` darkens what lies outside
    the projector.
    """
    weights, reach = _compute_weights(tuple(sigmas.tolist()))
    windows = sliding_window_view(
        np.pad(values.astype(np.float32), reach + _MARGIN, mode="edge"), 2 * reach + 1
    )
    table = np.tensordot(windows, weights, 1)  # (px, within, sigma)
    return np.ascontiguousarray(table.reshape(-1, len(sigmas)).T)


@lru_cache(8)
def _compute_weights(sigmas: tuple[float, ...]) -> tuple[np.ndarray, int]:
    """(2 reach + 1, OVERSAMPLING, LEVELS) float32: what each projector px adds at each place within
    one; and reach."""
    reach = int(np.ceil(4.5 * max(sigmas))) + 1
    around = np.arange(-reach, reach + 1)[:, None, None]
    within = (np.arange(OVERSAMPLING) / OVERSAMPLING)[:, None]
    # A box pixel seen from `within` is a difference of two Gaussian integrals.
    right, left = (ndtr((around + edge - within) / np.array(sigmas)) for edge in (0.5, -0.5))
    return ((right - left) / (right - left).sum(0)).astype(np.float32), reach


def window(coordinate: np.ndarray, extent: int, blur_px: np.ndarray) -> np.ndarray:
    """Share 0 ... 1 of the projector's light at `coordinate` px, across the edges of its `extent`
    px; 0 where NaN."""
    low, high = (coordinate + 0.5) / blur_px, (extent - 0.5 - coordinate) / blur_px
    return np.nan_to_num(ndtr(low) * ndtr(high))
