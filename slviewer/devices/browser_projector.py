"""A projector that any computer has: a page, full screen on the projector's output, that shows
patterns pixel by pixel.

A pattern varies along one axis, so that its profile alone is sent; the page keeps the profiles of
one sequence, and repeats one over its canvas when it is shown. "Shown" is reported two animation
frames later: the picture is composited by then, not yet emitted, and what the display adds is
measured and waited for as the rig's `settle_ms`.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import msgspec

from slviewer.devices.page_channel import ANSWER_S, PageChannel, PageConnection, resolve_page
from slviewer.devices.protocols import Openable, check_index, check_level, check_sequence
from slviewer.errors import DeviceError
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import PatternSequence

_MAX_SIZE_PX = 16384


_Count = Annotated[int, msgspec.Meta(ge=0, le=2**16)]
_Ratio = Annotated[float, msgspec.Meta(gt=0, le=64)]

# browsers round the ratio to single precision; a window that is cut off is 0.25 px or more away
_EXACT_PX = 0.01


class Screen(msgspec.Struct, frozen=True):
    """Screen and window of the projector page, as it reports them.

    `dpr`: device pixels per page pixel. `inner`, `whole`: (width, height) of the window's inside
    and of its screen in page pixels. `box`: the inside in device pixels as the browser laid it out,
    None where a browser does not report it. `full`: shown full screen on request. `settled`: the
    browser no longer shows over the page that Esc leaves full screen. `pinched`: magnification by
    touch.
    """

    dpr: _Ratio
    inner: tuple[_Count, _Count]
    whole: tuple[_Count, _Count]
    box: tuple[_Count, _Count] | None
    full: bool
    settled: bool
    visible: bool
    pinched: _Ratio

    @property
    def full_screen(self) -> bool:
        """Whether the window is full screen, on request or because it was opened so (kiosk,
        F11)."""
        return self.full or self.inner == self.whole

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) device px of the window if it is full screen, else of the screen."""
        width, height = self.inner if self.full_screen else self.whole
        return round(width * self.dpr), round(height * self.dpr)

    @property
    def is_pixel_exact(self) -> bool:
        """Whether the window is a whole number of device pixels wide and high."""
        sides = [self.dpr * side for side in self.inner]
        whole = tuple(round(side) for side in sides)
        near = all(abs(side - px) < _EXACT_PX for side, px in zip(sides, whole, strict=True))
        # a ratio that developer tools emulate is not in the box, which is then in page pixels
        return near and self.box in (None, whole, self.inner)

    def refusal(self, size: tuple[int, int] | None) -> str:
        """Return why patterns of `size` (width, height; None: unknown) cannot be shown there, with
        a remedy; else ""."""
        if not self.visible:
            return (
                "the projector page is hidden: bring its window to the front of the projector's"
                " screen, and leave nothing on top of it"
            )
        if not self.full_screen:
            return (
                "the projector page does not fill its screen: put its window on the projector's"
                " screen and click into it (or press F11)"
            )
        if abs(self.pinched - 1) > 1e-3:
            return (
                "the projector page is magnified by touch: pinch it back to its normal size, or"
                " reload it"
            )
        if not self.is_pixel_exact:
            width, height = (self.dpr * side for side in self.inner)
            return (
                f"the projector page would resample the patterns, its window is {width:g} x"
                f" {height:g} px at {self.dpr:g} px per page pixel: set the scaling of the"
                " projector's display to 100 % in the system's display settings, and the page's"
                " zoom to 100 % (Ctrl+0)"
            )
        # zoomed, next to a bar, or full screen inside a tab that is recorded
        if self.inner != self.whole:
            (width, height), (columns, rows) = self.inner, self.whole
            return (
                f"the projector page is full screen and {width} x {height} page pixels large where"
                f" its screen has {columns} x {rows}: set the page's zoom to 100 % (Ctrl+0), close"
                " any bar that the browser shows above it, and let nothing share or record this tab"
            )
        if size is not None and self.size != size:
            (columns, rows), (width, height) = self.size, size
            return (
                f"the projector page fills {columns} x {rows} px and the patterns have {width} x"
                f" {height}, which must fill it exactly: set the resolution of that display to"
                f" {width} x {height}, or choose {columns} x {rows} as the projector's size"
            )
        if not self.settled:
            return "the browser still shows a notice over the projector page: wait a few seconds"
        return ""


class ProjectorChannel(PageChannel[Screen]):
    """Connects a projector to its page."""

    facts = Screen
    name = "the projector page"
    remedy = "open the projector's link on the projector's screen"

    def __init__(self, answer_s: float = ANSWER_S) -> None:
        super().__init__(answer_s)
        self._light: int | None = None

    def set_light(self, grey: int | None) -> None:
        """Set the light that a page shows after a reload; None: no projector is open, it shows its
        marker."""
        with self._condition:
            self._light = grey
            self._publish_state()

    def _describe_state(self, facts: Screen) -> tuple[Any, dict[str, Any]]:
        size = self._wanted_size or facts.size
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
        self._channel.set_size(self.size)
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
            assert page
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
    return BrowserProjector(*resolve_page(page, "projector", size, _MAX_SIZE_PX))
