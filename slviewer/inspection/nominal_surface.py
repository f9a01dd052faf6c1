"""Signed distances of points from a nominal model."""

from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import box_middle, diagonal, lengths, unit_vectors
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.surface.shapes import Mesh, count_edges

RIM = 0.5
"""Cosine: what the rim of an open surface faces less than this lies beyond it, not above it."""
CORNER = 1e-4
"""Barycentric: nearer to a side than this, the nearest place lies on it."""
NEGLIGIBLE = 1e-4
"""mm: directions from nearer than this to the surface are rounding."""


class NominalSurface:
    """A mesh, closed or open, whose normals point outside. Distances are right within a
    micrometre."""

    def __init__(self, mesh: Mesh):
        import trimesh

        if not len(mesh.faces):
            raise InputError("The nominal model has no triangles: give a mesh.")
        vertices = mesh.vertices.astype(np.float64)
        self.middle = box_middle(vertices)  # casting in float32 is finest about 0
        self.diagonal = diagonal(vertices)
        self._mesh: Any = trimesh.Trimesh(vertices - self.middle, mesh.faces, process=False)
        if not self._mesh.area > 0:
            raise InputError("The nominal model's triangles have no area: give another file.")
        self._flat = np.asarray(self._mesh.face_normals)
        # normals of the vertices weighted by the triangles' angles tell the side of a place
        # (Bærentzen and Aanæs 2005)
        self._smooth = np.asarray(self._mesh.vertex_normals)
        self._faces = mesh.faces
        self._at_rim = _rim_vertices(mesh.faces, len(vertices))
        self._scene = raycasting_scene(vertices - self.middle, mesh.faces)

    def signed(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (n,) mm of places (n, 3), positive outside, infinite beyond the rim of an open
        mesh; and the surface's normals (n, 3) where each is nearest."""
        centred = points - self.middle
        nearest = self._scene.compute_closest_points(
            open3d().core.Tensor(centred.astype(np.float32))
        )
        face = nearest["primitive_ids"].numpy().astype(np.int64)
        s, t = nearest["primitive_uvs"].numpy().astype(np.float64).T
        offsets = centred - nearest["points"].numpy().astype(np.float64)
        normals = self._flat[face]
        # inside a triangle its own plane says how far; at a side or corner the direction does, and
        # the side of the surface follows from the normals of the vertices there
        at_side = (s < CORNER) | (t < CORNER) | (1 - s - t < CORNER)
        away = np.sum(normals * offsets, axis=1)
        if at_side.any():
            some = self._smooth[self._faces[face[at_side]]]
            weights = np.stack([1 - s - t, s, t], axis=1)[at_side]
            smooth = unit_vectors((some * weights[..., None]).sum(axis=1))
            gaps = lengths(offsets[at_side])
            above = np.sum(smooth * offsets[at_side], axis=1)
            signs = np.where(above < 0, -1.0, 1.0)
            away[at_side] = np.where(gaps > NEGLIGIBLE, signs * gaps, away[at_side])
            at_rim = (self._at_rim[self._faces[face[at_side]]] | (weights < CORNER)).all(axis=1)
            beyond = at_rim & (np.abs(above) < RIM * gaps) & (gaps > NEGLIGIBLE)
            away[np.flatnonzero(at_side)[beyond]] = np.inf
            normals = normals.copy()
            clear = gaps > 10 * NEGLIGIBLE
            normals[np.flatnonzero(at_side)[clear]] = (signs / np.maximum(gaps, 1e-300))[
                clear, None
            ] * offsets[at_side][clear]
        return away, normals

    def seen_from(
        self, places: np.ndarray, facing: np.ndarray, view: np.ndarray, least: float
    ) -> np.ndarray:
        """Return which places (n, 3) on the surface, facing (n, 3), are visible from far away in
        the direction ``view`` (3,); ``least``: cosine between the two. Returns (n,) bool."""
        is_visible = facing @ view > least
        lift = 1e-4 * self.diagonal
        origins = (places[is_visible] - self.middle + lift * facing[is_visible]).astype(np.float32)
        rays = np.concatenate([origins, np.broadcast_to(view, origins.shape)], axis=1).astype(
            np.float32
        )
        is_visible[is_visible] = ~self._scene.test_occlusions(open3d().core.Tensor(rays)).numpy()
        return is_visible

    def sample(self, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Places (count, 3) mm evenly over the area, and the unit normals (count, 3) there."""
        import trimesh

        places, face = trimesh.sample.sample_surface(self._mesh, count, seed=seed)
        return np.asarray(places) + self.middle, self._flat[face]


def _rim_vertices(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the vertices (count,) bool at edges of one triangle alone."""
    half, first, _, triangles = count_edges(faces)
    is_rim = np.zeros(count, bool)
    is_rim[half[first[triangles == 1]]] = True
    return is_rim
