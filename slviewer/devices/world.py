"""The scene of the simulated rig, and the light that its projector throws on it."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.simulation.boards import (
    FLAT,
    BoardScene,
    BoardShape,
    Pose,
    blank_board,
    printed_board,
)
from slviewer.simulation.concave import CONCAVE
from slviewer.simulation.decals import marked_plate
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene, sphere
from slviewer.simulation.second_camera import move_scene, pose_of, second_camera
from slviewer.simulation.turning import stone_on_table, turn_pose, turning
from slviewer.target.board import Board

Thing = Literal[
    "board",
    "plane",
    "sphere",
    "object",
    "stone",
    "stone on a table",
    "marked",
    "groove",
    "bowl",
    "wax",
]
"""The printed target, the blank plate, the Letter's sphere, the demo object, the stone of the
turntable, alone and on a table, a plate with coded markers, and three surfaces that light
themselves."""

_INITIAL_DEPTHS_MM = {"sphere": 690.0, **dict.fromkeys(CONCAVE, 640.0)}
_USUAL_DEPTH_MM = 600.0
"""At which things stand at first."""
SETTLED_S = 0.3
"""A thing that has not been moved for so long is rendered in full by a preview too."""
_DRAFT_SCALE = (
    0.25  # of a preview while things move: the geometry of 400x300 rays instead of 1600x1200
)


@dataclass(frozen=True, eq=False)
class Shown:
    """What the projector shows: pattern as `fringe.patterns.profile` returns it, or no axis and an
    image (h, w, 3) RGB, the lamp's relative light, the noise's seed.

    Under even light, `preview`, a moving scene may be drawn as a draft.
    """

    pattern: tuple[Axis | None, np.ndarray]
    lamp: float
    seed: tuple[int, ...]
    preview: bool


class SimulatedWorld:
    """The scene of a simulated rig, shared by its camera and projector. Things may be moved from
    any thread.

    One thing is in view at a time; the others keep their poses for later. A pose is T_camera_thing:
    the board's origin is its first feature, the plane's its middle, the sphere's its centre, the
    object's its own.
    """

    def __init__(
        self,
        rig: SimulatedRig,
        board: Board | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.rig = rig
        self._clock = clock
        self.shown = Shown(
            (None, np.zeros(rig.projector.size[0], np.uint8)), 1.0, (rig.seed,), True
        )
        self._draft_rig = replace(
            rig, camera=replace(rig.camera, scale=min(rig.camera.scale, _DRAFT_SCALE))
        )
        self._lock = threading.RLock()
        self._things: dict[Thing, Scene] = {
            "plane": blank_board(_make_initial_pose("plane")),
            "sphere": sphere((0.0, 0.0, _INITIAL_DEPTHS_MM["sphere"])),
        }
        self._standing: Thing = "board"
        self._table_deg = 0.0
        self._moved = self._clock()
        self._renderers: dict[bool, Renderer] = {}
        self.print_board(board or Board.parse("circles:21x16:9"))

    @property
    def standing(self) -> Thing:
        """The kind of thing in view."""
        return self._standing

    @property
    def scene(self) -> Scene:
        """The thing in view as a scene for a `Renderer`, whose truth is this world's truth."""
        with self._lock:
            return self._things[self._standing]

    @property
    def board(self) -> Board:
        """The printed board geometry."""
        scene = self._things["board"]
        assert isinstance(scene, BoardScene) and scene.board is not None
        return scene.board

    @property
    def shape(self) -> BoardShape:
        """The board's deviation from flat, and of its features from their nominal positions."""
        scene = self._things["board"]
        assert isinstance(scene, BoardScene)
        return scene.shape

    @property
    def pose(self) -> Pose:
        """T_camera_thing of the thing in view; identity rotation for a sphere."""
        return pose_of(self.scene)

    @property
    def turn_deg(self) -> float:
        """Rotation of the thing in view about the vertical, degrees."""
        R = self.pose.R
        return float(np.degrees(np.arctan2(R[0, 2], R[2, 2])))

    def print_board(self, board: Board, shape: BoardShape = FLAT) -> None:
        """Replace the board by another, centred on the camera's axis; the thing in view stays the
        same.

        Raises InputError for ChArUco boards, which the simulation does not print.
        """
        middle = (board.points.min(0) + board.points.max(0)) / 2
        pose = Pose(np.eye(3), np.array([0, 0, _USUAL_DEPTH_MM]) - middle)
        self._store_scene("board", printed_board(board, pose, shape, self.rig.seed))

    def place(self, thing: Thing, pose: Pose | None = None) -> None:
        """Place `thing` in view at T_camera_thing, in place of the current one; None: at its last
        pose."""
        if thing not in get_args(Thing):
            raise InputError(
                f"the simulated world has no {thing!r}", f"use one of {', '.join(get_args(Thing))}"
            )
        if pose is not None and not (np.isfinite(pose.R).all() and np.isfinite(pose.t).all()):
            raise InputError(
                "a pose with numbers that are not finite places nothing", "give a turn and mm"
            )
        with self._lock:
            scene = self._things[thing] if thing in self._things else _make_scene(thing)
            if pose is not None:
                scene = move_scene(scene, pose)
            self._standing = thing
            self._store_scene(thing, scene)

    def move(self, distance_mm: float | None = None, turn_deg: float | None = None) -> None:
        """Move the thing in view along its camera ray to depth `distance_mm`, and turn it about the
        vertical.

        `turn_deg` is the new rotation; None: unchanged.
        """
        with self._lock:
            pose = self.pose
            t = pose.t if distance_mm is None else pose.t * distance_mm / pose.t[2]
            more = 0.0 if turn_deg is None else np.radians(turn_deg - self.turn_deg)
            R = np.array(
                [[np.cos(more), 0, np.sin(more)], [0, 1, 0], [-np.sin(more), 0, np.cos(more)]]
            )
            self.place(self._standing, Pose(R @ pose.R, t))

    @property
    def table_deg(self) -> float:
        """The angle that the turntable stands at."""
        return self._table_deg

    def turn_table(self, deg: float) -> None:
        """Turn the table to an angle, and with it the thing in view, about the axis of
        `simulation.turning`."""
        with self._lock:
            self._table_deg, change_deg = deg, deg - self._table_deg
            self.place(self._standing, turn_pose(self.pose, change_deg))

    def renderer(self, preview: bool) -> Renderer:
        """Return a renderer of the scene; for previews soon after a motion, one of a smaller camera
        scale."""
        with self._lock:
            draft = preview and self._clock() - self._moved < SETTLED_S
            draft = draft and self._draft_rig.camera.scale < self.rig.camera.scale
            if draft not in self._renderers:
                self._renderers[draft] = Renderer(
                    self._draft_rig if draft else self.rig, self._things[self._standing]
                )
            return self._renderers[draft]

    def from_second_camera(self) -> "SecondView":
        """Return what a second camera sees of this world."""
        return SecondView(self)

    def _store_scene(self, thing: Thing, scene: Scene) -> None:
        """Store a thing's scene; if it is in view, note that it moved and drop its renderers."""
        with self._lock:
            self._things[thing] = scene
            if thing == self._standing:
                self._moved = self._clock()
                self._renderers.clear()


