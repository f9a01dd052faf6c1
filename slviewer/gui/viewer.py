"""A 3D view of one cloud, surface or mesh, for scripts and notebooks."""

import os
import sys
import threading
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from html import escape
from http import HTTPStatus
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import viser
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as serve_websockets
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows
from slviewer.gui.colouring import shade
from slviewer.gui.scene import FIELD_OF_VIEW, add_points, frame_points, set_view, thin
from slviewer.pipeline.measure import MeasuredSurface, load_surface
from slviewer.pipeline.operation import Job, opened
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import cloud_normals, normals
from slviewer.server import viser_internals
from slviewer.server.connection import quiet_logger
from slviewer.session.ply import Ply, read_ply
from slviewer.session.reading import expand_user
from slviewer.session.store import Session
from slviewer.surface.shapes import Mesh, PointSet

SHOWN_POINTS = 400_000
"""Points that are sent to the browser; a larger cloud is thinned evenly."""
PAGE_STYLE = b'[data-testid="floating-panel"] { display: none !important; }'
"""Hides viser's own panel, which has nothing to choose."""
FRAME_SCRIPT = (
    b"try { localStorage } catch { Object.defineProperty(window, 'localStorage',"
    b" { value: { getItem: () => null, setItem() {}, removeItem() {} } }) }"
)
"""Browsers deny their storage to a frame of another site's page, such as a notebook's, and viser's
page ends without one."""


class Viewer:
    """A 3D view that is served to this computer alone, at ``url``, until it is closed or the
    program ends. A notebook shows it below the cell that returns it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._closed = server, threading.Event()
        self.url = f"http://127.0.0.1:{server.get_port()}"

    def close(self) -> None:
        """Stop serving; the view in the browser stays as it is, and can no longer be reloaded."""
        if not self._closed.is_set():
            self._closed.set()
            viser_internals.stop(self._server)

    def wait(self) -> None:
        """Keep a script running until the view is closed or Ctrl-C is pressed."""
        try:
            while not self._closed.wait(1.0):  # some systems deliver Ctrl-C only between waits
                pass
        except KeyboardInterrupt:
            self.close()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<3D view at {self.url}>"

    def _repr_html_(self) -> str:
        """Return the view as a frame of a notebook."""
        return (
            f'<iframe src="{escape(self.url)}" title="3D view" width="100%" height="520"'
            ' style="border:0"></iframe>'
        )


def show(what: Any, name: str = "", *, open_browser: bool | None = None) -> Viewer:
    """Show a cloud, a surface or a mesh in a 3D view in the browser, framed and shaded, and return
    the `Viewer`, which closes it.

    Args:
        what: A `Cloud`; points (h, w, 3) or (n, 3) mm; a merged cloud of `fuse_clouds`, a mesh of
            `mesh_cloud`; a PLY file, or what `read_ply` returns; a session or its folder.
        name: Of a session: a scan, or a merge such as merge/1.
        open_browser: By default True, except in a notebook, which shows the view itself.

    A script that ends closes the view: `Viewer.wait` keeps it. Other programs on this computer can
    open the address too. Raises InputError for what cannot be shown, or holds no valid point.
    """
    shape = _find_shape(what, name)
    points = shape.points.reshape(-1, 3)
    points = points[finite_rows(points)]
    if not len(points):
        raise InputError("No valid point to show", "give a cloud with measured points.")
    viser_internals.check_version()
    server = viser_internals.start(_serve, "127.0.0.1", 0)
    server.gui.configure_theme(control_layout="floating")
    server.scene.set_up_direction("-y")
    server.initial_camera.fov = FIELD_OF_VIEW
    set_view(server.initial_camera, *frame_points(points, 1.6))
    _draw(server.scene, shape)
    viewer = Viewer(server)
    if open_browser if open_browser is not None else not _in_notebook():
        webbrowser.open(viewer.url)
    return viewer


def _serve(
    handler: Callable[..., Any], host: str, port: int, *, process_request: Any, **options: Any
) -> serve_websockets:
    """Start viser's server with our page, for browsers that were led to it by its own address."""
    start = b"<script>" + FRAME_SCRIPT + b"</script><style>" + PAGE_STYLE
    page = viser_internals.client_page().replace(b"<style>", start, 1)

    def answer(connection: ServerConnection, request: Request) -> Any:
        """Return the page, or viser's answer; a refusal where another site's page requests it."""
        own, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        is_own = own.startswith(("127.0.0.1:", "localhost:")) and origin in (None, f"http://{own}")
        if not is_own:
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the address of the 3D view.")
        if request.path != "/" or "Upgrade" in request.headers:
            return process_request(connection, request)
        headers = Headers([("Content-Type", "text/html"), ("Content-Length", str(len(page)))])
        return Response(HTTPStatus.OK, "OK", headers, page)

    options["logger"] = quiet_logger()
    return serve_websockets(handler, host, port, process_request=answer, **options)


def _find_shape(what: Any, name: str) -> Ply:
    """Return what is to be drawn of any of the kinds that `show` takes: points (h, w, 3) or (n, 3)
    mm, and where known normals like them, colours (...) or (..., 3) uint8, and faces."""
    if isinstance(what, str | os.PathLike | Session):
        path = what if isinstance(what, Session) else expand_user(Path(what))
        if isinstance(path, Path) and path.is_file():
            return _find_shape(read_ply(path), name)
        if not name:
            raise InputError("Which scan? Give its name as the second argument, or merge/1.")
        with opened(path) as store:
            return _find_shape(load_surface(Job(store), name), name)
    for wrapper in ("meshed", "mesh", "fused", "surface"):
        what = getattr(what, wrapper, what)
    match what:
        case Cloud():
            return Ply(what.points, what.texture, cloud_normals(what))
        case MeasuredSurface():
            return Ply(what.points, what.texture, what.normals, faces=what.faces)
        case Mesh():
            return Ply(what.vertices, what.colours, what.normals, faces=what.faces)
        case PointSet():
            return Ply(what.points, what.colours, what.normals)
        case Ply():
            return what
        case np.ndarray() if what.ndim in (2, 3) and what.shape[-1] == 3:
            return Ply(what, None, normals(what) if what.ndim == 3 else None)
    raise InputError(
        f"{type(what).__name__} cannot be shown",
        "give a cloud, points (..., 3), a mesh, a PLY file, or a session and a scan.",
    )


def _draw(scene: viser.SceneApi, shape: Ply) -> None:
    """Draw a mesh, or points in their colours, shaded as in the wizard."""
    points, faces = shape.points, shape.faces
    if faces is not None and len(faces):
        if shape.colours is None:
            scene.add_mesh_simple("/surface", points, faces, color=(200, 205, 210), side="double")
        else:
            coloured = trimesh.Trimesh(points, faces, vertex_colors=shape.colours, process=False)
            scene.add_mesh_trimesh("/surface", coloured)
        return
    if shape.colours is None:
        shape = replace(shape, colours=np.full(points.shape[:-1], 215, np.uint8))
    colours = shade(np.asarray(shape.colours), shape.normals)
    add_points(scene, "/cloud", *thin(points, colours, SHOWN_POINTS))


def _in_notebook() -> bool:
    """Return whether a notebook runs this program, which shows what a cell returns."""
    return "ipykernel" in sys.modules and "IPython" in sys.modules
