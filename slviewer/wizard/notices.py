"""Messages for the operator, one sentence each."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from datetime import datetime

from slviewer.errors import SlviewerError, hide_passwords
from slviewer.wizard.service import log
from slviewer.wizard.snapshot import Level, Notice

MOST_NOTICES = 100


class Notices:
    """The latest notices, oldest first. Every method may be called from any thread."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._latest: deque[Notice] = deque(maxlen=MOST_NOTICES)
        self._count = 0

    def add(self, level: Level, text: str, section: str = "") -> None:
        """Add a notice and log it, without passwords; one of the same text before it is removed.
        `section`: of the help's page of findings."""
        text = hide_passwords(text)
        log.log(logging.getLevelNamesMapping().get(level.upper(), logging.INFO), "%s", text)
        with self._lock:
            self._count += 1
            same = next((each for each in self._latest if each.text == text), None)
            if same is not None:
                self._latest.remove(same)
            self._latest.append(
                Notice(self._count, level, text, datetime.now().astimezone(), section)
            )
        self._changed()

    def add_failure(self, action: str, error: BaseException) -> None:
        """Add what `describe_failure` returns for the error that ended an action
        ("Calibrating")."""
        self.add("error", describe_failure(action, error))

    def clear(self) -> None:
        """Forget the notices: those of another session."""
        with self._lock:
            self._latest.clear()
        self._changed()

    def all(self) -> tuple[Notice, ...]:
        """Return the latest notices, oldest first."""
        with self._lock:
            return tuple(self._latest)


def describe_failure(action: str, error: BaseException) -> str:
    """Describe an error to the operator in one sentence; an unexpected one is logged with its
    traceback."""
    if isinstance(error, SlviewerError):
        return str(error)
    log.error("%s failed", action, exc_info=error)
    if isinstance(error, MemoryError):
        return (
            f"{action} failed: out of memory. Close other programs, or use a smaller camera image"
        )
    if isinstance(error, OSError):
        where = f" ({error.filename})" if error.filename else ""
        return f"{action} failed: {error.strerror or error}{where}"
    return (
        f"{action} failed because of an error in the program ({type(error).__name__}); see the log"
        " for details"
    )
