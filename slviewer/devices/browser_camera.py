"""A camera that anybody has: a page, open on a phone or laptop, that sends its camera's pictures
without loss.

The page waits for a picture that the camera took after the request, takes it from a canvas, and
sends one channel of it uncompressed (1 byte a pixel), or three. While the camera is in use, the
page locks exposure, focus and white balance as far as the browser lets it; what stays automatic is
reported in `notes`.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from slviewer.devices.page_channel import ANSWER_S, PageChannel, PageConnection, resolve_page
from slviewer.devices.protocols import CameraSettings, Channel, Openable, check_channel, check_frame
from slviewer.errors import DeviceError

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

    def refusal(self, size: tuple[int, int] | None) -> str:
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


class BrowserCamera(Openable):
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
        self._pages, self.size = resolve_page(page, "camera", size, _MAX_SIDE_PX)
        super().__init__("the browser camera")
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

    def grab(self, out: np.ndarray) -> None:
        """Fill `out` (h, w) with a picture taken after this call."""
        check_frame(self, out)
        np.copyto(out, self._request_picture(self._channel, 1)[..., 0])

    def grab_colour(self) -> np.ndarray:
        """Grab a new (h, w, 3) RGB picture, as `grab`."""
        return self._request_picture("rgb", 3)

    def settings(self) -> CameraSettings:
        """Read the exposure; None where the browser does not report it."""
        return CameraSettings(self._require_page().facts.exposure_ms)

    def apply(self, settings: CameraSettings) -> CameraSettings:
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
        return self.settings()

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
                f" {width * height * depth:,} of a picture: reload it"
            )
        return np.frombuffer(content, np.uint8).reshape(height, width, depth)

    def _require_page(self) -> PageConnection[Video]:
        """Return the page that was locked when the camera was opened. Raises DeviceError where it
        was reloaded."""
        self.check_open()
        assert self._page
        self._page.check()
        return self._page
