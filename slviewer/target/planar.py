"""The homography between a flat board and its image, and a polynomial model of the lens
distortion; orientation of a board's numbering, and the check that a numbered grid is the image of a
flat board.

Without a mark (``slviewer.target.mark``), a board that looks the same turned by 180 degrees
(symmetric circles, asymmetric circles with an even number of rows, chessboards whose columns + rows
are even) is numbered with its x axis to the right in the image: of the two numberings, the one
whose x axis points more along (2, 1) px, right and a little down. So an upright board counts from
its top-left feature, a board whose rows run vertically counts from the top right, and neither
changes when the board rolls by 60 degrees clockwise or 25 degrees the other way. A board that looks
the same turned by 90 degrees takes, of its four numberings, the one whose x axis points most to the
right.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import DetectionError
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import lengths
from slviewer.target.board import Board

HUBER_SIGMAS = 3.0
"""Residuals beyond so many robust standard deviations are down-weighted in the fit of a grid's
map."""
MAX_GRID_OFFSET = 0.08
"""Largest distance, in pitches, of a feature from the grid fitted to all features."""
MAX_GRID_OFFSET_SIGMAS = 8.0
"""The same in robust standard deviations; hand-held paper boards reach 6."""
MAX_BEND = 0.6
"""Largest distance, in pitches, by which a lens may distort the grid."""


def fit_homography(points: Floats, pixels: Floats, robust: bool = False) -> Floats:
    """Fit the homography (3, 3) float64 from points (n, 2) mm to pixels (n, 2), with positive depth
    on the board.

    By least squares; ``robust``: by least median of squares, with up to half outliers. Raises
    DetectionError where the points do not determine one.
    """
    H = None
    if len(points) >= 4:
        H, _ = cv2.findHomography(points, pixels, cv2.LMEDS if robust else 0)
    if H is None or abs(np.linalg.det(H)) < 1e-12:
        raise DetectionError(
            f"the {len(points)} detected features lie on one line",
            "turn the board towards the camera",
        )
    return H * np.sign(points.mean(0) @ H[2, :2] + H[2, 2])


def to_image(H: Floats, points: Floats) -> Floats:
    """Project points (n, 2) mm to pixels (n, 2) by a homography (3, 3)."""
    return (points @ H[:2, :2].T + H[:2, 2]) / (points @ H[2, :2] + H[2, 2])[:, None]


def jacobians(H: Floats, points: Floats) -> Floats:
    """Return the Jacobians (n, 2, 2) px per mm of a homography (3, 3) at points (n, 2) mm."""
    w = points @ H[2, :2] + H[2, 2]
    return (H[:2, :2] - to_image(H, points)[:, :, None] * H[2, :2]) / w[:, None, None]


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

    def extrapolate(self, points: Floats) -> Floats:
        """Map as ``to_image`` does, with the distortion of the nearest place within the features'
        rectangle: a polynomial ends there."""
        near = np.clip(points, self.low, self.low + self.span)
        return to_image(self.H, points) + self.to_image(near) - to_image(self.H, near)

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
        weighted = terms * weight[:, None], bent * weight[:, None]
        coefficients, *_ = np.linalg.lstsq(*weighted, rcond=None)
        residuals = bent - terms @ coefficients
        off = lengths(residuals)
        sigma = 1.26 * float(np.median(off))  # of two coordinates, robustly
        weight = np.sqrt(np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(off, 1e-9)))
    return GridMap(H, low, span, degree, coefficients, residuals, sigma)


def is_on_grid(grid_map: GridMap, pitch: Floats) -> Mask:
    """Return whether each feature that a map was fitted to is as close to it as the others are,
    ``pitch`` (n,) px."""
    limit = MAX_GRID_OFFSET_SIGMAS * grid_map.sigma_px
    most = np.clip(limit, np.maximum(0.3, 0.01 * pitch), np.maximum(0.5, MAX_GRID_OFFSET * pitch))
    return np.asarray(lengths(grid_map.residuals) <= most)


def select_upright(board: Board, pixels: Floats, numberings: list[np.ndarray]) -> np.ndarray:
    """Select one of several valid numberings, (n,) indices into ``pixels`` (m, 2) and -1 for hidden
    features, by the rule of this module."""
    preferred = np.array([1.0, 0.0] if len(numberings) == 4 else [2.0, 1.0])

    def agreement(order: np.ndarray) -> float:
        """Return how far the x axis of a numbering points in the preferred direction."""
        seen = order >= 0
        return float(x_direction(board.points[seen], pixels[order[seen]]) @ preferred)

    return max(numberings, key=agreement)


def x_direction(points: Floats, pixels: Floats) -> Floats:
    """Return the mean direction (2,) of the board's x axis in the image, a unit vector, by features
    at ``points`` (n, 2 or 3) of the board and ``pixels`` (n, 2)."""
    x = points[:, 0]
    direction = (x - x.mean()) @ (pixels - pixels.mean(0))
    return direction / np.linalg.norm(direction)


def check_grid(board: Board, pixels: Floats, ids: np.ndarray, what: str) -> None:
    """Raise DetectionError unless features at ``pixels`` (n, 2) are the image of a flat board
    through a real lens.

    ``ids`` (n,): indices into the board's points; ``what``: the features' name in messages. The
    pixels must agree with a homography and a smooth distortion (``planar.GridMap``), and the
    numbering must be right-handed.
    """
    advice = (
        "keep the board flat and in focus, without reflections, and take the pose again; a fisheye"
        " lens bends every board so: use one that keeps lines nearly straight"
    )
    points = board.nodes[ids]
    fitted = fit_grid_map(points, pixels)
    areas = np.linalg.det(jacobians(fitted.H, points))
    if areas.max() <= 0:
        raise DetectionError(
            f"the {what} appear mirrored", "point the camera at the board, not at a mirror"
        )
    pitch = np.sqrt(np.maximum(areas, 1e-9))
    if (lengths(pixels - to_image(fitted.H, points)) > MAX_BEND * pitch).any():
        raise DetectionError(f"the {what} detected do not lie on a flat grid", advice)
    off, wrong = lengths(fitted.residuals), ~is_on_grid(fitted, pitch)
    if wrong.any():
        worst = int(np.argmax(off / pitch))
        u, v = pixels[worst]
        raise DetectionError(
            f"{np.count_nonzero(wrong)} of {len(ids)} {what} do not fit the grid (the worst, at"
            f" pixel {u:.0f}, {v:.0f}, is {off[worst]:.1f} px off)",
            advice,
        )
