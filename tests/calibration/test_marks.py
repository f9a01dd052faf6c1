"""Poses of one board that disagree on whether it has a mark."""

import numpy as np
import pytest
from facts import missing_facts

from slviewer.calibration.diagnosis.numbering import reconcile_marks
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
