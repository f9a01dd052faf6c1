"""The error that the camera's blur makes at edges, beside the true one of blurred fringes."""

import cv2
import numpy as np
import pytest

from slviewer.fringe.edge_blur import LEAST_PX, edge_error, estimate_camera_blur

SHAPE, FINE = (240, 320), 4
NOISE = 0.5


def blurred_fringes(sigma_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phase (rad, NaN in the dark) and modulation (h, w) float32 of a disc with dark spots, and the phase's true
    error."""
    v, u = (np.mgrid[: SHAPE[0] * FINE, : SHAPE[1] * FINE] + 0.5) / FINE - 0.5
    albedo = 100.0 * (np.hypot(u - 160, v - 120) < 100)
    albedo[np.hypot(u % 50 - 25, v % 50 - 25) < 10] *= 0.3
    phase = 2 * np.pi * (0.9 * u + 0.1 * v + 3e-4 * u**2) / 18
    phasor = [cv2.GaussianBlur(albedo * part(phase), (0, 0), sigma_px * FINE) for part in (np.cos, np.sin)]
    z = sum(
        unit * part.reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean((1, 3))
        for unit, part in zip((1, 1j), phasor, strict=True)
    )
    rng = np.random.default_rng(0)
    z = z + NOISE * (rng.normal(size=SHAPE) + 1j * rng.normal(size=SHAPE))
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    true = 2 * np.pi * (0.9 * u + 0.1 * v + 3e-4 * u**2) / 18
    modulation = np.abs(z).astype(np.float32)
    error = np.where(modulation > 8, np.angle(z * np.exp(-1j * true)), np.nan)
    return (true + error).astype(np.float32), modulation, error


@pytest.mark.parametrize("sigma_px", [0.4, 0.7, 1.2, 2.0])
def test_the_error_at_edges_is_predicted(sigma_px: float) -> None:
    phase, modulation, error = blurred_fringes(sigma_px)
    predicted = edge_error(phase, modulation, NOISE)
    known = np.isfinite(phase)
    assert (np.isfinite(predicted) == known).all()
    noise = NOISE / modulation
    gross = np.abs(error) > 3 * noise
    assert gross[known].mean() > 0.04  # silhouette and spots
    left = np.abs(error) > 3 * np.hypot(noise, predicted)
    assert left[known].mean() < 0.01
    at_edges = known & (predicted > 5 * noise)
    ratio = np.sqrt(np.mean(error[at_edges] ** 2) / np.mean(predicted[at_edges] ** 2))
    assert 0.5 < ratio < 1.3  # neither explained away nor missed
    assert np.median(predicted[known] / noise[known]) < 0.4  # little is added far from edges


def test_blur_is_estimated_from_the_steepest_edges_of_each_tile() -> None:
    for sigma_px in (0.7, 1.5):
        phase, modulation, _ = blurred_fringes(sigma_px)
        blur = estimate_camera_blur(modulation, np.isfinite(phase), NOISE)
        assert sigma_px < np.median(blur) < 1.35 * sigma_px
    flat = np.full((60, 80), 50, np.float32) + np.random.default_rng(1).normal(0, NOISE, (60, 80)).astype(np.float32)
    assert (estimate_camera_blur(flat, np.ones(flat.shape, bool), NOISE) == np.float32(LEAST_PX)).all()
    assert (estimate_camera_blur(flat, np.zeros(flat.shape, bool), NOISE) == np.float32(LEAST_PX)).all()
