"""Authentication and routing of every HTTP request, and the headers that every answer carries."""

import base64
import hashlib
import json
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from slviewer.server.access import Access, Grant, Refusal, Role
from slviewer.server.connection import Connection
from slviewer.server.downloads import PREFIX, Downloads
from slviewer.server.help_pages import PREFIX as HELP_PREFIX
from slviewer.server.help_pages import HelpPages
from slviewer.server.limits import Admissions, address_group
from slviewer.server.viser_internals import PAGE_SCRIPT, SUBPROTOCOL, VISER_SCRIPTS, client_page

logger = logging.getLogger("slviewer.server")

LOGIN = "/login"
HEALTH = "/healthz"
"""Answered with 204 and nothing else, without a link: the server runs. Limits and checks of hosts
hold for it too."""
DEVICE_PATHS: dict[str, Role] = {"projector": "project", "camera": "camera"}
"""Below the operator's path: they lead to the page of a device with the rights of that page
alone."""
_CLOSED = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
HELP_POLICY = f"{_CLOSED}; style-src 'unsafe-inline'; img-src 'self'"
"""Content-Security-Policy of the documentation: nothing runs there, and only this server's pictures
are shown."""
_PATH = re.compile(r"/|(/[A-Za-z0-9_-][A-Za-z0-9._-]*)+/?")


@dataclass(frozen=True)
class DevicePage:
    """The page of a device, and the handler of the WebSockets that it opens."""

    html: bytes
    handler: Callable[[ServerConnection], Awaitable[None]]


@dataclass(eq=False)
class AuthMiddleware:
    """Authorises and answers a server's requests: viser's page, our own pages and files, and
    WebSockets.

    ``device_pages``: those that are served, which may change. ``strict_transport``: browsers are
    told to use this host encrypted from now on.
    """

    access: Access
    admissions: Admissions
    device_pages: Mapping[Role, DevicePage]
    downloads: Downloads
    strict_transport: bool = False

    def __post_init__(self) -> None:
        self._viser_page = client_page()
        self._login_page = resources.files("slviewer.server").joinpath("login.html").read_bytes()
        self._help = HelpPages()

    async def answer(self, connection: Connection, request: Request) -> Response | None:
        """Return the response to a request, hardened; None to open a WebSocket."""
        host = ""
        try:
            host = self.access.host(
                request.headers, connection.transport.get_extra_info("sockname")[0]
            )
            response = await self._answer(connection, request, host)
        except Refusal as refusal:
            response = self._refuse(refusal, request, host)
        except Exception:
            logger.exception("a request failed")
            response = respond(HTTPStatus.INTERNAL_SERVER_ERROR, "slviewer failed: see its log.\n")
        if response is not None and self.strict_transport:
            response.headers["Strict-Transport-Security"] = "max-age=86400"
        return response

    async def _answer(self, connection: Connection, request: Request, host: str) -> Response | None:
        """Return the response to an authorised request, None to open a WebSocket; raises Refusal
        otherwise."""
        headers, access = request.headers, self.access
        websocket = any(value.lower() == "websocket" for value in headers.get_all("Upgrade"))
        access.check_origin(headers, host, websocket)
        path, _, _ = request.path.partition("?")
        if not _PATH.fullmatch(path):
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        # some parameters make viser's page load messages, and so code, from elsewhere
        if "?" in request.path:
            raise Refusal(HTTPStatus.BAD_REQUEST, "This address takes no parameters.")
        if (
            not websocket
            and (response := self._answer_anyone(connection, request, path, host)) is not None
        ):
            return response
        grant, rest = access.authorise(path, headers)
        self.admissions.admit(connection, grant.role)
        if websocket:
            self._check_websocket(request, grant, rest)
            return None
        # asked for by the page of "/" too, which so learns whether its cookie is valid
        if rest == "favicon.ico":
            return respond(HTTPStatus.NO_CONTENT)
        if grant.role in DEVICE_PATHS.values():
            if rest or grant.role not in self.device_pages:
                raise Refusal(HTTPStatus.NOT_FOUND, "There is no such page here.")
            html = self.device_pages[grant.role].html
            return _respond_page(html, page_policy(html, host))
        if not rest:
            return _respond_page(self._viser_page, viser_policy(host))
        if rest.startswith(PREFIX):
            return await self._download(connection, rest)
        if rest.startswith(HELP_PREFIX):
            return self._show_help(rest.removeprefix(HELP_PREFIX))
        if grant.role == "operate" and DEVICE_PATHS.get(rest) in self.device_pages:
            return self._lead_to(access.grants[DEVICE_PATHS[rest]], request)
        raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here for this link.")

    def _answer_anyone(
        self, connection: Connection, request: Request, path: str, host: str
    ) -> Response | None:
        """Return the response that needs no cookie; None where the path needs one."""
        if path == "/":
            return self._show_login(host)
        # browsers ask for the icon by themselves, and would report its absence
        if path in ("/favicon.ico", HEALTH):
            return respond(HTTPStatus.NO_CONTENT)
        return self._log_in(connection, request) if path == LOGIN else None

    def _show_login(self, host: str, status: HTTPStatus = HTTPStatus.OK) -> Response:
        """Respond with the page that takes a link."""
        return _respond_page(self._login_page, page_policy(self._login_page, host), status)

    def _show_help(self, name: str) -> Response:
        """Respond with a page or a picture of the documentation; raises Refusal where there is none
        of this name."""
        file = self._help.file(name)
        if file is None:
            raise Refusal(HTTPStatus.NOT_FOUND, "There is no such page in the help.")
        return respond(HTTPStatus.OK, file.content, file.content_type, HELP_POLICY)

    def _check_websocket(self, request: Request, grant: Grant, rest: str) -> None:
        """Raise Refusal unless the role has a WebSocket at the rest of this path."""
        is_device = grant.role in DEVICE_PATHS.values()
        if rest or (is_device and grant.role not in self.device_pages):
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        if not is_device and request.headers.get_all("Sec-WebSocket-Protocol") != [SUBPROTOCOL]:
            raise Refusal(HTTPStatus.BAD_REQUEST, "This page is of another version: reload it.")

    def _log_in(self, connection: Connection, request: Request) -> Response:
        """Respond to the token in the Authorization header with the cookie and the path that it
        opens, as JSON."""
        scheme, _, token = " ".join(request.headers.get_all("Authorization")).partition(" ")
        if scheme.lower() != "bearer":
            raise Refusal(
                HTTPStatus.UNAUTHORIZED, "There is no token: open the link that slviewer printed."
            )
        peer = connection.transport.get_extra_info("peername")
        grant = self.access.exchange(token.strip(), address_group(peer[0]))
        response = respond(
            HTTPStatus.OK, json.dumps({"path": f"{grant.path}/"}), "application/json"
        )
        response.headers["Set-Cookie"] = grant.set_cookie(self.access.is_encrypted(request.headers))
        return response

    def _lead_to(self, grant: Grant, request: Request) -> Response:
        """Redirect the operator's browser to the page of another role, with its cookie."""
        response = respond(HTTPStatus.SEE_OTHER)
        response.headers["Location"] = f"{grant.path}/"
        response.headers["Set-Cookie"] = grant.set_cookie(self.access.is_encrypted(request.headers))
        return response

    def _refuse(self, refusal: Refusal, request: Request, host: str) -> Response:
        """Respond with the reason of a refusal; where a person reads it, on the page that takes a
        link."""
        person = any("text/html" in value for value in request.headers.get_all("Accept"))
        if host and person and refusal.status == HTTPStatus.FORBIDDEN:
            return self._show_login(host, HTTPStatus.FORBIDDEN)
        return respond(refusal.status, refusal.sentence + "\n")

    async def _download(self, connection: Connection, path: str) -> Response:
        """Stream an offered file; raises Refusal where it is no longer offered."""
        opened = self.downloads.open(path)
        if opened is None:
            raise Refusal(
                HTTPStatus.NOT_FOUND,
                "This file is no longer offered: request it again in slviewer.",
            )
        headers, file = opened
        harden(headers)
        headers["Connection"] = "close"
        with file:
            return await connection.stream(headers, file)


