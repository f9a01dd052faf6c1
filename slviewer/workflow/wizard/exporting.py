"""Files for other programs, made in the session's `exports` folder."""

import csv
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.reconstruction.mesh import grid_triangles
from slviewer.reconstruction.reconstruct import JUMP
from slviewer.registration.open3d_loader import open3d
from slviewer.session import atomic
from slviewer.session.exporters import write_calibration
from slviewer.session.names import safe_name
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.workflow.feedback import Warn
from slviewer.workflow.models import load_stereo
from slviewer.workflow.reporting import report as write_report
from slviewer.workflow.wizard.jobs import Reporter
from slviewer.workflow.wizard.looking import merged_cloud, scan_cloud
from slviewer.workflow.wizard.snapshot import ExportView, VerificationRow

Kind = Literal["cloud", "mesh", "merged mesh", "calibration", "report", "table"]
"""A scan's points, its mesh, the mesh of the current merge, the stereo calibration, the report, the verifications."""
FORMATS: dict[Kind, tuple[str, ...]] = {
    "cloud": ("ply",),
    "mesh": ("ply", "stl", "obj", "glb"),
    "merged mesh": ("ply", "stl", "obj", "glb"),
    "calibration": ("yml", "xml", "json"),
    "report": ("html",),
    "table": ("csv",),
}
_CELLS = 400  # along the longest side of a merged cloud: what its mesh resolves


@contextmanager
def delivered(session: Session, name: str, report: Reporter) -> Iterator[Path]:
    """A path to write `name` to; when the block ends the file appears in the exports, unless the work was cancelled."""
    target = session.exports / safe_name(name)
    with atomic.staged_folder(target, 0) as folder:
        yield folder / name
        report.saving()
        os.replace(folder / name, target)
    atomic.discard(folder)


def check_export(kind: Kind, file_format: str) -> None:
    """Raise InputError for a kind or a format that there is not."""
    if kind not in get_args(Kind):
        raise InputError(f"{kind!r} cannot be exported: choose one of {', '.join(get_args(Kind))}")
    if file_format not in FORMATS[kind]:
        raise InputError(f"the {kind} cannot be written as .{file_format}: choose {', '.join(FORMATS[kind])}")


def export_file(
    session: Session,
    kind: Kind,
    name: str,
    file_format: str,
    rows: Sequence[VerificationRow],
    report: Reporter,
    warn: Warn,
) -> str:
    """Write one file; returns its name. `name` is the scan's, or the merge's; `rows` fill the table."""
    check_export(kind, file_format)
    file_name = {
        "calibration": "calibration",
        "report": "report",
        "table": "verifications",
        "merged mesh": f"merged_{name}_mesh",
        "mesh": f"{name}_mesh",
        "cloud": f"{name}_cloud",
    }[kind]
    with delivered(session, f"{file_name}.{file_format}", report) as path:
        report(0.05, f"writing {path.name}")
        if kind == "calibration":
            write_calibration(path, _calibration(session))
        elif kind == "report":
            write_report(session, path, progress=report.within(0, 1), warn=warn)
        elif kind == "table":
            _write_table(path, rows)
        elif kind == "merged mesh":
            merged = merged_cloud(session, name)
            if merged.normals is None:
                raise InputError("the merged cloud has no normals: merge the scans again")
            points, normals, faces = _surface(merged.points, merged.normals, report.within(0.1, 0.9))
            _write_mesh(path, points, None, faces, normals)
        else:
            scan = scan_cloud(session, name)
            measured = np.isfinite(scan.points).all(-1)
            faces = None
            if kind == "mesh":
                faces = grid_triangles(scan.points, JUMP * float(np.median(scan.points[..., 2][measured])))
            report(0.6, f"writing {path.name}")
            _write_mesh(path, scan.points[measured], scan.texture[measured], faces)
    report(1.0, "exported")
    return f"{file_name}.{file_format}"


def listed(session: Session) -> tuple[ExportView, ...]:
    """What the exports folder holds."""
    folder = session.folder / "exports"
    if not folder.is_dir():
        return ()
    found = []
    for entry in sorted(folder.iterdir()):
        if entry.is_file() and not entry.name.startswith("."):
            found.append(ExportView(entry.name, entry, entry.stat().st_size))
    return tuple(found)


def _calibration(session: Session) -> dict[str, np.ndarray | str | float]:
    stereo = load_stereo(session)
    rig = stereo.rig
    rms = {f"reprojection_rms_px_{name}": float(value) for name, value in stereo.reprojection_rms_px.items()}
    return {
        "K_camera": rig.camera.K,
        "D_camera": rig.camera.D,
        "K_projector": rig.projector.K,
        "D_projector": rig.projector.D,
        "R": rig.R,
        "T": rig.t,
        "camera_size": np.array(rig.camera.size),
        "projector_size": np.array(rig.projector.size),
        **({"target": stereo.board} if stereo.board else {}),
        **rms,
    }


def _write_table(path: Path, rows: Sequence[VerificationRow]) -> None:
    if not rows:
        raise InputError("nothing is verified yet: capture a plane or a sphere first")
    titles = ["capture", "name", "shape", "model", "rms_mm", "noise_floor_mm", "radius_mm", "points", "set_aside"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*titles, "coverage", "R1_percent", "R2_percent", "R3_percent"])
        for r in rows:
            figures = (r.rms_mm, r.noise_floor_mm, r.radius_mm, r.points, r.set_aside, r.coverage)
            shares = r.incidence or {}
            writer.writerow(
                [
                    r.capture,
                    _harmless(r.label),
                    r.shape,
                    r.model,
                    *figures,
                    *(shares.get(k) for k in ("R1", "R2", "R3")),
                ]
            )


def _harmless(text: str) -> str:
    """A name that a spreadsheet does not take for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t") else text


def _surface(points: np.ndarray, normals: np.ndarray, report: Reporter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(vertices, normals, faces) of one surface through the points, by Poisson; cut off where no points are near."""
    o3d = open3d()
    known = np.isfinite(normals).all(1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[known].astype(float)))
    cloud.normals = o3d.utility.Vector3dVector(normals[known].astype(float))
    extent = float(np.ptp(np.percentile(points, [1, 99], axis=0), axis=0).max())
    cloud = cloud.voxel_down_sample(extent / _CELLS)
    # no finer than the points lie apart: the rest would be invented
    spacing = float(np.median(np.asarray(cloud.compute_nearest_neighbor_distance())))
    cell = max(extent / _CELLS, spacing)
    report(0.3, "a surface through the points")
    depth = int(np.ceil(np.log2(1.1 * extent / cell)))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth)
    report(0.8, "cutting off what was not measured")
    skin = o3d.geometry.PointCloud(mesh.vertices)
    mesh.remove_vertices_by_mask(np.asarray(skin.compute_point_cloud_distance(cloud)) > 3 * cell)
    if not len(mesh.triangles):
        raise SlviewerError("no surface could be laid through the merged points: merge scans that overlap more")
    mesh.compute_vertex_normals()
    return np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), np.asarray(mesh.triangles)


def _write_mesh(
    path: Path,
    points: np.ndarray,
    colours: np.ndarray | None,
    faces: np.ndarray | None,
    normals: np.ndarray | None = None,
) -> None:
    if path.suffix == ".ply":
        write_ply(path, points, colours=colours, normals=normals, faces=faces)
        return
    import trimesh  # a third of a second

    if colours is not None and colours.ndim == 1:
        colours = np.repeat(colours[:, None], 3, axis=1)
    mesh = trimesh.Trimesh(points, faces, vertex_colors=colours, vertex_normals=normals, process=False)
    mesh.export(path)
