"""The 3D view: named layers in the camera's frame, in mm, x to the right and y down as in the
image; clicks and drags in it, and the browsers' viewpoints.

A layer ("poses", "scan", …) belongs to a panel, which fills it, and shows or hides it as a whole.
Every method may be called from any thread.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import trimesh
import viser
import viser.transforms as tf
from numpy.typing import NDArray

from slviewer.geometry.vectors import thin_out
from slviewer.gui.widgets import Text
from slviewer.server.viser_internals import listen_to_shapes
from slviewer.surface.selection import ViewCamera
from slviewer.wizard.result_views import nearest

Colour = tuple[int, int, int]

CAMERA: Colour = (40, 120, 200)
PROJECTOR: Colour = (235, 140, 30)
GHOST: Colour = (20, 160, 220)

SHOWN_POINTS = 150_000
"""Points of one cloud that are sent to a browser: software rendering still moves them smoothly."""
USUAL_DISTANCE_MM = 600.0
"""Working distance of a rig that is not calibrated; all that is drawn beside scans is of a size
relative to the rig's own."""
_NEAREST, _FARTHEST = 1 / 300, 100.0
"""Depths that are drawn, over the view's distance."""
_FROM = np.array([-0.45, -0.35, -0.82])
"""Viewing direction: from the upper left of the camera, so that depth is visible and nothing is
upside down."""
TO_THE_RIGHT = np.cross([0.0, 1.0, 0.0], -_FROM) / np.linalg.norm(_FROM[[0, 2]])
"""(3,): to the right in that view, at the same distance."""
_OVERVIEW = np.array([(-0.72, -0.93, -1.37), (0.09, 0.07, 0.55)])
"""Camera position and target over the working distance: the rig and objects there, in a narrow
window too."""
FIELD_OF_VIEW = 0.75  # rad


@dataclass(frozen=True, eq=False)
class Click:
    """A click into the 3D view: the browser's view, the place in it, (2,) from 0 at its upper left
    to 1, and the ray through it, origin (3,) mm and direction (3,)."""

    view: ViewCamera
    place: np.ndarray
    origin: np.ndarray
    direction: np.ndarray

    def find_first(self, clouds: Sequence[np.ndarray]) -> tuple[int, tuple[int, ...]] | None:
        """Return which of several clouds (..., 3) mm the ray meets first, and the index of the
        point; None where it misses all."""
        met = []
        for i, points in enumerate(clouds):
            index = nearest(points, self.origin, self.direction)
            if index is not None:
                met.append((float((points[index] - self.origin) @ self.direction), i, index))
        return min(met)[1:] if met else None


DragShape = Literal["", "rectangle", "lasso", "brush"]
_CURSORS: dict[DragShape, str] = {
    "rectangle": "crosshair",
    "lasso": "url(\"data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' width='24'"
    " height='24' fill='none' stroke='%23e1287d' stroke-width='2'%3E%3Cpath d='M2 22 5 14 16 3l5 5"
    "L10 19z' fill='white'/%3E%3C/svg%3E\") 2 22, crosshair",
    "brush": "none",  # the page draws a circle of its size
}


@dataclass(frozen=True, eq=False)
class Drag:
    """A shape that was drawn into the 3D view by dragging: the browser's view, and its places (n,
    2), from 0 at the upper left to 1: an outline, or the path of a brush. ``removes``: Shift was
    held."""

    view: ViewCamera
    path: np.ndarray
    removes: bool