def _respond_page(html: bytes, policy: str, status: HTTPStatus = HTTPStatus.OK) -> Response:
    """Respond with a page under this Content-Security-Policy."""
    return respond(status, html, "text/html; charset=utf-8", policy)


def respond(
    status: HTTPStatus,
    body: bytes | str = b"",
    content_type: str = "text/plain; charset=utf-8",
    policy: str = _CLOSED,
) -> Response:
    """A complete answer with its length, hardened."""
    data = body.encode() if isinstance(body, str) else body
    headers = Headers({"Content-Type": content_type, "Content-Length": str(len(data))})
    harden(headers, policy)
    return Response(status.value, status.phrase, headers, data)


def harden(headers: Headers, policy: str = _CLOSED) -> None:
    """Add the headers that keep an answer out of other sites' pages, caches and histories (in
    place)."""
    for name, value in {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }.items():
        headers[name] = value


def page_policy(html: bytes, host: str) -> str:
    """Content-Security-Policy of our own pages: inline scripts, images and connections to this
    server only."""
    scripts = (
        " ".join(script_hash(m) for m in re.findall(rb"<script[^>]*>(.*?)</script>", html, re.S))
        or "'none'"
    )
    return (
        f"{_CLOSED}; script-src {scripts}; style-src 'unsafe-inline'; img-src 'self' data: blob:; "
        f"media-src data:; connect-src 'self' ws://{host} wss://{host}"
    )


def viser_policy(host: str) -> str:
    """Return the content security policy of viser's page, which unpacks itself with WebAssembly in
    a blob worker.

    Only viser's own scripts and ours for it (given by their hashes) run, so that HTML in a label, a
    script or an event handler in it, does nothing even where someone forgot to escape it. They may
    evaluate text: parts of them are compiled so, and Plotly is sent as text.
    """
    scripts = " ".join((*VISER_SCRIPTS, script_hash(PAGE_SCRIPT)))
    return (
        f"{_CLOSED}; script-src {scripts} 'unsafe-eval'; "
        "style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; media-src data: blob:; font-src data:; worker-src blob:; "
        f"connect-src 'self' data: blob: ws://{host} wss://{host}"
    )


def script_hash(script: bytes) -> str:
    """A script's SHA hash as a source in a Content-Security-Policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
