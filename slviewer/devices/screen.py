"""A browser window as a projector: whether each pixel of a pattern becomes one pixel of the
screen."""

from typing import Annotated

import msgspec

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
    def pixels(self) -> tuple[int, int]:
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


def refusal(screen: Screen, size: tuple[int, int] | None) -> str:
    """Return why patterns of `size` (width, height; None: unknown) cannot be shown there, with a
    remedy; else ""."""
    if not screen.visible:
        return (
            "the projector page is hidden: bring its window to the front of the projector's screen,"
            " and leave nothing on top of it"
        )
    if not screen.full_screen:
        return (
            "the projector page does not fill its screen: put its window on the projector's screen"
            " and click into it (or press F11)"
        )
    if abs(screen.pinched - 1) > 1e-3:
        return (
            "the projector page is magnified by touch: pinch it back to its normal size, or"
            " reload it"
        )
    if not screen.is_pixel_exact:
        width, height = (screen.dpr * side for side in screen.inner)
        return (
            f"the projector page would resample the patterns, its window is {width:g} x {height:g}"
            f" px at {screen.dpr:g} px per page pixel: set the scaling of the projector's display"
            " to 100 % in the system's display settings, and the page's zoom to 100 % (Ctrl+0)"
        )
    # zoomed, next to a bar, or full screen inside a tab that is recorded
    if screen.inner != screen.whole:
        (width, height), (columns, rows) = screen.inner, screen.whole
        return (
            f"the projector page is full screen and {width} x {height} page pixels large where its"
            f" screen has {columns} x {rows}: set the page's zoom to 100 % (Ctrl+0), close any bar"
            " that the browser shows above it, and let nothing share or record this tab"
        )
    if size is not None and screen.pixels != size:
        (columns, rows), (width, height) = screen.pixels, size
        return (
            f"the projector page fills {columns} x {rows} px and the patterns have {width} x"
            f" {height}, which must fill it exactly: set the resolution of that display to {width}"
            f" x {height}, or choose {columns} x {rows} as the projector's size"
        )
    if not screen.settled:
        return "the browser still shows a notice over the projector page: wait a few seconds"
    return ""
