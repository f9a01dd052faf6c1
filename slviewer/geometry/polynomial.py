"""A polynomial surface over a part of the image, fitted to scattered values (Letter step 2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import fit_reweighted
from slviewer.geometry.vectors import finite_rows

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Polynomial2D:
    """Sum of c_ij T_i(t) T_j(s), Chebyshev polynomials in v and u scaled to -1 ... 1 over ``box``
    (u0, v0, u1, v1) px.

    ``coefficients``: (degree + 1, degree + 1), zero where i + j exceeds the degree. NaN outside the
    box.
    """

    coefficients: Floats
    box: Box

    def evaluate(self, u: np.ndarray, v: np.ndarray) -> Floats:
        """Values at scattered pixels ``u``, ``v``, in their shape; NaN outside the box."""
        u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
        s, t = _normalise_pixels(u, v, self.box)
        values = chebyshev.chebval2d(t, s, self.coefficients)
        return np.where((np.abs(s) <= 1.0) & (np.abs(t) <= 1.0), values, np.nan)

    def evaluate_grid(self, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> Floats:
        """(h, w) float64 values of the pixels from ``origin`` (u, v) on; NaN outside the box."""
        height, width = shape
        s, t = _normalise_pixels(
            origin[0] + np.arange(width), origin[1] + np.arange(height), self.box
        )
        degree = len(self.coefficients) - 1
        down, along = chebyshev.chebvander(t, degree), chebyshev.chebvander(s, degree)
        out = down @ self.coefficients @ along.T
        out[np.abs(t) > 1.0], out[:, np.abs(s) > 1.0] = np.nan, np.nan
        return out


def fit_polynomial(
    u: np.ndarray,
    v: np.ndarray,
    values: np.ndarray,
    weights: np.ndarray | None,
    extent: Sequence[float],
    degree: int,
    robust: bool = False,
) -> Polynomial2D:
    """Least-squares polynomial of total ``degree`` through ``values`` (n,) at pixels ``u``, ``v``
    (n,).

    ``weights``: (n,), one over each value's variance, or None. ``extent``: the box (u0, v0, u1, v1)
    px, or a size (w, h) for a whole image; samples outside it, not finite, or of weight 0 are
    excluded. ``robust``: Tukey's weights, which reject outliers. Raises InputError where fewer
    samples than coefficients are left.
    """
    box = parse_box(extent)
    u, v, values, weights = select_valid_samples(u, v, values, weights, box)
    i, j = np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]).T
    if len(values) < len(i):
        raise InputError(
            f"{len(values)} samples are too few for a polynomial of degree {degree} with {len(i)}"
            " coefficients",
            "lower the degree, or check that the target is illuminated.",
        )
    s, t = _normalise_pixels(u, v, box)
    design = chebyshev.chebvander(t, degree)[:, i] * chebyshev.chebvander(s, degree)[:, j]

    def solve(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients (m,) and fitted values (n,) of weighted least squares with
        weights (n,)."""
        weighted = design * w[:, None]
        solution = np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=1e-14)[0]
        return solution, design @ solution

    coefficients = np.zeros((degree + 1, degree + 1))
    coefficients[i, j] = fit_reweighted(solve, values, weights) if robust else solve(weights)[0]
    return Polynomial2D(coefficients, box)


def monomials(points: Floats, degree: int) -> Floats:
    """(n, m): x^i y^j of points (n, 2) for i from 0 and j from 0 while i + j <= ``degree``; j runs
    fastest."""
    # products, much faster than powers
    x, y = (np.vander(column, degree + 1, increasing=True) for column in points.T)
    return np.stack(
        [x[:, i] * y[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1
    )


def fit_slopes(inputs: Floats, values: np.ndarray) -> Floats:
    """Return the slopes (k, m) of values (n, m) by ``inputs`` (n, k), by least squares with a
    constant.

    Rows with NaN do not count.
    """
    known = finite_rows(inputs, values)
    design = np.column_stack([inputs[known], np.ones(np.count_nonzero(known))])
    return np.linalg.lstsq(design, values[known], rcond=None)[0][:-1]


def grid_points(*coordinates: np.ndarray) -> Floats:
    """Return all combinations (n, k) of so many ``coordinates``, the first varying fastest in two
    dimensions."""
    return np.stack(np.meshgrid(*coordinates), axis=-1).reshape(-1, len(coordinates))


def scale_to_unit_square(points: Floats) -> Floats:
    """Scale points (n, 2) so that their extent along x and along y is -1 to 1."""
    low = points.min(0)
    return 2 * (points - low) / np.maximum(np.ptp(points, axis=0), 1e-9) - 1


def parse_box(extent: Sequence[float]) -> Box:
    """(u0, v0, u1, v1) px of a box, or of a whole image given as (width, height), outer pixel edges
    included."""
    if len(extent) == 2:
        return (-0.5, -0.5, extent[0] - 0.5, extent[1] - 0.5)
    u0, v0, u1, v1 = (float(edge) for edge in extent)
    if not (u1 > u0 and v1 > v0):
        raise InputError(
            f"The region {tuple(extent)} is empty",
            "give (u0, v0, u1, v1) with u0 < u1 and v0 < v1.",
        )
    return (u0, v0, u1, v1)


def select_valid_samples(
    u: np.ndarray, v: np.ndarray, values: np.ndarray, weights: np.ndarray | None, box: Box
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The finite samples of positive weight inside the box, as float64 (n,)."""
    weights = np.ones(np.size(values)) if weights is None else weights
    arrays = [np.asarray(a, dtype=np.float64).ravel() for a in (u, v, values, weights)]
    u, v, values, w = arrays
    selected = np.isfinite(arrays).all(axis=0) & (w > 0)
    selected &= (u >= box[0]) & (u <= box[2]) & (v >= box[1]) & (v <= box[3])
    return u[selected], v[selected], values[selected], w[selected]


def _normalise_pixels(u: np.ndarray, v: np.ndarray, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Scale pixel coordinates ``u``, ``v`` linearly from the box to -1 ... 1."""
    u0, v0, u1, v1 = box
    return 2.0 * (u - u0) / (u1 - u0) - 1.0, 2.0 * (v - v0) / (v1 - v0) - 1.0