class SceneLayer:
    """Draws objects into one layer of viser's scene; an object replaces that of the same name."""

    def __init__(
        self,
        api: viser.SceneApi,
        name: str,
        submit: Callable[[Callable[[], Any]], None],
        scene: "ViewerScene",
    ) -> None:
        self.name, self._api, self._submit, self._scene = name, api, submit, scene
        self._root: Any = api.add_frame(f"/{name}", show_axes=False)
        self._nodes: dict[str, Any] = {}
        self._titles: dict[str, str] = {}
        self._hidden: set[str] = set()

    def list_objects(self) -> dict[str, tuple[str, bool]]:
        """Return {name: title, whether it is shown} of the objects, none while the layer is
        hidden."""
        if not self._root.visible:
            return {}
        titles, hidden = self._titles, self._hidden
        return {name: (titles.get(name, name), name not in hidden) for name in self._nodes}

    def toggle(self, name: str) -> None:
        """Show a hidden object again, or hide it, also when it is drawn anew."""
        self._hidden ^= {name}
        if node := self._nodes.get(name):
            node.visible = name not in self._hidden
        self._scene.on_change()

    def resize_points(self, factor: float) -> None:
        """Draw the points of clouds larger by a factor."""
        for node in self._nodes.values():
            if isinstance(node, viser.PointCloudHandle):
                node.point_size *= factor

    def _add(self, name: str, node: Any, title: str = "") -> None:
        """Add an object's node, with a title for the list of objects."""
        self._nodes[name] = node
        self._titles[name] = title or name
        if name in self._hidden:
            node.visible = False
        self._scene.on_change()

    def hover_html(self, name: str) -> str:
        """Return what makes the page show, while the pointer moves, which point of an object a
        click would pick, as long as it is part of a visible panel."""
        return f'<i data-hover="{self._make_path(name)}"></i>'

    def drag_html(self, name: str, marks: Sequence[str]) -> str:
        """Return what makes the page drag marks over the points of an object."""
        paths = ";".join(map(self._make_path, marks))
        return f'<i data-drag="{self._make_path(name)}" data-marks="{paths}"></i>' if paths else ""

    def show(self, visible: bool) -> None:
        """Show or hide everything in the layer, now and when it is filled later."""
        self._root.visible = visible
        self._scene.on_change()

    def remove(self, *names: str) -> None:
        """Remove those of these objects that exist."""
        for name in names:
            if node := self._nodes.pop(name, None):
                node.remove()
                self._scene.on_change()

    def clear(self) -> None:
        """Remove all objects."""
        self.remove(*self._nodes)

    def device(
        self,
        name: str,
        K: np.ndarray,
        size: tuple[int, int],
        T_camera_device: np.ndarray,
        colour: Colour,
    ) -> None:
        """Draw a camera or projector as a frustum; K (3, 3) px, size (width, height) px, T (4, 4)
        mm."""
        width, height = size
        wxyz, position = _split_pose(T_camera_device)
        frustum = self._api.add_camera_frustum(
            self._make_path(name),
            fov=float(2 * np.arctan2(height / 2, K[1, 1])),
            # of the viewing angles, not of the pixels: a projector's may be far from square
            aspect=float((width / K[0, 0]) / (height / K[1, 1])),
            scale=self._scene.distance_mm / 10,
            thickness=2.0,
            thickness_units="screen",
            color=colour,
            wxyz=wxyz,
            position=position,
        )
        self._add(name, frustum)

    def board(
        self,
        name: str,
        T_camera_board: np.ndarray,
        outline: np.ndarray,
        colour: Colour,
        width_px: float,
        *,
        picture: np.ndarray | None = None,
        label: str = "",
    ) -> Any:
        """Draw a board's outline (4, 3) mm at T_camera_board (4, 4), with its picture (h, w, 3) and
        name, if given.

        The outline's corners go from the board's first feature along its first row and back around,
        as `Board.outline` gives them; the picture's rows run along the board's. Returns the handle
        of the picture, for clicks on it, None without one.
        """
        self.remove(name)  # with its label and picture
        sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
        self.lines(name, sides, colour, width_px, T=T_camera_board)
        path = self._make_path(name)
        if label:
            self._api.add_label(
                f"{path}/label", label, position=outline[0], anchor="bottom-left", depth_test=True
            )
        if picture is None:
            return None
        # rows of viser's images go up; the board's y goes down
        turned = tf.SO3.from_x_radians(np.pi).wxyz
        width, height = map(float, np.ptp(outline, axis=0)[:2])
        return self._api.add_image(
            f"{path}/picture", picture, width, height, wxyz=turned, position=outline.mean(axis=0)
        )

    def gizmo(
        self,
        name: str,
        T: np.ndarray,
        on_move: Callable[[np.ndarray], None] | None,
        on_end: Callable[[np.ndarray], None],
        *,
        scale_mm: float = 90.0,
    ) -> None:
        """Add a handle to move and turn an object, or move the one that is there; both callbacks
        get T (4, 4) in the camera's frame, `on_end` after what was submitted before."""
        if name in self._nodes:
            self._nodes[name].scale = scale_mm
            self.move(name, T)
            return
        wxyz, position = _split_pose(T)
        limits = ((-5000.0, 5000.0),) * 3
        self._nodes[name] = handle = self._api.add_transform_controls(
            self._make_path(name),
            scale=scale_mm,
            wxyz=wxyz,
            position=position,
            translation_limits=limits,  # type: ignore[arg-type]
            depth_test=False,
        )

        @handle.on_update
        def _(event: Any) -> None:
            """Call the callbacks with the handle's new pose."""
            rotation = tf.SO3(np.asarray(event.target.wxyz, float))
            T = tf.SE3.from_rotation_and_translation(rotation, event.target.position).as_matrix()
            if on_move is not None:
                on_move(T)
            if event.phase == "end":
                self._submit(partial(on_end, T))

    def move(self, name: str, T: np.ndarray) -> None:
        """Move an existing object to T (4, 4), without calling its callbacks."""
        if node := self._nodes.get(name):
            node.wxyz, node.position = _split_pose(T)

    def cloud(
        self,
        name: str,
        points: np.ndarray,
        colours: np.ndarray | Colour,
        limit: int = SHOWN_POINTS,
        title: str = "",
    ) -> int:
        """Draw a cloud (h, w, 3) or (n, 3) float32 mm, listed by its title; returns the number of
        points shown.

        Colours are grey levels of its shape, (..., 3) uint8, or one colour. NaN points are skipped.
        It is evenly thinned to about `limit` points, an organised cloud by rows and columns, so
        that no stripes appear.
        """
        shown, colours = thin(points, colours, limit)
        if len(shown):
            node = add_points(self._api, self._make_path(name), shown, colours)
            node.point_size *= self._scene.point_scale
            self._add(name, node, title)
        else:
            self.remove(name)
        return len(shown)

    def mesh(self, name: str, mesh: trimesh.Trimesh, title: str = "") -> None:
        """Draw a mesh, mm, with its colours or texture."""
        self._add(name, self._api.add_mesh_trimesh(self._make_path(name), mesh), title)

    def mark(
        self,
        name: str,
        point: np.ndarray,
        text: str,
        colour: Colour = (220, 40, 40),
        radius_mm: float = 1.5,
        on_drag: Callable[[np.ndarray], None] | None = None,
    ) -> None:
        """Draw a point (3,) mm as a ball with a label. ``on_drag`` is called with the point of the
        cloud (3,) mm that it was dragged to, where `drag_html` names it."""
        path, position = self._make_path(name), np.asarray(point, float)
        if on_drag is None:
            node: Any = self._api.add_frame(path, show_axes=False, position=position)
        else:  # the page drags it, over the cloud: viser's own handles stay hidden
            node = self._api.add_transform_controls(
                path,
                disable_axes=True,
                disable_sliders=True,
                disable_rotations=True,
                position=position,
            )

            @node.on_update
            def _(event: Any) -> None:
                """Call back with the end of a drag."""
                if event.phase == "end":
                    self._submit(partial(on_drag, np.array(event.target.position, float)))

        self._api.add_icosphere(f"{path}/ball", radius=radius_mm, color=colour)
        self._add(name, node, text)
        if text:
            self._api.add_label(f"{path}/words", text, anchor="bottom-left")

    def ball(self, name: str, centre: np.ndarray, radius_mm: float) -> None:
        """Draw a transparent ball around centre (3,) mm."""
        ball = self._api.add_icosphere(
            self._make_path(name),
            radius=radius_mm,
            color=GHOST,
            opacity=0.3,
            position=np.asarray(centre, float),
            cast_shadow=False,
            receive_shadow=False,
        )
        self._add(name, ball)

    def lines(
        self,
        name: str,
        segments: np.ndarray,
        colour: Colour,
        width_px: float = 3.0,
        label: tuple[str, np.ndarray] | None = None,
        T: np.ndarray | None = None,
    ) -> None:
        """Draw segments (n, 2, 3) mm (n may be 0) at T (4, 4), and a label, its text and place (3,)
        mm."""
        path = self._make_path(name)
        wxyz, position = _split_pose(np.eye(4) if T is None else T)
        frame = self._api.add_frame(path, show_axes=False, wxyz=wxyz, position=position)
        self._add(name, frame, label[0] if label else "")
        if len(segments):
            self._api.add_line_segments(
                f"{path}/lines",
                np.asarray(segments, np.float32),
                colour,
                thickness=width_px,
                thickness_units="screen",
            )
        if label is not None:
            text, place = label
            self._api.add_label(
                f"{path}/words", text, position=np.asarray(place, float), anchor="bottom-left"
            )

    def _make_path(self, name: str) -> str:
        """Return the path of an object's node, with slashes in its name replaced."""
        # names are entered by the operator: a slash would make another layer
        return f"/{self.name}/{name.replace('/', '_')}"


