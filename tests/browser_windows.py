"""A window of Chromium, Firefox or WebKit, each behind the same few methods, and the hand of an
operator in it.

Firefox (`firefox-esr`) is driven by WebDriver BiDi, WebKit (`webkit2gtk-driver`) by WebDriver, both
in a virtual display (`xvfb`), so that they draw in 3D."""

import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from clocks import until
from playwright.sync_api import Browser, Download
from websockets.sync.client import connect
from wizard_page import PATIENCE_S, SIZE, STILL, Opened, new_page

START_S = 120.0
"""Within which a browser starts on a busy machine."""
_MINI_BROWSER = sorted(Path("/usr/lib").glob("*/webkit2gtk-4.1/MiniBrowser"))
_OFF = ("app.update.enabled", "browser.safebrowsing.malware.enabled", "extensions.update.enabled")
_FIREFOX: dict[str, object] = {
    **dict.fromkeys(_OFF, False),
    "browser.download.folderList": 2,  # the folder below
    "browser.shell.checkDefaultBrowser": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "webgl.force-enabled": True,  # in software
}
COLLECT_ERRORS = """() => {
  window.collectedErrors = [];
  const report = error => window.collectedErrors.push(String(error?.stack ?? error));
  addEventListener("error", event => report(event.error ?? event.message));
  addEventListener("unhandledrejection", event => report(event.reason));
}"""

PAGE = "/operate-"
"""How the path of the operator's page begins."""
Place = tuple[float, float]


