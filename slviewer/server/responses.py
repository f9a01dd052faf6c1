"""HTTP answers, and the headers that every one of them carries."""

import base64
import hashlib
import re
from http import HTTPStatus

from websockets.datastructures import Headers
from websockets.http11 import Response

_CLOSED = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
HELP_POLICY = f"{_CLOSED}; style-src 'unsafe-inline'; img-src 'self'"
"""Content-Security-Policy of the documentation: nothing runs there, and only this server's pictures
are shown."""


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


def viser_policy(scripts: tuple[str, ...], host: str) -> str:
    """Return the content security policy of viser's page, which unpacks itself with WebAssembly in
    a blob worker.

    Only viser's own scripts (given by their hashes) run, so that HTML in a label, a script or an
    event handler in it, does nothing even where someone forgot to escape it. They may evaluate
    text: parts of them are compiled so, and Plotly is sent as text.
    """
    return (
        f"{_CLOSED}; script-src {' '.join(scripts)} 'unsafe-eval'; style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; media-src data: blob:; font-src data:; worker-src blob:; "
        f"connect-src 'self' data: blob: ws://{host} wss://{host}"
    )


def script_hash(script: bytes) -> str:
    """A script's SHA hash as a source in a Content-Security-Policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
