"""Further pages and WebSocket endpoints beside the wizard, on the same port and under the same rules."""

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from websockets.asyncio.server import ServerConnection

Handler = Callable[[ServerConnection], Awaitable[None]]

_PATH = re.compile(r"(/[A-Za-z0-9_-][A-Za-z0-9._-]*)+")
_RESERVED = ("/download",)


@dataclass(frozen=True)
class Page:
    """A page as it is sent; `viewers` whether a view-only link opens it too."""

    html: bytes
    viewers: bool


@dataclass(frozen=True)
class Endpoint:
    """What talks to the browsers that open a WebSocket here, on viser's event loop."""

    handler: Handler
    viewers: bool


class Routes:
    """The paths that this server answers to besides the wizard's own; may be changed while it runs."""

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._endpoints: dict[str, Endpoint] = {}

    def page(self, path: str, html: str, *, viewers: bool = False) -> None:
        """Serve a whole HTML page at this path. The scripts that stand in it run; it loads none from elsewhere."""
        self._pages[_checked(path)] = Page(html.encode(), viewers)

    def websocket(self, path: str, handler: Handler, *, viewers: bool = False) -> None:
        """Let pages of this server open a WebSocket at this path; the handler runs until the connection ends."""
        self._endpoints[_checked(path)] = Endpoint(handler, viewers)

    def remove(self, path: str) -> None:
        """Answer no more at this path."""
        self._pages.pop(path, None)
        self._endpoints.pop(path, None)

    def page_at(self, path: str) -> Page | None:
        """The page at this path, if there is one."""
        return self._pages.get(path)

    def endpoint_at(self, path: str) -> Endpoint | None:
        """The endpoint at this path, if there is one."""
        return self._endpoints.get(path)


def _checked(path: str) -> str:
    if not _PATH.fullmatch(path) or path.startswith(_RESERVED):
        raise ValueError(f"{path!r} is no path for a page: use letters, digits, - and _ after each slash.")
    return path
