"""What the operator is told: one sentence at a time, whatever happened."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from datetime import datetime

from slviewer.errors import SlviewerError
from slviewer.wizard.snapshot import Level, Notice

log = logging.getLogger("slviewer.wizard")

KEPT = 100


class Notices:
    """The latest notices, oldest first. Every method may be called from any thread."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._kept: deque[Notice] = deque(maxlen=KEPT)
        self._count = 0

    def tell(self, level: Level, text: str) -> None:
        """Add a sentence."""
        log.log({"warning": logging.WARNING, "error": logging.ERROR}.get(level, logging.INFO), "%s", text)
        with self._lock:
            self._count += 1
            self._kept.append(Notice(self._count, level, text, datetime.now().astimezone()))
        self._changed()

    def fail(self, doing: str, error: BaseException) -> None:
        """Say that something failed, in the words of `words_for`."""
        self.tell("error", words_for(doing, error))

    def all(self) -> tuple[Notice, ...]:
        """What is kept."""
        with self._lock:
            return tuple(self._kept)


def words_for(doing: str, error: BaseException) -> str:
    """One plain sentence for an error; what nobody foresaw goes to the log with its traceback."""
    if isinstance(error, SlviewerError):
        return str(error)
    log.error("%s failed", doing, exc_info=error)
    if isinstance(error, MemoryError):
        return f"{doing} failed: the memory is full; close other programs, or use a smaller camera image"
    if isinstance(error, OSError):
        where = f" ({error.filename})" if error.filename else ""
        return f"{doing} failed: {error.strerror or error}{where}"
    return f"{doing} failed because of an error in the program ({type(error).__name__}); the log holds its details"
