"""Threads that serve until they are closed, which the wizard has several of, and their timing."""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from slviewer.calibration.guidance import TRIALS

log = logging.getLogger("slviewer.wizard")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Timing:
    """How often the wizard repeats what it does by itself, and how much it computes each time.

    ``retry_s``: s between two attempts to open devices, or to read files that could not be read.
    ``previews_per_s``: rate of the camera preview. ``trials``: candidates of the next pose whose
    gain is computed. ``hold_s``: s for which a board is held still
    before the hands-free countdown starts, which takes ``count_s``.
    """

    retry_s: float = 2.0
    previews_per_s: float = 10.0
    trials: int = TRIALS
    hold_s: float = 1.0
    count_s: float = 1.0


class Service(ABC):
    """A thread of that name, which runs `_serve` once it is started. It waits on `_condition` for
    work, and returns where `_closing` is set."""

    def __init__(self, name: str) -> None:
        self._condition = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)

    @abstractmethod
    def _serve(self) -> None:
        """Serve until closing."""

    def start(self) -> None:
        """Start the thread, once everything exists that it needs."""
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the thread is alive."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Let the thread end soon."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()

    def close(self) -> None:
        """End the thread; returns within seconds."""
        self.stop()
        if self._thread.ident:
            self._thread.join(5.0)


class LatestWorker(Service, Generic[Item]):
    """A thread that calls `work(item)` with the latest item offered, and drops earlier ones."""

    def __init__(self, name: str, work: Callable[[Item], None], rest: float = 0.0) -> None:
        super().__init__(name)
        self._work, self._rest = work, rest
        self._item: Item | None = None
        self._last: Item | None = None
        self._begun: float | None = None  # of the item in work
        self._thread.start()

    def offer(self, item: Item) -> None:
        """Set the next item, in place of one that is still waiting."""
        with self._condition:
            self._item = item
            self._condition.notify_all()

    @property
    def busy_s(self) -> float:
        """For how many seconds it has worked on an item; 0 while it does not."""
        begun = self._begun
        return 0.0 if begun is None else time.monotonic() - begun

    def repeat(self) -> None:
        """Process the last item once more, unless another one is waiting."""
        with self._condition:
            self._item = self._last if self._item is None else self._item
            self._condition.notify_all()

    def _serve(self) -> None:
        """Process the latest item until closing, pausing `rest` times its duration; failures are
        logged."""
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closing or self._item is not None)
                if self._closing:
                    return
                item, self._last, self._item = self._item, self._item, None
            assert item is not None
            self._begun = begun = time.monotonic()
            try:
                self._work(item)
            except Exception:  # one bad item must not end the thread
                log.exception("%s failed", threading.current_thread().name)
            self._begun = None
            with self._condition:
                self._condition.wait_for(
                    lambda: self._closing, self._rest * (time.monotonic() - begun)
                )
