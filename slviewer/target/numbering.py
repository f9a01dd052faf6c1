"""Orientation of a board's numbering, and the check that the numbered grid is the image of a flat
board.

Without a mark (``slviewer.target.mark``), a board that looks the same turned by 180 degrees
(symmetric circles, asymmetric circles with an even number of rows, chessboards whose columns + rows
are even) is numbered with its x axis to the right in the image: of the two numberings, the one
whose x axis points more along (2, 1) px, right and a little down. So an upright board counts from
its top-left feature, a board whose rows run vertically counts from the top right, and neither
changes when the board rolls by 60 degrees clockwise or 25 degrees the other way. A board that looks
the same turned by 90 degrees takes, of its four numberings, the one whose x axis points most to the
right.
"""

import numpy as np

from slviewer.errors import DetectionError
from slviewer.geometry.rigid import Floats
from slviewer.target.board import Board
from slviewer.target.planar import fit_grid_map, fit_homography, jacobians, to_image

MAX_GRID_OFFSET = 0.08
"""Largest distance, in pitches, of a feature from the grid fitted to all features."""
MAX_GRID_OFFSET_SIGMAS = 8.0
"""The same in robust standard deviations; hand-held paper boards reach 6."""
MAX_BEND = 0.6
"""Largest distance, in pitches, by which a lens may distort the grid."""


def select_upright(board: Board, pixels: Floats, numberings: list[np.ndarray]) -> np.ndarray:
    """Select one of several valid numberings, (n,) indices into ``pixels`` (m, 2), by the rule of
    this module."""
    preferred = np.array([1.0, 0.0] if len(numberings) == 4 else [2.0, 1.0])
    return max(numberings, key=lambda order: float(x_direction(board, pixels[order]) @ preferred))


def x_direction(board: Board, pixels: Floats) -> Floats:
    """Return the mean direction (2,) of the board's x axis in the image, a unit vector."""
    x = board.points[:, 0] - board.points[:, 0].mean()
    direction = x @ (pixels - pixels.mean(0))
    return np.asarray(direction / np.linalg.norm(direction))


def check_grid(board: Board, pixels: Floats, ids: np.ndarray, what: str) -> None:
    """Raise DetectionError unless features at ``pixels`` (n, 2) are the image of a flat board
    through a real lens.

    ``ids`` (n,): indices into the board's points; ``what``: the features' name in messages. The
    pixels must agree with a homography and a smooth distortion (``planar.GridMap``), and the
    numbering must be right-handed.
    """
    advice = "keep the board flat and in focus, without reflections, and take the pose again"
    points = board.points[ids][:, :2] / board.pitch_mm
    H = fit_homography(points, pixels)
    areas = np.linalg.det(jacobians(H, points))
    if areas.max() <= 0:
        raise DetectionError(
            f"the {what} appear mirrored: point the camera at the board, not at a mirror"
        )
    pitch = np.sqrt(np.maximum(areas, 1e-9))
    if (np.linalg.norm(pixels - to_image(H, points), axis=1) > MAX_BEND * pitch).any():
        raise DetectionError(f"the {what} detected do not lie on a flat grid: {advice}")
    fitted = fit_grid_map(points, pixels)
    off = np.linalg.norm(fitted.residuals, axis=1)
    limit = MAX_GRID_OFFSET_SIGMAS * fitted.sigma_px
    wrong = off > np.clip(
        limit, np.maximum(0.3, 0.01 * pitch), np.maximum(0.5, MAX_GRID_OFFSET * pitch)
    )
    if wrong.any():
        worst = int(np.argmax(off / pitch))
        u, v = pixels[worst]
        raise DetectionError(
            f"{np.count_nonzero(wrong)} of {len(ids)} {what} do not fit the grid "
            f"(the worst, at pixel {u:.0f}, {v:.0f}, is {off[worst]:.1f} px off): {advice}"
        )
