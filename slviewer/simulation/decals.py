"""Coded markers stuck onto the scenes of the simulated rig."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.scenes import AlteredScene, Rays, Surface
from slviewer.target.coded import marker_modules

WHITE, BLACK = 0.85, 0.09
_QUIET = 0.2  # of the side: white around a marker
_THICK_MM = 4.0  # how far from the decal's plane a curved surface may lie
_SAMPLES = 4  # by the square of which a pixel's area is averaged


@dataclass(frozen=True, eq=False)
class Decal:
    """A marker ``number`` of side ``side_mm``, whose middle is the origin of ``pose``,
    T_object_decal: x to its right, y down, z into the surface."""

    number: int
    side_mm: float
    pose: Pose

    def albedo(self, xy: np.ndarray) -> np.ndarray:
        """Albedo (...) at places (..., 2) mm of the decal's plane; NaN beyond its paper."""
        modules = marker_modules(self.number)
        cell = self.side_mm / len(modules)
        at = np.floor(xy / cell + len(modules) / 2).astype(int)
        inside = ((at >= 0) & (at < len(modules))).all(axis=-1)
        at = np.clip(at, 0, len(modules) - 1)
        printed = np.where(modules[at[..., 1], at[..., 0]] == 0, BLACK, WHITE)
        paper = (np.abs(xy) <= self.side_mm * (0.5 + _QUIET)).all(axis=-1)
        return np.where(inside, printed, np.where(paper, WHITE, np.nan))


@dataclass(frozen=True, eq=False)
class MarkedScene(AlteredScene):
    """An object's scene at ``pose`` with decals on it, which follow its surface and do not change
    its shape."""

    pose: Pose
    decals: Sequence[Decal]

    def trace(self, rays: Rays) -> Surface:
        """What the scene's rays meet, with the decals' albedo, averaged over each pixel's area."""
        surface = self.scene.trace(rays)
        with np.errstate(invalid="ignore"):
            steps = [np.gradient(surface.points, axis=axis) for axis in (1, 0)]
        albedo = surface.albedo.copy()
        offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
        for decal in self.decals:
            R = self.pose.R @ decal.pose.R  # of the decal in the camera's frame
            local = (surface.points - self.pose.to_camera(decal.pose.t)) @ R
            with np.errstate(invalid="ignore"):
                near = (np.abs(local[..., :2]) < decal.side_mm).all(axis=-1) & (
                    np.abs(local[..., 2]) < _THICK_MM
                )
                near &= surface.normals @ R[:, 2] < 0
            if not near.any():
                continue
            along, down = (np.nan_to_num(step[near] @ R[:, :2]) for step in steps)
            own = albedo[near]
            total = np.zeros_like(own)
            for a, b in product(offsets, offsets):
                there = decal.albedo(local[near][:, :2] + a * along + b * down)
                total += np.where(np.isnan(there), own, there).astype(np.float32)
            albedo[near] = total / _SAMPLES**2
        return replace(surface, albedo=albedo)


def marked_plate(pose: Pose) -> MarkedScene:
    """A blank plate with six markers."""
    places = ((-60.0, -45.0), (0.0, -50.0), (60.0, -45.0), (-60.0, 40.0), (5.0, 45.0), (60.0, 45.0))
    decals = [
        Decal(i, 16.0, Pose(np.eye(3), np.array([x, y, 0.0]))) for i, (x, y) in enumerate(places)
    ]
    return MarkedScene(blank_board(pose), pose, decals)
