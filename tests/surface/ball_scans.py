"""Organised scans of a ball, from any side, without a renderer."""

import numpy as np

from slviewer.reconstruction.cloud import Cloud

RADIUS = 40.0
SIDES = {  # where the camera stands, as the ball sees it
    "front": (0, 0, -1),
    "back": (0, 0, 1),
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    "top": (0, -1, 0),
    "bottom": (0, 1, 0),
}


def looking_from(side: tuple[float, float, float], away: float) -> np.ndarray:
    """T_ball_camera (4, 4) of a camera ``away`` mm from the ball's middle, looking at it."""
    z = -np.array(side, float) / np.linalg.norm(side)
    x = np.cross([0.3, 1.0, 0.2], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = -away * z
    return T


def ball(
    away: float, sigma: float, seed: int, size: tuple[int, int] = (76, 57), grey: float = 200.0
) -> Cloud:
    """What a camera with a slight barrel distortion sees of the ball; noise along z, texture by the
    angle of sight."""
    w, h = size
    v, u = np.mgrid[:h, :w].astype(float)
    x, y = (u - w / 2) / (3.0 * w), (v - h / 2) / (3.0 * w)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) * (1 + 0.3 * (x**2 + y**2))[..., None] ** [
        1,
        1,
        0,
    ]
    squared = (rays**2).sum(axis=2)
    b = away / squared
    with np.errstate(invalid="ignore"):
        z = b - np.sqrt(b**2 - (away**2 - RADIUS**2) / squared)
    points = rays * z[..., None]
    normals = (points - [0, 0, away]) / RADIUS
    facing = -(normals * points).sum(axis=2) / np.linalg.norm(points, axis=2)
    z = z + sigma * np.random.default_rng(seed).normal(size=z.shape)
    points = rays * np.where(facing > 0.25, z, np.nan)[..., None]
    texture = np.nan_to_num(grey * np.ones_like(facing)).astype(np.uint8)
    return Cloud(points, "x", "stereo", np.full(z.shape, sigma), texture)


def off(points: np.ndarray) -> np.ndarray:
    """(n,) mm: how far points in the ball's frame lie outside the ball."""
    return np.asarray(np.linalg.norm(points.astype(float), axis=1) - RADIUS)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def around(
    sigma: float = 0.04, without: tuple[str, ...] = ()
) -> tuple[dict[str, Cloud], dict[str, np.ndarray]]:
    """Scans from the six sides, and their poses."""
    scans = {name: ball(300.0, sigma, i) for i, name in enumerate(SIDES) if name not in without}
    return scans, {name: looking_from(SIDES[name], 300.0) for name in scans}
