"""The message channel between a projector, on the thread that owns it, and its page, on a server's event loop.

The projector's side sends requests and waits; the server's side connects and disconnects pages and passes messages on.
One window at a time is the projector: it stays so when it is reloaded, and another one takes over only when the user
requests that in it. The page's report of its screen is judged here whether or not a projector is open, and the page
shows the same message as the operator's panel.
"""

import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import msgspec

from slviewer.devices.screen import Screen, refusal
from slviewer.errors import DeviceError, InputError

ANSWER_S = 1.8
"""A page that is alive answers within two animation frames; a request ends within two seconds in any case."""

Send = Callable[[bytes | None], None]
"""Queue a message for the page, from any thread, and return at once; None: end it, another window took over."""

_NO_PAGE = "no projector page is connected: open the projector's link on the projector's screen"


class Hello(msgspec.Struct, tag_field="op", tag="hello"):
    """A page's first message; `window` is the same after a reload, `take`: it requests to be the projector."""

    window: str
    take: bool
    screen: Screen


class Report(msgspec.Struct, tag_field="op", tag="screen"):
    """Message of the page that its screen has changed."""

    screen: Screen


class Done(msgspec.Struct, tag_field="op", tag="done"):
    """Answer of the page: request `number` was carried out, or why it was not."""

    number: int
    why: str = ""


@dataclass(frozen=True)
class PageState:
    """State of the projector page: "waiting" for one to be opened, "refused" or "ready", and a message in `words`.

    `size` is the (width, height) px of the page's screen, None while there is none.
    """

    state: Literal["waiting", "refused", "ready"]
    words: str
    size: tuple[int, int] | None = None


class PageConnection:
    """One connection of a projector page. The projector's thread sends requests, the server's stores the answers."""

    def __init__(self, condition: threading.Condition, hello: Hello, send: Send) -> None:
        self.window, self.screen = hello.window, hello.screen
        self.send = send
        self.changes = 0  # of its screen since it connected
        self.refused, self.gone = "", ""
        self.published: tuple | None = None
        self._condition = condition
        self._number = 0
        self._answer: Done | None = None

    def request(self, op: str, payload: bytes = b"", **fields: Any) -> None:
        """Send a request, and wait until the page reports it done. Raises DeviceError within two seconds."""
        with self._condition:
            self._number += 1
            self.check()
            self.send(_encode_message({"op": op, "number": self._number, **fields}, payload))
            end = time.monotonic() + ANSWER_S
            while self._answer is None or self._answer.number != self._number:
                self.check()
                remaining_s = end - time.monotonic()
                if remaining_s <= 0:
                    raise DeviceError(
                        f"the projector page did not answer within {ANSWER_S:g} s: look whether its window is covered, "
                        "its computer asleep, or the network down"
                    )
                self._condition.wait(remaining_s)
            if self._answer.why:
                raise DeviceError(f"the projector page failed, {self._answer.why}: reload it")

    def check(self) -> None:
        """Raise DeviceError if the page is disconnected, or its screen cannot show the patterns."""
        if self.gone or self.refused:
            raise DeviceError(self.gone or self.refused)

    def store_answer(self, done: Done) -> None:
        """Store an answer for the waiting `request`."""
        self._answer = done


class Channel:
    """Connects a projector to its page. Every method may be called from any thread; only `wait_ready` waits."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._page: PageConnection | None = None
        self._size: tuple[int, int] | None = None
        self._light: int | None = None

    # for panels that show the state

    def page_state(self) -> PageState:
        """Return the current state of the page."""
        with self._condition:
            page = self._page
            if page is None:
                return PageState("waiting", "waiting for the page")
            size = page.screen.pixels
            if page.refused:
                return PageState("refused", page.refused, size)
            return PageState("ready", f"ready {size[0]} x {size[1]}", size)

    def wait_ready(self, timeout_s: float) -> PageState:
        """Wait until the page is ready, at most `timeout_s`; returns its state."""
        with self._condition:
            self._condition.wait_for(lambda: self.page_state().state == "ready", timeout_s)
            return self.page_state()

    # the projector's side

    def set_pattern_size(self, size: tuple[int, int]) -> None:
        """Judge pages by patterns of this size (width, height) from now on."""
        with self._condition:
            self._size = size
            self._publish_state()

    def set_light(self, grey: int | None) -> None:
        """Set the light that a page shows after a reload; None: no projector is open, it shows its marker."""
        with self._condition:
            self._light = grey
            self._publish_state()

    def page(self) -> PageConnection:
        """Return the connected page, able to show the patterns. Raises DeviceError with a remedy."""
        with self._condition:
            if self._page is None:
                raise DeviceError(_NO_PAGE)
            self._page.check()
            return self._page

    # the server's side

    def connect(self, hello: str | bytes, send: Send) -> PageConnection | None:
        """Connect the page that sent `hello`; None where another window is the projector. Raises InputError for an
        invalid message.
        """
        incoming: Hello = _decode_message(hello, Hello)
        with self._condition:
            before = self._page
            if before is not None:
                if incoming.window != before.window and not incoming.take:
                    return None
                self._end_connection(
                    before,
                    "the projector page was reloaded, or connected anew"
                    if incoming.window == before.window
                    else "another window was made the projector",
                )
                before.send(None)
            page = self._page = PageConnection(self._condition, incoming, send)
            self._publish_state()
            return page

    def handle_message(self, page: PageConnection, message: str | bytes) -> None:
        """Handle a message of a connected page. Raises InputError for an invalid one."""
        incoming = _decode_message(message, Report | Done)
        with self._condition:
            if isinstance(incoming, Done):
                page.store_answer(incoming)
            elif incoming.screen != page.screen:
                page.screen = incoming.screen
                page.changes += 1
                self._publish_state()
            self._condition.notify_all()

    def disconnect(self, page: PageConnection) -> None:
        """Handle the loss of a page's connection."""
        with self._condition:
            if self._page is page:
                self._page = None
                self._end_connection(page, "the projector page was closed, or its connection was lost")

    def _end_connection(self, page: PageConnection, why: str) -> None:
        """End a connection: requests to this page then raise DeviceError with the reason."""
        page.gone = f"{why}: capture again once it is ready"
        self._condition.notify_all()

    def _publish_state(self) -> None:
        """Judge the page's screen, and send the page its state if that has changed."""
        page = self._page
        if page is None:
            return
        page.refused = refusal(page.screen, self._size)
        self._condition.notify_all()
        size = self._size or page.screen.pixels
        state = (page.refused, size, self._light is None)
        if state != page.published:
            page.published = state
            fields = {"refused": page.refused, "full": page.screen.full_screen, "size": size, "light": self._light}
            page.send(_encode_message({"op": "stand", **fields}))


def _encode_message(header: dict[str, Any], payload: bytes = b"") -> bytes:
    """Encode a message: the header's length as 4 bytes, little endian, the header as JSON, then the payload."""
    text = msgspec.json.encode(header)
    return struct.pack("<I", len(text)) + text + payload


def _decode_message(message: str | bytes, kind: Any) -> Any:
    """Decode a JSON message of the page as `kind`. Raises InputError for an invalid one."""
    try:
        return msgspec.json.decode(message, type=kind)
    except (msgspec.MsgspecError, UnicodeError) as error:
        raise InputError(f"the projector page sent an invalid message ({error}): reload it") from error