class ViewerScene:
    """Viser's scene: its floor, its layers, and the clicks and drags into it, which are passed on
    by `submit(do)`."""

    def __init__(
        self, server: viser.ViserServer, submit: Callable[[Callable[[], Any]], None]
    ) -> None:
        self._api, self._submit = server.scene, submit
        self.layers: list[SceneLayer] = []
        self.point_scale = 1.0
        self.on_change: Callable[[], None] = lambda: None
        """Called when objects were added, removed, shown or hidden."""
        self._drawn_shape = Text(server.gui)  # read by the page's script
        server.scene.set_up_direction("-y")
        self.set_distance(USUAL_DISTANCE_MM)

    def set_distance(self, mm: float) -> None:
        """Draw the floor, and devices from now on, for a rig of that working distance."""
        self.distance_mm = mm
        cell = 10 ** np.floor(np.log10(mm / 10))  # a round number of mm
        cell *= 5 if mm >= 50 * cell else 2 if mm >= 20 * cell else 1
        self._api.add_grid(
            "/floor",
            plane="xz",
            position=(0.0, 0.43 * mm, 0.83 * mm),
            infinite_grid=True,
            cell_size=cell,
            section_size=5 * cell,
            fade_distance=4.2 * mm,
            shadow_opacity=0.0,
        )

    def layer(self, name: str) -> SceneLayer:
        """Return a new layer."""
        self.layers.append(SceneLayer(self._api, name, self._submit, self))
        return self.layers[-1]

    def scale_points(self, scale: float) -> None:
        """Draw the points of all clouds, now and later, so many times as large as their
        distance."""
        for layer in self.layers:
            layer.resize_points(scale / self.point_scale)
        self.point_scale = scale

    def on_click(self, do: Callable[[Click], None] | None) -> None:
        """Call `do(click)` for each click into the scene; None: stop."""
        self._api.remove_click_callback()
        if do is not None:

            def handle(event: Any) -> None:
                """Call `do` with the place and ray of a click."""
                camera = event.client.camera
                origin, direction = map(np.array, (event.ray_origin, event.ray_direction))
                # where the ray of a wide view would begin: at a point near a ray, as a share of its
                # depth, as many pixels then lie between in a narrow view, from far away
                away = float(np.linalg.norm(np.subtract(camera.look_at, camera.position)))
                origin = origin + (1 - _relative_size(camera)) * away * direction
                click = Click(
                    read_view(event.client), np.array(event.screen_pos), origin, direction
                )
                self._submit(partial(do, click))

            self._api.on_click()(handle)

    def on_drag(
        self, shape: DragShape, do: Callable[[Drag], None] | None, size: float = 0.0
    ) -> None:
        """Call `do(drag)` for each shape that is dragged; dragging does not turn the view then,
        except with Ctrl. None: stop. ``size``: diameter of a brush, a share of the view's
        height."""
        self._api.remove_rect_select_callback()
        if do is None:
            self._drawn_shape.set("")
            return
        self._drawn_shape.set(
            f'<i data-draw="{shape}" data-size="{size:g}"></i>'
            f"<style>canvas[data-engine]{{cursor:{_CURSORS[shape]}!important}}</style>"
        )

        def handle(event: Any) -> None:
            """Call `do` with the shape."""
            path = np.array(event.screen_pos, float)
            if len(path) == 2:  # viser's own rectangle, where our script did not take the drag
                path = np.stack([path[[0, 1, 1, 0], 0], path[[0, 0, 1, 1], 1]], axis=1)
            drag = Drag(read_view(event.client), path, event.modifier == "shift")
            self._submit(partial(do, drag))

        listen_to_shapes(self._api, handle)


