"""The list of what is in the 3D view, without a browser."""

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
import viser

from slviewer.gui.scene import ViewerScene
from slviewer.server.secure import SafeServer, Serving, serve


@pytest.fixture
def server() -> Iterator[SafeServer]:
    server = serve(Serving(port=0))
    yield server
    server.stop()


def test_hidden_objects_stay_hidden_and_points_keep_their_size(server: SafeServer) -> None:
    scene, changes = ViewerScene(server.viser, lambda do: do()), list[int]()
    scene.on_change = lambda: changes.append(1)
    layer, other = scene.layer("scan"), scene.layer("merge")
    points = np.random.default_rng(0).random((500, 3)).astype(np.float32)

    def draw() -> viser.PointCloudHandle:
        layer.cloud("cloud", points, (1, 2, 3))
        node = server.viser.scene.get_handle_by_name("/scan/cloud")
        assert isinstance(node, viser.PointCloudHandle)
        return node

    size = draw().point_size
    layer.lines("m1", np.zeros((1, 2, 3)), (1, 2, 3), label=("distance 1", np.zeros(3)))
    assert layer.list_objects() == {"cloud": ("cloud", True), "m1": ("distance 1", True)}
    layer.toggle("cloud")
    assert not draw().visible and layer.list_objects()["cloud"] == ("cloud", False)
    layer.toggle("cloud")
    assert draw().visible
    scene.scale_points(2.0)
    assert draw().point_size == pytest.approx(2 * size)
    scene.scale_points(0.5)
    assert draw().point_size == pytest.approx(size / 2)
    layer.mesh("mesh", trimesh.creation.box((10, 20, 30)))
    assert layer.list_objects()["mesh"] == ("mesh", True)
    layer.remove("mesh")
    changes.clear()
    layer.remove("m1")
    layer.show(False)
    assert layer.list_objects() == other.list_objects() == {} and len(changes) == 2


def test_objects_have_titles_and_boards_lose_their_labels(server: SafeServer) -> None:
    scene = ViewerScene(server.viser, lambda do: do())
    layer, outline = scene.layer("poses"), np.eye(4, 3)
    layer.cloud("cloud", np.eye(3, dtype=np.float32), (1, 2, 3), title="A flat plate")
    layer.mesh("mesh", trimesh.creation.box((10, 20, 30)), "mesh of merged scans")
    layer.board("pose_01", np.eye(4), outline, (1, 2, 3), 1.0, label="pose_01")
    assert [title for title, _ in layer.list_objects().values()] == [
        "A flat plate",
        "mesh of merged scans",
        "pose_01",
    ]
    assert server.viser.scene.get_handle_by_name("/poses/pose_01/label") is not None
    layer.board("pose_01", np.eye(4), outline, (1, 2, 3), 1.0)
    assert server.viser.scene.get_handle_by_name("/poses/pose_01/label") is None
