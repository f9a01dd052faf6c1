"""Raw mosaics saved as grey are noticed, and nothing else is taken for one."""

import numpy as np
import pytest
from fringe_scene import capture, slope
from scipy.ndimage import gaussian_filter

from slviewer.fringe.presets import gray, p18
from slviewer.fringe.raw_image import measure_mosaic

pytestmark = pytest.mark.computes


def make_scene(seed: int, shape: tuple[int, int] = (121, 163)) -> np.ndarray:
    """Return frames (4, h, w) of a random scene, with noise, a part of it dark."""
    rng = np.random.default_rng(seed)
    scene = gaussian_filter(rng.uniform(0, 255, shape), 1.0)
    scene = 60 + 6 * (scene - scene.mean())
    scene[:, : shape[1] // 3] *= 0.05
    return np.clip(scene + rng.normal(0, 2, (4, *shape)), 0, 255)


@pytest.mark.parametrize("red", [(0, 0), (0, 1), (1, 0), (1, 1)])
@pytest.mark.parametrize("gains", [(0.55, 0.45), (0.9, 0.85), (1.2, 0.8), (0.4, 1.6)])
def test_mosaics_of_any_order_and_colour_are_noticed(
    red: tuple[int, int], gains: tuple[float, float]
) -> None:
    frames, (i, j) = make_scene(3), red
    frames[:, i::2, j::2] *= gains[0]
    frames[:, 1 - i :: 2, 1 - j :: 2] *= gains[1]
    assert measure_mosaic(np.clip(np.rint(frames), 0, 255).astype(np.uint8)) > 0.02


@pytest.mark.parametrize("seed", range(3))
def test_scenes_are_not_taken_for_mosaics(seed: int) -> None:
    frames = make_scene(seed).astype(np.uint8)
    assert measure_mosaic(frames) == 0
    frames[:, :, ::2] //= 2  # the finest stripes, or a sensor's columns
    assert measure_mosaic(frames) == 0


@pytest.mark.parametrize("sequence", [p18((912, 1140)), gray((912, 1140))])
def test_fringes_are_not_taken_for_mosaics(sequence) -> None:
    for per_px in (0.5, 1.0, 2.0):
        frames = capture(sequence, slope(per_px=per_px), gain=200)
        assert measure_mosaic(frames) == 0
    assert measure_mosaic(np.zeros_like(frames)) == 0
