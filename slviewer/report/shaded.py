"""A small renderer of point clouds: splats into a depth buffer, lit by their normals, with outlines from the depths.

Two passes over the points: the nearest depth of each image pixel, then the weighted mean of all splats close behind it,
so that noise in depth does not decide the colour from point to point.
"""

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import kernel

SUPERSAMPLING = 1.5
LIGHT = np.array([-0.45, -0.36, -0.82]) / np.linalg.norm([-0.45, -0.36, -0.82])
"""Towards the light, in the view's frame (x right, y down, z away): from above, left of the viewer."""
AMBIENT = 0.34
OUTLINE = 0.9
BACKGROUND = (246, 248, 250)


def view_rotation(yaw_deg: float, pitch_deg: float) -> np.ndarray:
    """(3, 3) turning camera-frame points into the view's frame: the viewer steps aside by yaw and up by pitch."""
    a, b = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return tilt @ turn


def render_points(
    points: np.ndarray,
    normals: np.ndarray,
    colours: np.ndarray,
    size: tuple[int, int],
    rotation: np.ndarray,
) -> np.ndarray:
    """(height, width, 3) uint8: an orthographic view of points (n, 3) that fills ``size`` = (width, height).

    ``normals`` (n, 3) NaN where unknown; ``colours`` (n, 3) 0 to 1. Points that are not finite are left
    out.
    """
    if points.shape != normals.shape or points.shape != colours.shape or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"points {points.shape}, normals {normals.shape} and colours {colours.shape} make no view: "
            "(n, 3) each is needed"
        )
    width, height = (round(SUPERSAMPLING * side) for side in size)
    known = np.isfinite(points).all(axis=1)
    if known.sum() < 3:
        return np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
    view = (points[known] @ rotation.T).astype(np.float32)
    shade = _shade(normals[known] @ rotation.T)
    illuminated = (np.clip(colours[known] * shade[:, :1] + shade[:, 1:], 0, 1)).astype(np.float32)

    low, high = np.percentile(view[:: max(1, len(view) // 50_000)], [0.3, 99.7], axis=0)
    scale = 0.92 * float(min(width / max(high[0] - low[0], 1e-6), height / max(high[1] - low[1], 1e-6)))
    middle = (low + high) / 2
    uv = (view[:, :2] - middle[:2]).astype(np.float32) * scale + np.array([width / 2, height / 2], np.float32)
    radius = _splat_radius(uv, (width, height))
    depth = np.full((height, width), np.inf, np.float32)
    blended = np.zeros((height, width, 4), np.float32)
    thickness = np.float32(2.5 * radius / scale)
    _splat(uv, view[:, 2], illuminated, np.float32(radius), thickness, depth, blended)

    weight = blended[..., 3:]
    background = np.array(BACKGROUND, np.float32) / 255
    image = blended[..., :3] / np.maximum(weight, 1e-9) + (weight == 0) * background
    image *= _outlines(depth, float(high[2] - low[2]))[..., None]
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return (255 * np.clip(small, 0, 1) + 0.5).astype(np.uint8)


def _shade(normals: np.ndarray) -> np.ndarray:
    """(n, 2): Lambert's factor with some ambient light, and a soft highlight to add."""
    unknown = ~np.isfinite(normals).all(axis=1)
    normals = np.where(unknown[:, None], [0.0, 0.0, -1.0], normals)
    lambert = np.clip(normals @ LIGHT, 0, 1)
    half = LIGHT + np.array([0.0, 0.0, -1.0])
    highlight = 0.16 * np.clip(normals @ (half / np.linalg.norm(half)), 0, 1) ** 30
    return np.stack([AMBIENT + (1.08 - AMBIENT) * lambert, np.where(unknown, 0, highlight)], axis=1)


def _splat_radius(uv: np.ndarray, size: tuple[int, int]) -> float:
    """Image pixels: the points' own spacing on the image, from how many share the cells that they cover."""
    cell = 16
    columns = -(-size[0] // cell)
    at = (uv // cell).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < columns) & (uv[:, 1] < size[1])
    counts = np.bincount(at[inside, 1] * columns + at[inside, 0])
    dense = counts[counts >= max(2, 0.25 * np.median(counts[counts > 0]))] if (counts > 0).any() else counts
    if not dense.size:
        return 2.0
    spacing = cell / np.sqrt(float(np.percentile(dense, 25)))
    return float(np.clip(1.15 * spacing, 1.0, 9.0))


@kernel()
def _splat(uv, depths, colours, radius, thickness, depth, blended):
    height, width = depth.shape
    reach = int(np.ceil(radius))
    limit = (radius + 0.5) ** 2
    for weigh in (False, True):
        for i in range(len(uv)):
            u, v, z = uv[i, 0], uv[i, 1], depths[i]
            column, row = int(np.floor(u)), int(np.floor(v))
            if column < -reach or row < -reach or column >= width + reach or row >= height + reach:
                continue
            for y in range(max(row - reach, 0), min(row + reach + 1, height)):
                for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                    away = (x + 0.5 - u) ** 2 + (y + 0.5 - v) ** 2
                    if away > limit:
                        continue
                    if not weigh:
                        depth[y, x] = min(depth[y, x], z)
                    elif z <= depth[y, x] + thickness:
                        w = np.exp(-2.0 * away / limit)
                        for k in range(3):
                            blended[y, x, k] += w * colours[i, k]
                        blended[y, x, 3] += w


def _outlines(depth: np.ndarray, extent: float) -> np.ndarray:
    """(h, w) factor 0 to 1 that darkens what lies just behind a nearer neighbour (eye-dome lighting)."""
    far = np.where(np.isfinite(depth), depth, np.nanmax(np.where(np.isfinite(depth), depth, np.nan)) + 0.1 * extent)
    padded = np.pad(far, 3, mode="edge")
    h, w = depth.shape
    drop = np.zeros_like(far)
    for dy, dx in ((0, 2), (0, -2), (2, 0), (-2, 0), (2, 2), (2, -2), (-2, 2), (-2, -2)):
        nearer = far - padded[3 + dy : 3 + dy + h, 3 + dx : 3 + dx + w]
        drop += np.clip(nearer / (0.02 * extent + 1e-9), 0, 1)
    factor = np.exp(-OUTLINE * drop / 8)
    return np.where(np.isfinite(depth), factor, np.maximum(factor, 0.93))
