"""What a preview shows: the board where it is, how bright, how still; and when hands-free
captures."""

import math
import threading

import numpy as np
import pytest
from facts import missing_facts
from wizard_events import HANG_S, until

from slviewer.calibration.next_pose import nominal_lens
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.gui.widgets import draw_preview
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from slviewer.wizard import preview_watcher
from slviewer.wizard.preview_watcher import (
    HandsFree,
    Stillness,
    Watch,
    Watcher,
    brightness,
    reduced,
)
from slviewer.wizard.service import Timing
from slviewer.wizard.snapshot import BoardSeen, PreviewView

BOARD = Board.parse("circles:9x7:20")


def seen(still_s: float, shift: float = 0.0, time_s: float = math.inf) -> BoardSeen:
    outline = np.array([[10.0, 10], [90, 10], [90, 70], [10, 70]]) + shift
    return BoardSeen(outline, outline, still_s, None, time_s)


@pytest.mark.computes
def test_the_board_is_found_in_the_cameras_pixels() -> None:
    rig = letter(0.6, local_distortion_px=0)
    middle = (BOARD.points.min(0) + BOARD.points.max(0)) / 2
    scene = printed_board(BOARD, Pose(np.eye(3), np.array([0, 0, 620.0]) - middle))
    white = PatternSequence(rig.projector.size, (Frame("white"),))
    frame = Renderer(rig, scene).capture(white)[0]
    assert reduced(frame)[1] < 1
    found: list[PreviewView] = []
    arrived = threading.Event()

    def see(view: PreviewView) -> None:
        if view.board is not None:
            found.append(view)
            arrived.set()

    watcher = Watcher(see)
    watcher.watch = Watch(BOARD, nominal_lens(rig.camera.size, 3555.6 * 0.6))

    watcher.offer(frame)  # and no other one: the scene may stay the same
    assert arrived.wait(HANG_S)
    watcher.close()
    board = found[0].board
    assert board is not None
    truth = rig.camera.project(scene.pose.to_camera(BOARD.points))
    assert 0.001 < np.abs(board.pixels - truth).max() < 0.5
    assert board.T_camera_board is not None
    np.testing.assert_allclose(board.T_camera_board[:3, 3], scene.pose.t, atol=6)
    assert (
        found[0].image.shape[1] == 800
        and 0.7 < found[0].brightest < 0.95
        and found[0].saturated == 0
    )


@pytest.mark.computes
def test_an_image_is_searched_again_only_once_something_has_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[np.ndarray] = []

    def detect_nothing(board: Board | None, image: np.ndarray) -> tuple[None, str]:
        searched.append(image)
        return None, "no board"

    monkeypatch.setattr(preview_watcher, "detect_in_preview", detect_nothing)
    rig = letter(0.25, local_distortion_px=0)
    white = PatternSequence(rig.projector.size, (Frame("white"),))
    watcher = Watcher(lambda view: None)
    watcher.watch = Watch(BOARD)
    try:
        for shift_mm, seed, count in ((0, 0, 1), (0, 1, 1), (0.5, 2, 2), (0.5, 3, 2)):  # 0.7 px
            scene = printed_board(BOARD, Pose(np.eye(3), np.array([shift_mm - 80, -60, 620.0])))
            watcher._detect((Renderer(rig, scene).capture(white, seed)[0], 1.0, 0.0))
            assert len(searched) == count
        watcher.watch = Watch(Board.parse("circles:7x5:20"))
        watcher._detect((searched[-1], 1.0, 0.0))
        assert len(searched) == 3
    finally:
        watcher.close()


