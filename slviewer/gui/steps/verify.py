"""Verify: a plane or a sphere, measured by each model, beside what the capture's noise alone would give."""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import PLOT_PX, Painter, Plot, opened
from slviewer.gui.preview import drawn, legend, light_words
from slviewer.gui.widgets import Html, Picture, Words, block, cell, colour_bar, colours, link, table, toned
from slviewer.gui.world import Stand
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
"""Width of the live picture: here it only has to show that the plane or the sphere is in view."""
TABLE = "verifications.csv"
MUCH_MASKED = 0.2
_SIGN = {"plane": "red is towards the camera", "sphere": "red is outwards"}


class Panel:
    """The fifth step."""

    key = "verify"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._measured: tuple[str, ...] = ()
        self._cloud: result_views.ScanCloud | None = None
        self._visible = False

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Capture", visible=False) as self._capture_folder:
            self._picture = Picture(gui, "Live picture", width_px=SMALL_PX)
            self._plane = gui.add_button("Capture plane", icon=viser.Icon.SQUARE)
            self._sphere = gui.add_button("Capture sphere", icon=viser.Icon.SPHERE)
            self._label = gui.add_text("Name", "", hint="If you like; else it is numbered")
            self._stand = Stand(self._stage, LAYER, ("plane", "sphere"))
            self._plane.on_click(safely(lambda: operator.capture_plane(self._label.value)))
            self._sphere.on_click(safely(lambda: operator.capture_sphere(self._label.value)))
        with gui.add_folder("Result", visible=False) as self._result_folder:
            self._result = Choice(gui, "Result of")
            self._words = Words(gui)
            self._maps = Plot(gui)
            self._model = Choice(gui, "Colours in 3D", "By whose error the cloud is coloured")
            self._legend = Words(gui)
            self._stage.bring_button(lambda: self._cloud.points if self._cloud else None)
        with gui.add_folder("All results", visible=False) as self._table_folder:
            self._table = Words(gui)
            self._write = gui.add_button("Write table as CSV", icon=viser.Icon.TABLE_EXPORT, color="gray")
            self._write.on_click(safely(lambda: operator.export("table")))
            self._file = Words(gui)
        with gui.add_folder("Recorded captures", visible=False) as self._recorded_folder:
            self._recorded = Choice(gui, "Capture")
            self._radius = gui.add_number(
                "Sphere's radius, mm", 0.0, min=0.0, max=2000.0, hint="About; helps to find it. 0: not known"
            )
            as_plane = gui.add_button("Measure as plane", icon=viser.Icon.SQUARE, color="gray")
            as_sphere = gui.add_button("Measure as sphere", icon=viser.Icon.SPHERE, color="gray")
            as_plane.on_click(safely(lambda: self._measure([self._recorded.value], "plane")))
            as_sphere.on_click(safely(lambda: self._measure([self._recorded.value], "sphere")))
            self._all = {}
            for shape in ("plane", "sphere"):
                self._all[shape] = gui.add_button(f"Measure all {shape}s", color="gray", visible=False)
                self._all[shape].on_click(safely(lambda shape=shape: self._measure_all(shape)))  # type: ignore[misc]
        for choice in (self._result, self._model):
            choice.on_change(safely(self._refresh))

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session, ready = snapshot.session, snapshot.step(self.key).state != "blocked"
            rig = snapshot.rig
            change(self._capture_folder, visible=rig.state != "none")
            for button in (self._plane, self._sphere):
                change(button, disabled=not ready or rig.state != "open" or rig.capture is not None)
            self._stand.draw(snapshot)
            if session is None or not ready:
                for folder in (self._recorded_folder, self._result_folder, self._table_folder):
                    change(folder, visible=False)
                return
            self._draw_recorded(session)
            rows = session.verifications
            for folder in (self._result_folder, self._table_folder):
                change(folder, visible=bool(rows))
            names = tuple(dict.fromkeys(row.capture for row in rows))
            labels = {row.capture: row.label for row in rows}
            self._result.offer([(name, titled(name, labels[name])) for name in names])
            if new := [name for name in names if name not in self._measured]:
                if self._measured:  # just measured: this is what the operator wants to see
                    self._result.choose(new[-1])
                self._measured = names
            self._table.set(results_table(rows) + distances_table(session.distances))
            made = next((each for each in session.exports if each.name == TABLE), None)
            self._file.set("" if made is None else block(link(self._stage.offer(made.path), f"Download {TABLE}")))
            self._refresh()

    def draw_preview(self, preview: PreviewView) -> None:
        self._picture.set(drawn(preview), legend(preview, light_words(preview)))

    def shown(self, visible: bool) -> None:
        self._visible = visible
        self._stage.scene.show(LAYER, visible)
        self._look()

    # drawing

    def _draw_recorded(self, session: SessionView) -> None:
        measured = {row.capture for row in session.verifications if not row.stale}
        change(self._recorded_folder, visible=bool(session.scans))
        waiting = [scan for scan in session.scans if scan.name not in measured]
        done = [scan for scan in session.scans if scan.name in measured]
        self._recorded.offer(
            [(scan.name, titled(scan.name, scan.label)) for scan in waiting]
            + [(scan.name, f"{titled(scan.name, scan.label)}, measured") for scan in done]
        )
        for shape, button in self._all.items():
            found = [scan for scan in waiting if likely(scan) == shape]
            change(button, visible=bool(found), label=f"Measure all {len(found)} {shape}s")

    def _refresh(self) -> None:
        """Ask for the pictures of the chosen result."""
        with self._lock:
            session = self._snapshot.session if self._snapshot else None
            name = self._result.value
            rows = [row for row in session.verifications if row.capture == name] if session else []
            if not rows:
                return
            self._model.offer([(row.model, row.model) for row in rows], rows[-1].model)
            self._words.set(result_words(rows))
            operator, key = self._stage.operator, (name, tuple((row.model, row.rms_mm) for row in rows))
            self._painter.ask(
                "maps", key, lambda: _maps(result_views.error_maps(opened(operator), name), rows), self._maps.set
            )
            model = self._model.value
            self._painter.ask(
                "cloud",
                (key, model),
                lambda: (result_views.scan_cloud(opened(operator), name), model, rows[0].shape),
                self._draw_cloud,
            )

    def _draw_cloud(self, made: Any) -> None:
        cloud, model, shape = made
        self._cloud = cloud
        limit = error_limit(list(cloud.errors.values()))
        rows, columns = cloud.thinned(120_000)
        painted = colours(cloud.errors[model][rows, columns], -limit, limit, "error")
        shown = self._stage.scene.cloud(LAYER, "cloud", cloud.points[rows, columns], painted)
        self._stage.scene.show(LAYER, self._visible)
        said = f"error by {model}, {_SIGN[shape]}; grey: not counted; {shown:,} points drawn"
        self._legend.set(colour_bar(f"−{limit:g} mm", f"+{limit:g} mm", "error", said))
        self._look()

    def _look(self) -> None:
        if self._visible and self._cloud is not None:
            self._stage.viewpoints.at(f"{LAYER} {self._cloud.name}", self._cloud.points)

    # requests

    def _measure(self, names: Sequence[str], shape: Shape) -> None:
        radius = float(self._radius.value)
        if names and names[0]:
            self._stage.operator.verify(list(names), shape, radius if shape == "sphere" and radius > 0 else None)

    def _measure_all(self, shape: Shape) -> None:
        session = self._snapshot.session if self._snapshot else None
        if session is not None:
            measured = {row.capture for row in session.verifications if not row.stale}
            found = [scan.name for scan in session.scans if scan.name not in measured and likely(scan) == shape]
            self._measure(found, shape)


