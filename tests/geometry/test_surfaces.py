"""Step 2's surfaces: noise averaged, stray samples ignored, local distortion kept."""

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.geometry.splines import fit_spline

SHAPE = (300, 400)
BOX = (60.0, 40.0, 360.0, 260.0)
LOCAL_RAD = 0.15 * 2 * np.pi / 18
"""0.15 px at a period of 18 px."""


def phase(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(smooth phase of a tilted board, 0 to 320 rad; local distortion with waves of a third of the
    image)."""
    smooth = 0.8 * u + 0.02 * v + 2e-4 * (u - 200) * (v - 150) + 3e-4 * (u - 200) ** 2
    return smooth, LOCAL_RAD * np.sin(2 * np.pi * u / (400 / 3)) * np.cos(2 * np.pi * v / 100)


def samples(
    n: int = 12_000, noise: float = 0.01, stray: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(BOX[0], BOX[2], n), rng.uniform(BOX[1], BOX[3], n)
    values = sum(phase(u, v)) + rng.normal(0, noise, n)
    hit = rng.random(n) < stray
    values[hit] += rng.choice([-2 * np.pi, 2 * np.pi, 0.3], hit.sum())
    return u, v, values


def grids() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = (u >= BOX[0]) & (u <= BOX[2]) & (v >= BOX[1]) & (v <= BOX[3])
    smooth, local = phase(u, v)
    return smooth, local, inside


@pytest.mark.parametrize(
    ("noise", "stray", "robust"), [(0.0, 0.0, False), (0.01, 0.0, True), (0.01, 0.04, True)]
)
def test_spline_keeps_local_distortion(noise: float, stray: float, robust: bool) -> None:
    surface = fit_spline(
        *samples(noise=noise, stray=stray), None, BOX, cells=(12, 10), robust=robust
    )
    grid = surface.evaluate_grid(SHAPE)
    smooth, local, inside = grids()
    assert np.array_equal(np.isfinite(grid), inside)
    kept = ((grid - smooth) * local)[inside].sum() / (local**2)[inside].sum()
    assert 0.95 < kept < 1.01
    error = (grid - smooth - local)[inside]
    assert np.sqrt(np.mean(error**2)) < 0.03 * LOCAL_RAD + 0.2 * noise
    assert abs(error.mean()) < 2e-4


def test_weights_and_invalid_samples() -> None:
    u, v, values = samples()
    weights = np.ones(len(u))
    values[::4] += 3
    weights[::4] = 0
    values[1::4] = np.nan
    grid = fit_spline(u, v, values, weights, BOX).evaluate_grid(SHAPE)
    smooth, local, inside = grids()
    assert np.abs((grid - smooth - local)[inside]).max() < 0.02


def test_cells_without_samples_are_held() -> None:
    u, v, values = samples()
    hole = np.hypot(u - 210, v - 150) < 45
    grid = fit_spline(u[~hole], v[~hole], values[~hole], None, BOX, robust=True).evaluate_grid(
        SHAPE
    )
    smooth, local, inside = grids()
    assert np.abs((grid - smooth - local)[inside]).max() < 5 * LOCAL_RAD


@pytest.mark.parametrize("kind", ["spline", "polynomial"])
def test_grid_window_and_scattered_pixels_agree(kind: str) -> None:
    u, v, values = samples(3_000)
    fitted = (
        fit_spline(u, v, values, None, BOX)
        if kind == "spline"
        else fit_polynomial(u, v, values, None, BOX, degree=7)
    )
    grid = fitted.evaluate_grid(SHAPE)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    assert np.allclose(fitted.evaluate(column, row), grid, rtol=0, atol=1e-9, equal_nan=True)
    assert np.array_equal(
        fitted.evaluate_grid((50, 70), (100, 90)), grid[90:140, 100:170], equal_nan=True
    )


def test_polynomials_are_reproduced() -> None:
    u, v, _ = samples(2_000)
    values = 3 + 0.5 * u - 0.02 * v + 1e-4 * u * v - 1e-6 * v**3
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    truth = 3 + 0.5 * column - 0.02 * row + 1e-4 * column * row - 1e-6 * row**3
    inside = grids()[2]
    for fitted in (
        fit_polynomial(u, v, values, None, BOX, 5),
        # the samples cover a part of the box only
        fit_polynomial(u, v, values, None, (400, 300), 5, robust=True),
        fit_spline(u, v, values, None, BOX),
    ):
        assert np.abs(fitted.evaluate_grid(SHAPE) - truth)[inside].max() < 1e-6


def test_a_low_degree_loses_what_a_high_one_keeps() -> None:
    u, v, values = samples(stray=0.04)
    smooth, local, inside = grids()
    kept = {}
    for degree in (5, 12):
        grid = fit_polynomial(u, v, values, None, BOX, degree, robust=True).evaluate_grid(SHAPE)
        kept[degree] = ((grid - smooth) * local)[inside].sum() / (local**2)[inside].sum()
    assert kept[5] < 0.5
    assert kept[12] > 0.85


def test_bad_input_is_refused() -> None:
    u, v, values = samples(30)
    with pytest.raises(InputError):
        fit_polynomial(u, v, values, None, BOX, 12)
    with pytest.raises(InputError):
        fit_spline(u, v, np.full(30, np.nan), None, BOX)
    with raises(InputError, "(10, 10, 5, 20)", "empty"):
        fit_spline(u, v, values, None, (10, 10, 5, 20))
    with raises(InputError, "0x4 cells"):
        fit_spline(u, v, values, None, BOX, cells=(0, 4))
