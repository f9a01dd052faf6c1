"""Limits of what unauthenticated clients may use up: connections, bytes of a request, lines of the
log."""

import contextlib
import ipaddress
import logging
import socket
import sys
from collections import Counter
from http import HTTPStatus
from time import monotonic
from typing import Any

from slviewer.server.access import Refusal, Role

logger = logging.getLogger("slviewer.server")

MAX_UNAUTHENTICATED, MAX_UNAUTHENTICATED_PER_ADDRESS = 256, 128
"""Connections without a valid cookie, in all and from one address; beyond, the oldest one is
closed."""
CONNECTIONS: dict[Role, int] = {"operate": 64, "watch": 64, "project": 16, "camera": 16}
"""Connections with the cookie of a role; beyond, another one is refused."""
ACCEPTED_AT_ONCE = 4
"""Connections accepted before those that are open are served again. About eight turns of the event
loop serve a request, and until then its connection must not be closed for another one, even if it
comes from the busiest address."""
_CLOSING = 32
_LOG_SECONDS = 60.0


class Listener(socket.socket):
    """A listening socket that hands out a limited number of connections without a valid cookie.

    A browser sends its request at once, so that the oldest connection that has not is closed for a
    new one, of the address that has most of them. What is handed out counts as unauthenticated
    until `admit` is called for its address.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._unauthenticated: dict[Any, _Accepted] = {}
        self._counts = Counter[str]()
        self._closing: dict[Any, float] = {}
        self._batch = 0
        self._closed_count, self._log_time = 0, float("-inf")

    def accept(self) -> tuple[socket.socket, Any]:
        """As socket's. Raises BlockingIOError where others should be served, or be closed,
        before."""
        now = monotonic()
        self._closing = {peer: begun for peer, begun in self._closing.items() if now - begun < 1.0}
        if self._batch >= ACCEPTED_AT_ONCE or len(self._closing) >= _CLOSING:
            self._batch = 0
            raise BlockingIOError
        try:
            descriptor, peer = self._accept()  # type: ignore[attr-defined]
        except OSError:
            self._batch = 0
            raise
        self._batch += 1
        accepted = _Accepted(self.family, self.type, self.proto, fileno=descriptor)
        self.count(accepted, peer)
        return accepted, peer

    def count(self, accepted: "_Accepted", peer: Any) -> None:
        """Count a connection from this socket address as unauthenticated, and close another one
        where it is too many."""
        accepted.listener, accepted.peer, accepted.group = self, peer, address_group(peer[0])
        self._unauthenticated[peer] = accepted
        self._counts[accepted.group] += 1
        self._make_room()

    def forget(self, peer: Any) -> None:
        """Count the connection from this socket address no longer: it is closed."""
        self.admit(peer)
        self._closing.pop(peer, None)

    def admit(self, peer: Any) -> "_Accepted | None":
        """Count the connection from this socket address, which has a valid cookie, no longer among
        the unauthenticated.

        Returns it; None where it is not among them.
        """
        accepted = self._unauthenticated.pop(peer, None)
        if accepted:
            self._counts[accepted.group] -= 1
            self._counts += Counter()  # without addresses that have none
        return accepted

    def _make_room(self) -> None:
        """Close the oldest connection of the busiest address where there are too many."""
        busiest, count = self._counts.most_common(1)[0]
        if (
            count <= MAX_UNAUTHENTICATED_PER_ADDRESS
            and len(self._unauthenticated) <= MAX_UNAUTHENTICATED
        ):
            return
        oldest = self.admit(
            next(peer for peer, one in self._unauthenticated.items() if one.group == busiest)
        )
        assert oldest
        self._closing[oldest.peer] = monotonic()
        with contextlib.suppress(OSError):  # it is closed as soon as its transport reads the end
            oldest.shutdown(socket.SHUT_RDWR)
        self._closed_count += 1
        if monotonic() - self._log_time >= _LOG_SECONDS:
            logger.warning(
                "%d connections without a valid link were closed: too many at a time",
                self._closed_count,
            )
            self._closed_count, self._log_time = 0, monotonic()


class _Accepted(socket.socket):
    """A connection that its listener counts until it is closed."""

    listener: Listener
    peer: Any
    group: str

    def close(self) -> None:
        """As socket's."""
        self.listener.forget(self.peer)
        super().close()


class Admissions:
    """The connections with a valid cookie, by role. Only for the server's own thread."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._connections: dict[Role, set[Any]] = {role: set() for role in CONNECTIONS}

    def admit(self, connection: Any, role: Role) -> None:
        """Count a connection (with `transport` and `role`) among those of a role; raises Refusal
        for one too many."""
        connections = self._connections[role]
        if len(connections) >= CONNECTIONS[role]:
            raise Refusal(
                HTTPStatus.SERVICE_UNAVAILABLE,
                "Too many pages are open by this link: close some of them.",
            )
        self._listener.admit(connection.transport.get_extra_info("peername"))
        connection.role = role
        connections.add(connection)
        connection.connection_lost_waiter.add_done_callback(
            lambda _: connections.discard(connection)
        )

    def close_all(self, but: Any = None, only: Any = None) -> None:
        """Abort all connections with a cookie but one; `only` this one where one is given."""
        for connections in self._connections.values():
            for connection in connections - {but}:
                if only in (None, connection):
                    connection.transport.abort()


class OncePerSecond(logging.Filter):
    """Drops a log record where one of the same message and error was logged within the last
    second."""

    def __init__(self) -> None:
        super().__init__()
        self._times: dict[Any, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged."""
        now = monotonic()
        error = record.exc_info[0] if record.exc_info else None
        fault = record.name, record.levelno, str(record.msg)[:200], error
        if now - self._times.get(fault, float("-inf")) < 1.0:
            return False
        self._times = {one: logged for one, logged in self._times.items() if now - logged < 1.0} | {
            fault: now
        }
        return True


def limit_log() -> None:
    """Log no fault of serving more than once a second."""
    for name in ("slviewer.server", "slviewer.server.websockets", "asyncio"):
        log = logging.getLogger(name)
        if not any(isinstance(one, OncePerSecond) for one in log.filters):
            log.addFilter(OncePerSecond())


def address_group(address: str) -> str:
    """The address, or of an IPv6 address the network of 64 bits, which one subscriber has all
    of."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address) and not parsed.ipv4_mapped:
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address


def raise_descriptor_limit() -> None:
    """Let this process open 1,024 files where it may: some systems start with fewer than all limits
    together need."""
    if sys.platform == "win32":
        return
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = 1024 if hard == resource.RLIM_INFINITY else min(1024, hard)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
