"""The board plane's projector coordinates for every camera pixel; a mask of the pixels that agree with it."""

from dataclasses import dataclass

import cv2
import numpy as np

MIN_FEATURES = 12
"""Nine unknowns, and some features more."""
OUTLIER_SIGMAS = 6.0
"""Features beyond so many robust sigma were not read on the board."""
MIN_TOLERANCE_PX = 1.0
TOLERANCE_RATIO = 4.0
"""How far from the plane a pixel may be read: this, and so many times what its farthest feature strays. Beyond the
outermost features, lenses bend the plane several times as much as between them."""


@dataclass(frozen=True)
class BoardPlane:
    """A homography from the camera to the projector, after the division model x / (1 + bend r^2) of the camera's lens.

    ``centre`` px and ``radius`` px normalise camera pixels; ``reach`` (2,) px is how far along x and y a pixel of the
    board may lie from what this predicts.
    """

    H: np.ndarray
    bend: float
    centre: np.ndarray
    radius: float
    reach: np.ndarray

    @classmethod
    def fit(cls, camera: np.ndarray, projector: np.ndarray, size: tuple[int, int]) -> "BoardPlane | None":
        """The plane of features at ``camera`` and ``projector`` pixels, (n, 2) each, in a camera of ``size``.

        Unread features (NaN) and outliers are excluded. None where too few remain.
        """
        centre, radius = (np.array(size) - 1) / 2, float(np.hypot(*size)) / 2
        kept = np.isfinite(projector).all(1) & np.isfinite(camera).all(1)
        found = None
        for _ in range(5):
            if np.count_nonzero(kept) < MIN_FEATURES:
                return None
            found = cls._fit(camera[kept], projector[kept], centre, radius)
            if found is None:
                return None
            strays = np.linalg.norm(found.predict(camera[:, 0], camera[:, 1]) - projector, axis=1)
            before = kept
            kept = strays < np.maximum(OUTLIER_SIGMAS * np.median(strays[kept]) / 1.1774, 0.5)
            if np.array_equal(kept, before):
                break
        return found

    @classmethod
    def _fit(cls, camera: np.ndarray, projector: np.ndarray, centre: np.ndarray, radius: float) -> "BoardPlane | None":
        bends, step = np.linspace(-0.5, 0.3, 9), 0.1
        best: tuple[float, BoardPlane] | None = None
        for _ in range(3):
            for bend in bends:
                H, _ = cv2.findHomography(_undistort_division((camera - centre) / radius, bend), projector)
                if H is None:
                    continue
                plane = cls(H, float(bend), centre, radius, np.zeros(2))
                strays = plane.predict(camera[:, 0], camera[:, 1]) - projector
                rms = float(np.sqrt(np.mean(strays**2)))
                if best is None or rms < best[0]:
                    best = (
                        rms,
                        cls(H, float(bend), centre, radius, MIN_TOLERANCE_PX + TOLERANCE_RATIO * np.abs(strays).max(0)),
                    )
            if best is None:
                return None
            bends = best[1].bend + np.linspace(-step, step, 7)
            step /= 3
        return best[1] if best else None

    def predict(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(..., 2) px in the projector of the plane at camera pixels (u, v), which broadcast."""
        x, y = (u - self.centre[0]) / self.radius, (v - self.centre[1]) / self.radius
        scale = 1 + self.bend * (x * x + y * y)
        a, b, w = (h[0] * x + h[1] * y + h[2] * scale for h in self.H)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([a / w, b / w], axis=-1)

    def contains(self, coordinate: np.ndarray, along: int, origin: tuple[int, int]) -> np.ndarray:
        """(h', w') bool: which projector coordinates, at camera pixels from ``origin`` = (u0, v0), lie near the plane.

        ``along`` 0: coordinates are columns; 1: rows. False for NaN.
        """
        height, width = coordinate.shape
        expected = self.predict(np.arange(width)[None] + origin[0], np.arange(height)[:, None] + origin[1])
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(coordinate - expected[..., along]) < self.reach[along])


def _undistort_division(normalised: np.ndarray, bend: float) -> np.ndarray:
    return normalised / (1 + bend * np.sum(normalised**2, axis=1, keepdims=True))
