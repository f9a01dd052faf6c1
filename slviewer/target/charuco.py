"""Detect the inner corners of ChArUco boards, whose markers identify them, so that a part of such a
board is enough; and name the board that the markers in view belong to, where it is another one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from slviewer.errors import BoardError, DetectionError, InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths, list_runs
from slviewer.target.board import DICTIONARIES, Board, Detection
from slviewer.target.corners import MIN_CORNERS, SUFFICIENT_SHARE, refine_corners
from slviewer.target.images import (
    MIRRORED,
    SEARCH_PX,
    BoardImage,
    light_advice,
    resize_image,
    to_full_image,
)
from slviewer.target.planar import check_grid, to_image

MARKER_TOLERANCE = 0.5
"""Largest distance, in squares, of a marker's corner from its place in a layout."""
MIN_MARKER_CORNERS = 8
MIN_MARKERS = 4
"""Smallest number of markers that name a board: of random squares, one in eight looks like a marker
of DICT_4X4_1000, turned or mirrored."""
MAX_COLUMNS = 40
"""Widest board that is tried for its markers."""
CELL_PX = 8
"""Pixels along a module of a rectified marker."""
MIN_MARKER_CONTRAST = 20
"""Grey levels between a rectified marker's dark and bright modules."""


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers in an image: ``ids`` (n,) int, of ``dictionary``, and corners ``quads`` (n, 4, 2)
    float64 px, clockwise on the marker from its top left. ``is_mirrored``: the image, or what it
    shows, is; ``is_inverted``: dark and bright are exchanged."""

    dictionary: str
    ids: np.ndarray
    quads: Floats
    is_mirrored: bool = False
    is_inverted: bool = False


def opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return the board as an OpenCV ``CharucoBoard``."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = board.columns, board.rows
    charuco = cv2.aruco.CharucoBoard(
        size, board.pitch_mm, board.marker_mm, dictionary, np.array(board.marker_ids)
    )
    charuco.setLegacyPattern(board.legacy)
    return charuco


def detect_charuco(board: Board, image: BoardImage) -> Detection:
    """Detect corners.

    Raises DetectionError for too few corners, and BoardError for markers of another board, in
    another layout, and for a mirror image.
    """
    detector = cv2.aruco.CharucoDetector(opencv_board(board))
    first = min(1.0, SEARCH_PX / max(image.grey.shape))
    pixels, ids = np.empty((0, 2)), np.empty(0, int)
    markers = Markers(board.dictionary, np.empty(0, int), np.empty((0, 4, 2)))
    for factor in dict.fromkeys((first / 2, first, 1.0)):
        small = resize_image(image.grey, factor)
        corners, numbers, outlines, marker_ids = detector.detectBoard(small)
        if marker_ids is not None and len(marker_ids) > len(markers.ids):
            quads = to_full_image(np.reshape(outlines, (-1, 4, 2)), factor)
            markers = replace(markers, ids=np.ravel(marker_ids).astype(int), quads=quads)
            _check_markers(board, markers)
        if numbers is not None and len(numbers) > len(ids):
            pixels = to_full_image(np.reshape(corners, (-1, 2)), factor)
            ids = np.ravel(numbers).astype(int)
        if len(ids) >= SUFFICIENT_SHARE * len(board.points):
            break
    if len(ids) >= MIN_CORNERS:
        points = board.points[ids][:, :2]
        pixels, good = refine_corners(image.deep, pixels, points, board.pitches, board.marker_mm)
        pixels, ids = pixels[good], ids[good]
    if len(ids) < MIN_CORNERS:
        _name_other_board(board, resize_image(image.grey, first))
        known = np.count_nonzero(np.isin(markers.ids, board.marker_ids))
        raise DetectionError(
            f"{len(ids)} of {len(board.points)} corners and {known} of {len(board.marker_ids)}"
            f" markers of {board} detected, and a pose needs {MIN_CORNERS}",
            f"{light_advice(image.grey)}",
        )
    check_grid(board, pixels, ids, "corners")
    foreign = np.setdiff1d(markers.ids, board.marker_ids)
    note = ""
    if len(foreign):
        note = f"markers {_list_ids(foreign)} in view are not of {board}, and are not used"
    return Detection(pixels, ids, note=note)


def _check_markers(board: Board, markers: Markers) -> None:
    """Raise BoardError where another board or layout explains the markers that this one explains,
    and one more at least."""
    other, count = _find_board(board, markers)
    if other == board:
        return
    own = _fitting(board, markers)
    shared = np.count_nonzero(own & _fitting(other, markers))
    # of two boards in view, the other explains the other's markers only
    if count < MIN_MARKER_CORNERS or count < own.sum() + 4 or shared < own.sum() / 2:
        return
    foreign = np.setdiff1d(markers.ids, board.marker_ids)
    if other.legacy != board.legacy and not len(foreign):
        raise BoardError(
            f"{count} of {4 * len(markers.ids)} corners of the markers fit {other}, a layout"
            f" {'before' if other.legacy else 'since'} OpenCV 4.6, and {own.sum()} fit {board}",
            f"give the board as {other}",
            cause="board-size",
        )
    raise BoardError(*_describe_other(board, other, markers), cause="board-size")


def name_marker_board(board: Board, image: BoardImage) -> None:
    """Raise BoardError where an image without a board that has no markers shows one that has."""
    factor = min(1.0, SEARCH_PX / max(image.grey.shape))
    markers = identify_markers(resize_image(image.grey, factor), "")
    if markers is not None and (kind := _identify_arrangement(markers)):
        raise BoardError(
            f"{len(markers.ids)} markers, {_list_ids(markers.ids)} of {markers.dictionary}, are"
            f" seen as on {kind}, and {board} has none",
            APRILGRID if kind == _GRID else "give the board in view, or bring the right one",
            cause="board-size",
        )


_GRID, _SQUARES = "an AprilGrid or a sheet of markers", "a ChArUco board"
APRILGRID = (
    "use another board (`slviewer target`), or install a plugin for AprilGrids, as"
    " docs/examples/slviewer-example-plugin is (aprilgrid:6x6:88)"
)


def _identify_arrangement(markers: Markers) -> str:
    """Return the kind of board on which most markers have their nearest neighbour where it is: at
    their side, or at their corner; empty for other arrangements."""
    a, b = (markers.quads[:, k] - markers.quads[:, 0] for k in (1, 3))
    middles = markers.quads.mean(axis=1)
    distances = lengths(middles - middles[:, None])
    np.fill_diagonal(distances, np.inf)
    nearest = distances.argmin(axis=1)
    sides = np.linalg.solve(np.stack([a, b], axis=-1), (middles[nearest] - middles)[..., None])
    short, long = np.sort(np.abs(sides[..., 0]), axis=1).T
    kinds = {_GRID: short < 0.2, _SQUARES: short > 0.8 * long}
    is_near = (long > 1) & (long < 2.5)
    return next((kind for kind, fits in kinds.items() if np.mean(fits & is_near) > 0.7), "")


def _name_other_board(board: Board, grey: np.ndarray) -> None:
    """Raise BoardError where an image without enough corners of the board shows markers of another
    board or dictionary, mirrored or inverted ones."""
    markers = identify_markers(grey, board.dictionary)
    if markers is None:
        return
    other, count = _find_board(replace(board, dictionary=markers.dictionary), markers)
    is_explained = count >= max(MIN_MARKER_CORNERS, 2 * len(markers.ids))
    if markers.is_mirrored or markers.is_inverted:
        if other == board and is_explained and markers.is_mirrored:
            raise BoardError(*MIRRORED, cause="axis-reversed")
        observation, remedy = MIRRORED if markers.is_mirrored else INVERTED
        names = f"{_list_ids(markers.ids)} of {markers.dictionary}"
        raise BoardError(
            f"{observation} ({len(markers.ids)} markers, {names})",
            remedy
            + (f"; and give the board as {other}" if is_explained and other != board else ""),
            cause="axis-reversed" if markers.is_mirrored else "board-size",
        )
    if other != board or len(np.setdiff1d(markers.ids, board.marker_ids)):
        text = _describe_other(board, other if is_explained else None, markers)
        raise BoardError(*text, cause="board-size")


INVERTED = (
    "dark and bright are exchanged in the image of the board",
    "print the board with dark markers on white paper, or invert the images",
)


def _describe_other(board: Board, other: Board | None, markers: Markers) -> tuple[str, str]:
    """Return observation and remedy for markers that are not the board's; ``other``: the board that
    explains them."""
    observation = (
        f"the {len(markers.ids)} markers seen are {_list_ids(markers.ids)} of {markers.dictionary},"
        f" and {board} has {_list_ids(np.array(board.marker_ids))} of {board.dictionary}"
    )
    if _identify_arrangement(markers) == _GRID:
        return f"{observation}: they lie side by side, as on {_GRID}", APRILGRID
    if other is None:
        return observation, "give the size, the dictionary and the first id of the board in view"
    if other.columns != board.columns:
        return (
            f"the markers seen, {_list_ids(markers.ids)} of {markers.dictionary}, lie as on a board"
            f" of {other.columns} columns, and {board} has {board.columns}",
            f"check columns, rows and dictionary, as in {other}",
        )
    return observation, f"give the board as {other}, or bring {board} into view"


def _find_board(board: Board, markers: Markers) -> tuple[Board, int]:
    """Return the board that explains most corners of the markers, and how many: the stated one
    where none is better, else one of another first id or layout, else of other columns."""
    best, most = board, 0
    # 0.9: a marker's corner may be covered
    for candidates in (_other_numbers(board, markers), _other_columns(board, markers)):
        for candidate in candidates:
            count = int(_fitting(candidate, markers).sum())
            if count >= most + 4:
                best, most = candidate, count
            if most == 4 * len(markers.ids):
                return best, most
        if most >= 0.9 * 4 * len(markers.ids):
            break
    return best, most


def _other_numbers(board: Board, markers: Markers) -> Iterator[Board]:
    """Yield the board, its other layout, and both with other first ids which half of the markers
    allow."""
    low, high = (int(np.percentile(markers.ids, q)) if len(markers.ids) else 0 for q in (25, 75))
    count = len(board.marker_ids)
    firsts = [board.first_id]
    if len(np.setdiff1d(markers.ids, board.marker_ids)):
        firsts += range(max(0, high - count + 1), low + 1)
    for first in firsts:
        for legacy in (board.legacy, not board.legacy):
            yield from _vary(board, first_id=first, legacy=legacy)


def _other_columns(board: Board, markers: Markers) -> Iterator[Board]:
    """Yield boards of the same first id and other columns, with rows for all ids seen."""
    most = int(markers.ids.max(initial=0)) - board.first_id + 1
    for columns in range(3, MAX_COLUMNS):
        rows = max(3, -(-2 * most // columns))
        for legacy in (False, True):
            yield from _vary(
                board, columns=columns, rows=rows + rows % 2 if legacy else rows, legacy=legacy
            )


def _vary(board: Board, **changes: int | bool) -> Iterator[Board]:
    """Yield the board with changes, if there is such a board."""
    try:
        yield replace(board, **changes)  # type: ignore[arg-type]
    except InputError:
        return


def _fitting(board: Board, markers: Markers) -> np.ndarray:
    """Return which of the markers' corners (4 n,) bool fit their places on the board by one
    homography."""
    fits = np.zeros((len(markers.ids), 4), bool)
    places = _marker_places(board)
    index = markers.ids - board.first_id
    known = np.flatnonzero((index >= 0) & (index < len(places)))
    if len(known) >= 2:
        pixels, points = markers.quads[known].reshape(-1, 2), places[index[known]].reshape(-1, 2)
        tolerance = MARKER_TOLERANCE * board.pitch_mm
        H, _ = cv2.findHomography(pixels, points, cv2.RANSAC, tolerance, maxIters=300)
        if H is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                off = lengths(to_image(np.asarray(H, float), pixels) - points)
            fits[known] = (off < tolerance).reshape(-1, 4)
    return fits.ravel()


@cache
def _marker_places(board: Board) -> Floats:
    """Return the corners (n, 4, 2) mm of the board's markers, in the order of their ids."""
    return np.array(opencv_board(board).getObjPoints(), float)[..., :2]


