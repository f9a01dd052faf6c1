"""Division of space into cubes: agrees with its definition by rows, also for points far from all
others."""

import numpy as np

from slviewer.geometry.vectors import occupied_cubes


def test_cubes_are_the_occupied_ones_in_ascending_order() -> None:
    points = np.random.default_rng(0).normal(0.0, 30.0, (20_000, 3))
    points[:3] *= 1e4
    expected, which = np.unique(np.floor(points / 4.0).astype(int), axis=0, return_inverse=True)
    cubes, numbers = occupied_cubes(points, 4.0)
    assert np.array_equal(numbers, which.ravel())
    assert np.array_equal(cubes - cubes[0], expected - expected[0])


def test_points_beyond_the_range_are_clipped_to_its_border() -> None:
    points = np.zeros((10, 3))
    points[0], points[1] = (1e9, 0.0, 0.0), (2e9, -1e9, 0.0)
    cubes, which = occupied_cubes(points, 1.0)
    assert len(cubes) == 3
    assert len({which[0], which[1], which[2]}) == 3
    assert (which[2:] == which[2]).all()
