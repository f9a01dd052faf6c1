"""Authentication and routing of every HTTP request."""

import logging
import re
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import NamedTuple
from urllib.parse import parse_qsl

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from slviewer.server.access import Access, Refusal
from slviewer.server.connection import Connection
from slviewer.server.downloads import PREFIX, Downloads
from slviewer.server.responses import harden, page_policy, respond, viser_policy

logger = logging.getLogger("slviewer.server")

_PATH = re.compile(r"/|(/[A-Za-z0-9_-][A-Za-z0-9._-]*)+")

_REDIRECT = """<!doctype html><meta charset="utf-8"><title>slviewer</title><script>location.replace(location.pathname)\
</script><noscript><a href="{path}">Open slviewer</a></noscript>"""


class Route(NamedTuple):
    """A page besides viser's, for the operator alone, and the handler of the WebSockets that it opens."""

    html: bytes
    handler: Callable[[ServerConnection], Awaitable[None]]


class AuthMiddleware:
    """Authorises and answers a server's requests: viser's page, our own pages and files, and WebSockets."""

    def __init__(
        self, access: Access, routes: dict[str, Route], downloads: Downloads, page: bytes, scripts: tuple[str, ...]
    ) -> None:
        """`routes` by path; `page` is viser's, and `scripts` the hashes of those that it may run."""
        self._access = access
        self._routes = routes
        self._downloads = downloads
        self._viser_page = page
        self._scripts = scripts

    async def answer(self, connection: Connection, request: Request) -> Response | None:
        """Return the response to a request, hardened; None to open a WebSocket."""
        try:
            return await self._answer(connection, request)
        except Refusal as refusal:
            response = respond(refusal.status, refusal.sentence + "\n")
        except Exception:
            logger.exception("a request failed")
            response = respond(HTTPStatus.INTERNAL_SERVER_ERROR, "slviewer failed: see its log.\n")
        harden(response.headers)
        return response

    async def _answer(self, connection: Connection, request: Request) -> Response | None:
        """Return the response to an authorised request, None to open a WebSocket; raises Refusal otherwise."""
        headers, access = request.headers, self._access
        host = access.host(headers, connection.transport.get_extra_info("sockname")[0])
        websocket = any(value.lower() == "websocket" for value in headers.get_all("Upgrade"))
        access.check_origin(headers, host, websocket)
        path, _, query = request.path.partition("?")
        if not _PATH.fullmatch(path):  # "//elsewhere" in a redirect would lead to another site
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        if "?" in request.path:
            if websocket:
                raise Refusal(HTTPStatus.BAD_REQUEST, "This address takes no parameters.")
            return self._accept_token(path, query, host, "cross-site" in headers.get_all("Sec-Fetch-Site"))
        role = access.role(headers)
        if path in self._routes and role != "operator":
            raise Refusal(HTTPStatus.FORBIDDEN, "This link is view-only: the page is for the operator.")
        if websocket:
            if path != "/" and path not in self._routes:
                raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
            connection.role = role
            return None
        if path == "/":
            response = respond(HTTPStatus.OK, self._viser_page, "text/html; charset=utf-8")
            harden(response.headers, viser_policy(self._scripts, host))
            return response
        if path == "/favicon.ico":  # browsers ask by themselves, and would report that there is none
            response = respond(HTTPStatus.NO_CONTENT)
            harden(response.headers)
            return response
        if path.startswith(PREFIX):
            return await self._download(connection, path)
        if path not in self._routes:
            raise Refusal(HTTPStatus.NOT_FOUND, "There is nothing here.")
        html = self._routes[path].html
        response = respond(HTTPStatus.OK, html, "text/html; charset=utf-8")
        harden(response.headers, page_policy(html, host))
        return response

    def _accept_token(self, path: str, query: str, host: str, from_another_site: bool) -> Response:
        """Respond to the link with the token: set a cookie, and redirect to the same address without the token.

        Any other parameter is refused: some make viser's page load messages, and so code, from elsewhere.
        """
        fields = parse_qsl(query, keep_blank_values=True)
        if len(fields) != 1 or fields[0][0] != "token":
            raise Refusal(HTTPStatus.BAD_REQUEST, "This address takes no parameters.")
        role = self._access.role_of(fields[0][1])
        if role is None:
            raise Refusal(HTTPStatus.FORBIDDEN, "This link is not, or no longer, valid: open the one last printed.")
        if from_another_site:
            # A browser that was sent here by another site's link would send on no strict cookie: our own page must.
            html = _REDIRECT.format(path=path).encode()
            response = respond(HTTPStatus.OK, html, "text/html; charset=utf-8")
            harden(response.headers, page_policy(html, host))
        else:
            response = respond(HTTPStatus.SEE_OTHER)
            response.headers["Location"] = path
            harden(response.headers)
        response.headers["Set-Cookie"] = self._access.set_cookie(role)
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
