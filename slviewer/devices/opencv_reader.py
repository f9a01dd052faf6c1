"""One video capture on a thread of its own, which alone knows which of its pictures are new.

Calls into a capture may block for as long as a driver or a network likes, so that callers who need
a picture wait here, and not longer than `StreamTiming.patience_s`. A live source is read without a
break, wanted or not: unread pictures accumulate in the buffers of the driver, of the network and of
the sender, and arrive later as if they were new.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from copy import copy
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np

from slviewer.errors import DeviceError

FRAMES = 3
"""The exposure of the first picture that arrives after a request started before it. So may the
second have been, by a sensor that exposes its next picture while it reads out the previous one;
that of the third started after it.
"""

_WINDOW_S = 4.0
_SATURATED = 0.95

T = TypeVar("T")


@dataclass(frozen=True)
class StreamTiming:
    """How long a reader waits, in s of `clock`.

    `patience_s`: without a picture for so long, a source is lost. `opening_s`: a webcam's driver
    may take seconds to start it. `warm_up_s`: a live source's first pictures, which may be dark,
    are discarded for so long. `ended_s`: a source that refuses its next picture for so long gives
    no more.
    """

    patience_s: float = 2.5
    opening_s: float = 6.0
    warm_up_s: float = 0.5
    ended_s: float = 0.5
    clock: Callable[[], float] = time.monotonic


TIMING = StreamTiming()
"""For real sources."""


@dataclass(frozen=True)
class Connected:
    """An open capture. One that is not `live` gives its next picture on request; where not even
    `grab_waits` for a picture of a live one, `read` does.
    """

    capture: cv2.VideoCapture
    live: bool
    grab_waits: bool = True


class Pace:
    """Distinguishes new pictures from buffered ones by the rhythm of their arrival."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[float, float]] = deque()

    def add(self, now: float, busy: float) -> float | None:
        """Add a picture that arrived at `now` s, when the reader had computed for `busy` s in all.

        Returns the time since the previous one in mean frame periods; None before three have
        arrived. The mean is over seconds, so that pictures which come in clumps, or in a flood
        after a pause, do not shorten it.
        """
        arrivals = self._arrivals
        periods = None
        if len(arrivals) > 2:
            mean = (arrivals[-1][0] - arrivals[0][0]) / (len(arrivals) - 1)
            periods = (now - arrivals[-1][0]) / max(mean, 1e-6)
        arrivals.append((now, busy))
        # a pause stays until its flood has gone by
        while len(arrivals) > 3 and arrivals[1][0] < now - _WINDOW_S:
            arrivals.popleft()
        return periods

    @property
    def saturated(self) -> bool:
        """Whether the reader never waits: it is slower than the source, and what it reads is always
        late."""
        (start, idle), (end, busy) = self._arrivals[0], self._arrivals[-1]
        return end - start > _WINDOW_S / 2 and busy - idle > _SATURATED * (end - start)


class _Wanted:
    """A requested picture: the last of the next `frames` new ones."""

    def __init__(self, frames: int) -> None:
        self.remaining = frames
        self.paused = False
        self.image: np.ndarray | None = None


