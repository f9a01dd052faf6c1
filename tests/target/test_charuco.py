"""ChArUco boards: first ids and dictionaries as stated, and markers that are not the board's."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises
from rendered_board import View

from slviewer.errors import BoardError, DetectionError, InputError
from slviewer.target.board import DICTIONARIES, Board
from slviewer.target.detect import detect

pytestmark = pytest.mark.computes

VIEW = View(size=(480, 360), supersample=3, tilt=15, axis=30, fill=0.6)
BOARD = Board.parse("charuco:7x5:20:15:DICT_5X5_100")


@pytest.mark.parametrize(
    "notation",
    [
        "charuco:7x5:20:15:DICT_5X5_100:17",
        "charuco-legacy:6x8:20:14:DICT_4X4_250:100",
        "charuco:5x4:20:15:DICT_APRILTAG_36h11:30",
        "charuco:5x4:20:15:DICT_ARUCO_ORIGINAL",
    ],
)
def test_boards_of_stated_first_id_and_dictionary_are_detected(notation: str) -> None:
    board = Board.parse(notation)
    assert str(board) == notation
    view = replace(VIEW, fill=0.5)
    detection = detect(board, view.render(board))
    assert len(detection.ids) > 0.8 * len(board.points)
    assert np.abs(detection.pixels - view.truth(board)[detection.ids]).max() < 0.3
    assert not detection.note


@pytest.mark.parametrize("notation", ["charuco:7x5:20:15:DICT_5X5_50:34", "charuco:7x5:20:15:x:-1"])
def test_first_ids_that_the_dictionary_lacks_are_refused(notation: str) -> None:
    with pytest.raises(InputError):
        Board.parse(notation)


def list_other_boards() -> Iterator[str]:
    yield from (f"charuco:7x5:20:15:DICT_5X5_100:{first}" for first in (1, 3, 7, 14, 17, 60))
    yield "charuco:7x5:20:15:DICT_5X5_250:105"
    yield from (f"charuco:7x5:20:15:{name}" for name in DICTIONARIES if "5X5" not in name)
    yield "charuco:7x5:20:15:DICT_6X6_50:20"


@pytest.mark.parametrize("notation", [*list_other_boards()])
def test_a_board_of_other_ids_or_dictionary_is_named(notation: str) -> None:
    other = Board.parse(notation)
    if not hasattr(cv2.aruco, other.dictionary):
        pytest.skip(f"this OpenCV has no {other.dictionary}")
    with pytest.raises(BoardError) as caught:
        detect(BOARD, VIEW.render(other))
    named = re.sub(r"(DICT_[467]X[467])_\d+", r"\1_50", notation)  # the smallest that has the ids
    assert f"{named}," in caught.value.remedy, caught.value.remedy


def test_more_columns_are_named() -> None:
    with raises(BoardError, "9 columns"):
        detect(BOARD, VIEW.render(Board.parse("charuco:9x6:20:15:DICT_5X5_100")))


@pytest.mark.parametrize("first", [0, 7, 40])
@pytest.mark.parametrize("dictionary", ["DICT_5X5_100", "DICT_4X4_50", "DICT_APRILTAG_36h11"])
def test_mirrored_markers_are_named_whatever_their_ids(first: int, dictionary: str) -> None:
    if dictionary == "DICT_4X4_50":
        first = min(first, 33)
    other = replace(BOARD, dictionary=dictionary, first_id=first)
    with raises(BoardError, "mirror", *([str(other)] if other != BOARD else [])):
        detect(BOARD, np.ascontiguousarray(VIEW.render(other)[:, ::-1]))


def test_exchanged_dark_and_bright_are_named() -> None:
    with raises(BoardError, "exchanged"):
        detect(BOARD, 255 - VIEW.render(BOARD))


def test_a_second_board_in_view_is_noted_and_not_used() -> None:
    left = View(size=(360, 300), supersample=3, fill=0.6)
    second = replace(BOARD, first_id=17)
    image = np.hstack([left.render(BOARD), left.render(second)])
    detection = detect(BOARD, image)
    assert len(detection.ids) == 24
    assert "17 to 33" in detection.note
    assert np.abs(detection.pixels - left.truth(BOARD)).max() < 0.3


def draw_tags(places: np.ndarray, side: int = 40) -> np.ndarray:
    """Return an image (480, 640) of AprilTags at ``places`` (n, 2) px, seen at a slant."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((480, 640), 220, np.uint8)
    for k, (u, v) in enumerate(places.astype(int)):
        image[v : v + side, u : u + side] = cv2.aruco.generateImageMarker(dictionary, k, side)
    corners = np.array([[0, 0], [640, 0], [640, 480], [0, 480]], np.float32)
    slanted = corners + np.array([[20, 10], [-30, 40], [-10, -30], [10, -5]], np.float32)
    H = cv2.getPerspectiveTransform(corners, slanted)
    return cv2.GaussianBlur(cv2.warpPerspective(image, H, (640, 480), borderValue=220), (0, 0), 0.8)


