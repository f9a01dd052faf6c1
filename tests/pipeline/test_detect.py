"""Boards in photographs, from the command line to the table and the overlay."""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.cli import main
from slviewer.errors import InputError
from slviewer.pipeline.detect import detect_board

sys.path.insert(0, str(Path(__file__).parents[1] / "target"))
from rendered_board import View

from slviewer.target.board import Board
from slviewer.target.detect import recognise_board

BOARD = Board.parse("circles:7x5:20")
VIEW = View(size=(320, 240), supersample=4, tilt=15, roll=10)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    cv2.imwrite(str(folder / "board.png"), VIEW.render(BOARD))
    cv2.imwrite(str(folder / "wall.png"), np.full((240, 320), 120, np.uint8))
    (folder / "notes.txt").write_text("no image")
    return folder


@pytest.mark.computes
def test_one_photograph_gives_a_table_and_an_overlay(
    photographs: Path, tmp_path: Path, capsys
) -> None:
    overlay, table = tmp_path / "out" / "overlay.png", tmp_path / "out" / "corners.csv"
    image = str(photographs / "board.png")
    assert (
        main(["detect", image, "--target", str(BOARD), "--out", str(overlay), "--csv", str(table)])
        == 0
    )
    printed = capsys.readouterr().out
    assert not missing_facts(printed, "35 of 35 circles") and len(printed.splitlines()) == 37
    rows = list(csv.DictReader(table.open()))
    places = np.array(
        [[float(row[name]) for name in ("index", "x_mm", "y_mm", "u_px", "v_px")] for row in rows]
    )
    np.testing.assert_array_equal(places[:, 0], np.arange(35))
    np.testing.assert_allclose(places[:, 1:3], BOARD.points[:, :2])
    off = np.linalg.norm(places[:, 3:] - VIEW.truth(BOARD), axis=1)
    assert 1e-4 < off.max() < 0.1
    picture, plain = cv2.imread(str(overlay)), VIEW.render(BOARD)
    assert max(picture.shape[:2]) == 1600
    scale = 1600 / 320
    u, v = np.round((VIEW.truth(BOARD)[8] + 0.5) * scale - 0.5).astype(int)
    assert picture[v, u, 0] > picture[v, u, 2] + 50, "a blue cross on a circle"
    assert np.ptp(picture.astype(int), axis=2).max() > 100 and plain.ndim == 2


@pytest.mark.computes
def test_several_photographs_give_a_line_each_and_status_1(
    photographs: Path, tmp_path: Path, capsys
) -> None:
    overlays = tmp_path / "overlays"
    assert main(["detect", str(photographs), "--target", str(BOARD), "--out", str(overlays)]) == 1
    printed = capsys.readouterr()
    assert not missing_facts(printed.out.splitlines()[0], "board.png", "35 of 35")
    assert not missing_facts(printed.out, "wall.png", "1 of 2")
    assert not missing_facts(printed.err, "1 of 2 images")
    assert sorted(path.name for path in overlays.iterdir()) == ["board_board.png", "wall_board.png"]


def test_what_is_no_photograph_is_named(tmp_path: Path) -> None:
    with raises(InputError, "nowhere.png"):
        detect_board([tmp_path / "nowhere.png"], str(BOARD))
    with raises(InputError, tmp_path):
        detect_board([tmp_path], str(BOARD))
    (tmp_path / "broken.png").write_bytes(b"no image")
    result = detect_board([tmp_path], "circles:7x5:20")
    assert result.detected == 0 and "broken.png" in result.images[0].refusal
    assert result.to_json()["images"][0]["detected"] is False


@pytest.mark.computes
def test_corners_that_are_seen_of_a_charuco_board_keep_their_numbers(tmp_path: Path) -> None:
    board = Board.parse("charuco:7x5:20")
    view = View(size=(400, 300), supersample=4, fill=0.6, hide=(-30, -30, 30, 90))
    cv2.imwrite(str(tmp_path / "part.png"), view.render(board))
    result = detect_board([tmp_path / "part.png"], str(board), out=tmp_path / "part_overlay.png")
    found = result.images[0]
    assert found.detected and 8 <= len(found.index) < len(board.points)
    assert not missing_facts(result.text(), f"{len(found.index)} of 24 corners")
    assert [row[1] for row in result.rows()] == found.index


@pytest.mark.computes
@pytest.mark.parametrize("notation", ["circles:7x5:20", "chessboard:8x6:20"])
def test_a_board_is_recognised_but_its_pitch(
    notation: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board, shown = Board.parse(notation), notation.rpartition(":")[0]
    for tilt in (0, 20):
        view = View(size=(320, 240), supersample=3, tilt=tilt, roll=10)
        cv2.imwrite(str(tmp_path / f"{tilt}.png"), view.render(board))
    cv2.imwrite(str(tmp_path / "wall.png"), np.full((240, 320), 120, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"no image")
    assert main(["detect", str(tmp_path)]) == 2
    assert missing_facts(capsys.readouterr().err, "2 of 3", f"--target {shown}:PITCH") == []


@pytest.mark.computes
def test_no_board_is_recognised_where_images_show_none_or_two(tmp_path: Path) -> None:
    wall = np.full((240, 320), 120, np.uint8)
    view = View(size=(320, 240), supersample=3)
    charuco = view.render(Board.parse("charuco:7x5:20"))
    two = [view.render(Board.parse(each)) for each in ("circles:7x5:20", "chessboard:8x6:20")]
    for images in ([wall, wall], [charuco, charuco], two, [wall[:8]], []):
        assert recognise_board(images) is None
