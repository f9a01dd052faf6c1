"""What the latest preview frame shows: the board, how bright it is, and whether anything moves.

One thread makes previews and another looks for the board, which takes longer, above all where there is none. For both,
frames that come while they are busy replace one another, so that what is seen is always now.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import cv2
import numpy as np

from slviewer.calibration.next_pose import approximate_pose
from slviewer.errors import DetectionError
from slviewer.geometry.lens import Lens
from slviewer.target.board import Board
from slviewer.target.detect import Detection, detect
from slviewer.target.planar import fit_homography, to_image
from slviewer.wizard.notices import log
from slviewer.wizard.snapshot import BoardSeen, PreviewView

Item = TypeVar("Item")

SEARCH_PX = 800
"""Longest side of the image in which the board is looked for, and which panels show."""
BINS = 64
STILL_PX = 0.004
"""A board whose features move less than this share of the image's width between two looks is held still."""
_REST = 2.0  # a search for the board is followed by a rest so many times as long: a third of one core at most


@dataclass(frozen=True)
class Watch:
    """What to look for: no board where None; `lens` gives its approximate pose."""

    board: Board | None = None
    lens: Lens | None = None


class Latest(Generic[Item]):
    """A thread that does `work(item)` for the latest item it was offered, and forgets those that came before."""

    def __init__(self, name: str, work: Callable[[Item], None], rest: float = 0.0) -> None:
        self._work, self._rest = work, rest
        self._condition = threading.Condition()
        self._item: Item | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def offer(self, item: Item) -> None:
        """Work on this next, instead of any that was not begun yet."""
        with self._condition:
            self._item = item
            self._condition.notify_all()

    def close(self) -> None:
        """End the thread."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self._thread.join(2.0)

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closing or self._item is not None)
                if self._closing:
                    return
                item, self._item = self._item, None
            assert item is not None
            begun = time.monotonic()
            try:
                self._work(item)
            except Exception:  # a frame that cannot be looked at must not end the preview
                log.exception("a preview frame could not be looked at")
            with self._condition:
                self._condition.wait_for(lambda: self._closing, self._rest * (time.monotonic() - begun))


class Watcher:
    """Looks at frames; `seen(view)` is called, on one thread, for each one it looked at."""

    def __init__(self, seen: Callable[[PreviewView], None]) -> None:
        self._seen = seen
        self._watch = Watch()
        self._found: tuple[Watch, BoardSeen | None, str] = (self._watch, None, "")
        self._stillness = Stillness()
        self._number, self._rate, self._last = 0, 0.0, 0.0
        self._finder = Latest("slviewer board finder", self._find, _REST)
        self._viewer = Latest("slviewer watcher", self._look)

    def offer(self, frame: np.ndarray) -> None:
        """Look at `frame` (h, w) next, instead of any that was not looked at yet."""
        self._viewer.offer(frame)

    def look_for(self, watch: Watch) -> None:
        """Look for another board from now on."""
        self._watch = watch

    def close(self) -> None:
        """End both threads."""
        self._viewer.close()
        self._finder.close()

    def _look(self, frame: np.ndarray) -> None:
        now = time.monotonic()
        image, scale = reduced(frame)
        if self._watch.board is not None:
            self._finder.offer((image, scale, now))
        if self._last:
            self._rate += 0.2 * (1 / max(now - self._last, 1e-3) - self._rate)
        self._last = now
        self._number += 1
        watch, board, missing = self._found
        if watch.board != self._watch.board:
            board, missing = None, ""
        rate = round(self._rate, 1)
        self._seen(PreviewView(self._number, image, scale, *brightness(frame), board, missing, None, rate))

    def _find(self, item: tuple[np.ndarray, float, float]) -> None:
        image, scale, taken = item
        watch, board = self._watch, None
        found, missing = find(watch.board, image)
        if found is not None and watch.board is not None:
            # centres of reduced pixels to those of the camera's
            found = replace(found, pixels=(found.pixels + 0.5) / scale - 0.5)
            still = self._stillness.of(found.pixels, STILL_PX * image.shape[1] / scale, taken)
            board = board_seen(watch.board, found, still, watch.lens, taken)
        else:
            self._stillness.lose()
        self._found = (watch, board, missing)


class Stillness:
    """Since when features have stayed where they are."""

    def __init__(self) -> None:
        self._pixels: np.ndarray | None = None
        self._since = 0.0

    def of(self, pixels: np.ndarray, tolerance_px: float, now: float) -> float:
        """Seconds since the features (n, 2) px last moved further than `tolerance_px` from where they came to rest."""
        before = self._pixels
        if before is None or before.shape != pixels.shape or np.abs(pixels - before).max() > tolerance_px:
            self._pixels, self._since = pixels, now
        return now - self._since

    def lose(self) -> None:
        """Nothing is seen any more."""
        self._pixels = None


def reduced(frame: np.ndarray) -> tuple[np.ndarray, float]:
    """(the frame (h, w) as uint8, SEARCH_PX long at most; its scale)."""
    scale = min(1.0, SEARCH_PX / max(frame.shape))
    small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    if small.dtype != np.uint8:
        small = cv2.convertScaleAbs(small, alpha=255 / _top(frame))
    return small, scale


def brightness(frame: np.ndarray) -> tuple[float, float, np.ndarray]:
    """(share of saturated pixels, 99.5th percentile as a share of the range, histogram (64,) of shares)."""
    top = _top(frame)
    some = frame[:: max(1, frame.shape[0] // 400), :: max(1, frame.shape[1] // 400)]
    counts = np.histogram(some, BINS, (0, top + 1))[0]
    return float((some >= top).mean()), float(np.percentile(some, 99.5)) / top, counts / some.size


def find(board: Board | None, image: np.ndarray) -> tuple[Detection | None, str]:
    """The board in a reduced image, or why there is none."""
    if board is None:
        return None, ""
    try:
        return detect(board, image), ""
    except DetectionError as error:
        return None, str(error)


def board_seen(board: Board, found: Detection, still_s: float, lens: Lens | None, taken: float) -> BoardSeen | None:
    """The detected board as a panel draws it."""
    points = board.points[found.ids]
    if len(points) < 4:
        return None
    H = fit_homography(points[:, :2], found.pixels)
    T = None if lens is None else approximate_pose(points, found.pixels, lens)
    return BoardSeen(found.pixels, to_image(H, board.outline()[:, :2]), still_s, T, taken)


def _top(frame: np.ndarray) -> int:
    """The camera's white: cameras of 10, 12 or 14 bits fill part of 16."""
    if frame.dtype == np.uint8:
        return 255
    brightest = int(frame.max(initial=0))
    return next((1 << bits) - 1 for bits in (10, 12, 14, 16) if brightest < 1 << bits)


