"""Preparation of images for board detection."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.fringe.layout import image_white
from slviewer.geometry.rigid import Floats, Floats32

Box = tuple[int, int, int, int]
MIRRORED = (
    "the camera's image of the board is a mirror image",
    "switch off the camera's mirror (selfie) or flip mode, or mirror its images back, and show the"
    " board directly, not in a mirror or from behind",
)
"""Observation and remedy."""
BAR_SIGMAS, BAR_SHARE = 5.0, 0.99
"""A bar's grey levels lie so many times its noise about their median, or all but so many do."""
EDGE_PX = 4
"""Lines beside a bar within which it ends: compression or a lens blurs its edge."""
STRAIGHT = 0.95
"""Share of a side that differs from the bar beside it: beside a board's margin, half of a
chessboard's squares do not."""
SMALLEST_PX = 32
"""Least side of an image in which boards are detected."""
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
        is_small = min(image.shape[:2]) < SMALLEST_PX
        if image.dtype not in (np.uint8, np.uint16) or not flat or is_small:
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

    def crop(self, box: Box) -> "BoardImage":
        """Return the part in a ``box`` (u0, v0, u1, v1) px."""
        u0, v0, u1, v1 = box
        return BoardImage(np.ascontiguousarray(self.grey[v0:v1, u0:u1]), self.deep[v0:v1, u0:u1])

    @cached_property
    def box(self) -> Box:
        """(u0, v0, u1, v1) px of the image less the bars along its borders: strips of one level but
        for noise, which end at a straight edge."""
        height, width = self.deep.shape
        u0, v0, u1, v1 = 0, 0, width, height
        for _ in range(2):  # bars at two sides may differ in level
            inside = self.deep[v0:v1, u0:u1]
            left, right = _measure_bar(inside.T), _measure_bar(inside.T[::-1])
            top, bottom = _measure_bar(inside), _measure_bar(inside[::-1])
            u0, v0, u1, v1 = u0 + left, v0 + top, u1 - right, v1 - bottom
            if min(u1 - u0, v1 - v0) < SMALLEST_PX:
                return 0, 0, width, height
        return u0, v0, u1, v1


def _measure_bar(lines: np.ndarray) -> int:
    """Return how many of the first ``lines`` (n, length) of an image are a bar."""
    outer = lines[:2].astype(float)
    level, steps = np.median(outer), np.diff(outer, axis=1)
    noise = float(np.std(outer))
    # what is not noise differs less between neighbours than it does along the line
    if noise > 0 and np.mean(steps**2) < noise**2:
        return 0
    reach = max(1.0, BAR_SIGMAS * noise)
    for k in range(len(lines)):
        if np.mean(np.abs(lines[k] - level) <= reach) < BAR_SHARE:
            edge = np.abs(lines[k : k + EDGE_PX] - level) > reach
            return k if k and edge.mean(axis=1).max() > STRAIGHT else 0
    return 0


def light_advice(grey: NDArray[np.uint8]) -> str:
    """Return advice on exposure and board position for an error message, by the share of saturated
    pixels."""
    saturated = np.mean(grey[::4, ::4] >= image_white(grey))
    advice = (
        "uncover the board, and move it so that all of it is in view, evenly illuminated and in"
        " focus"
    )
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
