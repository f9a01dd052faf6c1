"""Mesh editing: removal of small parts, hole filling, smoothing and decimation; each returns
figures of its change."""

from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError
from slviewer.surface.shapes import Mesh
from slviewer.surface.tools import select_faces, surface_shift, to_open3d_mesh, transfer_attributes
from slviewer.surface.topology import extent_across, face_areas, face_groups, opening_loops

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
    if not len(mesh.faces):
        return mesh, DroppedParts(0, 0.0)
    groups = face_groups(mesh.faces, len(mesh.vertices))
    sizes = np.bincount(groups, weights=face_areas(mesh))
    small = (sizes < LEAST_SHARE * sizes.max()) & (sizes <= most_mm2)
    largest = float(sizes[small].max()) if small.any() else 0.0
    return select_faces(mesh, ~small[groups]), DroppedParts(int(small.sum()), largest)


def fill_holes(mesh: Mesh, size_mm: float) -> tuple[Mesh, FilledHoles]:
    """Fill the holes with an extent of at most ``size_mm``, each by a triangle fan around its
    centroid."""
    if not size_mm >= 0:
        raise InputError(f"Holes of up to {size_mm} mm cannot be filled: give 0 or more.")
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
    if rounds < 1:
        raise InputError(f"{rounds} rounds of smoothing were asked for: give 1 or more.")
    calm = to_open3d_mesh(mesh).filter_smooth_taubin(number_of_iterations=rounds)
    smoothed = transfer_attributes(mesh, np.asarray(calm.vertices), mesh.faces)
    return smoothed, SurfaceShift(
        *surface_shift(mesh, smoothed), len(mesh.faces), len(smoothed.faces)
    )


def decimate(mesh: Mesh, triangles: int) -> tuple[Mesh, SurfaceShift]:
    """Simplify the mesh to at most a number of triangles by quadric error decimation."""
    if triangles < 4:
        raise InputError(f"{triangles} triangles make no mesh: ask for at least 4.")
    if len(mesh.faces) <= triangles:
        return mesh, SurfaceShift(0.0, 0.0, len(mesh.faces), len(mesh.faces))
    # Open3D places vertices well only in meshes of a large absolute size: the error of small parts
    # was doubled
    middle, size = (
        mesh.vertices.mean(axis=0, dtype=np.float64),
        float(np.ptp(mesh.vertices, axis=0).max()) or 1.0,
    )
    enlarged = to_open3d_mesh(mesh).translate(-middle).scale(_THINNED_AT / size, np.zeros(3))
    fewer = enlarged.simplify_quadric_decimation(triangles)
    thinned = transfer_attributes(
        mesh,
        np.asarray(fewer.vertices) * (size / _THINNED_AT) + middle,
        np.asarray(fewer.triangles),
    )
    return thinned, SurfaceShift(*surface_shift(mesh, thinned), len(mesh.faces), len(thinned.faces))
