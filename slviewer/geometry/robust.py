"""Robust standard deviation of residuals, and least squares reweighted against outliers."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats, Floats32

Solution = TypeVar("Solution")
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
"""Median length of a 2D error whose components are normal, in their standard deviation."""


def robust_sigma(residuals: Floats, about: float | None = None) -> float:
    """1.4826 times the median absolute deviation from the median, or from ``about``: the standard
    deviation of normal residuals, robust to outliers."""
    centre = np.median(residuals) if about is None else about
    return float(1.4826 * np.median(np.abs(residuals - centre)))


def weighted_median(values: Floats | Floats32, weights: Floats | Floats32) -> float:
    """The median of values of these weights, all above 0."""
    return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))


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


@kernel()
def select(values, count, wanted):
    """Return what has the index ``wanted`` among the first ``count`` values (n,), sorted.

    Hoare's selection, which reorders them; numba's sort and median take seconds to compile.
    """
    first, last = 0, count - 1
    while first < last:
        pivot, i, j = values[wanted], first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if j < wanted < i:
            break
        if wanted >= i:
            first = i
        else:
            last = j
    return values[wanted]


@kernel()
def median_of(values, count):
    """Return the median of the first ``count`` values (n,), which are reordered."""
    upper = select(values, count, count // 2)
    return upper if count % 2 else 0.5 * (upper + select(values, count, count // 2 - 1))
