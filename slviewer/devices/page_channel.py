"""The message channel between a device that is a browser's page, and the page, on a server's event
loop.

The device's side, on the thread that owns it, sends requests and waits; the server's side connects
and disconnects pages and passes messages on. One window at a time is the device: it stays so when
it is reloaded, and another one takes over only when the user requests that in it. What the page
reports of itself is judged here whether or not the device is open, and the page shows the same
message as the operator's panel.
"""

import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar

import msgspec

from slviewer.devices.protocols import Openable, check_image_size
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import Size

ANSWER_S = 1.8
"""A page that is alive answers within two animation frames; a request ends within two seconds
unless it says more."""

Send = Callable[[bytes | None], None]
"""Queue a message for the page, from any thread, and return at once; None: end it, another window
took over."""


class PageFacts(Protocol):
    """What a kind of page reports of itself."""

    @property
    def size(self) -> Size | None:
        """The (width, height) px of the page's screen or camera."""

    def refusal(self, size: Size | None) -> str:
        """Return why the page cannot be a device of this size (None: unknown), with a remedy; ""
        where it can."""


Facts = TypeVar("Facts", bound=PageFacts)


class Hello(msgspec.Struct, Generic[Facts], tag_field="op", tag="hello"):
    """A page's first message; `window` is the same after a reload, `take`: it requests to be the
    device."""

    window: str
    take: bool
    facts: Facts


class Report(msgspec.Struct, Generic[Facts], tag_field="op", tag="report"):
    """Message of a page that what it reports has changed."""

    facts: Facts


class Done(msgspec.Struct, tag_field="op", tag="done"):
    """Answer of the page: request `number` was carried out, or why it was not."""

    number: int
    why: str = ""


@dataclass(frozen=True)
class PageState:
    """State of a page: "waiting" for one to be opened, "refused" or "ready", and a message in
    `words`.

    `size` is the (width, height) px of the page's screen or camera, None while there is none.
    """

    state: Literal["waiting", "refused", "ready"]
    words: str
    size: Size | None = None


@dataclass(eq=False)
class PageConnection(Generic[Facts]):
    """One connection of a page. The device's thread sends requests, the server's stores the
    answers.

    ``changes`` of what it reported since it connected; ``refused``, ``gone``: why it cannot be the
    device, or is lost.
    """

    condition: threading.Condition
    name: str
    window: str
    facts: Facts
    send: Send
    answer_s: float = ANSWER_S
    changes: int = 0
    refused: str = ""
    gone: str = ""
    published: Any = None
    _number: int = 0
    answer: tuple[Done, bytes] | None = None

    def request(
        self, op: str, payload: bytes = b"", timeout_s: float | None = None, **fields: Any
    ) -> bytes:
        """Send a request, wait until the page reports it done, and return what came with the
        answer.

        Raises DeviceError within `timeout_s`, None: within `answer_s`.
        """
        timeout_s = self.answer_s if timeout_s is None else timeout_s
        with self.condition:
            self._number += 1
            self.check()
            self.send(encode_message({"op": op, "number": self._number, **fields}, payload))
            end = time.monotonic() + timeout_s
            while self.answer is None or self.answer[0].number != self._number:
                self.check()
                remaining_s = end - time.monotonic()
                if remaining_s <= 0:
                    raise DeviceError(
                        f"{self.name} did not answer within {timeout_s:g} s",
                        "look whether its window is covered, its computer asleep, or the network"
                        " down",
                    )
                self.condition.wait(remaining_s)
            done, content = self.answer
            self.answer = None
            if done.why:
                raise DeviceError(f"{self.name} failed, {done.why}", "reload it")
            return content

    def check(self) -> None:
        """Raise DeviceError if the page is disconnected, or cannot be the device."""
        if self.gone or self.refused:
            raise DeviceError(self.gone or self.refused)


