"""A triangle mesh before the rig, by ray casting."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import unit_vectors
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.simulation.assets import asset
from slviewer.simulation.boards import Pose
from slviewer.simulation.scenes import Points, Rays, Surface, directions_of

# shadow rays start this far above the surface: Open3D casts in float32, 1e-4 mm at these depths
_LIFT_MM = 0.02


@dataclass(frozen=True, eq=False)
class MeshScene:
    """A diffuse mesh: vertices (n, 3) mm in a frame of its own, triangles (m, 3) int, placed by
    `pose`.

    Depths are those of the flat triangles, in float64; shading follows normals interpolated between
    the vertices.
    """

    vertices: Points
    triangles: np.ndarray
    pose: Pose
    albedo: float = 0.8

    @cached_property
    def placed(self) -> np.ndarray:
        """Vertices (n, 3) float64 in the camera frame."""
        return self.pose.to_camera(self.vertices.astype(np.float64))

    def trace(self, rays: Rays) -> Surface:
        """Return the first triangle that each ray meets; back faces are ignored."""
        index, uvs = self.cast(rays)
        hit = index >= 0
        corners = self.triangles[index[hit]]
        a, b, c = (self.placed[corners[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)
        along = directions_of(rays)[hit]
        facing = (flat * along).sum(-1)
        points = along * ((flat * a).sum(-1) / facing)[:, None]
        s, t = uvs[hit].T[..., None]
        n = self.vertex_normals
        smooth = (1 - s - t) * n[corners[:, 0]] + s * n[corners[:, 1]] + t * n[corners[:, 2]]
        front = facing < 0
        hit[hit] = front
        surface = Surface.empty(rays.shape[:2])
        surface.points[hit], surface.normals[hit] = points[front], unit_vectors(smooth)[front]
        surface.albedo[hit] = self.albedo
        return surface

    def cast(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """Return (h, w) int: the triangle, of either side, that each ray meets, -1 for none; (h, w,
        2): where on it."""
        directions = directions_of(rays)
        lines = np.concatenate([np.zeros_like(directions), directions], -1).astype(np.float32)
        cast = self._caster.cast_rays(open3d().core.Tensor(lines))
        distance, index, uv = (
            cast[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")
        )
        return np.where(np.isfinite(distance), index.astype(np.int64), -1), uv.astype(float)

    def occluded(self, points: Points, source: Points) -> np.ndarray:
        """Return whether the mesh is between `points` and `source`."""
        way = source - points
        lift = _LIFT_MM / np.linalg.norm(way, axis=-1, keepdims=True)
        cast = np.concatenate([points + lift * way, (1 - lift) * way], -1).astype(np.float32)
        return self._caster.test_occlusions(open3d().core.Tensor(cast), 0.0, 1.0).numpy()

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """Unit normals (n, 3) of the vertices in the camera frame, averaged over triangles by
        area."""
        corners = self.placed[self.triangles]
        # twice the area: a fair weight
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.zeros_like(self.placed)
        np.add.at(normals, self.triangles.T, flat)
        return unit_vectors(normals)

    @cached_property
    def _caster(self) -> Any:
        """Open3D ray-casting scene of the placed mesh."""
        return raycasting_scene(self.placed, self.triangles)


def demo_object(pose: Pose) -> MeshScene:
    """The ammonite of ``assets/objects/ammonite.ply``: about 140 mm wide, its front towards -z of
    its own frame."""
    mesh = open3d().io.read_triangle_mesh(str(asset("objects/ammonite.ply")))
    if not mesh.has_triangles():
        raise InputError(
            "the shipped file assets/objects/ammonite.ply has no triangles",
            "install slviewer again",
        )
    return MeshScene(np.asarray(mesh.vertices), np.asarray(mesh.triangles), pose)
