"""Faults of rigs and scenes: motion, bending, wrong settings, and further objects in the view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe.sequence import Axis
from slviewer.simulation.boards import BoardScene, BoardShape, Pose, blank_board
from slviewer.simulation.plans import pose_at, rotation
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import AlteredScene, Points, Rays, Scene, Spheres, Surface
from slviewer.simulation.second_camera import move_scene, pose_of

Pattern = tuple[Axis | None, np.ndarray]
"""What `fringe.patterns.profile` gives: the axis and the grey levels along it."""
CleanScene = BoardScene | Spheres
"""Scenes that faults act on."""

_FINGERS_MM = (-24.0, -8.0, 8.0, 24.0)
_FINGER_RADIUS_MM = 11.0
_SPECK_CELL_MM = 2.0
_DIRT = 0.35
"""Share of its light that a dirty cell reflects."""
_THICKNESS_MM = 2.0  # more than any board's bow


@dataclass(frozen=True, eq=False)
class SceneGroup:
    """Several scenes in one view: each ray meets the nearest surface, and each scene shades the
    others' points."""

    scenes: Sequence[Scene]

    def trace(self, rays: Rays) -> Surface:
        """Return the nearest surface of all scenes along each ray."""
        nearest, *others = (scene.trace(rays) for scene in self.scenes)
        for surface in others:
            z = surface.points[..., 2]
            with np.errstate(invalid="ignore"):
                is_nearer = np.isfinite(z) & ~(nearest.points[..., 2] <= z)
            nearest = nearest.overlay(surface, is_nearer)
        return nearest

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """Whether any of the scenes blocks the way from a point to the source."""
        blocked = np.zeros(len(points), bool)
        for scene in self.scenes:
            blocked |= scene.occluded(points, source)
            if isinstance(scene, BoardScene):
                blocked |= _is_behind_plate(scene, points, source)
        return blocked


@dataclass(frozen=True, eq=False)
class DirtyBoard(AlteredScene):
    """A board with specks of dust and scratches, fixed to it: of the cells of its surface, `share`
    reflect only a third of the light."""

    scene: BoardScene
    share: float

    def trace(self, rays: Rays) -> Surface:
        """The board's surface, with reduced albedo at dirt."""
        surface = self.scene.trace(rays)
        hit = surface.albedo > 0
        pose = self.scene.pose
        xy = ((surface.points[hit] - pose.t) @ pose.R)[:, :2]
        cells = np.floor((xy - np.array(self.scene.corner)) / _SPECK_CELL_MM).astype(int)
        shape = np.ceil(np.array(self.scene.plate) / _SPECK_CELL_MM).astype(int) + 1
        rng = np.random.default_rng([0, 0xD1])
        dirty = rng.random(shape) < self.share
        for _ in range(round(40 * self.share * 10)):  # scratches: lines of cells
            start, way = rng.uniform(0, 1, 2) * shape, rng.normal(size=2)
            line = start + np.arange(rng.integers(10, 40))[:, None] * way / np.linalg.norm(way)
            dirty[tuple(np.clip(line.astype(int), 0, shape - 1).T)] = True
        albedo = surface.albedo.copy()
        albedo[hit] *= np.where(dirty[tuple(np.clip(cells, 0, shape - 1).T)], _DIRT, 1.0)
        return replace(surface, albedo=albedo)


