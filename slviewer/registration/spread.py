"""How far apart aligned scans lie, at each point of the surface that they were merged to."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_NEIGHBOURS = 6
"""Points of the coarsest scan that are averaged, so that the noise of single points matters less;
of a finer scan those of an area as large, as curvature moves the mean of a larger one."""
_MOST_NEIGHBOURS = 64
_REACH = 5.0
"""Greatest distance of these points, in spacings of the coarsest scan."""


def measure_spread(
    points: NDArray[np.floating], normals: NDArray[np.floating], scans: Sequence[NDArray]
) -> NDArray[np.float32]:
    """Return how far apart the scans lie along the normal at each point: (n,) mm, NaN where fewer
    than two are near, or where the normal is unknown.

    ``points``, ``normals`` (n, 3): of the merged surface. ``scans``: points (m, 3) mm of each, in
    the same frame.
    """
    trees = [cKDTree(np.asarray(scan, np.float64)) for scan in scans if len(scan) > 20]
    if len(trees) < 2:
        return np.full(len(points), np.nan, np.float32)
    spacing = np.array([np.median(tree.query(tree.data[::20], k=2)[0][:, 1]) for tree in trees])
    coarsest = float(spacing.max())
    low, high = np.full((2, len(points)), np.nan)
    count = np.zeros(len(points), int)
    for tree, its_own in zip(trees, spacing, strict=True):
        wanted = _NEIGHBOURS * (coarsest / max(float(its_own), 1e-9)) ** 2
        k = int(np.clip(round(wanted), _NEIGHBOURS, min(_MOST_NEIGHBOURS, tree.n)))
        away, index = tree.query(points, k, distance_upper_bound=_REACH * coarsest, workers=-1)
        near = np.isfinite(away).all(axis=1)
        offset = tree.data[np.where(near[:, None], index, 0)].mean(axis=1) - points
        height = np.where(near, np.sum(offset * normals, axis=1), np.nan)
        low, high = np.fmin(low, height), np.fmax(high, height)
        count += np.isfinite(height)
    return np.where(count > 1, high - low, np.nan).astype(np.float32)