class Window(ABC):
    """A window of a browser with one page."""

    has_webgl = True

    def __init__(self, downloads: Path) -> None:
        self.downloads = downloads

    @abstractmethod
    def open(self, address: str) -> None:
        """Open a link of the wizard, which leads to its page."""

    @abstractmethod
    def evaluate(self, function: str, *arguments: object) -> Any:
        """Call a JavaScript function in the page, and return what it returns or promises."""

    @abstractmethod
    def drag(self, places: Sequence[Place]) -> None:
        """Press the mouse at the first place (x, y) in px, move it over the others, and release
        it."""

    @abstractmethod
    def take_picture(self) -> bytes:
        """Return what the page looks like, as a PNG file."""

    @abstractmethod
    def list_errors(self) -> list[str]:
        """Return what went wrong in the page."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    def pause(self, seconds: float = 0.1) -> None:
        """Let the browser work."""
        time.sleep(seconds)


class ChromiumWindow(Window):
    """A window that Playwright drives."""

    def __init__(self, browser: Browser, downloads: Path) -> None:
        super().__init__(downloads)
        self._page = new_page(browser)
        self._opened = Opened(self._page)
        self._page.on("download", self._save)

    def _save(self, download: Download) -> None:
        download.save_as(self.downloads / download.suggested_filename)

    def open(self, address: str) -> None:
        self._page.goto(address)
        self._page.wait_for_url(re.compile(PAGE))

    def evaluate(self, function: str, *arguments: object) -> Any:
        return self._page.evaluate(f"all => ({function})(...all)", list(arguments))

    def drag(self, places: Sequence[Place]) -> None:
        mouse = self._page.mouse
        mouse.move(*places[0])
        mouse.down()
        for place in places[1:]:
            mouse.move(*place)
        mouse.up()

    def take_picture(self) -> bytes:
        return self._page.screenshot()

    def list_errors(self) -> list[str]:
        return self._opened.errors

    def pause(self, seconds: float = 0.1) -> None:
        self._page.wait_for_timeout(1000 * seconds)

    def close(self) -> None:
        self._page.context.close()


def _point(places: Sequence[Place]) -> list[dict[str, object]]:
    """Return the actions of a mouse that is dragged, as the WebDriver protocols take them."""
    moves = [
        {"type": "pointerMove", "x": round(x), "y": round(y), "duration": 0} for x, y in places
    ]
    down, up = ({"type": kind, "button": 0} for kind in ("pointerDown", "pointerUp"))
    parameters = {"pointerType": "mouse"}
    actions = [moves[0], down, *moves[1:], up]
    return [{"type": "pointer", "id": "mouse", "parameters": parameters, "actions": actions}]


class FirefoxWindow(Window):
    """A window that WebDriver BiDi drives."""

    def __init__(self, address: str, downloads: Path) -> None:
        super().__init__(downloads)
        self._socket = connect(f"{address}/session", max_size=None)
        self._number = 0
        self._errors: list[str] = []
        self._call("session.new", capabilities={})
        self._call("session.subscribe", events=["log.entryAdded"])
        self._context = self._tree()["context"]
        self._call("browsingContext.setViewport", context=self._context, viewport=SIZE)

    def _call(self, method: str, **parameters: object) -> Any:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(PATIENCE_S))
            if answer.get("method") == "log.entryAdded" and answer["params"]["level"] == "error":
                self._errors.append(answer["params"]["text"])
            if answer.get("id") == self._number:
                assert answer["type"] == "success", f"{method}: {answer}"
                return answer["result"]

    def _tree(self) -> Any:
        """Return what is open."""
        return self._call("browsingContext.getTree")["contexts"][0]

    def open(self, address: str) -> None:
        self._call("browsingContext.navigate", context=self._context, url=address, wait="complete")
        assert until(lambda: PAGE in self._tree()["url"])

    def evaluate(self, function: str, *arguments: object) -> Any:
        result = self._call(
            "script.callFunction",
            functionDeclaration=f"async all => JSON.stringify(await ({function})"
            "(...JSON.parse(all)) ?? null)",
            arguments=[{"type": "string", "value": json.dumps(arguments)}],
            awaitPromise=True,
            target={"context": self._context},
        )
        assert result["type"] == "success", result
        return json.loads(result["result"]["value"])

    def drag(self, places: Sequence[Place]) -> None:
        self._call("input.performActions", context=self._context, actions=_point(places))

    def take_picture(self) -> bytes:
        taken = self._call("browsingContext.captureScreenshot", context=self._context)
        return base64.b64decode(taken["data"])

    def list_errors(self) -> list[str]:
        self._call("session.status")  # what was sent before its answer has arrived
        return self._errors

    def close(self) -> None:
        self._call("browser.close")
        self._socket.close()


class WebKitWindow(Window):
    """A window that WebDriver drives."""

    def __init__(self, address: str, downloads: Path) -> None:
        super().__init__(downloads)
        self._address = address
        options = {"binary": str(_MINI_BROWSER[0]), "args": ["--automation"]}
        capabilities = {"alwaysMatch": {"webkitgtk:browserOptions": options}}
        opened = self._call("POST", "/session", {"capabilities": capabilities})
        self._address += f"/session/{opened['sessionId']}"
        self._call("POST", "/window/rect", SIZE)
        self._call("POST", "/timeouts", {"script": 1000 * PATIENCE_S})

    def _call(self, method: str, path: str, body: object = None) -> Any:
        request = urllib.request.Request(
            self._address + path,
            json.dumps(body or {}).encode() if method == "POST" else None,
            {"Content-Type": "application/json"},
            method=method,
        )
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
                return json.loads(answer.read())["value"]
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{path}: {error.read()[:1000]!r}") from error

    def open(self, address: str) -> None:
        self._call("POST", "/url", {"url": address})
        assert until(lambda: PAGE in self._call("GET", "/url"))
        self.evaluate(COLLECT_ERRORS)  # WebDriver reports none

    def evaluate(self, function: str, *arguments: object) -> Any:
        script = f"return ({function})(...arguments)"
        return self._call("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def drag(self, places: Sequence[Place]) -> None:
        self._call("POST", "/actions", {"actions": _point(places)})

    def take_picture(self) -> bytes:
        return base64.b64decode(self._call("GET", "/screenshot"))

    def list_errors(self) -> list[str]:
        return list(self.evaluate("() => window.collectedErrors"))

    def close(self) -> None:
        self._call("DELETE", "")


@contextmanager
def _running(command: Sequence[str | Path], log: Path, **variables: str) -> Iterator[None]:
    """Run a program with environment variables until the end, and then whatever it started; it ends
    with this one too where that is killed."""
    with log.open("wb") as out:
        process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", *command],
            env={**os.environ, **variables},
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _read(log: Path, pattern: str) -> str:
    """Wait until a program has written a line, and return a part of it."""
    end = time.monotonic() + START_S
    while not (match := re.search(pattern, log.read_text(errors="replace"), re.MULTILINE)):
        assert time.monotonic() < end, log.read_text(errors="replace")
        time.sleep(0.05)
    return match[1]


@contextmanager
def _display(folder: Path) -> Iterator[str]:
    """A virtual display."""
    size = f"{SIZE['width'] + 100}x{SIZE['height'] + 200}x24"
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", size, "-nolisten", "tcp"]
    with _running(command, folder / "display.log"):
        yield ":" + _read(folder / "display.log", r"^(\d+)\n")


def _free_port() -> int:
    """Return a port that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _listens(port: int) -> bool:
    """Return whether a program listens at a port."""
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def _skip_without(*programs: str) -> None:
    """Skip the test where a program is not installed."""
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")


