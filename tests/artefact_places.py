"""Where an artefact is held in an acceptance test, for one rig: so that a test covers what the rig
measures.

The volume is what camera and projector both see, from in front of the calibrated depths (R1) to
behind them (R3).
"""

from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rig import StereoRig

IN_FRONT, BEHIND = 0.15, 0.25
"""How far R1's and R3's positions lie outside the calibrated depths, as shares of their span."""
EDGE = 0.02
"""Share of an image's width that stays free at its edges."""
STEEPEST = np.radians(60.0)
"""A bar that does not fit is turned towards the depth, no further than this."""
_Place = tuple[str, tuple[float, float, float], tuple[float, float], float]
_BAR: tuple[_Place, ...] = (
    # words; direction; where its middle stands, from -1 to 1 of the free room; depth, 0 nearest to
    # 1 farthest in R2
    ("across, in the middle", (1.0, 0.0, 0.0), (0.0, 0.0), 0.5),
    ("upright, in the middle", (0.0, 1.0, 0.0), (0.0, 0.0), 0.5),
    ("diagonal, rising to the right, upper left", (1.0, -0.7, 0.0), (-0.8, -0.8), 0.7),
    ("diagonal, falling to the right, lower right", (1.0, 0.7, 0.0), (0.8, 0.8), 0.3),
    ("through the volume, from near to far", (1.0, -0.7, 1.3), (0.0, 0.0), 0.5),
    ("in front of the calibrated depths (R1)", (1.0, 0.5, 0.4), (0.0, 0.0), -IN_FRONT),
    ("behind the calibrated depths (R3)", (1.0, -0.5, -0.4), (0.4, -0.4), 1.0 + BEHIND),
)
_SPHERE: tuple[_Place, ...] = (
    ("in the middle", (1.0, 0.0, 0.0), (0.0, 0.0), 0.5),
    ("upper left, near", (1.0, 0.0, 0.0), (-0.9, -0.9), 0.1),
    ("lower right, far", (1.0, 0.0, 0.0), (0.9, 0.9), 0.9),
    ("upper right, far", (1.0, 0.0, 0.0), (0.9, -0.9), 0.9),
    ("lower left, near", (1.0, 0.0, 0.0), (-0.9, 0.9), 0.1),
    ("in front of the calibrated depths (R1)", (1.0, 0.0, 0.0), (0.0, 0.0), -IN_FRONT),
    ("behind the calibrated depths (R3)", (1.0, 0.0, 0.0), (0.4, -0.4), 1.0 + BEHIND),
)
_PLANE = (
    # words; turns about x and y in degrees; depth
    ("facing the camera, in the middle", (0.0, 0.0), 0.5),
    ("turned to the left", (0.0, 25.0), 0.4),
    ("turned to the right", (0.0, -25.0), 0.6),
    ("tilted back, diagonally", (20.0, 15.0), 0.5),
    ("in front of the calibrated depths (R1)", (8.0, -8.0), -IN_FRONT),
    ("behind the calibrated depths (R3)", (-8.0, 8.0), 1.0 + BEHIND),
)


@dataclass(frozen=True, eq=False)
class Place:
    """Where to hold an artefact: ``T_camera_artefact`` (4, 4), mm.

    A bar lies along its x axis about its middle, a plane is its xy plane with z away from the
    camera.
    """

    words: str
    T_camera_artefact: np.ndarray


def bar_places(
    rig: StereoRig, depth_range_mm: tuple[float, float], spacing_mm: float, diameter_mm: float
) -> list[Place]:
    """Seven places of a ball bar. Raises InputError where it is too long for what the rig sees."""
    return [_placed(rig, depth_range_mm, place, spacing_mm, diameter_mm) for place in _BAR]


def sphere_places(
    rig: StereoRig, depth_range_mm: tuple[float, float], diameter_mm: float
) -> list[Place]:
    """Seven places of a single sphere. Raises InputError where it is too large for what the rig
    sees."""
    return [_placed(rig, depth_range_mm, place, 0.0, diameter_mm) for place in _SPHERE]


