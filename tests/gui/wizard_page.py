"""The wizard's page as a person finds their way in it: by what stands there to be read."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Locator,
    Page,
    TimeoutError,
    ViewportSize,
    expect,
)

from slviewer.gui.app import App
from slviewer.wizard.service import Timing

SIZE: ViewportSize = {"width": 1280, "height": 800}
CALM = Timing(previews_per_s=2.0, trials=20)
"""Fewer previews, and fewer places tried before one is suggested: a browser draws beside them, in
software."""
RIG = {"driver": "simulated", "scale": 0.25}
PATIENCE_S = 600.0
"""After which something hangs: a busy machine may take minutes for kernels and for a browser that
draws in software."""
PATIENCE_MS = 1000 * PATIENCE_S
SMALL_CANVAS = """
for (const side of ["width", "height"]) {
  const own = Object.getOwnPropertyDescriptor(HTMLCanvasElement.prototype, side);
  Object.defineProperty(HTMLCanvasElement.prototype, side,
    { ...own, set(pixels) { own.set.call(this, Math.ceil(pixels / 4)); } });
}
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, { ...options, antialias: false });
};
"""
"""Draws the scene with a sixteenth of the pixels: here they are drawn in software, and no test
looks at them."""
FEW_FRAMES = """
const nextFrame = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = draw => setTimeout(() => nextFrame(draw), 80);
window.cancelAnimationFrame = clearTimeout;
"""
"""Draws the scene about ten times a second."""


UNKNOWN = "Tried to update non-existent component"
"""Of viser's client, which applies the updates of a batch after its removals; seen once in
thousands of pages."""


class Opened:
    """A page that remembers what went wrong in it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.errors: list[str] = []
        self._unknown = 0
        self._sent: list[bytes] = []
        page.add_init_script(SMALL_CANVAS)
        page.add_init_script(FEW_FRAMES)
        page.on("websocket", lambda socket: socket.on("framesent", self._record_sent))
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.errors.append(error.stack or str(error)))

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type == "error" and (UNKNOWN not in message.text or self._is_repeated()):
            self.errors.append(message.text)

    def _record_sent(self, frame: bytes | str) -> None:
        self._sent.append(frame if isinstance(frame, bytes) else frame.encode())

    def send(self, act: Callable[[], None], content: str) -> None:
        """Do something in the page, and wait until the page has sent the server a message with this
        content."""
        before = len(self._sent)
        act()
        wait_until(
            self.page, lambda: any(content.encode() in frame for frame in self._sent[before:])
        )

    def enter(self, label: str, text: str) -> None:
        """Type a text into the input beside this label, and wait until the server has it: it is
        sent with a delay."""
        self.send(lambda: field(self.page, label).fill(text), text)

    def _is_repeated(self) -> bool:
        """Whether such a message came before: a handle of ours that is gone would be updated again
        and again."""
        self._unknown += 1
        return self._unknown > 1


def new_page(browser: Browser, size: ViewportSize = SIZE) -> Page:
    """A page in a context of its own, which waits as long as a busy machine needs."""
    context = browser.new_context(viewport=size)
    context.set_default_timeout(PATIENCE_MS)
    return context.new_page()


def wait_until(page: Page, holds: Callable[[], object]) -> None:
    """Let the page work until something holds."""
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, "it did not come about"
        page.wait_for_timeout(50)


def button(page: Page, name: str, *, exact: bool = False) -> Locator:
    """The button that says so, or, unless ``exact``, that and more."""
    return page.get_by_role("button", name=name, exact=exact)


@contextmanager
def browse(browser: Browser, app: App) -> Iterator[Opened]:
    """The page of a wizard in a browser, ready, until it is closed."""
    page = new_page(browser)
    found = Opened(page)
    page.goto(app.server.link())
    button(page, "1. Rig").wait_for()
    yield found
    page.context.close()


def expect_message(page: Page, text: str | re.Pattern[str]) -> None:
    """Expect a text among the messages: what the step states is no notification."""
    open_tab(page, "Messages")
    expect(page.get_by_text(text).filter(visible=True).first).to_be_visible()
    open_tab(page, "Step")


