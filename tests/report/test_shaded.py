"""The little renderer: nearer hides farther, up is up, light comes from above, holes stay holes."""

import numpy as np
import pytest

from slviewer.report.surfaces import BACKGROUND, _select_mosaic, render_points, view_rotation

SIZE = (120, 90)
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def sheet(z: float, half: float, n: int = 120) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-0.75 * half, 0.75 * half, n))
    return np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)


def drawn(
    points: np.ndarray, colours: np.ndarray, normal: tuple[float, float, float] = (0, 0, -1)
) -> np.ndarray:
    return render_points(
        points, np.broadcast_to(normal, points.shape), colours, SIZE, np.eye(3)
    ).astype(int)


def test_nearer_points_hide_farther_ones() -> None:
    near, far = sheet(500, 20), sheet(600, 40)
    colours = np.concatenate([np.broadcast_to(RED, near.shape), np.broadcast_to(BLUE, far.shape)])
    for order in (slice(None), slice(None, None, -1)):
        image = drawn(np.concatenate([near, far])[order], colours[order])
        assert image.shape == (90, 120, 3)
        middle, side = image[45, 60], image[45, 15]
        assert middle[0] > 2 * middle[2] and side[2] > 2 * side[0]
        assert tuple(image[1, 1]) == BACKGROUND


def test_up_is_up_and_left_is_left() -> None:
    points = sheet(500, 40)
    colours = np.where((points[:, :1] < 0) & (points[:, 1:2] < 0), RED, BLUE)
    image = drawn(points, colours)
    assert image[30, 40, 0] > image[30, 40, 2] and image[60, 80, 2] > image[60, 80, 0]


def test_light_comes_from_above() -> None:
    points, grey = sheet(500, 40), np.full((14400, 3), 0.7)
    tilt = np.sqrt(0.5)
    up, down = (drawn(points, grey, (0, s * tilt, -tilt))[45, 60, 0] for s in (-1, 1))
    assert up > down + 60
    unknown = render_points(points, np.full(points.shape, np.nan), grey, SIZE, np.eye(3))
    assert down < unknown[45, 60, 0] < 255


def test_the_viewer_steps_aside_and_up() -> None:
    R = view_rotation(24, 18)
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1)
    nearer = R @ [0.0, 0.0, -1.0]
    # what sticks out moves right and down: seen from the left and above
    assert nearer[0] > 0 and nearer[1] > 0


def test_a_mosaic_shows_one_scan_in_each_square_and_leaves_no_hole() -> None:
    rng = np.random.default_rng(0)
    whole, part = rng.uniform(0, 100, (40000, 2)), rng.uniform(0, 50, (20000, 2))
    points = np.column_stack([np.concatenate([whole, part]), np.zeros(60000)])
    source = np.repeat([0, 1], [40000, 20000])
    shown = _select_mosaic(points, source)
    assert set(source[shown]) == {0, 1}
    cells = (points[shown, :2] // 2).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.95 * 50 * 50
    alone = points[shown][(points[shown, 0] > 60)]
    assert len(alone) == (points[:, 0] > 60).sum()