def likely(scan: ScanView) -> str:
    """What a capture shows: as it was captured for, else as the names of recorded ones say."""
    if scan.purpose != "scan":
        return scan.purpose
    return next((shape for shape in ("plane", "sphere") if scan.name.lower().startswith(shape)), "scan")


def result_words(rows: Sequence[VerificationRow]) -> Html:
    """One capture's figures: each model's RMS beside the noise floor."""
    sphere = rows[0].shape == "sphere"
    best = min(rows, key=lambda row: row.rms_mm)
    lines = []
    for row in rows:
        aside = 100 * row.set_aside / max(row.points, 1)
        line: list[object] = [
            row.model,
            toned(f"{row.rms_mm:.3f}", "good" if row is best else "plain", bold=row is best),
        ]
        line.append(_mm(row.noise_floor_mm))
        line += [_mm(row.radius_mm)] if sphere else []
        line += [toned(f"{aside:.1f} %", "warning" if aside > 2 else "plain")]
        lines.append([*line, "–" if row.coverage is None else f"{100 * row.coverage:.1f} %"])
    titles = ["Model", "RMS, mm", "noise floor, mm", *(["radius, mm"] if sphere else []), "set aside", "coverage"]
    said = table(titles, lines)
    if rows[0].incidence is not None:
        shares = ", ".join(f"{region} {share:.0f} %" for region, share in rows[0].incidence.items())
        said = Html(said + block(f"Share of the {rows[0].shape} in the depth ranges: {shares}"))
    for row in rows:
        if row.masked and row.masked > 0.0005:
            words = f"{row.model} masks {100 * row.masked:.1f} % of the {row.shape}: no target pose lit what they see."
            said = Html(said + block(toned(words, "warning" if row.masked > MUCH_MASKED else "dim")))
    if any(row.stale for row in rows):
        said = Html(said + block(toned("Measured with an older calibration: measure it again.", "warning")))
    return said


