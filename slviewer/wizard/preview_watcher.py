"""Analyses the latest preview frame: the board, how bright it is, and whether anything moves.

One thread makes previews and another detects the board, which takes longer, above all where there
is none. Frames that arrive while a thread is busy replace one another, so that the latest is always
the one analysed next.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.calibration.next_pose import approximate_pose
from slviewer.errors import DetectionError
from slviewer.fringe.layout import image_white, to_eight_bits
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Mask
from slviewer.target.board import Board, Detection
from slviewer.target.detect import detect
from slviewer.target.planar import fit_homography, to_image
from slviewer.wizard.service import LatestWorker, Timing
from slviewer.wizard.snapshot import BoardSeen, PreviewView

SEARCH_PX = 800
"""Longest side of the image in which the board is detected, and which panels show."""
BINS = 64
STILL_PX = 0.004
"""A board whose features move less than this share of the image's width between two looks is held
still."""
# 99 % of a thumbnail's grey levels differ by less where nothing moved: a board's edges, by a fifth
# of a px
_UNCHANGED = 6.0
_THUMBNAIL_PX = 160
_REST = 2.0  # pause after a detection, as a multiple of its duration: a third of one core at most


@dataclass(frozen=True)
class Watch:
    """What to detect in previews: no board where None; `lens` gives its approximate pose; `image`
    (h, w) bool: the pixels whose brightness counts, all if None."""

    board: Board | None = None
    lens: Lens | None = None
    image: Mask | None = None


class Watcher:
    """Analyses preview frames; `analysed(view)` is called after each, on one thread."""

    def __init__(self, analysed: Callable[[PreviewView], None]) -> None:
        self._analysed = analysed
        self.watch = Watch()  # what to detect from now on
        self._result: tuple[Watch, BoardSeen | None, str] = (self.watch, None, "")
        self._stillness = Stillness()
        # the board, and a thumbnail of the last image
        self._searched: tuple[Board | None, np.ndarray] = (None, np.zeros((0, 0), np.uint8))
        self._detected: tuple[Detection | None, str] = (None, "")
        self._number, self._rate, self._last = 0, 0.0, 0.0
        self._frame: np.ndarray | None = None  # the latest
        self._detector = LatestWorker("slviewer board detection", self._detect, _REST)
        self._viewer = LatestWorker("slviewer preview", self._make_preview)

    def offer(
        self,
        frame: np.ndarray,
        full_scale: int | None = None,
        second: np.ndarray | None = None,
    ) -> None:
        """Analyse `frame` (h, w) next, instead of any that is still waiting; `full_scale` is what
        the camera states, `second` a second camera's frame, to be shown with it."""
        self._viewer.offer((frame, full_scale, second))

    def repeat(self) -> None:
        """Analyse the latest frame once more: another board is to be detected."""
        self._viewer.repeat()

    def close(self) -> None:
        """End both threads."""
        self._viewer.close()
        self._detector.close()

    def _make_preview(self, item: tuple[np.ndarray, int | None, np.ndarray | None]) -> None:
        """Reduce a frame (h, w), offer it for board detection, and publish a preview with the
        latest detection.

        ``item``: as of `offer`.
        """
        now = time.monotonic()
        frame, full_scale, second = item
        image, scale = reduced(frame, full_scale=full_scale)
        white = image_white(frame, full_scale)
        if self.watch.board:
            self._detector.offer((image, scale, now))
        if frame is not self._frame:  # repeated for what has changed besides
            if self._last:
                self._rate += 0.2 * (1 / max(now - self._last, 1e-3) - self._rate)
            self._last, self._frame = now, frame
        self._number += 1
        watch, board, missing = self._result
        if watch.board != self.watch.board:
            board, missing = None, ""
        rate = round(self._rate, 1)
        light = brightness(frame, white, self.watch.image)
        level = to_eight_bits(np.array([[white]], frame.dtype), full_scale, int(frame.max()))
        image = np.where(image < level, image, np.uint8(255))
        beside = None if second is None else reduced(second, full_scale=full_scale)[0]
        shown = self._number, image, scale, *light, board, missing, None, rate
        self._analysed(PreviewView(*shown, second=beside))

    def _detect(self, item: tuple[np.ndarray, float, float]) -> None:
        """Detect the board in (reduced image, its scale, time in s), and store it, or why there is
        none.

        An image in which nothing has moved is not searched again. What is detected is published
        with the same frame once more, as another one may not come.
        """
        image, scale, time_s = item
        watch, board = self.watch, None
        thumbnail = reduced(image, _THUMBNAIL_PX)[0]
        board_before, before = self._searched
        is_searched = (
            board_before != watch.board
            or before.shape != thumbnail.shape
            or float(np.percentile(cv2.absdiff(thumbnail, before), 99)) >= _UNCHANGED
        )
        if is_searched:
            self._searched = watch.board, thumbnail
            self._detected = detect_in_preview(watch.board, image)
        detection, missing = self._detected
        if detection and watch.board:
            # centres of reduced pixels to those of the camera's
            detection = replace(detection, pixels=(detection.pixels + 0.5) / scale - 0.5)
            still = self._stillness.update(
                detection.pixels, STILL_PX * image.shape[1] / scale, time_s
            )
            points, pixels = watch.board.points[detection.ids], detection.pixels
            if len(points) >= 4:
                H = fit_homography(points[:, :2], pixels)
                outline = to_image(H, watch.board.outline()[:, :2])
                T = approximate_pose(points, pixels, watch.lens) if watch.lens else None
                board = BoardSeen(pixels, outline, still, T, time_s)
        else:
            self._stillness.reset()
        self._result = (watch, board, missing)
        if is_searched:
            self.repeat()


