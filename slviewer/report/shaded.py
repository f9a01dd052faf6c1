"""Renderer of point clouds: a depth buffer, and the mean colour of the front points, shaded by
their normals."""

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError

LIGHT = np.array([-0.45, -0.36, -0.82]) / np.linalg.norm([-0.45, -0.36, -0.82])
"""Towards the light, in the view's frame (x right, y down, z away): from above, left of the
viewer."""
AMBIENT = 0.34
BACKGROUND = (246, 248, 250)


def view_rotation(yaw_deg: float, pitch_deg: float) -> NDArray[np.float64]:
    """(3, 3) rotation of camera-frame points into the view's frame: the viewer steps aside by yaw
    and up by pitch."""
    turn, tilt = (
        cv2.Rodrigues(np.radians([0, yaw_deg, 0]))[0].T,
        cv2.Rodrigues(np.radians([pitch_deg, 0, 0]))[0],
    )
    return np.asarray(tilt @ turn)


def render_points(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    colours: NDArray[np.floating],
    size: tuple[int, int],
    rotation: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: an orthographic view of points (n, 3) that fills ``size`` = (width,
    height).

    ``normals`` (n, 3) NaN where unknown; ``colours`` (n, 3) 0 to 1. Points that are not finite are
    skipped.
    """
    if (
        points.shape != normals.shape
        or points.shape != colours.shape
        or points.ndim != 2
        or points.shape[1] != 3
    ):
        raise InputError(
            f"points {points.shape}, normals {normals.shape} and colours {colours.shape} make no"
            " view: (n, 3) each is needed"
        )
    width, height = size
    background = np.array(BACKGROUND, np.float32) / 255
    known = np.isfinite(points).all(axis=1)
    if known.sum() < 3:
        return np.full((height, width, 3), BACKGROUND, np.uint8)
    view = points[known] @ rotation.T
    colours = colours[known] * _shade_lambert(normals[known] @ rotation.T)[:, None]
    low, high = np.percentile(view, [0.3, 99.7], axis=0)
    scale = 0.92 * float(
        min(width / max(high[0] - low[0], 1e-6), height / max(high[1] - low[1], 1e-6))
    )
    uv = np.round(
        (view[:, :2] - (low + high)[:2] / 2) * scale + np.array([width / 2, height / 2])
    ).astype(np.intp)
    inside = ((uv >= 0) & (uv < size)).all(axis=1)
    index, z, colours = uv[inside] @ [1, width], view[inside, 2], colours[inside]

    cells = width * height
    depth = np.full(cells, np.inf, np.float32)
    np.minimum.at(depth, index, z)
    # the points' spacing, px: in the area that they cover once gaps of up to 10 px are closed
    occupied = np.isfinite(depth).reshape(height, width).astype(np.uint8)
    covered = int(cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, np.ones((10, 10), np.uint8)).sum())
    sigma = float(np.clip(0.7 * np.sqrt(covered / max(occupied.sum(), 1)), 0.6, 5.0))
    reach = 2 * int(np.ceil(1.5 * sigma)) + 1
    nearest = cv2.erode(depth.reshape(height, width), np.ones((reach, reach), np.uint8)).ravel()
    # behind the front, noise in depth decides nothing
    front = z <= nearest[index] + 2.5 * reach / scale
    layers = [
        np.bincount(index[front], weights, cells)
        for weights in (*colours[front].T, np.ones(front.sum()))
    ]
    summed = np.stack(layers, axis=-1).reshape(height, width, 4).astype(np.float32)
    blurred = cv2.GaussianBlur(summed, (0, 0), sigma)
    weight = blurred[..., 3:]
    image = np.where(
        weight > 0.03 * occupied.sum() / covered,
        blurred[..., :3] / np.maximum(weight, 1e-9),
        background,
    )
    return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)


def _shade_lambert(normals: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n,) factor of Lambert's law with ambient light, for unit normals (n, 3); NaN normals face
    the viewer."""
    facing = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, [0.0, 0.0, -1.0])
    return np.asarray(AMBIENT + (1.08 - AMBIENT) * np.clip(facing @ LIGHT, 0, 1))
