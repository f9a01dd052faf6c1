"""Reading the projector coordinate at a dark circle from its bright surroundings."""

import numpy as np
import pytest

from slviewer.calibration.local_fit import fit_local_values


def field_with_a_dark_disc(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[:80, :90].astype(float)
    values = 300 + 0.6 * u - 0.1 * v + 8e-4 * u * v - 4e-4 * u**2
    dark = np.hypot(u - 44.3, v - 39.6) < 12
    field = values + np.random.default_rng(0).normal(0, noise, values.shape)
    field[dark] = 1e4  # whatever a dark pixel says must not be read
    return field, np.where(dark, 0.0, 1.0)


def truth(u: float, v: float) -> float:
    return 300 + 0.6 * u - 0.1 * v + 8e-4 * u * v - 4e-4 * u**2


@pytest.mark.computes
def test_the_centre_is_read_from_the_ring_around_it() -> None:
    field, weight = field_with_a_dark_disc()
    value, slopes = fit_local_values(field, weight, np.array([[44.3, 39.6]]), np.array([25.0]))
    assert value[0] == pytest.approx(truth(44.3, 39.6), abs=1e-6)
    along = [truth(44.8, 39.6) - truth(43.8, 39.6), truth(44.3, 40.1) - truth(44.3, 39.1)]
    np.testing.assert_allclose(slopes[0], along, atol=1e-6)


def test_noise_averages_and_strays_do_not_pull() -> None:
    field, weight = field_with_a_dark_disc(0.3)
    field[30:50:7, 60:66] += 18.0
    value = fit_local_values(field, weight, np.array([[44.3, 39.6]]), np.array([25.0]))[0][0]
    assert 1e-6 < abs(value - truth(44.3, 39.6)) < 0.06


def test_nan_where_the_surroundings_lie_on_one_side() -> None:
    field, weight = field_with_a_dark_disc()
    weight[:, :46] = 0
    value, slopes = fit_local_values(field, weight, np.array([[44.3, 39.6]]), np.array([25.0]))
    assert np.isnan(value[0]) and np.isnan(slopes[0]).all()