class SecondView:
    """A simulated world as its second camera sees it."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world, self._camera = world, second_camera(world.rig)
        self.rig = self._camera.rig
        self._rendered: tuple[Scene | None, Renderer | None] = (None, None)

    @property
    def shown(self) -> Shown:
        """What the projector shows; its seed is this camera's own."""
        shown = self._world.shown
        return replace(shown, seed=(*shown.seed, 2))

    def renderer(self, preview: bool) -> Renderer:
        """Return a renderer of the scene, in full for a preview too."""
        scene, (rendered, renderer) = self._world.scene, self._rendered
        if renderer is None or rendered is not scene:
            renderer = Renderer(self.rig, self._camera.view(scene))
            self._rendered = scene, renderer
        return renderer


def _make_scene(thing: Thing) -> Scene:
    """Return the scene of a thing that is made when it is first placed, at its initial pose."""
    if thing == "marked":
        return marked_plate(_make_initial_pose(thing))
    if thing in CONCAVE:
        return CONCAVE[thing](_make_initial_pose(thing))
    if thing == "object":
        return demo_object(_make_initial_pose(thing))
    return stone_on_table() if thing == "stone on a table" else turning(1)["turn_01"]


def _make_initial_pose(thing: Thing) -> Pose:
    """Return the pose at which a thing is first placed: in front of the camera at its default
    depth."""
    return Pose(np.eye(3), np.array([0.0, 0.0, _INITIAL_DEPTHS_MM.get(thing, _USUAL_DEPTH_MM)]))
