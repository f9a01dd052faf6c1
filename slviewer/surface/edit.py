"""Mesh editing: removal of small parts, hole filling, smoothing and decimation; each returns
figures of its change."""

from dataclasses import dataclass

import numpy as np

from slviewer.geometry.vectors import rms
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.surface.shapes import (
    Mesh,
    extent_across,
    face_areas,
    face_groups,
    opening_loops,
    select_faces,
    to_open3d_mesh,
    transfer_attributes,
)

LEAST_SHARE = 0.01
_THINNED_AT = 1000.0


@dataclass(frozen=True)
class DroppedParts:
    """Number of removed parts, and the area of the largest one in mm2."""

    parts: int
    largest_mm2: float


@dataclass(frozen=True)
class FilledHoles:
    """Number of filled holes, extent of the largest one in mm, and number of openings that remain
    (``left``)."""

    holes: int
    largest_mm: float
    left: int


@dataclass(frozen=True)
class SurfaceShift:
    """Distances from the vertices before a change to the surface after it, and the numbers of
    triangles."""

    rms_mm: float
    max_mm: float
    before: int
    after: int


def drop_small_parts(mesh: Mesh, most_mm2: float) -> tuple[Mesh, DroppedParts]:
    """Remove the connected parts of at most ``most_mm2`` that have less than 1 % of the largest
    part's area."""
    groups = face_groups(mesh.faces, len(mesh.vertices))
    sizes = np.bincount(groups, weights=face_areas(mesh))
    small = (sizes < LEAST_SHARE * sizes.max()) & (sizes <= most_mm2)
    largest = float(sizes[small].max()) if small.any() else 0.0
    return select_faces(mesh, ~small[groups]), DroppedParts(int(small.sum()), largest)


def fill_holes(mesh: Mesh, size_mm: float) -> tuple[Mesh, FilledHoles]:
    """Fill the holes with an extent of at most ``size_mm``, each by a triangle fan around its
    centroid."""
    vertices, faces, sizes, left = [mesh.vertices], [mesh.faces], [], 0
    for loop in opening_loops(mesh.faces):
        corners = mesh.vertices[loop]
        across = extent_across(corners)
        if across > size_mm:
            left += 1
            continue
        sizes.append(across)
        if len(loop) == 3:
            faces.append(loop[None, ::-1])
            continue
        middle = len(mesh.vertices) + len(vertices) - 1
        vertices.append(corners.mean(axis=0, keepdims=True))
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), middle)], axis=1))
    if not sizes:
        return mesh, FilledHoles(0, 0.0, left)
    filled = transfer_attributes(mesh, np.concatenate(vertices), np.concatenate(faces))
    return filled, FilledHoles(len(sizes), max(sizes), left)


def smooth(mesh: Mesh, rounds: int) -> tuple[Mesh, SurfaceShift]:
    """Smooth the mesh by iterations of Taubin's filter, which does not shrink it."""
    calm = to_open3d_mesh(mesh).filter_smooth_taubin(number_of_iterations=rounds)
    smoothed = transfer_attributes(mesh, np.asarray(calm.vertices), mesh.faces)
    return smoothed, _measure_shift(mesh, smoothed)


def decimate(mesh: Mesh, triangles: int) -> tuple[Mesh, SurfaceShift]:
    """Simplify the mesh to at most a number of triangles by quadric error decimation."""
    if len(mesh.faces) <= triangles:
        return mesh, SurfaceShift(0.0, 0.0, len(mesh.faces), len(mesh.faces))
    # Open3D places vertices well only in meshes of a large absolute size: the error of small parts
    # was doubled
    middle = mesh.vertices.mean(axis=0, dtype=np.float64)
    size = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    enlarged = to_open3d_mesh(mesh).translate(-middle).scale(_THINNED_AT / size, np.zeros(3))
    fewer = enlarged.simplify_quadric_decimation(triangles)
    vertices = np.asarray(fewer.vertices) * (size / _THINNED_AT) + middle
    thinned = transfer_attributes(mesh, vertices, np.asarray(fewer.triangles))
    return thinned, _measure_shift(mesh, thinned)


def _measure_shift(before: Mesh, after: Mesh) -> SurfaceShift:
    """Measure the distances from the vertices of a mesh to its surface after a change."""
    middle = before.vertices.mean(axis=0)
    scene = raycasting_scene(after.vertices - middle, after.faces)
    places = open3d().core.Tensor(before.vertices - middle)
    distance = scene.compute_distance(places).numpy().astype(np.float64)
    return SurfaceShift(rms(distance), float(distance.max()), len(before.faces), len(after.faces))
