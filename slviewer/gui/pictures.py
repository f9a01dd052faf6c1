"""Plots and maps in a panel, and the thread that draws them.

What takes longer than a glance (a cloud from the disk, a figure of matplotlib's) is never made by the thread that draws
panels: a panel asks its `Painter` for it, and goes on. The figures are the report's own, drawn narrow.
"""

import threading
from collections.abc import Callable, Hashable
from typing import Any

import cv2
import numpy as np
import viser

from slviewer.errors import InputError
from slviewer.gui.widgets import Words, block, toned
from slviewer.report.page import Figure
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

PLOT_PX = 440
"""CSS px: as wide as the page's panel, so that letters in a figure are as large as the panel's own."""


class Painter:
    """One panel's wishes, each for a place; a newer wish for a place replaces what still waits for it.

    `failed(error)` is told what went wrong. The thread begins with the first wish, and ends with the program.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._condition = threading.Condition()
        self._asked: dict[str, Hashable] = {}
        self._waiting: dict[str, tuple[Hashable, Callable[[], Any], Callable[[Any], None]]] = {}
        self._thread: threading.Thread | None = None

    def ask(self, place: str, key: Hashable, make: Callable[[], Any], show: Callable[[Any], None]) -> None:
        """Call `show(make())` soon, on the painter's thread, unless this `key` is what `place` shows or waits for.

        `key` is what the picture depends on. `show` is not called where another wish for the place came meanwhile.
        """
        with self._condition:
            if place in self._asked and self._asked[place] == key:
                return
            self._asked[place] = key
            self._waiting[place] = (key, make, show)
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="slviewer painter", daemon=True)
                self._thread.start()
            self._condition.notify_all()

    def forget(self, place: str) -> None:
        """Want nothing for a place; the next wish for it is drawn whatever its key."""
        with self._condition:
            self._asked.pop(place, None)
            self._waiting.pop(place, None)

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting)
                place = next(iter(self._waiting))
                key, make, show = self._waiting.pop(place)
            try:
                made = make()
                with self._condition:
                    wanted = place in self._asked and self._asked[place] == key
                if wanted:
                    show(made)
            except Exception as error:  # a picture that cannot be drawn must not end those after it
                self._failed(error)


class Plot:
    """A figure in a panel with its caption below; hidden until there is one."""

    def __init__(self, gui: viser.GuiApi, label: str | None = None) -> None:
        blank = np.full((8, 2 * PLOT_PX, 3), 255, np.uint8)
        self._image = gui.add_image(blank, label=label, format="png", visible=False)
        self._caption = Words(gui)

    def set(self, figure: Figure | None, caption: str | None = None) -> None:
        """Show a figure, with its own caption or another; None: nothing."""
        if figure is None:
            self.hide()
            return
        drawn = cv2.imdecode(np.frombuffer(figure.png, np.uint8), cv2.IMREAD_COLOR)
        assert drawn is not None
        self._image.image = np.ascontiguousarray(drawn[..., ::-1])
        self._image.visible = True
        self._caption.set(block(toned(figure.caption if caption is None else caption, "dim")))

    def hide(self) -> None:
        """Show nothing."""
        if self._image.visible:
            self._image.visible = False
        self._caption.set("")


def opened(operator: Operator) -> Session:
    """The session that pictures are made from; InputError where it was closed meanwhile."""
    if operator.session is None:
        raise InputError("no session is open: open one first")
    return operator.session


def spread(values: np.ndarray, low: float = 1.0, high: float = 99.0) -> tuple[float, float]:
    """Where a colour scale for `values` begins and ends: percentiles of the finite ones; (0, 1) where there is none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    ends = np.percentile(finite[:: max(1, finite.size // 300_000)], [low, high])
    return float(ends[0]), float(ends[1])
