"""Detect the inner corners of chessboards and of ChArUco boards, whose markers identify them, so
that a part of such a board is enough; and refine them to a fraction of a pixel.

A corner is where two blurred edges cross, fitted to the grey levels around it. The model is
``I = P (1 + kappa E_1 E_2)``: P the plane of the light, kappa the contrast, E_k the blurred step
across edge k. A corner is the point that it is symmetric about, so that neither blur nor uneven
light moves it; gradient-based refinement (OpenCV's ``cornerSubPix``) is off by 0.03 to 0.07 px on
the same images.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import scipy

from slviewer.errors import BoardError, DetectionError
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.geometry.vectors import lengths
from slviewer.target.board import Board
from slviewer.target.images import (
    MIRRORED,
    SEARCH_PX,
    BoardImage,
    flatten_light,
    light_advice,
    resize_image,
    to_full_image,
)
from slviewer.target.planar import check_grid, fit_homography, jacobians, select_upright, to_image

MIN_CORNERS = 8
"""Smallest number of corners of a pose."""
SUFFICIENT_SHARE = 0.8
"""Share of the corners at which the search ends; below it continues at higher resolution."""
MARKER_TOLERANCE = 0.5
"""Largest distance, in squares, of a marker's corner from its place in a layout."""
MIN_MARKER_CORNERS = 8
MIN_CONTRAST = 1.12
"""Bright over dark squares around a corner."""
MAX_HALF_WIDTH_PX = 11
"""Largest half width of a window; farther pixels measure the lens rather than the corner."""
EDGE_SHARE = 0.4
"""Half length, in squares, of a corner's window along the edges."""
MAX_MISFIT = 0.15
MAX_RELATIVE_MISFIT = 3.0
"""Largest RMS misfit of a corner's grey levels: over its contrast, and over the median misfit of
all corners."""
ITERATIONS = 15
CONVERGENCE_PX = 1e-3


def opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return the board as an OpenCV ``CharucoBoard``."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    charuco = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.pitch_mm, board.marker_mm, dictionary
    )
    charuco.setLegacyPattern(board.legacy)
    return charuco


def detect_charuco(board: Board, image: BoardImage) -> tuple[Floats, np.ndarray]:
    """Detect corners; returns pixels (n, 2) float64 and ids (n,) int.

    Raises DetectionError for too few corners, and BoardError for markers in the other layout and
    for a mirror image.
    """
    detector = cv2.aruco.CharucoDetector(opencv_board(board))
    first = min(1.0, SEARCH_PX / max(image.grey.shape))
    pixels, ids = np.empty((0, 2)), np.empty(0, int)
    markers = 0
    for factor in dict.fromkeys((first / 2, first, 1.0)):
        small = resize_image(image.grey, factor)
        corners, numbers, outlines, marker_ids = detector.detectBoard(small)
        markers = max(markers, 0 if marker_ids is None else len(marker_ids))
        _check_layout(board, outlines, marker_ids)
        if numbers is not None and len(numbers) > len(ids):
            pixels = to_full_image(np.reshape(corners, (-1, 2)), factor)
            ids = np.ravel(numbers).astype(int)
        if len(ids) >= SUFFICIENT_SHARE * len(board.points):
            break
    if len(ids) >= MIN_CORNERS:
        points = board.points[ids][:, :2]
        pixels, good = refine_corners(image.deep, pixels, points, board.pitches, board.marker_mm)
        pixels, ids = pixels[good], ids[good]
    if markers < 2:
        mirrored = np.ascontiguousarray(resize_image(image.grey, first / 2)[:, ::-1])
        _, _, outlines, marker_ids = detector.detectBoard(mirrored)
        layouts = (board, replace(board, legacy=not board.legacy))
        if max(_count_fitting(each, outlines, marker_ids) for each in layouts) > MIN_MARKER_CORNERS:
            raise BoardError(*MIRRORED, cause="axis-reversed")
    if len(ids) < MIN_CORNERS:
        total_markers = board.columns * board.rows // 2
        raise DetectionError(
            f"{len(ids)} of {len(board.points)} corners and {markers} of {total_markers} markers of"
            f" {board} detected, and a pose needs {MIN_CORNERS}",
            f"{light_advice(image.grey)}",
        )
    check_grid(board, pixels, ids, "corners")
    return pixels, ids


