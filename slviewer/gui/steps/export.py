"""Step 9: write files for other programs, with their units and sizes, and download them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import viser

from slviewer.errors import SlviewerError
from slviewer.gui.inputs import Choice, change, scan_options
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.widgets import Html, Text, coloured, link, paragraph, records_html, table, to_html
from slviewer.pipeline.export import (
    What,
    default_file_name,
    describe_format,
    estimate_file_bytes,
    formats,
)
from slviewer.pipeline.mesh import BOARD
from slviewer.records.kinds import RECORDS
from slviewer.session.atomic import format_bytes
from slviewer.session.mesh_files import mesh_formats, point_formats
from slviewer.surface.meshing import MeshingPlan, Method
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import ExportView, SessionView, Snapshot

LAYER = "export"
LIST_PX = 250
"""Height of the list of files, so that the inputs below stay in view."""
MERGED = "merged"
POINTS, MESH = "points", "mesh"
MESHES = ("mesh", "merged-mesh")
FORMAT_NAMES = {
    "ply": "PLY",
    "stl": "STL",
    "obj": "OBJ",
    "glb": "GLB",
    "3mf": "3MF",
    "xyz": "XYZ text",
    "e57": "E57",
    "yml": "OpenCV YAML",
    "xml": "OpenCV XML",
    "json": "JSON",
    "npz": "NumPy",
}
NUMBERS: dict[What, tuple[str, str]] = {
    "calibration": (
        "calibration",
        "Lenses and poses of camera and projector, and the reprojection errors",
    ),
    "poses": ("poses", "Poses of camera, projector, target and merged scans, as 4x4 matrices"),
    "coefficients": ("coefficients", "Coefficients of the rational function of every camera pixel"),
}
"""Other exports than shapes: the choice, and its content."""
_QUIET = "color:var(--mantine-color-anchor);font-weight:600;text-decoration:none"
TEXTURED_FORMATS = ("glb", "obj")
METHODS: dict[Method, str] = {
    "grid": "pixel grid",
    "poisson": "Poisson",
    "volume": "volumetric mean",
}
SMALL, OPEN, SIZED, CLOSED = "fill small", "keep open", "fill up to size", "watertight"
TEXTURES = {"none": None, "1024 px": 1024, "2048 px": 2048, "4096 px": 4096}
TEXTURE = "2048 px"
"""Of the textured mesh that one button writes."""
SMOOTHING = {"none": 0, "light": 5, "strong": 20}
"""Number of iterations."""


class MeshInputs:
    """Inputs of a `MeshingPlan`, visible if there is something to mesh."""

    def __init__(self, context: PanelContext, changed: Callable[[], None]) -> None:
        gui = context.gui
        self._method = Choice(
            gui, "Method", "Pixel grid keeps every point; the others smooth out noise"
        )
        self._holes = gui.add_dropdown("Holes", (SMALL, OPEN, SIZED, CLOSED))
        self._size = gui.add_number(
            "Hole size, mm", 2.0, min=0.1, max=500.0, step=0.1, visible=False
        )
        self._thin = gui.add_number(
            "Triangles", 0, min=0, max=50_000_000, step=1000, hint="Maximum number; 0: no limit"
        )
        self._smooth = gui.add_dropdown(
            "Smoothing", tuple(SMOOTHING), hint="The result states how far the surface was moved"
        )
        self._method.on_change(context.callback(changed))
        for handle in (self._holes, self._size, self._thin, self._smooth):
            handle.on_update(context.callback(changed))

    def draw(self, visible: bool, merged: bool) -> None:
        """Show or hide the inputs; merged points have no pixel grid."""
        self._method.offer(
            [(name, text) for name, text in METHODS.items() if not (merged and name == "grid")]
        )
        self._method.set_visible(visible)
        inputs: list[Any] = [self._holes, self._thin, self._smooth]
        for handle in inputs:
            change(handle, visible=visible)
        change(self._size, visible=visible and self._holes.value == SIZED)

    @property
    def triangles(self) -> int | None:
        """The maximum number of triangles; None: no limit."""
        return max(4, round(self._thin.value)) if self._thin.value >= 1 else None

    def plan(self) -> MeshingPlan:
        """Return the chosen plan."""
        holes = self._holes.value
        chosen = next((name for name in get_args(Method) if name == self._method.value), None)
        # the pixel grid covers one side only: it is never closed
        method = None if holes == CLOSED and chosen == "grid" else chosen
        sizes = {OPEN: 0.0, SIZED: float(self._size.value)}
        return MeshingPlan(
            method, sizes.get(holes), self.triangles, SMOOTHING[self._smooth.value], holes == CLOSED
        )


class ExportPanel(StepPanel):
    """Panel of the step Export."""

    key = "export"
    layers = (LAYER,)
    _points: np.ndarray | None = None
    _drawn: SessionView | None = None

    def build(self) -> None:
        """Create the inputs and lists of files."""
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Files"):
            self._files = Text(gui)
        with gui.add_folder("Cloud or mesh"):
            self._source = Choice(gui, "Source")
            self._finish = context.button(
                "Write textured mesh", self._request_textured, viser.Icon.BRUSH, None,
                hint="GLB with an image of the surface, 2048 px: for viewers and presentations",
            )  # fmt: skip
            self._as: Any = gui.add_dropdown("Type", (POINTS, MESH))
            self._mesh = MeshInputs(context, self._describe)
            self._shape_format = Choice(gui, "File type")
            self._texture: Any = gui.add_dropdown(
                "Texture",
                tuple(TEXTURES),
                hint="An image of the surface, projected from the scans; thins the mesh",
            )
            self._white = gui.add_checkbox(
                "White balance",
                False,
                hint="Takes the board's white for neutral; for colour cameras",
            )
            self._shape_note = Text(gui)
            self._shape_link = Text(gui)
            self._shape_result = Text(gui)
            self._write = context.button(
                "Write file", self._request_shape, viser.Icon.FILE_EXPORT, None
            )
            context.view_button(lambda: self._points)
        with gui.add_folder("Calibration and poses"):
            self._numbers = Choice(gui, "Content")
            self._number_format = Choice(gui, "Format")
            self._number_note = Text(gui)
            self._number_link = Text(gui)
            self._write_numbers = context.button(
                "Write calibration", self._request_numbers, viser.Icon.FILE_EXPORT, None
            )
        with gui.add_folder(
            "Figures", visible=False, expand_by_default=False
        ) as self._figures_folder:
            self._figures = Text(gui)
        with gui.add_folder("Report and tables"):
            self._report = context.button("Write report", operator.report, viser.Icon.REPORT, None)
            self._table = context.button(
                "Write figures",
                lambda: operator.export("table"),
                viser.Icon.TABLE_EXPORT,
                hint="All verifications, clouds and merges as a CSV table",
            )
            context.button(
                "Collect diagnostics", operator.diagnostic_bundle, viser.Icon.STETHOSCOPE,
                hint="Versions, settings, logs and thumbnails for a bug report; no frames",
            )  # fmt: skip
        self._as.on_update(context.callback(self._describe))
        self._texture.on_update(context.callback(self._describe))
        for choice in (self._source, self._shape_format, self._numbers, self._number_format):
            choice.on_change(context.callback(self._describe))

    def draw(self, snapshot: Snapshot) -> None:
        """Show what a snapshot's session can export, and its files."""
        self._snapshot = snapshot
        session, calibration = snapshot.session, snapshot.calibration
        self._files.set(self._files_html(session))
        if session is None:
            return
        things = [(MERGED, "merged scans")] if session.merge else []
        things += scan_options(scan for scan in session.scans if scan.cloud != "absent")
        self._source.offer(things)
        models = calibration.models if calibration else ()
        coefficients = bool({"pixelwise", "splined"} & set(models))
        self._numbers.offer(
            [(k, text) for k, (text, _) in NUMBERS.items() if k != "coefficients" or coefficients]
        )
        unusable = snapshot.is_busy or (calibration is not None and bool(calibration.refused))
        blocked = snapshot.step(self.key).state == "blocked"
        change(self._report, disabled=snapshot.is_busy or blocked)
        change(self._write_numbers, disabled=unusable or blocked)
        for button in (self._write, self._finish):
            change(button, disabled=unusable or not things)
        change(self._table, disabled=snapshot.is_busy or not session.records)
        change(self._figures_folder, visible=bool(session.records))
        self._draw_figures(session)
        self._describe()

    def _draw_figures(self, session: SessionView) -> None:
        """Show the tables of all records, drawn again only where the session has changed."""
        if session is not self._drawn:
            self._drawn, labels = session, {scan.name: scan.label for scan in session.scans}
            self._figures.set(
                "".join(
                    records_html(session.list_records(kind), labels) for kind in RECORDS.values()
                )
            )

    def show(self, visible: bool) -> None:
        """Show or hide the layers, and move the views to the cloud."""
        super().show(visible)
        self._show_view()

    def _get_shape(self) -> tuple[What, str]:
        """Return what is to be exported, and its name; empty where nothing is offered."""
        name, mesh, session = self._source.value, self._as.value == MESH, self._session
        if name == MERGED:
            return "merged-mesh" if mesh else "merge", (
                session.merge.name if session and session.merge else ""
            )
        return "mesh" if mesh else "cloud", name

    def _describe(self) -> None:
        """Describe the chosen files, link those that exist, and request the cloud."""
        if self._session is not None:
            self._request_cloud(self._session)
            self._describe_shape(self._session)
            self._describe_numbers(self._session)

    def _describe_shape(self, session: SessionView) -> None:
        """Describe the file of the chosen cloud or mesh, and link it where it exists."""
        what, name = self._get_shape()
        mesh = what in MESHES
        self._mesh.draw(mesh and bool(name), what == "merged-mesh")
        self._shape_format.offer(
            [(each, FORMAT_NAMES.get(each, each.upper())) for each in formats(what)]
        )
        change(
            self._texture,
            visible=bool(name) and mesh and self._shape_format.value in TEXTURED_FORMATS,
        )
        change(
            self._white, visible=self._texture.visible and TEXTURES[self._texture.value] is not None
        )
        if not name:
            self._shape_note.write("Nothing reconstructed yet: scan an object first.", "warning")
            self._shape_link.set("")
            self._shape_result.set("")
            return
        chosen = self._shape_format.value
        file = _get_export(session, default_file_name(what, name, chosen))
        predicted = estimate_file_bytes(
            what, chosen, *_points(session, name), self._mesh.triangles if mesh else None
        )
        shown_type: What = "merged-mesh" if mesh and self._mesh.plan().method != "grid" else what
        self._shape_note.write(
            describe_shape_file(session, shown_type, name, chosen, None if file else predicted),
            "dim",
        )
        self._shape_link.set(self._link_html(file))
        self._shape_result.write(self._result_text(file) if file and mesh else "", "dim")
        is_own = file is not None and what == "merge" and chosen == "ply"  # the merge's own file
        label = "Write again" if file else "Write file"
        change(self._write, visible=not is_own, label=label, color=_button_colour(file))

    def _describe_numbers(self, session: SessionView) -> None:
        """Describe the file of the chosen numbers, and link it where it exists."""
        numbers: What = self._numbers.value or "calibration"  # type: ignore[assignment]
        self._number_format.offer([(each, FORMAT_NAMES[each]) for each in formats(numbers)])
        chosen = self._number_format.value
        self._number_note.write(f"{NUMBERS[numbers][1]}. {describe_format(chosen)}.", "dim")
        file = _get_export(session, default_file_name(numbers, "", chosen))
        self._number_link.set(self._link_html(file))
        label = f"Write {numbers} again" if file else f"Write {numbers}"
        change(self._write_numbers, label=label, color=_button_colour(file))

    def _request_cloud(self, session: SessionView) -> None:
        """Request the cloud of the chosen source."""
        name, merge, context = (
            self._source.value,
            session.merge.name if session.merge else "",
            self._context,
        )
        if not name:
            self._painter.cancel("cloud")
            self._scene.clear(LAYER)
            return
        clouds = {
            scan.name: (scan.figures.points, scan.figures.model, session.restriction(scan.name))
            for scan in session.scans
        }

        def load() -> tuple[np.ndarray, np.ndarray | None]:
            """Load points (..., 3) mm and colours of the source; None: it has no colours."""
            if name == MERGED:
                whole = result_views.merged_cloud(context.session, merge)
                return whole.points, whole.colours
            cloud = result_views.load_scan_cloud(context.session, name)
            return cloud.points, cloud.texture

        key: Any = merge if name == MERGED else clouds.get(name)
        self._painter.request("cloud", (name, key), load, self._draw_cloud)

    def _draw_cloud(self, made: tuple[np.ndarray, np.ndarray | None]) -> None:
        """Draw a loaded cloud, grey where it has no colours."""
        points, colours = made
        self._points = points
        self._scene.cloud(LAYER, "cloud", points, (150, 150, 150) if colours is None else colours)
        self._scene.show(LAYER, self._visible)
        self._show_view()

    def _show_view(self) -> None:
        """Move the browsers' views to the cloud, if it is visible."""
        if self._visible:
            self._context.viewpoints.show(f"{LAYER} {self._source.value}", self._points)

    # requests

    def _request_shape(self) -> None:
        """Request the file of the chosen cloud or mesh."""
        what, name = self._get_shape()
        if name:
            plan = self._mesh.plan() if what in MESHES else None
            chosen = self._shape_format.value
            texture = (
                TEXTURES[self._texture.value]
                if plan is not None and chosen in TEXTURED_FORMATS
                else None
            )
            white = BOARD if texture is not None and self._white.value else ""
            self._operator.export(what, name, chosen, plan, texture, white)

    def _request_textured(self) -> None:
        """Choose a mesh with a texture as GLB, and request its file."""
        self._as.value, self._texture.value = MESH, TEXTURE
        self._describe()  # offers the formats of a mesh
        self._shape_format.choose("glb")
        self._request_shape()

    def _request_numbers(self) -> None:
        """Request the file of the chosen numbers: calibration, poses or coefficients."""
        self._operator.export(cast(What, self._numbers.value), "", self._number_format.value)

    # files

    def _files_html(self, session: SessionView | None) -> Html:
        """Return a table of the exported files with sizes and download links."""
        exports = session.exports if session else ()
        if not exports:
            return paragraph(coloured("No files yet.", "dim"))
        rows = [
            (
                Html(f'<span style="overflow-wrap:anywhere">{to_html(export.name)}</span>'),
                Html(f'<span style="white-space:nowrap">{format_bytes(export.bytes)}</span>'),
                self._format_link(export, "Download", quiet=True),
            )
            for export in sorted(exports, key=_rank_export)
        ]
        return Html(
            f'<div style="max-height:{LIST_PX}px;overflow-y:auto">'
            f"{table(('File', 'Size', ''), rows)}</div>"
        )

    def _result_text(self, export: ExportView) -> str:
        """Return the notice about this file, without its name; empty where it is no longer among
        the notices."""
        notices = reversed(self._snapshot.notices if self._snapshot else ())
        text = next(
            (each.text for each in notices if each.text.startswith(f"{export.name} is ready")), ""
        )
        return text.partition(": ")[2]

    def _link_html(self, export: ExportView | None) -> str:
        """Return a link to an existing file; empty where there is none."""
        return (
            ""
            if export is None
            else paragraph(
                self._format_link(export, f"Download {export.name}, {format_bytes(export.bytes)}")
            )
        )

    def _format_link(self, export: ExportView, words: str, quiet: bool = False) -> Html:
        """Return a download link, plain text if `quiet`, else a button; empty where the file is
        gone."""
        try:
            address = self._context.offer(export.path)
            return (
                Html(f'<a href="{to_html(address)}" download style="{_QUIET}">{words}</a>')
                if quiet
                else link(address, words)
            )
        except SlviewerError:  # removed since the snapshot was made: the next one will not list it
            return to_html("")


