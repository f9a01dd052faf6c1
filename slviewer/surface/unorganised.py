"""Points without pixels that make them neighbours: their noise and normals, and fusing them."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import Floats, move_points
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import diagonal, finite_rows, median_spacing, subsample
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.registration.open3d_loader import fit_normals, point_cloud
from slviewer.surface.overlap_kernels import MIN_NORMAL_COSINE
from slviewer.surface.shapes import PointSet

_NEIGHBOURS = 24
_PLACES = 5000
_ORIENTED = 100.0
"""Cells along the diagonal that normals are first oriented in."""
_FAR, _SEEN = 1000.0, 0.75
"""Radius of the spherical flip that finds hidden points, in sizes; least share of a scan's points
that its own sensor sees: of a closed surface it sees half."""


def estimate_point_noise(points: Floats) -> float:
    """Estimate the standard deviation (mm) of points (n, 3) mm along their surface: from surfaces
    of second degree through the neighbours of up to 5000 of them, in the median. Errors that
    neighbours share are not in it."""
    count = min(_NEIGHBOURS, len(points))
    some = subsample(points, _PLACES)
    patches = points[cKDTree(points).query(some, k=count)[1]]
    patches = patches - patches.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))[1]
    height, *across = np.moveaxis(patches @ axes, 2, 0)
    scale = np.abs(across).max(axis=(0, 2))[:, None] + 1e-12
    flat = np.stack([each / scale for each in across], axis=-1).reshape(-1, 2)
    Q = np.linalg.qr(monomials(flat, 2).reshape(len(some), count, -1))[0]
    residual = height - np.einsum("nkj,nlj,nl->nk", Q, Q, height)
    sigma = np.sqrt((residual**2).sum(axis=1) / (count - Q.shape[2]))
    resolved = np.finfo(np.float32).eps * np.abs(points).max()  # of the float32 that are stored
    return max(float(np.median(sigma)), float(resolved))


def estimate_normals(points: Floats, sensor: Floats | None) -> tuple[Floats, bool]:
    """Estimate unit normals (n, 3) of points (n, 3) mm, and whether they are turned towards the
    ``sensor`` (3,): where that is unknown, or does not see most of them, neighbours are turned
    alike, and all outwards on the whole."""
    cloud = point_cloud(points)
    fit_normals(cloud, _NEIGHBOURS)
    size = diagonal(points)
    thin = point_cloud(points).voxel_down_sample(size / _ORIENTED)
    if sensor is not None:
        visible = thin.hidden_point_removal(sensor, _FAR * (size + float(np.linalg.norm(sensor))))[
            1
        ]
        if len(visible) > _SEEN * len(thin.points):
            cloud.orient_normals_towards_camera_location(sensor)
            return np.asarray(cloud.normals), True
    fit_normals(thin, _NEIGHBOURS)
    thin.orient_normals_consistent_tangent_plane(12)
    places, facing = np.asarray(thin.points), np.asarray(thin.normals)
    if np.sum(facing * (places - places.mean(axis=0))) < 0:
        facing = -facing
    normals = np.asarray(cloud.normals)
    alike = np.sum(normals * facing[cKDTree(places).query(points, workers=-1)[1]], axis=1)
    return np.where(alike[:, None] < 0, -normals, normals), False


def point_set(cloud: Cloud, T: Floats | None = None) -> PointSet:
    """Return the points of an unorganised cloud whose normals are known, moved by ``T`` (4, 4)."""
    assert cloud.normals is not None
    T = np.eye(4) if T is None else T
    mask = cloud.mask & finite_rows(cloud.normals)
    normals = choose_pixels(cloud.normals, mask) @ T[:3, :3].T
    colours = None if (rgb := cloud.rgb) is None else rgb[mask]
    points = move_points(T, choose_pixels(cloud.points, mask).astype(np.float64))
    return PointSet(points, normals, colours, cloud.sigma_z[mask])


def fuse_points(sets: Mapping[str, PointSet]) -> list[tuple[PointSet, np.ndarray]]:
    """Fuse points with normals and sigmas, in one frame: of each scan those at which it is the most
    precise one, moved along their normals to the weighted mean of all scans' surfaces; and the
    number of scans (n,) uint8 that each is a mean of."""
    trees = {name: cKDTree(each.points) for name, each in sets.items()}
    spacing = {name: median_spacing(tree, 5000) for name, tree in trees.items()}
    parts = []
    for i, (name, own) in enumerate(sets.items()):
        assert own.normals is not None and own.sigma_mm is not None
        weight = 1 / own.sigma_mm.astype(np.float64) ** 2
        total, shift = weight.copy(), np.zeros(len(own))
        seen_by, is_best = np.ones(len(own), np.uint8), np.ones(len(own), bool)
        for j, (other, there) in enumerate(sets.items()):
            if other == name:
                continue
            assert there.normals is not None and there.sigma_mm is not None
            reach = 2 * max(spacing[name], spacing[other])
            distance, nearest = trees[other].query(
                own.points, distance_upper_bound=reach, workers=-1
            )
            near = np.flatnonzero(np.isfinite(distance))
            nearest = nearest[near]
            cosine = np.sum(there.normals[nearest] * own.normals[near], axis=1)
            gap = (there.points[nearest] - own.points[near]).astype(np.float64)
            with np.errstate(divide="ignore"):
                height = np.sum(there.normals[nearest] * gap, axis=1) / cosine
            alike = cosine > MIN_NORMAL_COSINE
            if not alike.any():
                continue
            gate = max(6 * robust_sigma(height[alike], about=0.0), 0.25 * reach)
            alike &= np.abs(height) < gate
            near, nearest = near[alike], nearest[alike]
            added = 1 / there.sigma_mm[nearest].astype(np.float64) ** 2
            total[near] += added
            shift[near] += added * height[alike]
            seen_by[near] += 1
            is_best[near] &= (weight[near] > added) | ((weight[near] == added) & (i < j))
        moved = own.points + (shift / total)[:, None] * own.normals
        colours = None if own.colours is None else own.colours[is_best]
        averaged = PointSet(
            moved[is_best], own.normals[is_best], colours, 1 / np.sqrt(total[is_best])
        )
        parts.append((averaged, seen_by[is_best]))
    return parts