def add_points(
    api: viser.SceneApi, path: str, points: np.ndarray, colours: np.ndarray | Colour
) -> viser.PointCloudHandle:
    """Add points (n, 3) mm in colours (n, 3) to a scene, as large as their distances."""
    return api.add_point_cloud(
        path,
        points,
        colours,
        point_size=spacing(points),
        point_shape="square",
        point_shading="flat",
        precision="float32",
    )


def read_view(client: viser.ClientHandle) -> ViewCamera:
    """Return the view of a browser."""
    camera = client.camera
    rotation = tf.SO3(np.asarray(camera.wxyz, float)).as_matrix()
    return ViewCamera(
        np.asarray(camera.position, float), rotation, float(camera.fov), float(camera.aspect)
    )


def _split_pose(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (wxyz, position) of T (4, 4)."""
    return tf.SO3.from_matrix(T[:3, :3]).wxyz, T[:3, 3]


def thin(
    points: NDArray[np.float32], colours: NDArray[np.uint8] | Colour, limit: int
) -> tuple[NDArray[np.float32], Any]:
    """Thin a cloud to about `limit` points: (points (n, 3), their colours (n, 3) or the one
    colour).

    An organised cloud (h, w, 3) is thinned by rows and columns, (n, 3) by points; NaN points are
    skipped, grey levels become colours.
    """
    valid = np.asarray(np.isfinite(points).all(axis=-1))
    excess = max(np.count_nonzero(valid) / limit, 1.0)
    columns = int(np.ceil(np.sqrt(excess)))
    rows = int(np.ceil(excess / columns))
    steps = (rows, columns) if points.ndim == 3 else (rows * columns,)
    part = tuple(slice(None, None, step) for step in steps)
    valid = valid[part]
    if isinstance(colours, np.ndarray) and colours.shape[: len(steps)] == points.shape[:-1]:
        colours = colours[part][valid]
        if colours.ndim == 1:
            colours = np.repeat(colours[:, None], 3, axis=1)
        colours = np.ascontiguousarray(colours)
    return np.asarray(points[part][valid], np.float32), colours


def spacing(points: np.ndarray) -> float:
    """Estimate the distance, mm, between neighbours of an evenly sampled surface; of a few points,
    a share of their extent."""
    low, high = np.percentile(points, [1, 99], axis=0)
    _, middle, longest = np.sort(high - low)
    even = 1.3 * np.sqrt(middle * longest / len(points))
    return float(np.clip(even, 1e-4 * longest, 0.05 * longest)) or 1.0


class Viewpoints:
    """Moves the views of all browsers of a server; a new cloud is shown in every view."""

    def __init__(self, server: viser.ViserServer, scene: ViewerScene) -> None:
        self._server, self._scene = server, scene
        self._shown = ""
        server.initial_camera.fov = FIELD_OF_VIEW
        self.follow_distance()

    def follow_distance(self) -> None:
        """Show the rig at the scene's working distance, unless a cloud is shown, also to browsers
        that come later."""
        set_view(self._server.initial_camera, *_OVERVIEW * self._scene.distance_mm)
        if not self._shown:
            self._show_rig()

    def overview(self) -> None:
        """Show the whole rig again, if a cloud was shown."""
        if self._shown:
            self._shown = ""
            self._show_rig()

    def _show_rig(self) -> None:
        """Move all views to the rig."""
        for client in self._server.get_clients().values():
            _set_client_view(client, *_OVERVIEW * self._scene.distance_mm)

    def show(self, name: str, points: np.ndarray | None) -> None:
        """Move all views to the points (..., 3) mm, unless those of the same `name` are shown
        already."""
        if points is None or name == self._shown:
            return
        self._shown = name
        for client in self._server.get_clients().values():
            _look_at_points(client, points)


def _look_at_points(client: viser.ClientHandle, points: np.ndarray) -> None:
    """Move one browser's view to the points (..., 3) mm; nothing happens where none is valid."""
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])]
    if len(flat):
        size = _relative_size(client.camera)
        _set_client_view(client, *frame_points(flat, client.camera.aspect, size))