class Reader:
    """Reads the capture that `connect` opens, until `close`. Its methods are called from one other
    thread.

    `connect` may raise DeviceError. So does every method once the source is lost: make another
    reader then.
    """

    def __init__(
        self, name: str, connect: Callable[[], Connected], timing: StreamTiming = TIMING
    ) -> None:
        self._name, self._connect, self._timing = name, connect, timing
        self._condition = threading.Condition()
        self._jobs: deque[tuple[Callable[[cv2.VideoCapture], Any], Future[Any]]] = deque()
        self._wanted: _Wanted | None = None
        self._first: np.ndarray | None = None
        self._arrived = timing.clock()
        self._lost: DeviceError | None = None
        self._closing = False
        self._live = False
        self._pace = Pace()
        self._thread = threading.Thread(target=self._serve, name=f"slviewer {name}", daemon=True)
        self._thread.start()

    @property
    def live(self) -> bool:
        """Whether pictures come by themselves."""
        return self._live

    def first(self) -> np.ndarray:
        """Wait for the first valid picture, (h, w, 3) BGR or (h, w), once the source is open.
        Raises DeviceError."""
        with self._condition:
            self._wait_until(lambda: self._first is not None, self._timing.opening_s)
            assert self._first is not None
            return self._first

    def do(self, work: Callable[[cv2.VideoCapture], T]) -> T:
        """Run `work(capture)` on the reader's thread between two pictures; returns its result."""
        job: Future[T] = Future()
        with self._condition:
            self._jobs.append((work, job))
            self._condition.notify_all()
            self._wait_until(job.done, self._timing.patience_s)
        return job.result()

    def picture(self, later: int = 0) -> np.ndarray:
        """Wait for a live source's first picture (h, w, 3) BGR exposed after this call, or `later`
        pictures after it.

        The delay within an encoder and a network cannot be measured here: the rig measures it and
        waits for it.
        """
        wanted, patience_s = _Wanted(FRAMES + later), self._timing.patience_s
        with self._condition:
            self._wanted = wanted
            try:
                # some sources may be slow and others may come in clumps: the end is when nothing
                # counts for too long
                self._wait_until(
                    lambda: wanted.image is not None, patience_s, patience_s * wanted.remaining
                )
            finally:
                self._wanted = None
        assert wanted.image is not None
        return wanted.image

    def close(self) -> None:
        """Release the capture, at once or when it returns from a blocking call."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self.join(0.5)

    def join(self, timeout_s: float) -> None:
        """Wait until the capture is released."""
        self._thread.join(timeout_s)

    def _wait_until(
        self, ready: Callable[[], bool], patience_s: float, longest_s: float = 0.0
    ) -> None:
        """Wait for `ready()` on the condition. Raises DeviceError once no picture has come for
        `patience_s`."""
        requested_s = self._timing.clock()
        while not ready():
            if self._lost:
                raise copy(self._lost)
            now = self._timing.clock()
            silent = now - max(self._arrived, requested_s) if longest_s else now - requested_s
            if silent > patience_s:
                raise DeviceError(
                    f"{self._name} gave no picture within {patience_s:g} s",
                    "check its cable and whether another program uses it",
                )
            if longest_s and now - requested_s > longest_s:
                raise DeviceError(
                    f"the pictures of {self._name} arrive too irregularly to separate new from"
                    " buffered ones",
                    "use a cable instead of a radio link, or a lower frame rate",
                )
            self._condition.wait(0.1)

    # on its own thread

    def _serve(self) -> None:
        """Open the source, run jobs and read pictures until closing; store why the source was
        lost."""
        capture = None
        try:
            connected = self._connect()
            capture = connected.capture
            self._read_first(connected)
            while not self._closing:
                with self._condition:
                    if not connected.live:
                        self._condition.wait_for(lambda: self._jobs or self._closing)
                    jobs = list(self._jobs)
                    self._jobs.clear()
                for work, job in jobs:
                    try:
                        job.set_result(work(capture))
                    except Exception as error:
                        job.set_exception(error)
                if jobs:
                    with self._condition:
                        self._condition.notify_all()
                if connected.live and not self._closing:
                    self._read_next(connected)
        except DeviceError as error:
            self._report_loss(error)
        except Exception as error:
            self._report_loss(
                DeviceError(f"{self._name} failed ({error})", "close it and open it again")
            )
        finally:
            if capture is not None:
                capture.release()

    def _read_first(self, connected: Connected) -> None:
        """Read the first valid picture; the earliest may be dark, or from buffers filled while
        opening."""
        timing = self._timing
        start_s = timing.clock()
        read, image = connected.capture.read()
        frames = 1
        while connected.live and not self._closing:
            late = timing.clock() - start_s
            if (read and frames > 2 and late > timing.warm_up_s) or (
                not read and late > timing.patience_s
            ):
                break
            if not read:
                time.sleep(0.02)
            read, image = connected.capture.read()
            frames += read
        if not read:
            raise DeviceError(
                f"{self._name} was detected and gives no picture",
                "check whether another program uses it, or choose another size",
            )
        with self._condition:
            self._first, self._live, self._arrived = image, connected.live, timing.clock()
            self._condition.notify_all()

    def _read_next(self, connected: Connected) -> None:
        """Read the next picture of a live source, decoded only if it is the requested one."""
        image = None
        if connected.grab_waits:
            read = connected.capture.grab()
        else:
            read, image = connected.capture.read()
        now = self._timing.clock()
        if not read:
            if now - self._arrived > self._timing.ended_s:
                raise DeviceError(
                    f"{self._name} gives no more pictures",
                    "plug it in or start it again, and reconnect",
                )
            time.sleep(0.01)
            return
        self._arrived = now
        periods = self._pace.add(now, time.thread_time())
        wanted = self._wanted
        # None, or hard on the one before: out of a buffer
        if wanted is None or periods is None or periods < 0.5:
            return
        # after a pause of the reader's own, the first of those that waited
        if periods > 2 and not wanted.paused:
            wanted.paused = True
            return
        wanted.remaining -= 1
        if wanted.remaining > 0:
            return
        if self._pace.saturated:
            raise DeviceError(
                f"{self._name} sends pictures faster than this computer can unpack them, so that"
                " they grow old",
                "lower their size or their rate",
            )
        if image is None:
            read, image = connected.capture.retrieve()
        if read:
            with self._condition:
                wanted.image = image
                self._condition.notify_all()

    def _report_loss(self, why: DeviceError) -> None:
        """Store why the source was lost, and wake those that wait."""
        with self._condition:
            self._lost = why
            self._condition.notify_all()
