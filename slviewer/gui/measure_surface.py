"""The surface that is measured on: chosen, drawn in 3D, and asked where it was clicked."""

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np

from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.measure_words import deviation_bar
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened, spread
from slviewer.gui.steps.scan import ordered
from slviewer.gui.widgets import Html, Words, colour_bar, colours
from slviewer.inspection.colours import LEFT_OUT, colour_limit, deviation_colours
from slviewer.pipeline.measured_surface import MERGED, MeasuredSurface, Place
from slviewer.session.measurements import Measurement, measurement_arrays
from slviewer.wizard.snapshot import SessionView
from slviewer.wizard.surfaces import place_at

COLOURS = ("texture", "depth", "uncertainty")
DEVIATION = "deviation"
SHOWN = 150_000


class SurfaceBox:
    """What is measured on; ``loaded()`` is called once another one is there, on the painter's thread."""

    def __init__(self, stage: Stage, painter: Painter, layer: str, loaded: Callable[[], None]) -> None:
        self._stage, self._painter, self._layer, self._loaded = stage, painter, layer, loaded
        self._clicks = count()
        self._deviation: Measurement | None = None
        self._versions: dict[str, Any] = {}
        self._visible = False
        self.on: MeasuredSurface | None = None

    def build(self) -> None:
        """The inputs."""
        gui, safely = self._stage.gui, self._stage.safely
        self._choice = Choice(gui, "Measure on")
        self._choice.on_change(safely(self.ask))
        self._colour = gui.add_dropdown("Colour by", COLOURS)
        self._colour.on_update(safely(self.ask))
        self._legend = Words(gui)
        self._stage.bring_button(lambda: None if self.on is None else self.on.points)

    @property
    def name(self) -> str:
        """The scan or the merge that was chosen; empty where there is none."""
        return self._choice.value

    def choose(self, name: str) -> None:
        """Measure on this one, if it can be."""
        self._choice.choose(name)

    def offer(self, session: SessionView | None) -> None:
        """Offer what can be measured on now, and draw what is chosen."""
        scans = [scan for scan in ordered(session.scans) if scan.cloud == "fresh"] if session else []
        offered = [(scan.name, titled(scan.name, scan.label)) for scan in scans]
        where = session.folder if session else None
        self._versions = {s.name: (where, s.model, s.points, s.noise_mm, s.scale) for s in scans}
        merge = session.merge if session else None
        if merge is not None and not merge.stale:
            name = f"{MERGED}{merge.name}"
            offered.append((name, f"Merge of {len(merge.scans)} scans"))
            self._versions[name] = (where, merge.points)
        self._choice.offer(offered)
        self.ask()

    def deviate(self, measured: Measurement | None) -> None:
        """Offer to colour by this deviation, and do so; None: offer it no longer."""
        self._deviation = measured
        if measured is not None:
            change(self._colour, options=(*COLOURS, DEVIATION))
            change(self._colour, value=DEVIATION)
        elif DEVIATION in self._colour.options:
            kept = COLOURS[0] if self._colour.value == DEVIATION else self._colour.value
            self._colour.options = COLOURS
            change(self._colour, value=kept)
        self.ask()

    def show(self, visible: bool) -> None:
        """The panel is shown, or hidden."""
        self._visible = visible
        self._stage.scene.show(self._layer, visible)
        self._look()

    def clicked(self, origin: np.ndarray, direction: np.ndarray, do: Callable[[Place], None]) -> None:
        """Call ``do(place)`` soon with what a ray meets; nothing happens where it passes the surface by."""
        on, wish = self.on, f"click {next(self._clicks)}"
        if on is None:
            return

        def found(place: Place | None) -> None:
            self._painter.forget(wish)
            if place is not None and on is self.on:
                do(place)

        self._painter.ask(wish, None, lambda: place_at(on, origin, direction), found)

    def ask(self) -> None:
        """Ask for what is chosen, in the colours that are."""
        name, colour, shown = self.name, self._colour.value, self._deviation
        if not name:
            self.on = None
            self._painter.forget("surface")
            self._stage.scene.remove(self._layer, "surface")
            self._legend.set("")
            return
        if shown is not None and (shown.source != name or colour != DEVIATION):
            shown = None
        key = (name, self._versions.get(name), colour if shown is None else shown.id)
        operator = self._stage.operator

        def make() -> tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]:
            on = operator.surface(name)
            if shown is None:
                return (on, *painting(on, COLOURS[0] if colour == DEVIATION else colour))
            arrays = measurement_arrays(opened(operator), shown.id)
            return (on, *_deviating(arrays, shown))

        self._painter.ask("surface", key, make, self._draw)

    def _draw(self, made: tuple[MeasuredSurface, np.ndarray, np.ndarray, Html]) -> None:
        on, points, painted, bar = made
        fresh = on is not self.on
        self.on = on
        self._stage.scene.cloud(self._layer, "surface", points, painted)
        self._stage.scene.show(self._layer, self._visible)
        self._legend.set(bar)
        if fresh:
            self._loaded()
        self._look()

    def _look(self) -> None:
        if self._visible and self.on is not None:
            self._stage.viewpoints.at(f"{self._layer} {self.on.source}", self.on.points)


def painting(on: MeasuredSurface, colour: str) -> tuple[np.ndarray, np.ndarray, Html]:
    """(points (..., 3), their colours likewise, the legend) of a surface in one of COLOURS, thinned to be drawn."""
    step = 1
    if on.organised:  # row by row, so that what is drawn has no stripes
        step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(on.measured) / SHOWN))))
    part = (slice(None, None, step),) * (2 if on.organised else 1)
    points = on.points[part]
    if colour == "texture" and on.texture is not None:
        texture = on.texture[part]
        return points, texture if texture.ndim == points.ndim else np.repeat(texture[..., None], 3, axis=-1), Html("")
    if colour == "uncertainty":
        sigma = on.sigma_mm if on.left_mm is None else np.hypot(on.sigma_mm, on.left_mm)
        sigma = np.where(on.measured, sigma, np.nan)
        low, high = spread(sigma)
        said = "uncertainty of z (1 sigma)" if on.organised else "uncertainty along the normal (1 sigma)"
        said += "" if on.left_mm is not None else ", of noise alone"
        return points, colours(sigma[part], low, high), colour_bar(f"{low:.3f} mm", f"{high:.3f} mm", "value", said)
    low, high = spread(on.points[..., 2])
    bar = colour_bar(f"{low:.1f} mm", f"{high:.1f} mm", "value", "depth")
    return points, colours(points[..., 2], low, high), bar


def _deviating(arrays: dict[str, np.ndarray], measured: Measurement) -> tuple[np.ndarray, np.ndarray, Html]:
    """The same of a kept deviation; what of the nominal was not measured in grey."""
    verdict = measured.data["verdict"]
    limit = colour_limit(arrays["signed"], None if verdict is None else float(verdict["tolerance_mm"]))
    uncovered = arrays["uncovered"].reshape(-1, 3)
    points = np.concatenate([arrays["points"], uncovered]).astype(np.float32)
    grey = np.broadcast_to(np.array(LEFT_OUT, np.uint8), uncovered.shape)
    return points, np.concatenate([deviation_colours(arrays["signed"], limit), grey]), deviation_bar(limit)
