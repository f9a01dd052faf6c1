"""Kalibr's AprilGrid as a board: `aprilgrid:6x6:88` has 6x6 tags of 36h11, whose black sides are 88
mm long.

Tags are 1.3 sides apart, and numbered from the corner with tag 0. A feature is a corner of a tag.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.plugins import Board, BoardType, DetectionError

SPACING = 0.3
"""Gap between two tags, in sides of a tag."""
_DICTIONARY = cv2.aruco.DICT_APRILTAG_36h11
_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""(column, row) of a tag's corners, in the order in which OpenCV returns them."""


def count_features(board: Board) -> tuple[int, int]:
    """Return (columns, rows) of corners."""
    return 2 * board.columns, 2 * board.rows


def locate_features(board: Board) -> NDArray[np.float64]:
    """Return the corners (n, 3) mm, row by row."""
    columns, rows = count_features(board)
    along = [(k // 2) * (1 + SPACING) + k % 2 for k in range(max(columns, rows))]
    x, y = np.meshgrid(along[:columns], along[:rows])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * board.pitch_mm


def detect_corners(
    board: Board, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], np.ndarray]:
    """Detect the tags in an image (h, w); returns the corners (m, 2) px of those that belong to the
    board, and their indices."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    detected, tags, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    count = board.columns * board.rows
    pixels, ids = [], []
    for corners, tag in zip(detected, [] if tags is None else tags.ravel(), strict=True):
        if tag >= count:
            continue
        row, column = divmod(int(tag), board.columns)
        for (right, down), pixel in zip(_CORNERS, corners.reshape(4, 2), strict=True):
            ids.append((2 * row + down) * 2 * board.columns + 2 * column + right)
            pixels.append(pixel)
    if len(ids) < 4 * 4 and len(ids) < 4 * count:
        raise DetectionError(
            f"{len(ids) // 4} of {count} tags were detected",
            "bring the whole board into view, in focus and evenly lit",
        )
    return np.array(pixels, np.float64), np.array(ids)


BOARD_TYPE = BoardType(
    "aprilgrid",
    what="AprilGrid",
    counts="Tags per row and column; pitch: black side of a tag",
    example="aprilgrid:6x6:88",
    features=count_features,
    points=locate_features,
    detect=detect_corners,
)