def test_only_the_latest_frame_is_looked_at() -> None:
    begun, go_on, views = threading.Event(), threading.Event(), []

    def slow(view: PreviewView) -> None:
        views.append(view)
        begun.set()
        go_on.wait(HANG_S)

    watcher = Watcher(slow)
    watcher.offer(np.zeros((60, 80), np.uint8))
    assert begun.wait(HANG_S)
    for level in range(1, 100):
        watcher.offer(np.full((60, 80), level, np.uint8))
    go_on.set()
    until(lambda: len(views) >= 2)
    watcher.close()
    assert [view.image[0, 0] for view in views] == [0, 99]


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 4095)])
def test_brightness_goes_by_the_cameras_range(dtype: type, white: int) -> None:
    frame = np.full((300, 400), white // 2, dtype)
    frame[:30] = white
    saturated, brightest, histogram = brightness(frame)
    assert (
        saturated == pytest.approx(0.1, abs=0.005)
        and brightest == 1
        and histogram.sum() == pytest.approx(1)
    )
    assert histogram.argmax() == 31 and histogram[-1] == pytest.approx(0.1, abs=0.005)
    assert reduced(frame)[0].dtype == np.uint8


def test_what_is_no_image_is_striped_and_its_brightness_does_not_count() -> None:
    frame = np.full((300, 400), 100, np.uint8)
    frame[:, :100] = 255  # a bar
    image = np.indices(frame.shape)[1] >= 100
    assert brightness(frame)[0] > 0.2
    saturated, brightest, histogram = brightness(frame, image=image)
    assert saturated == 0 and brightest == pytest.approx(100 / 255)
    assert histogram.sum() == pytest.approx(1)
    grey = np.minimum(frame, 200)
    preview = PreviewView(1, grey, 1.0, saturated, brightest, histogram, None, "", None, 10.0)
    plain, striped = draw_preview(preview), draw_preview(preview, image=image)
    differs = (plain != striped).any(axis=2)
    quarter = striped.shape[1] // 4
    assert not differs[:, quarter:].any() and 0.3 < differs[:, :quarter].mean() < 0.7


def test_stillness_starts_anew_with_every_movement() -> None:
    still, pixels = Stillness(), np.zeros((5, 2))
    assert still.update(pixels, 1.0, 10.0) == 0
    assert still.update(pixels + 0.5, 1.0, 11.0) == 1
    assert still.update(pixels + 2, 1.0, 12.0) == 0
    assert still.update(pixels + 2, 1.0, 12.7) == pytest.approx(0.7)
    still.reset()
    assert still.update(pixels + 2, 1.0, 13.0) == 0
    # a slow drift is movement too
    drift = Stillness()
    assert max(drift.update(pixels + 0.3 * k, 1.0, float(k)) for k in range(10)) <= 3


def test_hands_free_counts_down_once_a_place() -> None:
    hands_free = HandsFree(Timing())
    assert hands_free.countdown(seen(7), False, 0) is None
    hands_free.is_on = True
    assert (
        hands_free.countdown(None, False, 0) is None
        and hands_free.countdown(seen(0.5), False, 0) is None
    )
    assert hands_free.countdown(seen(7), False, 1.0) == 1.0  # a slow look skips no countdown
    assert hands_free.countdown(seen(7.25), False, 1.25) == pytest.approx(0.75)
    assert hands_free.countdown(seen(0.1), False, 1.5) is None  # moved: it begins anew
    assert hands_free.countdown(seen(1.25), False, 3.0) == 1.0
    assert hands_free.countdown(seen(1.25), True, 3.5) is None
    assert hands_free.countdown(seen(1.5), False, 4.0) == 1.0
    last = hands_free.countdown(seen(2.6), False, 5.1)
    assert last is not None and last < 0
    hands_free.note_capture()
    assert hands_free.countdown(seen(2.6), True, 6.0) is None
    # what is still known from before the capture is of the place before, perhaps
    assert hands_free.countdown(seen(9, shift=-30, time_s=0.0), False, 6.5) is None
    assert hands_free.countdown(seen(5), False, 7.0) is None
    assert hands_free.countdown(seen(1.5, shift=30), False, 8.0) == 1.0


def test_hands_free_names_what_it_waits_for() -> None:
    hands_free = HandsFree(Timing())
    hands_free.countdown(None, False, 0)
    assert hands_free.awaited == ""
    hands_free.is_on = True
    for board, busy, facts in (
        (None, False, ("in view",)),
        (seen(0.2), False, ("hold",)),
        (seen(2), False, ("still", "1.0 s")),
        (seen(2), True, ()),
    ):
        hands_free.countdown(board, busy, 1.0)
        assert missing_facts(hands_free.awaited, *facts) == [] and bool(facts) == bool(
            hands_free.awaited
        )


def test_hands_free_captures_a_board_that_is_moved_while_it_is_captured() -> None:
    hands_free = HandsFree(Timing())
    hands_free.is_on = True
    hands_free.countdown(seen(2), False, 1.0)
    due = hands_free.countdown(seen(4), False, 3.0)
    assert due is not None and due <= 0
    hands_free.note_capture()
    assert hands_free.countdown(seen(0.1, shift=30), True, 4.0) is None
    # the first image after the capture shows the board at its next place
    assert hands_free.countdown(seen(2, shift=30), False, 5.0) == 1.0
    assert hands_free.countdown(seen(9), False, 6.0) is None and hands_free.needs_move
