"""Authentication and routing of every HTTP request."""

import json
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from slviewer.server.access import Access, Grant, Refusal, Role
from slviewer.server.connection import Connection
from slviewer.server.downloads import PREFIX, Downloads
from slviewer.server.help_pages import PREFIX as HELP_PREFIX
from slviewer.server.help_pages import HelpPages
from slviewer.server.limits import Admissions, address_group
from slviewer.server.responses import HELP_POLICY, harden, page_policy, respond, viser_policy

logger = logging.getLogger("slviewer.server")

LOGIN = "/login"
HEALTH = "/healthz"
"""Answered with 204 and nothing else, without a link: the server runs. Limits and checks of hosts hold for it too."""
DEVICE_PATHS: dict[str, Role] = {"projector": "project", "camera": "camera"}
"""Below the operator's path: they lead to the page of a device with the rights of that page alone."""
_HTML = "text/html; charset=utf-8"
_PATH = re.compile(r"/|(/[A-Za-z0-9_-][A-Za-z0-9._-]*)+/?")


@dataclass(frozen=True)
class DevicePage:
    """The page of a device, and the handler of the WebSockets that it opens."""

    html: bytes
    handler: Callable[[ServerConnection], Awaitable[None]]


class AuthMiddleware:
    """Authorises and answers a server's requests: viser's page, our own pages and files, and WebSockets."""

    def __init__(
        self,
        access: Access,
        admissions: Admissions,
        device_pages: Mapping[Role, DevicePage],
        downloads: Downloads,
        page: bytes,
        scripts: tuple[str, ...],
        subprotocol: str,
        strict_transport: bool = False,
    ) -> None:
        """`device_pages`: those that are served, which may change; `page` is viser's, `scripts` the hashes of those
        that it may run, `subprotocol` that of its WebSocket. `strict_transport`: browsers are told to use this host
        encrypted from now on.
        """
        self._access = access
        self._admissions = admissions
        self._device_pages = device_pages
        self._downloads = downloads
        self._viser_page = page
        self._scripts = scripts
        self._subprotocol = subprotocol
        self._strict_transport = strict_transport
        self._login_page = resources.files("slviewer.server").joinpath("login.html").read_bytes()
        self._help = HelpPages()

    async def answer(self, connection: Connection, request: Request) -> Response | None:
        """Return the response to a request, hardened; None to open a WebSocket."""
        host = ""
        try:
            host = self._access.host(request.headers, connection.transport.get_extra_info("sockname")[0])
            response = await self._answer(connection, request, host)
        except Refusal as refusal:
            response = self._refuse(refusal, request, host)
        except Exception:
            logger.exception("a request failed")
            response = respond(HTTPStatus.INTERNAL_SERVER_ERROR, "slviewer failed: see its log.\n")
            harden(response.headers)
        if response is not None and self._strict_transport:
            response.headers["Strict-Transport-Security"] = "max-age=86400"
        return response

    async def _answer(self, connection: Connection, request: Request, host: str) -> Response | None:
        """Return the response to an authorised request, None to open a WebSocket; raises Refusal otherwise."""
        headers, access = request.headers, self._access
        websocket = any(value.lower() == "websocket" for value in headers.get_all("Upgrade"))
        access.check_origin(headers, host, websocket)
        path, _, _ = request.path.partition("?")
        if not _PATH.fullmatch(path):
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        if "?" in request.path:  # some parameters make viser's page load messages, and so code, from elsewhere
            raise Refusal(HTTPStatus.BAD_REQUEST, "This address takes no parameters.")
        if not websocket and path == "/":
            return self._page(self._login_page, page_policy(self._login_page, host))
        if not websocket and path == "/favicon.ico":  # browsers ask by themselves, and would report that there is none
            return self._empty()
        if not websocket and path == HEALTH:
            return self._empty()
        if not websocket and path == LOGIN:
            return self._log_in(connection, request)
        grant, rest = access.authorise(path, headers)
        self._admissions.admit(connection, grant.role)
        if websocket:
            self._check_websocket(request, grant, rest)
            return None
        if rest == "favicon.ico":  # asked for by the page of "/" too, which so learns whether its cookie is valid
            return self._empty()
        if grant.role in DEVICE_PATHS.values():
            if rest or grant.role not in self._device_pages:
                raise Refusal(HTTPStatus.NOT_FOUND, "There is no such page here.")
            html = self._device_pages[grant.role].html
            return self._page(html, page_policy(html, host))
        if not rest:
            return self._page(self._viser_page, viser_policy(self._scripts, host))
        if rest.startswith(PREFIX):
            return await self._download(connection, rest)
        if rest.startswith(HELP_PREFIX):
            return self._show_help(rest.removeprefix(HELP_PREFIX))
        if grant.role == "operate" and DEVICE_PATHS.get(rest) in self._device_pages:
            return self._lead_to(access.grants[DEVICE_PATHS[rest]], request)
        raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here for this link.")

    def _show_help(self, name: str) -> Response:
        """Respond with a page or a picture of the documentation; raises Refusal where there is none of this name."""
        file = self._help.file(name)
        if file is None:
            raise Refusal(HTTPStatus.NOT_FOUND, "There is no such page in the help.")
        response = respond(HTTPStatus.OK, file.content, file.content_type)
        harden(response.headers, HELP_POLICY)
        return response

    def _check_websocket(self, request: Request, grant: Grant, rest: str) -> None:
        """Raise Refusal unless the role has a WebSocket at the rest of this path."""
        is_device = grant.role in DEVICE_PATHS.values()
        if rest or (is_device and grant.role not in self._device_pages):
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        if not is_device and request.headers.get_all("Sec-WebSocket-Protocol") != [self._subprotocol]:
            raise Refusal(HTTPStatus.BAD_REQUEST, "This page is of another version: reload it.")

    def _log_in(self, connection: Connection, request: Request) -> Response:
        """Respond to the token in the Authorization header with the cookie and the path that it opens, as JSON."""
        scheme, _, token = " ".join(request.headers.get_all("Authorization")).partition(" ")
        if scheme.lower() != "bearer":
            raise Refusal(HTTPStatus.UNAUTHORIZED, "There is no token: open the link that slviewer printed.")
        peer = connection.transport.get_extra_info("peername")
        grant = self._access.exchange(token.strip(), address_group(peer[0]))
        response = respond(HTTPStatus.OK, json.dumps({"path": f"{grant.path}/"}), "application/json")
        response.headers["Set-Cookie"] = grant.set_cookie(self._access.is_encrypted(request.headers))
        harden(response.headers)
        return response

    def _lead_to(self, grant: Grant, request: Request) -> Response:
        """Redirect the operator's browser to the page of another role, with its cookie."""
        response = respond(HTTPStatus.SEE_OTHER)
        response.headers["Location"] = f"{grant.path}/"
        response.headers["Set-Cookie"] = grant.set_cookie(self._access.is_encrypted(request.headers))
        harden(response.headers)
        return response

    def _refuse(self, refusal: Refusal, request: Request, host: str) -> Response:
        """Respond with the reason of a refusal; where a person reads it, on the page that takes a link."""
        person = any("text/html" in value for value in request.headers.get_all("Accept"))
        if host and person and refusal.status == HTTPStatus.FORBIDDEN:
            return self._page(self._login_page, page_policy(self._login_page, host), HTTPStatus.FORBIDDEN)
        response = respond(refusal.status, refusal.sentence + "\n")
        harden(response.headers)
        return response

    @staticmethod
    def _page(html: bytes, policy: str, status: HTTPStatus = HTTPStatus.OK) -> Response:
        """Respond with a page under this Content-Security-Policy."""
        response = respond(status, html, _HTML)
        harden(response.headers, policy)
        return response

    @staticmethod
    def _empty() -> Response:
        """Respond without content."""
        response = respond(HTTPStatus.NO_CONTENT)
        harden(response.headers)
        return response

    async def _download(self, connection: Connection, path: str) -> Response:
        """Stream an offered file; raises Refusal where it is no longer offered."""
        opened = self._downloads.open(path)
        if opened is None:
            raise Refusal(HTTPStatus.NOT_FOUND, "This file is no longer offered: request it again in slviewer.")
        headers, file = opened
        harden(headers)
        headers["Connection"] = "close"
        with file:
            return await connection.stream(headers, file)
