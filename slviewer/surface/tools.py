"""Mesh utilities: transfer of colours and sigmas, selection of faces, vertex normals, and
distances."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from slviewer.registration.open3d_loader import open3d
from slviewer.surface.shapes import Mesh, PointSet, pick_attributes
from slviewer.surface.topology import face_vectors


def transfer_attributes(known: Mesh | PointSet, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices (n, 3) mm and faces (m, 3) with colours and sigmas of the nearest
    known points.

    Normals are computed from the faces.
    """
    mesh = Mesh(vertices, faces)
    points = known.vertices if isinstance(known, Mesh) else known.points
    attributes: dict[str, Any] = {}
    if len(mesh.vertices) and (known.colours is not None or known.sigma_mm is not None):
        _, nearest = cKDTree(points).query(mesh.vertices)
        attributes = pick_attributes(known, nearest)
    return replace(mesh, **(attributes | {"normals": vertex_normals(mesh)}))


def select_faces(mesh: Mesh, mask: np.ndarray) -> Mesh:
    """Return the faces selected by a mask (m,) bool and the vertices that they use."""
    faces = mesh.faces[mask]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return Mesh(mesh.vertices[used], number[faces].reshape(-1, 3), **pick_attributes(mesh, used))


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return the area-weighted mean normals (n, 3) float32 of the faces around each vertex; (0, 0,
    1) without faces."""
    corners, weights = mesh.faces.ravel(), np.repeat(face_vectors(mesh), 3, axis=0)
    normals = np.stack(
        [np.bincount(corners, along, len(mesh.vertices)) for along in weights.T], axis=1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0]).astype(
        np.float32
    )


def surface_shift(before: Mesh, after: Mesh) -> tuple[float, float]:
    """Return (RMS, maximum) in mm of the distances from the vertices of one mesh to the surface of
    the other."""
    o3d = open3d()
    middle = before.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    core = o3d.core
    scene.add_triangles(
        core.Tensor(after.vertices - middle), core.Tensor(after.faces.astype(np.uint32))
    )
    distance = (
        scene.compute_distance(core.Tensor(before.vertices - middle)).numpy().astype(np.float64)
    )
    return float(np.sqrt(np.mean(distance**2))), float(distance.max())


def to_open3d_mesh(mesh: Mesh) -> Any:
    """Convert to Open3D's triangle mesh; only vertices and faces."""
    o3d = open3d()
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(mesh.faces),
    )
