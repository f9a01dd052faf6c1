"""Printable sheets: the numbers in the files are the board's, to a micrometre, and what is drawn is
found."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.errors import InputError
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.target.mark import mark_geometry
from slviewer.target.sheet import Drawing, draw_board, write_sheet

NOTATIONS = ["circles:5x4:9", "acircles:4x5:20", "chessboard:6x5:12.345", "charuco:6x5:20"]
SVG = "{http://www.w3.org/2000/svg}"
MM = 25.4 / 72


def svg_shapes(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Page size, circles (x, y, r) and rectangles (x, y, w, h) in mm."""
    root = ElementTree.parse(path).getroot()
    size = [float(root.attrib[side].removesuffix("mm")) for side in ("width", "height")]
    assert root.attrib["viewBox"] == " ".join(
        ["0 0", *(root.attrib[s].removesuffix("mm") for s in ("width", "height"))]
    )
    circles = [
        [float(c.attrib[name]) for name in ("cx", "cy", "r")] for c in root.iter(f"{SVG}circle")
    ]
    path_data = next(root.iter(f"{SVG}path")).attrib["d"]
    rectangles = re.findall(r"M(\S+) (\S+?)h(\S+?)v(\S+?)h(\S+?)z", path_data)
    return np.array(size), np.array(circles), np.array(rectangles, float)[:, :4]


