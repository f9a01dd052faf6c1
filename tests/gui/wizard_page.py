"""The wizard's page as a person finds their way in it: by what stands there to be read."""

import re
import time
from collections.abc import Callable

from playwright.sync_api import ConsoleMessage, Locator, Page, TimeoutError, expect

SIZE = {"width": 1280, "height": 800}
PATIENCE_MS = 120_000
"""For what is computed, on a machine that is busy with other things."""
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
"""Draws the scene with a sixteenth of the pixels: here they are drawn in software, and no test looks at them."""


UNKNOWN = "Tried to update non-existent component"
"""Of viser's client, which applies the updates of a batch after its removals; seen once in thousands of pages."""


class Opened:
    """A page that remembers what went wrong in it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.errors: list[str] = []
        self._unknown = 0
        page.add_init_script(SMALL_CANVAS)
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.errors.append(error.stack or str(error)))

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type == "error" and (UNKNOWN not in message.text or self._is_repeated()):
            self.errors.append(message.text)

    def _is_repeated(self) -> bool:
        """Whether such a message came before: a handle of ours that is gone would be updated again and again."""
        self._unknown += 1
        return self._unknown > 1


def button(page: Page, name: str) -> Locator:
    """The button that says so."""
    return page.get_by_role("button", name=name)


STILL = """quiet => new Promise(done => {
  const end = () => { watcher.disconnect(); done(); };
  let timer = setTimeout(end, quiet);
  const watcher = new MutationObserver(() => { clearTimeout(timer); timer = setTimeout(end, quiet); });
  watcher.observe(document.body, { childList: true, subtree: true });
  setTimeout(end, 3000);
})"""


def click(page: Page, name: str) -> None:
    """Click the button that says so once the page stands still: what is drawn anew just then may take the click."""
    expect(button(page, name)).to_be_enabled()
    page.evaluate(STILL, 250)
    button(page, name).click()


def field(page: Page, label: str) -> Locator:
    """The input beside this label: viser's labels are text, without a tie to their input."""
    return page.locator(f"xpath=//*[normalize-space(text())='{label}']/following::input[1]")


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of the dropdown beside this label; it closes where the panel is drawn anew meanwhile."""
    for _ in range(4):
        field(page, label).click()
        try:
            page.get_by_role("option", name=option, exact=True).click(timeout=PATIENCE_MS / 10)
        except TimeoutError:
            page.keyboard.press("Escape")
        else:
            return
    raise AssertionError(f"{label} does not offer {option}")


def press(page: Page, name: str, came: Callable[[], bool]) -> None:
    """Press a button until what it asks for has come: what is drawn anew just then may take the click."""
    for _ in range(4):
        button(page, name).click()
        end = time.monotonic() + PATIENCE_MS / 4000
        while time.monotonic() < end:
            if came():
                return
            page.wait_for_timeout(100)
    raise AssertionError(f"nothing came of pressing {name}")


def pose_row(page: Page, name: str, state: str) -> Locator:
    """The line of the list of poses that says what became of this one."""
    return page.locator("div", has_text=re.compile(rf"^{name}\s+{state}")).first


def capture_pose(page: Page, name: str) -> None:
    """Put the simulated board where it is asked for, and capture it as this pose, which must be good."""
    expect(button(page, "Place board")).to_be_enabled()
    click(page, "Place board")
    click(page, "Capture pose")
    expect(pose_row(page, name, "good")).to_be_visible(timeout=PATIENCE_MS)


CUT_LABELS = """() => [...document.querySelectorAll("button, label, th, td, [role=tab], span, p, div")]
    .filter(e => e.offsetParent && [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()))
    .filter(e => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).overflowX !== "visible")
    .map(e => e.textContent.trim())"""
BROKEN_LABELS = """() => [...document.querySelectorAll("label, button, th, [role=tab], span, div")]
    .filter(e => e.offsetParent && e.childNodes.length === 1 && e.firstChild.nodeType === 3)
    .filter(e => e.textContent.trim().split(/\\s+/).some(word => {
        const range = document.createRange(), at = e.textContent.indexOf(word);
        range.setStart(e.firstChild, at); range.setEnd(e.firstChild, at + word.length);
        return word.length < 24 && range.getClientRects().length > 1; }))
    .map(e => e.textContent.trim())"""


def cut_labels(page: Page) -> list[str]:
    """Texts on the page that do not fit: cut off, or with a line break inside a word or between figure and unit."""
    return [*page.evaluate(CUT_LABELS), *page.evaluate(BROKEN_LABELS)]