def _check_layout(
    board: Board, outlines: Sequence[np.ndarray], marker_ids: np.ndarray | None
) -> None:
    """Raise BoardError where the markers, with ``outlines`` (4, 2) px each, are placed as in the
    layout that the board does not have: that before, or that since OpenCV 4.6."""
    other = replace(board, legacy=not board.legacy)
    if other == board:  # alike with an odd number of rows
        return
    count, count_other = (_count_fitting(each, outlines, marker_ids) for each in (board, other))
    if count_other >= max(MIN_MARKER_CORNERS, count + 4):  # a marker more
        raise BoardError(
            f"{count_other} of {4 * len(outlines)} corners of the markers fit {other}, a layout"
            f" {'before' if other.legacy else 'since'} OpenCV 4.6, and {count} fit {board}",
            f"give the board as {other}",
            cause="board-size",
        )


def _count_fitting(
    board: Board, outlines: Sequence[np.ndarray], marker_ids: np.ndarray | None
) -> int:
    """Return how many of the markers' corners, (4, 2) px each, fit their places on the board by one
    homography."""
    places = np.array(opencv_board(board).getObjPoints())[..., :2]
    ids = np.empty(0, int) if marker_ids is None else np.ravel(marker_ids)
    known = np.flatnonzero(ids < len(places))
    if len(known) < 2:
        return 0
    pixels = np.reshape(outlines, (-1, 4, 2))[known].reshape(-1, 2)
    points = places[ids[known]].reshape(-1, 2)
    tolerance = MARKER_TOLERANCE * board.pitch_mm
    H, _ = cv2.findHomography(pixels, points, cv2.RANSAC, tolerance)
    if H is None:
        return 0
    with np.errstate(divide="ignore", invalid="ignore"):
        return int(
            np.count_nonzero(lengths(to_image(np.asarray(H, float), pixels) - points) < tolerance)
        )


def detect_chessboard(board: Board, image: BoardImage) -> Floats:
    """Detect every inner corner: (n, 2) float64 px in the order of ``board.points``.

    Raises DetectionError, whose message gives the number of corners detected.
    A board whose columns + rows are odd is numbered so that its top-left square is dark.
    """
    first_error: DetectionError | None = None
    for grid in _detect_grids(board, image.grey):
        try:
            return _verify_grid(board, image, grid)
        except DetectionError as error:
            first_error = first_error or error
    largest = _detect_largest(image.grey)
    is_larger = largest is not None and largest[..., 0].size > len(board.points)
    if first_error is None or is_larger:
        raise _describe_failure(board, image.grey, largest)
    raise first_error


def _verify_grid(board: Board, image: BoardImage, grid: Floats) -> Floats:
    """Refine and number a grid (rows, columns, 2) px of any orientation; returns the corners (n, 2)
    px.

    Raises DetectionError where a corner cannot be measured or the grid is not the board's.
    """
    # the detectors' own order may be mirrored; only the neighbourhood relation is used
    (a, b), (c, d) = (np.diff(grid, axis=axis).mean((0, 1)) for axis in (1, 0))
    if a * d < b * c:  # v points down
        grid = grid[:, ::-1]
    pixels, good = refine_corners(
        image.deep, grid.reshape(-1, 2), board.points[:, :2], board.pitches
    )
    if not good.all():
        raise DetectionError(
            f"{np.count_nonzero(~good)} of {len(good)} corners are covered or blurred beyond"
            " measuring",
            "uncover the board, focus the camera, and avoid reflections",
        )
    check_grid(board, pixels, np.arange(len(pixels)), "corners")
    grid = pixels.reshape(grid.shape)
    first_is_dark = _is_first_square_dark(image.deep, grid)
    _refuse_larger(board, image.deep, grid)
    numberings = _list_numberings(np.arange(len(pixels)).reshape(grid.shape[:2]), first_is_dark)
    return pixels[select_upright(board, pixels, numberings)]


