"""A viser server that only invited browsers reach, and that changes only what its page offers them
to change."""

import ipaddress
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import viser
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as serve_websockets

from slviewer.errors import UsageError
from slviewer.server import viser_internals
from slviewer.server.access import Access, Role
from slviewer.server.auth_middleware import AuthMiddleware, DevicePage
from slviewer.server.binding import listen, network_address
from slviewer.server.connection import REQUEST_SECONDS, Connection, quiet_logger
from slviewer.server.credentials import (
    TlsCertificate,
    load_tokens,
    save_tokens,
    self_made_certificate,
)
from slviewer.server.downloads import Downloads
from slviewer.server.gate import UploadBudget, ViserGate
from slviewer.server.limits import Admissions, limit_log, raise_descriptor_limit
from slviewer.server.viser_internals import ViserClient

MESSAGE_LIMIT = 32 * 2**20
"""Bytes of one message from a browser; the largest is a picture that the server requested."""
_NAME = re.compile(
    r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,251}[A-Za-z0-9_])?)(:[0-9]{1,5})?"
)
LEAVING_SECONDS = 3.0
"""How long a browser that requested new links may take to open its own."""


@dataclass(frozen=True)
class Serving:
    """Where and how to serve. `port` 0 takes any free one.

    `names` are further host names (`name` or `name:port`) under which browsers reach the server,
    behind a proxy, say; UsageError for what is none. `tls`: encrypt, with the files of a
    certificate (PEM: the chain, the key), else with a self-made one. `token_file` holds tokens that
    stay the same.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    tls: bool = False
    tls_files: tuple[Path, Path] | None = None
    token_file: Path | None = None

    def __post_init__(self) -> None:
        for name in self.names:
            if not _NAME.fullmatch(name):
                raise UsageError(
                    f"{name!r} is not a host name as browsers send it",
                    "give one of letters, digits, '-' and '.', with its port if that is another"
                    " one, and other letters as xn--…",
                )


@dataclass(frozen=True)
class SafeServer:
    """A running server: build the page with `viser`, offer files with `downloads`, set the
    `device_pages` by role."""

    viser: viser.ViserServer
    device_pages: dict[Role, DevicePage]
    downloads: Downloads
    serving: Serving
    access: Access
    admissions: Admissions
    certificate: TlsCertificate | None

    @property
    def port(self) -> int:
        """The port that it listens at."""
        return self.access.port

    @property
    def origin(self) -> str:
        """Scheme, host and port of its address, in brackets for IPv6; loopback if all are open."""
        address = self._address
        if address.is_unspecified:
            return self._format_origin("127.0.0.1" if address.version == 4 else "[::1]")
        return self._format_origin(f"[{address}]" if address.version == 6 else str(address))

    @property
    def shared_origin(self) -> str:
        """Scheme, host and port for other devices: the address in the network, where all addresses
        are open."""
        found = network_address() if self._address.is_unspecified else None
        return self._format_origin(found) if found else self.origin

    def link(self, role: Role = "operate", origin: str | None = None) -> str:
        """The link of a role, with its token behind the #, which browsers do not send; as secret as
        a password.

        `origin` (scheme, host, port) is the address to use where that is another one than the
        server's own.
        """
        own = self.origin if role == "operate" else self.shared_origin
        return f"{origin or own}/#{self.access.grants[role].token}"

    def one_time_link(self) -> str:
        """A link for the operator's browser that can be opened once, soon."""
        return f"{self.origin}/#{self.access.issue_one_time_token()}"

    def renew_links(self, client_id: int) -> None:
        """Replace all tokens, close all connections, and lead the operator's client that requested
        it to its new page, for which it has LEAVING_SECONDS.

        Raises OSError where the tokens come from a file that cannot be replaced; they are replaced
        here nevertheless.
        """
        client = ViserClient(self.viser, client_id)
        leaving = client.connection
        self.access.renew()
        viser_internals.call_soon(self.viser, 0.0, self.admissions.close_all, leaving)
        client.navigate(f"/#{self.access.issue_one_time_token()}")
        viser_internals.call_soon(
            self.viser, LEAVING_SECONDS, self.admissions.close_all, None, leaving
        )
        if self.serving.token_file is not None:
            save_tokens(
                self.serving.token_file,
                {role: grant.token for role, grant in self.access.grants.items()},
            )

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self._address.is_loopback

    def role(self, client_id: int) -> Role | None:
        """The role of a client of viser, "operate" or "watch"; None once it is disconnected."""
        connection = ViserClient(self.viser, client_id).connection
        return None if connection is None else connection.role

    def origin_of(self, client_id: int) -> str | None:
        """The origin (scheme, host, port) of a client's page, which a proxy may serve; None once
        disconnected."""
        connection = ViserClient(self.viser, client_id).connection
        return None if connection is None else connection.request.headers["Origin"]

    def stop(self) -> None:
        """End all connections, the server and its threads."""
        viser_internals.stop(self.viser)

    def _format_origin(self, host: str) -> str:
        """Scheme, host and port."""
        return f"{'https' if self.certificate else 'http'}://{host}:{self.port}"

    @property
    def _address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
        """The IP address that the server listens at, without an IPv6 zone."""
        return ipaddress.ip_address(self.viser.get_host().partition("%")[0])