@contextmanager
def firefox_window(folder: Path) -> Iterator[Window]:
    """A window of Firefox with a profile of its own in a folder."""
    _skip_without("firefox-esr", "Xvfb")
    profile, downloads = folder / "profile", folder / "downloads"
    log = folder / "firefox.log"
    profile.mkdir()
    settings = {**_FIREFOX, "browser.download.dir": str(downloads)}
    lines = [f"user_pref({json.dumps(k)}, {json.dumps(v)});" for k, v in settings.items()]
    (profile / "user.js").write_text("\n".join(lines))
    command: list[str | Path] = [
        "firefox-esr",
        "--no-remote",
        "--profile",
        profile,
        "--remote-debugging-port",
        "0",
    ]
    with (
        _display(folder) as display,
        _running(command, log, DISPLAY=display, HOME=str(folder)),
    ):
        address = _read(log, r"WebDriver BiDi listening on (ws://\S+)")
        with closing(FirefoxWindow(address, downloads)) as window:
            yield window


@contextmanager
def webkit_window(folder: Path) -> Iterator[Window]:
    """A window of WebKit, where the system's language is C."""
    _skip_without("WebKitWebDriver", "Xvfb")
    if not _MINI_BROWSER:
        pytest.skip("MiniBrowser of WebKitGTK is not installed")
    downloads, log = folder / "downloads", folder / "webkit.log"
    (folder / "user-dirs.dirs").write_text(f'XDG_DOWNLOAD_DIR="{downloads}"\n')
    port = _free_port()
    variables = {"HOME": str(folder), "XDG_CONFIG_HOME": str(folder), "LC_ALL": "C.UTF-8"}
    with (
        _display(folder) as display,
        _running(["WebKitWebDriver", f"--port={port}"], log, DISPLAY=display, **variables),
    ):
        assert until(lambda: _listens(port), START_S)
        with closing(WebKitWindow(f"http://127.0.0.1:{port}", downloads)) as window:
            yield window


FIND = """(role, name) => {
  const kinds = { button: "button, [role=button]", link: "a", option: "[role=option]",
    checkbox: "[type=checkbox]", field: "input", tab: "[role=tab]" };
  const label = e => (e.ariaLabel || e.textContent).trim();
  const [found] = [...document.querySelectorAll(kinds[role])]
    .filter(e => e.checkVisibility({ visibilityProperty: true }) && e.getClientRects().length)
    .filter(e => new RegExp(`^${name}`).test(label(e)))
    .sort((a, b) => label(a).length - label(b).length);
  if (!found) return `no ${role} "${name}" on the page`;
  if (found.disabled || found.dataset.disabled) return `${name} is disabled`;
  found.scrollIntoView({ block: "nearest" });
  const { x, y, width, height } = found.getBoundingClientRect();
  const place = [x + width / 2, y + height / 2], top = document.elementFromPoint(...place);
  return found.contains(top) ? place : `${name} lies below ${top?.outerHTML.slice(0, 200)}`;
}"""
"""Returns where the control of a role is whose name begins so (a pattern), or why it cannot be
clicked."""
BOX = "selector => document.querySelector(selector)?.getBoundingClientRect().toJSON()"
DROP = """(name, content) => {
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([content], name));
  for (const kind of ["dragenter", "dragover", "drop"])
    document.querySelector("canvas").dispatchEvent(
      new DragEvent(kind, { dataTransfer, bubbles: true, cancelable: true }));
}"""


