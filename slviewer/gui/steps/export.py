"""Step 9: write files for other programs, with their units and sizes, and download them."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from slviewer.errors import InputError, SlviewerError
from slviewer.gui.colouring import TEXTURE, merge_values, paint_points, scan_values
from slviewer.gui.panel import PanelPart, StepPanel, scan_labels, scan_options
from slviewer.gui.widgets import (
    Html,
    Text,
    coloured,
    link,
    note,
    paragraph,
    records_html,
    table,
    to_html,
)
from slviewer.pipeline.export import (
    What,
    default_file_name,
    describe_format,
    estimate_file_bytes,
    formats,
)
from slviewer.pipeline.mesh import BOARD
from slviewer.records.kinds import all_kinds
from slviewer.session.atomic import format_bytes
from slviewer.session.report_details import FIELDS, ReportDetails
from slviewer.session.shape_files import mesh_formats, point_formats, read_mesh_file
from slviewer.surface.meshing import TRIANGLES_PER_POINT, MeshingPlan, Method
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import ExportView, SessionView

LIST_PX = 250
"""Height of the list of files, so that the inputs below stay in view."""
MERGED = "merged"
POINTS, MESH = "points", "mesh"
SHOWN_MESHES = ("stl", "ply", "obj", "glb")
"""Formats of meshes that are read back, to be shown."""
MOST_MESH_BYTES = 80_000_000
"""Of a file that is shown: a larger one is slow to send and to draw."""
_GREY = (130, 130, 130)
"""Of meshes without colours."""
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
METHODS: dict[str, Method] = {
    "pixel grid": "grid",
    "Poisson": "poisson",
    "volumetric mean": "volume",
}
SMALL, OPEN, SIZED, CLOSED = "fill small", "keep open", "fill up to size", "watertight"
TEXTURES = {"none": None, "1024 px": 1024, "2048 px": 2048, "4096 px": 4096}
TEXTURE_PX = 2048
"""Of the textured mesh that one button writes."""
SMOOTHING = {"none": 0, "light": 5, "strong": 20}
"""Number of iterations."""


class MeshInputs(PanelPart):
    """Inputs of a `MeshingPlan`, visible if there is something to mesh."""

    _proposed = 0
    """Of the number of triangles, which the operator may change."""

    def build(self) -> None:
        """Create the inputs."""
        self._method = self.choice(
            "Method", "Pixel grid keeps every point; the others smooth out noise"
        )
        self._holes = self.dropdown("Holes", (SMALL, OPEN, SIZED, CLOSED))
        self._size = self.number("Hole size, mm", 2.0, 0.1, 500.0, 0.1)
        self._thin = self.number(
            "Triangles",
            0,
            0,
            50_000_000,
            1000,
            "Maximum number; by default twice that of the points",
        )
        self._smooth = self.choice(
            "Smoothing", "The result states how far the surface was moved", SMOOTHING
        )

    def show(self, visible: bool, merged: bool, points: int) -> None:
        """Show or hide the inputs for a number of points; merged ones have no pixel grid."""
        if self._thin.value in (0, self._proposed):
            self._proposed = self._thin.value = TRIANGLES_PER_POINT * points
        self._method.offer(
            {text: name for text, name in METHODS.items() if not (merged and name == "grid")}
        )
        for handle in (self._method.handle, self._holes, self._thin, self._smooth.handle):
            handle.visible = visible
        self._size.visible = visible and self._holes.value == SIZED

    @property
    def triangles(self) -> int | None:
        """The maximum number of triangles; None: that of the operation."""
        wanted = round(self._thin.value)
        return None if wanted in (0, self._proposed) else max(4, wanted)

    def plan(self) -> MeshingPlan:
        """Return the chosen plan."""
        holes, chosen = self._holes.value, self._method.value or None
        # the pixel grid covers one side only: it is never closed
        method = None if holes == CLOSED and chosen == "grid" else chosen
        sizes = {OPEN: 0.0, SIZED: float(self._size.value)}
        return MeshingPlan(
            method, sizes.get(holes), self.triangles, self._smooth.value, holes == CLOSED
        )


class ExportPanel(StepPanel):
    """Panel of the step Export."""

    key = "export"
    _drawn: SessionView | None = None
    _drawn_details = ReportDetails()

    def build(self) -> None:
        """Create the inputs and lists of files."""
        gui, operator = self._gui, self._operator
        with gui.add_folder("Files"):
            self._files = Text(gui)
            self._archive = Text(gui)
        with gui.add_folder("Cloud or mesh"):
            self._source = self.choice("Source")
            self._finish = self.button(
                "Write textured mesh", partial(self._request_mesh, "glb", TEXTURE_PX), "brush",
                hint="GLB with an image of the surface, 2048 px: for viewers and presentations",
            )  # fmt: skip
            self._stl = self.button(
                "Write STL", partial(self._request_mesh, "stl"), "cube",
                hint="The mesh alone, for CAD and printing",
            )  # fmt: skip
            self._as = self.dropdown("Type", (POINTS, MESH))
            self._mesh = MeshInputs(self)
            self._shape_format = self.choice("File type")
            self._texture = self.choice(
                "Texture",
                "An image of the surface, projected from the scans; thins the mesh",
                TEXTURES,
            )
            self._white = self.checkbox(
                "White balance", "Takes the board's white for neutral; for colour cameras"
            )
            self._shape_note = Text(gui)
            self._write = self.button("Write file", self._request_shape, "file-export", None)
        with gui.add_folder("Calibration and poses"):
            self._numbers = numbers = self.choice("Content")
            self._number_format = self.choice("Format")
            self._number_note = Text(gui)
            self._write_numbers = self.button(
                "Write calibration",
                lambda: operator.export(numbers.value, "", self._number_format.value),
                "file-export",
            )
        with gui.add_folder("Figures", expand_by_default=False) as self._figures_folder:
            self._figures = Text(gui)
        with gui.add_folder("Report and tables"):
            with gui.add_folder("Title page", expand_by_default=False):
                self._details: dict[str, Any] = {
                    field: gui.add_text(
                        f"{label}, °C" if field == "temperature_c" else label,
                        "",
                        hint="Optional; Write report remembers it",
                    )
                    for field, label in FIELDS.items()
                }
                self.upload_button("Upload logo", operator.upload_logo, ".png,.jpg,.jpeg,.webp")
                self._logo = self.button(
                    "Remove logo", lambda: operator.set_report_details(logo=""), "photo-off"
                )
            self._is_full = self.checkbox(
                "Full annex", hint="Also the rig: verifications, models, captures, hashes"
            )
            self._report = self.button("Write report", self._request_report, "report")
            self._table = self.button(
                "Write figures",
                lambda: operator.export("table"),
                "table-export",
                hint="All verifications, clouds and merges as a CSV table",
            )
            self.button(
                "Collect diagnostics", operator.diagnostic_bundle, "stethoscope",
                hint="Versions, settings, logs and thumbnails for a bug report; no frames",
            )  # fmt: skip

    def draw(self) -> None:
        """Show what the session can export, and its files; describe the chosen ones, link those
        that exist, and request the cloud."""
        session, calibration, busy = self.session, self.session.calibration, self.snapshot.is_busy
        self._files.set(self._files_html(session))
        self._archive.set("" if calibration is None else self._archive_html())
        things = {"merged scans": MERGED} if session.merge else {}
        things |= scan_options(scan for scan in session.scans if scan.cloud != "absent")
        self._source.offer(things)
        models = calibration.models if calibration else ()
        coefficients = bool({"pixelwise", "splined"} & set(models))
        self._numbers.offer_names(k for k in NUMBERS if k != "coefficients" or coefficients)
        unusable = busy or bool(calibration and calibration.refused)
        self._report.disabled = busy or self.is_blocked
        self._draw_details(session.report_details)
        self._write_numbers.disabled = unusable or self.is_blocked
        for button in (self._write, self._finish, self._stl):
            button.disabled = unusable or not things
        self._table.disabled = busy or not session.records
        self._figures_folder.visible = bool(session.records)
        if session is not self._drawn:
            self._drawn, labels = session, scan_labels(session)
            tables = (
                records_html(session.list_records(kind), labels) for kind in all_kinds().values()
            )
            self._figures.set("".join(tables))
        self._request_cloud()
        self._describe_shape()
        self._describe_numbers()

    def _draw_details(self, details: ReportDetails) -> None:
        """Show the details of the title page that have changed; what is typed stays else."""
        before, self._drawn_details = self._drawn_details, details
        for field, handle in self._details.items():
            value = getattr(details, field)
            if value != getattr(before, field):
                handle.value = "" if value is None else str(value)
        self._logo.visible = bool(details.logo)

    def _get_shape(self) -> tuple[What, str]:
        """Return what is to be exported, and its name; empty where nothing is offered."""
        name, mesh, merge = self._source.value, self._as.value == MESH, self.session.merge
        if name == MERGED:
            return "merged-mesh" if mesh else "merge", merge.name if merge else ""
        return "mesh" if mesh else "cloud", name

    def _describe_shape(self) -> None:
        """Describe the file of the chosen cloud or mesh, and link it where it exists."""
        session, (what, name) = self.session, self._get_shape()
        mesh = what in MESHES
        points, model = _points(session, name)
        self._mesh.show(mesh and bool(name), what == "merged-mesh", points)
        self._shape_format.offer(_name_formats(what))
        chosen = self._shape_format.value
        has_texture = bool(name) and mesh and chosen in TEXTURED_FORMATS
        self._texture.handle.visible = has_texture
        self._white.visible = has_texture and self._texture.value is not None
        if not name:
            self._shape_note.write("Nothing reconstructed yet: scan an object first.", "warning")
            return
        file = _get_export(session, default_file_name(what, name, chosen))
        triangles = self._mesh.triangles if mesh else None
        predicted = estimate_file_bytes(what, chosen, points, model, triangles)
        shown_type: What = "merged-mesh" if mesh and self._mesh.plan().method != "grid" else what
        text = describe_shape_file(shown_type, points, chosen, None if file else predicted)
        result = self._result_text(file) if file and mesh else ""
        unseen = note(_describe_view(what, file, chosen))
        self._shape_note.set(note(text) + self._link_html(file) + note(result) + unseen)
        # a merge's PLY is its own file
        self._write.visible = file is None or what != "merge" or chosen != "ply"
        self._write.label = "Write again" if file else "Write file"
        self._write.color = "gray" if file else None  # it is rather downloaded

    def _describe_numbers(self) -> None:
        """Describe the file of the chosen numbers, and link it where it exists."""
        numbers: What = self._numbers.value
        self._number_format.offer(_name_formats(numbers))
        chosen = self._number_format.value
        file = _get_export(self.session, default_file_name(numbers, "", chosen))
        text = f"{NUMBERS[numbers]}. {describe_format(chosen)}."
        self._number_note.set(note(text) + self._link_html(file))
        self._write_numbers.label = f"Write {numbers} again" if file else f"Write {numbers}"

    def _request_cloud(self) -> None:
        """Request the mesh that was written of the chosen source, else its cloud."""
        name, session = self._source.value, self.session
        merge = session.merge.name if session.merge else ""
        if not name:
            self.painter.cancel(self._draw_cloud)
            self.layer.clear()
            return

        what, captured = self._get_shape()
        chosen = self._shape_format.value
        file = None
        if what in MESHES:
            file = _get_export(session, default_file_name(what, captured, chosen))
        written = file.path.stat().st_mtime_ns if file and file.path.exists() else 0

        def load() -> trimesh.Trimesh | tuple[np.ndarray, np.ndarray]:
            """Load the mesh, or points (..., 3) mm and colours."""
            store = self.context.session
            if file and _is_drawn(file, chosen):
                mesh = read_mesh_file(file.path)
                if mesh.visual.kind is None:  # white, which the lights outshine
                    mesh.visual.vertex_colors = _GREY
                return mesh
            if name == MERGED:
                values = merge_values(result_views.merged_cloud(store, merge), ())
            else:
                values = scan_values(result_views.load_scan_cloud(store, name))
            return values.points, paint_points(values, TEXTURE)[0]

        version = (*_points(session, name), session.restriction(name))
        key = (name, merge if name == MERGED else version, file, written)
        self.painter.request(self._draw_cloud, key, load)

    def _draw_cloud(self, made: trimesh.Trimesh | tuple[np.ndarray, np.ndarray]) -> None:
        """Draw a loaded mesh, or a cloud."""
        if isinstance(made, trimesh.Trimesh):
            source = self._source.value
            title = f"mesh of {scan_labels(self.session).get(source, 'merged scans')}"
            self.layer.mesh("mesh", made, title)
            self.layer.remove("cloud")  # once the mesh is sent, which may take a while
            self.show_points(f"mesh {source}", np.asarray(made.vertices))
            return
        self.layer.remove("mesh")
        self.show_cloud(self._source.value, *made)

    # requests

    def _request_report(self) -> None:
        """Remember what was typed for the title page, and request the report. InputError for a
        temperature that is no number."""
        stated: dict[str, Any] = {field: each.value for field, each in self._details.items()}
        text = stated["temperature_c"].replace(",", ".").strip()
        try:
            stated["temperature_c"] = float(text) if text else None
        except ValueError as error:
            raise InputError(f"{text!r} is not a temperature", "type °C, such as 20.5") from error
        if self._operator.set_report_details(**stated):
            self._operator.export("report", is_full=self._is_full.value)

    def _request_shape(self) -> None:
        """Request the file of the chosen cloud or mesh."""
        what, name = self._get_shape()
        if name:
            plan = self._mesh.plan() if what in MESHES else None
            chosen = self._shape_format.value
            has_texture = plan is not None and chosen in TEXTURED_FORMATS
            texture = self._texture.value if has_texture else None
            white = BOARD if texture is not None and self._white.value else ""
            self._operator.export(what, name, chosen, plan, texture, white)

    def _request_mesh(self, file_format: str, texture_px: int | None = None) -> None:
        """Choose a mesh of this format, and request its file."""
        self._as.value = MESH
        self._texture.choose(texture_px)
        self._describe_shape()  # offers the formats of a mesh
        self._shape_format.choose(file_format)
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

    def _archive_html(self) -> Html:
        """Return a link to all files and results in one zip."""
        address = to_html(self.context.offer_archive())
        text = f'<a href="{address}" download style="{_QUIET}">Download all as one zip</a>'
        return paragraph(Html(f"{text} {coloured('files and results, without frames', 'dim')}"))

    def _result_text(self, export: ExportView) -> str:
        """Return the notice about this file, without its name; empty where it is no longer among
        the notices."""
        files = (notice.file for notice in reversed(self.snapshot.notices))
        return next((file.words for file in files if file and file.name == export.name), "")

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
            address = self.context.offer_download(export.path)
        except SlviewerError:  # removed since the snapshot was made: the next one will not list it
            return Html("")
        if quiet:
            return Html(f'<a href="{to_html(address)}" download style="{_QUIET}">{words}</a>')
        return link(address, words)


def _is_drawn(file: ExportView, file_format: str) -> bool:
    """Return whether the view shows a mesh that was written."""
    return file_format in SHOWN_MESHES and file.bytes < MOST_MESH_BYTES


def _describe_view(what: What, file: ExportView | None, file_format: str) -> str:
    """Return why the view does not show a mesh that was written; empty where it does."""
    if what not in MESHES or file is None or _is_drawn(file, file_format):
        return ""
    why = f"of {format_bytes(file.bytes)}" if file_format in SHOWN_MESHES else f"as {file_format}"
    return f"The view shows the points: a mesh {why} is not drawn."


def _name_formats(what: What) -> dict[str, str]:
    """Return {name: format} of the files that an export can be written to."""
    return {FORMAT_NAMES.get(each, each.upper()): each for each in formats(what)}


def describe_shape_file(what: What, points: int, file_format: str, size_bytes: int | None) -> str:
    """Describe a file of a scan or merge: its content, units, and approximate size, unless it is
    None."""
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
