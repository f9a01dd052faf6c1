"""Screened Poisson surface reconstruction, trimmed to the measured region."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.registration.open3d_loader import open3d, point_cloud
from slviewer.surface.edit import fill_holes
from slviewer.surface.shapes import (
    Mesh,
    PointSet,
    extent_across,
    face_areas,
    face_groups,
    opening_loops,
    select_faces,
    transfer_attributes,
)

LEAST_POINTS = 100
DEEPEST = 11
"""Largest depth of the octree: 2048 cells along the longest side, 80 um of 150 mm."""
REACH = 3.0
"""Distance from the points, in point spacings, beyond which the surface is extrapolated."""
BULGE = 1.3
"""Largest area of an extrapolated patch over the flat area within its rim."""


@dataclass(frozen=True)
class TrimmedPatches:
    """Figures of the extrapolated patches of a surface.

    ``filled``: number of patches that remain, of which ``flattened`` were replaced by flat ones;
    ``largest_mm``: extent of the largest; ``imagined``: their share of the whole area; ``cut``:
    number of removed patches.
    """

    filled: int
    flattened: int
    largest_mm: float
    imagined: float
    cut: int


def poisson_surface(points: PointSet, cell_mm: float) -> Mesh:
    """Reconstruct a closed surface from points with normals, with cells of ``cell_mm`` or larger.

    It is extrapolated where there are no points. Raises InputError for points without normals, or
    too few.
    """
    if points.normals is None:
        raise InputError(
            "These points have no normals: a surface through them needs to know its outside; merge"
            " again."
        )
    if len(points) < LEAST_POINTS:
        raise InputError(
            f"{len(points)} points make no surface: at least {LEAST_POINTS} are needed."
        )
    known = finite_rows(points.normals)
    middle = points.points.mean(axis=0, dtype=np.float64)
    cloud = point_cloud(points.points[known] - middle, points.normals[known].astype(np.float64))
    extent = float(np.ptp(points.points, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(1.1 * extent / cell_mm)), 4, DEEPEST))
    # one thread: its own pool spins, and where other programs hold the cores it takes a hundred
    # times as long
    surface, _ = open3d().geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, n_threads=1
    )
    mesh = transfer_attributes(
        points, np.asarray(surface.vertices) + middle, np.asarray(surface.triangles)
    )
    closed, _ = fill_holes(mesh, np.inf)  # where the box around the points cut it
    return closed


def trim_far_patches(
    mesh: Mesh, points: PointSet, spacing_mm: float, fill_mm: float
) -> tuple[Mesh, TrimmedPatches]:
    """Remove the patches far from all points whose rim has an extent of more than ``fill_mm``.

    Smaller patches remain as filled holes; one that bulges, as below an object on a table, is
    replaced by a flat fan.
    """
    distance, _ = cKDTree(points.points).query(
        mesh.vertices, distance_upper_bound=REACH * spacing_mm
    )
    far = ~np.isfinite(distance)
    imagined = far[mesh.faces].any(axis=1)
    if not imagined.any():
        return mesh, TrimmedPatches(0, 0, 0.0, 0.0, 0)
    groups = face_groups(mesh.faces, len(mesh.vertices), imagined)
    measured = np.zeros(len(mesh.vertices), bool)
    measured[mesh.faces[~imagined]] = True
    area = face_areas(mesh)
    is_near, filled, flattened, largest = ~imagined, 0, 0, 0.0
    order, count = np.argsort(groups, kind="stable"), int(groups.max()) + 1
    starts = np.searchsorted(groups[order], np.arange(count))
    for patch in np.split(order, starts)[1:]:  # the first holds what was measured
        corners = np.unique(mesh.faces[patch])
        rim = corners[measured[corners]]
        across = extent_across(mesh.vertices[rim]) if len(rim) else np.inf
        if len(rim) and across <= fill_mm:  # what has no rim floats by itself
            bulges = area[patch].sum() > BULGE * _flat_area(mesh.vertices, mesh.faces[patch])
            is_near[patch] = not bulges
            filled, flattened, largest = filled + 1, flattened + bulges, max(largest, across)
    trimmed, cut = select_faces(mesh, is_near), count - filled
    invented = area[is_near & imagined].sum()
    if flattened:
        open_area = face_areas(trimmed).sum()
        trimmed, _ = fill_holes(trimmed, fill_mm)
        invented += face_areas(trimmed).sum() - open_area
    share = float(invented / max(face_areas(trimmed).sum(), 1e-12))
    return trimmed, TrimmedPatches(filled, int(flattened), largest, share, cut)


def _flat_area(vertices: np.ndarray, patch: np.ndarray) -> float:
    """Return the area in mm2 of the fan within the rim of a ``patch`` of faces (k, 3); inf for
    several rims."""
    loops = opening_loops(patch)
    longest = max(loops, key=len, default=np.empty(0, int))
    if len(longest) < 0.8 * sum(map(len, loops)):
        return float("inf")
    around = vertices[longest].astype(np.float64)
    arms = around - around.mean(axis=0)
    return float(lengths(np.cross(arms, np.roll(arms, -1, axis=0))).sum() / 2)
