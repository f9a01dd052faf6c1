"""Chromium, wherever this machine has one; where it has none, one is fetched."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import Browser, BrowserType, Error

_FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # in software it costs more than without
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
_SYSTEM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_INSTALL = [sys.executable, "-m", "playwright", "install", "chromium"]


def launched(chromium: BrowserType, *flags: str) -> Browser:
    """The first Chromium that starts: the one that is asked for, the system's, Playwright's own,
    one fetched now."""
    asked = os.environ.get("SLVIEWER_CHROMIUM")
    if asked:
        return chromium.launch(executable_path=asked, args=[*_FLAGS, *flags])
    why = _tried(chromium, flags)
    if isinstance(why, Browser):
        return why
    fetch = [_INSTALL]
    if shutil.which("apt-get") and hasattr(os, "geteuid") and os.geteuid() == 0:
        fetch += [
            ["apt-get", "update"],
            ["apt-get", "install", "-y", "--no-install-recommends", "chromium"],
        ]
    for command in fetch:
        subprocess.run(command, capture_output=True, timeout=600, check=False)
        why = _tried(chromium, flags)
        if isinstance(why, Browser):
            return why
    raise RuntimeError(
        f"No Chromium starts here ({why}). Run `{' '.join(_INSTALL)}`, or `apt-get install"
        " chromium` as root, or name one in SLVIEWER_CHROMIUM."
    )


def _tried(chromium: BrowserType, flags: tuple[str, ...]) -> Browser | str:
    """A running browser, or why none runs."""
    why = "none was found"
    for path in [*filter(None, map(shutil.which, _SYSTEM)), chromium.executable_path]:
        if Path(path).exists():
            try:
                return chromium.launch(executable_path=path, args=[*_FLAGS, *flags])
            except Error as error:
                why = f"{path}: {error.message.splitlines()[0]}"
    return why
