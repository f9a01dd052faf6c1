"""The surface to measure on: chosen, drawn in 3D, and picked on."""

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

from slviewer.gui.panel import Choice, PanelPart, StepPanel, scan_options
from slviewer.gui.scene import Click
from slviewer.gui.steps.scan import sort_scans
from slviewer.gui.widgets import Html, Text, colour_bar, paint
from slviewer.inspection.deviation import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.pipeline.measured_surface import MERGED, MeasuredSurface, Place
from slviewer.pipeline.stored_records import Stored, load_arrays
from slviewer.records.measurement import Measurement
from slviewer.wizard.result_views import place_at
from slviewer.wizard.snapshot import SessionView

COLOURS = ("texture", "depth", "uncertainty")
DEVIATION = "deviation"


class SurfaceView(PanelPart):
    """View of the chosen surface; ``loaded()`` is called once another one is shown, on the
    painter's thread."""

    def __init__(self, panel: StepPanel, loaded: Callable[[], None]) -> None:
        super().__init__(panel)
        self._panel, self._loaded = panel, loaded
        self._clicks = count()
        self._deviation: Stored[Measurement] | None = None
        self._versions: dict[str, Any] = {}
        self.on: MeasuredSurface | None = None
        self.choice = Choice(self._context, "Surface", self.request)
        self._colour: Any = self._gui.add_dropdown("Colour", COLOURS)
        self._context.on_change(self.request, self._colour)
        self._legend = Text(self._gui)
        self._context.view_button(panel.get_points)

    @property
    def name(self) -> str:
        """The chosen scan or merge; empty where there is none."""
        return self.choice.value

    def offer(self, session: SessionView) -> None:
        """Offer the surfaces that can be measured on, and draw the chosen one."""
        scans = [scan for scan in sort_scans(session.scans) if scan.cloud == "fresh"]
        offered = scan_options(scans)
        self._versions = {
            scan.name: (session.folder, scan.figures, *session.restriction(scan.name))
            for scan in scans
        }
        merge = session.merge
        if merge is not None and not merge.stale:
            name = f"{MERGED}{merge.name}"
            offered.append((name, f"Merge of {len(merge.record.scans)} scans"))
            self._versions[name] = (session.folder, merge.record.points)
        self.choice.offer(offered)
        self.request()

    def show_deviation(self, measured: Stored[Measurement] | None) -> None:
        """Colour the surface by this deviation; None: by another quantity."""
        self._deviation = measured
        options = COLOURS if measured is None else (*COLOURS, DEVIATION)
        if self._colour.options != options:
            self._colour.options = options  # a colour that is no longer offered becomes the first
        if measured is not None:
            self._colour.value = DEVIATION
        self.request()

    def pick(self, click: Click, do: Callable[[Place], None]) -> None:
        """Call ``do(place)`` later with the point that a click meets; not called where it misses
        the surface."""
        on, slot = self.on, f"click {next(self._clicks)}"
        if on is None:
            return

        def picked(place: Place | None) -> None:
            """Pass the place on, unless the ray has missed or another surface is shown by now."""
            self._painter.cancel(slot)
            if place is not None and on is self.on:
                do(place)

        self._painter.request(
            slot, None, lambda: place_at(on, click.origin, click.direction), picked
        )

    def request(self) -> None:
        """Request the chosen surface in the chosen colours."""
        name, colour, shown = self.name, self._colour.value, self._deviation
        if not name:
            self.on = None
            self._painter.cancel("surface")
            self._layer.remove("surface")
            self._legend.set("")
            return
        if shown is not None and (shown.record.source != name or colour != DEVIATION):
            shown = None
        key = (name, self._versions.get(name), colour if shown is None else shown.name)

        def make() -> tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]:
            """Load the surface; returns (surface, points, colours, legend)."""
            on = self._operator.surface(name)
            if shown is None:
                return (on, *paint_surface(on, COLOURS[0] if colour == DEVIATION else colour))
            assert shown.record.deviation is not None
            arrays = load_arrays(self._context.session, f"{Measurement.kind}/{shown.name}")
            return (on, *_colour_by_deviation(arrays, shown.record.deviation.tolerance_mm))

        self._painter.request("surface", key, make, self._draw_surface)

    def _draw_surface(self, made: tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]) -> None:
        """Draw the loaded surface and its legend; report a new one."""
        on, points, painted, bar = made
        is_new = on is not self.on
        self.on = on
        self._layer.cloud("surface", points, painted)
        self._legend.set(bar)
        if is_new:
            self._loaded()
        self._panel.show_points(on.source, on.points)


def paint_surface(on: MeasuredSurface, colour: str) -> tuple[np.ndarray, np.ndarray, Html]:
    """Colour a surface by one of COLOURS: (points (..., 3), their colours (..., 3), the legend)."""
    if colour == "texture" and on.texture is not None:
        return on.points, on.texture, Html("")
    if colour == "uncertainty":
        sigma = on.sigma_mm if on.left_mm is None else np.hypot(on.sigma_mm, on.left_mm)
        what = "uncertainty of z" if on.organised else "uncertainty along the normal"
        title = f"{what} (1 sigma){'' if on.left_mm is not None else ', noise only'}"
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
    title = "deviation; red: outside, blue: inside, grey: not measured"
    scale = deviation_colours(np.linspace(-1, 1, 13), 1.0)
    legend = colour_bar(f"−{limit:.3g} mm", f"+{limit:.3g} mm", scale, title)
    return points, np.concatenate([deviation_colours(arrays["signed"], limit), grey]), legend
