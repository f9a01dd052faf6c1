"""The board plane's projector coordinates for every camera pixel; a mask of the pixels that agree
with it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import finite_rows, lengths, rms

MIN_FEATURES = 12
"""Nine unknowns, and some features more."""
OUTLIER_SIGMAS = 6.0
"""Features with a larger residual, in robust sigma, are outliers."""
MIN_TOLERANCE_PX = 1.0
TOLERANCE_RATIO = 4.0
"""Tolerance of a pixel's coordinate: 1 px plus four times the largest residual of a feature. Beyond
the outermost features, lens distortion is several times as large as between them."""


@dataclass(frozen=True)
class BoardPlane:
    """A homography from camera to projector, with the division model x / (1 + bend r^2) of the
    camera's distortion.

    ``centre`` px and ``radius`` px normalise camera pixels; ``reach`` (2,) px: tolerance of the
    projector's x and y coordinate at a pixel of the board.
    """

    H: np.ndarray
    bend: float
    centre: Floats
    radius: float
    reach: Floats

    @classmethod
    def fit(cls, camera: Floats, projector: Floats, size: tuple[int, int]) -> "BoardPlane | None":
        """Fit the plane robustly to features at ``camera`` and ``projector`` pixels (n, 2), NaN
        where unknown.

        ``size``: (width, height) px of the camera. None where fewer than MIN_FEATURES inliers
        remain.
        """
        centre, radius = (np.array(size) - 1) / 2, float(np.hypot(*size)) / 2
        inlier = finite_rows(projector, camera)
        plane = None
        for _ in range(5):
            if np.count_nonzero(inlier) < MIN_FEATURES:
                return None
            plane = cls._fit_inliers(camera[inlier], projector[inlier], centre, radius)
            if plane is None:
                return None
            residual = lengths(plane.predict(camera[:, 0], camera[:, 1]) - projector)
            before, typical = inlier, np.median(residual[inlier])
            inlier = residual < np.maximum(OUTLIER_SIGMAS * typical / 1.1774, 0.5)
            if np.array_equal(inlier, before):
                break
        return plane

    @classmethod
    def _fit_inliers(
        cls, camera: Floats, projector: Floats, centre: Floats, radius: float
    ) -> "BoardPlane | None":
        """Fit the homography for a range of distortions, refined twice, and return the plane with
        the smallest RMS."""
        bends, step = np.linspace(-0.5, 0.3, 9), 0.1
        fits: list[tuple[float, BoardPlane]] = []
        normalised = (camera - centre) / radius
        squares = np.sum(normalised**2, axis=1, keepdims=True)
        for _ in range(3):
            for bend in bends:
                # undistorted by the division model
                H, _ = cv2.findHomography(normalised / (1 + bend * squares), projector)
                if H is None:
                    continue
                plane = cls(H, float(bend), centre, radius, np.zeros(2))
                residuals = plane.predict(camera[:, 0], camera[:, 1]) - projector
                reach = MIN_TOLERANCE_PX + TOLERANCE_RATIO * np.abs(residuals).max(0)
                fits.append((rms(residuals), replace(plane, reach=reach)))
            if not fits:
                return None
            _, best = min(fits, key=lambda fit: fit[0])
            bends = best.bend + np.linspace(-step, step, 7)
            step /= 3
        return best

    def predict(self, u: np.ndarray, v: np.ndarray) -> Floats:
        """Return the plane's projector coordinates (..., 2) px at camera pixels (u, v), which
        broadcast."""
        x, y = (u - self.centre[0]) / self.radius, (v - self.centre[1]) / self.radius
        scale = 1 + self.bend * (x * x + y * y)
        a, b, w = (h[0] * x + h[1] * y + h[2] * scale for h in self.H)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([a / w, b / w], axis=-1)

    def contains(self, coordinate: np.ndarray, along: int, origin: tuple[int, int]) -> Mask:
        """(h', w') bool: projector coordinates (h', w') px within the tolerance of the plane; False
        for NaN.

        ``along``: 0 for columns, 1 for rows; ``origin``: camera pixel (u0, v0) of the first
        coordinate.
        """
        height, width = coordinate.shape
        expected = self.predict(
            np.arange(width)[None] + origin[0], np.arange(height)[:, None] + origin[1]
        )
        with np.errstate(invalid="ignore"):
            return np.abs(coordinate - expected[..., along]) < self.reach[along]
