"""Blocks of bright pixels: where they are, what they say, and how sure."""

import numpy as np

from slviewer.calibration.observe import block_samples
from slviewer.fringe.phase import PhaseMap

SHAPE = (240, 320)


def phase_map(axis: str, coordinate: np.ndarray, noise: np.random.Generator) -> PhaseMap:
    period, modulation, variance = 18.0, 60.0, 2.0
    sigma = np.sqrt(variance * 2 / 18) / modulation
    phase = (2 * np.pi * coordinate / period + noise.normal(0, sigma, coordinate.shape)).astype(
        np.float32
    )
    flat = np.full(coordinate.shape, modulation, np.float32)
    zero = np.zeros(coordinate.shape, np.uint8)
    return PhaseMap(axis, period, phase, phase, flat, flat, zero, (variance, 0.0), 18)  # type: ignore[arg-type]


def test_blocks_average_position_and_coordinate_alike_and_know_their_noise() -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    rng = np.random.default_rng(1)
    bright = rng.random(SHAPE) < 0.8
    x = phase_map("x", 100 + 0.9 * u + 0.1 * v, rng)
    samples = block_samples({"x": x}, {"x": bright}, count=2000)
    assert 1500 < len(samples.camera) <= 2000
    assert np.isnan(samples.projector[:, 1]).all() and np.isnan(samples.sigma[:, 1]).all()
    error = samples.projector[:, 0] - (
        100 + 0.9 * samples.camera[:, 0] + 0.1 * samples.camera[:, 1]
    )
    assert 0.9 < np.std(error / samples.sigma[:, 0]) < 1.1
    assert np.median(samples.sigma[:, 0]) < 0.3 * np.median(x.sigma_phase) * 18 / (2 * np.pi)
    quarters = np.histogram2d(*samples.camera.T, bins=4, range=[[0, 320], [0, 240]])[0]
    assert quarters.min() > 0.8 * quarters.mean()
