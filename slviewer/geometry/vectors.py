"""Lengths, directions, means, distances and cubes of many vectors."""

import numpy as np
import scipy
from numpy.typing import ArrayLike


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of vectors (..., k)."""
    return np.linalg.norm(vectors, axis=-1)


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., k) of length 1; 0 where a vector is 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def diagonal(points: np.ndarray) -> float:
    """Return the length of the diagonal of the box around points (n, k)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def box_middle(points: np.ndarray) -> np.ndarray:
    """Return the middle (k,) of the box around points (n, k)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def rms(values: ArrayLike) -> float:
    """Return the root mean square of values; NaN without any."""
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else float("nan")


def rms_length(vectors: np.ndarray) -> float:
    """Return the root mean square length of vectors (n, k); rows with NaN do not count."""
    return float(np.sqrt(np.nanmean(np.sum(vectors**2, axis=1))))


def shared_rms(vectors: np.ndarray) -> float:
    """Return the root mean square length of what neighbours among vectors (n, k) share, those of
    consecutive rows: of a pattern, to which independent noise adds nothing; NaN rows do not
    count."""
    products = np.sum(vectors[1:] * vectors[:-1], axis=1)
    products = products[np.isfinite(products)]
    return float(np.sqrt(max(products.mean(), 0.0))) if len(products) else 0.0


def finite_rows(*arrays: np.ndarray) -> np.ndarray:
    """Return where (...) all values along the last axis of every array (..., k) are finite."""
    return np.logical_and.reduce([np.isfinite(each).all(axis=-1) for each in arrays])


def subsample(values: np.ndarray, most: int) -> np.ndarray:
    """Return every k-th of values (n, ...), with the least k that leaves at most so many."""
    return values[:: max(1, -(-len(values) // most))]


def thin_out(values: np.ndarray, least: int) -> np.ndarray:
    """Return every k-th of values (n, ...), with the greatest k that leaves at least so many."""
    return values[:: max(1, len(values) // least)]


def median_spacing(tree: "scipy.spatial.cKDTree", samples: int) -> float:
    """Return the median distance of points of a search tree to their nearest other point, over some
    ``samples`` of them; infinite for a single point."""
    distance, _ = tree.query(thin_out(tree.data, samples), k=2)
    return float(np.median(distance[:, 1]))


PATCHES = 8
"""Across a region: deviations within a patch are taken for one another's company, those of
different patches not."""
LEAST_IN_PATCH = 20
"""Points, below which the mean of a patch says nothing."""
_BITS = 21  # of each coordinate of a cube


def occupied_cubes(points: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the cubes of ``side`` mm that hold points (n, 3) mm, and which of them each point is
    in, (n,).

    Cubes (m, 3) int64 are integer positions, in ascending order; their origin is arbitrary. Those a
    million and more cubes from the median are clipped to there. One integer per cube is sorted
    several times faster than three.
    """
    cube = np.floor(points / side).astype(np.int64)
    middle = np.median(thin_out(cube, 1000), axis=0).astype(np.int64)
    cube -= middle - (1 << _BITS - 1)
    cube.clip(0, (1 << _BITS) - 1, out=cube)
    shifts = np.array([2 * _BITS, _BITS, 0])
    packed = cube[:, 0] << shifts[0] | cube[:, 1] << shifts[1] | cube[:, 2]
    keys, which = np.unique(packed, return_inverse=True)
    return keys[:, None] >> shifts & (1 << _BITS) - 1, which


def sum_by_cube(values: np.ndarray, points: np.ndarray, side: float) -> np.ndarray:
    """Return the sums (m, k) of ``values`` (n, k) over the m occupied cubes of ``side`` mm of
    ``points`` (n, 3)."""
    _, which = occupied_cubes(points, side)
    return np.stack([np.bincount(which, column) for column in values.T], axis=1)


def patch_means(
    points: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middles (m, 3) of the patches of points (n, 3) mm that hold enough of them, the
    means (m,) of their ``values`` (n,), and the standard deviations (m,) of these means."""
    low = points.min(axis=0)
    side = max(float(np.ptp(points, axis=0).max()) / PATCHES, 1e-12)
    columns = np.column_stack([np.ones(len(points)), points, values, values**2])
    sums = sum_by_cube(columns, points - low, side)
    sums = sums[sums[:, 0] >= LEAST_IN_PATCH]
    count, means = sums[:, 0], sums[:, 1:] / sums[:, :1]
    variance = np.maximum(means[:, 4] - means[:, 3] ** 2, 0.0)
    return means[:, :3], means[:, 3], np.sqrt(variance / (count - 1))


def list_runs(numbers: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last of each run of consecutive ``numbers`` (n,) int, which are
    sorted."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [(int(run[0]), int(run[-1])) for run in runs if len(run)]