@dataclass(frozen=True, eq=False)
class MirrorTable(AlteredScene):
    """A polished table at y = `offset_mm` below an object: rays that miss the object and meet the
    table see the object mirrored.

    `reflectivity` 0 ... 1. Points and normals of mirrored pixels are those of the real surface,
    which the projector lights; `is_direct` says which pixels see it directly.
    """

    scene: CleanScene
    offset_mm: float
    reflectivity: float

    @property
    def reflection(self) -> tuple[np.ndarray, np.ndarray]:
        """M (3, 3) and shift (3,): X' = M X + shift is X mirrored in the table."""
        return np.diag([1.0, -1.0, 1.0]), np.array([0.0, 2 * self.offset_mm, 0.0])

    def trace(self, rays: Rays) -> Surface:
        """Trace rays to the object, and below it to its mirror image."""
        surface, pose, (M, shift) = self.scene.trace(rays), pose_of(self.scene), self.reflection
        image = move_scene(self.scene, Pose(M @ pose.R, M @ pose.t + shift)).trace(rays)
        # The table lies between camera and mirror image, so that the image's points are behind the
        # mirror.
        with np.errstate(invalid="ignore"):
            behind = image.points[..., 1] > self.offset_mm
        visible = ~np.isfinite(surface.points[..., 2]) & behind
        albedo = np.float32(self.reflectivity) * image.albedo
        return surface.overlay(
            Surface(image.points @ M.T + shift, image.normals @ M.T, albedo), visible
        )

    def is_direct(self, rays: Rays) -> np.ndarray:
        """Return the pixels (h, w) bool that see the object itself, and not its mirror image."""
        return np.isfinite(self.scene.trace(rays).points[..., 2])

    def second_projector(self, rig: SimulatedRig) -> SimulatedRig:
        """The rig with the projector's mirror image in the table: its light is `reflectivity` as
        strong."""
        M, shift = self.reflection
        light = replace(rig.light, ambient=0.0)
        return replace(rig, R=rig.R @ M, t=rig.R @ shift + rig.t, light=light)


def with_hand(scene: CleanScene, reach_mm: float, number: int = 0) -> Scene:
    """The scene with a hand that reaches `reach_mm` over it: over a board's right edge, or over a
    sphere's front."""
    lengths = np.arange(0.0, reach_mm + 20.0, 12.0)
    offsets = np.array([(x, y, -_FINGER_RADIUS_MM - 3.0) for x in lengths for y in _FINGERS_MM])
    if isinstance(scene, BoardScene):
        (x, y), (width, height) = scene.corner, scene.plate
        fingers = scene.pose.to_camera(
            offsets + np.array([x + width - reach_mm, y + 0.5 * height, 0.0])
        )
    else:
        edge = np.array([scene.radius_mm - reach_mm, 0.0, -scene.radius_mm])
        fingers = offsets + scene.centres[0] + edge
    return SceneGroup((scene, Spheres(fingers, _FINGER_RADIUS_MM, albedo=0.55)))


def _is_behind_plate(board: BoardScene, points: Points, source: Points) -> np.ndarray:
    """(n,) bool: the way from `points` (n, 3) to `source` (3,) crosses the plate; points on it are
    not behind it."""
    start, end = (points - board.pose.t) @ board.pose.R, (source - board.pose.t) @ board.pose.R
    with np.errstate(divide="ignore", invalid="ignore"):
        share = start[:, 2] / (start[:, 2] - end[2])
    crossing = (start + share[:, None] * (end - start))[:, :2] - np.array(board.corner)
    inside = ((crossing > 0) & (crossing < np.array(board.plate))).all(1)
    return np.asarray(inside & (share > 0) & (share < 1) & (np.abs(start[:, 2]) > _THICKNESS_MM))


def set_gamma(rig: SimulatedRig, gamma: float, number: int) -> SimulatedRig:
    """Return the rig with a projector of this gamma."""
    return replace(rig, light=replace(rig.light, gamma=gamma))


def dim_projector(rig: SimulatedRig, amplitude: float, number: int) -> SimulatedRig:
    """Return the rig with fringes of this amplitude in grey levels on white; the camera's exposure
    is unchanged."""
    white = 2 * amplitude / (1 - rig.light.black)
    peak = rig.sensor.dark_level + white * (1 + rig.light.ambient)
    return replace(rig, sensor=replace(rig.sensor, peak_level=peak))


