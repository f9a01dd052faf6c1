"""A thread that serves until it is closed, which the wizard has several of."""

import threading
from abc import ABC, abstractmethod


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

    def close(self) -> None:
        """End the thread; returns within seconds."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        if self._thread.ident:
            self._thread.join(5.0)
