"""What of an organised cloud is no surface: edge pixels that fly between two depths, grazing ones, small groups."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from slviewer.reconstruction.cloud import Cloud

STEEPEST = 6.0
"""Steps between neighbours, in their own distance across the line of sight, from which they are two surfaces (80°)."""
FLATTEST_SIGHT = 0.12
"""The cosine between a surface's normal and the line of sight below which it is not measured, but guessed (83°)."""
FAR_SPACINGS = 20.0
FAR_SHARE = 0.005
"""A cluster that lies so many times the distance of neighbouring points away from all others, and has less than this
share of them, is no part of the object."""
LEAST_GROUP = 2e-4
"""Share of a scan's pixels below which a group without neighbours is no part of the object."""


@dataclass(frozen=True)
class ExcludedPixels:
    """What of a scan is left out, in pixels: at its rim and at depth jumps, seen grazing or without a normal, in small
    groups, far from everything else."""

    edges: int
    grazing: int
    groups: int
    far: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.edges + self.grazing + self.groups + self.far


def clean(cloud: Cloud, normals: np.ndarray) -> tuple[np.ndarray, ExcludedPixels]:
    """(h, w) bool: the pixels of a cloud that lie on a surface, and what was left out.

    ``normals``: (h, w, 3), towards the camera.
    """
    mask = cloud.mask
    kept = mask & ~detect_jumps(cloud.points, cloud.sigma_z)
    # a pixel at the rim sees the surface with a part of its area only, in half a shadow, or with what lies behind
    kept &= cv2.erode(close_pinholes(kept), np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    edges = int(mask.sum() - kept.sum())
    seen = kept & (np.abs(sight_cosines(cloud.points, normals)) > FLATTEST_SIGHT)  # False where the normal is NaN
    grazing = int(kept.sum() - seen.sum())
    large = _large_groups(seen)
    near = large & ~detect_far_clusters(cloud.points, large)
    groups, far = int(seen.sum() - large.sum()), int(large.sum() - near.sum())
    return near, ExcludedPixels(edges, grazing, groups, far)


def sight_cosines(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(h, w) cosine between the normals (h, w, 3) and the lines of sight to points (h, w, 3) in the camera's frame."""
    away = np.linalg.norm(points, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(-np.einsum("ijk,ijk->ij", points, normals) / away)


def close_pinholes(mask: np.ndarray) -> np.ndarray:
    """(h, w) uint8, 0 or 1: the mask with gaps of up to four pixels closed."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    return np.asarray(cv2.morphologyEx(np.pad(mask, 2).astype(np.uint8), cv2.MORPH_CLOSE, disc)[2:-2, 2:-2])


def detect_jumps(points: np.ndarray, sigma_z: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels (h, w, 3) mm whose depth leaps to a neighbour's: there one pixel sees two surfaces.

    A leap is larger than ``STEEPEST`` times the distance of the neighbours across the line of sight and six times their
    noise ``sigma_z`` (h, w) (where it is known) together.
    """
    noise = 6 * np.nan_to_num(sigma_z, nan=0.0, posinf=0.0, neginf=0.0)
    jumps = np.zeros(points.shape[:2], bool)
    if not np.isfinite(points[..., 2]).any():
        return jumps
    for here, there in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = np.abs(points[there] - points[here])
        across = np.hypot(step[..., 0], step[..., 1])
        # along a line of sight that is oblique to the camera's axis, depth itself leads aside
        leap = step[..., 2] > STEEPEST * across.clip(max=2 * np.nanmedian(across)) + np.maximum(
            noise[here], noise[there]
        )
        jumps[here] |= leap
        jumps[there] |= leap
    return jumps


def detect_far_clusters(points: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(h, w) bool: of the points (h, w, 3) mm ``kept`` (h, w), those in small clusters far from everything else."""
    far = np.zeros(kept.shape, bool)
    places = points[kept].astype(np.float64)
    if len(places) < 2:
        return far
    every = places[:: max(1, len(places) // 5000)]
    spacing = float(np.median(cKDTree(places).query(every, k=2)[0][:, 1]))
    if not spacing > 0:
        return far
    cells, which, counts = np.unique(
        np.floor(places / (FAR_SPACINGS * spacing)).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    joined = cKDTree(cells).sparse_distance_matrix(cKDTree(cells), 1.8).tocsr()  # all 26 neighbours
    _, cluster = connected_components(joined, directed=False)
    small = np.bincount(cluster, counts) < FAR_SHARE * len(places)
    far[kept] = small[cluster][which.ravel()]
    return far


def _large_groups(mask: np.ndarray) -> np.ndarray:
    least = max(20.0, LEAST_GROUP * np.count_nonzero(mask))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[labels])
