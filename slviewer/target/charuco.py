"""Detect the inner corners of a ChArUco board; its markers identify them, so that a part of the
board is enough."""

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import DetectionError
from slviewer.target.board import Board
from slviewer.target.images import SEARCH_PX, BoardImage, light_advice, resize_image, to_full_image
from slviewer.target.numbering import check_grid
from slviewer.target.saddle import refine_corners

MIN_CORNERS = 8
"""Smallest number of corners of a pose."""
SUFFICIENT_SHARE = 0.8
"""Share of the corners at which the search ends; below it continues at higher resolution."""


def opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return the board as an OpenCV ``CharucoBoard``."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    return cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.pitch_mm, board.marker_mm, dictionary
    )


def detect_charuco(board: Board, image: BoardImage) -> tuple[NDArray[np.float64], np.ndarray]:
    """Detect corners; returns pixels (n, 2) float64 and ids (n,) int. Raises DetectionError for too
    few corners."""
    detector = cv2.aruco.CharucoDetector(opencv_board(board))
    first = min(1.0, SEARCH_PX / max(image.grey.shape))
    best: tuple[np.ndarray, np.ndarray] | None = None
    markers = 0
    for factor in dict.fromkeys((first / 2, first, 1.0)):
        small = resize_image(image.grey, factor)
        corners, ids, _, marker_ids = detector.detectBoard(small)
        markers = max(markers, 0 if marker_ids is None else len(marker_ids))
        if ids is not None and len(ids) and (best is None or len(ids) > len(best[1])):
            best = to_full_image(np.reshape(corners, (-1, 2)), factor), np.ravel(ids).astype(int)
        if best is not None and len(best[1]) >= SUFFICIENT_SHARE * len(board.points):
            break
    if best is not None and len(best[1]) >= MIN_CORNERS:
        pixels, ids = best
        points = board.points[ids][:, :2]
        pixels, good = refine_corners(image.deep, pixels, points, board.pitch_mm, board.marker_mm)
        best = pixels[good], ids[good]
    detected = 0 if best is None else len(best[1])
    if best is None or detected < MIN_CORNERS:
        total_markers = board.columns * board.rows // 2
        raise DetectionError(
            f"{detected} of {len(board.points)} corners and {markers} of {total_markers} markers of"
            f" {board} detected, and a pose needs {MIN_CORNERS}: {light_advice(image.grey)}"
        )
    check_grid(board, *best, "corners")
    return best
