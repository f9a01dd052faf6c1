"""Export: what other programs can read, with its size, at one click."""

from pathlib import Path
from typing import Any

import numpy as np
import viser

from slviewer.errors import SlviewerError
from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened
from slviewer.gui.views import bring_button
from slviewer.gui.widgets import Html, Words, block, cell, link, table, toned
from slviewer.workflow.wizard import looking
from slviewer.workflow.wizard.snapshot import ExportView, SessionView, Snapshot

LAYER = "export"
LIST_PX = 330
"""Height of the list of files, so that what writes others stays in view."""
MERGED = "merged"
CLOUD, MESH = "points, PLY", "mesh, "
SHAPES = (CLOUD, *(f"{MESH}{kind}" for kind in ("PLY", "STL", "OBJ", "GLB")))
CALIBRATIONS = {"OpenCV YAML": "yml", "OpenCV XML": "xml", "JSON": "json"}
_SHAPED = {"ply", "stl", "obj", "glb"}


class Panel:
    """The eighth step."""

    key = "export"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._merge = ""
        self._made: tuple[str, ...] = ()
        self._clouds: dict[str, Any] = {}
        self._points: np.ndarray | None = None
        self._visible = False

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Files to download"):
            self._files = Words(gui)
        with gui.add_folder("Cloud or mesh") as self._shape_folder:
            self._what = Choice(gui, "Of")
            self._shape = gui.add_dropdown("As", SHAPES)
            bring_button(self._stage, lambda: self._points)
            self._hint = Words(gui)
            self._write = gui.add_button("Write file", icon=viser.Icon.FILE_EXPORT)
            self._write.on_click(safely(self._ask_shape))
        with gui.add_folder("Calibration"):
            self._format = gui.add_dropdown("For", tuple(CALIBRATIONS))
            self._calibration = gui.add_button("Write calibration", icon=viser.Icon.FILE_EXPORT)
            self._calibration.on_click(
                safely(lambda: operator.export("calibration", "", CALIBRATIONS[self._format.value]))
            )
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
        self._shape.on_update(safely(self._say))
        self._what.on_change(safely(self._say))

    def draw(self, snapshot: Snapshot) -> None:
        session = snapshot.session
        ready = session is not None and snapshot.step(self.key).state != "blocked"
        busy = snapshot.job is not None and not snapshot.job.background
        self._files.set(self._listed(session))
        if session is None:
            return
        self._merge = session.merge.name if session.merge else ""
        things = [(MERGED, "the merged scans")] if session.merge else []
        things += [(scan.name, titled(scan.name, scan.label)) for scan in session.scans if scan.cloud != "absent"]
        self._what.offer(things)
        self._made = tuple(export.name for export in session.exports)
        self._clouds = {scan.name: (scan.points, scan.model) for scan in session.scans}
        refused = session.calibration is not None and bool(session.calibration.refused)
        change(self._report, disabled=busy or not ready)
        change(self._calibration, disabled=busy or not ready or refused)
        change(self._write, disabled=busy or not things)
        change(self._table, disabled=busy or not session.verifications)
        self._say()

    def shown(self, visible: bool) -> None:
        self._visible = visible
        self._stage.scene.show(LAYER, visible)
        self._show_closely()

    def _say(self) -> None:
        """What the file will be, whether it is there already, and how it looks."""
        self._look()
        merged_points = self._what.value == MERGED and self._shape.value == CLOUD
        there = merged_points and f"merged_{self._merge}.ply" in self._made
        change(self._write, visible=not there)
        if not self._what.value:
            self._hint.say("Nothing is reconstructed yet: scan an object first.", "warning")
        elif there:
            self._hint.say(f"merged_{self._merge}.ply is above, with colours and normals.", "good")
        elif self._what.value == MERGED and self._shape.value != CLOUD:
            self._hint.say("One closed surface through all scans, cut off where nothing was measured.", "dim")
        elif self._shape.value != CLOUD:
            self._hint.say("Triangles between neighbouring pixels; depth jumps stay open.", "dim")
        else:
            self._hint.say("Every measured point in mm, with its colour.", "dim")

    def _look(self) -> None:
        """Show in 3D what would be written."""
        name, merge, operator = self._what.value, self._merge, self._stage.operator
        if not name:
            self._painter.forget("cloud")
            self._stage.scene.clear(LAYER)
            return

        def load() -> tuple[np.ndarray, np.ndarray | None]:
            if name == MERGED:
                whole = looking.merged_cloud(opened(operator), merge)
                return whole.points, whole.colours
            cloud = looking.scan_cloud(opened(operator), name)
            rows, columns = cloud.thinned(120_000)
            return cloud.points[rows, columns], cloud.texture[rows, columns]

        self._painter.ask("cloud", (name, merge if name == MERGED else self._clouds.get(name)), load, self._draw_cloud)

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
            self._stage.eyes.at(f"{LAYER} {self._what.value}", self._points)

    def _ask_shape(self) -> None:
        name, shape = self._what.value, self._shape.value
        kind = shape.removeprefix(MESH).lower()
        if name == MERGED:
            self._stage.operator.export("merged-mesh", "", kind)
        elif shape == CLOUD:
            self._stage.operator.export("cloud", name, "ply")
        elif name:
            self._stage.operator.export("mesh", name, kind)

    def _listed(self, session: SessionView | None) -> Html:
        exports = session.exports if session else ()
        if not exports:
            return block(toned("Nothing yet: write something below.", "dim"))
        rows = [
            (
                Html(f'<span style="overflow-wrap:anywhere">{cell(export.name)}</span>'),
                size(export.bytes),
                self._link(export),
            )
            for export in sorted(exports, key=_rank)
        ]
        return Html(f'<div style="max-height:{LIST_PX}px;overflow-y:auto">{table(("File", "size", ""), rows)}</div>')

    def _link(self, export: ExportView) -> Html:
        try:
            return link(self._stage.offer(export.path), "Download")
        except SlviewerError:  # taken away since the snapshot was made: the next one will not list it
            return cell("")


def size(count: int) -> str:
    """Bytes as people read them."""
    return f"{count / 1e6:.1f} MB" if count >= 100_000 else f"{count / 1e3:.1f} kB"


def _rank(export: ExportView) -> tuple[int, str]:
    """What was wanted most stands first: merged clouds, other shapes, documents."""
    shaped = Path(export.name).suffix.removeprefix(".").lower() in _SHAPED
    return (0 if export.name.startswith("merged") else 1 if shaped else 2, export.name)
