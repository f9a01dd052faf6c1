"""A browser, wherever this machine has one, and a small simulated wizard for it to open."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Error, Playwright, expect, sync_playwright
from wizard_page import SIZE, Opened, button

from slviewer.gui.app import App
from slviewer.workflow.wizard.operator import Operator

RIG = {"driver": "simulated", "scale": 0.25}
_FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
_SYSTEM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_INSTALL = [sys.executable, "-m", "playwright", "install", "chromium"]


expect.set_options(timeout=20_000)  # a browser that draws in software beside the wizard's own work has its pauses


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        found = _launched(playwright)
        yield found
        found.close()


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    with Operator(tmp_path / "session", RIG) as engine:
        assert engine.wait_for(lambda s: s.rig.state == "open", 20.0) is not None
        yield engine


@pytest.fixture
def app(operator: Operator) -> Iterator[App]:
    wizard = App(operator, port=0)
    yield wizard
    wizard.close()


@pytest.fixture
def opened(browser: Browser, app: App) -> Iterator[Opened]:
    """The operator's page, ready."""
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(20_000)
    found = Opened(page)
    page.goto(app.server.url)
    button(page, "1. Rig").wait_for()
    yield found
    page.close()


def _launched(playwright: Playwright) -> Browser:
    """The first Chromium that starts: the one that is asked for, the system's, Playwright's own, one fetched now."""
    asked = os.environ.get("SLVIEWER_CHROMIUM")
    if asked:
        return playwright.chromium.launch(executable_path=asked, args=_FLAGS)
    why = _tried(playwright)
    if isinstance(why, Browser):
        return why
    fetch = [_INSTALL]
    if shutil.which("apt-get") and hasattr(os, "geteuid") and os.geteuid() == 0:
        fetch += [["apt-get", "update"], ["apt-get", "install", "-y", "--no-install-recommends", "chromium"]]
    for command in fetch:
        subprocess.run(command, capture_output=True, timeout=600, check=False)
        why = _tried(playwright)
        if isinstance(why, Browser):
            return why
    raise RuntimeError(
        f"No Chromium starts here ({why}). Run `{' '.join(_INSTALL)}`, or `apt-get install chromium` as root, or name "
        "one in SLVIEWER_CHROMIUM."
    )


def _tried(playwright: Playwright) -> Browser | str:
    """A running browser, or why none runs."""
    why = "none was found"
    for path in [*filter(None, map(shutil.which, _SYSTEM)), playwright.chromium.executable_path]:
        if Path(path).exists():
            try:
                return playwright.chromium.launch(executable_path=path, args=_FLAGS)
            except Error as error:
                why = f"{path}: {error.message.splitlines()[0]}"
    return why
