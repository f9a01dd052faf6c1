"""Access rules: the right Host and Origin, and a cookie from a link that only the operator was given."""

import hmac
import ipaddress
import re
import secrets
import socket
from http import HTTPStatus
from typing import Literal

from websockets.datastructures import Headers

from slviewer.errors import UsageError

Role = Literal["operator", "viewer"]

_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,256}")


class Refusal(Exception):
    """A refused request: the HTTP status, and one sentence for the sender."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status
        self.sentence = sentence


class MessageRefused(Exception):
    """A message that is dropped; `correct`: the client is sent the true value again.

    A number outside its range is not corrected: whoever types 50 into a field that starts at 10 passes through 5.
    """

    def __init__(self, reason: str, correct: bool = False) -> None:
        super().__init__(reason)
        self.correct = correct


class Access:
    """The rules of one server at one port.

    `names` are further host names, `name` or `name:port`, under which this server is reached (behind a proxy, say); the
    address that a connection came in at is always one, and so is the machine's own name unless it serves itself alone.
    """

    def __init__(self, port: int, token: str | None, view_token: str | None, names: tuple[str, ...] = ()) -> None:
        self.port = port
        self.token = _check_token(token)
        self.view_token = _check_token(view_token)
        if hmac.compare_digest(self.token, self.view_token):
            raise UsageError("The token for watching is the operator's: choose two different ones.")
        self.names = frozenset(name.lower() for name in names)
        # Cookies are shared by all ports of a host: two servers on one machine must not overwrite each other's.
        self.cookie_name = f"slviewer_{port}"

    def role_of(self, token: str) -> Role | None:
        """The role that a token belongs to, or None, compared in constant time."""
        given = token.encode("utf-8", "surrogateescape")
        operator = hmac.compare_digest(given, self.token.encode())
        viewer = hmac.compare_digest(given, self.view_token.encode())
        return "operator" if operator else "viewer" if viewer else None

    def role(self, headers: Headers) -> Role:
        """The role of the request's cookie; raises Refusal without a valid one."""
        for header in headers.get_all("Cookie"):
            for part in header.split(";"):
                name, _, value = part.strip().partition("=")
                if name == self.cookie_name and (role := self.role_of(value)) is not None:
                    return role
        raise Refusal(
            HTTPStatus.FORBIDDEN,
            "This page belongs to whoever started slviewer: open the link that it printed where it was started.",
        )

    def set_cookie(self, role: Role) -> str:
        """Return the Set-Cookie header of a role: HttpOnly, SameSite, for this browser session."""
        token = self.token if role == "operator" else self.view_token
        return f"{self.cookie_name}={token}; HttpOnly; SameSite=Strict; Path=/"

    def host(self, headers: Headers, local_address: str) -> str:
        """The request's Host if it is one of this server's names; raises Refusal otherwise (DNS rebinding)."""
        hosts = headers.get_all("Host")
        if len(hosts) != 1 or hosts[0].lower() not in self._list_hosts(local_address):
            raise Refusal(HTTPStatus.MISDIRECTED_REQUEST, "This server is not reached by that host name.")
        return hosts[0].lower()

    def check_origin(self, headers: Headers, host: str, websocket: bool) -> None:
        """Raise Refusal if another site's page sent the request; a WebSocket must say which page opened it."""
        origins = headers.get_all("Origin")
        own = {f"http://{host}", f"https://{host}"}
        if any(origin.lower() not in own for origin in origins) or (websocket and len(origins) != 1):
            raise Refusal(HTTPStatus.FORBIDDEN, "Another page may not use this one.")
        # SameSite ignores ports, so a page of another port of this machine is detected only here. Following a link is
        # no harm: it shows the page to the person who clicked it.
        site, mode = headers.get_all("Sec-Fetch-Site"), headers.get_all("Sec-Fetch-Mode")
        destination = headers.get_all("Sec-Fetch-Dest")
        foreign = any(value not in ("same-origin", "none") for value in site)
        if foreign and not (mode == ["navigate"] and destination == ["document"]):
            raise Refusal(HTTPStatus.FORBIDDEN, "Another page may not use this one.")

    def _list_hosts(self, local_address: str) -> set[str]:
        """All values of the Host header that name this server at the given local address."""
        address = ipaddress.ip_address(local_address.partition("%")[0])
        if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped:
            address = address.ipv4_mapped
        bare = {f"[{address}]" if address.version == 6 else str(address)}
        if address.is_loopback:
            bare.add("localhost")
        else:
            machine = socket.gethostname().lower()
            bare |= {machine, f"{machine}.local"}
        bare |= self.names
        return {f"{name}:{self.port}" for name in bare} | self.names | (bare if self.port == 80 else set())


def _check_token(token: str | None) -> str:
    """The token, checked for its characters and length; a random one for None. Raises UsageError."""
    if token is None:
        return secrets.token_urlsafe(24)
    if not _TOKEN.fullmatch(token):
        raise UsageError("A token has 16 or more letters, digits, - and _: leave it out and slviewer makes one.")
    return token
