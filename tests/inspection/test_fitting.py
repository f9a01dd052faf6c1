"""Shapes fitted to regions: right within what they say of themselves, and refused where the region
holds another."""

import json

import numpy as np
import pytest
from facts import missing_facts, raises
from shapes_of_points import MIDDLE, cylinder, plane, sphere, strewn

from slviewer.errors import InputError
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature, least_squares
from slviewer.inspection.uncertainty import scatter_covariance
from slviewer.records.measurement import Quantity
from slviewer.records.plain import from_plain
from slviewer.session.atomic import to_json

pytestmark = pytest.mark.computes


def test_a_sphere_with_strays_has_its_radius_within_its_uncertainty() -> None:
    found = fit_feature("sphere", strewn(sphere(6000, 50.0, 0.6, 0.03), 0.15))
    sigma = found.spread.sigmas[3]
    assert abs(found.feature.radius - 50.0) < 3 * sigma and 0.002 < sigma < 0.03
    assert np.linalg.norm(found.feature.place - MIDDLE) < 0.06
    # 95 % of a normal's width: 3.92 sigma
    assert 0.028 < found.rms < 0.032 and 0.11 < found.form < 0.125
    assert found.rms < abs(found.maximum) < 0.2
    assert (
        0.13 < found.left_out / 6000 < 0.15 and missing_facts(found.warnings[0], "excluded") == []
    )
    radius, diameter, *_ = found.quantities()
    assert diameter.value == 2 * radius.value and abs(diameter.U / sigma - 4) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "arc"), [(50.0, 6.2), (50.0, 0.7), (5.0, 2.5)], ids=["round", "narrow", "short"]
)
def test_a_cylinder_is_found_from_anywhere(length: float, arc: float) -> None:
    points, axis = cylinder(6000, 20.0, length, arc, 0.03)
    found = fit_feature("cylinder", strewn(points, 0.1))
    sigma = found.spread.sigmas[4]
    assert abs(found.feature.radius - 20.0) < 3.5 * sigma and sigma < 0.05
    assert abs(found.feature.direction @ axis) > np.cos(np.radians(0.05))
    off = np.cross(found.feature.place - MIDDLE, axis)
    assert np.linalg.norm(off) < 0.1
    assert 0.028 < found.rms < 0.033


def test_a_plane_with_strays_is_level_within_its_uncertainty() -> None:
    points = strewn(plane(6000, 30.0, 0.03), 0.2)
    found = fit_feature("plane", points)
    true = fit_feature("plane", plane(6000, 30.0, 0.0))
    tilt = np.linalg.norm(np.cross(found.feature.direction, true.feature.direction))
    assert tilt < 4 * found.spread.sigmas[:2].max() and 0.028 < found.rms < 0.032
    assert found.feature.direction[2] < 0  # towards the camera


@pytest.mark.parametrize(
    ("kind", "points", "facts"),
    [
        ("sphere", plane(3000, 30.0, 0.03), ("plane", "mm")),
        ("cylinder", plane(3000, 30.0, 0.03), ("plane", "mm")),
        ("sphere", sphere(3000, 50.0, 0.05, 0.03), ("plane", "mm")),
        ("sphere", cylinder(3000, 20.0, 50.0, 1.6, 0.03)[0], ("cylinder", "mm")),
        ("cylinder", sphere(3000, 50.0, 0.8, 0.03), ("sphere", "mm")),
        ("plane", sphere(3000, 50.0, 0.3, 0.03), ("bends", "mm")),
        ("plane", cylinder(3000, 20.0, 50.0, 1.0, 0.03)[0], ("bends", "mm")),
        ("plane", plane(20, 30.0, 0.03), ("20 measured points", "plane")),
        ("point", plane(200, 30.0, 0.03), ("point", "picked")),
    ],
)  # fmt: skip
def test_a_region_that_holds_another_shape_is_refused_with_what_it_holds(
    kind, points, facts
) -> None:
    with raises(InputError, *facts):
        fit_feature(kind, points)


def test_a_flat_region_with_a_bow_within_its_noise_stays_a_plane() -> None:
    points = sphere(3000, 50_000.0, 0.0005, 0.03)
    assert fit_feature("plane", points).rms < 0.033


def test_stated_uncertainties_cover_the_truth_as_often_as_they_say() -> None:
    misses = []
    for seed in range(40):
        points = sphere(800, 50.0, 0.7, 0.04, seed)
        found = least_squares("sphere", points, None)
        J = found.jacobian(points)
        sigma = np.sqrt(np.diag(scatter_covariance(points, J, found.distance(points))))
        misses.append((found.radius - 50.0) / sigma[3])
    off = np.abs(misses)
    assert np.count_nonzero(off < 2) >= 35 and np.count_nonzero(off < 0.5) <= 24
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.35


def test_errors_that_neighbours_share_make_a_fit_less_sure_than_noise_of_their_size() -> None:
    points = plane(4000, 30.0, 0.0)
    flat = least_squares("plane", points, None)
    rng = np.random.default_rng(0)
    noise = 0.03 * rng.normal(size=4000)
    across = points @ np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    waves = 0.03 * np.sqrt(2) * np.sin(across / 6.0)
    J = flat.jacobian(points)
    sigmas = [np.sqrt(np.diag(scatter_covariance(points, J, errors))) for errors in (noise, waves)]
    assert (sigmas[1].max() > 4 * sigmas[0].max()) and (sigmas[1] > 0.9 * sigmas[0]).all()


@pytest.mark.parametrize("kind", ["point", "plane", "sphere", "cylinder"])
def test_a_features_parameters_move_it_as_its_jacobian_says(kind) -> None:
    rng = np.random.default_rng(3)
    direction = None if kind in ("point", "sphere") else np.array([0.6, -0.48, 0.64])
    feature = Feature(kind, MIDDLE, direction, 20.0 if kind in ("sphere", "cylinder") else None)
    points = MIDDLE + rng.normal(size=(20, 3)) * 15
    J = feature.jacobian(points)
    assert J.shape == (20, feature.parameters)
    for k in range(feature.parameters):
        step = np.zeros(feature.parameters)
        step[k] = 1e-6
        numeric = (
            feature.moved(step).distance(points) - feature.moved(-step).distance(points)
        ) / 2e-6
        assert np.allclose(numeric, J[:, k], atol=1e-5)


def test_a_saved_fit_gives_the_same_feature_and_quantities() -> None:
    fit = fit_feature("sphere", sphere(2000, 50.0, 0.8, 0.02))
    feature = from_plain(json.loads(to_json(fit.feature)), Feature)
    assert feature.radius == fit.feature.radius and np.array_equal(feature.place, fit.feature.place)
    quantities = from_plain(json.loads(to_json(fit.quantities())), list[Quantity])
    assert quantities == fit.quantities()
    assert (
        missing_facts(
            quantities[0].format(), f"{quantities[0].value:.3f}", f"{quantities[0].U:.3f}"
        )
        == []
    )
