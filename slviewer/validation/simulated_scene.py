"""Small ray-traced scenes of a camera and a projector, with the true projector coordinate of every
camera pixel.

The camera stands at the origin and looks along z; the scene is about one unit of length away.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from slviewer.fringe.sequence import Size

SceneName = Literal["plane", "sphere", "step", "object"]
SCENES: tuple[SceneName, ...] = get_args(SceneName)
"""A tilted plane; a sphere before a plane; two planes, the nearer casting a shadow on the other; an
object that covers a fifth of the image."""
Texture = Literal["plain", "smooth", "printed"]
TEXTURES: tuple[Texture, ...] = get_args(Texture)
FOCAL = 1.1
"""Focal length of the camera, in widths of its image."""
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_EDGE_PX = 2.5  # by which the subpixels of a pixel differ at a depth edge, in camera pixels
_NEAR = 1e-6
_GRAZING = 0.05  # share of the light of a surface that faces the projector


@dataclass(frozen=True)
class SceneView:
    """Camera, projector and scene. ``field``: width of the projector's field over the camera's.

    ``baseline``: position of the projector beside and above the camera; ``roll``: rad, of the
    projector about its axis; ``seed``: of the shape and the texture of the scene.
    """

    camera: Size
    projector: Size
    field: float
    baseline: tuple[float, float]
    roll: float
    scene: SceneName
    texture: Texture
    seed: int

    @property
    def pixels_per_column(self) -> float:
        """Camera pixels for each projector pixel, along the axis that has fewer."""
        return self.field * min(c / p for c, p in zip(self.camera, self.projector, strict=True))


@dataclass(frozen=True, eq=False)
class Geometry:
    """What each of the subpixels of the camera sees: maps (4, h, w) float32.

    ``u``, ``v``: projector column and row, px; anything where ``shade`` is 0.
    ``albedo``: 0 where there is no surface. ``shade``: projector light at white, 0 where it does
    not reach. ``edge_px``: difference of the subpixels of a pixel at a depth edge.
    """

    u: np.ndarray
    v: np.ndarray
    albedo: np.ndarray
    shade: np.ndarray
    edge_px: float

    def true_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Projector column and row (h, w) px of each pixel; NaN where not wholly illuminated, or at
        a depth edge."""
        is_known = (self.shade > 0).all(axis=0)
        for values in (self.u, self.v):
            is_known &= np.ptp(values, axis=0) < self.edge_px
        u, v = (np.where(is_known, each.mean(axis=0), np.nan) for each in (self.u, self.v))
        return u, v


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane, limited to ``x_range`` and to ``radius`` about its point."""

    point: np.ndarray
    normal: np.ndarray
    x_range: tuple[float, float] = (-np.inf, np.inf)
    radius: float = np.inf

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance (n,) along rays, in lengths of their directions; infinite where they miss."""
        normal = self.normal.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.point - origin) @ normal) / (direction @ normal)
            x = origin[..., 0] + t * direction[..., 0]
            inside = (x >= self.x_range[0]) & (x <= self.x_range[1])
            if np.isfinite(self.radius):
                hit = origin + t[:, None] * direction
                inside &= np.linalg.norm(hit - self.point, axis=-1) <= self.radius
        return np.where(inside & (t > _NEAR), t, np.inf)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Normals (n, 3) towards the camera."""
        return np.broadcast_to(-self.normal, points.shape)


@dataclass(frozen=True, eq=False)
class _Sphere:
    """A sphere."""

    centre: np.ndarray
    radius: float

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance (n,) along rays, in lengths of their directions; infinite where they miss."""
        offset = origin - self.centre
        a = (direction * direction).sum(axis=-1)
        b = (direction * offset).sum(axis=-1)
        c = (offset * offset).sum(axis=-1) - self.radius**2
        root = b * b - a * c
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (t > _NEAR), t, np.inf)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward normals (n, 3)."""
        return (points - self.centre) / self.radius


_Surface = _Plane | _Sphere


def _tilted(rng: np.random.Generator, most: float) -> np.ndarray:
    """A unit vector along z, tilted by up to ``most`` about x and y."""
    normal = np.array([*rng.uniform(-most, most, 2), 1.0])
    return normal / np.linalg.norm(normal)


def _build_surfaces(view: SceneView, moved: np.ndarray) -> list[_Surface]:
    """The surfaces of a scene, displaced by ``moved`` (3,)."""
    rng = np.random.default_rng(view.seed)
    if view.scene == "plane":
        return [_Plane(np.array([0, 0, 1.0]) + moved, _tilted(rng, 0.4))]
    if view.scene == "sphere":
        centre = np.array([*rng.uniform(-0.08, 0.08, 2), 1.1])
        wall = _Plane(np.array([0, 0, 1.2]) + moved, _tilted(rng, 0.15))
        return [_Sphere(centre + moved, float(rng.uniform(0.22, 0.3))), wall]
    if view.scene == "step":
        edge, depth = float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.86, 0.94))
        front = _Plane(
            np.array([0, 0, depth]) + moved, _tilted(rng, 0.2), (edge + float(moved[0]), np.inf)
        )
        return [front, _Plane(np.array([0, 0, 1.1]) + moved, _tilted(rng, 0.15))]
    centre = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    if rng.random() < 0.5:
        return [_Sphere(centre + moved, 0.2)]
    return [_Plane(centre + moved, _tilted(rng, 0.35), radius=0.205)]


def _paint(view: SceneView, points: np.ndarray) -> np.ndarray:
    """Albedo (n,) of the surfaces at points (n, 3) that move with them."""
    rng = np.random.default_rng([view.seed, 1])
    if view.texture == "plain":
        return np.full(len(points), 0.9)
    x = (points[:, 0] - 0.2 * points[:, 2]).astype(np.float32)
    y = (points[:, 1] + 0.1 * points[:, 2]).astype(np.float32)
    waves = np.zeros(len(points), np.float32)
    for _ in range(5):
        kx, ky, start = rng.uniform([-30, -30, 0], [30, 30, 6.3]).astype(np.float32)
        waves += np.sin(kx * x + ky * y + start)
    if view.texture == "smooth":
        return np.clip(0.65 + 0.12 * waves, 0.3, 1.0)
    return np.where(waves > 0.6, 0.3, 0.9) * np.clip(1 + 0.04 * waves, 0.8, 1.2)


def _list_rays(camera: Size) -> np.ndarray:
    """Directions (n, 3) float32 of the rays of all subpixels."""
    width, height = camera
    x, y = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    rays = np.ones((len(_SUBPIXELS), height, width, 3), np.float32)
    for k, (dx, dy) in enumerate(_SUBPIXELS):
        rays[k, ..., 0] = (x + dx)[None, :] / (FOCAL * width)
        rays[k, ..., 1] = (y + dy)[:, None] / (FOCAL * width)
    return rays.reshape(-1, 3)


def _project(
    view: SceneView, points: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Projector column and row (n,) px of points (n, 3); ``centre`` of the projector (3,)."""
    z = np.array([0, 0, 1.0]) - centre
    z /= np.linalg.norm(z)
    x = np.cross([np.sin(-view.roll), np.cos(view.roll), 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    x, y, z = (rotation.astype(np.float32) @ (points - centre).T).astype(np.float32)
    extent = np.array(view.camera) / (FOCAL * view.camera[0]) * view.field
    focal = np.array(view.projector) / extent * np.linalg.norm(centre - [0, 0, 1.0])
    middle = [(extent - 1) / 2 for extent in view.projector]
    return focal[0] * x / z + middle[0], focal[1] * y / z + middle[1]


@lru_cache(maxsize=3)
def trace_view(
    view: SceneView, displacement: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Geometry:
    """Trace the rays of all subpixels; ``displacement`` of the scene, in its unit of length."""
    moved, rays = np.array(displacement, np.float32), _list_rays(view.camera)
    surfaces = _build_surfaces(view, moved)
    distances = np.stack([surface.intersect(np.zeros(3), rays) for surface in surfaces])
    nearest, t = distances.argmin(axis=0), distances.min(axis=0)
    is_seen = np.isfinite(t)
    points = np.where(is_seen, t, 1.0)[:, None].astype(np.float32) * rays
    normals = np.zeros_like(points)
    for k, surface in enumerate(surfaces):
        chosen = nearest == k
        normals[chosen] = surface.normals(points[chosen])
    centre = np.array([*view.baseline, 0.0], np.float32)
    to_light = centre - points
    for k, surface in enumerate(surfaces):
        # a surface does not hide itself: its normals decide that
        others = is_seen & (nearest != k)
        is_blocked = surface.intersect(points[others], to_light[others]) < 1
        normals[others] *= ~is_blocked[:, None]
    squared = np.einsum("ni,ni->n", to_light, to_light)
    lambert = np.maximum(np.einsum("ni,ni->n", normals, to_light), 0) / squared**1.5
    u, v = _project(view, points, centre)
    width, height = view.projector
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    albedo = np.where(is_seen, _paint(view, points - moved), 0.0)
    shade = np.where(inside & (lambert > _GRAZING), albedo * lambert, 0.0)
    shape = (len(_SUBPIXELS), view.camera[1], view.camera[0])
    u, v, albedo, shade = (
        each.astype(np.float32).reshape(shape)
        for each in (np.clip(u, -1, width), np.clip(v, -1, height), albedo, shade)
    )
    return Geometry(u, v, albedo, shade, _EDGE_PX / view.pixels_per_column)
