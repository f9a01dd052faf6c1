"""Inputs whose options come and go with the session, and handles that are touched only where something changed."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import viser

NOTHING = "–"
TYPING_S = 1.0
"""Without a keystroke, and an input is taken for entered."""


def change(handle: Any, **values: Any) -> None:
    """Set what differs, so that nothing is sent for nothing."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


class Follows:
    """Sets a handle's value when the session's changes, and only then: what somebody has just entered and is still on
    its way must not be overwritten by a snapshot that is a moment older.

    While somebody types, the first digits are a value too, and the session's answer to them waits until the typing has
    stopped.
    """

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self._told: Any = None
        self._entered = -math.inf
        self._waiting: threading.Timer | None = None
        handle.on_update(self._note)

    def tell(self, value: Any) -> None:
        """The session says so now."""
        if value != self._told:
            self._told = value
            if self._waiting is None:
                self._settle()

    async def _note(self, event: Any) -> None:
        if event.client_id is not None:
            self._entered = time.monotonic()

    def _settle(self) -> None:
        self._waiting = None
        left = self._entered + TYPING_S - time.monotonic()
        if left <= 0:
            change(self._handle, value=self._told)
        else:
            self._waiting = threading.Timer(left, self._settle)
            self._waiting.daemon = True
            self._waiting.start()


def titled(name: str, label: str) -> str:
    """How a capture is called in a list: by its label, and by its name too where these differ."""
    return name if label == name else f"{label} ({name})"


class Choice:
    """A dropdown of things that have a name and a text; `value` is the chosen one's name, empty where there is none."""

    def __init__(self, gui: viser.GuiApi, label: str, hint: str | None = None) -> None:
        self._handle: Any = gui.add_dropdown(label, (NOTHING,), hint=hint)
        self._names: dict[str, str] = {}

    def offer(self, things: Sequence[tuple[str, str]], preferred: str = "") -> None:
        """Offer (name, text) pairs; what is chosen stays chosen while it is offered, else it becomes `preferred`, or
        the first.
        """
        texts = tuple(text for _, text in things) or (NOTHING,)
        chosen = self.value
        names = {text: name for name, text in things}
        self._names = names
        if tuple(self._handle.options) != texts:
            kept = next((text for text, name in names.items() if name == chosen), "")
            wanted = next((text for text, name in names.items() if name == preferred), "")
            self._handle.options = texts
            self._handle.value = kept or wanted or texts[0]

    @property
    def value(self) -> str:
        """The name of what is chosen."""
        return self._names.get(self._handle.value, "")

    def choose(self, name: str) -> None:
        """Choose what is offered under `name`; nothing changes where it is not."""
        text = next((text for text, each in self._names.items() if each == name), None)
        if text is not None:
            self._handle.value = text

    def show(self, visible: bool) -> None:
        """Show or hide it."""
        change(self._handle, visible=visible)

    def on_change(self, do: Callable[[Any], None]) -> None:
        """Call `do(event)` whenever another thing is chosen, by whomever."""
        self._handle.on_update(do)
