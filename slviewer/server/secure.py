"""A viser server that only invited browsers reach, and that changes only what its page offers them to change."""

import ipaddress
import urllib.parse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import viser
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as serve_websockets

from slviewer.server import viser_internals
from slviewer.server.access import Access, Role
from slviewer.server.auth_middleware import AuthMiddleware, Route
from slviewer.server.binding import listen
from slviewer.server.connection import Connection, quiet_logger
from slviewer.server.downloads import Downloads
from slviewer.server.gate import ViserGate
from slviewer.server.responses import script_hash
from slviewer.server.uploads import UploadBudget

MESSAGE_LIMIT = 32 * 2**20
"""Bytes of one message from a browser; the largest is a picture that the server requested."""


@dataclass(frozen=True)
class SafeServer:
    """A running server: build the page with `viser`, add pages by path to `routes`, offer files with `downloads`."""

    viser: viser.ViserServer
    routes: dict[str, Route]
    downloads: Downloads
    host: str
    port: int
    access: Access

    @property
    def url(self) -> str:
        """The operator's link, with the token."""
        return self.link("/")

    @property
    def view_url(self) -> str:
        """The link for viewers, who may change nothing."""
        return self.link("/", "viewer")

    def link(self, path: str, role: Role = "operator") -> str:
        """The address of a page of this server with a token, to be opened once; as secret as a password."""
        token = self.access.token if role == "operator" else self.access.view_token
        return f"http://{self._format_host()}:{self.port}{path}?{urllib.parse.urlencode({'token': token})}"

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it. If not, tokens cross the network unencrypted."""
        return ipaddress.ip_address(self._address()).is_loopback

    def role(self, client_id: int) -> Role | None:
        """The role of a client of viser, operator or viewer; None once it is disconnected."""
        connection = viser_internals.connection_of(self.viser, client_id)
        return None if connection is None else connection.role

    def stop(self) -> None:
        """End all connections, the server and its threads."""
        viser_internals.stop(self.viser)

    def _address(self) -> str:
        """The IP address that the server listens at, without an IPv6 zone."""
        return self.viser.get_host().partition("%")[0]

    def _format_host(self) -> str:
        """The host part of links: the address, in brackets for IPv6; loopback if all addresses are open."""
        address = ipaddress.ip_address(self._address())
        if address.is_unspecified:
            return "127.0.0.1" if address.version == 4 else "[::1]"
        return f"[{address}]" if address.version == 6 else str(address)


def serve(
    host: str = "127.0.0.1",
    port: int = 8080,
    *,
    token: str | None = None,
    view_token: str | None = None,
    label: str | None = None,
    names: tuple[str, ...] = (),
    upload_limit: int = 256 * 10**6,
) -> SafeServer:
    """Start the server of viser's page; port 0 takes any free one.

    `names` are further host names (`name` or `name:port`) under which browsers reach this server. `upload_limit` bounds
    the bytes of all unfinished uploads.

    Raises SlviewerError within two seconds where the address can't be served, and where viser is not the pinned one.
    """
    viser_internals.check_version()
    sock = listen(host, port)
    address, port = sock.getsockname()[:2]
    try:
        access = Access(port, token, view_token, names)
        routes: dict[str, Route] = {}
        downloads = Downloads()
        scripts = (*viser_internals.VISER_SCRIPTS, script_hash(viser_internals.ONE_DRAW))
        middleware = AuthMiddleware(access, routes, downloads, viser_internals.client_page(), scripts)
        budget = UploadBudget(upload_limit)
        started: list[viser.ViserServer] = []

        def serve_viser(viser_handler: Callable[..., Any], _host: str, _port: int, **options: Any) -> serve_websockets:
            """Start viser's WebSocket server behind the middleware, in place of its own."""

            async def handle(connection: ServerConnection) -> None:
                """Handle a WebSocket: by the route of its path, else by viser behind a gate."""
                assert isinstance(connection, Connection)
                path = connection.request.path if connection.request else "/"
                if path in routes:
                    await routes[path].handler(connection)
                elif path == "/" and started and connection.role is not None:
                    gate = connection.gate = ViserGate(started[0], connection, connection.role, budget)
                    try:
                        await viser_handler(connection)
                    finally:
                        gate.close()

            options.update(
                sock=sock,
                process_request=middleware.answer,
                create_connection=Connection,
                max_size=MESSAGE_LIMIT,
                server_header=None,
                open_timeout=None,  # Connection limits the request alone
                logger=quiet_logger(),
            )
            return serve_websockets(handle, **options)

        server = viser_internals.start(serve_viser, address, port, label)
        started.append(server)
    except BaseException:
        sock.close()
        raise
    return SafeServer(server, routes, downloads, host, port, access)
