"""Step 8: distances, fitted shapes, sections, and deviations from a nominal model."""

from typing import Any, cast

import numpy as np

from slviewer.gui.inspection_inputs import InspectionInputs
from slviewer.gui.measure_list import MeasurementList
from slviewer.gui.measure_surface import SurfaceView
from slviewer.gui.panel import NO_SESSION, Choice, StepPanel
from slviewer.gui.scene import Click
from slviewer.gui.widgets import Html, Text, to_html
from slviewer.inspection.features import KINDS
from slviewer.inspection.regions import Region
from slviewer.pipeline.measure import What
from slviewer.pipeline.measured_surface import Place
from slviewer.pipeline.stored_records import Stored
from slviewer.records.measurement import Measurement
from slviewer.report.canvas import round_up
from slviewer.session.nominal import MM
from slviewer.surface.selection import ViewCamera
from slviewer.wizard.result_views import box_in_view, point_at
from slviewer.wizard.snapshot import SessionView, Snapshot

UNKNOWN = "unknown"
BALL, RECTANGLE, BOX = "ball", "rectangle", "box"
BOX_COLOUR = (20, 150, 140)
_PICKED = ("picked 1", "picked 2")
PICK = ("Point", "Distance", "Section")
FIT = ("Plane", "Sphere", "Cylinder")
COMPARE = ("Relation", "Deviation")
_CLICKS = {
    "Point": ("Click the point.",),
    "Distance": ("Click the first point.", "Click the second point."),
    "Section": ("Click the start of the section.", "Click the end of the section."),
}
_WITHOUT_CLICKS = {
    "Relation": "Choose two points or fits, and measure their distances and angles.",
    "Deviation": "Choose or upload a nominal model (STL, PLY, OBJ, STEP, 3MF), and compare.",
}


class Tool:
    """The chosen tool, its name empty for none, the points picked with it, and the box drawn for a
    fit: by a rectangle where ``by_rectangle``, else fits use a ball about the picked point."""

    def __init__(self) -> None:
        self.name = ""
        self.picked: list[Place] = []
        self.by_rectangle = False
        self.box: Region | None = None

    def select(self, name: str) -> None:
        """Select another tool, or none; picked points and the box are dropped."""
        self.name, self.picked, self.box = name, [], None

    @property
    def has_region(self) -> bool:
        """Whether there is a region to fit to."""
        return self.fits and (self.box is not None if self.by_rectangle else bool(self.picked))

    @property
    def fits(self) -> bool:
        """Whether the tool fits a shape to a region around the picked point."""
        return self.name in FIT

    @property
    def clicks(self) -> bool:
        """Whether the tool needs clicks on the surface."""
        return self.fits or self.name in _CLICKS

    def pick(self, place: Place) -> tuple[Place, ...] | None:
        """Add a click on the surface; returns all points once the tool has enough, and starts
        again.

        A tool that fits replaces its point instead, until the operator accepts the region. The same
        point again, as by a double click, is not a second point.
        """
        if self.fits:
            self.picked = [place]
            return None
        if place in self.picked:
            return None
        self.picked.append(place)
        if len(self.picked) < len(_CLICKS.get(self.name, ())):
            return None
        done, self.picked = tuple(self.picked), []
        return done

    @property
    def instruction(self) -> str:
        """What to do now, in one sentence."""
        if not self.name:
            return "Choose a tool."
        if self.fits:
            shape = self.name.lower()
            if self.by_rectangle:
                end = f", then press Fit {shape}." if self.box is not None else "."
                return f"Drag a rectangle over the {shape} alone{end}"
            if not self.picked:
                return f"Click the centre of the {shape}."
            return (
                f"Set the radius so that the ball contains only the {shape}, then press Fit"
                f" {shape}."
            )
        if self.name in _WITHOUT_CLICKS:
            return _WITHOUT_CLICKS[self.name]
        return _CLICKS[self.name][len(self.picked)]


