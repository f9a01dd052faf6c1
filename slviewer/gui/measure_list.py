"""The measurements: drawn in 3D, listed, shown one by one, renamed, deleted, restored, written as a
table."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change
from slviewer.gui.measure_drawing import drawn, label, lifted
from slviewer.gui.measure_html import deviation_figure, measurement_html, measurements_table
from slviewer.gui.measure_section import CURSORS, SectionPlot, cursor_points
from slviewer.gui.panel import PanelContext
from slviewer.gui.pictures import PLOT_PX, Painter, Plot
from slviewer.gui.widgets import Text, link, paragraph
from slviewer.inspection.colours import colour_limit
from slviewer.inspection.section import CutPlane
from slviewer.pipeline.measure import section_lines
from slviewer.pipeline.stored_records import Stored, load_arrays, name_records
from slviewer.records.measurement import Measurement
from slviewer.report.measurements import section_plot
from slviewer.wizard.measure_requests import PLAN, TABLE
from slviewer.wizard.snapshot import SessionView

CHOSEN, OTHER, STALE = (200, 40, 40), (30, 90, 160), (140, 140, 140)
Lines = list[np.ndarray]


class MeasurementList:
    """List of measurements with a chosen one; ``changed(measured)`` is called when another one is
    chosen."""

    def __init__(
        self,
        context: PanelContext,
        painter: Painter,
        layer: str,
        changed: Callable[[Stored[Measurement] | None], None],
    ) -> None:
        self._context, self._painter, self._layer, self._changed = context, painter, layer, changed
        self._lock = threading.RLock()
        self._session: SessionView | None = None
        self._on = ""
        self._known: set[str] = set()
        self._chosen_id = ""
        self._drawn: dict[str, Any] = {}
        self._lines: dict[str, tuple[CutPlane, Lines]] = {}

    def build(self) -> None:
        """Create the inputs."""
        gui, context, operator = self._context.gui, self._context, self._context.operator
        with gui.add_folder("Result", visible=False) as self._chosen_folder:
            self._choice = Choice(gui, "Result")
            self._choice.on_change(context.callback(self.refresh))
            self._histogram = Plot(gui)
            self._section = SectionPlot(self._context, self.refresh)
            self._details = Text(gui)
            self._rename_to = gui.add_text("New name", "")
            context.button("Rename", self._request_rename, viser.Icon.PENCIL)
            delete = lambda: operator.delete_measurement(self._choice.value)  # noqa: E731
            context.button(
                "Delete result",
                delete,
                viser.Icon.TRASH,
                "red",
                hint="Moves it to the session's trash",
            )
        self._restore = context.button(
            "Restore deleted",
            operator.undo_delete,
            viser.Icon.ARROW_BACK_UP,
            "orange",
            visible=False,
        )
        with gui.add_folder("All results", visible=False) as self._table_folder:
            self._table = Text(gui)
            context.button("Write CSV", operator.export_measurements_table, viser.Icon.TABLE_EXPORT)
            context.button(
                "Make plan",
                operator.make_inspection_plan,
                viser.Icon.REPEAT,
                hint="To repeat the fits on other scans",
            )
            self._file = Text(gui)

    @property
    def chosen(self) -> Stored[Measurement] | None:
        """The chosen measurement; None where there is none."""
        return next((each for each in self._measurements if each.name == self._choice.value), None)

    def draw(self, session: SessionView | None, on: str) -> list[Stored[Measurement]]:
        """Show the session's measurements, in 3D those on the surface ``on``; returns the new
        ones."""
        with self._lock:
            before, self._session, self._on = self._session, session, on
            measured = self._measurements
            if session is None or before is None or session.folder != before.folder:
                self._known = {each.name for each in measured}
                self._clear_drawings()
            new = [each for each in measured if each.name not in self._known]
            self._known = {each.name for each in measured}
            self._offer_choice()
            if new:
                self._choice.choose(new[-1].name)
            for folder in (self._chosen_folder, self._table_folder):
                change(folder, visible=bool(measured))
            change(self._restore, visible=bool(session and session.deleted_measurements))
            files = (
                [each for each in session.exports if each.name in (TABLE, PLAN)] if session else []
            )
            links = [
                link(self._context.offer(each.path), f"Download {each.name}") for each in files
            ]
            self._file.set("".join(map(paragraph, links)))
            self.refresh()
            return new

    def _offer_choice(self) -> None:
        """Offer the measurements, the latest first, by their names; by their ids too where names
        occur twice."""
        measured = self._measurements
        names = [each.name for each in measured]
        self._choice.offer(list(zip(names, name_records(measured), strict=True))[::-1])

    def change_surface(self, on: str) -> None:
        """Draw the measurements of another surface."""
        self._on = on
        self.refresh()

    def refresh(self) -> None:
        """Update tables, plots and 3D drawings for the chosen measurement."""
        with self._lock:
            chosen, measured = self.chosen, self._measurements
            chosen_id = chosen.name if chosen else ""
            if chosen_id != self._chosen_id:
                self._chosen_id = chosen_id
                self._changed(chosen)
            labels = self._labels
            self._table.set(measurements_table(measured, labels) if measured else "")
            self._details.set(measurement_html(chosen, labels) if chosen else "")
            self._draw_deviation(chosen)
            self._draw_section(chosen)
            self._request_drawings(chosen)

    # inside

    @property
    def _measurements(self) -> tuple[Stored[Measurement], ...]:
        """The session's measurements."""
        return self._session.measurements if self._session else ()

    @property
    def _labels(self) -> dict[str, str]:
        """{name of a surface: its label}, for scans and the merge."""
        if self._session is None:
            return {}
        merge = self._session.merge
        merged = (
            {}
            if merge is None
            else {f"merge/{merge.name}": f"merge of {len(merge.record.scans)} scans"}
        )
        return {scan.name: scan.label for scan in self._session.scans} | merged

    def _clear_drawings(self) -> None:
        """Remove all drawings, as the measurements of another session have the same ids."""
        for identity in self._drawn:
            self._context.scene.remove(self._layer, identity)
        self._drawn, self._lines, self._chosen_id = {}, {}, ""
        for place in ("drawings", "histogram", "section"):
            self._painter.cancel(place)

    def _request_rename(self) -> None:
        """Request the entered name for the chosen measurement."""
        if self._choice.value:
            self._context.operator.relabel_measurement(self._choice.value, self._rename_to.value)
            change(self._rename_to, value="")

    def _draw_deviation(self, measured: Stored[Measurement] | None) -> None:
        """Show the histogram of a deviation; hide it for others."""
        if measured is None or measured.record.deviation is None:
            self._painter.cancel("histogram")
            self._histogram.hide()
            return
        tolerance = measured.record.deviation.tolerance_mm

        def make() -> Any:
            """Plot the histogram of the deviation."""
            arrays = load_arrays(self._context.session, f"{Measurement.kind}/{measured.name}")
            limit = colour_limit(arrays["signed"], tolerance)
            return deviation_figure(
                measured.label, arrays["edges"], arrays["counts"], limit, tolerance
            )

        self._painter.request(
            "histogram", (measured.name, measured.label), make, self._histogram.set
        )

    def _draw_section(self, measured: Stored[Measurement] | None) -> None:
        """Show the plot of a section with its cursors, once its lines are read; None: hide it."""
        if measured is None or measured.name not in self._lines:
            self._painter.cancel("section")
            self._section.hide()
            for cursor in CURSORS:
                self._context.scene.remove(self._layer, f"cursor {cursor}")
            return
        plane, lines = self._lines[measured.name]
        self._section.set(measured.name, lines)
        at, on, key = (
            self._section.at,
            self._on,
            (measured.name, measured.label, self._section.at, self._on),
        )

        def make() -> Any:
            """Plot the section; returns (figure, cursors (3, 2) mm)."""
            cursors = cursor_points(lines, at)
            named = dict(zip(CURSORS, cursors, strict=True))
            return section_plot(measured.label, lines, named, width=PLOT_PX), cursors

        def show(made: Any) -> None:
            """Show the plot, and mark the cursors in 3D if the section's surface is shown."""
            self._section.show(*made)
            for cursor, point in zip(CURSORS, lifted(plane, made[1]), strict=True):
                if on == measured.record.source:
                    self._context.scene.mark(self._layer, f"cursor {cursor}", point, cursor)
                else:
                    self._context.scene.remove(self._layer, f"cursor {cursor}")

        self._painter.request("section", key, make, show)

    def _request_drawings(self, chosen: Stored[Measurement] | None) -> None:
        """Request the 3D drawings of all measurements on this surface; the lines of sections are
        read from disk."""
        measured = self._measurements
        others = {each.name: each.record for each in measured}
        shown = [
            each
            for each in measured
            if self._on
            in (
                each.record.source,
                *(others[o].source for o in each.record.of if o in others),
            )
        ]
        cut = [
            each.name
            for each in (*shown, *([chosen] if chosen else ()))
            if each.record.plane is not None
        ]
        looks = {each.name: (each.label, each.stale, each is chosen) for each in shown}

        def make() -> dict[str, tuple[CutPlane, Lines]]:
            """Load the plane and the lines of each section that is not loaded yet."""
            store = self._context.session
            return {i: self._lines[i] if i in self._lines else section_lines(store, i) for i in cut}

        def show(lines: dict[str, tuple[CutPlane, Lines]]) -> None:
            """Draw what has changed, and remove what is no longer there."""
            with self._lock:
                loaded = lines.keys() - self._lines.keys()
                self._lines = lines
                for identity in self._drawn.keys() - looks.keys():
                    self._context.scene.remove(self._layer, identity)
                    del self._drawn[identity]
                for each in shown:
                    if self._drawn.get(each.name) != looks[each.name]:
                        self._drawn[each.name] = looks[each.name]
                        self._draw_one(each, others, each is chosen)
                if chosen is not None and chosen.name in loaded:
                    self.refresh()

        self._painter.request("drawings", (self._on, tuple(looks.items()), tuple(cut)), make, show)

    def _draw_one(
        self, measured: Stored[Measurement], others: dict[str, Measurement], chosen: bool
    ) -> None:
        """Draw one measurement in 3D with its label, coloured by whether it is stale, chosen or
        neither."""
        cut = self._lines[measured.name][1] if measured.record.plane is not None else ()
        lines = drawn(measured.record, others, cut)
        if lines is None:
            return
        colour = STALE if measured.stale else CHOSEN if chosen else OTHER
        self._context.scene.drawing(
            self._layer, measured.name, lines[0], colour, lines[1], label(measured)
        )
