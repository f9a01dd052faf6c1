"""Real photographs: OpenCV's own pictures of circle grids, and a camera and projector capture of a
chessboard."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from variants import crossed, often

from slviewer.errors import DetectionError
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect, recognise_board

pytestmark = pytest.mark.computes

ASYMMETRIC = ("acircles:7x13:10", "acircles:5x5:10", "acircles:3x9:10")
CIRCLES = [("circles", k, "circles:7x7:10") for k in range(1, 15)]
ASYMMETRIC_CIRCLES = [("asymmetric_circles", k, ASYMMETRIC[(k - 1) // 3]) for k in range(1, 10)]
PHOTOGRAPHS = [*CIRCLES[:2], *ASYMMETRIC_CIRCLES[::3], *often(*CIRCLES[2:])]
PHOTOGRAPHS += often(*(each for k, each in enumerate(ASYMMETRIC_CIRCLES) if k % 3))


def photograph(path: Path) -> np.ndarray:
    if not path.exists():
        pytest.skip(f"{path} is not among the real captures")
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize(("folder", "number", "notation"), PHOTOGRAPHS)
def test_circles_are_found_where_opencv_finds_them(
    real_data: Path, folder: str, number: int, notation: str
) -> None:
    prefix = "circles" if folder == "circles" else "acircles"
    image = photograph(real_data / "opencv_circles" / folder / f"{prefix}{number}.png")
    board = Board.parse(notation)
    pixels = detect(board, image).pixels
    text = (real_data / "opencv_circles" / folder / f"{prefix}_corners{number}.dat").read_text()
    centres = np.array(re.search(r"data: \[([^]]*)\]", text).group(1).split(","), float).reshape(
        -1, 2
    )
    apart = np.linalg.norm(pixels[:, None] - centres[None], axis=2)
    assert sorted(apart.argmin(1)) == list(range(len(pixels)))
    # OpenCV's centres are a tenth of a pixel off themselves; the large photograph has large circles
    assert np.median(apart.min(1)) < 0.2 and apart.min(1).max() < 1.0
    grid = pixels.reshape(board.rows, board.columns, 2)
    across, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    assert across[0] * down[1] - across[1] * down[0] > 0


@pytest.mark.parametrize(
    ("notation", "number"),
    crossed(["circles:7x7:10", *ASYMMETRIC, "circles:21x16:9", "charuco:8x6:30"], [1, 2, 3]),
)
def test_boards_that_are_not_there_are_refused(real_data: Path, number: int, notation: str) -> None:
    with pytest.raises(DetectionError):
        detect(
            Board.parse(notation),
            photograph(real_data / "opencv_circles" / "negatives" / f"negative_{number}.png"),
        )


@pytest.mark.parametrize("pose", [0, *often(1, 2, 3, 4)])
def test_a_chessboard_is_found_by_either_notation(real_data: Path, pose: int) -> None:
    image = photograph(real_data / "kamino_procam_jpg90" / f"capture_{pose}" / "graycode_40.jpg")
    tall, wide = Board.parse("chessboard:7x9:75"), Board.parse("chessboard:9x7:75")
    upright, turned = detect(wide, image), detect(tall, image)
    pixels = upright.pixels
    apart = np.linalg.norm(pixels[:, None] - turned.pixels[None], axis=2)
    # the light of one corner ends beside it
    assert len(pixels) >= 62
    assert sorted(apart.argmin(1)) == list(range(len(pixels))) and apart.min(1).max() < 0.02
    for board, found in ((tall, turned), (wide, upright)):
        # a lens of this quality is close to a pinhole: residuals show sub-pixel errors, and paper
        # that is not flat
        points = board.points[found.ids][:, :2]
        H, _ = cv2.findHomography(points, found.pixels)
        left_over = found.pixels - cv2.perspectiveTransform(points[None], H)[0]
        ends = cv2.perspectiveTransform(board.points[None, [0, 8, -1, -9], :2], H)
        assert 0.05 < np.sqrt((left_over**2).sum(1).mean()) < 1.2
    mask = board_mask(wide, upright, image.shape)
    squares = np.abs(cv2.contourArea(np.float32(ends))) / 48
    assert np.count_nonzero(mask) == pytest.approx(9.9 * 7.9 * squares, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("notation", ["chessboard:8x7:75", *often("chessboard:8x6:75")])
def test_a_larger_chessboard_is_named(real_data: Path, notation: str) -> None:
    image = photograph(real_data / "kamino_procam_jpg90" / "capture_2" / "graycode_40.jpg")
    with pytest.raises(DetectionError):
        detect(Board.parse(notation), image)


@pytest.mark.slow
def test_boards_are_recognised_in_photographs_and_nothing_else_is(real_data: Path) -> None:
    kamino, circles = real_data / "kamino_procam_jpg90", real_data / "opencv_circles"
    chessboards = [photograph(kamino / f"capture_{k}" / "graycode_40.jpg") for k in (0, 1, 2)]
    found = recognise_board(chessboards)
    assert found is not None and (found.notation, found.shown) == ("chessboard:9x7", 3)
    grids = [photograph(circles / "circles" / f"circles{k}.png") for k in (1, 2, 3)]
    assert (found := recognise_board(grids)) is not None and found.notation == "circles:7x7"
    negatives = sorted((circles / "negatives").glob("*.png"))
    assert recognise_board(map(photograph, negatives)) is None
