"""Files for other programs, of everything that a session holds. The wizard's step Export and the
command call this."""

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Literal, get_args

from slviewer.errors import InputError
from slviewer.pipeline.capture_clouds import (
    merge_name,
    points_with_normals,
    read_merge,
    scan_cloud,
)
from slviewer.pipeline.export_documents import (
    write_calibration_file,
    write_coefficients,
    write_poses,
    write_table,
)
from slviewer.pipeline.feedback import part
from slviewer.pipeline.models import (
    ModelName,
    check_accepted,
    frame_of,
    preferred_model,
    warn_if_stale,
)
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.operation import Callbacks, takes_settings
from slviewer.pipeline.report import report
from slviewer.pipeline.scale import describe_scale
from slviewer.pipeline.scan_edits import refuse_region, resolve_region, restriction_notes
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.session.atomic import format_bytes
from slviewer.session.mesh_files import (
    IN_WORDS,
    estimated_bytes,
    exporters,
    mesh_formats,
    point_formats,
    write_shape,
)
from slviewer.session.reading import expand_user
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan, build_mesh
from slviewer.surface.shapes import PointSet

What = Literal[
    "cloud",
    "mesh",
    "merge",
    "merged-mesh",
    "calibration",
    "coefficients",
    "poses",
    "report",
    "table",
]
"""A scan's points, its mesh, the points of a merge, one mesh through them, the calibration, the
coefficients of each pixel, poses of devices, boards and scans, the report, the figures of all
records."""
_DOCUMENT_FORMATS: dict[str, tuple[str, ...]] = {
    "calibration": ("yml", "xml", "json"),
    "coefficients": ("npz",),
    "poses": ("json", "yml", "xml"),
    "report": ("html",),
    "table": ("csv",),
}
DOCUMENTS = {
    "yml": "OpenCV's YAML in mm and px, explained in comments",
    "xml": "OpenCV's XML in mm and px, explained in comments",
    "json": "JSON in mm and px, explained next to the numbers",
    "npz": "NumPy's arrays in mm, px and rad, explained in the one called about",
    "html": "one page that needs nothing else",
    "csv": "for a spreadsheet, in mm",
}
"""What the other formats are, and in which units."""
_ALIASES = {"yaml": "yml", "htm": "html"}
_ALONG_NORMAL = "sigma: expected error along the normal, mm"
_SCANS, _MERGES = ("cloud", "mesh"), ("merge", "merged-mesh")


def formats(what: What) -> tuple[str, ...]:
    """Return the formats of an export; the first is the default. Raises InputError for what cannot
    be exported."""
    if what not in get_args(What):
        raise InputError(f"{what!r} cannot be exported: choose one of {', '.join(get_args(What))}")
    if what in ("cloud", "merge"):
        return point_formats()
    if what in ("mesh", "merged-mesh"):
        return tuple(each for each in mesh_formats() if each != "xyz")
    return _DOCUMENT_FORMATS[what]


@dataclass(frozen=True)
class Exported:
    """An exported file, and a description of its content."""

    path: Path
    bytes: int
    words: str

    def text(self) -> str:
        """Return the content, path, size and format of the file as text."""
        content = describe_format(self.path.suffix.lower().removeprefix("."))
        return f"{self.words}\n-> {self.path}, {format_bytes(self.bytes)}: {content}"


def describe_format(file_format: str) -> str:
    """Describe what a format contains and in which units."""
    added = exporters().get(file_format)
    return added.what if added else IN_WORDS.get(file_format) or DOCUMENTS.get(file_format, "")


