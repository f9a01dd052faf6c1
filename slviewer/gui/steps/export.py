"""Export: what other programs can read, with its units and size, to download at one click."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import viser

from slviewer.errors import SlviewerError
from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened
from slviewer.gui.widgets import Html, Words, block, cell, link, table, toned
from slviewer.pipeline.export import FORMATS, What, file_name, foreseen_bytes, size, units
from slviewer.surface.meshing import MeshingPlan, Method
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import ExportView, SessionView, Snapshot

LAYER = "export"
LIST_PX = 250
"""Height of the list of files, so that what writes others stays in view."""
MERGED = "merged"
POINTS, MESH = "points", "mesh"
FORMAT_NAMES = {
    "ply": "PLY",
    "stl": "STL",
    "obj": "OBJ",
    "glb": "GLB",
    "xyz": "XYZ text",
    "yml": "OpenCV YAML",
    "xml": "OpenCV XML",
    "json": "JSON",
    "npz": "NumPy",
}
NUMBERS: dict[What, tuple[str, str]] = {
    "calibration": ("calibration", "Lenses of camera and projector, how they stand, and the reprojection errors"),
    "poses": ("poses", "Camera, projector, target and merged scans as 4x4 matrices"),
    "coefficients": ("each pixel's coefficients", "The rational function of every camera pixel"),
}
"""What there is beside shapes: as a choice, and what it holds."""
_QUIET = "color:var(--mantine-color-anchor);font-weight:600;text-decoration:none"
_SHAPED = {"ply", "stl", "obj", "glb", "xyz"}


METHODS: dict[Method, str] = {
    "grid": "between neighbouring pixels",
    "poisson": "fitted to all points (Poisson)",
    "volume": "mean in small cells (volume)",
}
SMALL, OPEN, SIZED, CLOSED = "fill the smallest", "leave open", "fill up to a size", "close all: watertight"
SMOOTHING = {"none": 0, "light": 5, "strong": 20}
"""Rounds of each."""


class MeshInputs:
    """The inputs of a plan, inside the folder that is open; shown where there is something to mesh."""

    def __init__(self, stage: Stage, changed: Callable[[], None]) -> None:
        gui = stage.gui
        self._method = Choice(gui, "Surface", "Between pixels shows each point; a fitted surface evens out noise")
        self._holes = gui.add_dropdown("Holes", (SMALL, OPEN, SIZED, CLOSED))
        self._size = gui.add_number("Up to, mm", 2.0, min=0.1, max=500.0, step=0.1, visible=False)
        self._thin = gui.add_number(
            "Triangles", 0, min=0, max=50_000_000, step=1000, hint="At most so many; 0: as many as there are"
        )
        self._smooth = gui.add_dropdown(
            "Smoothing", tuple(SMOOTHING), hint="Evens out noise; how far it moved the surface is told"
        )
        self._method.on_change(stage.safely(changed))
        for handle in (self._holes, self._size, self._thin, self._smooth):
            handle.on_update(stage.safely(changed))

    def draw(self, visible: bool, merged: bool) -> None:
        """Show or hide them; merged points have no pixels to lay triangles between."""
        offered = [(name, said) for name, said in METHODS.items() if not (merged and name == "grid")]
        self._method.offer(offered)
        self._method.show(visible)
        inputs: list[Any] = [self._holes, self._thin, self._smooth]
        for handle in inputs:
            change(handle, visible=visible)
        change(self._size, visible=visible and self._holes.value == SIZED)

    @property
    def triangles(self) -> int | None:
        """How many at most; None: as many as there are."""
        return max(4, round(self._thin.value)) if self._thin.value >= 1 else None

    def plan(self) -> MeshingPlan:
        """What is chosen."""
        holes = self._holes.value
        chosen = next((name for name in get_args(Method) if name == self._method.value), None)
        # pixels see one side only: a surface between them never closes
        method = None if holes == CLOSED and chosen == "grid" else chosen
        sizes = {OPEN: 0.0, SIZED: float(self._size.value)}
        return MeshingPlan(method, sizes.get(holes), self.triangles, SMOOTHING[self._smooth.value], holes == CLOSED)


class Panel:
    """The ninth step."""

    key = "export"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._snapshot: Snapshot | None = None
        self._points: np.ndarray | None = None
        self._visible = False

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Files to download"):
            self._files = Words(gui)
        with gui.add_folder("Cloud or mesh"):
            self._of = Choice(gui, "Of")
            self._as = gui.add_dropdown("As", (POINTS, MESH))
            self._mesh = MeshInputs(self._stage, self._say)
            self._shape_format = Choice(gui, "File type")
            self._shape_hint = Words(gui)
            self._shape_link = Words(gui)
            self._shape_done = Words(gui)
            self._write = gui.add_button("Write file", icon=viser.Icon.FILE_EXPORT)
            self._write.on_click(safely(self._ask_shape))
            self._stage.bring_button(lambda: self._points)
        with gui.add_folder("Calibration and poses"):
            self._numbers = Choice(gui, "What")
            self._number_format = Choice(gui, "Format")
            self._number_hint = Words(gui)
            self._number_link = Words(gui)
            self._write_numbers = gui.add_button("Write calibration", icon=viser.Icon.FILE_EXPORT)
            self._write_numbers.on_click(safely(self._ask_numbers))
        with gui.add_folder("Report and more"):
            self._report = gui.add_button("Write report", icon=viser.Icon.REPORT)
            self._report.on_click(safely(lambda: operator.report()))
            self._table = gui.add_button("Write table of verifications", icon=viser.Icon.TABLE_EXPORT, color="gray")
            self._table.on_click(safely(lambda: operator.export("table")))
            bundle = gui.add_button(
                "Collect diagnostics",
                icon=viser.Icon.STETHOSCOPE,
                color="gray",
                hint="Versions, settings, logs and small pictures, to send when asking for help; no frames",
            )
            bundle.on_click(safely(lambda: operator.diagnostic_bundle()))
        self._as.on_update(safely(self._say))
        for choice in (self._of, self._shape_format, self._numbers, self._number_format):
            choice.on_change(safely(self._say))

    def draw(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        session = snapshot.session
        busy = snapshot.job is not None and not snapshot.job.background
        ready = session is not None and snapshot.step(self.key).state != "blocked"
        self._files.set(self._listed(session))
        if session is None:
            return
        things = [(MERGED, "the merged scans")] if session.merge else []
        things += [(scan.name, titled(scan.name, scan.label)) for scan in session.scans if scan.cloud != "absent"]
        self._of.offer(things)
        models = session.calibration.models if session.calibration else ()
        coefficients = bool({"pixelwise", "splined"} & set(models))
        self._numbers.offer([(k, said) for k, (said, _) in NUMBERS.items() if k != "coefficients" or coefficients])
        refused = session.calibration is not None and bool(session.calibration.refused)
        change(self._report, disabled=busy or not ready)
        change(self._write_numbers, disabled=busy or not ready or refused)
        change(self._write, disabled=busy or not things or refused)
        change(self._table, disabled=busy or not session.verifications)
        self._say()

    def shown(self, visible: bool) -> None:
        self._visible = visible
        self._stage.scene.show(LAYER, visible)
        self._show_closely()

    # what would be written

    def _shape(self) -> tuple[What, str]:
        """What is chosen, and its name; empty where there is nothing to choose."""
        name, mesh, session = self._of.value, self._as.value == MESH, self._snapshot and self._snapshot.session
        if name == MERGED:
            return "merged-mesh" if mesh else "merge", session.merge.name if session and session.merge else ""
        return "mesh" if mesh else "cloud", name

    def _say(self) -> None:
        """What the files will be, whether they are there already, and how the shape looks."""
        session = self._snapshot.session if self._snapshot else None
        if session is None:
            return
        self._look(session)
        what, name = self._shape()
        mesh = what in ("mesh", "merged-mesh")
        self._mesh.draw(mesh and bool(name), what == "merged-mesh")
        self._shape_format.offer([(each, FORMAT_NAMES[each]) for each in FORMATS[what]])
        if name:
            chosen = self._shape_format.value
            made = _made(session, file_name(what, name, chosen))
            foreseen = foreseen_bytes(what, chosen, *_points(session, name), self._mesh.triangles if mesh else None)
            seen: What = "merged-mesh" if mesh and self._mesh.plan().method != "grid" else what
            self._shape_hint.say(shape_words(session, seen, name, chosen, None if made else foreseen), "dim")
            self._shape_link.set(self._offered(made))
            self._shape_done.say(self._done(made) if made and mesh else "", "dim")
            kept = made is not None and what == "merge" and chosen == "ply"  # the merge's own file
            change(self._write, visible=not kept, label="Write again" if made else "Write file", color=_tone(made))
        else:
            self._shape_hint.say("Nothing is reconstructed yet: scan an object first.", "warning")
            self._shape_link.set("")
            self._shape_done.say("")
        numbers: What = self._numbers.value or "calibration"  # type: ignore[assignment]
        self._number_format.offer([(each, FORMAT_NAMES[each]) for each in FORMATS[numbers]])
        chosen = self._number_format.value
        self._number_hint.say(f"{NUMBERS[numbers][1]}. {units(chosen)}.", "dim")
        made = _made(session, file_name(numbers, "", chosen))
        self._number_link.set(self._offered(made))
        label = f"Write {numbers} again" if made else f"Write {numbers}"
        change(self._write_numbers, label=label, color=_tone(made))

    def _look(self, session: SessionView) -> None:
        """Show in 3D what would be written."""
        name, merge, operator = self._of.value, session.merge.name if session.merge else "", self._stage.operator
        if not name:
            self._painter.forget("cloud")
            self._stage.scene.clear(LAYER)
            return
        clouds = {scan.name: (scan.points, scan.model) for scan in session.scans}

        def load() -> tuple[np.ndarray, np.ndarray | None]:
            if name == MERGED:
                whole = result_views.merged_cloud(opened(operator), merge)
                return whole.points, whole.colours
            cloud = result_views.scan_cloud(opened(operator), name)
            rows, columns = cloud.thinned(120_000)
            return cloud.points[rows, columns], cloud.texture[rows, columns]

        key: Any = merge if name == MERGED else clouds.get(name)
        self._painter.ask("cloud", (name, key), load, self._draw_cloud)

    def _draw_cloud(self, made: tuple[np.ndarray, np.ndarray | None]) -> None:
        points, colours = made
        if colours is not None and colours.shape != points.shape:  # grey
            colours = np.repeat(colours[..., None], 3, axis=-1)
        self._points = points
        self._stage.scene.cloud(LAYER, "cloud", points, (150, 150, 150) if colours is None else colours)
        self._stage.scene.show(LAYER, self._visible)
        self._show_closely()

    def _show_closely(self) -> None:
        if self._visible:
            self._stage.viewpoints.at(f"{LAYER} {self._of.value}", self._points)

    # requests

    def _ask_shape(self) -> None:
        what, name = self._shape()
        if name:
            plan = self._mesh.plan() if what in ("mesh", "merged-mesh") else None
            self._stage.operator.export(what, name, self._shape_format.value, plan)

    def _ask_numbers(self) -> None:
        self._stage.operator.export(self._numbers.value, "", self._number_format.value)

    # files

    def _listed(self, session: SessionView | None) -> Html:
        exports = session.exports if session else ()
        if not exports:
            return block(toned("Nothing yet: write something below.", "dim"))
        rows = [
            (
                Html(f'<span style="overflow-wrap:anywhere">{cell(export.name)}</span>'),
                Html(f'<span style="white-space:nowrap">{size(export.bytes)}</span>'),
                self._link(export, "Download", quiet=True),
            )
            for export in sorted(exports, key=_rank)
        ]
        return Html(f'<div style="max-height:{LIST_PX}px;overflow-y:auto">{table(("File", "size", ""), rows)}</div>')

    def _done(self, export: ExportView) -> str:
        """What was done to make this file, as it was told when it was; empty where that is long ago."""
        notices = reversed(self._snapshot.notices if self._snapshot else ())
        said = next((each.text for each in notices if each.text.startswith(f"{export.name} is ready")), "")
        return said.partition(": ")[2]

    def _offered(self, export: ExportView | None) -> str:
        """A link to what was written already; empty where it was not."""
        return "" if export is None else block(self._link(export, f"Download {export.name}, {size(export.bytes)}"))

    def _link(self, export: ExportView, words: str, quiet: bool = False) -> Html:
        try:
            address = self._stage.offer(export.path)
            return (
                Html(f'<a href="{cell(address)}" download style="{_QUIET}">{words}</a>')
                if quiet
                else link(address, words)
            )
        except SlviewerError:  # taken away since the snapshot was made: the next one will not list it
            return cell("")


def shape_words(session: SessionView, what: What, name: str, file_format: str, foreseen: int | None) -> str:
    """What a file of a scan or a merge will be: how it is made, its units, and about how large, where that is known."""
    points, _ = _points(session, name)
    made = {
        "cloud": f"Every measured point, {points:,}",
        "merge": f"The {points:,} merged points",
        "mesh": "Triangles between neighbouring pixels; depth jumps stay open",
        "merged-mesh": "One surface through the points, cut off where nothing was measured",
    }[what]
    return f"{made}. In {units(file_format)}.{'' if foreseen is None else f' About {size(foreseen)}.'}"


def _points(session: SessionView, name: str) -> tuple[int, str]:
    """How many points a scan or the merge has, and a scan's model."""
    scan = next((each for each in session.scans if each.name == name), None)
    if scan is not None:
        return scan.points, scan.model
    return session.merge.points if session.merge else 0, ""


def _made(session: SessionView, name: str) -> ExportView | None:
    return next((export for export in session.exports if export.name == name), None)


def _tone(made: ExportView | None) -> Literal["gray"] | None:
    """Of a button that writes: what is there already is rather downloaded."""
    return None if made is None else "gray"


def _rank(export: ExportView) -> tuple[int, str]:
    """What was wanted most stands first: merged clouds, other shapes, documents."""
    shaped = Path(export.name).suffix.removeprefix(".").lower() in _SHAPED
    return (0 if export.name.startswith("merged") else 1 if shaped else 2, export.name)