def _list_ids(ids: np.ndarray) -> str:
    """Return ids in words, as ranges."""
    texts = [f"{a} to {b}" if b > a else f"{a}" for a, b in list_runs(np.unique(ids))]
    return ", ".join(texts[:6]) + (", ..." if len(texts) > 6 else "")


def identify_markers(grey: np.ndarray, expected: str) -> Markers | None:
    """Return the markers in an image (h, w) uint8 of the dictionary, turn, mirroring and inversion
    that most of its squares fit without a wrong module, ``expected`` at equal numbers; None below
    `MIN_MARKERS`."""
    for is_inverted, image in ((False, grey), (True, 255 - grey)):
        quads = _detect_squares(image)
        best, most = None, MIN_MARKERS - 1
        for size in (4, 5, 6, 7) if len(quads) > most else ():
            cells, is_marker = _rectify(image, quads, size + 2)
            modules, corners = cells[is_marker, 1:-1, 1:-1], quads[is_marker]
            # fewer of many squares look like markers by chance
            most = max(most, len(modules) // 2) if best is None else most
            for markers in (
                *_look_up(modules, corners, expected),
                *_look_up(modules[:, :, ::-1], corners[:, [1, 0, 3, 2]], expected, mirrored=True),
            ):
                if len(markers.ids) > most:
                    best, most = replace(markers, is_inverted=is_inverted), len(markers.ids)
        if best is not None:
            return best
    return None


def _detect_squares(grey: np.ndarray) -> Floats:
    """Return the corners (n, 4, 2) px of what may be markers."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    found, _, rejected = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    return np.reshape([*found, *rejected], (-1, 4, 2)).astype(np.float64)


def _rectify(grey: np.ndarray, quads: Floats, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the modules (n, cells, cells) bool inside of quadrilaterals (n, 4, 2) px, True where
    bright, and whether they are clear and have a dark border (n,) bool."""
    side = cells * CELL_PX
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32) - 0.5
    modules, is_clear = np.zeros((len(quads), cells, cells), bool), np.zeros(len(quads), bool)
    for k, quad in enumerate(quads.astype(np.float32)):
        H = cv2.getPerspectiveTransform(quad, square)
        flat = cv2.warpPerspective(grey, H, (side, side), flags=cv2.INTER_LINEAR)
        level, binary = cv2.threshold(flat, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        middle = binary.reshape(cells, CELL_PX, cells, CELL_PX)[:, 2:-2, :, 2:-2]
        modules[k] = middle.mean((1, 3)) > 0.5
        if flat.min() <= level < flat.max():
            contrast = flat[flat > level].mean() - flat[flat <= level].mean()
            is_clear[k] = contrast > MIN_MARKER_CONTRAST
    border = modules.sum((1, 2)) - modules[:, 1:-1, 1:-1].sum((1, 2))
    return modules, is_clear & (border == 0)


def _look_up(
    modules: np.ndarray, quads: Floats, expected: str, mirrored: bool = False
) -> Iterator[Markers]:
    """Yield the markers of each family of dictionaries that ``modules`` (n, size, size) bool within
    the corners ``quads`` (n, 4, 2) px show, the family of ``expected`` first."""
    size = modules.shape[1]
    families = sorted(_families(size), key=lambda names: expected not in names)
    turned = [np.rot90(modules, k, (1, 2)).reshape(-1, size * size) for k in range(4)]
    packed = [np.packbits(each, axis=1) for each in turned]
    for names in families:
        numbers = _numbers(names[-1], size)
        ids, corners = list[int](), list[Floats]()
        for k in range(4):
            for row, quad in zip(packed[k], quads, strict=True):
                number = numbers.get(row.tobytes())
                if number is not None and number not in ids:
                    ids.append(number)
                    corners.append(np.roll(quad, -k, axis=0))
        if ids:
            fits = [name for name in names if max(ids) < DICTIONARIES[name]]
            name = expected if expected in fits else fits[0]
            yield Markers(name, np.array(ids), np.array(corners), mirrored)


def _families(size: int) -> list[tuple[str, ...]]:
    """Return the names of dictionaries of ``size`` x ``size`` modules; those of which the larger
    continue the smaller together, the smallest first."""
    alone = {4: ["APRILTAG_16h5"], 5: ["APRILTAG_25h9", "ARUCO_ORIGINAL"]}
    alone[6] = ["APRILTAG_36h11", "APRILTAG_36h10", "ARUCO_MIP_36h12"]
    names = [
        (f"DICT_{each}",) for each in alone.get(size, []) if hasattr(cv2.aruco, f"DICT_{each}")
    ]
    return [tuple(f"DICT_{size}X{size}_{count}" for count in (50, 100, 250, 1000)), *names]


@cache
def _numbers(name: str, size: int) -> dict[bytes, int]:
    """Return the number of each marker of a dictionary, by its packed modules."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    packed = [
        np.packbits(cv2.aruco.Dictionary.getBitsFromByteList(row[None], size).astype(bool))
        for row in dictionary.bytesList
    ]
    return {bits.tobytes(): number for number, bits in enumerate(packed)}
