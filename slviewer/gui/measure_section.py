"""A section: its profile as a plot, and three cursors to measure distances, heights and radii."""

from collections.abc import Callable
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.inputs import change
from slviewer.gui.panel import PanelContext
from slviewer.gui.pictures import PLOT_PX, Plot
from slviewer.gui.widgets import Html, Text, table
from slviewer.inspection.section import measure_cursors, nearest_on_section, radius_through
from slviewer.report.canvas import finish_figure, new_figure, style_axes
from slviewer.report.page import Figure

CURSORS = ("A", "B", "C")
_AT = (0.15, 0.85, 0.5)
"""Initial positions of the cursors, as shares of the section's length."""
_COLOURS = ("#b3261e", "#1f9673", "#7b5cc4")
_LINE = "#2270b8"
_STEPS = 400
_MOST_DRAWN = 2000
_LEAST_HIGH, _MOST_HIGH = 210, 330
_FLAT = 0.1
"""Height over length below which heights are drawn larger, to be visible at all."""


class SectionPlot:
    """The plot, a slider per cursor, and the values at the cursors; hidden without a section. ``moved()`` is called
    whenever a cursor was moved."""

    def __init__(self, context: PanelContext, moved: Callable[[], None]) -> None:
        self._id = ""
        self._lines: list[np.ndarray] = []
        self._plot = Plot(context.gui)
        self._sliders: list[Any] = []
        for name in CURSORS:
            slider = context.gui.add_slider(f"Cursor {name}, mm", 0.0, 1.0, 0.01, 0.0, visible=False)
            slider.on_update(context.callback(moved))
            self._sliders.append(slider)
        self._values = Text(context.gui)

    def set(self, identity: str, lines: list[np.ndarray]) -> None:
        """Put the cursors on a section's lines (k, 2) mm; they keep their positions on the same section."""
        if identity == self._id:
            return
        self._id, self._lines = identity, lines
        low, high, step = _range(np.concatenate(lines)[:, 0])
        for slider, share in zip(self._sliders, _AT, strict=True):
            slider.min, slider.max, slider.step = low, high, step
            slider.value = round(low + round(share * (high - low) / step) * step, 6)
            change(slider, visible=True)

    def hide(self) -> None:
        """Show nothing."""
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


def _range(along: np.ndarray) -> tuple[float, float, float]:
    """Lowest and highest of positions (n,) mm as round numbers, and a round step."""
    low, high = float(along.min()), float(along.max())
    digits = int(np.clip(-np.floor(np.log10(max(high - low, 1e-6) / _STEPS)), 0, 5))
    step = 10.0**-digits
    return round(np.ceil(low / step) * step, digits), round(np.floor(high / step) * step, digits), step


def cursor_points(lines: list[np.ndarray], at: tuple[float, ...]) -> np.ndarray:
    """(3, 2) mm: the section's points at the cursors."""
    return np.array([nearest_on_section(lines, x) for x in at])


def cursor_html(cursors: np.ndarray) -> Html:
    """The values at the cursors (3, 2) mm."""
    a, b, c = cursors
    rows: list[tuple[object, object]] = [
        (f"{q.name} A – B", f"{q.value:.3f} {q.unit}".replace("-", "−")) for q in measure_cursors(a, b)
    ]
    try:
        rows.append(("Radius through A, C, B", f"{radius_through(a, c, b).value:.3f} mm"))
    except InputError:
        rows.append(("Radius through A, C, B", "none: straight line"))
    return table(("Cursors", ""), rows)


def section_figure(name: str, lines: list[np.ndarray], cursors: np.ndarray) -> Figure:
    """The section's lines (k, 2) mm, with the cursors (3, 2) on them."""
    every = np.concatenate(lines)
    width, height = np.maximum(np.ptp(every, axis=0), 1e-6)
    drawing = new_figure(PLOT_PX, int(np.clip(1.6 * PLOT_PX * height / width + 90, _LEAST_HIGH, _MOST_HIGH)))
    axes = drawing.subplots()
    style_axes(axes, "", "along, mm", "height, mm")
    for line in lines:
        axes.plot(*line[:: max(1, len(line) // _MOST_DRAWN)].T, color=_LINE, linewidth=1.3)
    for cursor, text, colour in zip(cursors, CURSORS, _COLOURS, strict=True):
        axes.axvline(cursor[0], color=colour, linewidth=0.9, linestyle=":")
        axes.plot(*cursor, "o", color=colour, markersize=5)
        axes.annotate(text, cursor, xytext=(4, 5), textcoords="offset points", color=colour, fontsize=10, weight="bold")
    raised = height < _FLAT * width
    axes.set_aspect("auto" if raised else "equal", adjustable="datalim")
    axes.margins(y=0.15)
    scale = "heights are enlarged" if raised else "equal scales"
    return finish_figure(drawing, f"Section through both points and the camera; up: towards the camera; {scale}.", name)
