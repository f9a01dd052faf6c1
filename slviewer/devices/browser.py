"""Devices that any computer or phone has: a screen as the projector, a camera, each through a page
in a browser.

The camera's page, open on a phone or laptop, sends pictures without loss. It waits for a picture
that the camera took after the request, takes it from a canvas, and sends one channel of it
uncompressed (1 byte a pixel), or three. While the camera is in use, the page locks exposure, focus
and white balance as far as the browser lets it; what stays automatic is reported in `notes`.

The projector's page, full screen on the projector's output, shows patterns pixel by pixel. A
pattern varies along one axis, so that its profile alone is sent; the page keeps the profiles of one
sequence, and repeats one over its canvas when it is shown. "Shown" is reported two animation frames
later: the picture is composited by then, not yet emitted, and what the display adds is measured and
waited for as the rig's `settle_ms`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.page_channel import ANSWER_S, PageChannel, PageConnection, PageDevice
from slviewer.devices.protocols import (
    CameraDriver,
    CameraSettings,
    Channel,
    check_channel,
    check_image,
    check_index,
    check_level,
    check_sequence,
)
from slviewer.errors import DeviceError
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import Axis, PatternSequence, Size

FRAME_S = 10.0
"""How long a picture may take, from the request until it has arrived here."""
SETTLING_MS = 700.0
"""How long a camera takes to act on a setting."""
_LOCK_S = 8.0
"""How long the camera may take to reach the settings that it is locked at."""
_MAX_SIDE_PX = 2**13

_Text = Annotated[str, msgspec.Meta(max_length=200)]
_Side = Annotated[int, msgspec.Meta(ge=1, le=_MAX_SIDE_PX)]
_Milliseconds = Annotated[float, msgspec.Meta(gt=0, le=600_000)]
_PROBLEMS = {
    "insecure": (
        "the browser gives its camera to encrypted pages alone: start slviewer with --tls, and open"
        " the camera page's new link"
    ),
    "NotAllowedError": (
        "the browser refused the camera page its camera: allow it beside the page's address, then "
        "reload the page"
    ),
    "NotFoundError": "the camera page's device has no camera: open the page on another one",
    "NotReadableError": (
        "the camera page cannot read its camera: close other programs that use it, then reload it"
    ),
}


class Video(msgspec.Struct, frozen=True):
    """The camera of the page, as it reports it.

    `size`: (width, height) px of its pictures; None while there are none, and then `problem` is the
    name of the browser's error, "insecure" where the page is not encrypted, or "" while it starts.
    `label`: the browser's name for it. `automatic`: what the browser does not lock. `exposure_ms`:
    None where the browser does not report it. `visible`: whether the page is in front; hidden ones
    get no pictures.
    """

    size: tuple[_Side, _Side] | None
    problem: _Text
    label: _Text
    automatic: tuple[Literal["exposure", "focus", "white balance"], ...]
    exposure_ms: _Milliseconds | None
    visible: bool

    def refusal(self, size: Size | None) -> str:
        """Return why pictures of `size` (width, height; None: any) cannot be taken there, with a
        remedy; else ""."""
        if self.size is None:
            failed = f"the camera page has no pictures ({self.problem or 'its camera is starting'})"
            return _PROBLEMS.get(self.problem, f"{failed}: wait a moment, else reload the page")
        if not self.visible:
            return "the camera page is hidden: bring it to the front, and keep its screen on"
        if size is not None and size != self.size:
            (width, height), (columns, rows) = self.size, size
            return (
                f"the camera page's pictures have {width} x {height} px and no longer {columns} x"
                f" {rows}: turn the phone back and fix it, or choose the rig again"
            )
        return ""


class CameraChannel(PageChannel[Video]):
    """Connects a camera to its page."""

    facts = Video
    name = "the camera page"
    remedy = "open the camera's link on the phone or laptop whose camera is used"

    def __init__(self, answer_s: float = ANSWER_S, settling_ms: float = SETTLING_MS) -> None:
        super().__init__(answer_s)
        self.settling_ms = settling_ms

    def _describe_state(self, facts: Video) -> tuple[Any, dict[str, Any]]:
        in_use = self._wanted_size is not None
        return (facts.size, in_use), {"used": in_use}


class BrowserCamera(PageDevice[CameraChannel], CameraDriver):
    """One `channel` of the pictures of the camera on a page.

    A capture that loses its page, or whose pictures change their size, ends with a DeviceError. A
    gain is not set: browsers offer none that is a factor on the grey levels.
    """

    dtype = np.dtype(np.uint8)

    def __init__(
        self,
        size: Sequence[int] | None = None,
        exposure_ms: float | None = None,
        channel: Channel = "green",
        page: CameraChannel | None = None,
    ) -> None:
        """A camera of `size` (width, height) px, by default that of the connected page's camera;
        `channel` is what is decoded, `page` leads to the page. `exposure_ms` is set when it is
        opened, where the browser lets it.

        Raises DeviceError without a `page`, and where `size` is None and no page is ready.
        """
        check_channel(channel)
        super().__init__("camera", page, size, _MAX_SIDE_PX)
        self._channel: Channel = channel
        self._exposure_ms = CameraSettings(exposure_ms).exposure_ms
        self._page: PageConnection[Video] | None = None
        self._note = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about the settings, a sentence each."""
        page, unlocked = self._page, ""
        if page and page.facts.automatic:
            unlocked = (
                f"its browser does not lock {' and '.join(page.facts.automatic)}: nothing may move"
                " or change its brightness during a capture; Chrome on Android locks most"
            )
        return tuple(f"{self.name}: {sentence}" for sentence in (unlocked, self._note) if sentence)

    def _start(self) -> None:
        """Lock what is automatic. Raises DeviceError with a remedy where the page has no pictures
        of this size."""
        self._pages.set_size(self.size)
        page = self._pages.page()
        self._lock(page, self._exposure_ms)
        self._page = page

    def close(self) -> None:
        """Release the page, which unlocks its camera; nothing happens when it is not open."""
        if self._open:
            self._pages.set_size(None)
        self._page = None
        super().close()

    def _fill(self, out: np.ndarray) -> None:
        """Write a picture taken after this call."""
        np.copyto(out, self._request_picture(self._channel, 1)[..., 0])

    def grab_colour(self) -> np.ndarray:
        """Grab a new (h, w, 3) RGB picture, as `grab`."""
        return self._request_picture("rgb", 3)

    def _read_settings(self) -> CameraSettings:
        """Return the exposure; None where the browser does not report it."""
        return CameraSettings(self._require_page().facts.exposure_ms)

    def _write_settings(self, settings: CameraSettings) -> None:
        """Set the exposure; what could not be set is in `notes`."""
        page, self._note = self._require_page(), ""
        if settings.exposure_ms is not None:
            self._lock(page, settings.exposure_ms)
            if page.facts.exposure_ms is None:
                self._note = (
                    "its browser sets no exposure: change the light or the projector's brightness"
                    " instead"
                )
        if settings.gain is not None:
            self._note = "browsers set no gain: change the exposure instead"

    def _lock(self, page: PageConnection[Video], exposure_ms: float | None) -> None:
        """Lock what is automatic, at an exposure where one is given, and wait until the camera has
        settled."""
        page.request(
            "lock", timeout_s=_LOCK_S, exposure_ms=exposure_ms, settling_ms=self._pages.settling_ms
        )

    def _request_picture(self, channel: Channel | Literal["rgb"], depth: int) -> np.ndarray:
        """Request a picture taken from now on, and return it, (h, w, depth) uint8."""
        width, height = self.size
        content = self._require_page().request(
            "grab", timeout_s=FRAME_S, channel=channel, size=self.size
        )
        if len(content) != width * height * depth:
            raise DeviceError(
                f"the camera page sent {len(content):,} bytes and not the"
                f" {width * height * depth:,} of a picture",
                "reload it",
            )
        return np.frombuffer(content, np.uint8).reshape(height, width, depth)

    def _require_page(self) -> PageConnection[Video]:
        """Return the page that was locked when the camera was opened. Raises DeviceError where it
        was reloaded."""
        self.check_open()
        assert self._page
        self._page.check()
        return self._page


