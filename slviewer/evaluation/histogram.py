"""Error maps of several models as histograms that can be laid over each other."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError


@dataclass(frozen=True, eq=False)
class Histogram:
    """Error histograms on one common scale: ``edges`` (n + 1,) mm, ``counts`` (n,) and ``beyond`` by name."""

    edges: np.ndarray
    counts: dict[str, np.ndarray]
    beyond: dict[str, int]


def histogram(error_maps: Mapping[str, np.ndarray], bins: int = 80) -> Histogram:
    """Histograms of error maps (mm, NaN where invalid) over one range, symmetric about 0, that all of them share.

    The range holds 99.5 % of the errors of the widest map; how many lie beyond is told for each.
    """
    errors = {name: error[np.isfinite(error)] for name, error in error_maps.items()}
    if not errors or any(values.size == 0 for values in errors.values()):
        raise InputError("An error map without a single measured pixel has no histogram: evaluate a capture first.")
    limit = max(max(float(np.percentile(np.abs(values), 99.5)) for values in errors.values()), 1e-6)
    edges = np.linspace(-limit, limit, bins + 1)
    counts = {name: np.histogram(values, edges)[0] for name, values in errors.items()}
    return Histogram(edges, counts, {name: int(errors[name].size - counts[name].sum()) for name in errors})
