"""Scenes in front of the simulated rig, and the surfaces that its camera rays meet.

Every scene answers two questions: `trace` (where do the rays meet the surface, with which normal
and albedo) and `occluded` (does the scene itself stand between a surface point and the projector).
All lengths in mm, camera frame.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

Points = np.ndarray
"""(..., 3) mm: places, directions or normals, in the camera's frame where no other is named."""
Rays = np.ndarray
"""(h, w, 2): x / z and y / z of each pixel's ray."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What the rays of (h, w) pixels meet: points and unit normals (h, w, 3) float64, NaN where
    nothing is met; normals look towards the camera; albedo (h, w) float32, averaged over the
    pixel's area, 0 where nothing is met.
    """

    points: Points
    normals: Points
    albedo: np.ndarray

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "Surface":
        """The surface where none of (h, w) pixels meets anything."""
        nowhere = np.full((*shape, 3), np.nan)
        return cls(nowhere, nowhere.copy(), np.zeros(shape, np.float32))

    def overlay(self, other: "Surface", where: np.ndarray) -> "Surface":
        """Return the surface with the pixels ``where`` (h, w) bool of another one."""
        return Surface(
            np.where(where[..., None], other.points, self.points),
            np.where(where[..., None], other.normals, self.normals),
            np.where(where, other.albedo, self.albedo),
        )


class Scene(Protocol):
    """Protocol of scenes that can be rendered."""

    def trace(self, rays: Rays) -> Surface:
        """What the camera rays (h, w, 2) = (x/z, y/z) meet."""

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """(n,) bool: the way from `points` (n, 3) on the surface to `source` (3,) is blocked."""


def directions_of(rays: Rays) -> np.ndarray:
    """(h, w, 3): the directions (x/z, y/z, 1) of rays (h, w, 2)."""
    return np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1)


@dataclass(frozen=True, eq=False)
class AlteredScene:
    """A scene of which something changes what is seen, and not what is shaded."""

    scene: Scene

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """As of the scene itself."""
        return self.scene.occluded(points, source)


@dataclass(frozen=True, eq=False)
class Spheres:
    """One or several diffuse spheres: centres (n, 3), one radius, nothing behind them."""

    centres: Points
    radius_mm: float
    albedo: float = 0.85

    def trace(self, rays: Rays) -> Surface:
        """The nearer intersection with the nearest sphere."""
        directions = directions_of(rays)
        squared = (directions**2).sum(-1)
        depth = np.full(rays.shape[:2], np.inf)
        surface = Surface.empty(rays.shape[:2])
        for centre in self.centres:
            along = directions @ centre / squared
            root = along**2 - (centre @ centre - self.radius_mm**2) / squared
            with np.errstate(invalid="ignore"):
                z = along - np.sqrt(root)
            nearer = (z > 0) & (z < depth)
            depth[nearer] = z[nearer]
            surface.points[nearer] = directions[nearer] * z[nearer, None]
            surface.normals[nearer] = (surface.points[nearer] - centre) / self.radius_mm
            surface.albedo[nearer] = self.albedo
        return surface

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """Return whether another part of the spheres is between the points and `source`."""
        way = source - points
        blocked = np.zeros(len(points), bool)
        for centre in self.centres:
            to_centre = centre - points
            share = (to_centre * way).sum(-1) / (way**2).sum(-1)
            gap = np.linalg.norm(to_centre - share[:, None] * way, axis=-1)
            # A point of this very sphere lies at its radius: blocked only if the way enters, which
            # `share > 0` says.
            blocked |= (share > 0) & (gap < self.radius_mm * (1 - 1e-9))
        return blocked


def sphere(centre: tuple[float, float, float], diameter_mm: float = 196.0) -> Spheres:
    """The Letter's sphere, of 196 mm diameter."""
    return Spheres(np.array([centre], float), diameter_mm / 2)