_MAX_SIZE_PX = 16384
_SLOWEST_HZ = 20.0


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
    def size(self) -> Size:
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

    def refusal(self, size: Size | None) -> str:
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


class BrowserProjector(PageDevice[ProjectorChannel]):
    """A projector that shows its patterns on the page connected to its channel.

    A capture that loses its page, or during which the page's window changes, ends with a
    DeviceError; `load` then sends the patterns again, to whatever page is ready by then.
    """

    def __init__(
        self, size: Sequence[int] | None = None, page: ProjectorChannel | None = None
    ) -> None:
        """A projector of `size` (width, height) px, by default that of the connected page's screen.

        Raises DeviceError without a `page`, and where `size` is None and no page is connected.
        """
        super().__init__("projector", page, size, _MAX_SIZE_PX)
        self._sequence: PatternSequence | None = None
        self._sent: tuple[list[str], bytes] | None = None
        self._page: PageConnection[Screen] | None = None  # that has what was sent
        self._changes = 0

    def _start(self) -> None:
        """Show dark. Raises DeviceError with a remedy where the page cannot show patterns pixel by
        pixel."""
        self._forget_loaded()
        self._claimed.callback(self._forget_loaded)
        self._claimed.callback(self._pages.set_light, None)  # the page then shows its marker
        self._pages.set_size(self.size)
        self._pages.page()
        self.show_level(None)

    def load(self, sequence: PatternSequence) -> None:
        """Send all patterns of the sequence, unless the page has them already. Raises InputError or
        DeviceError."""
        self.check_open()
        check_sequence(self, sequence)
        self._send([profile(sequence, k) for k in range(len(sequence.frames))])
        self._sequence = sequence

    def load_pictures(self, pictures: Sequence[tuple[Axis, np.ndarray]]) -> None:
        """Load pictures for `play` in place of a sequence: the axis along which each varies, and
        its (extent, 3) RGB."""
        self.check_open()
        self._send(pictures)

    def play(self) -> None:
        """Show what is loaded, a picture a refresh of the display; returns when the last one is
        shown."""
        self.check_open()
        many = len(self._sent[0]) if self._sent else 0
        self._request("play", timeout_s=ANSWER_S + many / _SLOWEST_HZ)

    def _send(self, profiles: Sequence[tuple[Axis | None, np.ndarray]]) -> None:
        """Send pictures that the page lacks, grey (extent,) or RGB (extent, 3) along an axis."""
        page = self._pages.page()
        axes: list[str] = [axis or "x" for axis, _ in profiles]
        sent = axes, b"".join(levels.tobytes() for _, levels in profiles)
        if page is not self._page or sent != self._sent:
            self._forget_loaded()
            page.request("load", sent[1], size=self.size, axes=axes)
        self._sequence = None
        self._sent, self._page, self._changes = sent, page, page.changes

    def show(self, index: int) -> None:
        """Show frame `index`. Raises DeviceError where the page or its size changed since the
        patterns were sent."""
        self.check_open()
        check_index(self, self._sequence, index)
        self._request("show", index=index)

    def _request(self, op: str, timeout_s: float | None = None, **fields: Any) -> None:
        """Let the page show what it was sent, and check that it still is as it was then."""
        page = self._page
        try:
            assert page
            page.request(op, timeout_s=timeout_s, **fields)
            if page.changes != self._changes:
                raise DeviceError(
                    "the projector page's window changed while patterns were shown", "capture again"
                )
        except BaseException:
            self._forget_loaded()
            raise

    def show_level(self, grey: int | None) -> None:
        """Show even light; a reloaded page shows it again."""
        self.check_open()
        level = check_level(grey)
        page = self._pages.page()
        self._pages.set_light(level)
        page.request("level", grey=level)

    def show_image(self, image: np.ndarray) -> None:
        """Send an image (h, w, 3) and show it; a reloaded page is dark."""
        self.check_open()
        content = check_image(self, image).tobytes()
        self._forget_loaded()
        page = self._pages.page()
        self._pages.set_light(0)
        page.request("image", content, size=self.size)

    def _forget_loaded(self) -> None:
        """Forget the loaded sequence and the page that it was sent to."""
        self._sequence = self._sent = self._page = None


PageRole = Literal["projector", "camera"]
"""The devices that may be pages in a browser."""
PAGE_ROLES: tuple[PageRole, ...] = get_args(PageRole)


@dataclass(frozen=True)
class PageChannels:
    """The channels to the pages of the browser's devices."""

    projector: ProjectorChannel = field(default_factory=ProjectorChannel)
    camera: CameraChannel = field(default_factory=CameraChannel)


DRIVER = Driver(
    "browser",
    "a page on a screen, phone or laptop",
    needs=(
        "the projector page, open in a browser on the projector's screen; the camera page, on the"
        " phone or laptop"
    ),
    camera=BrowserCamera,
    projector=BrowserProjector,
    page=True,
)
