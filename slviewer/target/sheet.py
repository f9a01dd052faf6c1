"""Printable pages of boards, to exact scale."""

from pathlib import Path

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.target.board import Board
from slviewer.target.corners import opencv_board
from slviewer.target.drawing import LARGEST_PDF_MM, Drawing
from slviewer.target.mark import OFFSET, PAPER_WIDTH, RADIUS, mark_geometry, neighbour_distance_mm

CIRCLE_SHARE = 0.5
"""Diameter of a printed circle over the distance to its nearest neighbour."""
FOOTER_MM = 12.0
"""Strip below the board for the scale bar and the text."""


def write_sheet(board: Board, path: Path | str, margin_mm: float | None = None) -> None:
    """Write a board as a .pdf or .svg page of the board's size, with a scale bar to check the print
    by.

    ``margin_mm``: width of the paper around the board; by default what the mark of a board of
    circles needs, or half a square, but at least 10 mm. The mark is omitted where the margin is too
    narrow for it. The page's right and down are the board's x and y. Raises InputError for other
    suffixes, for pages that PDF cannot hold, and where the file cannot be written.
    """
    write_drawing(draw_board(board, margin_mm), Path(path))


def write_drawing(drawing: Drawing, path: Path) -> None:
    """Write a drawing as a .pdf or .svg page; raises as ``write_sheet``."""
    suffix = path.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise InputError(
            f"a sheet cannot be written as '{path.name}': give a name that ends in .pdf or .svg"
        )
    if suffix == ".pdf" and max(drawing.width, drawing.height) > LARGEST_PDF_MM:
        raise InputError(
            f"a page of {drawing.width:.0f}x{drawing.height:.0f} mm is more than a PDF can hold "
            f"({LARGEST_PDF_MM:.0f} mm): write .svg instead"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(drawing.pdf() if suffix == ".pdf" else drawing.svg())
    except OSError as error:
        raise InputError(
            f"'{path}' cannot be written ({error.strerror}): choose another place"
        ) from error


def draw_board(board: Board, margin_mm: float | None = None) -> Drawing:
    """Draw a board on its page, with a footer; ``margin_mm`` as in ``write_sheet``."""
    if board.plugin_type:
        raise InputError(
            f"{board.kind} boards come from a plugin and cannot be drawn: print its maker's file"
        )
    mark = mark_geometry(board)
    radius = CIRCLE_SHARE / 2 * neighbour_distance_mm(board)
    needed_margin = (
        (OFFSET + RADIUS + PAPER_WIDTH) * neighbour_distance_mm(board) - radius
        if mark
        else board.pitch_mm / 2
    )
    margin = max(10.0, needed_margin) if margin_mm is None else margin_mm
    if not margin >= 0:
        raise InputError(f"a margin of {margin} mm is not possible: give 0 or more")
    beyond = radius if mark else board.pitch_mm
    first = np.array([margin + beyond, margin + beyond])
    extent = np.ptp(board.points[:, :2], axis=0) + 2 * (margin + beyond)
    width, bottom = max(float(extent[0]), 40.0), float(extent[1])
    drawing = Drawing(width, bottom + FOOTER_MM)
    if mark:
        drawing.circles = [(x, y, radius) for x, y in (board.points[:, :2] + first).tolist()]
        if margin >= needed_margin:
            drawing.circles.append((first[0] + mark.x, first[1] + mark.y, mark.radius))
    else:
        _add_black_squares(board, drawing, *first.tolist())
    _add_footer(board, drawing, bottom)
    return drawing


def _add_black_squares(board: Board, drawing: Drawing, x: float, y: float) -> None:
    """Add the black squares of a board whose first inner corner is at (x, y) mm; the top-left one
    is black."""
    p = board.pitch_mm
    columns, rows = board.features
    for i, j in np.argwhere(np.indices((rows + 1, columns + 1)).sum(axis=0) % 2 == 0).tolist():
        drawing.rectangles.append((x + (j - 1) * p, y + (i - 1) * p, p, p))
    if board.kind != "charuco":
        return
    charuco = opencv_board(board)
    dictionary = charuco.getDictionary()
    for number, corners in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        left, top = np.reshape(corners, (-1, 3))[:, :2].min(0).astype(float) - p + (x, y)
        image = cv2.aruco.generateImageMarker(
            dictionary, int(number), dictionary.markerSize + 2, borderBits=1
        )
        drawing.add_cells(image == 0, float(left), float(top), board.marker_mm)


def _add_footer(board: Board, drawing: Drawing, top: float) -> None:
    """Add a scale bar, of 100 mm where the page is wide enough, and printing instructions below
    ``top`` mm."""
    inset = 5.0
    length = next(bar for bar in (100, 50, 20) if bar <= drawing.width - 2 * inset)
    for x in range(0, length + 1, 10):
        drawing.rectangles.append((inset + x - 0.1, top + 1.0, 0.2, 2.0))
    drawing.rectangles.append((inset, top + 2.8, float(length), 0.2))
    text = f"{board}   print at 100 %, without fitting to the page: the bar is {length} mm long"
    drawing.texts.append(
        (inset, top + 7.5, min(3.5, 2 * (drawing.width - 2 * inset) / len(text)), text)
    )
