"""Preparation of images for board detection."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.fringe.layout import image_white
from slviewer.geometry.rigid import Floats, Floats32

MIRRORED = (
    "the camera's image of the board is a mirror image",
    "switch off the camera's mirror (selfie) or flip mode, or mirror its images back, and show the"
    " board directly, not in a mirror or from behind",
)
"""Observation and remedy."""
SEARCH_PX = 1600
"""Longest side of the downscaled image for the first search; features are measured in the full
image."""


@dataclass(frozen=True)
class BoardImage:
    """An image prepared for board detection.

    ``grey`` (h, w) uint8: for the search, with stretched contrast if the image is dim; ``deep`` (h,
    w) float32: for sub-pixel refinement, in the image's own grey levels.
    """

    grey: NDArray[np.uint8]
    deep: Floats32

    @classmethod
    def from_image(cls, image: np.ndarray) -> "BoardImage":
        """Convert an image (h, w) or (h, w, 3) RGB, uint8 or uint16; raises InputError for
        others."""
        image = np.asarray(image)
        flat = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if image.dtype not in (np.uint8, np.uint16) or not flat or min(image.shape[:2]) < 32:
            raise InputError(
                f"an image of shape {image.shape} and type {image.dtype} was given",
                "boards are detected in (h, w) or (h, w, 3) images of uint8 or uint16, 32 pixels"
                " and more on each side",
            )
        if image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        bright = max(1.0, float(np.percentile(image[::4, ::4], 99.5)))
        grey = image
        if image.dtype != np.uint8 or bright < 100:
            grey = cv2.convertScaleAbs(image.astype(np.float32), alpha=220 / bright)
        return cls(np.ascontiguousarray(grey), image.astype(np.float32))


def light_advice(grey: NDArray[np.uint8]) -> str:
    """Return advice on exposure and board position for an error message, by the share of saturated
    pixels."""
    saturated = np.mean(grey[::4, ::4] >= image_white(grey))
    advice = "move the board so that all of it is in view, evenly illuminated and in focus"
    if saturated > 0.02:
        return f"lower the exposure ({saturated:.0%} of the image is saturated), or {advice}"
    return advice


def resize_image(image: np.ndarray, factor: float) -> np.ndarray:
    """Resize an image by ``factor``, with area averaging if smaller and cubic interpolation if
    larger."""
    if factor == 1:
        return image
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=interpolation)


def to_full_image(pixels: np.ndarray, factor: float) -> Floats:
    """Convert pixels of an image ``factor`` times as large to those of the full image."""
    return (pixels.astype(float) + 0.5) / factor - 0.5


def flatten_light(grey: NDArray[np.uint8]) -> np.ndarray:
    """Divide an image (h, w) uint8 by the local maximum brightness, so that paper becomes evenly
    white."""
    small = resize_image(grey, 64 / max(grey.shape))
    white = cv2.GaussianBlur(cv2.dilate(small, np.ones((9, 9), np.uint8)), (9, 9), 0)
    white = cv2.resize(white, grey.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.divide(grey, np.maximum(white, 8), scale=230)