class MeasurePanel(StepPanel):
    """Panel of the step Measure."""

    key = "measure"

    _sized_for = ""

    def build(self) -> None:
        """Create the inputs of surface, tools and results."""
        gui, context, operator = self._gui, self._context, self._operator
        self._tool = Tool()
        self._related: list[tuple[str, str]] = []
        with gui.add_folder("Surface") as self._surface_folder:
            self._surface = SurfaceView(self, self._handle_loaded)
        with gui.add_folder("Tools") as self._tools_folder:
            for title, tools in (("Pick", PICK), ("Fit", FIT), ("Compare", COMPARE)):
                group = gui.add_button_group(title, tools)
                group.on_click(context.callback(lambda group=group: self._select_tool(group.value)))  # type: ignore[misc]
            self._instruction = Text(gui)
            self._by: Any = gui.add_dropdown("Region", (BALL, RECTANGLE))
            context.on_change(self._change_region, self._by)
            self._radius: Any = gui.add_slider(
                "Radius, mm", 0.5, 100.0, 0.5, 15.0, hint="Of the ball in 3D"
            )
            context.on_change(self._draw_region, self._radius)
            self._inside = Text(gui)
            self._fit = context.button("Fit", self._request_fit, "check", None)
            self._from, self._to = Choice(context, "From"), Choice(context, "To")
            self._relate = context.button(
                "Measure relation",
                lambda: operator.measure_between(self._from.value, self._to.value),
                "ruler-2",
                None,
            )
            # viser cannot hide upload buttons alone
            with gui.add_folder(None) as self._nominal_folder:
                context.upload_button(
                    "Upload model", operator.upload_nominal, ".stl,.ply,.obj,.step,.stp,.3mf"
                )
                self._nominal = Choice(context, "Nominal")
                self._units: Any = gui.add_dropdown(
                    "Units",
                    (UNKNOWN, *MM),
                    hint="Of the nominal model; unknown: mm, if the sizes agree",
                )
                self._tolerance = gui.add_number(
                    "Tolerance ±, mm",
                    0.0,
                    min=0.0,
                    max=1000.0,
                    step=0.01,
                    hint="0: without a verdict",
                )
                self._compare = context.button(
                    "Compare", self._request_comparison, "arrows-diff", None
                )
            self._end = context.button(
                "End tool", lambda: self._select_tool(""), "x", hint="Key: Esc"
            )
        self._escape = gui.add_command("End the measuring tool", hotkey="escape", disabled=True)
        self._escape.on_trigger(context.callback(lambda: self._select_tool("")))
        self._results = MeasurementList(self, self._show_measurement)
        self._inspection = InspectionInputs(self)
        self._draw_tool()

    def draw(self, snapshot: Snapshot) -> None:
        """Show the surfaces and measurements of a snapshot."""
        session = self._session
        usable = snapshot.step(self.key).state != "blocked"
        self._surface.offer(session if usable else NO_SESSION)
        self._surface_folder.visible = self._tools_folder.visible = bool(self._surface.name)
        self._offer_inputs(session)
        new = self._results.update(session, self._surface.name)
        self._inspection.offer(snapshot, self._surface.name)
        if self._tool.fits and any(each.record.what == self._tool.name.lower() for each in new):
            self._select_tool(self._tool.name)
        self._compare.disabled = snapshot.is_busy or not self._nominal.value
        self._fit.disabled = snapshot.is_busy

    def show(self, visible: bool) -> None:
        """Show or hide the panel's layer; the tool is reset, and clicks are ignored until one is
        selected."""
        with self._lock:
            self._visible = True  # until the clicks are left to another step
            self._select_tool("")
            super().show(visible)

    # tools

    def _select_tool(self, name: str) -> None:
        """Select a tool by name; empty: none."""
        with self._lock:
            self._tool.select(name)
            if self._visible:  # before the instruction appears, so that no click is lost
                self._escape.disabled = not name
                rectangle = self._tool.fits and self._tool.by_rectangle
                self._scene.on_rectangle(self._handle_rectangle if rectangle else None)
                clicks = self._tool.clicks and not rectangle
                self._scene.on_click(self._handle_click if clicks else None)
            self._draw_tool()

    def _change_region(self) -> None:
        """Take clicks or rectangles, as the operator chose."""
        with self._lock:
            self._tool.by_rectangle = self._by.value == RECTANGLE
            self._select_tool(self._tool.name)

    def _handle_rectangle(self, view: ViewCamera, low: np.ndarray, high: np.ndarray) -> None:
        """Take the box around what a dragged rectangle shows."""

        def take() -> None:
            """Set the box, and draw it."""
            with self._lock:
                if self._surface.on is not None and self._tool.fits:
                    self._tool.box = box_in_view(self._surface.on, view, low, high)
                    self._draw_tool()

        self._context.callback(take)(None)

    def _handle_click(self, click: Click) -> None:
        """Pick the point of the surface that a click meets."""
        self._context.callback(lambda: self._surface.pick(click, self._add_pick))(None)

    def _add_pick(self, place: Place) -> None:
        """Add a picked point to the tool, and request the measurement once it has enough."""
        with self._lock:
            if not self._tool.clicks:
                return
            places, on = self._tool.pick(place), self._surface.name
            self._draw_tool()
        if places is not None:
            self._operator.measure(on, cast(What, self._tool.name.lower()), places)

    def _draw_tool(self) -> None:
        """Show the instruction and the inputs of the tool, and the points picked with it."""
        tool = self._tool
        title = f"<b>{to_html(tool.name)}</b>: " if tool.name else ""
        text = Html(title + to_html(tool.instruction))
        self._instruction.write(text, "info" if tool.name else "dim")
        self._end.visible = bool(tool.name)
        self._by.visible = tool.fits
        self._radius.visible = tool.fits and not tool.by_rectangle
        self._fit.visible = tool.has_region
        self._fit.label = f"Fit {tool.name.lower()}"
        relation, deviation = (tool.name == name for name in COMPARE)
        for handle in (self._from.handle, self._to.handle, self._relate):
            handle.visible = relation
        self._nominal_folder.visible = deviation
        on = self._surface.on
        marked = [] if on is None or tool.fits else tool.picked
        self.layer.remove(*_PICKED[len(marked) :])
        for name, place in zip(_PICKED, marked, strict=False):
            if on is not None:
                self.layer.mark(name, point_at(on, place), name[-1])
        self._draw_region()

    def _draw_region(self) -> None:
        """Draw the region that a shape would be fitted to, and request its number of points."""
        with self._lock:
            on, region = self._surface.on, self._make_region()
            if on is None or region is None:
                self.layer.remove(BALL, BOX)
                self.painter.cancel("inside")
                self._inside.set("")
                return
            if region.kind == "ball":
                self.layer.remove(BOX)
                self.layer.ball(BALL, region.centre, float(region.size[0]))
            else:
                self.layer.remove(BALL)
                self.layer.lines(BOX, region.edges(), BOX_COLOUR)
            key = (self._surface.name, region.text())
            self.painter.request(
                "inside",
                key,
                lambda: len(on.within(region)),
                lambda points: self._inside.write(f"{points:,} points in the {region.kind}", "dim"),
            )

    def _make_region(self) -> Region | None:
        """Return the ball around the picked point, or the box that was drawn; None unless the tool
        fits and has one."""
        on = self._surface.on
        if on is None or not self._tool.has_region:
            return None
        if self._tool.by_rectangle:
            return self._tool.box
        return Region.ball(point_at(on, self._tool.picked[0]), float(self._radius.value))

    # the surface and the results

    def _handle_loaded(self) -> None:
        """Handle that another surface is shown: drop picked points, and adapt the ball to its
        size."""
        with self._lock:
            on = self._surface.on
            assert on is not None
            self._select_tool(self._tool.name)
            self._results.change_surface(on.source)
            if self._sized_for != on.source:
                self._sized_for = on.source
                low, high = np.nanpercentile(on.points.reshape(-1, 3), [2, 98], axis=0)
                most = round_up(0.6 * float(np.linalg.norm(high - low)))
                self._radius.max, self._radius.step, self._radius.min = most, most / 200, most / 200
                self._radius.value = most / 5

    def _show_measurement(self, measured: Stored[Measurement] | None) -> None:
        """Show the surface on which a measurement was made."""
        record = None if measured is None else measured.record
        if record is not None and record.source != self._surface.name:
            self._surface.choice.choose(record.source)
        self._surface.show_deviation(
            measured if record is not None and record.deviation is not None else None
        )

    # requests

    def _offer_inputs(self, session: SessionView) -> None:
        """Offer the results to relate, by default the latest two, and the nominal models."""
        related = [
            (each.name, each.label)
            for each in session.measurements
            if each.record.what in KINDS and not each.stale
        ]
        for choice in (self._from, self._to):
            choice.offer(related)
        # likely the latest two
        if related != self._related and len(related) > 1 and self._tool.name != COMPARE[0]:
            self._from.choose(related[-2][0])
            self._to.choose(related[-1][0])
        self._related = related
        self._relate.disabled = len(related) < 2
        self._nominal.offer_names(session.nominals)

    def _request_fit(self) -> None:
        """Request the fit of the tool's shape to the region."""
        with self._lock:
            region, shape = self._make_region(), cast(What, self._tool.name.lower())
        if region is not None:
            self._operator.measure(self._surface.name, shape, region=region)

    def _request_comparison(self) -> None:
        """Request the comparison with the chosen nominal model."""
        units = None if self._units.value == UNKNOWN else self._units.value
        tolerance = float(self._tolerance.value) or None
        self._operator.compare_nominal(self._surface.name, self._nominal.value, units, tolerance)
