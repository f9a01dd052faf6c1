"""Whether dark and bright squares meet at a corner."""

import cv2
import numpy as np

LEAST_CONTRAST = 1.12
"""Bright over dark squares around a corner."""


def crossing(image: np.ndarray, corners: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(...,) int8: +1 where the square towards -x, -y of a corner is dark, -1 where bright, 0 where no squares meet.

    ``corners``, ``across``, ``down`` (..., 2) px: the corner, and the steps to the next ones along x and y. The two
    squares on one diagonal must both be brighter than the two on the other. A corner too near the image's border
    to be judged is 0 as well.
    """
    offsets = [(-1, -1), (1, 1), (1, -1), (-1, 1)]
    levels = np.stack([_levels(image, corners + 0.3 * (a * across + b * down)) for a, b in offsets])
    main, other = levels[:2], levels[2:]
    with np.errstate(invalid="ignore"):
        dark = main.max(0) * LEAST_CONTRAST < other.min(0)
        bright = other.max(0) * LEAST_CONTRAST < main.min(0)
    return dark.astype(np.int8) - bright.astype(np.int8)


def _levels(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Grey levels of a slightly blurred image at pixels (..., 2), NaN outside."""
    height, width = image.shape
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), np.float32)
    levels = cv2.remap(
        cv2.GaussianBlur(image, (3, 3), 0),
        flat[..., 0],
        flat[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = (flat >= 0).all(2) & (flat[..., 0] <= width - 1) & (flat[..., 1] <= height - 1)
    return np.where(inside, levels, np.nan).reshape(pixels.shape[:-1])