def plane_places(rig: StereoRig, depth_range_mm: tuple[float, float]) -> list[Place]:
    """Six places of a plane, as large as the rig sees or smaller."""
    near, far = depth_range_mm
    places = []
    for words, (about_x, about_y), depth in _PLANE:
        z = near + depth * (far - near)
        middle = _room(rig, z)[0]
        places.append(
            Place(
                words, _pose(_turn(np.radians(about_x), np.radians(about_y)), np.append(middle, z))
            )
        )
    return places


def _placed(
    rig: StereoRig, depth_range: tuple[float, float], place: _Place, spacing: float, diameter: float
) -> Place:
    """A bar as its place says, moved to the middle and then turned towards the depth as far as it
    must to be seen."""
    words, direction, offset, depth = place
    near, far = depth_range
    z = near + depth * (far - near)
    middle, free = _room(rig, z)
    along = np.array(direction) / np.linalg.norm(direction)
    flat = np.array([along[0], along[1], 0.0]) / np.hypot(along[0], along[1])
    first = float(np.arctan2(along[2], np.hypot(along[0], along[1])))
    steeper = np.linspace(first, np.copysign(STEEPEST, first), 8)
    for angle in steeper:
        axis = np.cos(angle) * flat + np.array([0.0, 0.0, np.sin(angle)])
        for share in np.linspace(1.0, 0.0, 21):
            centre = np.append(middle + share * np.array(offset) * free, z)
            ends = centre + spacing / 2 * np.array([[-1.0], [1.0]]) * axis
            if _seen(rig, _outline(ends, diameter / 2)):
                z_axis = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [-1.0, 0.0, 0.0])
                z_axis /= np.linalg.norm(z_axis)
                return Place(
                    words, _pose(np.stack([axis, np.cross(z_axis, axis), z_axis], 1), centre)
                )
    size = f"of {spacing:g} mm with balls of {diameter:g} mm" if spacing else f"of {diameter:g} mm"
    raise InputError(
        f"an artefact {size} does not fit into what camera and projector see at {z:.0f} mm"
        f" ({2 * free[0]:.0f} x {2 * free[1]:.0f} mm): use a smaller one"
    )


def _room(rig: StereoRig, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Middle (2,) and half size (2,), mm, of the part of a depth that camera and projector both
    see."""
    width, height = rig.camera.size
    u, v = np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 31))
    rays = rig.camera.undistort(np.stack([u.ravel(), v.ravel()], 1))
    points = np.concatenate([rays, np.ones((len(rays), 1))], 1) * z
    seen = points[_inside(rig, points)]
    if len(seen) < 9:
        raise InputError(
            f"camera and projector see nothing together at {z:.0f} mm: turn them towards each other"
        )
    low, high = seen[:, :2].min(0), seen[:, :2].max(0)
    return (low + high) / 2, (high - low) / 2


def _seen(rig: StereoRig, points: np.ndarray) -> bool:
    return bool(_inside(rig, points).all())


def _inside(rig: StereoRig, points: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) that lie within both images, a little away from their edges."""
    inside = points[:, 2] > 0
    for lens, pixels in (
        (rig.camera, rig.camera.project(points)),
        (rig.projector, rig.project(points)),
    ):
        size = np.array(lens.size)
        edge = EDGE * size[0]
        with np.errstate(invalid="ignore"):
            inside &= ((pixels > edge) & (pixels < size - 1 - edge)).all(1)
    return np.asarray(inside)


def _outline(centres: np.ndarray, radius: float) -> np.ndarray:
    """(8 n, 3): points around spheres, across the line of sight."""
    angles = np.arange(8) * np.pi / 4
    ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], 1)
    return (centres[:, None] + ring).reshape(-1, 3)


def _turn(about_x: float, about_y: float) -> np.ndarray:
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array(
        [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    )


def _pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
