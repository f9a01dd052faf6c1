"""Spheres of known size and place."""

import numpy as np
import pytest
from planted import cloud, plane_depth, sphere_depth

from slviewer.errors import InputError
from slviewer.evaluation.fit import evaluate_sphere, evaluate_spheres

SIGMA = 0.04
CENTRE, RADIUS = (15.0, -10.0, 680.0), 98.0


def sphere_before_a_wall(sigma_z: float = SIGMA) -> tuple[np.ndarray, np.ndarray]:
    front = sphere_depth(CENTRE, RADIUS)
    hit = np.isfinite(front)
    return cloud(np.where(hit, front, plane_depth(850.0)), sigma_z), hit


@pytest.mark.parametrize("radius", [None, 100.0])
def test_radius_and_noise_are_found_in_a_whole_cloud(radius: float | None) -> None:
    points, hit = sphere_before_a_wall()
    result = evaluate_sphere(points, None, np.full(points.shape[:2], SIGMA), radius)
    # a radius handed in does not hold the fit
    assert result.radius_mm == pytest.approx(RADIUS, abs=0.01)
    assert np.linalg.norm(result.sphere.centre - CENTRE) < 0.02
    assert 0.9 * hit.sum() < result.points <= hit.sum()
    assert 0.4 * SIGMA < result.rms_mm < SIGMA
    assert result.noise_floor_mm == pytest.approx(result.rms_mm, rel=0.02)
    assert not np.isfinite(result.error_map[~hit]).any()


@pytest.mark.parametrize("scale", [0.02, 50.0])
def test_a_sphere_of_another_size_is_found_alike(scale: float) -> None:
    points, _ = sphere_before_a_wall()
    sigma = np.full(points.shape[:2], SIGMA)
    usual = evaluate_sphere(points, None, sigma)
    other = evaluate_sphere(points * scale, None, sigma * scale)
    assert abs(other.points - usual.points) <= 5 and abs(other.excluded - usual.excluded) <= 5
    assert [other.radius_mm, other.rms_mm] == pytest.approx(
        [scale * usual.radius_mm, scale * usual.rms_mm], rel=1e-3
    )


def test_errors_are_positive_outwards() -> None:
    front = sphere_depth(CENTRE, RADIUS)
    front[140:150, 210:220] -= 0.3
    result = evaluate_sphere(cloud(front, 0.02), None)
    assert 0.2 < np.nanmean(result.error_map[142:148, 212:218]) < 0.31


def test_a_dent_in_form_is_not_set_aside() -> None:
    """A sphere squeezed by half a millimetre along x keeps all its points."""
    front = sphere_depth(CENTRE, RADIUS)
    points = cloud(front, 0.01)
    points[..., 0] = CENTRE[0] + (points[..., 0] - CENTRE[0]) * (1 - 0.5 / RADIUS)
    result = evaluate_sphere(points, None)
    assert result.excluded_share < 0.001
    assert 0.05 < result.rms_mm < 0.3


def test_two_spheres_and_their_spacing() -> None:
    left, right = (-75.0, 5.0, 600.0), (74.0, 10.0, 616.0)
    known = float(np.linalg.norm(np.subtract(left, right)))
    a, b = sphere_depth(left, 25.0), sphere_depth(right, 25.0)
    points = cloud(np.where(np.isfinite(a), a, b), SIGMA)
    results = evaluate_spheres(points, 2, radius=25.0)
    assert [result.sphere.centre[0] > 0 for result in results] == [False, True]
    for result in results:
        assert result.radius_mm == pytest.approx(25.0, abs=0.02)
    assert np.linalg.norm(results[1].sphere.centre - results[0].sphere.centre) == pytest.approx(
        known, abs=0.02
    )


def test_a_wall_is_no_sphere() -> None:
    with pytest.raises(InputError):
        evaluate_sphere(cloud(plane_depth(), SIGMA), None)