def frame_points(
    points: np.ndarray, aspect: float, relative_size: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return camera position and target (3,) mm that show valid points (n, 3) in a view of that
    width over height, whose field of view has a size relative to the perspective one."""
    low, high = np.percentile(thin_out(points, 20_000), [2, 98], axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    # the field of view is that of the height
    away = 1.45 * size * max(1.0, 0.85 / aspect) or 50.0  # of a single point
    return middle + _FROM * away / relative_size, middle


def _relative_size(camera: viser.CameraHandle) -> float:
    """Return how large a browser's field of view is relative to that of the perspective view; an
    orthographic view has a small one, from far away."""
    return float(np.tan(camera.fov / 2) / np.tan(FIELD_OF_VIEW / 2))


def set_view(
    camera: viser.CameraHandle | viser.InitialCameraConfig, position: np.ndarray, at: np.ndarray
) -> None:
    """Set a camera's position and target (3,) mm, and the depths that it shows."""
    camera.position = tuple(position)  # this also moves the target
    camera.look_at = tuple(at)
    away = float(np.linalg.norm(at - position))
    camera.near, camera.far = _NEAREST * away, _FARTHEST * away


def _set_client_view(client: viser.ClientHandle, position: np.ndarray, at: np.ndarray) -> None:
    """Set one browser's view, as `set_view` does."""
    with client.atomic():
        # viser sends no view that it takes for the browser's own, which a slow browser has already
        # been sent away from: one beside it is always sent
        client.camera.position = tuple(2 * position - at)
        set_view(client.camera, position, at)
