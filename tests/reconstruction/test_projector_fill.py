"""What the second of two cameras does not see, filled by the projector after a comparison."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.projector_fill import fill_unseen

SHAPE = 60, 80
NOISE, CALIBRATION = 0.02, 0.005
UNSEEN = np.zeros(SHAPE, bool)
UNSEEN[:, :10] = True


def plane(seed: int, *, shift_mm: float = 0.0, slope: float = 0.0) -> Cloud:
    """A plane that faces the camera, with noise; moved, and turned by ``slope`` mm per pixel."""
    points = np.zeros((*SHAPE, 3))
    points[..., 2] = 600 + np.random.default_rng(seed).normal(0, NOISE, SHAPE) + shift_mm
    points[..., 2] += slope * (np.arange(SHAPE[0]) - 29.5)[:, None]
    known = {"sigma_z": np.full(SHAPE, NOISE), "sigma_calibration": np.full(SHAPE, CALIBRATION)}
    return Cloud(points, "x", "splined", **known)


def cameras() -> Cloud:
    """What both cameras see."""
    cloud = plane(1)
    for values in (cloud.points, cloud.sigma_z, cloud.sigma_calibration):
        assert values is not None
        values[UNSEEN] = np.nan
    return cloud


def test_unseen_points_are_the_projectors_and_the_others_stay() -> None:
    own, lit = cameras(), plane(2)
    filled = fill_unseen(own, lit, UNSEEN)
    assert filled.fill is not None and filled.fill.is_used
    assert filled.fill.points == UNSEEN.sum() == (filled.mask & ~own.mask).sum()
    np.testing.assert_array_equal(filled.points[UNSEEN], lit.points[UNSEEN])
    np.testing.assert_array_equal(filled.points[~UNSEEN], own.points[~UNSEEN])
    np.testing.assert_allclose(filled.sigma[UNSEEN], np.hypot(NOISE, CALIBRATION), rtol=1e-3)
    assert filled.extrapolated is None


def test_only_what_the_second_camera_does_not_see_is_filled() -> None:
    own = cameras()
    assert not (fill_unseen(own, plane(2), np.zeros(SHAPE, bool)).mask & UNSEEN).any()


def test_extrapolated_points_stay_marked() -> None:
    beyond = np.zeros(SHAPE, bool)
    beyond[:5] = True
    filled = fill_unseen(cameras(), replace(plane(2), extrapolated=beyond), UNSEEN)
    assert filled.extrapolated is not None
    np.testing.assert_array_equal(filled.extrapolated, beyond & UNSEEN)


@pytest.mark.parametrize("moved", [{"shift_mm": 2.0}, {"shift_mm": 0.05}, {"slope": 0.01}])
def test_a_projector_that_moved_fills_nothing(moved: dict[str, float]) -> None:
    own = cameras()
    filled = fill_unseen(own, plane(2, **moved), UNSEEN)
    assert filled.fill is not None and not filled.fill.is_used
    assert f"{filled.fill.different_mm:.3f}" in filled.fill.text()
    for name in ("points", "sigma_z", "sigma_calibration"):
        np.testing.assert_array_equal(getattr(filled, name), getattr(own, name))
    assert filled.sigma_edges is None


def test_a_difference_that_is_not_predicted_is_part_of_sigma() -> None:
    filled = fill_unseen(cameras(), plane(2, shift_mm=0.02), UNSEEN)
    assert filled.fill is not None and filled.fill.is_used
    expected = np.sqrt(NOISE**2 + CALIBRATION**2 + 0.02**2)
    np.testing.assert_allclose(filled.sigma[UNSEEN], expected, rtol=0.1)
    np.testing.assert_allclose(filled.sigma[~UNSEEN], np.hypot(NOISE, CALIBRATION), rtol=1e-3)


def test_too_little_to_compare_fills_nothing() -> None:
    own = cameras()
    own.points[10:] = np.nan
    own.points[:, 30:] = np.nan
    own.points[::2, ::2] = np.nan
    filled = fill_unseen(own, plane(2), UNSEEN)
    assert filled.fill is not None and not filled.fill.is_used
    assert filled.fill.different_mm is None and filled.fill.text()
