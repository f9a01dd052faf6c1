"""Printable pages of boards, to exact scale: vector drawings in mm as SVG or PDF, a few filled
shapes and text."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import Mask
from slviewer.target.board import Board
from slviewer.target.charuco import opencv_board
from slviewer.target.mark import OFFSET, PAPER_WIDTH, RADIUS, mark_geometry, neighbour_distance_mm

CIRCLE_SHARE = 0.5
"""Diameter of a printed circle over the distance to its nearest neighbour."""
FOOTER_MM = 12.0
"""Strip below the board for the scale bar and the text."""
MM_PER_POINT = 25.4 / 72
LARGEST_PDF_MM = 14_400 * MM_PER_POINT
"""Side of the largest page that PDF viewers accept."""
ARC_CONTROL = 0.5522847498
"""Handles of a quarter circle's Bezier curve over its radius; the curve leaves the circle by 0.03 %
of it at most."""


@dataclass
class Drawing:
    """Black shapes on a page of ``width`` x ``height`` mm; x to the right, y down from the top left
    corner, mm."""

    width: float
    height: float
    circles: list[tuple[float, float, float]] = field(default_factory=list)
    """(x, y, radius)"""
    rectangles: list[tuple[float, float, float, float]] = field(default_factory=list)
    """(x, y, width, height)"""
    texts: list[tuple[float, float, float, str]] = field(default_factory=list)
    """(x, y of the baseline, size of the letters, ASCII text)"""

    def add_cells(self, black: Mask, left: float, top: float, side: float) -> None:
        """Add the black cells (m, m) bool of a square of ``side`` mm at (left, top), neighbours in
        a row merged."""
        cell = side / len(black)
        for i, row in enumerate(np.pad(black, ((0, 0), (1, 1))).astype(int)):
            starts, ends = np.nonzero(np.diff(row) == 1)[0], np.nonzero(np.diff(row) == -1)[0]
            self.rectangles += [
                (left + a * cell, top + i * cell, (b - a) * cell, cell)
                for a, b in zip(starts, ends, strict=True)
            ]

    def svg(self) -> bytes:
        """The drawing as an SVG file whose user unit is the millimetre."""
        squares = "".join(
            f"M{_mm(x)} {_mm(y)}h{_mm(w)}v{_mm(h)}h{_mm(-w)}z" for x, y, w, h in self.rectangles
        )
        lines = [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" width="{_mm(self.width)}mm"'
                f' height="{_mm(self.height)}mm" viewBox="0 0 {_mm(self.width)}'
                f' {_mm(self.height)}">'
            ),
            f'<rect width="{_mm(self.width)}" height="{_mm(self.height)}" fill="white"/>',
            *(f'<circle cx="{_mm(x)}" cy="{_mm(y)}" r="{_mm(r)}"/>' for x, y, r in self.circles),
            f'<path d="{squares}"/>',
            *(
                f'<text x="{_mm(x)}" y="{_mm(y)}" font-size="{_mm(size)}" font-family="Helvetica,'
                f' Arial, sans-serif">{text}</text>'
                for x, y, size, text in self.texts
            ),
            "</svg>",
        ]
        return "\n".join(lines).encode("ascii")

    def pdf(self) -> bytes:
        """The drawing as a PDF file of one page; its content is in mm, after one change of
        units."""
        scale = 1 / MM_PER_POINT
        lines = [f"{scale:.10f} 0 0 {-scale:.10f} 0 {self.height * scale:.6f} cm"]
        for x, y, r in self.circles:
            h = ARC_CONTROL * r
            lines += [
                f"{_mm(x + r)} {_mm(y)} m",
                _curve(x + r, y + h, x + h, y + r, x, y + r),
                _curve(x - h, y + r, x - r, y + h, x - r, y),
                _curve(x - r, y - h, x - h, y - r, x, y - r),
                _curve(x + h, y - r, x + r, y - h, x + r, y),
                "f",
            ]
        lines += [f"{_mm(x)} {_mm(y)} {_mm(w)} {_mm(h)} re" for x, y, w, h in self.rectangles]
        lines += ["f"] * bool(self.rectangles)  # one path, so that touching cells show no seams
        lines += [
            f"BT /F1 {_mm(size)} Tf 1 0 0 -1 {_mm(x)} {_mm(y)} Tm ({text}) Tj ET"
            for x, y, size, text in self.texts
        ]
        content = "\n".join(lines)
        page = f"0 0 {self.width * scale:.6f} {self.height * scale:.6f}"
        objects = (
            "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{page}] /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>",
            f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        )
        body, table = "%PDF-1.7\n", "xref\n0 6\n0000000000 65535 f \n"
        for number, text in enumerate(objects, 1):
            table += f"{len(body):010d} 00000 n \n"
            body += f"{number} 0 obj\n{text}\nendobj\n"
        trailer = f"trailer\n<< /Size 6 /Root 1 0 R >>\nstartxref\n{len(body)}\n%%EOF\n"
        return (body + table + trailer).encode("ascii")


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
            f"a sheet cannot be written as '{path.name}'", "give a name that ends in .pdf or .svg"
        )
    if suffix == ".pdf" and max(drawing.width, drawing.height) > LARGEST_PDF_MM:
        raise InputError(
            f"a page of {drawing.width:.0f}x{drawing.height:.0f} mm is more than a PDF can hold"
            f" ({LARGEST_PDF_MM:.0f} mm)",
            "write .svg instead",
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(drawing.pdf() if suffix == ".pdf" else drawing.svg())
    except OSError as error:
        raise InputError(
            f"'{path}' cannot be written ({error.strerror})", "choose another place"
        ) from error


def draw_board(board: Board, margin_mm: float | None = None) -> Drawing:
    """Draw a board on its page, with a footer; ``margin_mm`` as in ``write_sheet``."""
    if board.plugin_type:
        raise InputError(
            f"{board.kind} boards come from a plugin and cannot be drawn", "print its maker's file"
        )
    if board.pitch_y_mm != board.pitch_mm:
        raise InputError(
            f"Cannot draw {board}",
            "two pitches describe a print as it was measured. Draw it with one pitch.",
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
        raise InputError(f"a margin of {margin} mm is not possible", "give 0 or more")
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
    is black, but for the layout before OpenCV 4.6."""
    p = board.pitch_mm
    columns, rows = board.features
    parity = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    for i, j in np.argwhere(parity == board.legacy).tolist():
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


def _mm(value: float) -> str:
    """A length to a hundredth of a micrometre, without an exponent."""
    return f"{value:.5f}".rstrip("0").rstrip(".")


def _curve(*coordinates: float) -> str:
    """Return a PDF operator for a Bezier curve."""
    return " ".join(_mm(c) for c in coordinates) + " c"
