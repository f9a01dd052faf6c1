"""A section: its profile as a plot, and three cursors to measure distances, heights and radii."""

from collections.abc import Callable
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext
from slviewer.gui.pictures import Plot
from slviewer.gui.widgets import Html, Text, table
from slviewer.inspection.section import measure_cursors, nearest_on_section, radius_through
from slviewer.report.page import Figure

CURSORS = ("A", "B", "C")
_AT = (0.15, 0.85, 0.5)
"""Initial positions of the cursors, as shares of the section's length."""
_STEPS = 400


class SectionPlot:
    """Plot of a section, a slider per cursor, and the values at the cursors; hidden without a
    section.

    ``moved()`` is called whenever a cursor was moved.
    """

    def __init__(self, context: PanelContext, moved: Callable[[], None]) -> None:
        self._id = ""
        self._lines: list[np.ndarray] = []
        self._plot = Plot(context.gui)
        self._sliders: list[Any] = []
        for name in CURSORS:
            slider = context.gui.add_slider(
                f"{name}, mm", 0.0, 1.0, 0.01, 0.0, visible=False, hint=f"Cursor {name}"
            )
            slider.on_update(context.callback(moved))
            self._sliders.append(slider)
        self._values = Text(context.gui)

    def set(self, identity: str, lines: list[np.ndarray]) -> None:
        """Place the cursors on a section's lines (k, 2) mm; they keep their positions on the same
        section."""
        if identity == self._id:
            return
        self._id, self._lines = identity, lines
        low, high, step = _round_range(np.concatenate(lines)[:, 0])
        for slider, share in zip(self._sliders, _AT, strict=True):
            slider.min, slider.max, slider.step = low, high, step
            slider.value = round(low + round(share * (high - low) / step) * step, 6)
            change(slider, visible=True)

    def hide(self) -> None:
        """Hide plot, values and sliders."""
        self._id = ""
        self._plot.hide()
        self._values.set("")
        for slider in self._sliders:
            change(slider, visible=False)

    @property
    def at(self) -> tuple[float, ...]:
        """Positions of the cursors along the section, mm."""
        return tuple(float(slider.value) for slider in self._sliders)

    def show(self, figure: Figure, cursors: np.ndarray) -> None:
        """Show the plot, with the cursors (3, 2) mm drawn in it."""
        self._plot.set(figure)
        self._values.set(cursor_html(cursors))


def _round_range(along: np.ndarray) -> tuple[float, float, float]:
    """Return (lowest, highest, step) of positions (n,) mm as round numbers."""
    low, high = float(along.min()), float(along.max())
    digits = int(np.clip(-np.floor(np.log10(max(high - low, 1e-6) / _STEPS)), 0, 5))
    step = 10.0**-digits
    return (
        round(np.ceil(low / step) * step, digits),
        round(np.floor(high / step) * step, digits),
        step,
    )


def cursor_points(lines: list[np.ndarray], at: tuple[float, ...]) -> np.ndarray:
    """Return the section's points (3, 2) mm at the cursors."""
    return np.array([nearest_on_section(lines, x) for x in at])


def cursor_html(cursors: np.ndarray) -> Html:
    """Return a table of distances and radius at the cursors (3, 2) mm."""
    a, b, c = cursors
    rows: list[tuple[object, object]] = [
        (f"{q.name.capitalize()} A – B", f"{q.value:.3f} {q.unit}".replace("-", "−"))
        for q in measure_cursors(a, b)
    ]
    try:
        rows.append(("Radius through A, C, B", f"{radius_through(a, c, b).value:.3f} mm"))
    except InputError:
        rows.append(("Radius through A, C, B", "none: straight line"))
    return table(("Cursors", ""), rows)
