"""The measurements: drawn in 3D, listed, shown one by one, renamed, deleted, restored, written as a
table; a section with cursors to measure in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.measure_drawing import drawn, label, lifted
from slviewer.gui.panel import (
    NO_SESSION,
    Choice,
    PanelPart,
    StepPanel,
    scan_labels,
)
from slviewer.gui.widgets import (
    DECISION_TONES,
    PLOT_PX,
    Html,
    Plot,
    Text,
    alert,
    note,
    properties_table,
    records_html,
    relabel,
    report_table,
    to_html,
)
from slviewer.inspection.deviation import colour_limit
from slviewer.inspection.section import (
    CutPlane,
    measure_cursors,
    nearest_on_section,
    radius_through,
)
from slviewer.pipeline.measure import section_lines
from slviewer.pipeline.stored_records import Stored, load_arrays, name_records
from slviewer.records.measurement import Measurement, list_quantities
from slviewer.report.canvas import finish_figure, new_figure, style_axes
from slviewer.report.page import Figure
from slviewer.report.surfaces import draw_deviations, section_plot
from slviewer.wizard.result_requests import PLAN, TABLE
from slviewer.wizard.snapshot import SessionView

CHOSEN, OTHER, STALE = (200, 40, 40), (30, 90, 160), (140, 140, 140)
CURSORS = ("A", "B", "C")
_AT = (0.15, 0.85, 0.5)
"""Initial positions of the cursors, as shares of the section's length."""
_STEPS = 400
_MARKS = tuple(f"cursor {cursor}" for cursor in CURSORS)
"""Of the cursors in 3D."""
_HISTOGRAM_PX = 230
Lines = list[np.ndarray]


