"""A cubic B-spline surface over a part of the image: smooths scattered values, and keeps what a
lens does locally.

A polynomial of low degree over the whole image removes the local distortion that a pixel-wise
calibration should learn (its step 2); a spline of some cells across keeps it, and still averages
hundreds of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from slviewer.errors import InputError
from slviewer.geometry.jit import kernel
from slviewer.geometry.polynomial import (
    Polynomial2D,
    fit_polynomial,
    parse_box,
    select_valid_samples,
)
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import fit_reweighted

TREND_DEGREE = 3
"""Of a cell's weight: holds coefficients that no sample reaches at the trend, and hardly pulls
where samples are."""
RIDGE = 1e-7
"""Of a cell's weight: holds coefficients that no sample reaches at the trend, and hardly pulls
elsewhere."""


@dataclass(frozen=True, eq=False)
class SplineSurface:
    """A trend plus a tensor-product uniform cubic B-spline over ``trend.box``.

    ``coefficients``: (ny + 3, nx + 3) for ny x nx cells. NaN outside the box; in cells without
    samples it continues smoothly from its neighbours, which is not a measurement: mask those.
    """

    trend: Polynomial2D
    coefficients: Floats

    @property
    def _spans(self) -> tuple[tuple[float, float, int], tuple[float, float, int]]:
        """Start, end and number of cells of the box along u and v."""
        rows, columns = self.coefficients.shape
        u0, v0, u1, v1 = self.trend.box
        return (u0, u1, columns - 3), (v0, v1, rows - 3)

    def evaluate(self, u: np.ndarray, v: np.ndarray) -> Floats:
        """Values at scattered pixels ``u``, ``v``, in their shape; NaN outside the box."""
        u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
        values = self.trend.evaluate(u, v).ravel()
        inside = np.isfinite(values)
        along, down = self._spans
        bases = *cubic_basis(u.ravel()[inside], *along), *cubic_basis(v.ravel()[inside], *down)
        values[inside] += _spline_at(*bases, self.coefficients)
        return values.reshape(u.shape)

    def evaluate_grid(self, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> Floats:
        """(h, w) float64 values of the pixels from ``origin`` (u, v) on; NaN outside the box."""
        along, down = (
            basis_matrix(first + np.arange(count, dtype=np.float64), *span)
            for first, count, span in zip(origin, shape[::-1], self._spans, strict=True)
        )
        return self.trend.evaluate_grid(shape, origin) + down @ self.coefficients @ along.T


def fit_spline(
    u: np.ndarray,
    v: np.ndarray,
    values: np.ndarray,
    weights: np.ndarray | None,
    extent: Sequence[float],
    cells: tuple[int, int] = (12, 10),
    smooth: float = 1e-3,
    robust: bool = False,
) -> SplineSurface:
    """Cubic B-spline surface through ``values`` (n,) at pixels ``u``, ``v`` (n,), by penalised
    least squares.

    ``weights``: (n,), one over each value's variance, or None. ``extent``: the box (u0, v0, u1, v1)
    px, or a size (w, h) for a whole image; samples outside it, not finite, or of weight 0 are
    excluded. ``cells``: (across, down). ``smooth``: weight of the squared second differences of the
    coefficients, relative to a mean cell's data: at 1e-3 a wave of four cells loses 1 % of its
    height, and cells without samples are held by their neighbours. ``robust``: Tukey's weights, so
    that outliers (contrast edges, 2 pi spikes) do not pull.

    Raises InputError where fewer samples are left than the trend has coefficients, or for no cells.
    """
    box = parse_box(extent)
    nx, ny = cells
    if nx < 1 or ny < 1:
        raise InputError(
            f"A surface of {nx}x{ny} cells was requested", "at least one each way is needed."
        )
    u, v, values, weights = select_valid_samples(u, v, values, weights, box)
    trend = fit_polynomial(u, v, values, weights, box, TREND_DEGREE, robust)
    rest = values - trend.evaluate(u, v)
    cells_u, basis_u = cubic_basis(u, box[0], box[2], nx)
    cells_v, basis_v = cubic_basis(v, box[1], box[3], ny)
    bases = cells_u, basis_u, cells_v, basis_v
    reached = len(np.unique(cells_v * nx + cells_u))
    columns, count = nx + 3, (nx + 3) * (ny + 3)
    penalty = scipy.sparse.tril(bending_energy(columns, ny + 3), format="coo")
    prior = np.zeros((3 * columns + 4, count))  # in lower banded form
    prior[penalty.row - penalty.col, penalty.col] = smooth * penalty.data
    prior[0] += RIDGE
    prior *= weights.sum() / reached

    def solve(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients (ny + 3, nx + 3) and fitted values (n,) for sample weights
        (n,)."""
        band = prior.copy()
        right = np.zeros(count)
        _accumulate(*bases, w, rest, columns, band, right)
        solution = scipy.linalg.solveh_banded(
            band, right, lower=True, overwrite_ab=True, overwrite_b=True, check_finite=False
        )
        coefficients = solution.reshape(-1, columns)
        return coefficients, _spline_at(*bases, coefficients)

    return SplineSurface(
        trend, fit_reweighted(solve, rest, weights) if robust else solve(weights)[0]
    )