class Stillness:
    """Measures for how long detected features have not moved."""

    def __init__(self) -> None:
        self._pixels: np.ndarray | None = None
        self._since = 0.0

    def update(self, pixels: np.ndarray, tolerance_px: float, now: float) -> float:
        """Return the seconds since features (n, 2) px last moved more than `tolerance_px` from
        their rest position."""
        before = self._pixels
        if (
            before is None
            or before.shape != pixels.shape
            or np.abs(pixels - before).max() > tolerance_px
        ):
            self._pixels, self._since = pixels, now
        return now - self._since

    def reset(self) -> None:
        """Forget the features: the board is no longer detected."""
        self._pixels = None


def reduced(
    frame: np.ndarray, longest_px: int = SEARCH_PX, full_scale: int | None = None
) -> tuple[np.ndarray, float]:
    """Reduce a frame (h, w) to uint8 with at most ``longest_px`` on its longer side; returns
    (image, scale)."""
    scale = min(1.0, longest_px / max(frame.shape))
    small = (
        cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else frame
    )
    return to_eight_bits(small, full_scale, int(frame.max(initial=0))), scale


def brightness(
    frame: np.ndarray, white: float | None = None, image: Mask | None = None
) -> tuple[float, float, np.ndarray]:
    """Return (share of saturated pixels, 99.5th percentile as a share of the range, histogram (64,)
    of shares); ``white``: level at which the camera clips, by default that of the frame; ``image``
    (h, w) bool: the pixels that count, all if None."""
    white = image_white(frame) if white is None else white
    sample = np.s_[:: max(1, frame.shape[0] // 400), :: max(1, frame.shape[1] // 400)]
    some = frame[sample]
    if image is not None and image.shape == frame.shape and image[sample].any():
        some = some[image[sample]]
    some = np.minimum(some, int(white))
    brightest = float(np.percentile(some, 99.5, method="inverted_cdf"))
    shares = np.histogram(some, BINS, (0, white + 1))[0] / some.size
    return float(np.mean(some >= int(white))), brightest / white, shares


def detect_in_preview(board: Board | None, image: np.ndarray) -> tuple[Detection | None, str]:
    """Detect the board in a reduced image; returns (detection, "") or (None, why it was not
    detected)."""
    if board is None:
        return None, ""
    try:
        return detect(board, image, several=True), ""  # as calibrations do
    except DetectionError as error:
        return None, str(error)


SHOW = "Hands-free waits for the board: hold it in view of the camera."
MOVE = "Hands-free waits: move the board to the dashed outline, then hold it still."
HOLD = "Hands-free waits: hold the board still."


class HandsFree:
    """Decides when to capture hands-free: a countdown after the board was held still in a new
    place."""

    def __init__(self, timing: Timing) -> None:
        self._timing = timing
        self.is_on = False
        self.awaited = ""
        """What it waits for before it captures; empty while it is off, and while anything is
        captured."""
        self._captured: np.ndarray | None = None  # the board's outline at the last capture
        self._requested = -math.inf  # when the last capture was
        self._is_place_unknown = False  # of the last capture, until the board is detected after it
        self._due: np.ndarray | None = None  # the outline at which a capture is due
        self._begun: float | None = None

    @property
    def needs_move(self) -> bool:
        """Whether the board still is where it was captured last."""
        return self.awaited == MOVE

    def countdown(self, board: BoardSeen | None, busy: bool, now: float) -> float | None:
        """Return the seconds until the capture, 0 or less when it is due; None where none is
        coming."""
        is_fresh = board is not None and board.time_s > self._requested
        if self._is_place_unknown and not busy and board and is_fresh:
            self._captured, self._is_place_unknown = board.outline, False
        self.awaited = self._find_obstacle(board if is_fresh else None, busy)
        if self.awaited or busy or not self.is_on or board is None:
            self._begun = self._due = None
            return None
        if self._begun is None:
            self._begun = now
        remaining_s = self._timing.count_s - (now - self._begun)
        self._due = board.outline if remaining_s <= 0 else None
        self.awaited = f"Hold the board still: {max(remaining_s, 0):.1f} s."
        return remaining_s

    def _find_obstacle(self, board: BoardSeen | None, busy: bool) -> str:
        """Return what must happen before the countdown; empty where it may run."""
        if busy or not self.is_on:
            return ""
        if board is None:
            return SHOW
        if self._captured is not None:
            size = np.linalg.norm(np.ptp(board.outline, axis=0))
            if np.abs(board.outline - self._captured).max() < 0.03 * size:  # the same place
                return MOVE
        return "" if board.still_s >= self._timing.hold_s else HOLD

    def note_capture(self) -> None:
        """Note that a capture was requested: its place is where a capture was due, else the board's
        outline in the next preview."""
        self._is_place_unknown = self._due is None
        if self._due is not None:
            self._captured = self._due
        self._requested, self._begun, self._due = time.monotonic(), None, None
