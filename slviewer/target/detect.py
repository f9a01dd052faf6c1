"""Detect a board in an image, numbered as its points are, or raise an error with the reason."""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import BoardError, DetectionError, InputError
from slviewer.geometry.rigid import Mask
from slviewer.geometry.vectors import lengths
from slviewer.target.board import Board, Detection
from slviewer.target.charuco import detect_charuco, name_marker_board
from slviewer.target.circles import detect_circles, list_grids
from slviewer.target.coded import detect_markers
from slviewer.target.corners import detect_chessboard, recognise_chessboard
from slviewer.target.images import BoardImage
from slviewer.target.planar import fit_homography, to_image

_FEWEST = 6
"""Features of a plugin's board that fix its pose with some to spare."""
_SAME_FEATURE_PX = 2.0
"""Farthest that two detections of a feature lie apart: less than features do."""


def detect(board: Board, image: np.ndarray, *, several: bool = False) -> Detection:
    """Detect a board's features in an image (h, w), or (h, w, 3) RGB, uint8 or uint16.

    The numbering's x axis turns clockwise into its y axis in the image, always. A symmetric board
    is numbered from its mark (``slviewer.target.mark``); where none is detected, the rule of
    ``slviewer.target.planar`` selects the numbering. ``several``: also where other places of the
    board show the same features (``others``). Raises DetectionError, whose message states what was
    detected and what to do, rather than return a grid with a feature missing, misplaced or shifted.
    Bars along the image's borders are not part of it, unless only these strips show where an evenly
    bright background ends.
    """
    whole = BoardImage.from_image(image)
    if whole.box == (0, 0, *whole.grey.shape[::-1]):
        return _detect_inside(board, whole, several)
    inside: Detection | None = None
    with suppress(DetectionError):
        # names of other boards in view are those of the whole image
        inside = _detect_inside(board, whole.crop(whole.box), several, names_others=False)
        inside = replace(inside, pixels=inside.pixels + np.array(whole.box[:2]))
    is_sure = inside is not None and (inside.marked or len(inside.ids) == len(board.points))
    if inside is not None and is_sure:
        return inside
    # an even background looks like bars, whose end is that of the board: what both show is sure
    each = _detect_inside(board, whole, several)
    if inside is None or len(each.others) < len(inside.others):
        return each
    shared, first, second = np.intersect1d(inside.ids, each.ids, return_indices=True)
    apart = lengths(inside.pixels[first] - each.pixels[second])
    if not several and not (len(shared) and np.all(apart < _SAME_FEATURE_PX)):
        raise DetectionError(
            f"{len(each.ids)} of {len(board.points)} features of {board} have two numberings, with"
            " and without the even strips along the image's borders",
            "move the board so that all of it is in view",
        )
    return max(inside, each, key=lambda d: len(d.ids))


def _detect_inside(
    board: Board, board_image: BoardImage, several: bool, *, names_others: bool = True
) -> Detection:
    """Detect a board as `detect` does, in an image without bars; ``names_others``: an error names
    another board in view."""
    if board.kind == "charuco":
        return detect_charuco(board, board_image)
    if added := board.plugin_type:
        pixels, ids = added.detect(board, board_image.grey)
        return _check_detection(board, pixels, ids)
    is_chessboard = board.kind == "chessboard"
    try:
        detection = (detect_chessboard if is_chessboard else detect_circles)(board, board_image)
    except DetectionError as error:
        if names_others and not isinstance(error, BoardError):
            name_marker_board(board, board_image)
        raise
    if len(detection.others) and not several:
        what = "corners" if is_chessboard else "circles"
        raise DetectionError(
            f"{len(detection.ids)} of {len(board.points)} {what} of {board} detected, and which"
            " these are is hidden by the image's border, covered or dark",
            f"keep two opposite sides of the board{'' if is_chessboard else ', or its mark,'} in"
            " view",
        )
    return detection


@dataclass(frozen=True)
class RecognisedBoard:
    """A board that ``shown`` of ``images`` images show: ``notation`` lacks the pitch, which no
    image shows."""

    notation: str
    shown: int
    images: int

    @property
    def board(self) -> Board:
        """The board with a pitch of 1 mm."""
        return Board.parse(f"{self.notation}:1")

    def text(self) -> str:
        """Describe what the images show."""
        kind = "a chessboard" if self.board.kind == "chessboard" else "a grid of circles"
        size = f"{self.board.columns}x{self.board.rows}"
        return f"{self.shown} of {self.images} images show {kind}, {size}"


def recognise_board(images: Iterable[np.ndarray]) -> RecognisedBoard | None:
    """Return the chessboard or grid of circles that most of the images show in which there is any,
    two or more of them unless there is one image; None where there is none, or where they differ.

    ChArUco boards and asymmetric grids are not recognised.
    """
    votes, count = Counter[str](), 0
    for image in images:
        count += 1
        if found := _recognise_in(image):
            votes[found] += 1
    (notation, shown), *others = votes.most_common(2) or [("", 0)]
    is_alone = not others or others[0][1] < shown
    if not shown or not is_alone or shown < min(2, count) or 2 * shown < votes.total():
        return None
    return RecognisedBoard(notation, shown, count)


def _recognise_in(image: np.ndarray) -> str:
    """Return the notation, without pitch, of the board that is wholly in an image: one that
    detecting it confirms; empty where there is none."""
    try:
        prepared = BoardImage.from_image(image)
        prepared = prepared.crop(prepared.box)
    except InputError:
        return ""
    if len(detect_markers(prepared.grey).ids):
        return ""
    for board, found in _list_boards(prepared):
        H = fit_homography(board.points[found.ids][:, :2], found.pixels)
        corners = board.outline()[:, :2]
        sides = to_image(H, (corners + np.roll(corners, 1, axis=0)) / 2)
        is_whole = ((sides >= 0) & (sides < prepared.grey.shape[::-1])).all()
        if is_whole and not len(found.others):
            return f"{board.kind}:{board.columns}x{board.rows}"
    return ""


def _list_boards(image: BoardImage) -> Iterator[tuple[Board, Detection]]:
    """Yield the chessboard and the grids of circles, with a pitch of 1 mm, that are detected."""
    if chessboard := recognise_chessboard(image):
        yield chessboard
    for size in dict.fromkeys(list_grids(image)):
        with suppress(InputError):
            board = Board("circles", *size, 1.0)
            yield board, detect_circles(board, image)


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
    the detected features, wherever the board may be.

    ``shape`` is the image's, (h, w) or (h, w, 3).
    """
    if len(detection.ids) < 4:
        raise InputError(
            f"{len(detection.ids)} features do not give a board's outline", "detect at least 4"
        )
    inside = np.ones(shape[:2], bool)
    for ids in (detection.ids, *detection.others):
        H = fit_homography(board.points[ids][:, :2], detection.pixels)
        corners = to_image(H, board.outline()[:, :2])
        mask = np.zeros(shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, np.round(corners * 16).astype(np.int32), 1, shift=4)
        inside &= mask > 0
    return inside
