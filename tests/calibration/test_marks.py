"""Poses of one board that disagree on whether it has a mark, or show a part of it."""

from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts

from slviewer.calibration.diagnosis.numbering import place_by_neighbours, reconcile_marks
from slviewer.calibration.observe import Observation
from slviewer.target.board import Board

BOARD = Board.parse("circles:9x7:20")
PLACES = BOARD.points[:, :2] * 2 + (100.0, 80.0)
"""px, of an upright board that is numbered by the rule."""


def pose(name: str, marked: bool, turned: bool = False) -> Observation:
    camera = PLACES[::-1] if turned else PLACES
    projector = camera * 0.5
    return Observation(
        name,
        BOARD.points,
        camera,
        projector,
        {},
        {},
        (640, 480),
        (0, 0, 8, 8),
        np.zeros(8, np.uint8),
        marked=marked,
    )


@pytest.mark.parametrize("turned", [False, True])
def test_what_a_minority_takes_for_a_mark_is_none(turned: bool) -> None:
    poses = [pose(f"pose_{k}", marked=k < 3, turned=turned and k < 3) for k in range(8)]
    numbered, warning = reconcile_marks(BOARD, poses)
    assert [o.name for o in numbered] == [o.name for o in poses] and not any(
        o.marked for o in numbered
    )
    for each in numbered:
        np.testing.assert_array_equal(each.camera, PLACES)
        np.testing.assert_array_equal(each.projector, PLACES * 0.5)
    assert missing_facts(warning, 3, 8, "pose_0", "pose_1", "pose_2") == []


def test_poses_that_agree_stay_as_they_are() -> None:
    for marked in (6, 0):
        poses = [pose(f"pose_{k}", marked=k < marked, turned=k < marked) for k in range(8)]
        assert reconcile_marks(BOARD, poses) == (poses, "")


def test_a_part_is_numbered_as_the_next_pose_is_turned() -> None:
    upright, turned = pose("pose_1", False), pose("pose_4", False)
    turned = replace(turned, camera=turned.camera[:, ::-1] * [-1, 1] + (800, 0))
    shown = np.flatnonzero((BOARD.points[:, :2] < 90).all(axis=1))
    # the same corner of the board, as if it were turned by a quarter
    quarter = BOARD.points[shown][:, [1, 0, 2]] * [1, -1, 1] + [0, 120, 0]

    def part(whole: Observation, name: str, wrong_first: bool) -> Observation:
        numberings = [BOARD.points[shown], quarter][:: -1 if wrong_first else 1]
        return replace(
            whole, name=name, points=numberings[0], others=np.array(numberings[1:]),
            camera=whole.camera[shown], projector=whole.projector[shown],
        )  # fmt: skip

    poses = [upright, part(upright, "pose_2", True), part(turned, "pose_3", True), turned]
    placed = place_by_neighbours(poses)
    for each in placed[1:3]:
        np.testing.assert_array_equal(each.points, BOARD.points[shown])
    assert placed[0] is upright and placed[3] is turned
    alone = [part(upright, "pose_2", True)]
    assert place_by_neighbours(alone) == alone
