"""Find a board in an image."""

from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import DetectionError, InputError
from slviewer.target.board import Board


@dataclass(frozen=True)
class Detection:
    """``pixels`` (n, 2) float64 px, and ``ids`` (n,) int: which of ``board.points`` each one is."""

    pixels: np.ndarray
    ids: np.ndarray


def detect(board: Board, image: np.ndarray) -> Detection:
    """The board's features in an image (h, w) or (h, w, 3), uint8 or uint16; raises DetectionError."""
    grey = grey_image(image)
    size = board.features
    if board.kind in ("circles", "acircles"):
        kind = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
        parameters = cv2.SimpleBlobDetector_Params()
        parameters.minArea, parameters.maxArea = 12.0, grey.size / (2.0 * len(board.points))
        blobs = cv2.SimpleBlobDetector_create(parameters)
        for flags in (kind | cv2.CALIB_CB_CLUSTERING, kind):
            found, corners = cv2.findCirclesGrid(grey, size, flags=flags, blobDetector=blobs)
            if found:
                break
    elif board.kind == "chessboard":
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE)
    else:
        raise DetectionError("ChArUco boards cannot be detected yet")
    if not found:
        raise DetectionError(f"{board} not found: lower the exposure, or move the board so that all of it is in view")
    return Detection(corners.reshape(-1, 2).astype(float), np.arange(len(board.points)))


def grey_image(image: np.ndarray) -> np.ndarray:
    """(h, w) uint8 of an image (h, w) or (h, w, 3) RGB, uint8 or uint16."""
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise InputError(
            f"an image of shape {image.shape} and type {image.dtype} was given: "
            "boards are found in (h, w) or (h, w, 3) images of uint8 or uint16"
        )
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if image.dtype == np.uint16:
        image = np.uint8(image * (255.0 / max(1, int(image.max()))))
    return image


def board_mask(board: Board, detection: Detection, shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) bool: pixels inside the board's outline, by the homography of the detection."""
    H, _ = cv2.findHomography(board.points[detection.ids][:, :2], detection.pixels)
    corners = cv2.perspectiveTransform(board.outline()[None, :, :2], H)[0]
    mask = np.zeros(shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(corners * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)