def estimate_file_bytes(
    what: What, file_format: str, points: int, model: str = "", triangles: int | None = None
) -> int | None:
    """About how large a file of a scan or a merge of so many points becomes, thinned to
    ``triangles`` where that is wanted; None where it is not known before."""
    if what in ("cloud", "merge"):
        return estimated_bytes(file_format, points, scalars=3 if model == "splined" else 1)
    # between neighbouring pixels, all but those at borders
    faces = 2 * points if what == "mesh" else None
    if triangles is not None:
        faces = triangles if faces is None else min(triangles, faces)
    return None if faces is None else estimated_bytes(file_format, faces // 2, faces, scalars=1)


def check_export(what: What, file_format: str) -> None:
    """Raise InputError for something that cannot be exported, or not in this format."""
    if _ALIASES.get(file_format, file_format) not in formats(what):
        listed = ", ".join(f".{each}" for each in formats(what))
        raise InputError(f"the {what} cannot be written as .{file_format}: choose {listed}")


def default_file_name(what: What, name: str, file_format: str) -> str:
    """The default name of an exported file, such as ``object_1_mesh.stl``."""
    stems = {
        "cloud": f"{name}_cloud",
        "mesh": f"{name}_mesh",
        "merge": f"merged_{name}",
        "table": "figures",
        "merged-mesh": f"merged_{name}_mesh",
        "coefficients": f"coefficients_{name}".removesuffix("_"),
    }
    return f"{stems.get(what, what)}.{file_format}"


@dataclass(frozen=True)
class ExportSettings(Callbacks):
    """What is written, and to which file.

    Args:
        session: Session folder.
        what: cloud and mesh of a scan; merge (the points) and merged-mesh; calibration for OpenCV
            or as JSON; coefficients of each pixel as .npz; poses of camera, projector, target and
            scans as 4x4 matrices; report as HTML; table of the figures of verifications, clouds and
            merges as CSV.
        name: The scan of a cloud or a mesh; the number of a merge, by default the last; the model
            of coefficients.
        out: The file, whose suffix selects the format, or a folder; by default the session's
            exports.
        file_format: ply, stl, obj, glb, 3mf, xyz, e57, yml, xml, json, ..., where --out is a folder
            or not given.
        model: Which calibration to make a cloud with, by default the one of the stored cloud, or
            the best; or which to write (of splined the pinhole and Brown lenses that come nearest,
            and their remaining error).
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
            A merge was cut when it was made.
        accept_rejected: Use the calibration although its verdict rejects it.

    The file is written whole or not at all.
    """

    session: SessionLike
    what: What
    name: str = ""
    _: KW_ONLY
    out: Path | str | None = None
    file_format: str = ""
    model: ModelName | None = None
    plan: MeshingPlan | None = None
    roi: str = ""
    accept_rejected: bool = False


@takes_settings(ExportSettings)
def export(settings: ExportSettings) -> Exported:
    """Write a file for other programs: shapes in mm (.ply .stl .obj .3mf .xyz) or m (.glb .e57),
    calibration, poses."""
    what, progress, warn = settings.what, settings.progress, settings.warn
    with opened(settings.session) as store:
        chosen = settings.file_format.lower().removeprefix(".")
        check_export(what, chosen or formats(what)[0])
        name = _resolve_name(store, what, settings.name)
        target = _output_path(store, what, name, settings.out, chosen)
        if what not in ("report", "table"):
            check_accepted(store, settings.accept_rejected)
        # reading a merge warns by itself
        if what not in ("report", "table", *_MERGES):
            warn_if_stale(store, warn)
        if what in _SCANS:
            words = _write_scan(store, name, target, settings)
        elif what in _MERGES:
            words = _write_merge(store, name, target, settings)
        elif what == "report":
            report(store, target, progress=progress, warn=warn)
            words = "report"
        else:
            progress(0.1, f"writing {target.name}")
            words = _write_document(store, what, name, target, settings.model)
    progress(1.0, "exported")
    return Exported(target, target.stat().st_size, words)


def _write_scan(store: Session, name: str, target: Path, settings: ExportSettings) -> str:
    """Write a scan's measured points with normals, colours and sigmas, or a mesh of them; return a
    description of what was written."""
    progress, roi = settings.progress, settings.roi
    cloud = scan_cloud(
        store,
        name,
        settings.model,
        part(progress, 0, 0.4),
        settings.warn,
        settings.accept_rejected,
        roi,
    )
    mask = cloud.mask
    if not mask.any():
        raise InputError(
            f"{name}: no pixel was measured: does the calibration belong to this camera and"
            " projector?"
        )
    notes = (
        f"scan {name}, frame: {frame_of(store, cloud.model)}, x right, y down, z away",
        *_model_notes(store, cloud.model),
        *restriction_notes(store, [name], resolve_region(store, roi)),
    )
    if settings.what == "mesh":
        return _write_mesh(name, cloud, notes, target, settings)
    progress(0.56, "normals")
    normals = grid_normals(cloud.points)[mask]
    colours = None if (rgb := cloud.rgb) is None else rgb[mask]
    progress(0.85, f"writing {target.name}")
    points = PointSet(cloud.measured, normals, colours)
    notes = (*notes, "sigma: expected error of the depth, mm")
    write_shape(target, points, scalars=cloud.sigmas(mask), notes=notes)
    return f"{name}: {len(points)} points"


def _write_merge(store: Session, name: str, target: Path, settings: ExportSettings) -> str:
    """Write the points of the merge of that number, or one mesh through them; return a description
    of what was written."""
    refuse_region(f"merge/{name}", settings.roi)
    settings.progress(0.08, "reading the merged points")
    merge, merged = read_merge(store, f"merge/{name}", settings.warn)
    notes = (
        (
            f"merge {name} of {', '.join(merge.scans)}, frame: {frame_of(store, merge.model)}, at"
            f" {merge.reference}"
        ),
        *_model_notes(store, merge.model),
        *merge.restrictions,
    )
    if settings.what == "merged-mesh":
        return _write_mesh(f"merge {name}", points_with_normals(merged), notes, target, settings)
    settings.progress(0.85, f"writing {target.name}")
    points = PointSet(merged.points, merged.normals, merged.colours)
    notes = (*notes, _ALONG_NORMAL)
    write_shape(target, points, scalars=merged.scalars, notes=notes)
    return f"merge {name}: {len(points)} points"


def _write_mesh(
    whose: str,
    source: Cloud | PointSet,
    notes: tuple[str, ...],
    target: Path,
    settings: ExportSettings,
) -> str:
    """Write a mesh of a scan or of merged points, and return a description of it."""
    progress = settings.progress
    made = build_mesh(source, settings.plan or MeshingPlan(), part(progress, 0.4, 0.8))
    done = made.text().splitlines()
    progress(0.85, f"writing {target.name}")
    write_shape(target, made.mesh, notes=(*notes, _ALONG_NORMAL, *done))
    return f"{whose}: {'; '.join(done)}"


def _model_notes(store: Session, model: str) -> tuple[str, ...]:
    """Return file comments that name the calibration and its scale correction; none without a
    model."""
    return tuple(filter(None, (model and f"calibration {model}", describe_scale(store, model))))


def _write_document(store: Session, what: What, name: str, target: Path, model: str | None) -> str:
    """Write a calibration, coefficients, poses or the table, and return a description of what was
    written."""
    if what == "calibration":
        chosen = model or preferred_model(store)
        return (
            f"{chosen} calibration of camera and projector,"
            f" {write_calibration_file(store, target, chosen)}"
        )
    if what == "coefficients":
        return f"coefficients of each pixel by the {write_coefficients(store, name, target)} model"
    if what == "poses":
        write_poses(store, model or preferred_model(store), target)
        return "poses of the devices, the target and the scans"
    write_table(store, target)
    return "figures"


def _resolve_name(store: Session, what: What, name: str) -> str:
    """Return the requested name, or by default that of the only scan, or of the last merge."""
    if what in _MERGES:
        return merge_name(store, name)
    if what not in _SCANS:
        return name
    if name:
        return store.load_capture(name).name
    scans = store.capture_names("scan")
    if len(scans) != 1:
        raise InputError(
            f"which scan? name one of {', '.join(scans)}"
            if scans
            else "there is no scan: capture one"
        )
    return scans[0]


def _output_path(
    store: Session, what: What, name: str, out: Path | str | None, chosen: str
) -> Path:
    """Return the path of the file to write, with a suffix that fits the format."""
    given = None if out is None else expand_user(out)
    if given is None or given.is_dir():
        return (given or store.exports) / default_file_name(what, name, chosen or formats(what)[0])
    suffix = given.suffix.lower().removeprefix(".")
    if chosen and suffix != chosen:
        return given.with_name(f"{given.name}.{chosen}")
    check_export(what, suffix)
    return given