def basis_matrix(positions: np.ndarray, start: float, end: float, cells: int) -> np.ndarray:
    """(n, cells + 3): weight of each coefficient at each position."""
    cell, weights = cubic_basis(positions, start, end, cells)
    matrix = np.zeros((len(positions), cells + 3))
    np.put_along_axis(matrix, cell[:, None] + np.arange(4), weights, axis=1)
    return matrix


def image_basis(pixels: np.ndarray, size: np.ndarray, cells: tuple[int, int]) -> np.ndarray:
    """(n, coefficients): weight of each coefficient of a field over an image of ``size`` px at
    pixels (n, 2); ``cells`` (across, down)."""
    across, down = (basis_matrix(pixels[:, k], -0.5, size[k] - 0.5, cells[k]) for k in range(2))
    return (down[:, :, None] * across[:, None]).reshape(len(pixels), -1)


def cubic_basis(
    positions: np.ndarray, start: float, end: float, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return each position's cell (n,), one of those from start to end, and its four cubic B-spline
    weights (n, 4)."""
    x = (positions - start) * (cells / (end - start))
    cell = np.clip(np.floor(x).astype(np.int64), 0, cells - 1)
    f = x - cell
    g = 1.0 - f
    weights = np.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], axis=1) / 6.0
    return cell, weights


def second_differences(count: int) -> "scipy.sparse.dia_array":
    """Return the second differences (count - 2, count) of so many coefficients."""
    return scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))


def bending_energy(columns: int, rows: int) -> "scipy.sparse.sparray":
    """Return the quadratic form d_uu^2 + 2 d_uv^2 + d_vv^2 of coefficients (rows, columns), as of a
    thin plate.

    It is a sparse matrix (rows columns, rows columns) of first and second differences.
    """
    first = [scipy.sparse.diags([-1.0, 1.0], [0, 1], shape=(n - 1, n)) for n in (columns, rows)]
    uu = scipy.sparse.kron(scipy.sparse.eye(rows), second_differences(columns))
    vv = scipy.sparse.kron(second_differences(rows), scipy.sparse.eye(columns))
    uv = scipy.sparse.kron(first[1], first[0])
    return uu.T @ uu + 2.0 * uv.T @ uv + vv.T @ vv


@kernel()
def _accumulate(cells_u, basis_u, cells_v, basis_v, weights, values, columns, band, right):
    """Adds the samples' normal equations to ``band`` (lower banded) and ``right``."""
    products = np.empty(16)
    for k in range(weights.shape[0]):
        if weights[k] == 0.0:
            continue
        for a in range(4):
            for b in range(4):
                products[4 * a + b] = basis_v[k, a] * basis_u[k, b]
        # an index with a sign would be tested for its end
        corner = np.uint64(cells_v[k] * columns + cells_u[k])
        for a in range(4):
            for b in range(4):
                row = corner + np.uint64(a * columns + b)
                w = weights[k] * products[4 * a + b]
                right[row] += w * values[k]
                for c in range(a + 1):
                    for d in range(4 if c < a else b + 1):
                        below = np.uint64((a - c) * columns + b - d)
                        band[below, row - below] += w * products[4 * c + d]


@kernel()
def _spline_at(cells_u, basis_u, cells_v, basis_v, coefficients):
    """Return the spline's values (n,) at samples given by their cells (n,) and basis weights (n,
    4)."""
    out = np.empty(cells_u.shape[0])
    for k in range(cells_u.shape[0]):
        total = 0.0
        for a in range(4):
            for b in range(4):
                total += (
                    basis_v[k, a] * basis_u[k, b] * coefficients[cells_v[k] + a, cells_u[k] + b]
                )
        out[k] = total
    return out
