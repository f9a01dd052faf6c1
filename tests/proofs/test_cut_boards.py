"""Boards cut by the image's border, the light's edge or a hand are numbered right or refused."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.target.board import Board
from slviewer.target.detect import detect
from tests.proofs.cut_boards import CUTS, draw_view, judge_view, prove_cut_boards


@pytest.mark.parametrize("cut", CUTS)
def test_a_cut_board_is_not_numbered_wrongly(cut: str) -> None:
    for notation in ("acircles:4x9:20", "chessboard:9x6:20"):
        board = Board.parse(notation)
        answer, reason = judge_view(draw_view(board, cut, np.random.default_rng([5, len(cut)])))
        assert answer in ("right", "several") or (answer == "refused" and board.kind in reason)


def test_the_proof_recognises_a_wrong_numbering() -> None:
    board = Board.parse("chessboard:9x6:20")
    view = draw_view(board, "border", np.random.default_rng(7))
    detection = detect(board, view.image, several=True)
    assert view.is_right(detection)
    shifted = replace(detection, ids=(detection.ids + 1) % len(board.points), others=())
    assert not view.is_right(shifted)


@pytest.mark.slow
def test_cut_boards_are_proved() -> None:
    proof = prove_cut_boards(0.1, 5, lambda share, stage: None)
    assert proof.holds, proof.text()