def results_table(rows: Sequence[VerificationRow]) -> str:
    """Planes, then spheres: a line a capture, a column a model, the best in bold."""
    said = ""
    for shape in ("plane", "sphere"):
        found = [row for row in rows if row.shape == shape]
        if not found:
            continue
        models = tuple(dict.fromkeys(row.model for row in found))
        lines = []
        for name in dict.fromkeys(row.capture for row in found):
            mine = {row.model: row for row in found if row.capture == name}
            first = next(iter(mine.values()))
            best = min(mine.values(), key=lambda row: row.rms_mm)
            title = toned(
                first.label + (" (older calibration)" if first.stale else ""), "warning" if first.stale else "plain"
            )
            line: list[object] = [title, _shares(first.incidence)]
            for model in models:
                row = mine.get(model)
                text = "–" if row is None else f"{row.rms_mm:.3f}"
                line.append(toned(text, "good" if row is best else "plain", bold=row is best))
            line.append(_mm(first.noise_floor_mm))
            lines.append(line)
        heads = [shape.capitalize(), "R1/R2/R3, %", *(f"{model}, mm" for model in models), "floor, mm"]
        said += table(heads, lines)
        if shape == "sphere":
            said += _radii(found, models)
    return said


def _radii(rows: Sequence[VerificationRow], models: Sequence[str]) -> str:
    """The spheres' radii by each model."""
    lines = []
    for name in dict.fromkeys(row.capture for row in rows):
        mine = {row.model: row for row in rows if row.capture == name}
        label = next(iter(mine.values())).label
        lines.append([label, *(_mm(mine[m].radius_mm if m in mine else None) for m in models)])
    return table(["Radius of the sphere, mm", *models], lines)


def distances_table(distances: Sequence[CentreDistance]) -> str:
    """How far apart the spheres' centres are by each model."""
    if not distances:
        return ""
    models = tuple(dict.fromkeys(each.model for each in distances))
    pairs: dict[tuple[str, str], dict[str, float]] = {}
    for each in distances:
        pairs.setdefault(each.captures, {})[each.model] = each.distance_mm
    lines = [
        [f"{a} – {b}", *(f"{found[model]:.3f}" if model in found else "–" for model in models)]
        for (a, b), found in pairs.items()
    ]
    return table(["Distance of the centres, mm", *models], lines)


def _maps(maps: Mapping[str, np.ndarray], rows: Sequence[VerificationRow]) -> Figure:
    rms = {row.model: row.rms_mm for row in rows}
    floors = [row.noise_floor_mm for row in rows if row.noise_floor_mm is not None]
    shown = {model: maps[model] for model in rms if model in maps}
    title = titled(rows[0].capture, rows[0].label)
    floor = floors[-1] if floors else float("nan")
    return error_maps(title, shown, rms, floor, width=PLOT_PX, sign=_SIGN[rows[0].shape])


def _mm(value: float | None, digits: int = 3) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _shares(incidence: Mapping[str, float] | None) -> Html:
    if incidence is None:
        return cell("–")
    return cell("/".join(f"{incidence.get(region, 0.0):.0f}" for region in ("R1", "R2", "R3")))
