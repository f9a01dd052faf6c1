"""Saturation below full scale is found, and bright scenes are not taken for it."""

import numpy as np
import pytest
from fringe_scene import capture, slope

from slviewer.fringe.decode import decode
from slviewer.fringe.layout import image_white
from slviewer.fringe.plateau import find_plateau
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import PatternSequence

RNG = np.random.default_rng(0)


def steps(n: int = 4, noise: float = 1.0, spread: float = 0.3, gain: float = 1.0) -> np.ndarray:
    """Levels (n, 4000) of cosines of 8 to 200 levels and brightnesses that vary by `spread`."""
    u = np.linspace(0, 57, 4000)
    albedo = gain * (1 - spread * RNG.random(u.size))
    fringe = 104 + 96 * np.cos(2 * np.pi * (u + np.arange(n)[:, None] / n))
    return albedo * fringe + noise * RNG.standard_normal(fringe.shape)


@pytest.mark.parametrize(
    ("clip", "full_scale", "dtype"),
    [(235, 255, np.uint8), (3839, 4095, np.uint16), (940, 1023, np.uint16)],
)
@pytest.mark.parametrize("n", [3, 4, 18])
def test_the_level_at_which_the_camera_clips_is_found(clip, full_scale, dtype, n):
    levels = steps(n, gain=1.6) * full_scale / 255
    clipped = np.clip(np.rint(levels), 0, clip).astype(dtype)
    assert find_plateau(clipped, full_scale) == clip
    few = np.where(np.arange(4000) % 33 == 0, 2.2, 1.1) * steps(n) * full_scale / 255
    few = np.clip(np.rint(few), 0, clip).astype(dtype)  # 3 % of the pixels
    assert find_plateau(few, full_scale) == clip


def test_noise_after_the_sensor_widens_the_plateau():
    levels = np.clip(steps(gain=2.0), 0, 235) + RNG.normal(0, 1.2, (4, 4000))
    found = find_plateau(np.rint(levels).clip(0, 255).astype(np.uint8), 255)
    assert found is not None
    assert 231 <= found <= 235


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 4.0])
@pytest.mark.parametrize("spread", [0.0, 0.3])
@pytest.mark.parametrize("bits", [4, 8, 10])
def test_a_bright_board_is_no_plateau(noise, spread, bits):
    for n in (3, 4, 18):
        levels = np.rint(steps(n, noise, spread, 1.15).clip(0, 254) * ((1 << bits) / 256))
        left = levels.astype(np.uint16) << (16 - bits)
        assert find_plateau(left, ((1 << bits) - 1) << (16 - bits)) is None


def test_black_and_white_levels_are_no_plateau():
    bits = np.where(RNG.random((8, 4000)) < 0.5, 20, 200).astype(np.uint8)
    assert find_plateau(bits, 255) is None
    assert find_plateau(bits[:1], 255) is None
    one_white = np.rint(steps(5, 0.5, 0.0)).astype(np.uint8)
    one_white[2] = 201
    assert find_plateau(one_white, 255) is None


def test_one_image_shows_a_plateau_of_a_single_level():
    image = np.rint(RNG.normal(np.linspace(40, 330, 400), 2, (300, 400)))
    assert image_white(image.clip(0, 235).astype(np.uint8)) == 235
    assert image_white(image.clip(0, 300).astype(np.uint16)) == pytest.approx(300, abs=1)
    evenly = np.rint(RNG.normal(200, 0.6, (300, 400))).astype(np.uint8)
    assert image_white(evenly) == 255


@pytest.mark.computes
@pytest.mark.parametrize("cell_px", [21.0, 23.0, 26.0])
def test_gray_cells_about_as_wide_as_a_fringe_decode(cell_px):
    frames = (*phase_steps("x", 4, 22.5), *gray_bits("x", 4))
    sequence = PatternSequence((256, 128), frames, gray_cell_px=cell_px)
    coordinate = slope(80, 200, start=20.0)
    phase = decode(sequence, capture(sequence, coordinate), "x")
    error = np.abs(phase.coordinate - coordinate)[phase.mask]
    assert phase.mask.mean() > 0.6
    assert 1e-3 < np.median(error) < 0.1
    assert error.max() < 1.0
