"""Snapshots for listeners: one thread builds and publishes them, one for many changes that come
together."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Generic

from slviewer.wizard.jobs import describe_failure
from slviewer.wizard.service import Item, Service, log
from slviewer.wizard.snapshot import Snapshot

PAUSE_S = 0.05
"""Between two snapshots: a panel needs no more than twenty a second."""
REFRESH_S = 30.0
PULSE_S = 1.0
"""Between two snapshots while a job runs and reports nothing."""


class Listeners(Generic[Item]):
    """Callbacks, all called by one thread; they may be added and removed by any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callbacks: tuple[Callable[[Item], None], ...] = ()

    def add(self, callback: Callable[[Item], None]) -> Callable[[], None]:
        """Add a callback for every later item; returns a function that removes it."""

        def remove() -> None:
            """Remove the callback."""
            with self._lock:
                self._callbacks = tuple(each for each in self._callbacks if each is not callback)

        with self._lock:
            self._callbacks += (callback,)
        return remove

    def call(self, item: Item) -> None:
        """Call every callback with the item; one that fails is logged."""
        for callback in self._callbacks:
            try:
                callback(item)
            except Exception:
                log.exception("a listener failed")


class Publisher(Service):
    """Builds a snapshot when something has changed, and publishes it to every listener.

    Where that fails, the last snapshot is published again with the reason as its `read_failure`,
    and another is built every ``retry_s`` until one succeeds.

    `build(version, session_changed)` and the listeners are called on the publisher's thread alone.
    """

    def __init__(
        self, build: Callable[[int, bool], Snapshot], first: Snapshot, retry_s: float
    ) -> None:
        super().__init__("slviewer publisher")
        self._build, self._retry_s = build, retry_s
        self._requested = self._published = 0  # changes: counted, and those that listeners know
        self._session_changed = self._urgent = False
        self.latest = first
        self.listeners = Listeners[Snapshot]()

    def mark_changed(self, session: bool = False) -> None:
        """Request a snapshot; `session`: the session's files have changed too."""
        with self._condition:
            self._requested += 1
            self._session_changed |= session
            self._condition.notify_all()

    def refresh(self) -> Snapshot:
        """Build and publish a new snapshot now, and return it. Not to be called by a listener."""
        self.mark_changed(session=True)
        with self._condition:
            wanted, self._urgent = self._requested, True
            self._condition.notify_all()
            self._condition.wait_for(lambda: self._published >= wanted or self._closing, REFRESH_S)
            return self.latest

    @property
    def is_current(self) -> bool:
        """Whether the latest snapshot contains every change, and every listener has been called
        with it."""
        with self._condition:
            return self._requested == self._published

    def wait_for(self, condition: Callable[[Snapshot], bool], timeout_s: float) -> Snapshot | None:
        """Wait for the first snapshot for which `condition` holds, and return it; None after
        `timeout_s`."""
        with self._condition:
            self._condition.wait_for(lambda: condition(self.latest) or self._closing, timeout_s)
            return self.latest if condition(self.latest) else None

    def _find_pause_s(self) -> float | None:
        """Return after how long another snapshot is published without a change: while a job or
        a plan is computed, its seconds count."""
        return PULSE_S if self.latest.job or self.latest.content.pending_plan else None

    def _serve(self) -> None:
        """Build and publish a snapshot after each batch of changes, or after a failure, until
        closing."""
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._requested > self._published or self._closing,
                    self._retry_s if self.latest.read_failure else self._find_pause_s(),
                )
                if self._closing:
                    return
                requested = self._requested
                session = self._session_changed or bool(self.latest.read_failure)
                self._session_changed = self._urgent = False
            version = self.latest.version + 1
            try:
                snapshot = self._build(version, session)
            except Exception as error:
                failure = describe_failure("Updating the page", error)
                snapshot = replace(self.latest, version=version, read_failure=failure)
            with self._condition:
                self.latest = snapshot
                self._condition.notify_all()
            self.listeners.call(snapshot)
            with self._condition:
                self._published = requested
                self._condition.notify_all()
                self._condition.wait_for(lambda: self._urgent or self._closing, PAUSE_S)
