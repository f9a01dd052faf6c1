"""How blurred contrast edges are, and that bright pixels near them are left out."""

import cv2
import numpy as np
import pytest

from slviewer.calibration.observe import (
    CLEARANCE_SIGMAS,
    MIN_CLEARANCE_PX,
    bright_pixels,
    edge_blur_px,
)
from slviewer.fringe.phase import PhaseMap

PITCH = 30.0
INSIDE = np.pad(np.ones((270, 360), bool), 15)
V, U = np.mgrid[:300, :390].astype(float)


TURNED = np.exp(0.175j) * (U + 1j * V) / PITCH
"""Board coordinates in pitches, as complex numbers: 10 degrees off the image's rows."""


def distance_from_circles() -> np.ndarray:
    """(h, w) px from the rim of the nearest circle of the grid; negative inside."""
    nearest = np.round(TURNED.real) + 1j * np.round(TURNED.imag)
    return (np.abs(TURNED - nearest) - 0.25) * PITCH


def seen(white: np.ndarray, sigma: float, noise: float = 0.5) -> PhaseMap:
    """Modulation of 80 on what is white (h fine, w fine) and 8 elsewhere, blurred, under uneven
    light."""
    modulation = cv2.GaussianBlur(np.where(white, 80.0, 8.0), (0, 0), sigma) * (1 - 0.3 * U / 390)
    modulation += np.random.default_rng(0).normal(0, noise, modulation.shape)
    flat = np.zeros(modulation.shape, np.float32)
    return PhaseMap(
        "x",
        18.0,
        flat,
        flat,
        modulation.astype(np.float32),
        flat + 100,
        flat.astype(np.uint8),
        (1, 0),
        18,
    )


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5])
@pytest.mark.parametrize("squares", [False, True])
def test_the_blur_of_edges_is_measured(sigma: float, squares: bool) -> None:
    white = (
        (np.floor(TURNED.real) + np.floor(TURNED.imag)) % 2 == 0
        if squares
        else distance_from_circles() > 0
    )
    phase = seen(white, sigma)
    corners = 0.25 if squares else 0.12  # which belong to two edges
    assert edge_blur_px(phase, INSIDE, PITCH) == pytest.approx(
        np.hypot(sigma, 12**-0.5), rel=corners
    )


@pytest.mark.parametrize("sigma", [0.5, 1.2])
def test_pixels_within_some_sigma_of_an_edge_are_left_out(sigma: float) -> None:
    distance = distance_from_circles()
    clear = bright_pixels(seen(distance > 0, sigma), INSIDE, PITCH)
    well_inside = INSIDE & np.roll(INSIDE, (8, 8), (0, 1)) & np.roll(INSIDE, (-8, -8), (0, 1))
    reach = CLEARANCE_SIGMAS * np.hypot(sigma, 12**-0.5)
    assert not clear[
        distance < reach - 0.6
    ].any()  # which side of a pixel's middle an edge runs is not known
    assert clear[well_inside & (distance > max(reach, MIN_CLEARANCE_PX) + 1.2)].all()


def test_where_edges_are_everywhere_the_clearest_pixels_are_kept() -> None:
    distance = distance_from_circles()
    clear = bright_pixels(seen(distance > 0, 3.0), INSIDE, PITCH)
    assert np.count_nonzero(clear & INSIDE) > 0.1 * np.count_nonzero(INSIDE & (distance > 0))
    assert distance[clear].min() > 1.0
    assert edge_blur_px(seen(distance > -100, 1.0), INSIDE, PITCH) < 0.3, (
        "a blank board has no edges"
    )