def _detect_grids(board: Board, grey: np.ndarray) -> Iterator[Floats]:
    """Yield grids (rows, columns, 2) px of the board's size, good to a pixel or two, of any
    orientation, of which the caller takes the first that is right.

    They are those of OpenCV's sector-based search, the largest grid if it has the board's size, and
    that of OpenCV's older search, which links squares by their corners.
    """
    scale, shape = min(1.0, SEARCH_PX / max(grey.shape)), (board.rows, board.columns, 2)
    even = flatten_light(grey)
    thorough = cv2.CALIB_CB_EXHAUSTIVE
    for source, factor, flags in (  # the fastest first
        (even, scale / 2, 0),
        (grey, scale / 2, 0),
        (even, scale / 2, thorough),
        (even, scale, thorough),
        (grey, scale, 0),
    ):
        success, corners = cv2.findChessboardCornersSB(
            resize_image(source, factor), board.features, flags=flags
        )
        if success:
            yield to_full_image(corners, factor).reshape(shape)
            break
    largest = _detect_largest(grey)
    if largest is not None and sorted(largest.shape[:2]) == sorted(board.features):
        yield largest if largest.shape[0] == board.rows else largest.transpose(1, 0, 2)
    success, corners = cv2.findChessboardCorners(resize_image(grey, scale / 2), board.features)
    if success:
        yield to_full_image(corners, scale / 2).reshape(shape)


def _detect_largest(grey: np.ndarray) -> Floats | None:
    """Detect the largest grid of corners (rows, columns, 2) px of any chessboard; None below
    3x3."""
    factor = min(1.0, SEARCH_PX / max(grey.shape)) / 2
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    flattened = resize_image(flatten_light(grey), factor)
    success, corners, cells = cv2.findChessboardCornersSBWithMeta(flattened, (3, 3), flags)
    return to_full_image(corners, factor).reshape(*cells.shape[:2], 2) if success else None


def _describe_failure(board: Board, grey: np.ndarray, largest: Floats | None) -> DetectionError:
    """Return the error: the largest chessboard detected, if any, and what to do."""
    if largest is None:
        return DetectionError(
            f"no chessboard detected where {board} has {len(board.points)} corners",
            light_advice(grey),
        )
    rows, columns = largest.shape[:2]
    if rows * columns <= len(board.points):
        return DetectionError(
            f"{rows * columns} of {len(board.points)} corners of {board} detected"
            f" ({columns}x{rows})",
            light_advice(grey),
        )
    return DetectionError(
        f"a chessboard of {columns}x{rows} inner corners detected, {board} expected",
        "check its columns and rows",
    )


def _is_first_square_dark(image: np.ndarray, grid: Floats) -> bool:
    """Return whether the square outside the first corner is dark.

    Raises DetectionError where dark and bright squares do not alternate.
    """
    colours = corner_polarity(image, grid, np.gradient(grid, axis=1), np.gradient(grid, axis=0))
    colours = colours * np.where(np.indices(colours.shape).sum(0) % 2, -1, 1)
    good = max(np.count_nonzero(colours > 0), np.count_nonzero(colours < 0))
    if good < colours.size:
        raise DetectionError(
            f"at {colours.size - good} of {colours.size} corners no dark and bright squares"
            " alternate",
            "move the board so that all of it is in view, uncovered and without reflections",
        )
    return bool(colours[0, 0] > 0)


def _refuse_larger(board: Board, image: np.ndarray, grid: Floats) -> None:
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
                f" {board}",
                "check the board's columns and rows",
            )


