"""Plots and maps in a panel, and the thread that makes them.

Whatever is slow (reading a cloud, a figure of matplotlib) is never done by the thread that draws
panels: they request it from a `Painter`. The figures are those of the report, drawn narrower.
"""

import threading
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import viser

from slviewer.gui.widgets import Text, coloured, paragraph
from slviewer.report.page import Figure

PLOT_PX = 440
"""CSS px: as wide as the page's panel, so that letters in a figure are as large as the panel's
own."""


class Painter:
    """Computes the pictures of one panel on a thread, by slots; a newer request for a slot replaces
    a waiting one.

    `failed(error)` is called for failures. The thread begins with the first request, and ends with
    the program.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._condition = threading.Condition()
        self._requested: dict[str, Hashable] = {}
        self._waiting: dict[str, tuple[Hashable, Callable[[], Any], Callable[[Any], None]]] = {}
        self._thread: threading.Thread | None = None

    def request(
        self, slot: str, key: Hashable, make: Callable[[], Any], show: Callable[[Any], None]
    ) -> None:
        """Call `show(make())` on the painter's thread, unless `slot` already shows or awaits the
        same `key`.

        `key` is what the picture depends on. `show` is not called if another request for the slot
        came meanwhile.
        """
        with self._condition:
            if slot in self._requested and self._requested[slot] == key:
                return
            self._requested[slot] = key
            self._waiting[slot] = (key, make, show)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._serve, name="slviewer painter", daemon=True
                )
                self._thread.start()
            self._condition.notify_all()

    def cancel(self, slot: str) -> None:
        """Drop the request for a slot; the next one is computed whatever its key."""
        with self._condition:
            self._requested.pop(slot, None)
            self._waiting.pop(slot, None)

    def _serve(self) -> None:
        """Compute and show the waiting requests, one after the other; failures are reported."""
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting)
                slot = next(iter(self._waiting))
                key, make, show = self._waiting.pop(slot)
            try:
                made = make()
                with self._condition:
                    wanted = slot in self._requested and self._requested[slot] == key
                if wanted:
                    show(made)
            except Exception as error:  # one picture that fails must not end the thread
                self._failed(error)


class Plot:
    """A figure in a panel with its caption below; hidden while there is none."""

    def __init__(self, gui: viser.GuiApi, label: str | None = None) -> None:
        blank = np.full((8, 2 * PLOT_PX, 3), 255, np.uint8)
        self._image = gui.add_image(blank, label=label, format="png", visible=False)
        self._caption = Text(gui)

    def set(self, figure: Figure | None, caption: str | None = None) -> None:
        """Show a figure, with its own caption or another one; None: hide it."""
        if figure is None:
            self.hide()
            return
        self._image.image = figure.pixels
        self._image.visible = True
        self._caption.set(
            paragraph(coloured(figure.caption if caption is None else caption, "dim"))
        )

    def hide(self) -> None:
        """Hide figure and caption."""
        if self._image.visible:
            self._image.visible = False
        self._caption.set("")
