"""The listening socket, bound before viser starts: a failure is an error, not another port and not
a hang."""

import errno
import os
import socket
import threading

from slviewer.errors import SlviewerError
from slviewer.server.limits import Listener

RESOLVE_SECONDS = 1.5
"""A name server that does not answer must not keep the operator waiting."""


def listen(host: str, port: int) -> Listener:
    """A TCP socket listening at exactly this address, with limits for unauthenticated clients; port
    0 takes any free one.

    A name server has RESOLVE_SECONDS to answer. Raises SlviewerError at the latest then, where the
    port is in use or the address is not this machine's.
    """
    if not host or not 0 <= port <= 65535:
        raise SlviewerError(
            f"{host or 'An empty host'}:{port} is not an address to serve at",
            "try 127.0.0.1 and port 8080.",
        )
    family, address = _resolve(host, port)
    sock = Listener(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere this option lets two programs share a port
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)
        # Two sockets may bind the same port as long as neither listens: only listening tells that
        # it is ours.
        sock.listen(128)
    except (OSError, OverflowError) as error:
        sock.close()
        raise SlviewerError(_format_remedy(host, port, error)) from error
    return sock


def network_address() -> str | None:
    """Return the address of this machine in its network, which the system would send from; None
    without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            # an address for documentation (RFC 5737); nothing is sent
            sock.connect(("192.0.2.1", 9))
        except OSError:
            return None
        return str(sock.getsockname()[0])


def _resolve(host: str, port: int) -> tuple[int, tuple]:
    """Address family and socket address of host and port; raises SlviewerError if the name does not
    resolve in time."""
    candidates: list[tuple[int, tuple]] = []

    def look_up() -> None:
        """Append what the name resolves to; nothing where it does not resolve."""
        try:
            infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        except (OSError, UnicodeError):
            return
        candidates.extend((info[0], info[4]) for info in infos)

    thread = threading.Thread(target=look_up, daemon=True)
    thread.start()
    thread.join(RESOLVE_SECONDS)
    if not candidates:
        raise SlviewerError(
            f"No address was found for the host {host!r}",
            "use 127.0.0.1 for this machine alone, or an address of this machine to let others in.",
        )
    return candidates[0]


def _format_remedy(host: str, port: int, error: OSError | OverflowError) -> str:
    """Message for an address that cannot be opened: the cause, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.EADDRINUSE, getattr(errno, "WSAEADDRINUSE", -1)):
        return (
            f"Port {port} at {host} is in use, perhaps by another slviewer: close that one, or"
            " choose another port with --port (--port 0 takes any free one)."
        )
    if number in (errno.EACCES, errno.EPERM):
        return f"This account may not open port {port}: choose a port above 1023 with --port."
    if number == errno.EADDRNOTAVAIL:
        return f"{host} is not an address of this machine: use 127.0.0.1, or one that it has."
    return f"The address {host}:{port} can't be served ({error}): use 127.0.0.1 and another --port."
