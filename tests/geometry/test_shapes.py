"""Planes and spheres: truth recovered within what noise allows, degenerate points refused."""

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.shapes import (
    Plane,
    Sphere,
    fit_plane,
    fit_sphere,
    ransac_plane,
    ransac_sphere,
)

CENTRE, RADIUS = np.array([12.0, -7.0, 640.0]), 98.03


def plane_points(n: int, noise: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-150, 150, (2, n))
    points = np.column_stack([x, y, 600 + 0.2 * x - 0.1 * y])
    return points + rng.normal(0, noise, (n, 1)) * np.array([0.2, -0.1, -1]) / np.linalg.norm(
        [0.2, -0.1, -1]
    )


def sphere_points(
    n: int, noise: float, seed: int = 0, centre: np.ndarray = CENTRE, r: float = RADIUS
) -> np.ndarray:
    """The cap that a camera sees, 60 degrees wide on each side."""
    rng = np.random.default_rng(seed)
    z, angle = rng.uniform(-1, -0.5, n), rng.uniform(0, 2 * np.pi, n)
    directions = np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z]
    )
    return centre + directions * (r + rng.normal(0, noise, (n, 1)))


def rms(shape: Plane | Sphere, points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(shape.distance(points) ** 2)))


def test_plane() -> None:
    plane = fit_plane(plane_points(20_000, 0.05))
    truth = np.array([0.2, -0.1, -1]) / np.linalg.norm([0.2, -0.1, -1])
    assert np.linalg.norm(plane.normal) == pytest.approx(1)
    assert plane.normal[2] < 0
    assert np.abs(plane.normal - truth).max() < 2e-5
    assert plane.offset == pytest.approx(-600 / np.linalg.norm([0.2, -0.1, -1]), abs=0.002)
    assert 0.048 < rms(plane, plane_points(20_000, 0.05)) < 0.052
    assert plane.distance(np.array([0.0, 0, 0])) > 500  # the camera is on the positive side


def test_plane_exact_and_with_gaps() -> None:
    points = plane_points(100, 0)
    assert rms(fit_plane(points), points) < 1e-10
    points[::3] = np.nan
    assert rms(fit_plane(points), points[np.isfinite(points[:, 0])]) < 1e-10


def test_sphere() -> None:
    points = sphere_points(20_000, 0.05)
    sphere = fit_sphere(points)
    assert np.abs(sphere.centre - CENTRE).max() < 0.01
    assert sphere.radius == pytest.approx(RADIUS, abs=0.01)
    assert 0.048 < rms(sphere, points) < 0.052


def test_sphere_with_its_radius_known() -> None:
    points = sphere_points(5_000, 0.05)
    sphere = fit_sphere(points, RADIUS)
    assert sphere.radius == RADIUS
    assert np.abs(sphere.centre - CENTRE).max() < 0.005
    larger = fit_sphere(points, RADIUS + 1)
    assert rms(larger, points) > 2 * rms(sphere, points)


def test_sphere_is_exact_on_exact_points_and_moves_with_them() -> None:
    points = sphere_points(50, 0)
    assert fit_sphere(points).radius == pytest.approx(RADIUS, abs=1e-8)
    moved = fit_sphere(points + np.array([1e4, -2e4, 3e4]))
    assert np.abs(moved.centre - CENTRE - [1e4, -2e4, 3e4]).max() < 1e-6


def test_sphere_fit_is_orthogonal() -> None:
    """The algebraic fit alone shrinks a noisy cap's sphere; orthogonal distances do not."""
    radii = [fit_sphere(sphere_points(300, 1.0, seed, r=20.0)).radius for seed in range(40)]
    assert np.mean(radii) == pytest.approx(20.0, abs=0.25)


def test_degenerate_points_are_refused() -> None:
    line = np.outer(np.linspace(0, 1, 50), [100.0, 20, 5]) + np.array([0, 0, 600])
    with raises(InputError, "line"):
        fit_plane(line)
    with pytest.raises(InputError):
        fit_plane(np.random.default_rng(0).normal(0, 1, (200, 3)))
    with raises(InputError, "2 points"):
        fit_plane(line[:2])
    with raises(InputError, "3 points"):
        fit_sphere(sphere_points(3, 0))
    with raises(InputError, "flat"):
        fit_sphere(plane_points(500, 0))
    with raises(InputError, "flat"):
        fit_sphere(plane_points(5_000, 0.05))
    with raises(InputError, "flat"):
        fit_sphere(line)
    with raises(InputError, "(n, 3)"):
        fit_plane(np.zeros((5, 2)))
    with raises(InputError, "0 points"):
        fit_plane(np.full((10, 3), np.nan))


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A sphere before a wall, with stray points; which points are the sphere's."""
    rng = np.random.default_rng(8)
    wall = plane_points(12_000, 0.05) + np.array([0, 0, 150])
    stray = rng.uniform([-200, -200, 450], [200, 200, 800], (1_500, 3))
    ball = sphere_points(4_000, 0.05)
    points = np.concatenate([wall, stray, ball])
    is_ball = np.arange(len(points)) >= len(points) - len(ball)
    shuffled = rng.permutation(len(points))
    return points[shuffled], is_ball[shuffled]


@pytest.mark.parametrize("radius", [None, RADIUS])
def test_a_sphere_before_a_wall_is_found(radius: float | None) -> None:
    points, is_ball = scene()
    sphere, inliers = ransac_sphere(points, 0.5, radius)
    assert np.abs(sphere.centre - CENTRE).max() < 0.5
    assert sphere.radius == pytest.approx(RADIUS, abs=0.5)
    assert inliers[is_ball].all()
    assert inliers[~is_ball].mean() < 0.05
    again, _ = ransac_sphere(points, 0.5, radius)
    assert np.array_equal(again.centre, sphere.centre)


def test_the_wall_is_found_behind_a_sphere() -> None:
    points, is_ball = scene()
    plane, inliers = ransac_plane(points, 0.5)
    assert plane.normal[2] < 0
    assert 11_900 < (inliers & ~is_ball).sum() < 12_200
    assert rms(plane, points[inliers]) < 0.1


def test_a_cap_that_fills_the_view_is_found() -> None:
    points = sphere_points(8_000, 0.05)
    shown = points[(np.abs(points - CENTRE)[:, :2] < 0.4 * RADIUS).all(axis=1)]
    assert 0.5 * np.linalg.norm(np.ptp(shown, axis=0)) < RADIUS
    sphere, inliers = ransac_sphere(shown, 0.5)
    assert sphere.radius == pytest.approx(RADIUS, abs=0.5) and inliers.all()


@pytest.mark.parametrize("bend", [0.0, 2.0])
def test_no_sphere_on_a_wall(bend: float) -> None:
    points = plane_points(5_000, 0.05)
    points += [0.0, 0.0, 1.0] * (bend * np.cos(points[:, :1] / 60))
    points[::10] = np.nan
    with raises(InputError, "No sphere"):
        ransac_sphere(points, 0.3)
    with pytest.raises(InputError):
        ransac_plane(np.full((100, 3), np.nan), 0.5)