def overexpose(rig: SimulatedRig, times: float, number: int) -> SimulatedRig:
    """The rig overexposed: white light reaches ``times`` the camera's full scale."""
    sensor = rig.sensor
    return replace(rig, sensor=replace(sensor, peak_level=sensor.dark_level + times * 255))


def refocus_camera(rig: SimulatedRig, share: float, number: int) -> SimulatedRig:
    """Return the rig with the camera refocused for each pose: its focal length changes by up to
    ``share``."""
    factor = 1 + share * float(np.random.default_rng([rig.seed, number, 0xFB]).uniform(-1, 1))
    fx, fy = rig.camera.focal_px
    return replace(rig, camera=replace(rig.camera, focal_px=(fx * factor, fy * factor)))


def drift_projector(rig: SimulatedRig, mrad: float, number: int) -> SimulatedRig:
    """The rig with its projector turned a little in each capture, by ``mrad`` over eight, as a
    warming mount does."""
    return knock_projector(rig, mrad * min(number, 8) / 8, number)


def knock_projector(rig: SimulatedRig, mrad: float, number: int) -> SimulatedRig:
    """The rig with its projector turned by ``mrad`` after the calibration, as by a knock."""
    turn = rotation(1e-3 * mrad * np.array([0.6, 0.7, 0.4]))
    return replace(rig, R=turn @ rig.R, t=turn @ rig.t)


def flex_board(scene: CleanScene, bow_mm: float, number: int) -> Scene:
    """Return the scene with a board bent anew for each ``number``; scenes without a board are
    unchanged."""
    if not isinstance(scene, BoardScene):
        return scene
    bow = bow_mm * np.random.default_rng([number, 0xF1]).uniform(-1, 1, 3)
    return replace(scene, shape=BoardShape(*bow.tolist()))


def moving_scenes(scenes: Sequence[CleanScene], by_mm: float) -> list[Scene]:
    """Return eleven copies of the one scene, which moves by `by_mm` mm and turns slightly about its
    own origin, as if held by hand."""
    (scene,) = scenes
    pose, way, turn = pose_of(scene), np.array([0.7, 0.5, 0.5]), np.array([0.3, -0.5, 0.2]) / 100
    return [
        move_scene(scene, Pose(rotation(moved * turn) @ pose.R, pose.t + moved * way))
        for moved in np.linspace(0, by_mm, 11)
    ]


def dirty_scene(scene: CleanScene, share: float, number: int) -> Scene:
    """The scene with dust and scratches on this share of its board; scenes without a board are
    unchanged."""
    return DirtyBoard(scene, share) if isinstance(scene, BoardScene) else scene


def put_on_table(scene: CleanScene, reflectivity: float, number: int) -> Scene:
    """The scene on a polished table 3 mm below the object, which mirrors it."""
    if isinstance(scene, BoardScene):
        lowest = max(scene.place(a, b)[1] for a in (0, 1) for b in (0, 1))
    else:
        lowest = scene.centres[:, 1].max() + scene.radius_mm
    return MirrorTable(scene, float(lowest) + 3.0, reflectivity)


def add_second_board(scene: CleanScene, size_mm: float, number: int) -> Scene:
    """The scene with another white plate of this width 70 mm behind the object, to the left of
    it."""
    middle = scene.place(0.5, 0.5) if isinstance(scene, BoardScene) else scene.centres[0]
    place = middle + np.array([-0.18 * middle[2], -0.09 * middle[2], 70.0])
    pose = pose_at((5.0, -12.0, 8.0), place)
    return SceneGroup((scene, blank_board(pose, (size_mm, 0.8 * size_mm))))


def reverse_pattern(pattern: Pattern, level: float) -> Pattern:
    """Reverse the pattern's columns (level 0), rows (1) or both (2)."""
    axis, levels = pattern
    hit = (axis == "x" and level != 1) or (axis == "y" and level != 0)
    return (axis, levels[::-1].copy()) if hit else pattern
