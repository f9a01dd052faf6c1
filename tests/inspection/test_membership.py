"""Points over a feature's own area belong to it at any distance; others do not."""

import numpy as np
import pytest

from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.form import form_error
from slviewer.inspection.regions import Region

N, NOISE, RADIUS, HALF = 4000, 0.02, 10.0, 15.0


def pin(dent_mm: float = 0.0, reach_mm: float = 2.5) -> np.ndarray:
    """A pin along z, with a dent at x = RADIUS."""
    rng = np.random.default_rng(1)
    t, h = rng.uniform(-np.pi, np.pi, N), rng.uniform(-HALF, HALF, N)
    away = np.hypot(RADIUS * t, h)
    r = RADIUS + NOISE * rng.normal(size=N)
    r -= dent_mm * np.cos(np.pi / 2 * np.minimum(away / reach_mm, 1)) ** 2
    return np.stack([r * np.cos(t), r * np.sin(t), h], 1)


def floor() -> np.ndarray:
    """The face on which the pin stands."""
    rng = np.random.default_rng(2)
    t, r = rng.uniform(-np.pi, np.pi, 2000), np.sqrt(rng.uniform(RADIUS**2, 15**2, 2000))
    z = -HALF + NOISE * rng.normal(size=2000)
    return np.stack([r * np.cos(t), r * np.sin(t), z], 1)


def spikes() -> np.ndarray:
    return np.random.default_rng(3).uniform(-14, 14, (20, 3)) * [1, 1, HALF / 14]


@pytest.mark.parametrize("dent_mm", [0.15, 0.5, 3.0])
def test_dent_counts_as_form_and_widens_the_place(dent_mm: float) -> None:
    fit = fit_feature("cylinder", pin(dent_mm))
    found = form_error("cylindricity", fit, fit.points)
    sound = fit_feature("cylinder", pin())
    assert found.U is not None
    assert 0.6 * dent_mm < found.value + found.U
    assert found.value > 0.4 * dent_mm
    if dent_mm > 0.4:
        assert (fit.spread.sigmas > 1.2 * sound.spread.sigmas).any()
        assert fit.excluded < 10


def test_face_and_spikes_beside_a_pin_are_excluded() -> None:
    points = np.concatenate([pin(), floor(), spikes()])
    region = Region.box((-15, -15, -16), (15, 15, 16))
    fit = fit_feature("cylinder", points, region=region)
    radius = fit.feature.radius
    assert radius is not None and abs(radius - RADIUS) < 0.005
    assert 1900 < fit.excluded < 2100
    assert "beside" in fit.excluded_as and "isolated" in fit.excluded_as
    assert form_error("cylindricity", fit, fit.points).value < 0.06


def test_dent_deeper_than_its_region_is_missed_by_no_fit() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-20, 20, (N, 3))
    points[:, 2] = NOISE * rng.normal(size=N)
    points[np.hypot(*points[:, :2].T) < 3, 2] -= 1.5
    region = Region.box((-18, -18, -1), (18, 18, 1))
    fit = fit_feature("plane", points, region=region)
    assert form_error("flatness", fit, fit.points).value > 1.0
