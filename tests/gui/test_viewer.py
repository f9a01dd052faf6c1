"""The 3D view that a script or a notebook opens of a cloud or a mesh."""

import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from facts import raises

import slviewer as sl
from slviewer.errors import InputError
from slviewer.gui.viewer import Viewer
from slviewer.surface.shapes import Mesh, PointSet

V, U = np.mgrid[:40, :60].astype(np.float32)
PLANE = np.dstack([U - 30, V - 20, 500 + 0.2 * U]).astype(np.float32)
FLAT = PLANE.reshape(-1, 3)
FACES = np.array([[0, 1, 60], [1, 61, 60]], np.int32)


def nodes(viewer: Viewer) -> set[str]:
    return {
        getattr(message, "name", "") for message in viewer._server._websock_server._broadcast_buffer
        .message_from_id.values()
    } & {"/cloud", "/surface"}  # fmt: skip


def status(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.parametrize(
    ("what", "node"),
    [
        (PLANE, "/cloud"),
        (FLAT, "/cloud"),
        (sl.Cloud(PLANE, "x", "stereo", np.ones(U.shape)), "/cloud"),
        (PointSet(FLAT, colours=np.full((len(FLAT), 3), 90, np.uint8)), "/cloud"),
        (Mesh(FLAT, FACES), "/surface"),
        (Mesh(FLAT, FACES, colours=np.full((len(FLAT), 3), 90, np.uint8)), "/surface"),
    ],
    ids=["grid", "points", "Cloud", "PointSet", "Mesh", "coloured"],
)
def test_each_kind_of_shape_is_drawn_and_framed(what: object, node: str) -> None:
    with sl.show(what, open_browser=False) as viewer:
        assert nodes(viewer) == {node}
        camera = viewer._server.initial_camera
        assert np.linalg.norm(np.subtract(camera.look_at, np.median(FLAT, axis=0))) < 5
        assert 50 < np.linalg.norm(np.subtract(camera.position, camera.look_at)) < 300


def test_the_view_is_served_to_its_own_address_alone() -> None:
    viewer = sl.show(FLAT, open_browser=False)
    port = viewer.url.rpartition(":")[2]
    assert viewer.url == f"http://127.0.0.1:{port}" and viewer.url in viewer._repr_html_()
    assert status(viewer.url) == 200
    assert status(viewer.url, Origin="https://elsewhere.example") == 403
    assert status(viewer.url, Host=f"elsewhere.example:{port}") == 403
    viewer.close()
    viewer.close()
    viewer.wait()  # returns, as it is closed
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(viewer.url, timeout=2)


def test_a_file_and_a_session_are_shown(tmp_path: Path) -> None:
    sl.write_ply(tmp_path / "points.ply", FLAT)
    with sl.show(tmp_path / "points.ply", open_browser=False) as viewer:
        assert nodes(viewer) == {"/cloud"}
    sl.import_cloud(tmp_path / "session", [tmp_path / "points.ply"])
    with sl.show(tmp_path / "session", "points", open_browser=False) as viewer:
        assert nodes(viewer) == {"/cloud"}
    with raises(InputError, "merge/1"):
        sl.show(tmp_path / "session")


def test_what_cannot_be_shown_is_refused() -> None:
    with raises(InputError, "dict"):
        sl.show({})
    with raises(InputError, "valid"):
        sl.show(np.full((4, 5, 3), np.nan, np.float32))


def test_a_browser_is_opened_except_in_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    with sl.show(FLAT) as viewer:
        assert opened == [viewer.url]
    monkeypatch.setattr("slviewer.gui.viewer._in_notebook", lambda: True)
    with sl.show(FLAT):
        assert len(opened) == 1
