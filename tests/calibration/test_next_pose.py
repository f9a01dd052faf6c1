"""Suggested poses keep the board in view, close the gaps of coverage, and say in words what they
are."""

import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.calibration.next_pose import (
    TILTS,
    approximate_pose,
    count_cells,
    count_coverage,
    depth_range,
    estimated_lens,
    nominal_lens,
    outline_px,
    projector_reach,
    suggest,
)
from slviewer.errors import InputError
from slviewer.target.board import Board

BOARD = Board.parse("circles:21x16:9")
LENS = nominal_lens((400, 300), 889.0)


def everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


def follow(n: int, illuminated=everywhere) -> list[np.ndarray]:
    poses: list[np.ndarray] = []
    for _ in range(n):
        poses.append(suggest(BOARD, LENS, poses, illuminated=illuminated).T_camera_board)
    return poses


@pytest.mark.computes
def test_suggestions_close_every_gap_and_stay_in_view():
    poses = follow(12)
    found = count_coverage(BOARD, LENS, poses)
    assert found.cells.min() >= 2 and found.depths.min() >= 2 and found.tilts.min() >= 1
    assert found.share > 0.95
    near, far = depth_range(BOARD, LENS)
    for T in poses:
        corners = outline_px(BOARD, LENS, T)
        assert (corners > 0).all() and (corners < [399, 299]).all()
        assert near * 0.8 < T[2, 3] < far * 1.2
    shares = [count_coverage(BOARD, LENS, poses[:k]).share for k in range(13)]
    assert shares[0] == 0 and np.diff(shares).min() >= 0


@pytest.mark.computes
def test_words_say_what_the_pose_is():
    words = {"facing": ["squarely"], **{tilt: tilt.split() for tilt in TILTS[1:]}}
    seen = set()
    poses: list[np.ndarray] = []
    for _ in range(14):
        next_one = suggest(BOARD, LENS, poses, illuminated=everywhere)
        poses.append(next_one.T_camera_board)
        tilts = count_coverage(BOARD, LENS, poses[-1:]).tilts
        tilt = TILTS[int(np.argmax(tilts))]
        attitude, _, where = next_one.sentence.split(",")
        assert missing_facts(attitude, *words[tilt]) == []
        seen.add(tilt)
        centre = next_one.outline_px.mean(0)
        assert ("left" in where) == (centre[0] < 0.44 * 400)
    assert seen == set(TILTS)
    # the top of a board tilted "top away" is farther than its bottom
    top_away = next(T for T in poses if count_coverage(BOARD, LENS, [T]).tilts[1])
    top, bottom = (
        top_away[:3, :3] @ corner + top_away[:3, 3] for corner in BOARD.outline()[[0, 3]]
    )
    assert top[2] > bottom[2] + 10


def test_a_pose_and_a_lens_are_recovered_from_features():
    poses = follow(5)
    seen = [LENS.project(BOARD.points @ T[:3, :3].T + T[:3, 3]) for T in poses]
    for T, pixels in zip(poses, seen, strict=True):
        np.testing.assert_allclose(approximate_pose(BOARD.points, pixels, LENS), T, atol=1e-3)
    lens = estimated_lens([BOARD.points] * 5, seen, (400, 300))
    assert lens.K[0, 0] == pytest.approx(889, rel=0.01)
    assert estimated_lens([BOARD.points], seen[:1], (400, 300)).K[0, 0] == pytest.approx(600)
    assert approximate_pose(BOARD.points[:3], seen[0][:3], LENS) is None


def test_the_projectors_reach_is_learnt_from_two_planes():
    P = np.array([[700.0, 0, 456, 300 - 456 * 0.3], [0, 1400, 570, 0], [0, 0, 1, 0]]) @ np.diag(
        [1, 1, 1, 300.0]
    )

    def project(points):
        h = np.column_stack([points, np.ones(len(points))]) @ P.T
        return h[:, :2] / h[:, 2:]

    planes = [BOARD.points @ T[:3, :3].T + T[:3, 3] for T in follow(2, illuminated=None)]
    points = np.concatenate(planes)
    reach = projector_reach(points, project(points), (912, 1140))
    assert reach is not None
    trial = np.random.default_rng(0).uniform([-300, -300, 450], [300, 300, 700], (500, 3))
    u = project(trial) / [912, 1140]
    clearly = (np.abs(u - 0.5) < 0.47).all(1) | (np.abs(u - 0.5) > 0.5).any(1)
    np.testing.assert_array_equal(reach(trial)[clearly], (np.abs(u - 0.5) < 0.48).all(1)[clearly])
    assert projector_reach(planes[0], project(planes[0]), (912, 1140)) is None
    for T in follow(6, illuminated=reach):
        assert reach(BOARD.outline() @ T[:3, :3].T + T[:3, 3]).all()


def test_refused_suggestions_are_passed_over_and_large_boards_refused():
    first, second = (
        suggest(BOARD, LENS, [], illuminated=everywhere, skip=k).T_camera_board for k in (0, 1)
    )
    assert not np.allclose(first, second)
    with raises(InputError, BOARD):
        suggest(BOARD, LENS, [], illuminated=lambda points: np.zeros(len(points), bool))


def test_cells_of_an_image_are_counted_by_pose():
    corner, whole = np.array([[0.0, 0.0], [399.4, 299.4]]), np.mgrid[:400:20, :300:20]
    counts = count_cells([corner, whole.reshape(2, -1).T.astype(float)], (400, 300))
    expected = np.ones((3, 4), int)
    expected[0, 0] = expected[2, 3] = 2
    np.testing.assert_array_equal(counts, expected)
    assert not count_cells([], (400, 300)).any()