def open_tab(page: Page, name: str) -> None:
    """Show another tab of the panel: Step, Session or Messages."""
    page.get_by_role("tab", name=name).click()


STILL = """quiet => new Promise(done => {
  const end = () => { watcher.disconnect(); done(); };
  let timer = setTimeout(end, quiet);
  const watcher = new MutationObserver(() => {
    clearTimeout(timer);
    timer = setTimeout(end, quiet);
  });
  watcher.observe(document.body, { childList: true, subtree: true });
  setTimeout(end, 12 * quiet);
})"""


def wait_until_still(page: Page, quiet_ms: float = 250) -> None:
    """Wait until nothing on the page has changed for so long; at most some seconds where a live
    image is shown."""
    page.evaluate(STILL, quiet_ms)


def click(page: Page, name: str, *, exact: bool = False) -> None:
    """Click the button that says so once the page stands still: what is drawn anew just then may
    take the click."""
    expect(button(page, name, exact=exact)).to_be_enabled()
    wait_until_still(page)
    button(page, name, exact=exact).click()


def unfold(page: Page, folder: str) -> None:
    """Open a folder of the panel, which is closed at first."""
    page.get_by_text(folder, exact=True).click()


def field(page: Page, label: str) -> Locator:
    """The input beside this label, which the page may name so: viser's labels are text, as titles
    of tables are, without a tie to their input."""
    beside = f"//*[normalize-space(text())='{label}']/following::input[1]"
    return page.locator(f"xpath={beside}[not(@aria-label) or @aria-label='{label}']")


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of the dropdown beside this label; it closes where the panel is drawn anew
    meanwhile."""
    for _ in range(4):
        field(page, label).click()
        try:
            page.get_by_role("option", name=option, exact=True).click(timeout=12_000)
        except TimeoutError:
            page.keyboard.press("Escape")
        else:
            return
    raise AssertionError(f"{label} does not offer {option}")


def press(page: Page, name: str, came: Callable[[], bool]) -> None:
    """Press a button until what it asks for has come: what is drawn anew just then may take the
    click."""
    for _ in range(4):
        button(page, name).click()
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            if came():
                return
            page.wait_for_timeout(100)
    raise AssertionError(f"nothing came of pressing {name}")


def pose_row(page: Page, name: str, state: str) -> Locator:
    """The line of the list of poses that says what became of this one."""
    return page.locator("div", has_text=re.compile(rf"^{name}\s+{state}")).first


def capture_pose(page: Page, name: str) -> None:
    """Put the simulated board where it is asked for, and capture it as this pose, which must be
    good."""
    expect(button(page, "Place board")).to_be_enabled()
    click(page, "Place board")
    click(page, "Capture pose")
    expect(pose_row(page, name, "good")).to_be_visible(timeout=PATIENCE_MS)


CUT_LABELS = """() =>
    [...document.querySelectorAll("button, label, th, td, [role=tab], span, p, div")]
    .filter(e => e.offsetParent)
    .filter(e => [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()))
    .filter(e => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1)
    .filter(e => getComputedStyle(e).overflowX !== "visible")
    .map(e => e.textContent.trim())"""
BROKEN_LABELS = """() => [...document.querySelectorAll("label, button, th, [role=tab], span, div")]
    .filter(e => e.offsetParent && e.childNodes.length === 1 && e.firstChild.nodeType === 3)
    .filter(e => e.textContent.trim().split(/\\s+/).some(word => {
        const range = document.createRange(), at = e.textContent.indexOf(word);
        range.setStart(e.firstChild, at); range.setEnd(e.firstChild, at + word.length);
        return word.length < 24 && range.getClientRects().length > 1; }))
    .map(e => e.textContent.trim())"""


def cut_labels(page: Page) -> list[str]:
    """Texts on the page that do not fit: cut off, or with a line break inside a word or between
    figure and unit."""
    return [*page.evaluate(CUT_LABELS), *page.evaluate(BROKEN_LABELS)]
