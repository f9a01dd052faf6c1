"""Surfaces of points: by screened Poisson reconstruction, trimmed to the measured region, or by a
signed distance field of mean heights above the points' tangent planes, and marching cubes."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.jit import kernel
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

    It is extrapolated where there are no points. Raises InputError for too few
    points.
    """
    assert points.normals is not None
    if len(points) < LEAST_POINTS:
        raise InputError(
            f"{len(points)} points make no surface", f"at least {LEAST_POINTS} are needed."
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


BLOCK = 8
PLANE_REACH = 2.0
"""Radius in cells within which a point's tangent plane contributes to the field."""
_MOST_BLOCKS = 20_000_000


def volume_surface(points: PointSet, cell_mm: float) -> Mesh:
    """Reconstruct the surface of points with normals on a grid of ``cell_mm``; it extends two cells
    beyond the points.

    Points are weighted by 1 / sigma2 where known. Memory grows with the surface's area, not with
    the bounding box. Raises InputError for points without normals, for a bounding box of too many
    cells, and without a surface.
    """
    assert points.normals is not None
    o3d = open3d()
    origin = points.points.min(axis=0).astype(np.float64) - 4 * cell_mm
    at = (points.points - origin) / cell_mm
    shape = np.ceil(at.max(axis=0) / BLOCK).astype(np.int64) + 2
    if np.prod(shape) > _MOST_BLOCKS:
        raise InputError(
            f"The points fill {np.ptp(points.points, axis=0).max():.0f} mm, too much for cells of"
            f" {cell_mm:.3g} mm",
            "exclude stray scans.",
        )
    touched = np.zeros(tuple(shape), bool)
    low, high = (
        (at + reach).astype(np.int64) // BLOCK for reach in (-PLANE_REACH, PLANE_REACH + 1)
    )
    for corner in product((False, True), repeat=3):  # at most two blocks along each axis
        touched[tuple(np.where(corner, high, low).T)] = True
    keys = np.argwhere(touched).astype(np.int32)
    kinds = (o3d.core.float32, o3d.core.float32)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), kinds, ((1,), (1,)), 1.0, BLOCK, len(keys)
    )
    buffers, _ = grid.hashmap().activate(o3d.core.Tensor(keys))
    lookup = np.full(tuple(shape), -1, np.int32)
    lookup[tuple(keys.T)] = buffers.numpy()
    height, weight = (
        grid.attribute(name).numpy().reshape(-1, BLOCK**3) for name in ("tsdf", "weight")
    )
    height[:], weight[:] = 0, 0
    sigma, share = points.sigma_mm, np.ones(len(points))
    if sigma is not None:
        share[:] = (np.median(sigma) / np.maximum(sigma, 1e-6)) ** 2
    normals = points.normals.astype(np.float64)
    _add_planes(at, normals, share, BLOCK, PLANE_REACH, lookup, height, weight)
    known = weight > 0
    height[known] /= weight[known]
    weight[known] = 1.0
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    if not len(mesh.vertex.positions):
        raise InputError(
            "No surface was found between the points", "the cells are too fine for them."
        )
    vertices, faces = _sort_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())
    return transfer_attributes(points, vertices.astype(np.float64) * cell_mm + origin, faces)


def _sort_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort vertices (n, 3) by position and faces (m, 3) by vertex, so that the result does not
    depend on threads."""
    order = np.lexsort(vertices.T)
    faces = np.argsort(order)[faces]
    first = faces.argmin(axis=1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])]


@kernel()
def _add_planes(at, normals, share, block, reach, lookup, height, weight):
    """Add the signed distances to each point's tangent plane to the grid nodes around it, and their
    weights.

    ``at`` (n, 3) in cells; ``share`` (n,): the points' weights; ``lookup`` (a, b, c): index of each
    block; ``height`` and ``weight`` (blocks, block^3): sums.
    """
    for i in range(len(at)):
        p0, p1, p2 = at[i, 0], at[i, 1], at[i, 2]
        for z in range(int(np.ceil(p2 - reach)), int(np.floor(p2 + reach)) + 1):
            for y in range(int(np.ceil(p1 - reach)), int(np.floor(p1 + reach)) + 1):
                for x in range(int(np.ceil(p0 - reach)), int(np.floor(p0 + reach)) + 1):
                    d0, d1, d2 = x - p0, y - p1, z - p2
                    near = 1.0 - (d0 * d0 + d1 * d1 + d2 * d2) / (reach * reach)
                    if near <= 0.0:
                        continue
                    w = share[i] * near * near
                    b = lookup[x // block, y // block, z // block]
                    k = x % block + block * (y % block + block * (z % block))
                    height[b, k] += w * (
                        d0 * normals[i, 0] + d1 * normals[i, 1] + d2 * normals[i, 2]
                    )
                    weight[b, k] += w
