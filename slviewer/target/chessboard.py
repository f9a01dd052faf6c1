"""Detect the inner corners of a chessboard."""

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.errors import DetectionError
from slviewer.target.board import Board
from slviewer.target.images import (
    SEARCH_PX,
    BoardImage,
    flatten_light,
    light_advice,
    resize_image,
    to_full_image,
)
from slviewer.target.numbering import check_grid, select_upright
from slviewer.target.saddle import refine_corners


def detect_chessboard(board: Board, image: BoardImage) -> NDArray[np.float64]:
    """Detect every inner corner: (n, 2) float64 px in the order of ``board.points``.

    Raises DetectionError, whose message gives the number of corners detected.
    A board whose columns + rows are odd is numbered so that its top-left square is dark.
    """
    first_error: DetectionError | None = None
    for detect in (_detect_by_sectors, _detect_in_largest, _detect_by_squares):
        grid = detect(board, image.grey)
        if grid is not None:
            try:
                return _verify_grid(board, image, grid)
            except DetectionError as error:
                first_error = first_error or error
    raise (
        DetectionError(_failure_message(board, image.grey))
        if first_error is None or _shows_larger_chessboard(board, image.grey)
        else first_error
    )


def _verify_grid(board: Board, image: BoardImage, grid: np.ndarray) -> np.ndarray:
    """Refine and number a grid (rows, columns, 2) px of any orientation; returns the corners (n, 2)
    px.

    Raises DetectionError where a corner cannot be measured or the grid is not the board's.
    """
    # the detectors' own order may be mirrored; only the neighbourhood relation is used
    if _grid_orientation(grid) < 0:
        grid = grid[:, ::-1]
    pixels, good = refine_corners(
        image.deep, grid.reshape(-1, 2), board.points[:, :2], board.pitch_mm
    )
    if not good.all():
        raise DetectionError(
            f"{np.count_nonzero(~good)} of {len(good)} corners are covered or blurred beyond"
            " measuring: uncover the board, focus the camera, and avoid reflections"
        )
    check_grid(board, pixels, np.arange(len(pixels)), "corners")
    grid = pixels.reshape(grid.shape)
    first_is_dark = _is_first_square_dark(image.deep, grid)
    _refuse_larger(board, image.deep, grid)
    numberings = _list_numberings(np.arange(len(pixels)).reshape(grid.shape[:2]), first_is_dark)
    return np.asarray(pixels[select_upright(board, pixels, numberings)])


def _detect_by_sectors(board: Board, grey: np.ndarray) -> np.ndarray | None:
    """Detect a grid (rows, columns, 2) px, good to a pixel or two, by OpenCV's sector-based search,
    or None."""
    full = min(1.0, SEARCH_PX / max(grey.shape))
    even = flatten_light(grey)
    thorough = cv2.CALIB_CB_EXHAUSTIVE
    for source, factor, flags in (
        (even, full / 2, 0),
        (grey, full / 2, 0),
        (even, full / 2, thorough),
        (even, full, thorough),
        (grey, full, 0),
    ):
        success, corners = cv2.findChessboardCornersSB(
            resize_image(source, factor), board.features, flags=flags
        )
        if success:
            return to_full_image(corners, factor).reshape(board.rows, board.columns, 2)
    return None


def _detect_largest(grey: np.ndarray) -> np.ndarray | None:
    """Detect the largest grid of corners (rows, columns, 2) px of any chessboard; None below
    3x3."""
    factor = min(1.0, SEARCH_PX / max(grey.shape)) / 2
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    flattened = resize_image(flatten_light(grey), factor)
    success, corners, cells = cv2.findChessboardCornersSBWithMeta(flattened, (3, 3), flags)
    return to_full_image(corners, factor).reshape(*cells.shape[:2], 2) if success else None


def _detect_in_largest(board: Board, grey: np.ndarray) -> np.ndarray | None:
    """Detect the largest grid (rows, columns, 2) px, along the board's rows; None unless it has the
    board's size."""
    largest = _detect_largest(grey)
    if largest is None or sorted(largest.shape[:2]) != sorted(board.features):
        return None
    return largest if largest.shape[0] == board.rows else largest.transpose(1, 0, 2)


def _shows_larger_chessboard(board: Board, grey: np.ndarray) -> bool:
    """Return whether the image shows a chessboard with more corners than the board."""
    largest = _detect_largest(grey)
    return largest is not None and largest[..., 0].size > len(board.points)


def _detect_by_squares(board: Board, grey: np.ndarray) -> np.ndarray | None:
    """Detect a grid (rows, columns, 2) px by OpenCV's older search, from square to square, or
    None."""
    factor = min(1.0, SEARCH_PX / max(grey.shape)) / 2
    success, corners = cv2.findChessboardCorners(resize_image(grey, factor), board.features)
    return to_full_image(corners, factor).reshape(board.rows, board.columns, 2) if success else None


