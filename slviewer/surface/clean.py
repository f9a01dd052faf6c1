"""Cleaning of organised clouds: flying pixels at depth edges, grazing pixels, and small or distant
groups."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slviewer.geometry.cubes import occupied_cubes
from slviewer.geometry.vectors import lengths, median_spacing
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.surface.topology import label_connected

STEEPEST = 6.0
"""Largest depth step between neighbours of one surface, over their distance across the viewing
direction (80°)."""
MIN_VIEWING_COSINE = 0.12
"""Least cosine between normal and viewing direction of a measured surface (83°)."""
FAR_SPACINGS = 20.0
FAR_SHARE = 0.005
"""A cluster is excluded where it is more than 20 point spacings away from all others and has less
than 0.5 % of the points."""
LEAST_GROUP = 2e-4
"""Least share of a scan's pixels in a connected group."""


@dataclass(frozen=True)
class ExcludedPixels:
    """Numbers of excluded pixels: ``edges`` (border and depth jumps), ``grazing`` or without a
    normal, in small ``groups``, and in ``far`` clusters."""

    edges: int
    grazing: int
    groups: int
    far: int

    @property
    def total(self) -> int:
        """Number of all excluded pixels."""
        return self.edges + self.grazing + self.groups + self.far


def clean(cloud: Cloud, normals: np.ndarray) -> tuple[np.ndarray, ExcludedPixels]:
    """Select the pixels of a cloud on a surface, (h, w) bool, and count the excluded ones.

    ``normals``: (h, w, 3), towards the camera, NaN where unknown.
    """
    mask = cloud.mask
    inside = mask & ~detect_jumps(cloud.points, cloud.sigma_z)
    # the area of a pixel at the border is covered in part only, half in shadow, or mixed with the
    # background
    inside &= cv2.erode(close_pinholes(inside), np.ones((3, 3), np.uint8), borderValue=1).astype(
        bool
    )
    edges = int(mask.sum() - inside.sum())
    # False for NaN
    facing = inside & (np.abs(viewing_cosines(cloud.points, normals)) > MIN_VIEWING_COSINE)
    grazing = int(inside.sum() - facing.sum())
    grouped = _select_large_groups(facing)
    surface = grouped & ~detect_far_clusters(cloud.points, grouped)
    groups, far = int(facing.sum() - grouped.sum()), int(grouped.sum() - surface.sum())
    return surface, ExcludedPixels(edges, grazing, groups, far)


def viewing_cosines(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(h, w): cosine between normals (h, w, 3) and directions from points (h, w, 3) to the camera
    at the origin."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(-np.einsum("ijk,ijk->ij", points, normals) / lengths(points))


def close_pinholes(mask: np.ndarray) -> np.ndarray:
    """Close gaps of up to four pixels in a mask (h, w) bool; returns (h, w) uint8, 0 or 1."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    return np.asarray(
        cv2.morphologyEx(np.pad(mask, 2).astype(np.uint8), cv2.MORPH_CLOSE, disc)[2:-2, 2:-2]
    )


def detect_jumps(points: np.ndarray, sigma_z: np.ndarray) -> np.ndarray:
    """Detect the pixels (h, w) bool of organised points (h, w, 3) mm on either side of a depth
    jump.

    A jump exceeds ``STEEPEST`` times the neighbours' distance across the viewing direction plus six
    times their noise ``sigma_z`` (h, w) mm, where that is known.
    """
    noise = 6 * np.nan_to_num(sigma_z, nan=0.0, posinf=0.0, neginf=0.0)
    jumps = np.zeros(points.shape[:2], bool)
    if not np.isfinite(points[..., 2]).any():
        return jumps
    for here, there in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = np.abs(points[there] - points[here])
        across = np.hypot(step[..., 0], step[..., 1])
        # on an oblique ray a depth jump moves the point across as well: limit that distance
        is_jump = step[..., 2] > STEEPEST * across.clip(max=2 * np.nanmedian(across)) + np.maximum(
            noise[here], noise[there]
        )
        jumps[here] |= is_jump
        jumps[there] |= is_jump
    return jumps


def detect_far_clusters(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(h, w) bool: of the points (h, w, 3) mm in a ``mask`` (h, w), those in small clusters far
    from all others."""
    far = np.zeros(mask.shape, bool)
    chosen = choose_pixels(points, mask).astype(np.float64)
    if len(chosen) < 2:
        return far
    spacing = median_spacing(cKDTree(chosen, balanced_tree=False, compact_nodes=False), 5000)
    if not spacing > 0:
        return far
    cubes, which = occupied_cubes(chosen, FAR_SPACINGS * spacing)
    pairs = cKDTree(cubes).query_pairs(1.8, output_type="ndarray")  # all 26 neighbours
    cluster = label_connected(pairs, len(cubes))[which]
    far[mask] = (np.bincount(cluster) < FAR_SHARE * len(chosen))[cluster]
    return far


def _select_large_groups(mask: np.ndarray) -> np.ndarray:
    """Select the connected groups of a mask (h, w) bool with at least 20 pixels and a share of
    LEAST_GROUP."""
    least = max(20.0, LEAST_GROUP * np.count_nonzero(mask))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[labels])