def _list_numberings(order: np.ndarray, first_is_dark: bool) -> list[np.ndarray]:
    """Return the flattened rotations of the corners' ``order`` (rows, columns) that the squares'
    colours allow."""
    rows, columns = order.shape
    turns = range(0, 4, 1 if rows == columns else 2)
    numberings = [np.rot90(order, turn).ravel() for turn in turns]
    # the square outside the first corner, after the rotation, was the one outside another corner
    # of the grid
    squares = [(0, columns, rows + columns, rows)[turn] for turn in turns]
    dark = [
        numbering
        for numbering, square in zip(numberings, squares, strict=True)
        if first_is_dark == (square % 2 == 0)
    ]
    return dark or numberings


def corner_polarity(image: np.ndarray, corners: Floats, across: Floats, down: Floats) -> np.ndarray:
    """Return (...,) int8: 1 where the square towards -x, -y of a corner is dark, -1 if bright, 0
    where no squares meet.

    ``corners``, ``across``, ``down`` (..., 2) px: the corner, and the steps to the next ones along
    x and y. The two squares on one diagonal must both be brighter than the two on the other. 0 also
    where the image's border is too close.
    """
    offsets = [(-1, -1), (1, 1), (1, -1), (-1, 1)]
    places = np.stack([corners + 0.3 * (a * across + b * down) for a, b in offsets])
    height, width = image.shape
    flat = np.ascontiguousarray(places.reshape(-1, 1, 2), np.float32)
    blurred, border = cv2.GaussianBlur(image, (3, 3), 0), cv2.BORDER_REPLICATE
    levels = cv2.remap(blurred, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=border)
    inside = (flat >= 0).all(2) & (flat[..., 0] <= width - 1) & (flat[..., 1] <= height - 1)
    main, other = np.split(np.where(inside, levels, np.nan).reshape(places.shape[:-1]), 2)
    with np.errstate(invalid="ignore"):
        dark = main.max(0) * MIN_CONTRAST < other.min(0)
        bright = other.max(0) * MIN_CONTRAST < main.min(0)
    return dark.astype(np.int8) - bright.astype(np.int8)


def refine_corners(
    image: Floats32,
    pixels: Floats,
    points: Floats,
    pitch: Floats,
    marker: float = 0.0,
) -> tuple[Floats, Mask]:
    """Refine corners; returns sub-pixel positions (n, 2) float64 px and whether each fits the
    model, (n,) bool.

    ``image`` (h, w) float32; ``pixels`` (n, 2) px: initial positions, good to a px or two;
    ``points`` (n, 2) mm: the corners on the board; ``pitch`` (2,) and ``marker``: sides of the
    squares and of the markers in them, mm.
    """
    H = fit_homography(points, pixels)
    to_px = jacobians(H, points) * pitch
    sides = lengths(to_px.transpose(0, 2, 1))
    reach = int(np.clip(round(EDGE_SHARE * float(np.median(sides))), 3, MAX_HALF_WIDTH_PX))
    span = np.arange(-reach, reach + 1)
    middle = np.rint(pixels).astype(int)
    u, v = (middle[:, k, None] + o.ravel() for k, o in enumerate(np.meshgrid(span, span)))
    height, width = image.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    grey = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    offset = np.stack([u, v], axis=2) - pixels[:, None]
    board = np.abs(np.einsum("nij,nmj->nmi", np.linalg.inv(to_px), offset))
    free = 0.8 * (1 - marker / pitch.min()) / 2 if marker else EDGE_SHARE
    weight = (inside & (board.max(2) < EDGE_SHARE) & (board.min(2) < free)).astype(float)
    shift, misfit = _fit_corners(offset, grey, weight, to_px)
    good = misfit < np.maximum(MAX_MISFIT, MAX_RELATIVE_MISFIT * np.median(misfit))
    good &= lengths(shift) < reach
    return pixels + shift, good