def serve(serving: Serving, *, upload_limit: int = 256 * 10**6) -> SafeServer:
    """Start the server of viser's page. `upload_limit` bounds the bytes of all unfinished uploads.

    Raises SlviewerError within two seconds where the address can't be served, where viser is not
    the pinned one, and where tokens or certificate cannot be used.
    """
    viser_internals.check_version()
    tokens = {} if serving.token_file is None else load_tokens(serving.token_file)
    certificate = None
    if serving.tls_files is not None:
        certificate = TlsCertificate(*serving.tls_files)
    elif serving.tls:
        certificate = self_made_certificate(serving.host, serving.names)
    context = certificate.context() if certificate else None
    limit_log()
    raise_descriptor_limit()
    sock = listen(serving.host, serving.port)
    address, port = sock.getsockname()[:2]
    try:
        access = Access(port, tokens, serving.names, tls=certificate is not None)
        admissions = Admissions(sock)
        device_pages: dict[Role, DevicePage] = {}
        downloads = Downloads()
        is_trusted = certificate is not None and not certificate.self_made
        middleware = AuthMiddleware(
            access, admissions, device_pages, downloads, strict_transport=is_trusted
        )
        budget = UploadBudget(upload_limit)
        started: list[viser.ViserServer] = []

        def serve_viser(
            viser_handler: Callable[..., Any], _host: str, _port: int, **options: Any
        ) -> serve_websockets:
            """Start viser's WebSocket server behind the middleware, in place of its own."""

            async def handle(connection: ServerConnection) -> None:
                """Handle a WebSocket: of a device's page, else by viser behind a gate."""
                assert isinstance(connection, Connection)
                if connection.role in device_pages:
                    await device_pages[connection.role].handler(connection)
                elif connection.role in ("operate", "watch") and started:
                    gate = connection.gate = ViserGate(
                        started[0], connection, connection.role, budget
                    )
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
                # of a crowd: a browser whose request does not fit in tries again after a second
                backlog=1024,
                open_timeout=None,  # Connection limits the request alone
                logger=quiet_logger(),
            )
            if context:
                options.update(ssl=context, ssl_handshake_timeout=REQUEST_SECONDS)
            return serve_websockets(handle, **options)

        server = viser_internals.start(serve_viser, address, port)
        started.append(server)
    except BaseException:
        sock.close()
        raise
    return SafeServer(
        server,
        device_pages,
        downloads,
        replace(serving, port=port),
        access,
        admissions,
        certificate,
    )
