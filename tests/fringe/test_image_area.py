"""The part of the camera's image that light can change, and what is told apart from the rest."""

import numpy as np
import pytest

from slviewer.fringe.image_area import (
    ImageArea,
    combine_areas,
    fill_dead,
)
from slviewer.fringe.noise import measure_noise

SHAPE = (120, 160)


def frames(seed: int = 0, noise: float = 1.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    level = 90 + 60 * np.sin(np.arange(12))[:, None, None]
    return np.clip(np.rint(level + noise * rng.normal(size=(12, *SHAPE))), 1, 254).astype(np.uint8)


def measure(stack: np.ndarray) -> ImageArea:
    return ImageArea.of_frames(stack)


def boards(seed: int, hidden: np.ndarray | None = None) -> ImageArea:
    """The area of a turned board that moves in front of black, which has no noise."""
    rng = np.random.default_rng(seed)
    v, u = np.indices(SHAPE)
    du, dv = u - rng.uniform(60, 100), v - rng.uniform(50, 70)
    turn = rng.uniform(0.1, 0.5)
    x, y = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
    is_board = (abs(x) < rng.uniform(35, 50)) & (abs(y) < rng.uniform(25, 40))
    stack = np.where(is_board, frames(seed), 0)
    return measure(stack if hidden is None else np.where(hidden, 0, stack))


def test_an_image_that_changes_everywhere_is_whole() -> None:
    area = measure(frames())
    assert area.is_whole and not area.describe()
    assert combine_areas([area] * 3) is None


@pytest.mark.parametrize("level", [0, 40, 255])
def test_bars_are_no_image_whatever_their_level(level: int) -> None:
    stack = frames()
    stack[:, :, :13] = stack[:, -7:] = level
    stack[::2, 50, 3] ^= 1  # a pixel of a bar that flickers
    area = measure(stack)
    assert area.box == area.bounds == (13, 0, 160, 113) and not len(area.lines)
    assert area.area_px == (160 - 13) * 113
    assert area.describe() == "bars of 13 px at the left, 7 px at the bottom"
    common = combine_areas([area, area, area])
    assert common is not None and common.bounds == area.bounds
    inside = common.contains(np.array([[13.0, 0.0], [12.0, 0.0], [159.0, 112.0], [159.0, 113.0]]))
    assert inside.tolist() == [True, False, True, False]
    # cells of 16 x 12 px; a sliver of the first column's cells is image, and is filled
    cells = common.contains_cells((10, 10))
    assert not cells[:, 0].any() and cells[:9, 1:].all() and not cells[9].any()
    assert common.fill_outside(np.arange(100).reshape(10, 10))[0, :2].tolist() == [1, 1]


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("level", [0, 255])
def test_dead_lines_are_named_and_filled(width: int, level: int) -> None:
    v, u = np.indices(SHAPE)
    smooth = np.rint(120 + 60 * np.sin(u / 7) * np.cos(v / 9)).astype(np.uint8)
    stack = frames()
    stack[:, :, 70 : 70 + width] = level
    stack[:, 30, :80] = level  # half a row
    area = measure(stack)
    assert area.is_whole
    assert area.lines.tolist() == [*([0, 70 + k] for k in range(width)), [1, 30]]
    last = f" to {69 + width}" if width > 1 else ""
    assert area.describe() == f"column{'s' * (width > 1)} 70{last} and row 30"
    image = smooth.copy()
    image[:, 70 : 70 + width] = image[30] = level
    before = image.copy()
    filled = fill_dead(image, area)
    assert np.array_equal(image, before)
    assert np.abs(filled.astype(int) - smooth).max() <= 4
    both = np.stack([image] * 3, axis=-1)
    assert np.array_equal(fill_dead(both, area)[..., 1], filled)
    assert fill_dead(image, ImageArea.whole((160, 120))) is image


def test_single_dead_pixels_and_black_gaps_of_a_board_are_no_dead_lines() -> None:
    stack = frames()
    stack[:, *np.random.default_rng(1).integers(0, 120, (2, 40))] = 0
    assert not len(measure(stack).lines)
    v, u = np.indices(SHAPE)
    discs = np.hypot(u % 16 - 8, v % 16 - 8) < 6  # gaps of 4 px of black without noise
    assert not len(measure(np.where(discs, frames(), 0)).lines)


def test_the_circle_of_a_hood_is_no_image() -> None:
    v, u = np.indices(SHAPE)
    is_hidden = np.hypot(u - 79.5, v - 59.5) > 85
    areas = [measure(np.where(is_hidden, 0, frames(seed))) for seed in range(3)]
    area = combine_areas(areas)
    assert area is not None and area.box == (0, 0, 160, 120)
    assert area.area_px == pytest.approx(np.count_nonzero(~is_hidden), rel=0.02)
    corners = "top left, top right, bottom left, bottom right"
    assert area.describe() == f"{100 * (1 - area.area_px / 19200):.1f} % at the {corners}"


def test_bars_with_noise_are_no_image() -> None:
    for seed, level in enumerate((0, 16, 200, 255)):
        noise = level + 1.2 * np.random.default_rng(seed).normal(size=(12, *SHAPE))
        stack, hidden = frames(), np.clip(np.rint(noise), 0, 255)
        stack[:, :, :16] = hidden[:, :, :16]
        stack[:, 100:] = hidden[:, 100:]
        area = measure(stack)
        common = combine_areas([area] * 3)
        assert common is not None and common.box == (16, 0, 160, 100)


def test_faint_light_and_what_room_light_shows_are_image() -> None:
    rng = np.random.default_rng(0)
    for share in (0.02, 0.05):  # of the light, less than the noise
        light = share * (frames(noise=0).astype(float) - 90)
        stack = 60 + light + 1.5 * rng.normal(size=(12, *SHAPE))
        assert combine_areas([measure(np.rint(stack).astype(np.uint8))] * 3) is None
    texture = 60 + 20 * (np.indices(SHAPE).sum(axis=0) // 5 % 2)
    stack = frames()
    stack[:, :, :40] = np.rint(texture + 1.5 * rng.normal(size=(12, *SHAPE)))[:, :, :40]
    assert combine_areas([measure(stack)] * 3) is None


def test_masks_and_dead_pixels_are_named_where_they_are() -> None:
    dead = np.zeros(SHAPE, bool)
    dead[10:30, 70:100] = dead[90:, :20] = True
    single = np.random.default_rng(2).choice(SHAPE[0] * SHAPE[1], 12, replace=False)
    dead.reshape(-1)[single] = True
    areas = [measure(np.where(dead, 255, frames(seed))) for seed in range(3)]
    area = combine_areas(areas)
    assert area is not None and area.box == (0, 0, 160, 120)
    share = (20 * 30 + 30 * 20) / 192
    text = area.describe()
    assert text.startswith(f"{share:.1f} % at the top, bottom left and "), text
    assert int(np.count_nonzero(area.dead)) == pytest.approx(12, abs=2)
    assert not area.contains(np.array([[80.0, 20.0], [10.0, 100.0]])).any()


def test_a_background_too_dark_to_change_is_image() -> None:
    for first in range(0, 60, 3):
        areas = [boards(first + k) for k in range(3)]
        assert {area.box for area in areas} == {(0, 0, 160, 120)}
        assert combine_areas(areas) is None
    assert combine_areas([boards(0)] * 2) is None  # too few to tell


def test_a_dead_column_shows_before_a_background_too_dark_to_change() -> None:
    hidden = np.zeros(SHAPE, bool)
    hidden[:, 80] = True
    area = combine_areas([boards(seed, hidden) for seed in range(4)])
    assert area is not None and area.describe() == "column 80"


def test_bars_without_noise_leave_the_measured_noise_as_it_is() -> None:
    from slviewer.fringe.layout import axis_layout
    from slviewer.fringe.presets import complementary

    sequence = complementary((256, 64))
    rng = np.random.default_rng(0)
    wave = np.arange(len(sequence.frames))[:, None, None]
    clean = 100 + 50 * np.cos(wave + np.arange(160) / 9)
    stack = np.rint(clean + 2 * rng.normal(size=(len(wave), *SHAPE))).astype(np.uint8)
    layout = axis_layout(sequence, "x")
    before = np.array(measure_noise(layout, stack, 255.0))
    stack[:, :, :56] = 40
    after = np.array(measure_noise(layout, stack, 255.0))
    levels = np.array([[1, 60], [1, 140]])
    assert levels @ after == pytest.approx(levels @ before, rel=0.15)
