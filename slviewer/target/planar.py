"""The homography between a flat board and its image."""

import cv2
import numpy as np

from slviewer.errors import DetectionError


def fit_homography(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(3, 3) float64 from points (n, 2) mm to pixels (n, 2) px by least squares, positive in depth on the board.

    Raises DetectionError where they do not determine one.
    """
    H = cv2.findHomography(points, pixels)[0] if len(points) >= 4 else None
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        raise DetectionError(f"the {len(points)} features found lie on one line: turn the board towards the camera")
    return np.asarray(H * np.sign(points.mean(0) @ H[2, :2] + H[2, 2]))


def to_image(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 2) px of points (n, 2) mm."""
    return np.asarray((points @ H[:2, :2].T + H[:2, 2]) / (points @ H[2, :2] + H[2, 2])[:, None])


def jacobians(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px per mm at points (n, 2) mm."""
    w = points @ H[2, :2] + H[2, 2]
    return np.asarray((H[None, :2, :2] - to_image(H, points)[:, :, None] * H[2, :2]) / w[:, None, None])
