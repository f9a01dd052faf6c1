"""What the compiled form's grid adds to depths, against interpolation by SciPy."""

import numba
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from slviewer.calibration.splined.correction_grid import add_corrections


@numba.njit
def _corrected(
    z: np.ndarray, cell: np.ndarray, rest: np.ndarray, grid: np.ndarray, step: int, row: int
) -> None:
    add_corrections(z, cell, rest, grid, step, row)


@pytest.mark.slow
@pytest.mark.parametrize("layers", [1, 2, 9], ids=["one layer", "two neighbours", "any"])
@pytest.mark.parametrize("step", [3, 8, 16])
def test_the_grid_is_added_between_its_eight_nodes(layers: int, step: int) -> None:
    rng = np.random.default_rng(layers)
    grid = rng.normal(0, 1, (3, 7, 11)).astype(np.float32)
    width, row = 6 * step - 1, step + 1
    cell = rng.integers(0, layers, width).astype(np.int32)
    rest = rng.random(width).astype(np.float32)
    z = np.full(width, 500.0, np.float32)
    outside = rng.random(width) < 0.2
    cell[outside], z[outside] = -1, np.nan
    # a grid cell that measures nothing
    cell[2 * step : 3 * step], z[2 * step : 3 * step] = (
        -1,
        np.nan,
    )
    given = z.copy()
    _corrected(z, cell, rest, grid, step, row)
    seen = cell >= 0
    at = np.stack([np.full(width, row / step), np.arange(width) / step, cell + rest])
    expected = given + map_coordinates(grid.astype(float), at, order=1)
    np.testing.assert_allclose(z[seen], expected[seen], atol=2e-4)
    assert np.isnan(z[~seen]).all()
