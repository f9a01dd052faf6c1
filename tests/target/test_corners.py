"""Chessboards and ChArUco boards in rendered images."""

from dataclasses import replace

import numpy as np
import pytest
from facts import raises
from rendered_board import View
from variants import crossed, often

from slviewer.errors import DetectionError
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect
from slviewer.target.planar import check_grid

pytestmark = pytest.mark.computes

SMALL = View(size=(400, 300), supersample=4)
CHESSBOARD = Board.parse("chessboard:9x7:20")


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt((difference**2).sum(1).mean()))


@pytest.mark.parametrize(
    ("notation", "view", "limit"),
    [
        ("chessboard:9x7:20", View(size=(480, 360), shade=4), 0.006),
        ("chessboard:9x7:20", replace(SMALL, blur=2, noise=2, tilt=20), 0.05),
        ("charuco:7x5:20:12:DICT_4X4_50", replace(SMALL, fill=0.55, tilt=40, axis=20), 0.04),
        *often(
            ("chessboard:9x7:20", View(size=(480, 360), shade=4, tilt=20, axis=70), 0.02),
            ("chessboard:9x7:20", View(size=(480, 360), shade=4, tilt=45, axis=70, noise=2), 0.03),
            ("chessboard:9x7:20", replace(SMALL, shade=10, tilt=20), 0.04),
            ("chessboard:9x7:20", replace(SMALL, k1=0.4, tilt=20), 0.05),
            (
                "charuco:8x6:20",
                View(size=(480, 360), fill=0.6, shade=4, tilt=20, axis=70, noise=1),
                0.02,
            ),
        ),
    ],
)
def test_corners_are_exact_to_hundredths_of_a_pixel(
    notation: str, view: View, limit: float
) -> None:
    board = Board.parse(notation)
    detection = detect(board, view.render(board))
    np.testing.assert_array_equal(detection.ids, np.arange(len(board.points)))
    assert 1e-5 < rms(detection.pixels - view.truth(board)) < limit


@pytest.mark.parametrize(
    ("notation", "roll"),
    crossed(
        ["chessboard:8x7:20", "chessboard:7x8:20", "charuco:7x5:20", "charuco:6x6:20"],
        [180, 90, 150, 270, 0],
    ),
)
def test_a_board_with_marks_of_its_own_keeps_its_numbers(notation: str, roll: float) -> None:
    board, view = Board.parse(notation), replace(SMALL, roll=roll, tilt=20, fill=0.7)
    detection = detect(board, view.render(board))
    assert rms(detection.pixels - view.truth(board)[detection.ids]) < 0.1


@pytest.mark.parametrize("roll", [60, 180, *often(0, 300)])
def test_a_symmetric_chessboard_is_numbered_from_the_left(roll: float) -> None:
    view = replace(SMALL, roll=roll, tilt=20, fill=0.65)
    pixels = detect(CHESSBOARD, view.render(CHESSBOARD)).pixels
    truth = view.truth(CHESSBOARD)
    assert rms(pixels - (truth[::-1] if roll == 180 else truth)) < 0.1


def test_hidden_corners_are_counted_not_guessed() -> None:
    with raises(DetectionError, "of 63", "chessboard:9x7:20"):
        detect(CHESSBOARD, replace(SMALL, hide=(-30, -30, 190, 10)).render(CHESSBOARD))


def test_a_stained_corner_is_left_out() -> None:
    view = replace(SMALL, tilt=20)
    image, truth = view.render(CHESSBOARD), view.truth(CHESSBOARD)
    u, v = np.round(truth[30]).astype(int).tolist()
    image[v - 2 : v + 6, u - 2 : u + 6] = 60
    detection = detect(CHESSBOARD, image)
    assert set(range(63)) - set(detection.ids.tolist()) == {30}
    assert rms(detection.pixels - truth[detection.ids]) < 0.1


