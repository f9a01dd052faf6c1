"""What was measured: drawn in 3D, listed, looked at one by one, renamed, deleted, brought back, written as a table."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change
from slviewer.gui.measure_drawing import drawn, label, lifted
from slviewer.gui.measure_section import CURSORS, SectionBox, placed, section_figure
from slviewer.gui.measure_words import deviation_figure, measurement_words, measurements_table, verdict_words
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, Plot, opened
from slviewer.gui.widgets import Words, block, link
from slviewer.inspection.colours import colour_limit
from slviewer.inspection.section import CutPlane
from slviewer.pipeline.measurements import section_lines
from slviewer.session.measurements import Measurement, measurement_arrays
from slviewer.wizard.measure_requests import TABLE
from slviewer.wizard.snapshot import SessionView

CHOSEN, OTHER, STALE = (200, 40, 40), (30, 90, 160), (140, 140, 140)
Lines = list[np.ndarray]


class Results:
    """The list and the chosen measurement; ``chose(measured)`` is called when another one is chosen."""

    def __init__(self, stage: Stage, painter: Painter, layer: str, chose: Callable[[Measurement | None], None]) -> None:
        self._stage, self._painter, self._layer, self._chose = stage, painter, layer, chose
        self._lock = threading.RLock()
        self._session: SessionView | None = None
        self._on = ""
        self._known: set[str] = set()
        self._told = ""
        self._drawn: dict[str, Any] = {}
        self._lines: dict[str, tuple[CutPlane, Lines]] = {}

    def build(self) -> None:
        """The inputs."""
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Result", visible=False) as self._chosen_folder:
            self._choice = Choice(gui, "Measurement")
            self._choice.on_change(safely(self.refresh))
            self._verdict = Words(gui)
            self._histogram = Plot(gui)
            self._section = SectionBox(self._stage, self.refresh)
            self._words = Words(gui)
            self._rename_to = gui.add_text("New name", "")
            rename = gui.add_button("Rename", icon=viser.Icon.PENCIL, color="gray")
            rename.on_click(safely(self._rename))
            delete = gui.add_button(
                "Delete measurement", icon=viser.Icon.TRASH, color="red", hint="It goes to the session's trash"
            )
            delete.on_click(safely(lambda: operator.delete_measurement(self._choice.value)))
        self._restore = gui.add_button(
            "Bring deleted back", icon=viser.Icon.ARROW_BACK_UP, color="orange", visible=False
        )
        self._restore.on_click(safely(lambda: operator.restore_measurement()))
        with gui.add_folder("All results", visible=False) as self._table_folder:
            self._table = Words(gui)
            write = gui.add_button("Write table as CSV", icon=viser.Icon.TABLE_EXPORT, color="gray")
            write.on_click(safely(lambda: operator.write_measurements()))
            self._file = Words(gui)

    @property
    def chosen(self) -> Measurement | None:
        """The measurement that is looked at."""
        return next((each for each in self._measured if each.id == self._choice.value), None)

    def draw(self, session: SessionView | None, on: str) -> list[Measurement]:
        """Show the session's measurements, in 3D those on the surface ``on``; returns those that have just come."""
        with self._lock:
            return self._draw(session, on)

    def _draw(self, session: SessionView | None, on: str) -> list[Measurement]:
        if session is None or self._session is None or session.folder != self._session.folder:
            self._known = {each.id for each in session.measurements} if session else set()
            self._forget()
        self._session, self._on = session, on
        measured = self._measured
        names = [each.name for each in measured]
        self._choice.offer(
            [
                (each.id, each.name if names.count(each.name) == 1 else f"{each.name} ({each.id})")
                for each in reversed(measured)
            ]
        )
        new = [each for each in measured if each.id not in self._known]
        self._known = {each.id for each in measured}
        if new:
            self._choice.choose(new[-1].id)
        for folder in (self._chosen_folder, self._table_folder):
            change(folder, visible=bool(measured))
        change(self._restore, visible=bool(session and session.deleted_measurements))
        made = next((each for each in session.exports if each.name == TABLE), None) if session else None
        self._file.set("" if made is None else block(link(self._stage.offer(made.path), f"Download {TABLE}")))
        self.refresh()
        return new

    def move_to(self, on: str) -> None:
        """Another surface is drawn: show what was measured on it."""
        self._on = on
        self.refresh()

    def refresh(self) -> None:
        """Show the chosen one."""
        with self._lock:
            self._refresh()

    def _refresh(self) -> None:
        chosen, measured = self.chosen, self._measured
        if (chosen.id if chosen else "") != self._told:
            self._told = chosen.id if chosen else ""
            self._chose(chosen)
        labels = self._labels
        self._table.set(measurements_table(measured, chosen.id if chosen else "", labels) if measured else "")
        self._words.set(measurement_words(chosen, labels) if chosen else "")
        self._draw_deviation(chosen if chosen and chosen.kind == "deviation" else None)
        self._draw_section(chosen if chosen and chosen.kind == "section" else None)
        self._ask_drawings(chosen)

    # inside

    @property
    def _measured(self) -> tuple[Measurement, ...]:
        return self._session.measurements if self._session else ()

    @property
    def _labels(self) -> dict[str, str]:
        if self._session is None:
            return {}
        merge = self._session.merge
        merged = {} if merge is None else {f"merge/{merge.name}": f"the merge of {len(merge.scans)} scans"}
        return {scan.name: scan.label for scan in self._session.scans} | merged

    def _forget(self) -> None:
        """Another session: its measurements are called m1, m2, … too."""
        for identity in self._drawn:
            self._stage.scene.remove(self._layer, identity)
        self._drawn, self._lines, self._told = {}, {}, ""
        for place in ("drawings", "histogram", "section"):
            self._painter.forget(place)

    def _rename(self) -> None:
        if self._choice.value:
            self._stage.operator.rename_measurement(self._choice.value, self._rename_to.value)
            change(self._rename_to, value="")

    def _draw_deviation(self, measured: Measurement | None) -> None:
        if measured is None:
            self._painter.forget("histogram")
            self._histogram.hide()
            self._verdict.set("")
            return
        self._verdict.set(verdict_words(measured.data))
        verdict, operator = measured.data["verdict"], self._stage.operator
        tolerance = None if verdict is None else float(verdict["tolerance_mm"])

        def make() -> Any:
            arrays = measurement_arrays(opened(operator), measured.id)
            limit = colour_limit(arrays["signed"], tolerance)
            return deviation_figure(measured.name, arrays["edges"], arrays["counts"], limit, tolerance)

        self._painter.ask("histogram", (measured.id, measured.name), make, self._histogram.set)

    def _draw_section(self, measured: Measurement | None) -> None:
        """The plot as the cursors stand now; the lines are read first."""
        if measured is None or measured.id not in self._lines:
            self._painter.forget("section")
            self._section.hide()
            for cursor in CURSORS:
                self._stage.scene.remove(self._layer, f"cursor {cursor}")
            return
        plane, lines = self._lines[measured.id]
        self._section.set(measured.id, lines)
        at, on, key = self._section.at, self._on, (measured.id, measured.name, self._section.at, self._on)

        def make() -> Any:
            cursors = placed(lines, at)
            return section_figure(measured.name, lines, cursors), cursors

        def show(made: Any) -> None:
            self._section.show(*made)
            for cursor, point in zip(CURSORS, lifted(plane, made[1]), strict=True):
                if on == measured.source:
                    self._stage.scene.mark(self._layer, f"cursor {cursor}", point, cursor)
                else:
                    self._stage.scene.remove(self._layer, f"cursor {cursor}")

        self._painter.ask("section", key, make, show)

    def _ask_drawings(self, chosen: Measurement | None) -> None:
        """Everything that was measured on this surface, in 3D; a section's lines are read from the disk."""
        measured, operator = self._measured, self._stage.operator
        others = {each.id: each for each in measured}
        shown = [
            each
            for each in measured
            if self._on == each.source or any(o in others and others[o].source == self._on for o in each.of)
        ]
        cut = [each.id for each in (*shown, *([chosen] if chosen else ())) if each.kind == "section"]
        looks = {each.id: (each.name, each.stale, each is chosen) for each in shown}

        def make() -> dict[str, tuple[CutPlane, Lines]]:
            store = opened(operator)
            return {i: self._lines[i] if i in self._lines else section_lines(store, i) for i in cut}

        def show(lines: dict[str, tuple[CutPlane, Lines]]) -> None:
            with self._lock:
                came = lines.keys() - self._lines.keys()
                self._lines = lines
                for identity in self._drawn.keys() - looks.keys():
                    self._stage.scene.remove(self._layer, identity)
                    del self._drawn[identity]
                for each in shown:
                    if self._drawn.get(each.id) != looks[each.id]:
                        self._drawn[each.id] = looks[each.id]
                        self._draw_one(each, others, each is chosen)
                if came and chosen is not None and chosen.id in came:
                    self._refresh()

        self._painter.ask("drawings", (self._on, tuple(looks.items()), tuple(cut)), make, show)

    def _draw_one(self, measured: Measurement, others: dict[str, Measurement], chosen: bool) -> None:
        found = drawn(measured, others, self._lines[measured.id][1] if measured.kind == "section" else ())
        if found is None:
            return
        colour = STALE if measured.stale else CHOSEN if chosen else OTHER
        self._stage.scene.drawing(self._layer, measured.id, found[0], colour, found[1], label(measured))
