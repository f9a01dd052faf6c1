"""Which browsers have drawn the updates sent to them, so that each is updated at its own pace.

A browser answers a question once all that was sent before it has been drawn, so that an answer
tells more than any buffer of the network's: one that stalls, on the way or at its screen, has one
picture on its way to it and no more.
"""

import threading
from collections.abc import Callable
from time import monotonic

import viser

from slviewer.server import viser_internals

STALLED_S = 1.0
"""A browser that has not answered for so long sets the pace for itself alone."""


class Viewers:
    """The browsers of one server. Every method may be called from any thread; `answered()` is
    called on the server's own, whenever one has caught up, and must return at once.
    """

    def __init__(self, server: viser.ViserServer, answered: Callable[[], None]) -> None:
        self._server, self._answered = server, answered
        self._lock = threading.Lock()
        self._request_times: dict[int, float] = {}
        self._durations: dict[int, float] = {}

    def ready(self) -> list[viser.ClientHandle]:
        """The clients that have drawn everything marked by `sent`."""
        clients = self._server.get_clients()
        with self._lock:
            for known in (self._request_times, self._durations):
                for gone in known.keys() - clients.keys():
                    del known[gone]
            return [
                client for number, client in clients.items() if number not in self._request_times
            ]

    def here(self) -> set[int]:
        """The numbers of all connected clients."""
        return set(self._server.get_clients())

    def sent(self, client: viser.ClientHandle) -> None:
        """Mark that something was sent to this client: it is not ready until it has drawn it."""
        number = client.client_id
        with self._lock:
            self._request_times[number] = monotonic()

        def record_answer() -> None:
            """Record how long the client took, s, and call `answered`."""
            with self._lock:
                sent_s = self._request_times.pop(number, None)
                if sent_s is not None:
                    self._durations[number] = min(monotonic() - sent_s, STALLED_S)
            self._answered()

        viser_internals.request_answer(client, record_answer)

    def slowest_s(self) -> float:
        """Time, s, that the slowest client took to draw its last update, stalled ones excluded; 0
        if there is none."""
        now = monotonic()
        with self._lock:
            waiting = [
                now - sent_s for sent_s in self._request_times.values() if now - sent_s < STALLED_S
            ]
            return max([*self._durations.values(), *waiting], default=0.0)
