"""Robust standard deviation of residuals, and least squares reweighted against outliers."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from slviewer.geometry.rigid import Floats

Solution = TypeVar("Solution")


def robust_sigma(residuals: Floats, about: float | None = None) -> float:
    """1.4826 times the median absolute deviation from the median, or from ``about``: the standard
    deviation of normal residuals, robust to outliers."""
    centre = np.median(residuals) if about is None else about
    return float(1.4826 * np.median(np.abs(residuals - centre)))


def tukey_weights(residuals: Floats, sigma: float) -> Floats:
    """Tukey's biweight at 4.685 sigma (95 % efficient on normal residuals): 0 beyond."""
    scaled = np.minimum(np.abs(residuals) / (4.685 * sigma), 1.0)
    return (1.0 - scaled**2) ** 2


def fit_reweighted(
    solve: Callable[[Floats], tuple[Solution, Floats]],
    values: np.ndarray,
    weights: Floats,
) -> Solution:
    """Iteratively reweighted least squares with Tukey's weights.

    ``solve(weights)`` returns a solution and its fitted values (n,); ``values`` (n,) are the
    observations, and ``weights`` (n,) one over the variance of each, known up to a factor. Ends
    when the fit moves by less than a hundredth of the residuals' robust sigma.
    """
    solution, fitted = solve(weights)
    rounding = 1e-12 * float(np.abs(values).max(initial=0.0))
    for _ in range(10):
        standardised = (values - fitted) * np.sqrt(weights / weights.max())
        sigma = robust_sigma(standardised)
        if sigma <= rounding:
            break
        before = fitted
        solution, fitted = solve(weights * tukey_weights(standardised, sigma))
        if np.sqrt(np.mean((fitted - before) ** 2)) < 0.01 * sigma:
            break
    return solution