def _fit_corners(
    offset: Floats, grey: np.ndarray, weight: np.ndarray, to_px: Floats
) -> tuple[Floats, Floats]:
    """Fit all corners at once by damped Gauss-Newton; returns shifts (n, 2) px and RMS misfits over
    contrast (n,).

    ``offset`` (n, m, 2) px: pixels of each window from the initial corner; ``grey`` and ``weight``
    (n, m); ``to_px`` (n, 2, 2): px per square along the board's x and y.

    Unknowns of each corner: its position (2), the angles of the edges' normals (2), the blur's
    sigma, the plane of the light (3), kappa.
    """
    n = len(offset)
    q = np.zeros((n, 9))
    # an edge along (a, b) has its normal along (-b, a)
    q[:, 2:4] = np.arctan2(to_px[:, 0], -to_px[:, 1])
    q[:, 4] = 1.0
    q[:, 5] = (weight * grey).sum(1) / np.maximum(weight.sum(1), 1)
    q[:, 8] = 0.1
    model, J = _evaluate_model(q, offset)
    q[:, 8] = 0.6 * np.where((weight * (grey - q[:, 5, None]) * J[..., 8]).sum(1) < 0, -1, 1)
    damping = np.full(n, 1e-3)
    model, J = _evaluate_model(q, offset)
    cost = (weight * (grey - model) ** 2).sum(1)
    for _ in range(ITERATIONS):
        J *= weight[..., None]
        A = J.transpose(0, 2, 1) @ J
        b = J.transpose(0, 2, 1) @ (grey - model)[..., None]
        diagonal = np.einsum("nii->ni", A)
        diagonal += damping[:, None] * diagonal + 1e-6
        trial = q + np.linalg.solve(A, b)[..., 0]
        trial[:, 4] = np.clip(trial[:, 4], 0.25, 8.0)
        trial_model, trial_J = _evaluate_model(trial, offset)
        trial_cost = (weight * (grey - trial_model) ** 2).sum(1)
        better = trial_cost < cost
        settled = (~better | (np.abs(trial - q)[:, :2].max(1) < CONVERGENCE_PX)).all()
        damping = np.where(better, damping * 0.1, np.minimum(damping * 10, 1e6))
        q[better], cost[better] = trial[better], trial_cost[better]
        model[better], J[better] = trial_model[better], trial_J[better]
        if settled:
            break
    misfit = np.sqrt(cost / np.maximum(weight.sum(1), 1))
    return q[:, :2], misfit / np.maximum(np.abs(q[:, 5] * q[:, 8]), 1e-6)


def _evaluate_model(q: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """Return grey levels (n, m) and derivatives (n, m, 9) of corners ``q`` (n, 9) at offsets (n, m,
    2) px."""
    x, y = np.moveaxis(offset - q[:, None, :2], -1, 0)
    sigma = q[:, 4, None]
    light = q[:, 5, None] + q[:, 6, None] * offset[..., 0] + q[:, 7, None] * offset[..., 1]
    kappa = q[:, 8, None]
    # (2, n, m): of both edges
    angles = q[:, 2:4].T[..., None]
    normal_u, normal_v = np.cos(angles), np.sin(angles)
    distance = normal_u * x + normal_v * y
    edge = scipy.special.erf(distance / (np.sqrt(2) * sigma))
    slope = np.sqrt(2 / np.pi) / sigma * np.exp(-0.5 * (distance / sigma) ** 2)
    cross, ahead = edge[0] * edge[1], slope * edge[::-1]
    gain = light * kappa
    J = np.empty((*light.shape, 9))
    J[..., 0] = -gain * (ahead * normal_u).sum(0)
    J[..., 1] = -gain * (ahead * normal_v).sum(0)
    J[..., 2], J[..., 3] = gain * ahead * (normal_u * y - normal_v * x)
    J[..., 4] = -gain * (ahead * distance).sum(0) / sigma
    J[..., 5] = 1 + kappa * cross
    J[..., 6] = offset[..., 0] * J[..., 5]
    J[..., 7] = offset[..., 1] * J[..., 5]
    J[..., 8] = light * cross
    return light * J[..., 5], J
