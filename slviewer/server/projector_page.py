"""The page of a browser projector, and the messages between it and the server."""

import asyncio
import contextlib
from importlib import resources

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from slviewer.devices.channel import Channel
from slviewer.errors import InputError
from slviewer.server.secure import SafeServer

ANOTHER_WINDOW, NOT_UNDERSTOOD = 4001, 1008
"""Why the connection was closed: the page then waits for somebody to ask for it, or connects again."""
_HELLO_S = 5.0


def serve_projector(server: SafeServer, channel: Channel) -> None:
    """Serve the page at `server.link("project")`, and connect it to `channel`."""
    html = resources.files("slviewer.server").joinpath("projector.html").read_text("utf-8")

    async def handle(connection: ServerConnection) -> None:
        """Exchange messages with a page until it disconnects."""
        with contextlib.suppress(ConnectionClosed):
            await _talk(connection, channel)

    server.projector.html, server.projector.handler = html.encode(), handle


async def _talk(connection: ServerConnection, channel: Channel) -> None:
    """Exchange messages between a projector page and its channel until one side ends the connection."""
    loop, outbox = asyncio.get_running_loop(), asyncio.Queue[bytes | None]()

    def send(message: bytes | None) -> None:
        """Queue a message to the page; None: close the connection."""
        with contextlib.suppress(RuntimeError):  # the server has stopped, and the page is gone with it
            loop.call_soon_threadsafe(outbox.put_nowait, message)

    async def write() -> None:
        """Send queued messages to the page, and close the connection after the last."""
        while (message := await outbox.get()) is not None:
            await connection.send(message)
        await connection.close(ANOTHER_WINDOW, "another window is the projector")

    try:
        page = channel.connect(await asyncio.wait_for(connection.recv(), _HELLO_S), send)
    except (InputError, TimeoutError):
        await connection.close(NOT_UNDERSTOOD, "not understood")
        return
    if page is None:
        await connection.close(ANOTHER_WINDOW, "another window is the projector")
        return
    writer = asyncio.create_task(write())
    try:
        async for message in connection:
            channel.handle_message(page, message)
    except InputError:
        await connection.close(NOT_UNDERSTOOD, "not understood")
    finally:
        channel.disconnect(page)
        writer.cancel()
        with contextlib.suppress(ConnectionClosed, asyncio.CancelledError):
            await writer