class Hand:
    """An operator's hand on the page; every click, drag and key counts as one of `choices`."""

    def __init__(self, window: Window) -> None:
        self.window = window
        self.choices: list[str] = []

    def wait_for(self, get: Callable[[], Any], is_right: Callable[[Any], object] = bool) -> Any:
        """Wait until what is looked up is right, and return it."""
        end = time.monotonic() + PATIENCE_S
        while not is_right(value := get()):
            assert time.monotonic() < end, value
            self.window.pause()
        return value

    def read(self, pattern: str) -> None:
        """Wait until the page shows a text."""
        self.wait_for(
            lambda: self.window.evaluate("() => document.body.innerText"),
            lambda text: re.search(pattern, text, re.MULTILINE),
        )

    def act(self, what: str, do: Callable[[], object]) -> None:
        """Do something once the page stands still: what is drawn anew just then may take the
        click."""
        self.window.evaluate(STILL, 250)
        self.choices.append(what)
        do()

    def click(self, name: str, role: str = "button") -> None:
        """Click a control once it can be clicked."""
        find = lambda: self.window.evaluate(FIND, role, name)  # noqa: E731
        is_place = lambda found: isinstance(found, list)  # noqa: E731
        self.wait_for(find, is_place)
        self.act(name, lambda: self.window.drag([self.wait_for(find, is_place)]))

    def unfold(self, folder: str) -> None:
        """Open a folder of the panel; what is drawn anew just then may take the click."""
        is_open = "name => [...document.querySelectorAll('[aria-expanded=true]')].some(e =>" + (
            " e.textContent === name)"
        )
        self.choices.append(folder)
        while not self.window.evaluate(is_open, folder):
            self.click(folder)
            self.choices.pop()
            self.window.pause(2.0)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a dropdown: two clicks."""
        self.click(label, "field")
        self.click(option, "option")
        value = "label => document.querySelector(`input[aria-label='${label}']`)?.value"
        self.wait_for(lambda: self.window.evaluate(value, label), lambda found: found == option)

    def see(self, selector: str) -> None:
        """Wait until an element is drawn with something in it: a browser may clip what has a place
        on the page."""

        def contrast() -> float:
            box = self.window.evaluate(BOX, selector)
            if box is None:
                return 0.0
            left, top = np.ceil([box["left"], box["top"]]).astype(int) + 1
            right, bottom = np.floor([box["right"], box["bottom"]]).astype(int) - 1
            data = np.frombuffer(self.window.take_picture(), np.uint8)
            page = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            assert page is not None
            return float(np.ptp(page[top:bottom, left:right]))

        self.wait_for(contrast, lambda found: found > 100)

    def wait_for_download(self, pattern: str) -> Path:
        """Wait until a file of this name has been downloaded whole, and return its path."""
        folder = self.window.downloads

        def find() -> dict[Path, int]:
            return {path: path.stat().st_size for path in folder.iterdir()}

        def is_whole(before: dict[Path, int]) -> bool:
            self.window.pause(1.0)  # a browser may write it under another name, or in parts
            return before == find() and any(path.match(pattern) and before[path] for path in before)

        return next(path for path in self.wait_for(find, is_whole) if path.match(pattern))

    def drop(self, path: Path) -> None:
        """Drop a file of text on the 3D view."""
        self.act(path.name, lambda: self.window.evaluate(DROP, path.name, path.read_text()))