def describe_shape_file(
    session: SessionView, what: What, name: str, file_format: str, size_bytes: int | None
) -> str:
    """Describe a file of a scan or merge: its content, units, and approximate size, where known."""
    points, _ = _points(session, name)
    content = {
        "cloud": f"{points:,} points",
        "merge": f"{points:,} merged points",
        "mesh": "Triangles between neighbouring pixels, open at depth edges",
        "merged-mesh": "One surface through the points, cut off where nothing was measured",
    }[what]
    about = "" if size_bytes is None else f" About {format_bytes(size_bytes)}."
    return f"{content}. Unit: {describe_format(file_format)}.{about}"


def _points(session: SessionView, name: str) -> tuple[int, str]:
    """Return the number of points of a scan or the merge, and a scan's model."""
    scan = next((each for each in session.scans if each.name == name), None)
    if scan is not None:
        return scan.figures.points, scan.figures.model
    return session.merge.record.points if session.merge else 0, ""


def _get_export(session: SessionView, name: str) -> ExportView | None:
    """Return the exported file called `name`; None where there is none."""
    return next((export for export in session.exports if export.name == name), None)


def _button_colour(file: ExportView | None) -> Literal["gray"] | None:
    """Return grey for a file that exists already, which is rather downloaded; else the main
    colour."""
    return None if file is None else "gray"


def _rank_export(export: ExportView) -> tuple[int, str]:
    """Return a sort key: merged clouds, then other shapes, then documents."""
    shaped = Path(export.name).suffix.removeprefix(".").lower() in {
        *point_formats(),
        *mesh_formats(),
    }
    return (0 if export.name.startswith("merged") else 1 if shaped else 2, export.name)
