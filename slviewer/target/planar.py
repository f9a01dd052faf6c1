"""The homography between a flat board and its image, and a polynomial model of the lens
distortion."""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import DetectionError
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import Floats

HUBER_SIGMAS = 3.0
"""Residuals beyond so many robust standard deviations are down-weighted in the fit of a grid's
map."""


def fit_homography(points: Floats, pixels: Floats, robust: bool = False) -> Floats:
    """Fit the homography (3, 3) float64 from points (n, 2) mm to pixels (n, 2), with positive depth
    on the board.

    By least squares; ``robust``: by least median of squares, with up to half outliers. Raises
    DetectionError where the points do not determine one.
    """
    H = (
        cv2.findHomography(points, pixels, cv2.LMEDS if robust else 0)[0]
        if len(points) >= 4
        else None
    )
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        raise DetectionError(
            f"the {len(points)} detected features lie on one line: turn the board towards the"
            " camera"
        )
    return np.asarray(H * np.sign(points.mean(0) @ H[2, :2] + H[2, 2]))


def to_image(H: Floats, points: Floats) -> Floats:
    """Project points (n, 2) mm to pixels (n, 2) by a homography (3, 3)."""
    return np.asarray((points @ H[:2, :2].T + H[:2, 2]) / (points @ H[2, :2] + H[2, 2])[:, None])


def jacobians(H: Floats, points: Floats) -> Floats:
    """Return the Jacobians (n, 2, 2) px per mm of a homography (3, 3) at points (n, 2) mm."""
    w = points @ H[2, :2] + H[2, 2]
    return np.asarray(
        (H[None, :2, :2] - to_image(H, points)[:, :, None] * H[2, :2]) / w[:, None, None]
    )


@dataclass(frozen=True)
class GridMap:
    """Map from a flat grid of features to the image: a homography ``H`` from pitches to pixels,
    plus a polynomial in the board's coordinates for the lens distortion.

    ``residuals`` (n, 2) px of the features that it was fitted to, ``sigma_px`` the robust standard
    deviation of their lengths.
    """

    H: Floats
    low: Floats
    span: Floats
    degree: int
    coefficients: np.ndarray
    residuals: Floats
    sigma_px: float

    def to_image(self, points: Floats) -> Floats:
        """Map points (n, 2) in pitches to pixels (n, 2); extrapolates beyond the fitted
        features."""
        scaled = 2 * (points - self.low) / self.span - 1
        return to_image(self.H, points) + monomials(scaled, self.degree) @ self.coefficients

    def pitch_px(self, points: Floats) -> Floats:
        """Return the pitch (n,) px in the image at points (n, 2) in pitches; 0 behind the
        camera."""
        return np.sqrt(np.maximum(np.linalg.det(jacobians(self.H, points)), 0.0))


def fit_grid_map(points: Floats, pixels: Floats, robust: bool = False) -> GridMap:
    """Fit the map from points (n, 2) in pitches to pixels (n, 2): a homography and a cubic
    polynomial.

    ``robust``: with Huber's weights, for up to a third of outliers. Raises DetectionError where the
    features do not determine a map.
    """
    H = fit_homography(points, pixels, robust)
    low, span = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-9)
    degree = 3 if len(points) >= 25 else 1
    terms = monomials(2 * (points - low) / span - 1, degree)
    bent = pixels - to_image(H, points)
    weight = np.ones(len(points))
    for _ in range(8 if robust else 1):
        coefficients = np.linalg.lstsq(terms * weight[:, None], bent * weight[:, None], rcond=None)[
            0
        ]
        residuals = bent - terms @ coefficients
        off = np.linalg.norm(residuals, axis=1)
        sigma = 1.26 * float(np.median(off))  # of two coordinates, robustly
        weight = np.sqrt(np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(off, 1e-9)))
    return GridMap(H, low, span, degree, coefficients, residuals, sigma)
