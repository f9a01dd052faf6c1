"""Measure: distances, fitted shapes, sections, and how far a part lies off its nominal model."""

import threading
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change
from slviewer.gui.measure_results import Results
from slviewer.gui.measure_surface import SurfaceBox
from slviewer.gui.measure_tools import COMPARE, FIT, PICK, Tool
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter
from slviewer.gui.scene import GHOST
from slviewer.gui.widgets import Html, Tone, Words, block, boxed, cell, toned
from slviewer.inspection.features import KINDS
from slviewer.inspection.regions import Region
from slviewer.pipeline.measured_surface import Place
from slviewer.report.canvas import round_up
from slviewer.session.measurements import Measurement
from slviewer.session.nominal import MM
from slviewer.wizard.snapshot import SessionView, Snapshot
from slviewer.wizard.surfaces import point_at

LAYER = "measure"
NOT_SAID = "not said"
_BALL = "ball"
_PICKED = ("picked 1", "picked 2")


class Panel:
    """The eighth step."""

    key = "measure"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._tool = Tool()
        self._sized = ""
        self._related: list[tuple[str, str]] = []
        self._visible = False
        self._surface = SurfaceBox(stage, self._painter, LAYER, self._loaded)
        self._results = Results(stage, self._painter, LAYER, self._chose)

    def build(self) -> None:
        gui, safely = self._stage.gui, self._stage.safely
        with gui.add_folder("Surface", visible=False) as self._surface_folder:
            self._surface.build()
        with gui.add_folder("Tools", visible=False) as self._tools_folder:
            for title, tools in (("Pick", PICK), ("Fit", FIT), ("Compare", COMPARE)):
                group = gui.add_button_group(title, tools)
                group.on_click(safely(lambda group=group: self._take(group.value)))  # type: ignore[misc]
            self._now = Words(gui)
            self._build_fit()
            self._build_between()
            self._build_nominal()
            self._away = gui.add_button("Put tool away", icon=viser.Icon.X, color="gray", hint="Key: Esc")
            self._away.on_click(safely(lambda: self._take("")))
        self._escape = gui.add_command("Put the measuring tool away", hotkey="escape", disabled=True)
        self._escape.on_trigger(safely(lambda: self._take("")))
        self._results.build()
        self._draw_tool()

    def _build_fit(self) -> None:
        gui, safely = self._stage.gui, self._stage.safely
        self._radius: Any = gui.add_slider("Radius, mm", 0.5, 100.0, 0.5, 15.0, visible=False, hint="Of the ball in 3D")
        self._radius.on_update(safely(self._draw_ball))
        self._inside = Words(gui)
        self._fit = gui.add_button("Fit", icon=viser.Icon.CHECK, visible=False)
        self._fit.on_click(safely(self._ask_fit))

    def _build_between(self) -> None:
        gui = self._stage.gui
        self._one, self._other = Choice(gui, "From"), Choice(gui, "To")
        self._between = gui.add_button("Measure between them", icon=viser.Icon.RULER_2, visible=False)
        self._between.on_click(
            self._stage.safely(lambda: self._stage.operator.measure_between(self._one.value, self._other.value))
        )

    def _build_nominal(self) -> None:
        gui, safely = self._stage.gui, self._stage.safely
        with gui.add_folder(None, visible=False) as self._nominal_folder:  # viser shows upload buttons whatever is said
            upload = gui.add_upload_button(
                "Upload nominal model", icon=viser.Icon.UPLOAD, color="gray", mime_type=".stl,.ply,.obj"
            )
            upload.on_upload(safely(lambda: self._stage.operator.take_nominal(upload.value.name, upload.value.content)))
            self._nominal = Choice(gui, "Model")
            hint = "Not said: mm, and it is asked where the sizes do not fit"
            self._units = gui.add_dropdown("Its units", (NOT_SAID, *MM), hint=hint)
            hint = "The tolerance; 0: none, and nothing is judged"
            self._tolerance = gui.add_number("Limit ±, mm", 0.0, min=0.0, max=1000.0, step=0.01, hint=hint)
            self._compare = gui.add_button("Compare", icon=viser.Icon.ARROWS_DIFF)
            self._compare.on_click(safely(self._ask_compare))

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            session = snapshot.session
            usable = session is not None and snapshot.step(self.key).state != "blocked"
            self._surface.offer(session if usable else None)
            there = bool(self._surface.name)
            change(self._surface_folder, visible=there)
            change(self._tools_folder, visible=there)
            self._offer_inputs(session)
            new = self._results.draw(session, self._surface.name)
            if self._tool.fits and any(each.kind == self._tool.name.lower() for each in new):
                self._take(self._tool.name)
            busy = snapshot.job is not None and not snapshot.job.background
            change(self._compare, disabled=busy or not self._nominal.value)
            change(self._fit, disabled=busy)

    def shown(self, visible: bool) -> None:
        with self._lock:
            self._tool.take("")
            self._draw_tool()
            self._visible = visible
            self._surface.show(visible)
            self._stage.scene.on_pick(None)
            change(self._escape, disabled=True)

    # tools

    def _take(self, name: str) -> None:
        with self._lock:
            self._tool.take(name)
            self._listen()  # before it is said: a click made as soon as one reads the sentence would be lost
            self._draw_tool()

    def _listen(self) -> None:
        """Hear of clicks into the scene while the tool waits for them; another step's clicks are its own."""
        if self._visible:
            change(self._escape, disabled=not self._tool.name)
            self._stage.scene.on_pick(self._click if self._tool.clicks and not self._lacking else None)

    @property
    def _lacking(self) -> str:
        """What the surface lacks for the tool; empty where it can be used."""
        on = self._surface.on
        if self._tool.name != "Section" or on is None or on.organised or on.faces is not None:
            return ""
        return "This merge has no triangles to cut: measure on one of its scans."

    def _click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        self._stage.safely(lambda: self._surface.clicked(origin, direction, self._picked))(None)

    def _picked(self, place: Place) -> None:
        with self._lock:
            if not self._tool.clicks:
                return
            done, on, operator = self._tool.pick(place), self._surface.name, self._stage.operator
            self._draw_tool()
        if done is None:
            return
        match self._tool.name:
            case "Point":
                operator.measure_point(on, *done)
            case "Distance":
                operator.measure_distance(on, *done)
            case "Section":
                operator.measure_section(on, *done)

    def _draw_tool(self) -> None:
        """What the tool asks for now, and what was picked with it."""
        tool = self._tool
        title = f"<b>{cell(tool.name)}</b>: " if tool.name else ""
        said = Html(title + cell(self._lacking or tool.sentence))
        tone: Tone = "warning" if self._lacking else "info"
        self._now.set(boxed(said, tone) if tool.name else block(toned(said, "dim")))
        change(self._away, visible=bool(tool.name))
        ready = tool.fits and bool(tool.picked)
        change(self._radius, visible=tool.fits)
        change(self._fit, visible=ready, label=f"Fit {tool.name.lower()}" if tool.fits else "Fit")
        for choice in (self._one, self._other):
            choice.show(tool.name == COMPARE[0])
        change(self._between, visible=tool.name == COMPARE[0])
        change(self._nominal_folder, visible=tool.name == COMPARE[1])
        on, scene = self._surface.on, self._stage.scene
        marked = [] if on is None or tool.fits else tool.picked
        for i, name in enumerate(_PICKED):
            if on is not None and i < len(marked):
                scene.mark(LAYER, name, point_at(on, marked[i]), str(i + 1))
            else:
                scene.remove(LAYER, name)
        self._draw_ball()

    def _draw_ball(self) -> None:
        """The region that a shape would be fitted to, and how much it holds."""
        with self._lock:
            on, region = self._surface.on, self._region()
            if on is None or region is None or region.centre is None:
                self._painter.forget("inside")
                self._stage.scene.remove(LAYER, _BALL)
                self._inside.set("")
                return
            radius = float(self._radius.value)
            self._stage.scene.ball(LAYER, _BALL, region.centre, radius, GHOST)
            key = (self._surface.name, tuple(region.centre), radius)
            self._painter.ask("inside", key, lambda: len(on.within(region)), self._say_inside)

    def _say_inside(self, points: int) -> None:
        self._inside.say(f"{points:,} points in the ball", "dim")

    def _region(self) -> Region | None:
        on = self._surface.on
        if on is None or not self._tool.fits or not self._tool.picked:
            return None
        return Region.ball(point_at(on, self._tool.picked[0]), float(self._radius.value))

    # the surface and the results

    def _loaded(self) -> None:
        """Another surface: what was picked on the one before is forgotten, and the ball fits its size."""
        with self._lock:
            on = self._surface.on
            assert on is not None
            self._take(self._tool.name)
            self._results.move_to(on.source)
            if self._sized != on.source:
                self._sized = on.source
                low, high = np.nanpercentile(on.points.reshape(-1, 3), [2, 98], axis=0)
                most = round_up(0.6 * float(np.linalg.norm(high - low)))
                self._radius.max, self._radius.step, self._radius.min = most, most / 200, most / 200
                self._radius.value = most / 5

    def _chose(self, measured: Measurement | None) -> None:
        """Show a measurement where it was made."""
        if measured is not None and measured.source != self._surface.name:
            self._surface.choose(measured.source)
        self._surface.deviate(measured if measured is not None and measured.kind == "deviation" else None)

    # requests

    def _offer_inputs(self, session: SessionView | None) -> None:
        measured = session.measurements if session else ()
        related = [(each.id, each.name) for each in measured if each.kind in KINDS and not each.stale]
        for choice in (self._one, self._other):
            choice.offer(related)
        if (
            related != self._related and len(related) > 1 and self._tool.name != COMPARE[0]
        ):  # the latest two, most likely
            self._one.choose(related[-2][0])
            self._other.choose(related[-1][0])
        self._related = related
        change(self._between, disabled=len(related) < 2)
        self._nominal.offer([(name, name) for name in (session.nominals if session else ())])

    def _ask_fit(self) -> None:
        with self._lock:
            region, shape = self._region(), self._tool.name.lower()
        if region is not None:
            self._stage.operator.measure_shape(self._surface.name, shape, region)

    def _ask_compare(self) -> None:
        units = None if self._units.value == NOT_SAID else self._units.value
        tolerance = float(self._tolerance.value) or None
        self._stage.operator.compare_nominal(self._surface.name, self._nominal.value, units, tolerance)
