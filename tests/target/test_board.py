"""Notation, points and outlines of boards."""

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.target.board import Board

NOTATIONS = [
    "circles:21x16:9",
    "acircles:4x11:20",
    "chessboard:9x7:75",
    "chessboard:7x9:12.5",
    "charuco:8x6:30",
    "charuco:8x6:30:20",
    "charuco:8x6:30:22.5:DICT_4X4_50",
]


@pytest.mark.parametrize("notation", NOTATIONS)
def test_notation_round_trips(notation: str) -> None:
    board = Board.parse(notation)
    assert str(board) == notation
    assert Board.parse(str(board)) == board and hash(Board.parse(notation)) == hash(board)


def test_notation_forgives_spaces_and_capitals() -> None:
    assert Board.parse(" Circles: 21 X 16 : 9.0 ") == Board("circles", 21, 16, 9.0)


def test_odd_lengths_keep_every_digit() -> None:
    assert Board.parse(str(Board("circles", 5, 4, 1 / 3))).pitch_mm == 1 / 3


@pytest.mark.parametrize(
    ("notation", "facts"),
    [
        ("", ("circles", "charuco")),
        ("squares:3x3:4", ("squares", "circles", "charuco")),
        ("circles", ("0 fields", "circles:")),
        ("circles:21x16", ("1 fields", "columns", "rows", "pitch")),
        ("circles:21:9", ("'21'", "columns", "rows")),
        (f"circles:{'9' * 5000}x16:9", ("columns", "rows")),
        ("circles:21x16:9:3", ("3 fields", "circles:")),
        ("circles:21x16:wide", ("'wide'", "length")),
        ("circles:21x16:-9", ("'-9'", "length")),
        ("circles:21x16:nan", ("'nan'", "length")),
        ("circles:21x16:inf", ("inf mm", 0.01, "10000 mm")),
        ("circles:1x16:9", ("1x16", 3, "200 rows")),
        ("chessboard:9x2000:9", ("9x2000", 3, "200 rows")),
        ("charuco:8x6:30:0", ("'0'", "length")),
        ("charuco:8x6:30:30", ("30 mm", 0.95, "charuco:8x6:30:22.5")),
        ("charuco:8x6:30:20:DICT_9X9_50", ("DICT_9X9_50", "DICT_4X4_50", "DICT_5X5_1000")),
        ("charuco:20x20:30:20:DICT_4X4_50", ("200 markers", "DICT_4X4_50", 50)),
    ],
)
def test_bad_notation_is_refused_with_the_fault_and_an_example(
    notation: str, facts: tuple[object, ...]
) -> None:
    with raises(InputError, *facts) as error:
        Board.parse(notation)
    assert "DICT_4X4_50 has 50" in str(error.value) or any(
        kind in str(error.value) for kind in ("circles", "ch")
    )


def test_points_run_row_by_row_from_the_origin() -> None:
    points = Board.parse("circles:3x4:9").points
    assert points.shape == (12, 3) and points.dtype == np.float64
    np.testing.assert_array_equal(points[:4], [[0, 0, 0], [9, 0, 0], [18, 0, 0], [0, 9, 0]])
    assert not points.flags.writeable


def test_asymmetric_points_are_opencvs() -> None:
    expected = [[(2 * j + i % 2) * 20, i * 20, 0] for i in range(11) for j in range(4)]
    np.testing.assert_array_equal(Board.parse("acircles:4x11:20").points, expected)


def test_charuco_features_are_inner_corners() -> None:
    board = Board.parse("charuco:8x6:30")
    assert board.features == (7, 5) and len(board.points) == 35
    assert (board.marker_mm, board.dictionary) == (22.5, "DICT_5X5_1000")


@pytest.mark.parametrize(
    ("notation", "low", "high"),
    [
        ("circles:3x4:10", (-5, -5), (25, 35)),
        ("acircles:3x5:10", (-5, -5), (55, 45)),
        ("chessboard:3x4:10", (-9.5, -9.5), (29.5, 39.5)),
        ("charuco:4x5:10", (-10, -10), (30, 40)),
    ],
)
def test_outline_is_what_surely_belongs_to_the_board(
    notation: str, low: tuple[float, float], high: tuple[float, float]
) -> None:
    outline = Board.parse(notation).outline()
    assert outline.shape == (4, 3)
    np.testing.assert_allclose(outline[:, :2].min(0), low)
    np.testing.assert_allclose(outline[:, :2].max(0), high)
    np.testing.assert_allclose(Board.parse(notation).outline(0.0)[0], 0.0)
