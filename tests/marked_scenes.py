"""A sphere and a cylinder with coded markers on their fronts, and a plain cylinder."""

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.simulation.boards import Pose
from slviewer.simulation.decals import Decal, MarkedScene
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.scenes import sphere


def marked_sphere(pose: Pose) -> MarkedScene:
    """The Letter's sphere with six markers on its front."""
    turns = ((-25, -15), (0, -22), (25, -15), (-20, 20), (5, 22), (25, 18))
    radius = 98.0
    decals = [_stick_on_front(i, 16.0, turn, radius) for i, turn in enumerate(turns)]
    return MarkedScene(sphere(tuple(pose.t.tolist()), 2 * radius), pose, decals)


def marked_cylinder(pose: Pose) -> MarkedScene:
    """An open cylinder about the y axis with six markers on its front."""
    radius = 40.0
    places = ((-30, -40.0), (0, -45.0), (30, -40.0), (-25, 35.0), (5, 40.0), (30, 35.0))
    decals = [
        _stick_on_front(i, 14.0, (around, 0), radius, y) for i, (around, y) in enumerate(places)
    ]
    return MarkedScene(MeshScene(*cylinder_mesh(radius, 150.0), pose), pose, decals)


def _stick_on_front(
    number: int, side_mm: float, turn_deg: tuple[float, float], radius: float, y: float = 0.0
) -> Decal:
    """The marker on a front at ``radius`` from the y axis, turned about y and then x, and moved
    along y."""
    R = Rotation.from_euler("yx", turn_deg, degrees=True).as_matrix()
    place = R @ np.array([0.0, 0.0, -radius]) + np.array([0.0, y, 0.0])
    return Decal(number, side_mm, Pose(R, place))


def cylinder_mesh(radius: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """An open cylinder along y with facets smaller than the noise: vertices (n, 3) mm, triangles
    (m, 3)."""
    around = 720
    angles = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angles), np.zeros(around), radius * np.sin(angles)], axis=1)
    vertices = np.concatenate([ring + np.array([0, y, 0]) for y in (-length / 2, length / 2)])
    i, j = np.arange(around), np.roll(np.arange(around), -1)
    halves = [np.stack([i, i + around, j], 1), np.stack([j, i + around, j + around], 1)]
    return vertices, np.concatenate(halves)
