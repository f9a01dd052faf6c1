"""Snapshots for subscribers: one thread makes and publishes them, one for many changes that come together."""

import threading
import time
from collections.abc import Callable

from slviewer.wizard.notices import log
from slviewer.wizard.snapshot import Snapshot

PAUSE_S = 0.05
"""Between two snapshots: a panel needs no more than twenty a second."""


class Publisher:
    """Makes a snapshot when something has changed, and publishes it to every listener.

    `make(version, session_changed)` is called on this thread, or by `now`; never by two at a time.
    """

    def __init__(self, make: Callable[[int, bool], Snapshot], first: Snapshot) -> None:
        self._make = make
        self._making = threading.Lock()
        self._condition = threading.Condition()
        self._changed, self._session_changed, self._closing = False, False, False
        self._latest = first
        self._listeners: dict[int, Callable[[Snapshot], None]] = {}
        self._thread = threading.Thread(target=self._serve, name="slviewer publisher", daemon=True)

    def start(self) -> None:
        """Begin to make snapshots: once everything is there that `make` looks at."""
        self._thread.start()

    def changed(self, session: bool = False) -> None:
        """Something changed; `session`: also what the session's files say."""
        with self._condition:
            self._changed = True
            self._session_changed |= session
            self._condition.notify_all()

    @property
    def latest(self) -> Snapshot:
        return self._latest

    def now(self) -> Snapshot:
        """A snapshot of this moment, published to every listener."""
        self.changed(session=True)
        self._publish()
        return self._latest

    def listen(self, callback: Callable[[Snapshot], None]) -> Callable[[], None]:
        """Call back with every snapshot from now on, on the publisher's thread; returns how to stop that."""
        with self._condition:
            number = max(self._listeners, default=0) + 1
            self._listeners[number] = callback

        def stop() -> None:
            with self._condition:
                self._listeners.pop(number, None)

        return stop

    def wait_for(self, condition: Callable[[Snapshot], bool], timeout_s: float) -> Snapshot | None:
        """The first snapshot for which `condition` holds; None where none came in time."""
        end = time.monotonic() + timeout_s
        with self._condition:
            while not condition(self._latest):
                left = end - time.monotonic()
                if left <= 0 or self._closing:
                    return None
                self._condition.wait(left)
            return self._latest

    def close(self) -> None:
        """End the thread."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        self._thread.join(5.0)

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._changed or self._closing)
                if self._closing:
                    return
            self._publish()
            time.sleep(PAUSE_S)

    def _publish(self) -> None:
        with self._making:
            with self._condition:
                if not self._changed:
                    return
                session = self._session_changed
                self._changed, self._session_changed = False, False
                version = self._latest.version + 1
            try:
                snapshot = self._make(version, session)
            except Exception:
                log.exception("no snapshot could be made")
                return
            with self._condition:
                self._latest = snapshot
                listeners = list(self._listeners.values())
                self._condition.notify_all()
            for listener in listeners:
                try:
                    listener(snapshot)
                except Exception:
                    log.exception("a listener failed")
