"""An object to be seen all round, and the turntable that turns it before the rig."""

from functools import lru_cache

import numpy as np

from slviewer.geometry.vectors import unit_vectors
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import rotation

STEPS = 12
AXIS_POINT = np.array([3.0, 6.0, 600.0])
"""On the table's axis, mm in the camera's frame."""
LOOKING_DOWN_DEG = 30.0
_DOWN = np.radians(LOOKING_DOWN_DEG)
AXIS = unit_vectors(np.array([0.02, -np.cos(_DOWN), -np.sin(_DOWN)]))
"""Up from the table, in the camera's frame; the table turns the right-handed way about it."""
_AXIS_OFFSET_MM = np.array([6.0, -4.0, 0.0])  # the object does not stand in the table's middle

_RADIUS_MM, _FOOT_MM = 56.0, 27.0
_TABLE_MM = 130.0
"""From the object to the edges of a square table."""
_SUBDIVISIONS = 7  # edges of about half a millimetre


def turning(steps: int = STEPS) -> dict[str, MeshScene]:
    """The worn stone in equal steps of the table, turn_01, turn_02 ...: the camera sees all of it
    but its flat foot."""
    vertices, triangles = stone()
    side = unit_vectors(np.cross(AXIS, [0.0, 0.0, 1.0]))
    upright = np.stack([side, np.cross(AXIS, side), AXIS], axis=1)
    first = Pose(upright, AXIS_POINT + upright @ _AXIS_OFFSET_MM)
    return {
        f"turn_{k + 1:02d}": MeshScene(vertices, triangles, turn_pose(first, 360.0 * k / steps))
        for k in range(steps)
    }


def turn_pose(pose: Pose, deg: float) -> Pose:
    """Return a pose on the table after it was turned by an angle."""
    R = rotation(np.radians(deg) * AXIS)
    return Pose(R @ pose.R, AXIS_POINT + R @ (pose.t - AXIS_POINT))


def stone_on_table() -> MeshScene:
    """The stone as it is first on the turntable, and a square table below its foot that the camera
    sees around it."""
    scene = turning(1)["turn_01"]
    a, n = _TABLE_MM, len(scene.vertices)
    corners = np.array([(x, y, -_FOOT_MM) for x, y in ((-a, -a), (a, -a), (a, a), (-a, a))])
    table = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    return MeshScene(
        np.concatenate([scene.vertices, corners]),
        np.concatenate([scene.triangles, n + table]),
        scene.pose,
    )


@lru_cache(1)
def stone() -> tuple[np.ndarray, np.ndarray]:
    """A worn stone on a flat foot, watertight: vertices (n, 3) float64 mm with z up, triangles (m,
    3) int32 that are counter-clockwise seen from outside. About 120 mm wide, 90 mm high, without
    symmetry."""
    import trimesh.creation  # takes 0.3 s

    ball = trimesh.creation.icosphere(_SUBDIVISIONS)
    directions, triangles = np.array(ball.vertices), np.array(ball.faces, np.int32)
    rng = np.random.default_rng(12)
    radius = np.full(len(directions), _RADIUS_MM)
    for _ in range(6):  # the lopsided whole
        wave = rng.normal(size=3) * rng.uniform(0.8, 2.0)
        radius += 1.2 * np.cos(directions @ wave + rng.uniform(0, 2 * np.pi))
    middles = unit_vectors(rng.normal(size=(90, 3)))
    widths = np.radians(rng.uniform(5.0, 12.0, len(middles)))
    heights = (
        rng.uniform(0.15, 0.35, len(middles))
        * widths
        * _RADIUS_MM
        * rng.choice([-1.0, 1.0], len(middles))
    )
    for middle, width, height in zip(middles, widths, heights, strict=True):
        radius += height * np.exp((directions @ middle - 1.0) / width**2)
    down = np.maximum(-directions[:, 2], 1e-9)
    radius = np.minimum(radius, _FOOT_MM / down)
    return directions * radius[:, None], triangles
