"""Inputs whose options come and go with the session, and handles that are updated only where something changed."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import viser

from slviewer.gui.panel import PanelContext

NOTHING = "–"
TYPING_S = 1.0
"""An input counts as entered after so long without a keystroke."""


def change(handle: Any, **values: Any) -> None:
    """Set the attributes that differ, so that nothing is sent needlessly."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


class SessionValue:
    """Sets a handle's value when the session's changes, and only then: a snapshot that is a moment older must not
    overwrite what was just entered.

    While somebody types, the first digits are a value too; the session's answer to them waits until typing has stopped.
    """

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self._latest: Any = None
        self._entered = -math.inf
        self._timer: threading.Timer | None = None
        handle.on_update(self._note_entry)

    def update(self, value: Any) -> None:
        """The session's value now."""
        if value != self._latest:
            self._latest = value
            if self._timer is None:
                self._set()

    async def _note_entry(self, event: Any) -> None:
        if event.client_id is not None:
            self._entered = time.monotonic()

    def _set(self) -> None:
        self._timer = None
        remaining = self._entered + TYPING_S - time.monotonic()
        if remaining <= 0:
            change(self._handle, value=self._latest)
        else:
            self._timer = threading.Timer(remaining, self._set)
            self._timer.daemon = True
            self._timer.start()


def display_name(name: str, label: str) -> str:
    """The text for a capture in a list: its label, followed by its name if they differ."""
    return name if label == name else f"{label} ({name})"


class Choice:
    """A dropdown of things that have a name and a text; `value` is the chosen name, empty where there is none."""

    def __init__(self, gui: viser.GuiApi, label: str, hint: str | None = None) -> None:
        self._handle: Any = gui.add_dropdown(label, (NOTHING,), hint=hint)
        self._names: dict[str, str] = {}

    def offer(self, things: Sequence[tuple[str, str]], preferred: str = "") -> None:
        """Offer (name, text) pairs; the choice stays while it is offered, else it becomes `preferred`, or the first."""
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
        """The chosen name."""
        return self._names.get(self._handle.value, "")

    def choose(self, name: str) -> None:
        """Choose a name, if it is offered."""
        text = next((text for text, each in self._names.items() if each == name), None)
        if text is not None:
            self._handle.value = text

    def set_visible(self, visible: bool) -> None:
        """Show or hide it."""
        change(self._handle, visible=visible)

    def on_change(self, do: Callable[[Any], None]) -> None:
        """Call `do(event)` whenever the choice changes, by whomever."""
        self._handle.on_update(do)


class RestoreButton:
    """Offers to restore the capture that was deleted last."""

    def __init__(self, context: PanelContext) -> None:
        self._name = ""
        self._button = context.button(
            "Restore", lambda: context.operator.undelete(self._name), viser.Icon.ARROW_BACK_UP, "orange", visible=False
        )

    def offer(self, deleted: Sequence[str]) -> None:
        """Offer the first of these names, the last deleted."""
        self._name = deleted[0] if deleted else ""
        if self._name:
            change(self._button, label=f"Restore {self._name}")
        change(self._button, visible=bool(self._name))
