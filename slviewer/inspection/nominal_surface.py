"""A nominal model: signed distances of points from it, and which of it is visible."""

from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    move_points,
)
from slviewer.geometry.vectors import (
    box_middle,
    diagonal,
    lengths,
    subsample,
    unit_vectors,
)
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.surface.shapes import Mesh, count_edges, label_connected, list_adjacent_faces

RIM = 0.5
"""Cosine: what the rim of an open surface faces less than this lies beyond it, not above it."""
CORNER = 1e-4
"""Barycentric: nearer to a side than this, the nearest place lies on it."""
NEGLIGIBLE = 1e-4
"""mm: directions from nearer than this to the surface are rounding."""
MIN_NORMAL_COSINE = 0.5
"""Cosine: a scan point whose normal is turned away further from the nominal's lies on something
else there."""
SNAPPING_COSINE = 0.95
CHUNK = 32_768
MAX_VOTERS = 200_000
LEAST_VOTES = 20
"""Points more that show a patch from behind, from which on it faces the wrong way."""


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
        # the vertices at edges of one triangle alone
        half, first, _, triangles = count_edges(mesh.faces)
        self._at_rim = np.zeros(len(vertices), bool)
        self._at_rim[half[first[triangles == 1]]] = True
        self.is_closed = not (triangles == 1).any()
        # nothing shows such a model from behind
        self.is_solid = bool(self._mesh.is_volume)
        self.mesh, self.vertices = mesh, vertices
        self._scene = raycasting_scene(vertices - self.middle, mesh.faces)

    def gaps(self, points: Floats) -> Floats:
        """Distances (n,) mm of places (n, 3) from the surface, without a sign."""
        centred = (points - self.middle).astype(np.float32)
        found = self._scene.compute_distance(open3d().core.Tensor(centred)).numpy()
        return np.asarray(found, np.float64)

    def is_hit(self, origins: Floats, directions: Floats) -> Mask:
        """Return which rays (n, 3), (n, 3) meet the surface: (n,) bool."""
        rays = np.concatenate([origins - self.middle, directions], axis=1).astype(np.float32)
        return np.asarray(self._scene.test_occlusions(open3d().core.Tensor(rays)).numpy(), bool)

    def main_axes(self) -> tuple[Floats, Floats]:
        """Return the model's main axes, the columns of (3, 3), those of its frame where they are
        near; and the middle (3,) mm of the box along them."""
        axes = np.linalg.svd(self.sample(5_000)[0] - self.middle, full_matrices=False)[2].T
        if np.abs(axes).max(axis=0).min() > SNAPPING_COSINE:
            axes = np.eye(3)
        axes = np.asarray(axes * np.sign(np.linalg.det(axes)))
        return axes, axes @ box_middle(self.vertices @ axes)

    def is_between(self, starts: Floats, ends: Floats) -> Mask:
        """Return whether the surface lies between places (n, 3), (n, 3), but not at them: (n,)
        bool."""
        rays = np.concatenate([starts - self.middle, ends - starts], axis=1).astype(np.float32)
        near = open3d().core.Tensor(rays)
        return np.asarray(self._scene.test_occlusions(near, 0.01, 0.99).numpy(), bool)

    def signed(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) mm of places (n, 3), positive outside, infinite beyond the rim of an open
        mesh; and the surface's normals (n, 3) where each is nearest."""
        return self._find_nearest(points)[:2]

    def _find_nearest(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """`signed`, and the unit normals (n, 3), at edges between those of their faces."""
        found = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3))
        for k in range(0, len(points), CHUNK):  # that the caches hold
            for whole, part in zip(found, self._find_few(points[k : k + CHUNK]), strict=True):
                whole[k : k + CHUNK] = part
        return found

    def _find_few(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """`_find_nearest` of fewer points."""
        centred = points - self.middle
        nearest = self._scene.compute_closest_points(
            open3d().core.Tensor(centred.astype(np.float32))
        )
        face = nearest["primitive_ids"].numpy().astype(np.int64)
        s, t = nearest["primitive_uvs"].numpy().astype(np.float64).T
        offsets = centred - nearest["points"].numpy().astype(np.float64)
        towards = self._flat[face]
        facing = towards.copy()
        # inside a triangle its own plane says how far; at a side or corner the direction does, and
        # the side of the surface follows from the normals of the vertices there
        away = np.einsum("ij,ij->i", towards, offsets)
        at_side = np.flatnonzero((s < CORNER) | (t < CORNER) | (1 - s - t < CORNER))
        s, t, offsets, corners = (
            s[at_side],
            t[at_side],
            offsets[at_side],
            self._faces[face[at_side]],
        )
        weights = np.stack([1 - s - t, s, t], axis=1)
        smooth = unit_vectors((self._smooth[corners] * weights[..., None]).sum(axis=1))
        gaps, above = lengths(offsets), np.sum(smooth * offsets, axis=1)
        signs = np.where(above < 0, -1.0, 1.0)
        is_off, is_clear = gaps > NEGLIGIBLE, gaps > 10 * NEGLIGIBLE
        at_rim = (self._at_rim[corners] | (weights < CORNER)).all(axis=1)
        beyond = at_rim & (np.abs(above) < RIM * gaps)
        away[at_side[is_off]] = np.where(beyond, np.inf, signs * gaps)[is_off]
        towards[at_side[is_clear]] = ((signs / np.maximum(gaps, 1e-300))[:, None] * offsets)[
            is_clear
        ]
        facing[at_side] = smooth
        return away, towards, facing

    def distances(
        self,
        points: Floats,
        normals: Floats | None,
        T: Floats,
        reach: float,
        *,
        either_side: bool = False,
        at_edges: bool = False,
    ) -> tuple[Floats, Floats]:
        """Signed distances (n,) mm of a scan's points (n, 3) at ``T`` (4, 4), and the surface's
        normals (n, 3); NaN for points farther than ``reach`` mm, or whose ``normals`` (n, 3) face
        another way than the surface, or than ``either_side`` of it. ``at_edges``: those that face
        as the faces of an edge belong to it, which draws them from beyond."""
        away, towards, facing = self._find_nearest(move_points(T, points))
        belongs = np.abs(away) <= reach
        if normals is not None:
            cosine = ((normals @ T[:3, :3].T) * (facing if at_edges else towards)).sum(axis=1)
            # an unknown normal excludes nothing
            belongs &= ~((np.abs(cosine) if either_side else cosine) < MIN_NORMAL_COSINE)
        away[~belongs] = np.nan
        towards[~belongs] = np.nan
        return away, towards

    def seen_from(self, places: Floats, facing: Floats, view: Floats, least: float) -> Mask:
        """Return which places (n, 3) on the surface, facing (n, 3), are visible in the unit
        direction ``view``, (3,) or (n, 3); ``least``: cosine between the two. Returns (n,) bool."""
        view = np.broadcast_to(view, places.shape)
        is_visible = np.asarray(np.sum(facing * view, axis=1) > least)
        lift = 1e-4 * self.diagonal
        origins = (places - self.middle + lift * facing)[is_visible]
        rays = np.concatenate([origins, view[is_visible]], axis=1).astype(np.float32)
        is_visible[is_visible] = ~self._scene.test_occlusions(open3d().core.Tensor(rays)).numpy()
        return is_visible

    def seen_from_behind(self, points: Floats, normals: Floats, T: Floats, reach: float) -> Mask:
        """Return which triangles (m,) bool face away from a scan's points (n, 3), with normals
        (n, 3), at ``T`` (4, 4): of patches that are wound alike, those that most of the points
        within ``reach`` mm show from behind."""
        points, normals = subsample(points, MAX_VOTERS), subsample(normals, MAX_VOTERS)
        pairs, alike = list_adjacent_faces(self._faces)
        patch = label_connected(pairs[alike], len(self._faces))
        moved = (move_points(T, points) - self.middle).astype(np.float32)
        nearest = self._scene.compute_closest_points(open3d().core.Tensor(moved))
        near = lengths(moved - nearest["points"].numpy()) <= reach
        hit = nearest["primitive_ids"].numpy().astype(np.int64)[near]
        cosine = np.sum((normals[near] @ T[:3, :3].T) * self._flat[hit], axis=1)
        votes = (cosine > MIN_NORMAL_COSINE).astype(float) - (cosine < -MIN_NORMAL_COSINE)
        return np.asarray(np.bincount(patch[hit], votes, patch.max() + 1)[patch] < -LEAST_VOTES)

    def sample(self, count: int, seed: int = 0) -> tuple[Floats, Floats]:
        """Places (count, 3) mm evenly over the area, and the unit normals (count, 3) there."""
        import trimesh

        places, face = trimesh.sample.sample_surface(self._mesh, count, seed=seed)
        return np.asarray(places) + self.middle, self._flat[face]
