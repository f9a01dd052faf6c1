"""The error that the camera's blur makes at edges, beside the true one of blurred fringes."""

import cv2
import numpy as np
import pytest
from fringe_scene import variants

from slviewer.fringe.edge_blur import LEAST_PX, estimate_camera_blur, estimate_displacement

pytestmark = pytest.mark.computes

SHAPE, FINE = (240, 320), 4
NOISE = 0.5


def blurred_fringes(sigma_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phase (rad, NaN in the dark) and modulation (h, w) float32 of a disc with dark spots, and the
    phase's true error."""
    v, u = (np.mgrid[: SHAPE[0] * FINE, : SHAPE[1] * FINE] + 0.5) / FINE - 0.5
    albedo = 100.0 * (np.hypot(u - 160, v - 120) < 100)
    albedo[np.hypot(u % 80 - 40, v % 80 - 40) < 20] *= 0.3
    phase = 2 * np.pi * (0.9 * u + 0.1 * v + 3e-4 * u**2) / 18
    phasor = [
        cv2.GaussianBlur(albedo * part(phase), (0, 0), sigma_px * FINE) for part in (np.cos, np.sin)
    ]
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


@pytest.mark.parametrize("sigma_px", variants([0.4, 0.7, 1.2, 2.0], 0.7))
def test_the_error_at_edges_is_predicted_and_removed(sigma_px: float) -> None:
    phase, modulation, error = blurred_fringes(sigma_px)
    displaced = estimate_displacement(phase, modulation, NOISE)
    known = np.isfinite(phase)
    assert (np.isfinite(displaced.shift) == known).all()
    noise = NOISE / modulation
    gross = np.abs(error) > 3 * noise
    assert gross[known].mean() > 0.04  # silhouette and spots
    left = np.abs(error) > 3 * np.hypot(noise, np.abs(displaced.shift))
    assert left[known].mean() < 0.01
    at_edges = known & (np.abs(displaced.shift) > 5 * noise)
    ratio = np.sqrt(np.mean(error[at_edges] ** 2) / np.mean(displaced.shift[at_edges] ** 2))
    assert 0.5 < ratio < 1.3  # neither explained away nor missed
    # little is added far from edges
    assert np.median(np.abs(displaced.shift[known]) / noise[known]) < 0.4
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    at_spots = at_edges & (np.hypot(u - 160, v - 120) < 90)
    assert displaced.is_continuous[at_spots].mean() > 0.75, "the disc is one surface, spots or not"
    corrected = np.where(displaced.is_continuous, error - displaced.shift, error)
    at_spots &= displaced.is_continuous
    assert 0.05 < rms(corrected[at_spots]) / rms(error[at_spots]) < 0.33
    spread = np.hypot(noise, displaced.remaining)[at_spots]
    assert 0.5 < rms(corrected[at_spots] / spread) < 1.5, "what remains is predicted"
    far = known & (np.abs(displaced.shift) < 0.1 * noise)
    assert rms(corrected[far]) < 1.02 * rms(error[far])


@pytest.mark.parametrize("jump", [0.6, 2.0])
def test_a_step_of_the_surface_is_no_printed_edge(jump: float) -> None:
    """Two halves at different depth, equally bright: their fringes interfere in between, and
    nothing is corrected."""
    v, u = (np.mgrid[: SHAPE[0] * FINE, : SHAPE[1] * FINE] + 0.5) / FINE - 0.5
    fine = 2 * np.pi * u / 18 + jump * (u > 160.3 + 0.2 * v)
    phasor = [cv2.GaussianBlur(100 * part(fine), (0, 0), 1.2 * FINE) for part in (np.cos, np.sin)]
    real, imaginary = (part.reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean((1, 3)) for part in phasor)
    true = fine.reshape(SHAPE[0], FINE, SHAPE[1], FINE)[:, 0, :, 0]
    z = real + 1j * imaginary
    phase = (true + np.angle(z * np.exp(-1j * true))).astype(np.float32)
    displaced = estimate_displacement(phase, np.abs(z).astype(np.float32), NOISE)
    at_step = np.abs(np.arange(SHAPE[1]) - 160.3 - 0.2 * np.arange(SHAPE[0])[:, None]) < 2
    at_step[:10] = at_step[-10:] = False
    moved = np.where(displaced.is_continuous, displaced.shift, 0)
    assert np.abs(moved[at_step]).max() < 0.02
    assert np.abs(moved[10:-10, 10:-10][~at_step[10:-10, 10:-10]]).max() < 0.05


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_blur_is_estimated_from_the_steepest_edges_of_each_tile() -> None:
    for sigma_px in (0.7, 1.5):
        phase, modulation, _ = blurred_fringes(sigma_px)
        blur = estimate_camera_blur(modulation, np.isfinite(phase), NOISE)
        assert sigma_px < np.median(blur) < 1.35 * sigma_px
    flat = np.full((60, 80), 50, np.float32) + np.random.default_rng(1).normal(
        0, NOISE, (60, 80)
    ).astype(np.float32)
    assert (
        estimate_camera_blur(flat, np.ones(flat.shape, bool), NOISE) == np.float32(LEAST_PX)
    ).all()
    assert (
        estimate_camera_blur(flat, np.zeros(flat.shape, bool), NOISE) == np.float32(LEAST_PX)
    ).all()
