"""The surface to measure on: chosen, drawn in 3D, and picked on."""

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

from slviewer.gui.inputs import Choice, change, scan_options
from slviewer.gui.measure_html import deviation_bar
from slviewer.gui.panel import PanelContext
from slviewer.gui.pictures import Painter
from slviewer.gui.steps.scan import sort_scans
from slviewer.gui.widgets import Html, Text, paint
from slviewer.inspection.deviation import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.pipeline.measured_surface import MERGED, MeasuredSurface, Place
from slviewer.pipeline.stored_records import Stored, load_arrays
from slviewer.records.measurement import Measurement
from slviewer.wizard.snapshot import SessionView
from slviewer.wizard.surfaces import place_at

COLOURS = ("texture", "depth", "uncertainty")
DEVIATION = "deviation"


class SurfaceView:
    """View of the chosen surface; ``loaded()`` is called once another one is shown, on the
    painter's thread."""

    def __init__(
        self, context: PanelContext, painter: Painter, layer: str, loaded: Callable[[], None]
    ) -> None:
        self._context, self._painter, self._layer, self._loaded = context, painter, layer, loaded
        self._clicks = count()
        self._deviation: Stored[Measurement] | None = None
        self._versions: dict[str, Any] = {}
        self._visible = False
        self.on: MeasuredSurface | None = None

    def build(self) -> None:
        """Create the inputs."""
        gui, context = self._context.gui, self._context
        self._choice = Choice(gui, "Surface")
        self._choice.on_change(context.callback(self.request))
        self._colour = gui.add_dropdown("Colour", COLOURS)
        self._colour.on_update(context.callback(self.request))
        self._legend = Text(gui)
        context.view_button(lambda: None if self.on is None else self.on.points)

    @property
    def name(self) -> str:
        """The chosen scan or merge; empty where there is none."""
        return self._choice.value

    def choose(self, name: str) -> None:
        """Choose a surface by name, if it is offered."""
        self._choice.choose(name)

    def offer(self, session: SessionView | None) -> None:
        """Offer the surfaces that can be measured on, and draw the chosen one."""
        scans = (
            [scan for scan in sort_scans(session.scans) if scan.cloud == "fresh"] if session else []
        )
        offered = scan_options(scans)
        folder = session.folder if session else None
        cut = session.restriction if session else lambda _: (None, ())
        self._versions = {s.name: (folder, s.figures, *cut(s.name)) for s in scans}
        merge = session.merge if session else None
        if merge is not None and not merge.stale:
            name = f"{MERGED}{merge.name}"
            offered.append((name, f"Merge of {len(merge.record.scans)} scans"))
            self._versions[name] = (folder, merge.record.points)
        self._choice.offer(offered)
        self.request()

    def show_deviation(self, measured: Stored[Measurement] | None) -> None:
        """Colour the surface by this deviation; None: by another quantity."""
        self._deviation = measured
        if measured is not None:
            change(self._colour, options=(*COLOURS, DEVIATION))
            change(self._colour, value=DEVIATION)
        elif DEVIATION in self._colour.options:
            colour = COLOURS[0] if self._colour.value == DEVIATION else self._colour.value
            self._colour.options = COLOURS
            change(self._colour, value=colour)
        self.request()

    def show(self, visible: bool) -> None:
        """Show or hide the surface."""
        self._visible = visible
        self._context.scene.show(self._layer, visible)
        self._show_view()

    def pick(self, origin: np.ndarray, direction: np.ndarray, do: Callable[[Place], None]) -> None:
        """Call ``do(place)`` later with the point that a ray meets; not called where it misses the
        surface."""
        on, slot = self.on, f"click {next(self._clicks)}"
        if on is None:
            return

        def picked(place: Place | None) -> None:
            """Pass the place on, unless the ray has missed or another surface is shown by now."""
            self._painter.cancel(slot)
            if place is not None and on is self.on:
                do(place)

        self._painter.request(slot, None, lambda: place_at(on, origin, direction), picked)

    def request(self) -> None:
        """Request the chosen surface in the chosen colours."""
        name, colour, shown = self.name, self._colour.value, self._deviation
        if not name:
            self.on = None
            self._painter.cancel("surface")
            self._context.scene.remove(self._layer, "surface")
            self._legend.set("")
            return
        if shown is not None and (shown.record.source != name or colour != DEVIATION):
            shown = None
        key = (name, self._versions.get(name), colour if shown is None else shown.name)
        context = self._context

        def make() -> tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]:
            """Load the surface; returns (surface, points, colours, legend)."""
            on = context.operator.surface(name)
            if shown is None:
                return (on, *paint_surface(on, COLOURS[0] if colour == DEVIATION else colour))
            assert shown.record.deviation is not None
            arrays = load_arrays(context.session, f"{Measurement.kind}/{shown.name}")
            return (on, *_colour_by_deviation(arrays, shown.record.deviation.tolerance_mm))

        self._painter.request("surface", key, make, self._draw_surface)

    def _draw_surface(self, made: tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]) -> None:
        """Draw the loaded surface and its legend; report a new one."""
        on, points, painted, bar = made
        is_new = on is not self.on
        self.on = on
        self._context.scene.cloud(self._layer, "surface", points, painted)
        self._context.scene.show(self._layer, self._visible)
        self._legend.set(bar)
        if is_new:
            self._loaded()
        self._show_view()

    def _show_view(self) -> None:
        """Move the browsers' views to the surface, if it is visible."""
        if self._visible and self.on is not None:
            self._context.viewpoints.show(f"{self._layer} {self.on.source}", self.on.points)


def paint_surface(on: MeasuredSurface, colour: str) -> tuple[np.ndarray, np.ndarray, Html]:
    """Colour a surface by one of COLOURS: (points (..., 3), their colours (..., 3), the legend)."""
    if colour == "texture" and on.texture is not None:
        return on.points, on.texture, Html("")
    if colour == "uncertainty":
        sigma = on.sigma_mm if on.left_mm is None else np.hypot(on.sigma_mm, on.left_mm)
        title = (
            "uncertainty of z (1 sigma)"
            if on.organised
            else "uncertainty along the normal (1 sigma)"
        )
        title += "" if on.left_mm is not None else ", noise only"
        return on.points, *paint(np.where(on.measured, sigma, np.nan), "mm", 3, title)
    return on.points, *paint(on.points[..., 2], "mm", 1, "depth")


def _colour_by_deviation(
    arrays: dict[str, np.ndarray], tolerance: float | None
) -> tuple[np.ndarray, np.ndarray, Html]:
    """Colour a surface by a stored deviation: (points (n, 3) mm, colours (n, 3), legend); grey
    where not measured."""
    limit = colour_limit(arrays["signed"], tolerance)
    uncovered = arrays["uncovered"].reshape(-1, 3)
    points = np.concatenate([arrays["points"], uncovered]).astype(np.float32)
    grey = np.broadcast_to(np.array(EXCLUDED_COLOUR, np.uint8), uncovered.shape)
    return (
        points,
        np.concatenate([deviation_colours(arrays["signed"], limit), grey]),
        deviation_bar(limit),
    )
