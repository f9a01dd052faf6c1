"""Step 5: measure a plane or a sphere by each model, and compare with the noise floor of the capture."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change, display_name
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.pictures import PLOT_PX, Plot
from slviewer.gui.preview import draw_preview, exposure_html, legend
from slviewer.gui.simulated_object import SimulatedObject
from slviewer.gui.widgets import Html, Picture, Text, colour_bar, coloured, colours, link, paragraph, table, to_html
from slviewer.pipeline.verify import Shape
from slviewer.report.maps import error_limit, error_maps
from slviewer.report.page import Figure
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import (
    CentreDistance,
    PreviewView,
    ScanView,
    SessionView,
    Snapshot,
    VerificationRow,
)

LAYER = "verify"
SMALL_PX = 300
"""Width of the live image: it only shows whether the plane or the sphere is in view."""
TABLE = "verifications.csv"
MUCH_MASKED, MANY_OUTLIERS = 0.2, 0.02
"""Shares of a shape or scan that are reported as a warning."""
_SIGN = {"plane": "red is towards the camera", "sphere": "red is outwards"}


class Panel(StepPanel):
    """Verification."""

    key = "verify"
    layers = (LAYER,)

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        self._measured: tuple[str, ...] = ()
        self._cloud: result_views.ScanCloud | None = None

    def build(self) -> None:
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Capture", visible=False) as self._capture_folder:
            self._picture = Picture(gui, "Live image", width_px=SMALL_PX)
            self._plane = context.button(
                "Capture plane", lambda: operator.capture_plane(self._label.value), viser.Icon.SQUARE, None
            )
            self._sphere = context.button(
                "Capture sphere", lambda: operator.capture_sphere(self._label.value), viser.Icon.SPHERE, None
            )
            self._label = gui.add_text("Name", "", hint="Optional; numbered by default")
            self._simulated = SimulatedObject(context, LAYER, ("plane", "sphere"))
        with gui.add_folder("Result", visible=False) as self._result_folder:
            self._result = Choice(gui, "Result")
            self._figures = Text(gui)
            self._maps = Plot(gui)
            self._model = Choice(gui, "3D colours", "The model whose errors colour the cloud")
            self._legend = Text(gui)
            context.view_button(lambda: self._cloud.points if self._cloud else None)
        with gui.add_folder("All results", visible=False) as self._table_folder:
            self._table = Text(gui)
            context.button("Write CSV", lambda: operator.export("table"), viser.Icon.TABLE_EXPORT)
            self._file = Text(gui)
        with gui.add_folder("Recorded captures", visible=False) as self._recorded_folder:
            self._recorded = Choice(gui, "Capture")
            hint = "Approximate radius of a sphere, to detect it; 0: unknown"
            self._radius = gui.add_number("Radius, mm", 0.0, min=0.0, max=2000.0, hint=hint)
            shapes: tuple[tuple[Shape, Any], ...] = (("plane", viser.Icon.SQUARE), ("sphere", viser.Icon.SPHERE))
            self._all: dict[Shape, viser.GuiButtonHandle] = {}
            for shape, icon in shapes:
                measure = lambda shape=shape: self._measure([self._recorded.value], shape)  # noqa: E731
                context.button(f"Measure {shape}", measure, icon)
            for shape, icon in shapes:
                measure_all = lambda shape=shape: self._measure_all(shape)  # noqa: E731
                self._all[shape] = context.button(f"Measure all {shape}s", measure_all, icon, visible=False)
        for choice in (self._result, self._model):
            choice.on_change(context.callback(self._refresh))

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session, ready = snapshot.session, snapshot.step(self.key).state != "blocked"
            rig = snapshot.rig
            change(self._capture_folder, visible=rig.state != "none")
            for button in (self._plane, self._sphere):
                change(button, disabled=not ready or rig.state != "open" or rig.capture is not None)
            self._simulated.draw(snapshot)
            if session is None or not ready:
                for folder in (self._recorded_folder, self._result_folder, self._table_folder):
                    change(folder, visible=False)
                return
            self._draw_recorded(session)
            rows = session.verifications
            for folder in (self._result_folder, self._table_folder):
                change(folder, visible=bool(rows))
            labels = {row.capture: row.label for row in rows}
            self._result.offer([(name, display_name(name, label)) for name, label in labels.items()])
            if new := [name for name in labels if name not in self._measured]:
                if self._measured:  # show what was just measured
                    self._result.choose(new[-1])
                self._measured = tuple(labels)
            self._table.set(results_table(rows) + distances_table(session.distances))
            file = next((each for each in session.exports if each.name == TABLE), None)
            self._file.set("" if file is None else paragraph(link(self._context.offer(file.path), f"Download {TABLE}")))
            self._refresh()

    def draw_preview(self, preview: PreviewView) -> None:
        self._picture.set(draw_preview(preview), legend(preview, exposure_html(preview)))

    def show(self, visible: bool) -> None:
        super().show(visible)
        self._show_view()

    # drawing

    def _draw_recorded(self, session: SessionView) -> None:
        waiting = _not_measured(session)
        names = {scan.name for scan in waiting}
        change(self._recorded_folder, visible=bool(session.scans))
        self._recorded.offer(
            [(scan.name, display_name(scan.name, scan.label)) for scan in waiting]
            + [
                (scan.name, f"{display_name(scan.name, scan.label)}, measured")
                for scan in session.scans
                if scan.name not in names
            ]
        )
        for shape, button in self._all.items():
            n = sum(shape_of(scan) == shape for scan in waiting)
            change(button, visible=n > 0, label=f"Measure all {n} {shape}s")

    def _refresh(self) -> None:
        """Request the pictures of the chosen result."""
        with self._lock:
            session = self._snapshot.session if self._snapshot else None
            name = self._result.value
            rows = [row for row in session.verifications if row.capture == name] if session else []
            if not rows:
                return
            self._model.offer([(row.model, row.model) for row in rows], rows[-1].model)
            self._figures.set(verification_html(rows))
            context, key = self._context, (name, tuple((row.model, row.rms_mm) for row in rows))
            self._painter.request(
                "maps", key, lambda: _maps(result_views.error_maps(context.session, name), rows), self._maps.set
            )
            model = self._model.value
            self._painter.request(
                "cloud",
                (key, model),
                lambda: (result_views.scan_cloud(context.session, name), model, rows[0].shape),
                self._draw_cloud,
            )

    def _draw_cloud(self, made: tuple[result_views.ScanCloud, str, Shape]) -> None:
        self._cloud, model, shape = cloud, *_ = made
        limit = error_limit(list(cloud.errors.values()))
        self._scene.cloud(LAYER, "cloud", cloud.points, colours(cloud.errors[model], -limit, limit, "error"))
        self._scene.show(LAYER, self._visible)
        title = f"error of {model}; {_SIGN[shape]}; grey: not evaluated"
        self._legend.set(colour_bar(f"−{limit:g} mm", f"+{limit:g} mm", "error", title))
        self._show_view()

    def _show_view(self) -> None:
        if self._visible and self._cloud is not None:
            self._context.viewpoints.show(f"{LAYER} {self._cloud.name}", self._cloud.points)

    # requests

    def _measure(self, names: Sequence[str], shape: Shape) -> None:
        radius = float(self._radius.value)
        if names and names[0]:
            self._operator.verify(list(names), shape, radius if shape == "sphere" and radius > 0 else None)

    def _measure_all(self, shape: Shape) -> None:
        session = self._snapshot.session if self._snapshot else None
        if session is not None:
            self._measure([scan.name for scan in _not_measured(session) if shape_of(scan) == shape], shape)


def _not_measured(session: SessionView) -> list[ScanView]:
    """Captures without an up-to-date verification."""
    measured = {row.capture for row in session.verifications if not row.stale}
    return [scan for scan in session.scans if scan.name not in measured]


def shape_of(scan: ScanView) -> str:
    """ "plane", "sphere" or "scan": the purpose of a capture, or what the name of a recorded one suggests."""
    if scan.purpose != "scan":
        return scan.purpose
    return next((shape for shape in ("plane", "sphere") if scan.name.lower().startswith(shape)), "scan")


def verification_html(rows: Sequence[VerificationRow]) -> Html:
    """One capture's figures: each model's RMS beside the noise floor."""
    sphere = rows[0].shape == "sphere"
    best = min(rows, key=lambda row: row.rms_mm)
    lines: list[list[object]] = []
    for row in rows:
        outliers = row.set_aside / max(row.points, 1)
        lines.append(
            [
                row.model,
                coloured(f"{row.rms_mm:.3f}", "good" if row is best else "plain", bold=row is best),
                _mm(row.noise_floor_mm),
                *([_mm(row.radius_mm)] if sphere else []),
                coloured(f"{100 * outliers:.1f}", "warning" if outliers > MANY_OUTLIERS else "plain"),
                "–" if row.coverage is None else f"{100 * row.coverage:.1f}",
            ]
        )
    titles = ["Model", "RMS, mm", "Noise floor, mm", *(["Radius, mm"] if sphere else []), "Outliers, %", "Coverage, %"]
    html = table(titles, lines)
    if rows[0].incidence is not None:
        shares = ", ".join(f"{region} {share:.0f} %" for region, share in rows[0].incidence.items())
        html += paragraph(f"Depth ranges: {shares}")
    for row in rows:
        if row.masked and row.masked > 0.0005:
            text = f"{row.model}: {100 * row.masked:.1f} % masked, outside the calibrated region."
            html += paragraph(coloured(text, "warning" if row.masked > MUCH_MASKED else "dim"))
    if any(row.stale for row in rows):
        html += paragraph(coloured("Measured with an older calibration: measure it again.", "warning"))
    return Html(html)


def results_table(rows: Sequence[VerificationRow]) -> str:
    """Planes, then spheres: one line per capture, one column per model, the best in bold."""
    html = ""
    for shape in ("plane", "sphere"):
        of_shape = [row for row in rows if row.shape == shape]
        if not of_shape:
            continue
        models = tuple(dict.fromkeys(row.model for row in of_shape))
        by_capture: dict[str, dict[str, VerificationRow]] = {}
        for row in of_shape:
            by_capture.setdefault(row.capture, {})[row.model] = row
        lines: list[list[object]] = []
        for results in by_capture.values():
            first, best = next(iter(results.values())), min(results.values(), key=lambda row: row.rms_mm)
            title = coloured(first.label + " (stale)" * first.stale, "warning" if first.stale else "plain")
            cells = [
                coloured(_mm(row.rms_mm if row else None), "good" if row is best else "plain", bold=row is best)
                for row in map(results.get, models)
            ]
            lines.append([title, _shares(first.incidence), *cells, _mm(first.noise_floor_mm)])
        html += table([f"{shape.capitalize()} RMS, mm", "R1/R2/R3, %", *models, "Noise floor"], lines)
        if shape == "sphere":
            radii = [
                [
                    next(iter(results.values())).label,
                    *(_mm(row.radius_mm if row else None) for row in map(results.get, models)),
                ]
                for results in by_capture.values()
            ]
            html += table(["Radius, mm", *models], radii)
    return html


def distances_table(distances: Sequence[CentreDistance]) -> str:
    """The distances of the spheres' centres by each model."""
    if not distances:
        return ""
    models = tuple(dict.fromkeys(each.model for each in distances))
    pairs: dict[tuple[str, str], dict[str, float]] = {}
    for each in distances:
        pairs.setdefault(each.captures, {})[each.model] = each.distance_mm
    lines = [[f"{a} – {b}", *(_mm(by_model.get(model)) for model in models)] for (a, b), by_model in pairs.items()]
    return table(["Centre distance, mm", *models], lines)


def _maps(maps: Mapping[str, np.ndarray], rows: Sequence[VerificationRow]) -> Figure:
    rms = {row.model: row.rms_mm for row in rows}
    floors = [row.noise_floor_mm for row in rows if row.noise_floor_mm is not None]
    shown = {model: maps[model] for model in rms if model in maps}
    title = display_name(rows[0].capture, rows[0].label)
    floor = floors[-1] if floors else float("nan")
    return error_maps(title, shown, rms, floor, width=PLOT_PX, sign=_SIGN[rows[0].shape])


def _mm(value: float | None) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.3f}"


def _shares(incidence: Mapping[str, float] | None) -> Html:
    if incidence is None:
        return to_html("–")
    return to_html("/".join(f"{incidence.get(region, 0.0):.0f}" for region in ("R1", "R2", "R3")))
