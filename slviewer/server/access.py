"""Access rules: the right Host and Origin, and for each role a token, a path of its own and a
cookie for that path.

A token is exchanged for a cookie once, at `/login`. Browsers send the cookies of a host to all its
ports, but only to the paths that a cookie names: each role has a path that cannot be guessed, so
that no other server on the machine is sent the cookie, and the cookies of two roles never meet.
"""

import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from time import monotonic
from types import MappingProxyType
from typing import Literal, get_args

from websockets.datastructures import Headers

from slviewer.errors import UsageError

Role = Literal["operate", "watch", "project", "camera"]
"""Who may do what: operate the wizard, watch it, or be the page of the projector or of the
camera."""
ROLES: tuple[Role, ...] = get_args(Role)

ONE_TIME_SECONDS = 120.0
"""How long a one-time token may be exchanged."""
WRONG_TOKENS, WRONG_TOKENS_SECONDS = 10, 60.0
"""Wrong tokens from one address within this time, after which it is refused."""
_MOST_ADDRESSES = 1024
_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,256}")


class Refusal(Exception):
    """A refused request: the HTTP status, and one sentence for the sender."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status, self.sentence = status, sentence


class MessageRefused(Exception):
    """A message that is dropped; `correct`: the client is sent the true value again.

    A number outside its range is not corrected: whoever types 50 into a field that starts at 10
    passes through 5.
    """

    def __init__(self, reason: str, correct: bool = False) -> None:
        super().__init__(reason)
        self.correct = correct


@dataclass(frozen=True)
class Grant:
    """What the token of one role opens: `path`, without a final slash, to whoever sends the cookie
    `value`.

    Path and value are derived from the token, so that browsers stay logged in when a server with
    the same tokens starts again. `chosen`: a person chose the token, which may therefore be
    guessed.
    """

    role: Role
    token: str
    port: int
    chosen: bool = False

    @property
    def path(self) -> str:
        """Path of the role's page; no secret, but not to be guessed by other servers."""
        return f"/{self.role}-{self._derive('path')[:16]}"

    @property
    def cookie_name(self) -> str:
        """Name of the cookie, with port and role: browsers do not tell the cookies of two ports
        apart."""
        return f"slviewer_{self.port}_{self.role}"

    @property
    def value(self) -> str:
        """Value of the cookie, from which the token cannot be computed."""
        return self._derive("cookie")

    def set_cookie(self, secure: bool) -> str:
        """Return the Set-Cookie header: for scripts and other sites invisible, for this browser
        session."""
        attributes = "; HttpOnly; SameSite=Strict" + ("; Secure" if secure else "")
        return f"{self.cookie_name}={self.value}; Path={self.path}{attributes}"

    def accepts(self, headers: Headers) -> bool:
        """Whether one of the request's cookies is this one, compared in constant time."""
        parts = (
            part.strip().partition("=")
            for header in headers.get_all("Cookie")
            for part in header.split(";")
        )
        return any(
            name == self.cookie_name and _is_equal(value, self.value) for name, _, value in parts
        )

    def _derive(self, purpose: str) -> str:
        """Return the HMAC of port, role and purpose with the token as its key, in hexadecimal
        digits."""
        return hmac.new(
            self.token.encode(), f"{purpose} {self.role} {self.port}".encode(), hashlib.sha256
        ).hexdigest()