@pytest.mark.parametrize("notation", [str(BOARD), "chessboard:9x6:25", "circles:21x16:9"])
def test_aprilgrids_and_charuco_boards_are_named(notation: str) -> None:
    board = Board.parse(notation)
    rows, columns = np.indices((6, 7)).reshape(2, -1)
    grid = draw_tags(np.stack([120 + 52 * columns, 80 + 52 * rows], axis=1))
    with raises(BoardError, "0 to 41 of DICT_APRILTAG_36h11", "AprilGrid", "plugin"):
        detect(board, grid)
    if board.kind != "charuco":
        with raises(BoardError, "17 markers", "ChArUco"):
            detect(board, VIEW.render(BOARD))
        scattered = np.random.default_rng(0).permutation(54)[:9]
        places = np.stack([60 + 60 * (scattered % 9), 60 + 60 * (scattered // 9)], axis=1)
        jitter = np.random.default_rng(1).integers(-9, 10, places.shape)
        with pytest.raises(DetectionError) as caught:
            detect(board, draw_tags(places + jitter))
        assert not isinstance(caught.value, BoardError)


def test_the_notation_of_aprilgrids_names_the_plugin() -> None:
    with raises(InputError, "aprilgrid:6x6:88", "plugin"):
        Board.parse("aprilgrid:6x6:88")


def test_images_without_a_board_are_not_named_as_one() -> None:
    rng = np.random.default_rng(4)
    image = np.full((480, 640), 220, np.uint8)
    for u, v in rng.uniform((40, 40), (600, 440), (60, 2)).astype(int).tolist():
        size = int(rng.integers(14, 30))
        image[v : v + size, u : u + size] = 20
        inner = rng.integers(0, 2, (4, 4)).astype(np.uint8) * 200 + 20
        cells = cv2.resize(inner, None, fx=size // 6, fy=size // 6, interpolation=0)
        at = size // 6
        image[v + at : v + at + len(cells), u + at : u + at + len(cells)] = cells
    with pytest.raises(DetectionError) as caught:
        detect(BOARD, image)
    assert not isinstance(caught.value, BoardError)


def test_the_reported_pictures_are_named(real_data: Path, tmp_path: Path) -> None:
    make = real_data / "reports4" / "01-charuco-id-offset" / "make.py"
    if not make.is_file():
        pytest.skip(f"{make} is missing")
    subprocess.run([sys.executable, make, tmp_path], check=True)
    pictures = {path.name: cv2.imread(str(path), 0) for path in tmp_path.glob("*.png")}
    board = Board.parse("charuco:7x5:35:25:DICT_5X5_100")
    assert len(detect(board, pictures["first.png"]).ids) >= 20
    with raises(BoardError, "17 to 33", f"{board}:17"):
        detect(board, pictures["from_17.png"])
    assert len(detect(replace(board, first_id=17), pictures["from_17.png"]).ids) >= 20
    with raises(BoardError, "DICT_4X4_50"):
        detect(Board.parse("charuco-legacy:8x6:35:24"), pictures["four_by_four.png"])