class PageChannel(ABC, Generic[Facts]):
    """Connects a device to its page. Every method may be called from any thread; only `wait_ready`
    waits."""

    facts: type
    """What the page reports of itself."""
    name: str
    """Of the page, to start a sentence with."""
    remedy: str
    """What to do where no page is connected."""

    def __init__(self, answer_s: float = ANSWER_S) -> None:
        self._condition = threading.Condition()
        self._answer_s = answer_s
        self._page: PageConnection[Facts] | None = None
        self._wanted_size: Size | None = None

    def set_size(self, size: Size | None) -> None:
        """Judge pages by pictures or patterns of this size (width, height) from now on; None: of
        any."""
        with self._condition:
            self._wanted_size = size
            self._publish_state()

    @abstractmethod
    def _describe_state(self, facts: Facts) -> tuple[Any, dict[str, Any]]:
        """Return a value that differs when the page has to learn its state anew, and the fields
        that describe it."""

    # for panels that show the state

    def page_state(self) -> PageState:
        """Return the current state of the page."""
        with self._condition:
            page = self._page
            if page is None:
                return PageState("waiting", "waiting for the page")
            size = page.facts.size
            if page.refused or size is None:
                return PageState("refused", page.refused, size)
            return PageState("ready", f"ready {size[0]} x {size[1]}", size)

    def wait_ready(self, timeout_s: float) -> PageState:
        """Wait until the page is ready, at most `timeout_s`; returns its state."""
        with self._condition:
            self._condition.wait_for(lambda: self.page_state().state == "ready", timeout_s)
            return self.page_state()

    # the device's side

    def page(self) -> PageConnection[Facts]:
        """Return the connected page, able to be the device. Raises DeviceError with a remedy."""
        with self._condition:
            if self._page is None:
                raise DeviceError(
                    f"no {self.name.removeprefix('the ')} is connected", f"{self.remedy}"
                )
            self._page.check()
            return self._page

    # the server's side

    def connect(self, hello: str | bytes, send: Send) -> PageConnection[Facts] | None:
        """Connect the page that sent `hello`; None where another window is the device. Raises
        InputError for an invalid message.
        """
        first = self._decode(hello, Hello[self.facts])  # type: ignore[name-defined]
        with self._condition:
            before = self._page
            if before:
                is_same = first.window == before.window
                if not is_same and not first.take:
                    return None
                reloaded = f"{self.name} was reloaded, or connected anew"
                replaced = f"another window was made {self.name}"
                self._end_connection(before, reloaded if is_same else replaced)
                before.send(None)
            page = self._page = PageConnection(
                self._condition, self.name, first.window, first.facts, send, self._answer_s
            )
            self._publish_state()
            return page

    def handle_message(self, page: PageConnection[Facts], message: str | bytes) -> None:
        """Handle a message of a connected page. Raises InputError for an invalid one."""
        content = b""
        if isinstance(message, bytes):  # an answer, as `encode_message` makes it
            length = struct.unpack("<I", message[:4])[0] if len(message) >= 4 else 0
            message, content = message[4 : 4 + length], message[4 + length :]
        incoming = self._decode(message, Report[self.facts] | Done)  # type: ignore[name-defined]
        with self._condition:
            if isinstance(incoming, Done):
                page.answer = incoming, content
            elif incoming.facts != page.facts:
                page.facts = incoming.facts
                page.changes += 1
                self._publish_state()
            self._condition.notify_all()

    def disconnect(self, page: PageConnection[Facts]) -> None:
        """Handle the loss of a page's connection."""
        with self._condition:
            if self._page is page:
                self._page = None
                self._end_connection(page, f"{self.name} was closed, or its connection was lost")

    def _end_connection(self, page: PageConnection[Facts], why: str) -> None:
        """End a connection: requests to this page then raise DeviceError with the reason."""
        page.gone = f"{why}: capture again once it is ready"
        self._condition.notify_all()

    def _publish_state(self) -> None:
        """Judge what the page reports, and send the page its state if that has changed."""
        page = self._page
        if page is None:
            return
        page.refused = page.facts.refusal(self._wanted_size)
        self._condition.notify_all()
        state, fields = self._describe_state(page.facts)
        if (page.refused, state) != page.published:
            page.published = page.refused, state
            page.send(encode_message({"op": "stand", "refused": page.refused, **fields}))

    def _decode(self, message: str | bytes, kind: Any) -> Any:
        """Decode a JSON message of the page as `kind`. Raises InputError for an invalid one."""
        try:
            return msgspec.json.decode(message, type=kind)
        except (msgspec.MsgspecError, UnicodeError) as error:
            raise InputError(
                f"{self.name} sent an invalid message ({error})", "reload it"
            ) from error


Channel = TypeVar("Channel", bound=PageChannel[Any])


def encode_message(header: dict[str, Any], payload: bytes = b"") -> bytes:
    """Encode a message: the header's length as 4 bytes, little endian, the header as JSON, then the
    payload."""
    text = msgspec.json.encode(header)
    return struct.pack("<I", len(text)) + text + payload


class PageDevice(Openable, Generic[Channel]):
    """A device that is a page: its channel ``_pages``, and its ``size`` (width, height) px, by
    default that of the connected page.

    Raises DeviceError without a channel, and where the size is None and no page is ready.
    """

    def __init__(
        self, what: str, page: Channel | None, size: Sequence[int] | None, most_px: int
    ) -> None:
        super().__init__(f"the browser {what}")
        if page is None:
            raise DeviceError(
                f"{self.name}'s page is served by `slviewer wizard` and `slviewer capture`",
                "use one of them",
            )
        known = page.page_state().size if size is None else check_image_size(what, size, most_px)
        if known is None:
            raise DeviceError(
                f"the {what}'s size is unknown", f"open the {what} page first, or give the size"
            )
        self._pages, self.size = page, known
