"""The spread of residuals that stray values do not move, and weights that leave those values out."""

import numpy as np


def robust_sigma(residuals: np.ndarray) -> float:
    """1.4826 times the median absolute deviation: normal residuals' standard deviation, stray ones or not."""
    return float(1.4826 * np.median(np.abs(residuals - np.median(residuals))))


def tukey_weights(residuals: np.ndarray, sigma: float) -> np.ndarray:
    """Tukey's biweight at 4.685 sigma (95 % efficient on normal residuals): 0 beyond, so an outlier pulls no more."""
    scaled = np.minimum(np.abs(residuals) / (4.685 * sigma), 1.0) if sigma > 0 else (residuals != 0).astype(float)
    weights: np.ndarray = (1.0 - scaled**2) ** 2
    return weights