def pdf_shapes(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same from a PDF, through its own change of units."""
    data = path.read_bytes()
    text = data.decode("ascii")
    assert text.startswith("%PDF-1.7\n") and text.endswith("%%EOF\n")
    start = int(text.rsplit("startxref\n", 1)[1].split("\n")[0])
    assert text[start:].startswith("xref\n")
    for number, offset in enumerate(re.findall(r"(\d{10}) 00000 n \n", text[start:]), 1):
        assert text[int(offset) :].startswith(f"{number} 0 obj\n")
    length, content = re.search(r"/Length (\d+) >>\nstream\n(.*?)\nendstream", text, re.S).groups()
    assert len(content) == int(length)
    size = np.array(re.search(r"/MediaBox \[0 0 (\S+) (\S+)\]", text).groups(), float) * MM
    a, b, c, d, e, f = (float(v) for v in content.split("\n")[0].split()[:6])
    assert (b, c, e) == (0, 0, 0)
    arcs = re.findall(r"^(\S+) (\S+) m\n((?:.* c\n){4})f$", content, re.M)
    circles = []
    for _, _, curves in arcs:
        ends = np.array([line.split()[4:6] for line in curves.strip().split("\n")], float)
        circles.append([*ends.mean(0), np.ptp(ends[:, 0]) / 2])
    rectangles = np.array(
        re.findall(r"^(\S+) (\S+) (\S+) (\S+) re$", content, re.M), float
    ).reshape(-1, 4)
    page_height = size[1]

    def on_page(points: np.ndarray) -> np.ndarray:  # to mm from the top left corner of the paper
        return np.stack([points[:, 0] * a * MM, page_height - (points[:, 1] * d + f) * MM], axis=1)

    rectangles = np.c_[on_page(rectangles), rectangles[:, 2] * a * MM, -rectangles[:, 3] * d * MM]
    found = np.array(circles).reshape(-1, 3)
    return size, np.c_[on_page(found), found[:, 2] * a * MM], rectangles


@pytest.mark.parametrize("notation", NOTATIONS)
@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".PDF"])
def test_distances_are_exact_to_a_micrometre(notation: str, suffix: str, tmp_path: Path) -> None:
    board = Board.parse(notation)
    path = tmp_path / "new" / f"board{suffix}"
    write_sheet(board, path)
    size, circles, rectangles = (svg_shapes if suffix == ".svg" else pdf_shapes)(path)
    wanted = draw_board(board)
    np.testing.assert_allclose(size, (wanted.width, wanted.height), atol=1e-3)
    np.testing.assert_allclose(
        circles.reshape(-1, 3), np.array(wanted.circles).reshape(-1, 3), atol=1e-3
    )
    np.testing.assert_allclose(rectangles, wanted.rectangles, atol=1e-3)
    assert missing_facts(path.read_text(), notation, "100 %") == []
    if board.kind in ("circles", "acircles"):
        grid, dot = circles[:-1], circles[-1] - [*circles[0, :2], 0]
        np.testing.assert_allclose(grid[:, :2] - grid[0, :2], board.points[:, :2], atol=1e-3)
        mark = mark_geometry(board)
        assert mark is not None
        np.testing.assert_allclose(dot, (mark.x, mark.y, mark.radius), atol=1e-3)


def test_a_narrow_margin_has_no_mark_and_a_wide_one_leaves_paper_around_it() -> None:
    board = Board.parse("circles:5x4:40")
    assert len(draw_board(board, margin_mm=20.0).circles) == 20
    x, y, r = draw_board(board).circles[-1]
    assert len(draw_board(board).circles) == 21 and min(x, y) - r >= r


def test_circles_are_half_the_distance_between_neighbours() -> None:
    assert draw_board(Board.parse("circles:5x4:9")).circles[0][2] == pytest.approx(9 / 4)
    assert draw_board(Board.parse("acircles:4x5:20")).circles[0][2] == pytest.approx(
        20 * 2**0.5 / 4
    )


@pytest.mark.parametrize(
    ("notation", "length"), [("circles:21x16:9", 100), ("circles:5x4:9", 50), ("circles:3x3:1", 20)]
)
def test_the_scale_bar_is_as_long_as_it_says(notation: str, length: int) -> None:
    drawing = draw_board(Board.parse(notation))
    assert max(w for _, _, w, h in drawing.rectangles if h < 0.5) == length
    assert missing_facts(drawing.texts[0][3], f"{length} mm") == []
    assert all(
        x + w <= drawing.width and y + h <= drawing.height for x, y, w, h in drawing.rectangles
    )


def rasterised(drawing: Drawing) -> np.ndarray:
    """(h, w) uint8: the page at 4 px a mm, grey at its edges."""
    fine = 16
    page = np.full((4 * round(drawing.height * 4), 4 * round(drawing.width * 4)), 255, np.uint8)
    for x, y, r in drawing.circles:
        centre = round((x * fine - 0.5) * 16), round((y * fine - 0.5) * 16)
        cv2.circle(page, centre, round(r * fine * 16), 0, -1, shift=4)
    for x, y, w, h in drawing.rectangles:
        page[round(y * fine) : round((y + h) * fine), round(x * fine) : round((x + w) * fine)] = 0
    return cv2.GaussianBlur(
        cv2.resize(page, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA), (3, 3), 0
    )


@pytest.mark.parametrize(
    "notation", [*NOTATIONS, "chessboard:6x4:10", "charuco:5x6:20:15:DICT_4X4_50"]
)
def test_a_printed_board_is_found_with_its_numbers(notation: str) -> None:
    board = Board.parse(notation)
    drawing = draw_board(board)
    detection = detect(board, rasterised(drawing))
    corner = drawing.circles[0][:2] if drawing.circles else (10 + board.pitch_mm,) * 2
    expected = (board.points[:, :2] + corner) * 4 - 0.5
    np.testing.assert_array_equal(detection.ids, np.arange(len(board.points)))
    assert detection.marked == ("circles" in notation)
    turned = detect(
        board, np.rot90(rasterised(drawing), 2)
    ).pixels  # the rule alone would count from the other end
    if detection.marked:
        np.testing.assert_allclose(
            turned, np.array(rasterised(drawing).shape[::-1]) - 1 - expected, atol=0.15
        )
    np.testing.assert_allclose(detection.pixels, expected, atol=0.15)


def test_what_cannot_be_written_is_refused_in_a_sentence(tmp_path: Path) -> None:
    board = Board.parse("circles:5x4:9")
    with raises(InputError, "board.png", ".pdf", ".svg"):
        write_sheet(board, tmp_path / "board.png")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError):
        write_sheet(board, tmp_path / "file" / "board.pdf")
    with raises(InputError, "PDF", ".svg"):
        write_sheet(Board.parse("circles:20x20:300"), tmp_path / "board.pdf")
    with raises(InputError, "margin", "-1 mm"):
        write_sheet(board, tmp_path / "board.pdf", margin_mm=-1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]
