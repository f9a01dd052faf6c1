"""One browser's connection: its request awaited for a limited time, its messages gated, its files
streamed."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, BinaryIO

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Response

from slviewer.server.access import Role

REQUEST_SECONDS = 10.0
"""How long a browser may take to send its request."""
REQUEST_BYTES = 32_768
"""Of a request with all its headers; browsers send a tenth of it."""
STALL_SECONDS = 30.0
"""How long the reader of a file may take nothing of it."""
CHUNK = 2**17
"""Bytes; after the last chunk is written, a slow reader has ten seconds for it."""

Gate = Callable[[Any], bytes | None]


class Connection(ServerConnection):
    """A websockets connection that knows its role and, for viser's messages, its gate."""

    role: Role | None = None
    gate: Gate | None = None
    """What a message becomes on its way in; None drops it."""
    _request_bytes = 0

    def data_received(self, data: bytes) -> None:
        """As websockets, but a request that is too long ends the connection before it takes up
        memory."""
        if self.request is None:
            self._request_bytes += len(data)
            if self._request_bytes > REQUEST_BYTES:
                self.transport.abort()
                return
        super().data_received(data)

    async def handshake(self, *args: Any, **kwargs: Any) -> None:
        """As websockets, whose own limit would cut a long download too: here it covers the request
        alone."""
        await asyncio.wait(
            [self.request_rcvd, self.connection_lost_waiter],
            timeout=REQUEST_SECONDS,
            return_when=asyncio.FIRST_COMPLETED,
        )
        if self.request is None:
            self.transport.abort()
        await super().handshake(*args, **kwargs)

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that the gate lets pass."""
        while True:
            data = await super().recv(decode)
            passed = data if self.gate is None else self.gate(data)
            if passed is not None:
                return passed

    async def stream(self, headers: Headers, file: BinaryIO) -> Response:
        """Send an answer whose body is this open file, chunk by chunk; returns what process_request
        must return.

        The reader's pace is kept, so that a file of any size takes one chunk of memory. A reader
        who takes nothing for STALL_SECONDS, or a server that stops, ends it.
        """
        tail: bytes = b"HTTP/1.1 200 OK\r\n" + headers.serialize()
        try:
            async with asyncio.timeout(STALL_SECONDS) as limit:
                while chunk := await asyncio.to_thread(file.read, CHUNK):
                    if self.transport.is_closing() or not self.server.is_serving():
                        raise TimeoutError
                    self.transport.write(tail)
                    await self.drain()
                    tail = chunk
                    limit.reschedule(asyncio.get_running_loop().time() + STALL_SECONDS)
        except (TimeoutError, OSError):
            # The answer has begun, so there is no other to give; a cancelled handshake ends the
            # connection silently.
            self.transport.abort()
            raise asyncio.CancelledError from None
        return _Tail(200, "OK", Headers(), tail)


class _Tail(Response):
    """The rest of a response whose beginning was already sent."""

    def serialize(self) -> bytes:
        """The bytes of the body, without status line and headers: those have been sent."""
        return bytes(self.body)


def quiet_logger() -> logging.Logger:
    """The websockets logger of this server, which drops errors that clients cause, such as failed
    handshakes."""
    logger = logging.getLogger("slviewer.server.websockets")
    logger.setLevel(logging.WARNING)  # else every connection is logged
    if _is_server_error not in logger.filters:
        logger.addFilter(_is_server_error)
    return logger


def _is_server_error(record: logging.LogRecord) -> bool:
    """Whether a log record reports an error other than a failed handshake or a lost connection."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, InvalidHandshake | ConnectionClosed | ConnectionError)
