"""A simulated board with its mark is numbered from the same circle at any turn; without it, from
the one that is up."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import AlteredScene, Rays, Surface
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.target.mark import mark_geometry

BOARD = Board.parse("circles:11x8:14")


class MarkedBoard(AlteredScene):
    """The board with its mark."""

    def trace(self, rays: Rays) -> Surface:
        surface, mark = self.scene.trace(rays), mark_geometry(BOARD)
        x, y, _ = np.moveaxis((surface.points - self.scene.pose.t) @ self.scene.pose.R, -1, 0)
        inside = np.hypot(x - mark.x, y - mark.y) < mark.radius
        return replace(surface, albedo=np.where(inside, np.float32(0.09), surface.albedo))


@pytest.mark.parametrize("turned", [0.0, 180.0])
def test_the_first_circle_is_the_marked_one(turned: float) -> None:
    rig = letter(0.25, 0)
    R = rotation(np.radians([20.0, -10.0, 0.0])) @ rotation(np.radians([0.0, 0.0, turned]))
    pose = Pose(R, np.array([0.0, 0.0, 600.0]) - R @ BOARD.points.mean(0))
    image = np.empty(rig.camera.size[::-1], np.uint8)
    found = {}
    for marked in (True, False):
        board = printed_board(BOARD, pose)
        scene = MarkedBoard(board) if marked else board
        Renderer(rig, scene).frame(("x", np.full(912, 255.0)), np.arange(2, dtype=np.uint32), image)
        found[marked] = detect(BOARD, image)
        assert found[marked].marked == marked
    true = rig.camera.project(pose.to_camera(board.features))
    assert np.abs(found[True].pixels - true).max() < 0.15
    plain = found[False].pixels if turned == 0 else found[False].pixels[::-1]
    assert np.abs(plain - true).max() < 0.15
