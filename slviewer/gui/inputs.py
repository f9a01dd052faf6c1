"""Inputs whose options come and go with the session, and handles that are updated only where
something changed."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import viser

from slviewer.gui.panel import PanelContext
from slviewer.wizard.snapshot import ScanView

NOTHING = "–"
TYPING_S = 1.0
"""An input counts as entered after so long without a keystroke."""


def change(handle: Any, **values: Any) -> None:
    """Set the attributes of a handle that differ, so that nothing is sent needlessly."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


class SessionValue:
    """Sets a handle's value only when the session's value changes.

    A snapshot that is a moment older must not overwrite what was just entered. While somebody
    types, the first digits are a value too; the session's answer to them waits until typing has
    stopped.
    """

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self._latest: Any = None
        self._entered = -math.inf
        self._timer: threading.Timer | None = None
        handle.on_update(self._note_entry)

    def update(self, value: Any) -> None:
        """Set the session's value; the handle follows if it has changed."""
        if value != self._latest:
            self._latest = value
            if self._timer is None:
                self._apply_latest()

    async def _note_entry(self, event: Any) -> None:
        """Store the time of an entry in a browser."""
        if event.client_id is not None:
            self._entered = time.monotonic()

    def _apply_latest(self) -> None:
        """Set the handle to the latest value, or retry once the user has stopped typing."""
        self._timer = None
        remaining = self._entered + TYPING_S - time.monotonic()
        if remaining <= 0:
            change(self._handle, value=self._latest)
        else:
            self._timer = threading.Timer(remaining, self._apply_latest)
            self._timer.daemon = True
            self._timer.start()


def display_name(name: str, label: str) -> str:
    """Return the text for a capture in a list: its label, followed by its name if they differ."""
    return name if label == name else f"{label} ({name})"


def scan_options(scans: Iterable[ScanView]) -> list[tuple[str, str]]:
    """Return (name, text) of each scan, for a `Choice`."""
    return [(scan.name, display_name(scan.name, scan.label)) for scan in scans]


class Choice:
    """A dropdown of (name, text) options; `value` is the chosen name, empty where there is none."""

    def __init__(self, gui: viser.GuiApi, label: str, hint: str | None = None) -> None:
        self._handle: Any = gui.add_dropdown(label, (NOTHING,), hint=hint)
        self._names: dict[str, str] = {}

    def offer(self, things: Sequence[tuple[str, str]], preferred: str = "") -> None:
        """Set the (name, text) options; the choice stays if possible, else it becomes `preferred`
        or the first one."""
        texts = tuple(text for _, text in things) or (NOTHING,)
        chosen = self.value
        self._names = {text: name for name, text in things}
        if tuple(self._handle.options) != texts:
            same = next((text for text, name in self._names.items() if name == chosen), "")
            wanted = next((text for text, name in self._names.items() if name == preferred), "")
            self._handle.options = texts
            self._handle.value = same or wanted or texts[0]

    @property
    def value(self) -> str:
        """The chosen name; empty where there is none."""
        return self._names.get(self._handle.value, "")

    def choose(self, name: str) -> None:
        """Choose an option by its name, if it is offered."""
        text = next((text for text, each in self._names.items() if each == name), None)
        if text is not None:
            self._handle.value = text

    def set_visible(self, visible: bool) -> None:
        """Show or hide the dropdown."""
        change(self._handle, visible=visible)

    def on_change(self, do: Callable[[Any], None]) -> None:
        """Call `do(event)` whenever the choice changes, by the user or by the program."""
        self._handle.on_update(do)


class RestoreButton:
    """A button that restores the capture that was deleted last."""

    def __init__(self, context: PanelContext) -> None:
        self._name = ""
        self._button = context.button(
            "Restore",
            lambda: context.operator.undelete(self._name),
            viser.Icon.ARROW_BACK_UP,
            "orange",
            visible=False,
        )

    def offer(self, deleted: Sequence[str]) -> None:
        """Offer the first of these names, the last deleted; the button is hidden without one."""
        self._name = deleted[0] if deleted else ""
        if self._name:
            change(self._button, label=f"Restore {self._name}")
        change(self._button, visible=bool(self._name))
