"""A projector that any computer has: a page, full screen on the projector's output, that shows
patterns pixel by pixel.

A pattern varies along one axis, so that its profile alone is sent; the page keeps the profiles of
one sequence, and repeats one over its canvas when it is shown. "Shown" is reported two animation
frames later: the picture is composited by then, not yet emitted, and what the display adds is
measured and waited for as the rig's `settle_ms`.
"""

from collections.abc import Sequence
from typing import Any

import msgspec

from slviewer.devices.page_channel import ANSWER_S, PageChannel, PageConnection
from slviewer.devices.protocols import (
    Openable,
    check_image_size,
    check_index,
    check_level,
    check_sequence,
)
from slviewer.devices.screen import Screen, refusal
from slviewer.errors import DeviceError
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import PatternSequence

_MAX_SIZE_PX = 16384


class ProjectorHello(msgspec.Struct, tag_field="op", tag="hello"):
    """The first message of the projector page."""

    window: str
    take: bool
    facts: Screen = msgspec.field(name="screen")


class ProjectorReport(msgspec.Struct, tag_field="op", tag="screen"):
    """Message of the page that its screen has changed."""

    facts: Screen = msgspec.field(name="screen")


class ProjectorChannel(PageChannel[Screen]):
    """Connects a projector to its page."""

    hello, report = ProjectorHello, ProjectorReport
    name = "the projector page"
    remedy = "open the projector's link on the projector's screen"

    def __init__(self, answer_s: float = ANSWER_S) -> None:
        super().__init__(answer_s)
        self._pattern_size: tuple[int, int] | None = None
        self._light: int | None = None

    def set_pattern_size(self, size: tuple[int, int]) -> None:
        """Judge pages by patterns of this size (width, height) from now on."""
        with self._condition:
            self._pattern_size = size
            self._publish_state()

    def set_light(self, grey: int | None) -> None:
        """Set the light that a page shows after a reload; None: no projector is open, it shows its
        marker."""
        with self._condition:
            self._light = grey
            self._publish_state()

    def _refuse(self, facts: Screen) -> str:
        return refusal(facts, self._pattern_size)

    def _size(self, facts: Screen) -> tuple[int, int]:
        return facts.pixels

    def _describe_state(self, facts: Screen) -> tuple[Any, dict[str, Any]]:
        size = self._pattern_size or facts.pixels
        return (size, self._light is None), {
            "full": facts.full_screen,
            "size": size,
            "light": self._light,
        }


class BrowserProjector(Openable):
    """A projector of `size` (width, height) px that shows its patterns on the page connected to
    `channel`.

    A capture that loses its page, or during which the page's window changes, ends with a
    DeviceError; `load` then sends the patterns again, to whatever page is ready by then.
    """

    def __init__(self, channel: ProjectorChannel, size: tuple[int, int]) -> None:
        super().__init__("the browser projector")
        self.size = size
        self._channel = channel
        self._sequence: PatternSequence | None = None
        self._sent: tuple[list[str], bytes] | None = None
        self._page: PageConnection[Screen] | None = None  # that has what was sent
        self._changes = 0

    def _start(self) -> None:
        """Show dark. Raises DeviceError with a remedy where the page cannot show patterns pixel by
        pixel."""
        self._forget_loaded()
        self._channel.set_pattern_size(self.size)
        self._channel.page()
        self.show_level(None)

    def close(self) -> None:
        """Release the page, which then shows its marker."""
        if self._open:
            self._channel.set_light(None)
        self._forget_loaded()
        super().close()

    def load(self, sequence: PatternSequence) -> None:
        """Send all patterns of the sequence, unless the page has them already. Raises InputError or
        DeviceError."""
        self.check_open()
        check_sequence(self, sequence)
        page = self._channel.page()
        profiles = [profile(sequence, k) for k in range(len(sequence.frames))]
        axes: list[str] = [axis or "x" for axis, _ in profiles]
        sent = axes, b"".join(levels.tobytes() for _, levels in profiles)
        if page is not self._page or sent != self._sent:
            self._forget_loaded()
            page.request("load", sent[1], size=self.size, axes=axes)
        self._sequence, self._sent, self._page, self._changes = sequence, sent, page, page.changes

    def show(self, index: int) -> None:
        """Show frame `index`. Raises DeviceError where the page or its size changed since the
        patterns were sent."""
        self.check_open()
        check_index(self, self._sequence, index)
        page = self._page
        try:
            assert page is not None
            page.request("show", index=index)
            if page.changes != self._changes:
                raise DeviceError(
                    "the projector page's window changed while patterns were shown: capture again"
                )
        except BaseException:
            self._forget_loaded()
            raise

    def show_level(self, grey: int | None) -> None:
        """Show even light; a reloaded page shows it again."""
        self.check_open()
        level = check_level(grey)
        page = self._channel.page()
        self._channel.set_light(level)
        page.request("level", grey=level)

    def _forget_loaded(self) -> None:
        """Forget the loaded sequence and the page that it was sent to."""
        self._sequence = self._sent = self._page = None


def browser_projector(
    size: Sequence[int] | None = None, page: ProjectorChannel | None = None
) -> BrowserProjector:
    """Create a projector of `size` (width, height) px, by default the size of the connected page's
    screen.

    Raises DeviceError without a `page`, and where `size` is None and no page is connected.
    """
    if page is None:
        raise DeviceError(
            "the browser projector's page is served by `slviewer wizard` and `slviewer capture`:"
            " use one of them"
        )
    known = (
        page.page_state().size
        if size is None
        else check_image_size("projector", size, _MAX_SIZE_PX)
    )
    if known is None:
        raise DeviceError(
            "the projector's size is unknown: open the projector page first, or give the size"
        )
    return BrowserProjector(page, known)
