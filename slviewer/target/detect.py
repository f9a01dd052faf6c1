"""Detect a board in an image, numbered as its points are, or raise an error with the reason."""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import DetectionError, InputError
from slviewer.geometry.rigid import Floats, Mask
from slviewer.target.board import Board
from slviewer.target.circles import detect_circles
from slviewer.target.corners import detect_charuco, detect_chessboard
from slviewer.target.images import BoardImage
from slviewer.target.planar import fit_homography, to_image

_FEWEST = 6
"""Features of a plugin's board that fix its pose with some to spare."""


@dataclass(frozen=True)
class Detection:
    """Detected features: ``pixels`` (n, 2) float64 px, and ``ids`` (n,) int, their indices into
    ``board.points``.

    All features in order for circles and chessboards, the detected ones for ChArUco. A circle's
    pixel is the centroid of its image, which perspective and distortion move away from the image of
    its centre (some hundredths of a pixel; it grows with the square of the radius): ``radius_mm``,
    0 for corners, is there to correct that. ``marked``: the mark beside the first circle was
    detected, so that the numbering is the board's own at any turn.
    """

    pixels: Floats
    ids: np.ndarray
    radius_mm: float = 0.0
    marked: bool = False


def detect(board: Board, image: np.ndarray) -> Detection:
    """Detect a board's features in an image (h, w), or (h, w, 3) RGB, uint8 or uint16.

    The numbering's x axis turns clockwise into its y axis in the image, always. A symmetric board
    is numbered from its mark (``slviewer.target.mark``); where none is detected, the rule of
    ``slviewer.target.planar`` selects the numbering. Raises DetectionError, whose message states
    what was detected and what to do, rather than return a grid with a feature missing, misplaced or
    shifted.
    """
    board_image = BoardImage.from_image(image)
    if board.kind == "charuco":
        pixels, ids = detect_charuco(board, board_image)
        return Detection(pixels, ids)
    if added := board.plugin_type:
        pixels, ids = added.detect(board, board_image.grey)
        return _check_detection(board, pixels, ids)
    ids = np.arange(len(board.points))
    if board.kind == "chessboard":
        return Detection(detect_chessboard(board, board_image), ids)
    pixels, radius, marked = detect_circles(board, board_image)
    return Detection(pixels, ids, radius, marked)


def _check_detection(board: Board, pixels: np.ndarray, ids: np.ndarray) -> Detection:
    """Return what a plugin's detector found. Raises DetectionError where its numbers cannot be
    those of the board."""
    pixels, ids = np.asarray(pixels, np.float64), np.asarray(ids)
    known = len(board.points)
    is_valid = pixels.shape == (len(ids), 2) and np.isfinite(pixels).all()
    if not is_valid or len(np.intersect1d(ids, np.arange(known))) < len(ids):
        raise DetectionError(
            f"the plugin of {board.kind} boards returned features that are not distinct, or not"
            f" among the {known} of the board",
            "report it to its maker",
        )
    if len(ids) < _FEWEST:
        raise DetectionError(
            f"{len(ids)} of {known} features were detected", "show the whole board, evenly lit"
        )
    return Detection(pixels, ids.astype(int))


def board_mask(board: Board, detection: Detection, shape: tuple[int, ...]) -> Mask:
    """Return the mask (h, w) bool of the pixels inside ``board.outline()``, by the homography of
    the detected features.

    ``shape`` is the image's, (h, w) or (h, w, 3).
    """
    if len(detection.ids) < 4:
        raise InputError(
            f"{len(detection.ids)} features do not give a board's outline", "detect at least 4"
        )
    H = fit_homography(board.points[detection.ids][:, :2], detection.pixels)
    corners = to_image(H, board.outline()[:, :2])
    mask = np.zeros(shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(corners * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)