class MeasurementList(PanelPart):
    """List of measurements with a chosen one; ``changed(measured)`` is called when another one is
    chosen."""

    def __init__(
        self, panel: StepPanel, changed: Callable[[Stored[Measurement] | None], None]
    ) -> None:
        super().__init__(panel)
        self._changed = changed
        self._session: SessionView = NO_SESSION
        self._on = self._chosen_id = self._section_id = ""
        self._known: set[str] = set()
        self._drawn: dict[str, Any] = {}
        self._lines: dict[str, tuple[CutPlane, Lines]] = {}
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Result") as self._chosen_folder:
            self._choice = choice = Choice(context, "Result", self.refresh)
            self._histogram = Plot(gui)
            self._section = Plot(gui)
            self._cursors: list[Any] = [
                gui.add_slider(f"{name}, mm", 0.0, 1.0, 0.01, 0.0, hint=f"Cursor {name}")
                for name in CURSORS
            ]
            context.on_change(self.refresh, *self._cursors)
            self._values = Text(gui)
            self._details = Text(gui)
            self._new_name: Any = gui.add_text("New name", "")
            context.button("Rename", self._request_rename, "pencil")
            context.button(
                "Delete result",
                lambda: operator.delete_measurement(choice.value),
                "trash",
                "red",
                hint="Moves it to the session's trash",
            )
        self._restore = context.button(
            "Restore deleted", operator.undo_delete, "arrow-back-up", "orange"
        )
        with gui.add_folder("All results") as self._table_folder:
            self._table = Text(gui)
            context.button("Write CSV", operator.export_measurements_table, "table-export")
            context.button(
                "Make plan",
                operator.make_inspection_plan,
                "repeat",
                hint="To repeat the fits on other scans",
            )
            self._file = Text(gui)

    def update(self, session: SessionView, on: str) -> list[Stored[Measurement]]:
        """Show the session's measurements, in 3D those on the surface ``on``; returns the new
        ones."""
        with self._lock:
            before, self._session, self._on = self._session, session, on
            measured = session.measurements
            names = [each.name for each in measured]
            if session.folder != before.folder:
                self._known = set(names)
                # the measurements of another session have the same ids
                self._layer.remove(*self._drawn)
                self._drawn, self._lines, self._chosen_id = {}, {}, ""
                for slot in ("drawings", "histogram", "section"):
                    self._painter.cancel(slot)
            new = [each for each in measured if each.name not in self._known]
            self._known = set(names)
            # the latest first, by their names; by their ids too where names occur twice
            self._choice.offer(list(zip(names, name_records(measured), strict=True))[::-1])
            if new:
                self._choice.choose(new[-1].name)
            self._chosen_folder.visible = self._table_folder.visible = bool(measured)
            self._restore.visible = session.deleted_measurements > 0
            self._file.set(self._context.links_html(session.exports, TABLE, PLAN))
            self.refresh()
            return new

    def change_surface(self, on: str) -> None:
        """Draw the measurements of another surface."""
        self._on = on
        self.refresh()

    def refresh(self) -> None:
        """Update tables, plots and 3D drawings for the chosen measurement."""
        with self._lock:
            measured = self._session.measurements
            chosen = next((each for each in measured if each.name == self._choice.value), None)
            chosen_id = chosen.name if chosen else ""
            if chosen_id != self._chosen_id:
                self._chosen_id = chosen_id
                self._changed(chosen)
            labels = scan_labels(self._session)
            if (merge := self._session.merge) is not None:
                labels[f"merge/{merge.name}"] = f"merge of {len(merge.record.scans)} scans"
            self._table.set(measurements_table(measured, labels) if measured else "")
            self._details.set(measurement_html(chosen, labels) if chosen else "")
            self._draw_deviation(chosen)
            self._draw_section(chosen)
            self._request_drawings(measured, chosen)

    # inside

    def _request_rename(self) -> None:
        """Request the entered name for the chosen measurement."""
        if self._choice.value:
            self._operator.relabel_measurement(self._choice.value, self._new_name.value)
            self._new_name.value = ""

    def _draw_deviation(self, measured: Stored[Measurement] | None) -> None:
        """Show the histogram of a deviation; hide it for others."""
        if measured is None or measured.record.deviation is None:
            self._painter.cancel("histogram")
            self._histogram.set(None)
            return
        tolerance = measured.record.deviation.tolerance_mm

        def make() -> Figure:
            """Plot the histogram of the deviation."""
            arrays = load_arrays(self._context.session, f"{Measurement.kind}/{measured.name}")
            return deviation_figure(measured.label, arrays, tolerance)

        key = (measured.name, measured.label)
        self._painter.request("histogram", key, make, self._histogram.set)

    def _draw_section(self, measured: Stored[Measurement] | None) -> None:
        """Show the plot of a section with its cursors, once its lines are read; None: hide it."""
        loaded = self._lines.get(measured.name) if measured else None
        for slider in self._cursors:
            slider.visible = loaded is not None
        if measured is None or loaded is None:
            self._section_id = ""
            self._painter.cancel("section")
            self._section.set(None)
            self._values.set("")
            self._layer.remove(*_MARKS)
            return
        plane, lines = loaded
        if measured.name != self._section_id:  # on the same section they keep their positions
            self._section_id = measured.name
            low, high, step = _round_range(np.concatenate(lines)[:, 0])
            for slider, share in zip(self._cursors, _AT, strict=True):
                slider.min, slider.max, slider.step = low, high, step
                slider.value = round(low + round(share * (high - low) / step) * step, 6)
        at, on = tuple(float(slider.value) for slider in self._cursors), self._on

        def make() -> tuple[Figure, np.ndarray]:
            """Plot the section; returns (figure, cursors (3, 2) mm)."""
            cursors = cursor_points(lines, at)
            named = dict(zip(CURSORS, cursors, strict=True))
            return section_plot(measured.label, lines, named, width=PLOT_PX), cursors

        def show(made: tuple[Figure, np.ndarray]) -> None:
            """Show the plot with the values at the cursors, and mark these in 3D if the section's
            surface is shown."""
            figure, cursors = made
            self._section.set(figure)
            self._values.set(cursor_html(cursors))
            if on == measured.record.source:
                points = lifted(plane, cursors)
                for cursor, mark, point in zip(CURSORS, _MARKS, points, strict=True):
                    self._layer.mark(mark, point, cursor)
            else:
                self._layer.remove(*_MARKS)

        self._painter.request("section", (measured.name, measured.label, at, on), make, show)

    def _request_drawings(
        self, measured: Sequence[Stored[Measurement]], chosen: Stored[Measurement] | None
    ) -> None:
        """Request the 3D drawings of all measurements on this surface; the lines of sections are
        read from disk."""
        records = {each.name: each.record for each in measured}
        on_surface = {name for name, record in records.items() if record.source == self._on}
        shown = [each for each in measured if on_surface & {each.name, *each.record.of}]
        looks = {each.name: (each.label, each.stale, each is chosen) for each in shown}
        sections = [each.name for each in measured if each.record.plane is not None]

        def make() -> dict[str, tuple[CutPlane, Lines]]:
            """Load the plane and the lines of each section that is not loaded yet."""
            store = self._context.session
            return {name: self._lines.get(name) or section_lines(store, name) for name in sections}

        def show(lines: dict[str, tuple[CutPlane, Lines]]) -> None:
            """Draw what has changed, and remove what is no longer there."""
            with self._lock:
                loaded = lines.keys() - self._lines.keys()
                self._lines = lines
                self._layer.remove(*(self._drawn.keys() - looks.keys()))
                for each in shown:
                    if self._drawn.get(each.name) != looks[each.name]:
                        self._draw_one(each, records, each is chosen)
                self._drawn = looks
                if chosen is not None and chosen.name in loaded:
                    self.refresh()

        key = (self._on, tuple(looks.items()), tuple(sections))
        self._painter.request("drawings", key, make, show)

    def _draw_one(
        self, measured: Stored[Measurement], others: dict[str, Measurement], chosen: bool
    ) -> None:
        """Draw one measurement in 3D with its label, coloured by whether it is stale, chosen or
        neither."""
        cut = self._lines[measured.name][1] if measured.record.plane is not None else ()
        if (drawing := drawn(measured.record, others, cut)) is not None:
            segments, place = drawing
            colour = STALE if measured.stale else CHOSEN if chosen else OTHER
            text = label(measured)
            self._layer.lines(measured.name, segments, colour, label=(text, place))


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
    values = {
        f"{q.name.capitalize()} A – B": f"{q.value:.3f} {q.unit}".replace("-", "−")
        for q in measure_cursors(a, b)
    }
    try:
        radius = f"{radius_through(a, c, b).value:.3f} mm"
    except InputError:
        radius = "none: straight line"
    return properties_table("Cursors", {**values, "Radius through A, C, B": radius})