@pytest.mark.parametrize(
    ("shift", "seen"), [((130, 0), 42), *often(((-130, 0), 42), ((0, 100), 45), ((0, -100), 45))]
)
def test_what_is_in_view_of_a_chessboard_is_numbered_by_its_ends(
    shift: tuple[int, int], seen: int
) -> None:
    view = replace(SMALL, fill=0.6, shift=shift)
    detection = detect(CHESSBOARD, view.render(CHESSBOARD))
    assert abs(len(detection.ids) - seen) <= 9 and not len(detection.others)
    assert rms(detection.pixels - view.truth(CHESSBOARD)[detection.ids]) < 0.1


def test_every_place_of_a_chessboard_that_an_image_allows_is_listed() -> None:
    view = replace(SMALL, fill=0.8, shift=(90, 60))
    image, truth = view.render(CHESSBOARD), view.truth(CHESSBOARD)
    with raises(DetectionError, "of 63", "border"):
        detect(CHESSBOARD, image)
    seen = detect(CHESSBOARD, image, several=True)
    off = [rms(seen.pixels - truth[ids]) for ids in (seen.ids, *seen.others)]
    assert min(off) < 0.1 and len(off) == 4


def test_colours_tell_which_end_of_a_chessboard_is_in_view() -> None:
    board = Board.parse("chessboard:9x6:20")
    view = replace(SMALL, fill=0.8, shift=(90, 60))
    seen = detect(board, view.render(board))
    assert rms(seen.pixels - view.truth(board)[seen.ids]) < 0.1


def test_a_chessboard_without_an_end_in_view_is_refused() -> None:
    board = Board.parse("chessboard:14x9:15")
    with raises(DetectionError, "of 126", "left and the right", "rows"):
        detect(board, replace(SMALL, fill=1.25).render(board), several=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "tilt"),
    [
        ("chessboard:8x7:20", 25),
        ("chessboard:9x6:20", 0),
        *often(("chessboard:7x5:20", 25), ("chessboard:6x7:20", 25)),
    ],
)
def test_a_larger_chessboard_than_stated_is_refused(wrong: str, tilt: float) -> None:
    with raises(DetectionError, wrong, "columns"):
        detect(Board.parse(wrong), replace(SMALL, tilt=tilt).render(CHESSBOARD))


def test_a_hidden_part_of_a_charuco_board_leaves_the_rest() -> None:
    board, view = Board.parse("charuco:7x5:20"), replace(SMALL, fill=0.6, hide=(-30, -30, 30, 90))
    detection = detect(board, view.render(board))
    assert 8 <= len(detection.ids) < len(board.points)
    assert rms(detection.pixels - view.truth(board)[detection.ids]) < 0.1
    mask = board_mask(board, detection, (300, 400))
    whole = board_mask(board, detect(board, replace(view, hide=None).render(board)), (300, 400))
    assert np.count_nonzero(mask != whole) < 0.01 * np.count_nonzero(whole)


def test_too_few_charuco_corners_are_refused() -> None:
    board = Board.parse("charuco:7x5:20")
    with raises(DetectionError, "of 24", "of 17", 8):
        detect(board, replace(SMALL, hide=(-30, -30, 90, 90)).render(board))


def test_a_grid_with_a_misplaced_or_mirrored_feature_is_refused() -> None:
    truth = replace(SMALL, tilt=30, k1=-0.3).truth(CHESSBOARD)
    ids = np.arange(len(truth))
    check_grid(CHESSBOARD, truth, ids, "corners")
    off = truth.copy()
    off[20] += (5.0, 0.0)
    with raises(DetectionError, "grid"):
        check_grid(CHESSBOARD, off, ids, "corners")
    swapped = truth.copy()
    swapped[[20, 21]] = swapped[[21, 20]]
    with pytest.raises(DetectionError):
        check_grid(CHESSBOARD, swapped, ids, "corners")
    with raises(DetectionError, "mirrored"):
        check_grid(CHESSBOARD, truth * (-1, 1), ids, "corners")
    with raises(DetectionError, "8", "line"):
        check_grid(CHESSBOARD, truth[:8], ids[:8], "corners")
