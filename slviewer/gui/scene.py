"""The 3D view: named layers in the camera's frame, in mm, x to the right and y down as in the
image.

A layer ("poses", "scan", …) belongs to a panel, which fills it, and shows or hides it as a whole.
An object replaces that of the same name. Every method may be called from any thread.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser.transforms as tf
from numpy.typing import NDArray

from slviewer.surface.selection import ViewCamera

Colour = tuple[int, int, int]

CAMERA: Colour = (40, 120, 200)
PROJECTOR: Colour = (235, 140, 30)
GHOST: Colour = (20, 160, 220)

SHOWN_POINTS = 150_000
"""Points of one cloud that are sent to a browser: software rendering still moves them smoothly."""
_FRUSTUM_MM = 60.0
_FLOOR_MM = 260.0


@dataclass(frozen=True)
class Stroke:
    """How lines are drawn."""

    colour: Colour
    width_px: float = 2.0


class ViewerScene:
    """Draws named layers of objects into viser's scene."""

    def __init__(self, api: viser.SceneApi) -> None:
        self._api = api
        self._layers: dict[str, Any] = {}
        self._nodes: dict[tuple[str, str], list[Any]] = {}
        self._pick: Callable[[Any], Any] | None = None
        self._rectangle: Callable[[Any], Any] | None = None
        api.set_up_direction("-y")
        api.add_grid(
            "/floor",
            plane="xz",
            position=(0.0, _FLOOR_MM, 500.0),
            infinite_grid=True,
            cell_size=50.0,
            section_size=250.0,
            cell_color=(225, 229, 233),
            section_color=(190, 196, 202),
            fade_distance=2500.0,
            shadow_opacity=0.0,
        )

    # layers

    def show(self, layer: str, visible: bool) -> None:
        """Show or hide a layer and everything in it, now and when it is filled later."""
        self._get_layer(layer).visible = visible

    def remove(self, layer: str, name: str) -> None:
        """Remove an object from a layer, if it exists."""
        for node in reversed(self._nodes.pop((layer, name), [])):  # what hangs below a node first
            node.remove()

    def clear(self, layer: str) -> None:
        """Remove all objects of a layer."""
        for name in self.names(layer):
            self.remove(layer, name)

    def names(self, layer: str) -> list[str]:
        """List the names of a layer's objects."""
        return [name for where, name in list(self._nodes) if where == layer]

    # objects

    def device(
        self,
        layer: str,
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
        handle = self._api.add_camera_frustum(
            self._make_path(layer, name),
            fov=float(2 * np.arctan2(height / 2, K[1, 1])),
            # of the viewing angles, not of the pixels: a projector's may be far from square
            aspect=float((width / K[0, 0]) / (height / K[1, 1])),
            scale=_FRUSTUM_MM,
            thickness=2.0,
            thickness_units="screen",
            color=colour,
            wxyz=wxyz,
            position=position,
        )
        self._store_nodes(layer, name, [handle])

    def board(
        self,
        layer: str,
        name: str,
        T_camera_board: np.ndarray,
        outline: np.ndarray,
        stroke: Stroke,
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
        path = self._make_path(layer, name)
        wxyz, position = _split_pose(T_camera_board)
        nodes: list[Any] = [
            self._api.add_frame(path, show_axes=False, wxyz=wxyz, position=position)
        ]
        sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1).astype(np.float32)
        nodes.append(
            self._api.add_line_segments(
                f"{path}/outline",
                sides,
                stroke.colour,
                thickness=stroke.width_px,
                thickness_units="screen",
            )
        )
        image = None
        if picture is not None:
            # rows of viser's images go up; the board's y goes down
            turned = tf.SO3.from_x_radians(np.pi).wxyz
            width, height = map(float, np.ptp(outline, axis=0)[:2])
            middle = outline.mean(axis=0)
            image = self._api.add_image(
                f"{path}/picture", picture, width, height, wxyz=turned, position=middle
            )
            nodes.append(image)
        if label:
            nodes.append(
                self._api.add_label(
                    f"{path}/label",
                    label,
                    position=outline[0],
                    anchor="bottom-left",
                    depth_test=True,
                )
            )
        self._store_nodes(layer, name, nodes)
        return image

    def gizmo(
        self,
        layer: str,
        name: str,
        T: np.ndarray,
        on_move: Callable[[np.ndarray], None],
        on_end: Callable[[np.ndarray], None] | None = None,
        *,
        scale_mm: float = 90.0,
    ) -> None:
        """Add a handle to move and turn an object; both callbacks get T (4, 4) in the camera's
        frame."""
        wxyz, position = _split_pose(T)
        limits = ((-5000.0, 5000.0),) * 3
        handle = self._api.add_transform_controls(
            self._make_path(layer, name),
            scale=scale_mm,
            wxyz=wxyz,
            position=position,
            translation_limits=limits,  # type: ignore[arg-type]
            depth_test=False,
        )

        @handle.on_update
        def _(event: Any) -> None:
            """Call the callbacks with the handle's new pose."""
            on_move(_read_pose(event.target))
            if on_end is not None and event.phase == "end":
                on_end(_read_pose(event.target))

        self._store_nodes(layer, name, [handle])

    def move(self, layer: str, name: str, T: np.ndarray) -> None:
        """Move an existing object to T (4, 4), without calling its callbacks."""
        nodes = self._nodes.get((layer, name))
        if nodes:
            nodes[0].wxyz, nodes[0].position = _split_pose(T)

    def cloud(
        self,
        layer: str,
        name: str,
        points: np.ndarray,
        colours: np.ndarray | Colour,
        limit: int = SHOWN_POINTS,
    ) -> int:
        """Draw a cloud (h, w, 3) or (n, 3) float32 mm; returns the number of points shown.

        Colours are grey levels of its shape, (..., 3) uint8, or one colour. NaN points are skipped.
        It is evenly thinned to about `limit` points, an organised cloud by rows and columns, so
        that no stripes appear.
        """
        shown, colours = thin(points, colours, limit)
        if not len(shown):
            self.remove(layer, name)
            return 0
        handle = self._api.add_point_cloud(
            self._make_path(layer, name),
            shown,
            colours,
            point_size=spacing(shown),
            point_shape="square",
            point_shading="flat",
            precision="float32",
        )
        self._store_nodes(layer, name, [handle])
        return len(shown)

    def mark(
        self,
        layer: str,
        name: str,
        point: np.ndarray,
        text: str,
        colour: Colour = (220, 40, 40),
        radius_mm: float = 1.5,
    ) -> None:
        """Draw a point (3,) mm as a ball with a label."""
        path = self._make_path(layer, name)
        ball = self._api.add_icosphere(
            path, radius=radius_mm, color=colour, position=np.asarray(point, float)
        )
        self._store_nodes(
            layer, name, [ball, self._api.add_label(f"{path}/words", text, anchor="bottom-left")]
        )

    def ball(
        self, layer: str, name: str, centre: np.ndarray, radius_mm: float, colour: Colour
    ) -> None:
        """Draw a transparent ball around centre (3,) mm."""
        handle = self._api.add_icosphere(
            self._make_path(layer, name),
            radius=radius_mm,
            color=colour,
            opacity=0.3,
            position=np.asarray(centre, float),
            cast_shadow=False,
            receive_shadow=False,
        )
        self._store_nodes(layer, name, [handle])

    def drawing(
        self,
        layer: str,
        name: str,
        segments: np.ndarray,
        colour: Colour,
        place: np.ndarray,
        text: str,
    ) -> None:
        """Draw segments (n, 2, 3) mm (n may be 0), and a label at place (3,) mm."""
        path = self._make_path(layer, name)
        nodes: list[Any] = [self._api.add_frame(path, show_axes=False)]
        if len(segments):
            nodes.append(
                self._api.add_line_segments(
                    f"{path}/lines",
                    np.asarray(segments, np.float32),
                    colour,
                    thickness=3.0,
                    thickness_units="screen",
                )
            )
        nodes.append(
            self._api.add_label(
                f"{path}/words", text, position=np.asarray(place, float), anchor="bottom-left"
            )
        )
        self._store_nodes(layer, name, nodes)

    def lines(self, layer: str, name: str, segments: np.ndarray, colour: Colour) -> None:
        """Draw segments (n, 2, 3) mm."""
        handle = self._api.add_line_segments(
            self._make_path(layer, name),
            np.asarray(segments, np.float32),
            colour,
            thickness=3.0,
            thickness_units="screen",
        )
        self._store_nodes(layer, name, [handle])

    def on_view_click(
        self, do: Callable[[ViewCamera, np.ndarray, np.ndarray], None] | None
    ) -> None:
        """Call `do(view, at, direction)` for each click in place of `on_pick`: the browser's view,
        the place in it, (2,) from 0 at its upper left to 1, and the ray (3,) through it; None:
        stop."""
        self.on_pick(None)
        if do is not None:

            def click(event: Any) -> None:
                """Call `do` with the place and view of a click."""
                do(
                    read_view(event.client),
                    np.array(event.screen_pos),
                    np.array(event.ray_direction),
                )

            self._pick = self._api.on_click()(click)

    def on_rectangle(self, do: Callable[[ViewCamera, np.ndarray, np.ndarray], None] | None) -> None:
        """Call `do(view, low, high)` for each rectangle that is dragged: the browser's view, and
        two corners, (2,) from 0 at its upper left to 1; dragging does not turn the view then. None:
        stop."""
        if self._rectangle is not None:
            self._api.remove_rect_select_callback(self._rectangle)
            self._rectangle = None
        if do is not None:

            def select(event: Any) -> None:
                """Call `do` with the corners of a rectangle."""
                do(read_view(event.client), np.array(event.screen_min), np.array(event.screen_max))

            self._rectangle = self._api.on_rect_select()(select)

    def on_pick(self, do: Callable[[np.ndarray, np.ndarray], None] | None) -> None:
        """Call `do(origin, direction)`, (3,) each in the camera's frame, for each click into the
        scene; None: stop."""
        if self._pick is not None:
            self._api.remove_click_callback(self._pick)
            self._pick = None
        if do is not None:

            def pick(event: Any) -> None:
                """Call `do` with the ray of a click."""
                do(np.array(event.ray_origin), np.array(event.ray_direction))

            self._pick = self._api.on_click()(pick)

    def _get_layer(self, layer: str) -> Any:
        """Return the node of a layer, created where it is missing."""
        if layer not in self._layers:
            self._layers[layer] = self._api.add_frame(f"/{layer}", show_axes=False)
        return self._layers[layer]

    def _make_path(self, layer: str, name: str) -> str:
        """Return the path of an object's node in its layer, with slashes in its name replaced."""
        self._get_layer(layer)
        # names are entered by the operator: a slash would make another layer
        return f"/{layer}/{name.replace('/', '_')}"

    def _store_nodes(self, layer: str, name: str, nodes: list[Any]) -> None:
        """Store the nodes of an object, its root first."""
        self._nodes[layer, name] = nodes


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


def _read_pose(handle: Any) -> np.ndarray:
    """Return T (4, 4) of a handle's position and orientation."""
    T = np.eye(4)
    T[:3, :3] = tf.SO3(np.asarray(handle.wxyz, float)).as_matrix()
    T[:3, 3] = handle.position
    return T


def thin(
    points: NDArray[np.float32], colours: NDArray[np.uint8] | Colour, limit: int
) -> tuple[NDArray[np.float32], Any]:
    """Thin a cloud to about `limit` points: (points (n, 3), their colours (n, 3) or the one
    colour).

    An organised cloud (h, w, 3) is thinned by rows and columns, (n, 3) by points; NaN points are
    skipped, grey levels become colours.
    """
    valid = np.asarray(np.isfinite(points).all(axis=-1))
    excess = np.count_nonzero(valid) / limit
    rows = columns = 1
    while rows * columns < excess:
        rows, columns = (rows, columns + 1) if rows == columns else (columns, columns)
    steps = (rows, columns) if points.ndim == 3 else (rows * columns,)
    part = tuple(slice(None, None, step) for step in steps)
    valid = valid[part]
    if isinstance(colours, np.ndarray) and colours.shape[: len(steps)] == points.shape[:-1]:
        colours = colours[part][valid]
        colours = (
            np.repeat(colours[:, None], 3, axis=1)
            if colours.ndim == 1
            else np.ascontiguousarray(colours)
        )
    return np.asarray(points[part][valid], np.float32), colours


def spacing(points: np.ndarray) -> float:
    """Estimate the distance, mm, between neighbours of an evenly sampled surface."""
    low, high = np.percentile(points, [1, 99], axis=0)
    sides = np.sort(high - low)
    return float(np.clip(1.3 * np.sqrt(max(sides[1] * sides[2], 1e-6) / len(points)), 0.05, 20.0))
