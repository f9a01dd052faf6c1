"""Shapes fitted to regions: right within what they say of themselves, and refused where the region
holds another."""

import json
from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts, raises
from shapes_of_points import MIDDLE, cylinder, plane, sphere, strewn

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import move_points
from slviewer.geometry.triangulation import triangulate_pixels
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature, least_squares
from slviewer.inspection.uncertainty import PointErrors, scatter_covariance
from slviewer.reconstruction.cloud import Misfit
from slviewer.reconstruction.rig_change import PointResponse, change_rig
from slviewer.records.measurement import Quantity
from slviewer.records.record import from_plain
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
        0.13 < found.excluded / 6000 < 0.15 and missing_facts(found.warnings[0], "excluded") == []
    )
    radius, diameter, *_ = found.quantities()
    assert diameter.value == 2 * radius.value and abs(diameter.U / sigma - 4) < 0.05


NORMAL = Lens(np.array([[900.0, 0, 200], [0, 900, 150], [0, 0, 1]]), np.zeros(5), (400, 300))
WIDE = Lens(np.array([[1400.0, 0, 456], [0, 2800, 570], [0, 0, 1]]), np.zeros(5), (912, 1140))
ANGLE = 0.29
R = np.array([[np.cos(ANGLE), 0, np.sin(ANGLE)], [0, 1, 0], [-np.sin(ANGLE), 0, np.cos(ANGLE)]])
RIG = StereoRig(NORMAL, WIDE, R, np.array([-172.0, -4.0, 54.0]))
BALL = np.array([0.0, 0.0, 700.0])


def measured_ball(change: np.ndarray, form_mm: float = 0.0) -> np.ndarray:
    """Points (n, 3) on a ball of 98 mm radius, by a rig that changed after its calibration."""
    real = change_rig(RIG, change)
    points = sphere(6000, 98.0, 0.9, 0.0) - MIDDLE
    points *= 1 + form_mm / 98 * np.cos(6 * np.arctan2(points[:, 1], points[:, 0]))[:, None]
    pixels, coordinate = real.camera.project(points + BALL), real.project(points + BALL)[:, 0]
    coordinate = coordinate + 0.01 * np.random.default_rng(2).normal(size=len(points))
    found = triangulate_pixels(RIG, pixels, coordinate, "x")
    return found[np.isfinite(found).all(axis=1)]


CHANGED = {
    "camera's focus by 0.5 %": (0, 1.0, 1.66),
    "camera's focus by -0.3 %": (0, -0.6, 0.95),
    "projector's focus by 0.5 %": (1, 1.0, 0.46),
    "turned by 1 mrad": (3, 1.0, 0.22),
}


@pytest.mark.parametrize("what", CHANGED)
def test_a_rig_that_changed_is_a_finding_and_in_the_uncertainty(what: str) -> None:
    which, size, off_mm = CHANGED[what]
    points = measured_ball(size * np.eye(8)[which])
    response = PointResponse(RIG, "x", points[::50], residual_px=1e-4)
    found = fit_feature("sphere", points, PointErrors(response=response))
    assert abs(2 * found.feature.radius - 196) == pytest.approx(off_mm, abs=0.03)
    assert off_mm < 4 * found.spread.sigmas[3] < 4.0
    assert not missing_facts(found.warnings[0], "times worse", "mm", "Focus", "form", "check")


def test_a_rig_that_did_not_change_is_no_finding_and_leaves_the_uncertainty() -> None:
    points = measured_ball(np.zeros(8))
    response = PointResponse(RIG, "x", points[::50], residual_px=1e-4)
    plain = fit_feature("sphere", points)
    found = fit_feature("sphere", points, PointErrors(response=response))
    assert found.warnings == () and np.array_equal(found.spread.sigmas, plain.spread.sigmas)
    points = measured_ball(np.eye(8)[0])  # by a calibration of unknown errors
    unknown = PointErrors(response=PointResponse(RIG, "x", points[::50]))
    assert fit_feature("sphere", points, unknown).warnings == ()


def test_a_misfit_of_the_axes_is_in_the_uncertainty_wherever_the_part_lies() -> None:
    points = measured_ball(np.zeros(8))
    excess = np.zeros((12, 16), np.float32)
    excess[4:9, 5:11] = 0.5
    known = PointErrors(response=PointResponse(RIG, "x", points[::50], residual_px=1e-4))
    local = PointErrors(response=replace(known.response, misfit=Misfit(excess)))
    T = np.array([[0.0, -1, 0, 30], [1, 0, 0, -20], [0, 0, 1, 5], [0, 0, 0, 1]])
    sigmas = [
        fit_feature("sphere", move_points(M, points), errors.moved(M)).spread.sigmas[3]
        for errors, M in ((known, np.eye(4)), (local, np.eye(4)), (local, T))
    ]
    assert 3 * sigmas[0] < sigmas[1] < 1.0 and sigmas[2] == pytest.approx(sigmas[1], rel=1e-3)
    assert known.warnings == () and not missing_facts(local.warnings[0], "16 %", "0.50 px", "U")


def test_a_part_with_form_errors_is_found_to_have_them_or_a_changed_rig() -> None:
    points = measured_ball(np.zeros(8), form_mm=0.1)
    response = PointResponse(RIG, "x", points[::50], residual_px=1e-4)
    found = fit_feature("sphere", points, PointErrors(response=response))
    assert not missing_facts(found.warnings[0], "the part has this form", "U allows for both")
    assert abs(2 * found.feature.radius - 196) < 4 * found.spread.sigmas[3] < 1.0


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
            quantities[0].format(), f"{quantities[0].value:.4f}", f"{quantities[0].U:.4f}"
        )
        == []
    )
