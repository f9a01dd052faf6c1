"""Step 8: distances, fitted shapes, sections, and deviations from a nominal model, on a surface
that is chosen, drawn in 3D and picked on."""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np

from slviewer.gui.colouring import (
    SURFACE_COLOURINGS,
    in_view,
    paint_points,
    shade,
    surface_values,
)
from slviewer.gui.measure_list import InspectionInputs, MeasurementList
from slviewer.gui.panel import NO_SESSION, Form, PanelPart, StepPanel, scan_options
from slviewer.gui.scene import Click, Drag
from slviewer.gui.steps.scan import sort_scans
from slviewer.gui.widgets import Html, Text, colour_bar, note, to_html
from slviewer.inspection.deviation import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.inspection.features import KINDS
from slviewer.inspection.regions import Region
from slviewer.pipeline.compare import CompareSettings
from slviewer.pipeline.measure import MERGED, MeasuredSurface, Place, What
from slviewer.pipeline.operation import Stored, load_arrays
from slviewer.records.measurement import Measurement
from slviewer.report.page import round_up
from slviewer.session.units import MM, Units
from slviewer.wizard.result_views import box_in_view, place_at, point_at, snap
from slviewer.wizard.snapshot import SessionView

DEVIATION = "deviation"


class SurfaceView(PanelPart):
    """View of the chosen surface, ``on``: None until it is loaded."""

    on: MeasuredSurface | None = None
    _deviation: Stored[Measurement] | None = None
    _merge = ""

    def build(self) -> None:
        """Create the inputs."""
        self._versions: dict[str, Any] = {}
        self._choice = self.choice("Surface")
        self._colour = self.dropdown("Colour", SURFACE_COLOURINGS)
        self._legend = Text(self._gui)

    @property
    def name(self) -> str:
        """The chosen scan or merge; empty where there is none."""
        return str(self._choice.value)

    def offer(self, session: SessionView) -> None:
        """Offer the surfaces that can be measured on, and draw the chosen one."""
        scans = [scan for scan in sort_scans(session.scans) if scan.cloud == "fresh"]
        offered: dict[str, str] = {}
        self._versions = {
            scan.name: (session.folder, scan.figures, *session.restriction(scan.name))
            for scan in scans
        }
        merge = session.merge
        if merge and not merge.stale:
            name = offered[f"Merge of {len(merge.record.scans)} scans"] = f"{MERGED}{merge.name}"
            self._versions[name] = (session.folder, merge.record.points)
        self._choice.offer(offered | scan_options(scans))
        before, self._merge = self._merge, next(iter(offered.values()), "")
        if self._merge != before:
            self._choice.choose(self._merge)  # what the scans were merged for
        self._request()

    def show_measurement(self, measured: Stored[Measurement] | None) -> None:
        """Show the surface on which a measurement was made, coloured by its deviation if it has
        one; None: as chosen."""
        if measured:
            self._choice.choose(measured.record.source)
            if measured.record.deviation is None:
                measured = None
        self._deviation = measured
        options = SURFACE_COLOURINGS if measured is None else (*SURFACE_COLOURINGS, DEVIATION)
        if self._colour.options != options:
            self._colour.options = options  # a colour that is no longer offered becomes the first
        if measured:
            self._colour.value = DEVIATION
        self._request()

    def pick(self, click: Click, do: Callable[[Place], None]) -> None:
        """Call ``do(place)`` later with the point that a click meets; not called where it misses
        the surface."""
        on = self.on
        if on is None:
            return

        def picked(place: Place | None) -> None:
            """Pass the place on, unless the ray has missed or another surface is shown by now."""
            if place is not None and on is self.on:
                do(place)

        self._painter.request_once(picked, lambda: place_at(on, click.origin, click.direction))

    def _request(self) -> None:
        """Request the chosen surface in the chosen colours."""
        name, colour, shown = self.name, self._colour.value, self._deviation
        if not name:
            self.on = None
            self._painter.cancel(self._draw_surface)
            self._layer.remove("surface")
            self._legend.set("")
            return
        if shown and (shown.record.source != name or colour != DEVIATION):
            shown = None
        key = (name, self._versions.get(name), colour if shown is None else shown.name)

        def make() -> tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]:
            """Load the surface; returns (surface, points, colours, legend)."""
            on = self._operator.surface(name)
            if shown is None:
                default = SURFACE_COLOURINGS[0] if colour == DEVIATION else colour
                return (on, on.points, *paint_points(surface_values(on), default))
            assert shown.record.deviation is not None
            arrays = load_arrays(self.context.session, f"{Measurement.kind}/{shown.name}")
            return (on, *_colour_by_deviation(arrays, shown.record.deviation.tolerance_mm))

        self._painter.request(self._draw_surface, key, make)

    def _draw_surface(self, made: tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]) -> None:
        """Draw the loaded surface and its legend; report a new one."""
        on, points, painted, bar = made
        is_new = on is not self.on
        self.on = on
        self._layer.cloud("surface", points, painted)
        self._legend.set(bar)
        if is_new:
            self.redraw()
        self.panel.show_points(on.source, on.points)


