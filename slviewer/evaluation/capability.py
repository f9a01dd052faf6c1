"""Capability of a process: Cp and Cpk of a sample against limits, with their confidence
intervals."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2, norm

from slviewer.records.inspection import Capability

CONFIDENCE = 0.95
MIN_PARTS = 3


def process_capability(
    values: Sequence[float], lower: float | None, upper: float | None
) -> Capability | None:
    """Estimate the capability of a process; None for fewer than 3 values, without a limit, or where
    they do not vary.

    Cp's interval is exact for normal values (chi squared), Cpk's is Bissell's approximation
    (Applied Statistics 39, 1990). The spread of the values includes that of the measurement.
    """
    x = np.asarray(values, np.float64)
    n = len(x)
    low, high = -np.inf if lower is None else lower, np.inf if upper is None else upper
    if (
        n < MIN_PARTS
        or not np.isfinite([low, high]).any()
        or not (sigma := float(x.std(ddof=1))) > 0
    ):
        return None
    mean, tail = float(x.mean()), (1 - CONFIDENCE) / 2
    cp = None
    if np.isfinite(high - low):
        value = (high - low) / (6 * sigma)
        ends = value * np.sqrt(chi2.ppf([tail, 1 - tail], n - 1) / (n - 1))
        cp = (value, float(ends[0]), float(ends[1]))
    cpk = min(mean - low, high - mean) / (3 * sigma)
    reach = float(norm.ppf(1 - tail) * np.sqrt(1 / (9 * n) + cpk**2 / (2 * (n - 1))))
    return Capability(n, mean, sigma, cp, (cpk, cpk - reach, cpk + reach))
