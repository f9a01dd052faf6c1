"""Round blobs in an image: candidates for a board's circles."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.geometry.rigid import Floats
from slviewer.target.images import resize_image

MIN_AREA_PX = 12
"""Smallest area of a blob whose shape can be judged."""
MAX_ELONGATION = 4.0
"""Largest length over width of a circle's image at a usable tilt."""
MIN_ROUNDNESS = 0.88
"""Smallest roundness of a candidate circle."""


@dataclass(frozen=True)
class Blobs:
    """``centres`` (n, 2) px, ``areas`` (n,) px² and ``covariances`` (n, 2, 2) px² of elliptical
    blobs, all darker than their surroundings, or all brighter if ``inverted``."""

    centres: Floats
    areas: Floats
    covariances: Floats
    inverted: bool

    @property
    def roundness(self) -> Floats:
        """(n,) area over that of the ellipse with the same second moments: 1 for ellipses, 0.955
        for rectangles."""
        return self.areas / (4 * np.pi * np.sqrt(np.linalg.det(self.covariances)))

    def select(self, which: np.ndarray) -> "Blobs":
        """Return a subset of the blobs, by index or mask."""
        return Blobs(self.centres[which], self.areas[which], self.covariances[which], self.inverted)

    def rescale(self, scale: Floats) -> "Blobs":
        """Return the blobs in the pixels of an image that is ``scale`` (2,) times as wide and as
        high."""
        centres, areas = (self.centres + 0.5) * scale - 0.5, self.areas * scale.prod()
        return Blobs(centres, areas, self.covariances * np.outer(scale, scale), self.inverted)


def detect_blobs(grey: NDArray[np.uint8], pitch: float, inverted: bool) -> Iterator[Blobs]:
    """Yield the dark blobs of an image (h, w) uint8, or the bright ones if ``inverted``, once per
    threshold.

    ``pitch`` px is the largest distance that neighbouring circles can have. Each attempt compares
    pixels with the middle between the darkest and the brightest of a neighbourhood (or with its
    mean, where reflections spoil the brightest), for neighbourhoods of different sizes: a small one
    follows uneven light, a large one holds large circles.
    """
    image = cv2.GaussianBlur(255 - grey if inverted else grey, (3, 3), 0)
    for binarise in (_threshold_by_extremes, _threshold_by_mean):
        for share in (0.5, 1.0, 0.25, 0.125):
            if share * pitch >= 8:
                yield _select_ellipses(binarise(image, share * pitch), inverted)


def _threshold_by_extremes(image: np.ndarray, window: float) -> np.ndarray:
    """Return (h, w) uint8: 1 where darker than the mean of the neighbourhood's minimum and
    maximum."""
    factor = min(1.0, 16.0 / window)
    small = resize_image(image, factor)
    reach = 2 * round(window * factor / 2) + 1
    kernel = np.ones((reach, reach), np.uint8)
    bright = cv2.blur(cv2.dilate(small, kernel), (reach, reach))
    dark = cv2.blur(cv2.erode(small, kernel), (reach, reach))
    middle = cv2.addWeighted(bright, 0.5, dark, 0.5, 0)
    middle[cv2.subtract(bright, dark) <= np.maximum(8, bright // 10)] = 0
    if factor < 1:
        middle = cv2.resize(middle, image.shape[::-1])
    return np.asarray(image < middle, np.uint8)


def _threshold_by_mean(image: np.ndarray, window: float) -> np.ndarray:
    """Return (h, w) uint8: 1 where darker than the neighbourhood's mean by a twelfth of it and by 4
    grey levels."""
    reach = 2 * round(window * 0.75) + 1
    mean = cv2.blur(image, (reach, reach))
    return np.asarray(image < cv2.subtract(mean, np.maximum(mean // 12, 4)), np.uint8)


def _select_ellipses(mask: np.ndarray, inverted: bool) -> Blobs:
    """Return the blobs of a mask (h, w) uint8 that fill their ellipse and do not touch the image's
    border."""
    height, width = mask.shape
    _, labels, stats, centres = cv2.connectedComponentsWithStats(
        mask, connectivity=4, ltype=cv2.CV_32S
    )
    left, top, across, down, area = stats.T
    plausible = (area >= MIN_AREA_PX) & (area <= height * width / 8)
    plausible &= (
        (area >= 0.25 * across * down)
        & (across <= MAX_ELONGATION * down)
        & (down <= MAX_ELONGATION * across)
    )
    plausible &= (left > 0) & (top > 0) & (left + across < width) & (top + down < height)
    plausible[0] = False
    number = np.cumsum(plausible, dtype=np.int32) - 1
    v, u = np.nonzero(plausible[labels])
    label = labels[v, u]
    du, dv = u - centres[label, 0], v - centres[label, 1]
    label, n = number[label], area[plausible].astype(float)
    count = len(n)
    covariances = np.empty((count, 2, 2))
    # a pixel is a square, not a point
    covariances[:, 0, 0] = np.bincount(label, du * du, count) / n + 1 / 12
    covariances[:, 1, 1] = np.bincount(label, dv * dv, count) / n + 1 / 12
    covariances[:, 0, 1] = covariances[:, 1, 0] = np.bincount(label, du * dv, count) / n
    blobs = Blobs(centres[plausible], n, covariances, inverted)
    return blobs.select(blobs.roundness > MIN_ROUNDNESS)