class Access:
    """The rules of one server at one port. Every method may be called from any thread.

    `tokens` by role are fixed ones; the others are random. `names` are further host names, `name`
    or `name:port`, under which this server is reached (behind a proxy, say); the address that a
    connection came in at is always one, and so is the machine's own name unless it serves itself
    alone. `tls`: the server itself encrypts.
    """

    def __init__(
        self,
        port: int,
        tokens: Mapping[Role, str] = MappingProxyType({}),
        names: tuple[str, ...] = (),
        tls: bool = False,
    ) -> None:
        self.port = port
        self.tls = tls
        self.names = frozenset(name.lower() for name in names)
        given = list(tokens.values())
        if not all(map(_TOKEN.fullmatch, given)):
            raise UsageError(
                "A token has 16 or more letters, digits, - and _",
                "leave it out and slviewer makes one.",
            )
        if len(set(given)) < len(given):
            raise UsageError("Two roles have the same token", "choose different ones.")
        self._wrong: dict[str, list[float]] = {}
        self.renew(tokens)

    def renew(self, tokens: Mapping[Role, str] = MappingProxyType({})) -> None:
        """Replace all tokens, by those given, else random ones: the links given out so far open
        nothing any more."""
        self._one_time: dict[str, float] = {}
        self.grants: dict[Role, Grant] = {
            role: Grant(
                role, tokens.get(role, secrets.token_urlsafe(24)), self.port, role in tokens
            )
            for role in ROLES
        }

    def issue_one_time_token(self) -> str:
        """Return a token that the operator's browser can exchange once, within ONE_TIME_SECONDS."""
        token = secrets.token_urlsafe(24)
        self._one_time[token] = monotonic() + ONE_TIME_SECONDS
        return token

    def is_pending(self, token: str) -> bool:
        """Whether a one-time token has not been exchanged yet."""
        return monotonic() < self._one_time.get(token, 0.0)

    def exchange(self, token: str, address: str) -> Grant:
        """Return what a token opens; raises Refusal for a wrong one, and for an address that sent
        too many.

        An address with too many wrong tokens is still granted random ones, which cannot be guessed:
        else whoever shares the operator's address could keep the operator out.
        """
        now = monotonic()
        recent = [t for t in self._wrong.get(address, []) if now - t < WRONG_TOKENS_SECONDS]
        limited = len(recent) >= WRONG_TOKENS
        if (expiry := self._one_time.pop(token, None)) is not None and now < expiry:
            return self.grants["operate"]
        matching = [grant for grant in self.grants.values() if _is_equal(token, grant.token)]
        if matching and not (limited and matching[0].chosen):
            return matching[0]
        if limited:
            raise Refusal(
                HTTPStatus.TOO_MANY_REQUESTS,
                f"Too many wrong links came from this address: wait {WRONG_TOKENS_SECONDS:.0f} s,"
                " then try again.",
            )
        if address not in self._wrong and len(self._wrong) >= _MOST_ADDRESSES:
            self._wrong.pop(next(iter(self._wrong)))
        self._wrong[address] = [*recent, now]
        raise Refusal(
            HTTPStatus.FORBIDDEN,
            "This link is not, or no longer, valid: open the one last printed.",
        )

    def authorise(self, path: str, headers: Headers) -> tuple[Grant, str]:
        """Return the grant that a path and the request's cookie belong to, and the rest of the
        path, without a slash.

        Raises Refusal without a valid cookie.
        """
        first, _, rest = path.removeprefix("/").partition("/")
        for grant in self.grants.values():
            if _is_equal(f"/{first}", grant.path) and grant.accepts(headers):
                return grant, rest
        raise Refusal(
            HTTPStatus.FORBIDDEN,
            "This page belongs to whoever started slviewer: open the link that it printed where it"
            " was started.",
        )

    def is_encrypted(self, headers: Headers) -> bool:
        """Whether the browser's side of the connection is encrypted, by this server or by a proxy
        that says so."""
        return self.tls or [value.lower() for value in headers.get_all("X-Forwarded-Proto")] == [
            "https"
        ]

    def host(self, headers: Headers, local_address: str) -> str:
        """The request's Host if it is one of this server's names; raises Refusal otherwise (DNS
        rebinding)."""
        hosts = headers.get_all("Host")
        if len(hosts) != 1 or hosts[0].lower() not in self._list_hosts(local_address):
            raise Refusal(
                HTTPStatus.MISDIRECTED_REQUEST,
                "This server is not reached by that host name: start slviewer with --name and this"
                " name, if it is one.",
            )
        return hosts[0].lower()

    def check_origin(self, headers: Headers, host: str, websocket: bool) -> None:
        """Raise Refusal if another site's page sent the request; a WebSocket must say which page
        opened it."""
        origins, site, mode, destination = map(
            headers.get_all, ("Origin", "Sec-Fetch-Site", "Sec-Fetch-Mode", "Sec-Fetch-Dest")
        )
        own = {f"http://{host}", f"https://{host}"}
        foreign = any(origin.lower() not in own for origin in origins) or (
            websocket and len(origins) != 1
        )
        # SameSite ignores ports, so a page of another port of this machine is detected only here.
        # Following a link is no harm: it shows the page to the person who clicked it.
        if (mode, destination) != (["navigate"], ["document"]):
            foreign = foreign or not {*site} <= {"same-origin", "none"}
        if foreign:
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
        standard = self.port == (443 if self.tls else 80)
        return {f"{name}:{self.port}" for name in bare} | self.names | (bare if standard else set())


def _is_equal(given: str, expected: str) -> bool:
    """Whether two texts are equal, compared in constant time."""
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), expected.encode())
