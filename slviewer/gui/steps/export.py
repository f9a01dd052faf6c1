"""Step 9: write files for other programs, with their units and sizes, and download them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.gui.panel import Choice, PanelPart, StepPanel, scan_labels, scan_options
from slviewer.gui.widgets import Html, Text, link, note, paragraph, records_html, table, to_html
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

LIST_PX = 250
"""Height of the list of files, so that the inputs below stay in view."""
MERGED = "merged"
POINTS, MESH = "points", "mesh"
MESHES = ("mesh", "merged-mesh")
FORMAT_NAMES = {"xyz": "XYZ text", "yml": "OpenCV YAML", "xml": "OpenCV XML", "npz": "NumPy"}
NUMBERS: dict[What, str] = {
    "calibration": "Lenses and poses of camera and projector, and the reprojection errors",
    "poses": "Poses of camera, projector, target and merged scans, as 4x4 matrices",
    "coefficients": "Coefficients of the rational function of every camera pixel",
}
"""Other exports than shapes, and their content."""
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


class MeshInputs(PanelPart):
    """Inputs of a `MeshingPlan`, visible if there is something to mesh."""

    def __init__(self, panel: StepPanel, changed: Callable[[], None]) -> None:
        super().__init__(panel)
        gui, context = self._gui, self._context
        self._method = Choice(
            context,
            "Method",
            changed,
            hint="Pixel grid keeps every point; the others smooth out noise",
        )
        self._holes = gui.add_dropdown("Holes", (SMALL, OPEN, SIZED, CLOSED))
        self._size = gui.add_number("Hole size, mm", 2.0, min=0.1, max=500.0, step=0.1)
        self._thin = gui.add_number(
            "Triangles", 0, min=0, max=50_000_000, step=1000, hint="Maximum number; 0: no limit"
        )
        self._smooth = gui.add_dropdown(
            "Smoothing", tuple(SMOOTHING), hint="The result states how far the surface was moved"
        )
        context.on_change(changed, self._holes, self._size, self._thin, self._smooth)

    def show(self, visible: bool, merged: bool) -> None:
        """Show or hide the inputs; merged points have no pixel grid."""
        self._method.offer(
            (name, text) for name, text in METHODS.items() if not (merged and name == "grid")
        )
        inputs: list[Any] = [self._method.handle, self._holes, self._thin, self._smooth]
        for handle in inputs:
            handle.visible = visible
        self._size.visible = visible and self._holes.value == SIZED

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
    _drawn: SessionView | None = None

    def build(self) -> None:
        """Create the inputs and lists of files."""
        gui, context, operator = self._gui, self._context, self._operator
        with gui.add_folder("Files"):
            self._files = Text(gui)
        with gui.add_folder("Cloud or mesh"):
            self._source = Choice(context, "Source", self._describe)
            self._finish = context.button(
                "Write textured mesh", self._request_textured, "brush", None,
                hint="GLB with an image of the surface, 2048 px: for viewers and presentations",
            )  # fmt: skip
            self._as: Any = gui.add_dropdown("Type", (POINTS, MESH))
            self._mesh = MeshInputs(self, self._describe)
            self._shape_format = Choice(context, "File type", self._describe)
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
            self._write = context.button("Write file", self._request_shape, "file-export", None)
            context.view_button(self.get_points)
        with gui.add_folder("Calibration and poses"):
            self._numbers = numbers = Choice(context, "Content", self._describe)
            self._number_format = Choice(context, "Format", self._describe)
            self._number_note = Text(gui)
            self._write_numbers = context.button(
                "Write calibration",
                lambda: operator.export(numbers.value, "", self._number_format.value),  # type: ignore[arg-type]
                "file-export",
                None,
            )
        with gui.add_folder("Figures", expand_by_default=False) as self._figures_folder:
            self._figures = Text(gui)
        with gui.add_folder("Report and tables"):
            self._report = context.button(
                "Write report", lambda: operator.export("report"), "report", None
            )
            self._table = context.button(
                "Write figures",
                lambda: operator.export("table"),
                "table-export",
                hint="All verifications, clouds and merges as a CSV table",
            )
            context.button(
                "Collect diagnostics", operator.diagnostic_bundle, "stethoscope",
                hint="Versions, settings, logs and thumbnails for a bug report; no frames",
            )  # fmt: skip
        context.on_change(self._describe, self._as, self._texture)

    def draw(self, snapshot: Snapshot) -> None:
        """Show what a snapshot's session can export, and its files."""
        session, calibration, busy = self._session, snapshot.calibration, snapshot.is_busy
        self._files.set(self._files_html(session))
        things = [(MERGED, "merged scans")] if session.merge else []
        things += scan_options(scan for scan in session.scans if scan.cloud != "absent")
        self._source.offer(things)
        models = calibration.models if calibration else ()
        coefficients = bool({"pixelwise", "splined"} & set(models))
        self._numbers.offer_names(k for k in NUMBERS if k != "coefficients" or coefficients)
        unusable = busy or bool(calibration and calibration.refused)
        blocked = snapshot.step(self.key).state == "blocked"
        self._report.disabled = busy or blocked
        self._write_numbers.disabled = unusable or blocked
        self._write.disabled = self._finish.disabled = unusable or not things
        self._table.disabled = busy or not session.records
        self._figures_folder.visible = bool(session.records)
        if session is not self._drawn:
            self._drawn, labels = session, scan_labels(session)
            tables = (records_html(session.list_records(kind), labels) for kind in RECORDS.values())
            self._figures.set("".join(tables))
        self._describe()

    def _get_shape(self) -> tuple[What, str]:
        """Return what is to be exported, and its name; empty where nothing is offered."""
        name, mesh, merge = self._source.value, self._as.value == MESH, self._session.merge
        if name == MERGED:
            return "merged-mesh" if mesh else "merge", merge.name if merge else ""
        return "mesh" if mesh else "cloud", name

    def _describe(self) -> None:
        """Describe the chosen files, link those that exist, and request the cloud."""
        self._request_cloud()
        self._describe_shape()
        self._describe_numbers()

    def _describe_shape(self) -> None:
        """Describe the file of the chosen cloud or mesh, and link it where it exists."""
        session, (what, name) = self._session, self._get_shape()
        mesh = what in MESHES
        self._mesh.show(mesh and bool(name), what == "merged-mesh")
        self._shape_format.offer(_name_formats(what))
        chosen = self._shape_format.value
        self._texture.visible = bool(name) and mesh and chosen in TEXTURED_FORMATS
        self._white.visible = self._texture.visible and TEXTURES[self._texture.value] is not None
        if not name:
            self._shape_note.write("Nothing reconstructed yet: scan an object first.", "warning")
            return
        file = _get_export(session, default_file_name(what, name, chosen))
        predicted = estimate_file_bytes(
            what, chosen, *_points(session, name), self._mesh.triangles if mesh else None
        )
        shown_type: What = "merged-mesh" if mesh and self._mesh.plan().method != "grid" else what
        text = describe_shape_file(session, shown_type, name, chosen, None if file else predicted)
        result = self._result_text(file) if file and mesh else ""
        self._shape_note.set(note(text) + self._link_html(file) + note(result))
        # a merge's PLY is its own file
        self._write.visible = file is None or what != "merge" or chosen != "ply"
        self._write.label = "Write again" if file else "Write file"
        self._write.color = "gray" if file else None  # it is rather downloaded

    def _describe_numbers(self) -> None:
        """Describe the file of the chosen numbers, and link it where it exists."""
        numbers: What = self._numbers.value  # type: ignore[assignment]
        self._number_format.offer(_name_formats(numbers))
        chosen = self._number_format.value
        file = _get_export(self._session, default_file_name(numbers, "", chosen))
        text = f"{NUMBERS[numbers]}. {describe_format(chosen)}."
        self._number_note.set(note(text) + self._link_html(file))
        self._write_numbers.label = f"Write {numbers} again" if file else f"Write {numbers}"
        self._write_numbers.color = "gray" if file else None

    def _request_cloud(self) -> None:
        """Request the cloud of the chosen source."""
        name, session = self._source.value, self._session
        merge = session.merge.name if session.merge else ""
        if not name:
            self.painter.cancel("cloud")
            self.layer.clear()
            return

        def load() -> tuple[np.ndarray, np.ndarray | None]:
            """Load points (..., 3) mm and colours of the source; None: it has no colours."""
            store = self._context.session
            if name == MERGED:
                whole = result_views.merged_cloud(store, merge)
                return whole.points, whole.colours
            cloud = result_views.load_scan_cloud(store, name)
            return cloud.points, cloud.texture

        version = (*_points(session, name), session.restriction(name))
        key = (name, merge if name == MERGED else version)
        self.painter.request("cloud", key, load, self._draw_cloud)

    def _draw_cloud(self, made: tuple[np.ndarray, np.ndarray | None]) -> None:
        """Draw a loaded cloud, grey where it has no colours."""
        points, colours = made
        self.layer.cloud("cloud", points, (150, 150, 150) if colours is None else colours)
        self.show_points(self._source.value, points)

    # requests

    def _request_shape(self) -> None:
        """Request the file of the chosen cloud or mesh."""
        what, name = self._get_shape()
        if name:
            plan = self._mesh.plan() if what in MESHES else None
            chosen = self._shape_format.value
            has_texture = plan is not None and chosen in TEXTURED_FORMATS
            texture = TEXTURES[self._texture.value] if has_texture else None
            white = BOARD if texture is not None and self._white.value else ""
            self._operator.export(what, name, chosen, plan, texture, white)

    def _request_textured(self) -> None:
        """Choose a mesh with a texture as GLB, and request its file."""
        self._as.value, self._texture.value = MESH, TEXTURE
        self._describe()  # offers the formats of a mesh
        self._shape_format.choose("glb")
        self._request_shape()

    # files

    def _files_html(self, session: SessionView) -> Html:
        """Return a table of the exported files with sizes and download links."""
        if not session.exports:
            return note("No files yet.")
        rows = [
            (
                Html(f'<span style="overflow-wrap:anywhere">{to_html(export.name)}</span>'),
                Html(f'<span style="white-space:nowrap">{format_bytes(export.bytes)}</span>'),
                self._format_link(export, "Download", quiet=True),
            )
            for export in sorted(session.exports, key=_rank_export)
        ]
        return Html(
            f'<div style="max-height:{LIST_PX}px;overflow-y:auto">'
            f"{table(('File', 'Size', ''), rows)}</div>"
        )

    def _result_text(self, export: ExportView) -> str:
        """Return the notice about this file, without its name; empty where it is no longer among
        the notices."""
        for notice in reversed(self._snapshot.notices):
            if notice.text.startswith(f"{export.name} is ready"):
                return notice.text.partition(": ")[2]
        return ""

    def _link_html(self, export: ExportView | None) -> str:
        """Return a link to an existing file; empty where there is none."""
        if export is None:
            return ""
        words = f"Download {export.name}, {format_bytes(export.bytes)}"
        return paragraph(self._format_link(export, words))

    def _format_link(self, export: ExportView, words: str, quiet: bool = False) -> Html:
        """Return a download link, plain text if `quiet`, else a button; empty where the file is
        gone."""
        try:
            address = self._context.offer_download(export.path)
        except SlviewerError:  # removed since the snapshot was made: the next one will not list it
            return Html("")
        if quiet:
            return Html(f'<a href="{to_html(address)}" download style="{_QUIET}">{words}</a>')
        return link(address, words)


def _name_formats(what: What) -> list[tuple[str, str]]:
    """Return (format, its name) of the files that an export can be written to."""
    return [(each, FORMAT_NAMES.get(each, each.upper())) for each in formats(what)]


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
    for scan in session.scans:
        if scan.name == name:
            return scan.figures.points, scan.figures.model
    return session.merge.record.points if session.merge else 0, ""


def _get_export(session: SessionView, name: str) -> ExportView | None:
    """Return the exported file called `name`; None where there is none."""
    return next((export for export in session.exports if export.name == name), None)


def _rank_export(export: ExportView) -> tuple[int, str]:
    """Return a sort key: merged clouds, then other shapes, then documents."""
    suffix = Path(export.name).suffix.removeprefix(".").lower()
    shaped = suffix in {*point_formats(), *mesh_formats()}
    return (0 if export.name.startswith("merged") else 1 if shaped else 2, export.name)