def _grid_orientation(grid: np.ndarray) -> float:
    """Return the cross product of the mean steps along rows and columns: positive for a
    right-handed grid (v down)."""
    (a, b), (c, d) = (np.diff(grid, axis=axis).mean((0, 1)) for axis in (1, 0))
    return float(a * d - b * c)


def _failure_message(board: Board, grey: np.ndarray) -> str:
    """Return the error message: the largest chessboard detected, if any, and what to do."""
    largest = _detect_largest(grey)
    if largest is None:
        return (
            f"no chessboard detected where {board} has {len(board.points)} corners:"
            f" {light_advice(grey)}"
        )
    rows, columns = largest.shape[:2]
    if rows * columns <= len(board.points):
        count = (
            f"{rows * columns} of {len(board.points)} corners of {board} detected"
            f" ({columns}x{rows})"
        )
        return f"{count}: {light_advice(grey)}"
    return (
        f"a chessboard of {columns}x{rows} inner corners detected, {board} expected: check its"
        " columns and rows"
    )


def _is_first_square_dark(image: np.ndarray, grid: np.ndarray) -> bool:
    """Return whether the square outside the first corner is dark.

    Raises DetectionError where dark and bright squares do not alternate.
    """
    colours = corner_polarity(image, grid, np.gradient(grid, axis=1), np.gradient(grid, axis=0))
    rows, columns = colours.shape
    colours = colours * np.where(np.indices(colours.shape).sum(0) % 2, -1, 1)
    good = max(np.count_nonzero(colours > 0), np.count_nonzero(colours < 0))
    if good < rows * columns:
        raise DetectionError(
            f"at {rows * columns - good} of {rows * columns} corners no dark and bright squares"
            " alternate: move the board so that all of it is in view, uncovered and without"
            " reflections"
        )
    return bool(colours[0, 0] > 0)


def _refuse_larger(board: Board, image: np.ndarray, grid: np.ndarray) -> None:
    """Raise DetectionError where the squares continue outside the grid, which may then be shifted
    by a row."""
    for side in range(4):
        rotated = np.rot90(grid, side)
        outside = 3 * rotated[0] - 3 * rotated[1] + rotated[2]
        polarity = corner_polarity(
            image, outside, np.gradient(outside, axis=0), rotated[0] - outside
        )
        if (
            np.count_nonzero(polarity) > 0.5 * len(polarity)
            and (np.diff(polarity[polarity != 0]) != 0).mean() > 0.5
        ):
            raise DetectionError(
                f"the chessboard goes on beyond the {board.columns}x{board.rows} inner corners of"
                f" {board}: check the board's columns and rows"
            )


def _list_numberings(order: np.ndarray, first_is_dark: bool) -> list[np.ndarray]:
    """Return the flattened rotations of the corners' ``order`` (rows, columns) that the squares'
    colours allow."""
    rows, columns = order.shape
    dark: list[np.ndarray] = []
    bright: list[np.ndarray] = []
    for turns in range(0, 4, 1 if rows == columns else 2):
        # the square outside the first corner, after the rotation, was the one outside another
        # corner of the grid
        i, j = ((0, 0), (0, columns), (rows, columns), (rows, 0))[turns]
        group = dark if first_is_dark == ((i + j) % 2 == 0) else bright
        group.append(np.rot90(order, turns).ravel())
    return dark or bright


MIN_CONTRAST = 1.12
"""Bright over dark squares around a corner."""


def corner_polarity(
    image: np.ndarray, corners: np.ndarray, across: np.ndarray, down: np.ndarray
) -> np.ndarray:
    """Return (...,) int8: 1 where the square towards -x, -y of a corner is dark, -1 if bright, 0
    where no squares meet.

    ``corners``, ``across``, ``down`` (..., 2) px: the corner, and the steps to the next ones along
    x and y. The two squares on one diagonal must both be brighter than the two on the other. 0 also
    where the image's border is too close.
    """
    offsets = [(-1, -1), (1, 1), (1, -1), (-1, 1)]
    levels = np.stack(
        [_sample_levels(image, corners + 0.3 * (a * across + b * down)) for a, b in offsets]
    )
    main, other = levels[:2], levels[2:]
    with np.errstate(invalid="ignore"):
        dark = main.max(0) * MIN_CONTRAST < other.min(0)
        bright = other.max(0) * MIN_CONTRAST < main.min(0)
    return dark.astype(np.int8) - bright.astype(np.int8)


def _sample_levels(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Sample the grey levels of a slightly blurred image at pixels (..., 2); NaN outside."""
    height, width = image.shape
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2), np.float32)
    levels = cv2.remap(
        cv2.GaussianBlur(image, (3, 3), 0),
        flat[..., 0],
        flat[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = (flat >= 0).all(2) & (flat[..., 0] <= width - 1) & (flat[..., 1] <= height - 1)
    return np.where(inside, levels, np.nan).reshape(pixels.shape[:-1])