def measurements_table(measured: Sequence[Stored[Measurement]], labels: Mapping[str, str]) -> Html:
    """Return a table of all measurements, the latest first; ``labels``: {scan: the operator's
    name}."""
    named = {
        f"{each.label} ({each.name}{', stale' if each.stale else ''})": each.record
        for each in reversed(measured)
    }
    listed = relabel(list_quantities(named), labels)
    # a panel is too narrow for a column of scans
    rows = [[f"{name} on {scan}", what, scan, *rest] for name, what, scan, *rest in listed.rows]
    shown = [column for column in listed.columns if column.title != "scan"]
    return report_table(replace(listed, rows=rows).select(shown))


def measurement_html(measured: Stored[Measurement], labels: Mapping[str, str]) -> Html:
    """Return all figures of one measurement, with its source and warnings."""
    record = measured.record
    about = f"{record.what} on {labels.get(record.source, record.source)}, by {record.model}"
    about += f"; {record.where}." if record.where else "."
    html = records_html([measured], labels, named=False) + note(about)
    if record.deviation is not None and (verdict := record.deviation.verdict) is not None:
        html = (
            alert(Html(f"<b>{to_html(verdict.text())}</b>"), DECISION_TONES[verdict.decision])
            + html
        )
    if measured.stale:
        stale = "Out of date: the measured surface has changed; measure again."
        html = alert(stale, "warning") + html
    return html


def deviation_figure(
    name: str, arrays: Mapping[str, np.ndarray], tolerance: float | None
) -> Figure:
    """Plot the histogram of a stored deviation: ``edges`` (n + 1,) mm, ``counts`` (n,), and
    ``signed`` (m,) mm, by whose range it is coloured."""
    drawing = new_figure(PLOT_PX, _HISTOGRAM_PX)
    axes = drawing.subplots()
    style_axes(axes, "", "deviation, mm", "points, %")
    edges, limit = arrays["edges"], colour_limit(arrays["signed"], tolerance)
    draw_deviations(axes, edges, arrays["counts"], limit, tolerance)
    if tolerance is not None:
        far = max(float(edges[-1]), 1.15 * tolerance)
        axes.set_xlim(-far, far)
    return finish_figure(drawing, "Histogram of the deviations.", name)