def _colour_by_deviation(
    arrays: dict[str, np.ndarray], tolerance: float | None
) -> tuple[np.ndarray, np.ndarray, Html]:
    """Colour a surface by a stored deviation: (points (n, 3) mm, colours (n, 3), legend); grey
    where not measured."""
    limit = colour_limit(arrays["signed"], tolerance)
    uncovered = arrays["uncovered"].reshape(-1, 3)
    points = np.concatenate([arrays["points"], uncovered]).astype(np.float32)
    grey = np.broadcast_to(np.array(EXCLUDED_COLOUR, np.uint8), uncovered.shape)
    title = "deviation; red: outside, blue: inside, grey: not measured"
    scale = deviation_colours(np.linspace(-1, 1, 13), 1.0)
    legend = colour_bar(f"−{limit:.3g} mm", f"+{limit:.3g} mm", scale, title)
    painted = shade(deviation_colours(arrays["signed"], limit), arrays["normals"])
    return points, np.concatenate([painted, grey]), in_view(legend)


UNKNOWN = "unknown"
BALL, RECTANGLE, BOX = "ball", "rectangle", "box"
BOX_COLOUR = (20, 150, 140)
_PICKED = ("picked 1", "picked 2")
_ENDS = ("end 1", "end 2")
"""Marks of the chosen result's points."""
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
    def what(self) -> What:
        """What the tool measures."""
        return cast(What, self.name.lower())

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
    _on: MeasuredSurface | None = None
    _drawn: object = None
    _drawn_ends: object = None

    def build(self) -> None:
        """Create the inputs of surface, tools and results."""
        gui, operator = self._gui, self._operator
        self._tool = Tool()
        self._related: dict[str, str] = {}
        self._results = MeasurementList(self)
        with gui.add_folder("Surface") as self._surface_folder:
            self._surface = SurfaceView(self)
        with gui.add_folder("Tools") as self._tools_folder:
            for title, tools in (("Pick", PICK), ("Fit", FIT), ("Compare", COMPARE)):
                self.button_group(title, tools, self._select_tool)
            self._instruction = Text(gui)
            self._by = self.dropdown("Region", (BALL, RECTANGLE), do=self._change_region)
            self._radius: Any = gui.add_slider(
                "Radius, mm", 0.5, 100.0, 0.5, 15.0, hint="Of the ball in 3D"
            )
            self.react(self._radius.on_update)
            self._inside = Text(gui)
            self._fit = self.button("Fit", self._request_fit, "check", None)
            self._from, self._to = self.choice("From"), self.choice("To")
            self._relate = self.button(
                "Measure relation",
                lambda: operator.measure_between(self._from.value, self._to.value),
                "ruler-2",
                None,
            )
            # viser cannot hide upload buttons alone
            with gui.add_folder(None) as self._nominal_folder:
                self.upload_button(
                    "Upload model", operator.upload_nominal, ".stl,.ply,.obj,.step,.stp,.3mf"
                )
                self._nominal = self.choice("Nominal")
                units: dict[str, Units | None] = {UNKNOWN: None, **{unit: unit for unit in MM}}
                self._units = self.choice(
                    "Units", "Of the nominal model; unknown: mm, if the sizes agree", units
                )
                self._inputs = Form(self, CompareSettings, "tolerance")
                self._compare = self.button(
                    "Compare", self._request_comparison, "arrows-diff", None
                )
            end = partial(self._select_tool, "")
            self._end = self.button("End tool", end, "x", hint="Key: Esc")
        self._escape = self.command("End the measuring tool", end, "escape")
        self._escape.disabled = True
        self._inspection = InspectionInputs(self)

    def draw(self) -> None:
        """Show the surfaces, the measurements, and the tool."""
        session, surface, busy = self.session, self._surface, self.snapshot.is_busy
        surface.offer(NO_SESSION if self.is_blocked else session)
        self._surface_folder.visible = self._tools_folder.visible = bool(surface.name)
        self._offer_inputs(session)
        new = self._results.update(surface.name)
        if self._results.is_other:
            surface.show_measurement(self._results.chosen)
        self._inspection.offer(surface.name)
        if surface.on is not self._on:
            self._on = surface.on
            self._handle_loaded()
        if self._tool.fits and any(each.record.what == self._tool.what for each in new):
            self._select_tool(self._tool.name)
        self._compare.disabled = busy or not self._nominal.value
        self._fit.disabled = busy
        self._draw_tool()
        self._draw_picked()
        self._draw_ends()

    def show(self, visible: bool) -> None:
        """Show or hide the panel's layer; the tool is reset, and clicks are ignored until one is
        selected."""
        self._visible = True  # until the clicks are left to another step
        self._select_tool("")
        super().show(visible)

    # tools

    def _select_tool(self, name: str) -> None:
        """Select a tool by name; empty: none."""
        self._tool.select(name)
        if self._visible:  # before the instruction appears, so that no click is lost
            self._escape.disabled = not name
            rectangle = self._tool.fits and self._tool.by_rectangle
            self._scene.on_drag("rectangle", self._handle_rectangle if rectangle else None)
            clicks = self._tool.clicks and not rectangle
            self._scene.on_click(self._handle_click if clicks else None)

    def _change_region(self) -> None:
        """Take clicks or rectangles, as the operator chose."""
        self._tool.by_rectangle = self._by.value == RECTANGLE
        self._select_tool(self._tool.name)

    def _handle_rectangle(self, drag: Drag) -> None:
        """Take the box around what a dragged rectangle shows."""
        if self._on is not None and self._tool.fits:
            self._tool.box = box_in_view(self._on, drag.view, drag.path)
            self.redraw()

    def _handle_click(self, click: Click) -> None:
        """Pick the point of the surface that a click meets."""
        self._surface.pick(click, self._add_pick)

    def _add_pick(self, place: Place) -> None:
        """Add a picked point to the tool, and request the measurement once it has enough."""
        if not self._tool.clicks:
            return
        places = self._tool.pick(place)
        self.redraw()
        if places:
            self._operator.measure(self._surface.name, self._tool.what, places)

    def _move_pick(self, number: int, point: np.ndarray) -> None:
        """Move a picked point to the point (3,) mm of the surface that it was dragged to."""
        if self._on is not None and number < len(self._tool.picked):
            self._tool.picked[number] = snap(self._on, point)
            self.redraw()

    def _move_end(self, name: str, number: int, point: np.ndarray) -> None:
        """Request a measurement again with one of its points where it was dragged to."""
        if self._on is not None:
            self._operator.move_point(name, number, snap(self._on, point))

    def _draw_tool(self) -> None:
        """Show the instruction and the inputs of the tool."""
        tool = self._tool
        title = f"<b>{to_html(tool.name)}</b>: " if tool.name else ""
        clicks = tool.clicks and not (tool.fits and tool.by_rectangle)
        hover = self.layer.hover_html("surface") if clicks else ""
        marks = _PICKED[: len(tool.picked)] or _ENDS[: len(self._list_ends())]
        drag = self.layer.drag_html("surface", marks)
        text = Html(title + to_html(tool.instruction) + hover + drag)
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

    def _draw_picked(self) -> None:
        """Draw the points picked with the tool, or the region that it would fit a shape to, and
        request the region's number of points."""
        on, tool, region = self._on, self._tool, self._make_region()
        key = (self._surface.name, tool.name, tuple(tool.picked), region and region.text())
        if key == self._drawn:
            return
        self._drawn = key
        self.layer.remove(*_PICKED, BALL, BOX)
        self.painter.cancel(self._inside.set)
        self._inside.set("")
        if on is None:
            return
        for number, (name, place) in enumerate(zip(_PICKED, tool.picked, strict=False)):
            title = "" if tool.fits else name[-1]
            move = partial(self._move_pick, number)
            self.layer.mark(name, point_at(on, place), title, on_drag=move)
        if region is None:
            return
        if region.kind == "ball":
            self.layer.ball(BALL, region.centre, float(region.size[0]))
        else:
            self.layer.lines(BOX, region.edges(), BOX_COLOUR)
        self.painter.request(
            self._inside.set,
            key,
            lambda: note(f"{len(on.within(region)):,} points in the {region.kind}"),
        )

    def _list_ends(self) -> list[Place]:
        """Return the places of the chosen result that can be dragged: on the surface that is
        shown, while no other point is picked."""
        chosen, on = self._results.chosen, self._on
        if chosen is None or on is None or chosen.stale or self._tool.picked:
            return []
        return chosen.record.places() if chosen.record.source == on.source else []

    def _draw_ends(self) -> None:
        """Draw the points of the chosen result."""
        chosen, places = self._results.chosen, self._list_ends()
        key = (chosen and chosen.name, self._on and self._on.source, places)
        if key == self._drawn_ends:
            return
        self._drawn_ends = key
        self.layer.remove(*_ENDS)
        if chosen is None or self._on is None:
            return
        for number, (name, place) in enumerate(zip(_ENDS, places, strict=False)):
            move = partial(self._move_end, chosen.name, number)
            self.layer.mark(name, point_at(self._on, place), "", on_drag=move)

    def _make_region(self) -> Region | None:
        """Return the ball around the picked point, or the box that was drawn; None unless the tool
        fits and has one."""
        if self._on is None or not self._tool.has_region:
            return None
        if self._tool.by_rectangle:
            return self._tool.box
        return Region.ball(point_at(self._on, self._tool.picked[0]), float(self._radius.value))

    # the surface and the results

    def _handle_loaded(self) -> None:
        """Handle that another surface is shown: drop picked points, and adapt the ball to its
        size."""
        on = self._on
        self._select_tool(self._tool.name)
        if on is not None and self._sized_for != on.source:
            self._sized_for = on.source
            low, high = np.nanpercentile(on.points.reshape(-1, 3), [2, 98], axis=0)
            most = round_up(0.6 * float(np.linalg.norm(high - low)))
            self._radius.max, self._radius.step, self._radius.min = most, most / 200, most / 200
            self._radius.value = most / 5

    # requests

    def _offer_inputs(self, session: SessionView) -> None:
        """Offer the results to relate, by default the latest two, and the nominal models."""
        related = {
            each.label: each.name
            for each in session.measurements
            if each.record.what in KINDS and not each.stale
        }
        for choice in (self._from, self._to):
            choice.offer(related)
        # likely the latest two
        if related != self._related and len(related) > 1 and self._tool.name != COMPARE[0]:
            *_, before, latest = related.values()
            self._from.choose(before)
            self._to.choose(latest)
        self._related = related
        self._relate.disabled = len(related) < 2
        self._nominal.offer_names(session.nominals)

    def _request_fit(self) -> None:
        """Request the fit of the tool's shape to the region."""
        if region := self._make_region():
            self._operator.measure(self._surface.name, self._tool.what, region=region)

    def _request_comparison(self) -> None:
        """Request the comparison with the chosen nominal model."""
        self._operator.compare_nominal(
            self._surface.name,
            self._nominal.value,
            units=self._units.value,
            **self._inputs.values(),
        )
