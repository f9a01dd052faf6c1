"""A simulated board with its mark is numbered from the same circle at any turn; without it, from
the one that is up."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.target.mark import mark_geometry

BOARD = Board.parse("circles:11x8:14")


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_the_first_circle_is_the_marked_one(turned: float) -> None:
    rig = letter(0.25, 0)
    R = rotation(np.radians([20.0, -10.0, 0.0])) @ rotation(np.radians([0.0, 0.0, turned]))
    pose = Pose(R, np.array([0.0, 0.0, 600.0]) - R @ BOARD.points.mean(0))
    image = np.empty(rig.camera.size[::-1], np.uint8)
    found = {}
    for marked in (True, False):
        mark = mark_geometry(BOARD) if marked else None
        scene = replace(printed_board(BOARD, pose), mark=mark)
        Renderer(rig, scene).frame(("x", np.full(912, 255.0)), np.arange(2, dtype=np.uint32), image)
        found[marked] = detect(BOARD, image)
        assert found[marked].marked == marked
    true = rig.camera.project(pose.to_camera(scene.features))
    assert np.abs(found[True].pixels - true).max() < 0.15
    plain = found[False].pixels if turned == 0 else found[False].pixels[::-1]
    assert np.abs(plain - true).max() < 0.15
