"""The pages of a browser's projector and camera, and the messages between them and the server."""

import asyncio
import contextlib
from functools import partial
from importlib import resources
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from slviewer.devices.browser import PageChannels
from slviewer.devices.page_channel import PageChannel
from slviewer.errors import InputError
from slviewer.server.access import Role
from slviewer.server.auth_middleware import DevicePage
from slviewer.server.secure import SafeServer

ANOTHER_WINDOW, NOT_UNDERSTOOD = 4001, 1008
"""Why the connection was closed: the page then waits for somebody to ask for it, or connects
again."""
_HELLO_S = 5.0
_SHARED = "device_page.js"
"""Script of both pages, put into each of them: their roles are served nothing but their page."""


def serve_device_pages(server: SafeServer, channels: PageChannels) -> None:
    """Serve the pages at `server.link("project")` and `server.link("camera")`, and connect them to
    `channels`."""
    folder = resources.files("slviewer.server")
    script = folder.joinpath(_SHARED).read_text("utf-8")
    pages: dict[Role, tuple[str, PageChannel[Any]]] = {
        "project": ("projector.html", channels.projector),
        "camera": ("camera.html", channels.camera),
    }
    for role, (name, channel) in pages.items():
        html = folder.joinpath(name).read_text("utf-8").replace(f"/* {_SHARED} */", script)
        server.device_pages[role] = DevicePage(html.encode(), partial(_talk, channel))


async def _talk(channel: PageChannel[Any], connection: ServerConnection) -> None:
    """Exchange messages between a page and its channel until one side ends the connection."""
    loop, outbox = asyncio.get_running_loop(), asyncio.Queue[bytes | None]()

    def send(message: bytes | None) -> None:
        """Queue a message to the page; None: close the connection."""
        # the server has stopped, and the page is gone with it
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(outbox.put_nowait, message)

    async def write() -> None:
        """Send queued messages to the page, and close the connection after the last."""
        while (message := await outbox.get()) is not None:
            await connection.send(message)
        await connection.close(ANOTHER_WINDOW, "another window is the device")

    try:
        page = channel.connect(await asyncio.wait_for(connection.recv(), _HELLO_S), send)
    except (InputError, TimeoutError):
        await connection.close(NOT_UNDERSTOOD, "not understood")
        return
    if page is None:
        await connection.close(ANOTHER_WINDOW, "another window is the device")
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
