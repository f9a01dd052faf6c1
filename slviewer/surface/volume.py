"""Surface reconstruction by a signed distance field: mean heights above the points' tangent planes,
marching cubes."""

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import kernel
from slviewer.registration.open3d_loader import open3d
from slviewer.surface.shapes import Mesh, PointSet, transfer_attributes

BLOCK = 8
REACH = 2.0
"""Radius in cells within which a point's tangent plane contributes to the field."""
_MOST_BLOCKS = 20_000_000


def volume_surface(points: PointSet, cell_mm: float) -> Mesh:
    """Reconstruct the surface of points with normals on a grid of ``cell_mm``; it extends two cells
    beyond the points.

    Points are weighted by 1 / sigma2 where known. Memory grows with the surface's area, not with
    the bounding box. Raises InputError for points without normals, for a bounding box of too many
    cells, and without a surface.
    """
    if points.normals is None:
        raise InputError(
            "These points have no normals: a volume needs to know its outside; merge the scans"
            " again."
        )
    o3d = open3d()
    origin = points.points.min(axis=0).astype(np.float64) - 4 * cell_mm
    at = (points.points - origin) / cell_mm
    shape = np.ceil(at.max(axis=0) / BLOCK).astype(np.int64) + 2
    if np.prod(shape) > _MOST_BLOCKS:
        raise InputError(
            f"The points fill {np.ptp(points.points, axis=0).max():.0f} mm, too much for cells of"
            f" {cell_mm:.3g} mm: exclude stray scans."
        )
    touched = np.zeros(tuple(shape), bool)
    _mark_blocks(at, BLOCK, REACH, touched)
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
    _add_planes(at, normals, share, BLOCK, REACH, lookup, height, weight)
    known = weight > 0
    height[known] /= weight[known]
    weight[known] = 1.0
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    if not len(mesh.vertex.positions):
        raise InputError(
            "No surface was found between the points: the cells are too fine for them."
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
def _mark_blocks(at, block, reach, touched):
    """Set ``touched`` (a, b, c) True for the blocks within ``reach`` cells of points ``at`` (n, 3),
    in cells."""
    for i in range(len(at)):
        x0, x1 = int(at[i, 0] - reach) // block, int(at[i, 0] + reach + 1) // block
        y0, y1 = int(at[i, 1] - reach) // block, int(at[i, 1] + reach + 1) // block
        z0, z1 = int(at[i, 2] - reach) // block, int(at[i, 2] + reach + 1) // block
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    touched[x, y, z] = True


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
