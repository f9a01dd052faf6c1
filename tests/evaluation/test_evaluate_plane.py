"""A board of known flatness and noise, found in a cloud that also holds other things."""

import numpy as np
import pytest
from facts import missing_facts, raises
from planted import board_before_a_wall, cloud, plane_depth, rays, rectangle

from slviewer.errors import InputError
from slviewer.evaluation.fit import ShapeSearch, evaluate_plane

SIGMA = 0.05


def along_normal(points: np.ndarray, normal: np.ndarray, sigma_z: float) -> float:
    """What sigma_z leaves perpendicular to the plane, as root mean square."""
    return float(np.sqrt(np.mean((sigma_z * rays()[np.isfinite(points[..., 2])] @ normal) ** 2)))


def test_the_plane_and_its_noise_are_found_in_a_whole_cloud() -> None:
    points, board = board_before_a_wall(SIGMA)
    result = evaluate_plane(points, None, np.full(points.shape[:2], SIGMA, np.float32))
    # z = 600 + 0.2 x - 0.1 y, towards the camera
    truth = np.array([0.2, -0.1, -1.0]) / np.sqrt(1.05)
    assert np.degrees(np.arccos(result.plane.normal @ truth)) < 0.01
    assert result.points > 0.95 * board.sum()
    assert not np.isfinite(result.error_map[~board]).any()
    assert result.excluded < 1e-4 * result.points
    expected = along_normal(np.where(board[..., None], points, np.nan), truth, SIGMA)
    assert result.rms_mm == pytest.approx(expected, rel=0.02)
    assert result.noise_floor_mm == pytest.approx(result.rms_mm, rel=0.02)
    assert result.warning is None


def test_noise_that_differs_from_pixel_to_pixel_has_its_own_floor() -> None:
    sigma = np.linspace(0.03, 0.12, 400)[None].repeat(300, axis=0)
    result = evaluate_plane(cloud(plane_depth(), sigma), np.ones((300, 400), bool), sigma)
    # root mean square, on a slanted plane
    assert result.noise_floor_mm == pytest.approx(0.079 * 0.97, rel=0.05)
    assert result.rms_mm == pytest.approx(result.noise_floor_mm, rel=0.02)


def test_errors_are_positive_towards_the_camera() -> None:
    z = plane_depth()
    z[140:160, 190:210] -= 0.3
    result = evaluate_plane(cloud(z, 0.02), None)
    assert 0.2 < np.nanmean(result.error_map[142:158, 192:208]) < 0.3


def test_stray_points_are_set_aside_and_counted() -> None:
    points, _ = board_before_a_wall(SIGMA)
    rng = np.random.default_rng(1)
    inner = np.argwhere(rectangle((60, 310), (30, 260)))
    stray = inner[rng.choice(len(inner), 500, replace=False)]
    points[stray[:, 0], stray[:, 1]] *= rng.uniform(1.005, 1.2, (500, 1)).astype(np.float32)
    result = evaluate_plane(points, None)
    assert 495 <= result.excluded <= 510
    assert 0.045 < result.rms_mm < 0.052
    assert not result.inliers[stray[:, 0], stray[:, 1]].any()
    assert np.isfinite(result.error_map[stray[:, 0], stray[:, 1]]).mean() > 0.99


def test_more_than_two_percent_set_aside_is_a_warning() -> None:
    z = plane_depth()
    z[100:150, 100:180] += 1.5  # 3 % of the board, where it is dented
    result = evaluate_plane(cloud(z, 0.02), None)
    assert result.warning is not None
    assert missing_facts(result.warning, "3.3 %") == []


def test_missing_data_and_gaps_do_not_cut_the_board() -> None:
    points, board = board_before_a_wall(SIGMA)
    points[:, ::29] = np.nan  # lost code edges
    points[:, 1::29] = np.nan
    points[np.random.default_rng(2).random(points.shape[:2]) < 0.1] = np.nan
    result = evaluate_plane(points, None)
    assert result.points > 0.93 * np.count_nonzero(board & np.isfinite(points[..., 2]))
    assert 0.045 < result.rms_mm < 0.052


def test_a_bow_of_half_a_millimetre_is_not_flattened() -> None:
    x = rays()[..., 0] * 600.0
    bow = 0.5 * (1.0 - (x / np.abs(x).max()) ** 2)
    result = evaluate_plane(cloud(plane_depth() - bow, 0.02), None)
    inner = bow[2:-2, 2:-2]
    assert result.excluded == 0
    # 0.976: the plane's slant
    assert result.rms_mm == pytest.approx(np.std(inner) * 0.976, rel=0.06)


def test_a_bent_corner_stays_in_the_region() -> None:
    x, y = rays()[..., 0] * 600.0, rays()[..., 1] * 600.0
    bend = np.clip(x + y - 150.0, 0.0, None) * 0.02  # up to 3 mm
    result = evaluate_plane(cloud(plane_depth() + bend, 0.02), None)
    assert result.points > 0.97 * x.size
    assert result.warning is not None


def test_tolerances_follow_the_noise_of_a_coarse_cloud() -> None:
    sigma = 6.0  # Gray code alone, on a rig with little depth per projector pixel
    points, board = board_before_a_wall(sigma)
    result = evaluate_plane(points, None, np.full(points.shape[:2], sigma))
    assert result.points > 0.95 * board.sum()
    assert result.noise_floor_mm == pytest.approx(result.rms_mm, rel=0.02)


def test_a_given_mask_is_all_that_is_looked_at() -> None:
    points, board = board_before_a_wall(SIGMA)
    wall = rectangle((330, 400), (0, 300))
    result = evaluate_plane(points, wall)
    assert result.points == wall.sum()
    assert result.plane.offset == pytest.approx(-900.0 / np.sqrt(1.01), abs=1.0)
    assert not np.isfinite(result.error_map[board]).any()


def test_a_masked_region_full_of_strays_is_still_measured() -> None:
    points, board = board_before_a_wall(SIGMA)
    points[30:120, 60:200] *= 1.1  # a fifth of the mask shows something else
    result = evaluate_plane(points, board)
    assert 0.045 < result.rms_mm < 0.052
    assert 0.15 < result.excluded_share < 0.25
    assert result.warning is not None


def test_clouds_without_a_plane_are_refused() -> None:
    empty = np.full((300, 400, 3), np.nan, np.float32)
    with pytest.raises(InputError):
        evaluate_plane(empty, None)
    with pytest.raises(InputError):
        ShapeSearch("plane", cloud(np.random.default_rng(0).uniform(300, 900, (300, 400)))).find()
    with raises(InputError, "organised", "(120000, 3)"):
        evaluate_plane(empty.reshape(-1, 3), None)
    with raises(InputError, "mask", "(3, 4)", "(300, 400)"):
        evaluate_plane(cloud(plane_depth()), np.ones((3, 4), bool))
    with raises(InputError, "noise", "(3, 4)", "(300, 400)"):
        evaluate_plane(cloud(plane_depth()), None, np.ones((3, 4)))