class HandsFree:
    """Decides when to capture by itself: the board held still for a while, in a place where it was not before."""

    HOLD_S = 1.0
    COUNT_S = 1.0

    def __init__(self) -> None:
        self.on = False
        self._taken: np.ndarray | None = None
        self._just_took = False
        self._asked = 0.0
        self._begun: float | None = None

    def countdown(self, board: BoardSeen | None, busy: bool, now: float) -> float | None:
        """Seconds until the capture, 0 or less: now; None where none is coming."""
        if self._just_took and not busy and board is not None and board.taken > self._asked:
            self._taken, self._just_took = board.outline, False
        if (
            not self.on
            or self._just_took
            or board is None
            or busy
            or board.still_s < self.HOLD_S
            or self._same(board.outline)
        ):
            self._begun = None
            return None
        if self._begun is None:
            self._begun = now
        return self.COUNT_S - (now - self._begun)

    def took(self) -> None:
        """A capture was asked for, by whatever means; where a later picture shows the board counts as taken."""
        self._just_took, self._asked, self._begun = True, time.monotonic(), None

    def _same(self, outline: np.ndarray) -> bool:
        if self._taken is None:
            return False
        size = np.linalg.norm(np.ptp(outline, axis=0))
        return bool(np.abs(outline - self._taken).max() < 0.03 * size)
