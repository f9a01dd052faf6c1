"""Files for other programs, of everything that a session holds. The wizard's step Export and the
command call this."""

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from slviewer import __version__
from slviewer.calibration.pinhole_fit import fit_splined, pixelwise_residuals
from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError, UsageError
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import rigid_transform
from slviewer.pipeline.cloud_corrections import (
    describe_scale,
    resolve_region,
    restriction_notes,
    scale_factor,
)
from slviewer.pipeline.machine_poses import load_places
from slviewer.pipeline.models import (
    ModelName,
    available_models,
    check_accepted,
    frame_of,
    load_model,
    load_stereo,
    preferred_model,
    warn_of_calibration,
)
from slviewer.pipeline.operation import (
    Callbacks,
    SessionLike,
    Stored,
    list_records,
    opened,
    part,
    takes_settings,
)
from slviewer.pipeline.reconstruct import (
    load_origin,
    merge_name,
    points_with_normals,
    read_merge,
    scan_cloud,
)
from slviewer.pipeline.report import report
from slviewer.printable import format_csv
from slviewer.process import call_apart
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import cloud_normals
from slviewer.records.kinds import all_kinds
from slviewer.records.merge import Merge
from slviewer.records.record import Value
from slviewer.session.atomic import arriving_file, format_bytes, replace_file
from slviewer.session.exporters import write_calibration
from slviewer.session.names import natural_key
from slviewer.session.reading import expand_user
from slviewer.session.shape_files import (
    all_formats,
    describe_loss,
    estimated_bytes,
    mesh_formats,
    point_formats,
    write_shape,
)
from slviewer.session.store import Session
from slviewer.surface.meshing import TRIANGLES_PER_POINT, MeshingPlan, build_mesh
from slviewer.surface.shapes import PointSet, move_shape

_FRAMES = (
    "T_a_b maps points of frame b into frame a: X_a = T_a_b X_b, in mm. Camera and projector look"
    " along their z, x to the right and y down in the image"
)
_CALIBRATION = {
    "units": (
        "lengths in mm, image coordinates in px; pixel (0, 0) is the centre of the top left one"
    ),
    "model": (
        "pinhole cameras with OpenCV's distortion; what the pixels learnt beyond it is in the"
        " coefficients' file"
    ),
    "frame": (
        "the frame that X_camera means here and in clouds of this model; another model's may be"
        " turned against it"
    ),
    "target": "the board of the target poses: kind, columns x rows, pitch in mm",
    "camera_size": "width and height of the camera's image, px",
    "projector_size": "width and height of the projector's image, px",
    "K_camera": "intrinsics of the camera: fx 0 cx, 0 fy cy, 0 0 1, px",
    "D_camera": "distortion of the camera: k1 k2 p1 p2 k3, as OpenCV orders them",
    "K_projector": "intrinsics of the projector, as an inverse camera, px",
    "D_projector": "distortion of the projector: k1 k2 p1 p2 k3",
    "R": "rotation from the camera's frame into the projector's: X_projector = R X_camera + T",
    "T": "translation of the same, mm",
    "T_projector_camera": "R and T as one matrix. " + _FRAMES,
    "T_camera_projector": (
        "its inverse, the projector's pose in the camera's frame: the last column is its centre, mm"
    ),
    "baseline_mm": "distance between the centres of camera and projector, mm",
    "scale_factor": "correction of the scale by a certified artefact, which is in T already",
    "depth_range_mm": "nearest and farthest depth of the target poses, mm",
    "target_poses": "number of target poses that it was made from",
    "fit_rms_px_camera": (
        "RMS distance of these lenses' image of the model's own rays from their pixels, camera, px"
    ),
    "fit_max_px_camera": "the largest of these distances, px",
    "fit_rms_px_projector": (
        "RMS distance of these lenses' image of the model's own rays from their pixels, projector"
    ),
    "fit_max_px_projector": "the largest of these distances, px",
    "reprojection_rms_px_stereo": (
        "RMS distance of measured from predicted features in both devices, px"
    ),
    "reprojection_rms_px_camera": "the camera's alone, px",
    "reprojection_rms_px_projector": "the projector's alone, px",
}
_FIGURES = ("rms_mm", "overlap", "sigma_shift_mm", "sigma_turn_deg")
"""Of a scan's registration: its RMS, the share of it that overlaps, and the standard deviations of
its pose."""
_POSES = {
    "frames": _FRAMES,
    "model": "the calibration that the projector's pose is of",
    "camera": "the reference frame is the camera's, as calibrated, which every scan is measured in",
    "projector": "the projector's pose in it: the last column is its centre, mm",
    "targets": "where the board stood in each target pose",
    "merges": (
        "how the scans of each merge lie: T_reference_scan, the pose of the camera in the object's"
        " frame, which is the camera's at the reference scan, and T_reference_projector, that of"
        " the projector"
    ),
}
_PIXELWISE = (
    "slviewer, model pixelwise: for axis x or y and camera pixel (row, column), c ="
    " <axis>_coefficients[:, row, column], phi the absolute phase in rad of fringes of"
    " <axis>_period_px projector px, phi = 2 pi u/period: z = (c0 + c1 phi)/(1 + c2 phi), x ="
    " c3 z, y = c4 z, in mm in the camera's frame, all times scale_factor. <axis>_rms_mm: the"
    " fit's RMS in z, x, y; <axis>_poses: target poses used; <axis>_phase_min, _phase_max: the"
    " phases used. NaN where not fitted."
)
_SPLINED = (
    "slviewer, model splined, compiled: for axis x or y and camera pixel (row, column), c ="
    " <axis>_coefficients[:, row, column], s = projector coordinate in px less"
    " <axis>_centre_px: z0 = (c0 + c1 s)/(1 + c2 s); z = z0 + g, g interpolated linearly in"
    " <axis>_grid at (row/step, column/step, (z0 - near)/(far - near) (n - 1)) with"
    " <axis>_grid_step_px, near and far = <axis>_depths_mm and n the grid's last length; x ="
    " rays[0] z, y = rays[1] z, in mm in the camera's frame, all times scale_factor. NaN: not"
    " measured."
)


def write_calibration_file(store: Session, path: Path, model: str) -> str:
    """A model's pinholes and Brown lenses with names, units and quality, as OpenCV's YAML or XML,
    or as JSON; returns what they leave, in words.

    Of the splined model the best fit in the frame of its own clouds; the others stand on stereo's
    lenses.
    """
    stereo, factor = load_stereo(store), scale_factor(store, model)
    fitted = load_model(store, model)
    rig, fits, depths, count = stereo.rig, {}, stereo.depth_range_mm, len(stereo.poses)
    if isinstance(fitted, SplinedModel):
        camera, projector = fit_splined(fitted)
        rig = StereoRig(camera.lens, projector.lens, fitted.rig.R, fitted.rig.t)
        fits = {"camera": camera, "projector": projector}
        depths, count = fitted.bundle.depth_range_mm, len(fitted.bundle.poses)
    elif isinstance(fitted, PixelwiseModel):
        fits = {"camera": pixelwise_residuals(fitted, rig.camera)}
    T = rigid_transform(rig.R, factor * rig.t)
    entries: dict[str, Any] = {
        "program": f"slviewer {__version__}",
        "units": "mm, px",
        "model": model,
        "frame": frame_of(store, model),
        "target": stereo.board or None,
        "camera_size": np.array(rig.camera.size),
        "projector_size": np.array(rig.projector.size),
        "K_camera": rig.camera.K,
        "D_camera": rig.camera.D,
        "K_projector": rig.projector.K,
        "D_projector": rig.projector.D,
        "R": rig.R,
        "T": factor * rig.t,
        "T_projector_camera": T,
        "T_camera_projector": np.linalg.inv(T),
        "baseline_mm": factor * rig.baseline_mm,
        "scale_factor": None if factor == 1 else factor,
        "depth_range_mm": factor * np.array(depths) if depths else None,
        "target_poses": count or None,
    }
    entries = {name: value for name, value in entries.items() if value is not None}
    for device, fit in fits.items():
        entries |= {f"fit_rms_px_{device}": fit.rms_px, f"fit_max_px_{device}": fit.max_px}
    if not isinstance(fitted, SplinedModel):
        entries |= {
            f"reprojection_rms_px_{name}": float(value)
            for name, value in stereo.reprojection_rms_px.items()
        }
    write_calibration(path, entries, _CALIBRATION)
    errors = ", ".join(
        f"{fit.rms_px:.3f} px RMS and {fit.max_px:.3f} px at most in the {device}"
        for device, fit in fits.items()
    )
    return f"in the frame of the {entries['frame']}" + (
        f"; remaining error of pinhole and Brown distortion: {errors}" if errors else ""
    )


def write_coefficients(store: Session, name: str, path: Path) -> str:
    """Each pixel's rational function as .npz with an ``about`` in words, of the model ``name``
    (pixelwise or splined; empty: the one there is, pixelwise first); returns which."""
    there = [model for model in ("pixelwise", "splined") if model in available_models(store)]
    if not (name or there) or name == "stereo":
        raise InputError(
            "only the pixelwise and the splined model have coefficients for each pixel",
            "calibrate these",
        )
    model = load_model(store, name or there[0])
    entries: dict[str, Any] = {"scale_factor": scale_factor(store, model.name)}
    if isinstance(model, SplinedModel):
        entries |= {"about": _SPLINED, "rays": model.rays}
        for axis in model.axes:
            fast = model.fast_axis(axis)
            entries |= {
                f"{axis}_coefficients": fast.coefficients,
                f"{axis}_centre_px": fast.centre,
                f"{axis}_grid": fast.supported_grid,
                f"{axis}_grid_step_px": fast.step,
                f"{axis}_depths_mm": [fast.near, fast.far],
            }
    else:
        assert isinstance(model, PixelwiseModel)
        entries["about"] = _PIXELWISE
        for axis, fit in model.fits.items():
            entries[f"{axis}_period_px"] = model.periods_px[axis]
            for key in ("coefficients", "rms_mm", "poses", "phase_min", "phase_max"):
                entries[f"{axis}_{key}"] = getattr(fit, key)
    arrays = {key: np.asarray(value) for key, value in entries.items()}
    with arriving_file(path, sum(array.nbytes for array in arrays.values())) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return model.name


def write_poses(store: Session, model: str, path: Path) -> None:
    """Camera and projector, the board in each target pose, and the scans of each merge, as 4x4
    matrices."""
    entries: dict[str, Any] = {
        "program": f"slviewer {__version__}",
        "units": "mm",
        "frames": _FRAMES,
        "model": model,
        "camera": {"T_reference_camera": np.eye(4)},
        "projector": {"T_reference_projector": np.linalg.inv(_projector_transform(store, model))},
    }
    if targets := _target_pose_entries(store, model):
        entries["targets"] = targets
    if merges := list_records(store, Merge):
        entries["merges"] = [_merge_entry(store, each) for each in merges]
    write_calibration(path, entries, _POSES)


def _target_pose_entries(store: Session, model: str) -> list[dict[str, Any]]:
    """Return name, transform (4, 4) mm and reprojection RMS of each target pose by a model."""
    fitted, factor = load_model(store, model), scale_factor(store, model)
    if isinstance(fitted, SplinedModel):
        bundle = fitted.bundle
        rms = {name: (fit.camera_rms_px, fit.projector_rms_px) for name, fit in bundle.fits.items()}
        T_camera_board = rigid_transform(bundle.state.R_board, bundle.state.t_board)
        poses = dict(zip(bundle.poses, T_camera_board, strict=True))
    else:
        stereo = load_stereo(store)
        poses, rms = dict(stereo.poses), dict(stereo.pose_rms_px)
    figures = ("camera_rms_px", "projector_rms_px")
    return [
        {
            "name": name,
            "T_camera_board": rigid_transform(poses[name][:3, :3], factor * poses[name][:3, 3]),
            **dict(zip(figures, map(float, rms.get(name, ())), strict=False)),
        }
        for name in sorted(poses, key=natural_key)
    ]


def _merge_entry(store: Session, each: Stored[Merge]) -> dict[str, Any]:
    """Return a merge's scans with their transforms (4, 4) mm to the reference and their
    registration figures."""
    made = each.record
    model = made.model if made.model in available_models(store) else "stereo"
    projector = np.linalg.inv(_projector_transform(store, model))
    scans, poses = [], made.poses
    for scan in made.scans:
        T = poses[scan]
        entry = {"name": scan, "T_reference_scan": T, "T_reference_projector": T @ projector}
        figures = ((key, getattr(made.pairs.get(scan), key, None)) for key in _FIGURES)
        scans.append(entry | {key: value for key, value in figures if value is not None})
    return {"name": each.name, "reference": made.reference, "model": made.model, "scans": scans}


def _projector_transform(store: Session, model: str) -> np.ndarray:
    """T_projector_camera (4, 4) mm by a model, with its correction of scale."""
    fitted = load_model(store, model)
    rig = fitted.rig if isinstance(fitted, SplinedModel) else load_stereo(store).rig
    return rigid_transform(rig.R, scale_factor(store, model) * rig.t)


def write_table(store: Session, path: Path) -> None:
    """Write the tables of all records as one CSV: a line for each of theirs, the kind and whether
    it is up to date."""
    rows: list[dict[str, Value]] = []
    for each in (each for kind in all_kinds().values() for each in list_records(store, kind)):
        start = {
            "kind": each.record.kind,
            "record": each.name,
            "label": each.label,
            "up to date": "no" if each.stale else "yes",
        }
        for table in each.record.tables({each.name: each.record}):
            headings = [column.heading for column in table.columns]
            rows += [
                {**start, **dict(zip(headings, table.values(row), strict=True))}
                for row in table.rows
            ]
    if not rows:
        raise InputError("nothing was found yet", "verify, reconstruct or merge captures first")
    titles = list(dict.fromkeys(title for row in rows for title in row))
    lines = ([row.get(title) for title in titles] for row in rows)
    replace_file(path, format_csv([titles, *lines]).encode())


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
_SCANS, _MERGES, _MESHES = ("cloud", "mesh"), ("merge", "merged-mesh"), ("mesh", "merged-mesh")


def formats(what: What) -> tuple[str, ...]:
    """Return the formats of an export; the first is the default. Raises InputError for what cannot
    be exported."""
    if what in ("cloud", "merge"):
        return point_formats()
    if what in _MESHES:
        return mesh_formats()
    if what in _DOCUMENT_FORMATS:
        return _DOCUMENT_FORMATS[what]
    raise InputError(f"{what!r} cannot be exported", f"choose one of {', '.join(get_args(What))}")


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
    shape = all_formats().get(file_format)
    return shape.what if shape else DOCUMENTS.get(file_format, "")


def estimate_file_bytes(
    what: What, file_format: str, points: int, model: str, triangles: int | None
) -> int:
    """About how large a file of a scan or a merge of so many points becomes at most, thinned to
    ``triangles`` where that is wanted."""
    if what in ("cloud", "merge"):
        return estimated_bytes(file_format, points, scalars=3 if model == "splined" else 1)
    faces = TRIANGLES_PER_POINT * points
    if triangles is not None:
        # a surface fitted to the points may have more
        faces = min(triangles, faces) if what == "mesh" else triangles
    return estimated_bytes(file_format, faces // 2, faces, scalars=1)


def check_export(what: What, file_format: str) -> None:
    """Raise InputError for something that cannot be exported, or not in this format."""
    if _ALIASES.get(file_format, file_format) not in formats(what):
        listed = ", ".join(f".{each}" for each in formats(what))
        raise InputError(f"the {what} cannot be written as .{file_format}", f"choose {listed}")


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
        what: cloud and mesh of a scan, without extrapolated points; merge (the points) and
            merged-mesh; calibration for OpenCV or as JSON; coefficients of each pixel as .npz;
            poses of camera, projector, target and scans as 4x4 matrices; report as HTML; table of
            the figures of verifications, clouds and merges as CSV.
        name: The scan of a cloud or a mesh, or a merge, as merge/1; the number of a merge, by
            default the last; the model of coefficients.
        out: The file, whose suffix selects the format, or a folder; by default the session's
            exports.
        file_format: ply, stl, obj, glb, 3mf, xyz, pcd, e57, yml, xml, json, ..., where --out is a
            folder or not given.
        model: Which calibration to make a cloud with, by default the one of the stored cloud, or
            the best; or which to write (of splined the pinhole and Brown lenses that come nearest,
            and their remaining error).
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
            A merge was cut when it was made.
        frame: Of clouds and meshes: camera, or robot, the base of the machine whose poses `import
            poses` stored, by the hand-eye calibration.
        full: Of a report: also what concerns the rig, not the part.
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
    frame: Literal["camera", "robot"] = "camera"
    full: bool = False
    accept_rejected: bool = False


@takes_settings(ExportSettings)
def export(settings: ExportSettings) -> Exported:
    """Write a file for other programs: points and meshes in mm, or in the unit that the format
    demands, calibration, poses."""
    what = settings.what
    if what in _SCANS and settings.name.startswith(f"{Merge.kind}/"):
        what = "merge" if what == "cloud" else "merged-mesh"
        settings = replace(settings, what=what)
    if settings.frame == "robot" and what not in (*_SCANS, *_MERGES):
        raise UsageError(f"{what} has no frame of its own", "omit --frame")
    with opened(settings.session) as store:
        chosen = settings.file_format.lower().removeprefix(".")
        file_format = chosen or formats(what)[0]
        check_export(what, file_format)
        name = _resolve_name(store, what, settings.name)
        target = store.exports if settings.out is None else expand_user(settings.out)
        if target.is_dir():
            target /= default_file_name(what, name, file_format)
        elif chosen and target.suffix.lower() != f".{chosen}":
            target = target.with_name(f"{target.name}.{chosen}")
        check_export(what, target.suffix.lower().removeprefix("."))
        if what not in ("report", "table"):
            check_accepted(store, settings.accept_rejected)
            if what not in _MERGES:  # reading a merge warns by itself
                warn_of_calibration(store, settings.warn)
        write = _write_document if what in _DOCUMENT_FORMATS else _write_shape
        words = write(store, name, target, settings)
    settings.progress(1.0, "exported")
    return Exported(target, target.stat().st_size, words)


def _write_shape(store: Session, name: str, target: Path, settings: ExportSettings) -> str:
    """Write the points of a scan or a merge with normals, colours and sigmas, or a mesh of them;
    return a description of what was written."""
    progress, is_scan = settings.progress, settings.what in _SCANS
    source: Cloud | PointSet
    if is_scan:
        job = settings.job(store).part(0, 0.4)
        cloud = scan_cloud(job, name, settings.model, settings.roi)
        if not (mask := cloud.mask).any():
            raise InputError(
                f"{name}: no pixel was measured",
                "does the calibration belong to this camera and projector?",
            )
        whose, model, placed = name, cloud.model, name
        origin = f"scan {name}, frame: {frame_of(store, model)}, x right, y down, z away"
        restrictions = restriction_notes(store, [name], resolve_region(store, settings.roi))
    else:
        whose = f"merge {name}"
        progress(0.08, "reading the merged points")
        merge, merged = read_merge(store, f"merge/{name}", settings.warn, settings.roi)
        model, restrictions, placed = merge.model, tuple(merge.restrictions), merge.reference
        frame = f"{frame_of(store, model)}, at {merge.reference}"
        origin = f"{whose} of {', '.join(merge.scans)}, frame: {frame}"
    origin_mm, T_frame_camera = load_origin(store, placed), None
    if settings.frame == "robot":
        if origin_mm is not None:
            raise InputError(
                f"{placed} was imported with far coordinates of its own, which no machine placed",
                "export it without --frame robot",
            )
        T_frame_camera = load_places(store, [placed], model)[placed].T
        origin = f"{whose}, frame: base of the machine that placed {placed}"
    calibration = model and f"calibration {model}", describe_scale(store, model)
    notes = [origin, *filter(None, calibration), *restrictions]
    if settings.what in _MESHES:
        source = cloud if is_scan else points_with_normals(merged)
        plan, meshing = settings.plan or MeshingPlan(), part(progress, 0.4, 0.8)
        built = call_apart(build_mesh, source, plan, progress=meshing)
        made = built.text().splitlines()
        progress(0.85, f"writing {target.name}")
        mesh = replace(built.mesh, origin=origin_mm)
        if T_frame_camera is not None:
            mesh = move_shape(T_frame_camera, mesh)
        write_shape(target, mesh, notes=[*notes, _ALONG_NORMAL, *made])
        return "; ".join(
            [f"{whose}: {'; '.join(made)}", *filter(None, [describe_loss(target, mesh)])]
        )
    if is_scan:
        progress(0.56, "normals")
        normals, rgb = cloud_normals(cloud)[mask], cloud.rgb
        points = PointSet(cloud.measured, normals, None if rgb is None else rgb[mask])
        scalars, sigma = cloud.sigmas(mask), "sigma: expected error of the depth, mm"
    else:
        points = PointSet(merged.points, merged.normals, merged.colours)
        scalars, sigma = merged.scalars, _ALONG_NORMAL
    points = replace(points, origin=origin_mm)
    progress(0.85, f"writing {target.name}")
    if T_frame_camera is not None:
        points = move_shape(T_frame_camera, points)
    write_shape(target, points, scalars=scalars, notes=[*notes, sigma])
    loss = describe_loss(target, points, cloud.scalars if is_scan else ())
    return "; ".join([f"{whose}: {len(points)} points", *filter(None, [loss])])


def _write_document(store: Session, name: str, target: Path, settings: ExportSettings) -> str:
    """Write a report, a calibration, coefficients, poses or the table, and return a description of
    what was written."""
    what, progress = settings.what, settings.progress
    if what == "report":
        report(store, target, full=settings.full, progress=progress, warn=settings.warn)
        return "report"
    progress(0.1, f"writing {target.name}")
    if what == "coefficients":
        return f"coefficients of each pixel by the {write_coefficients(store, name, target)} model"
    if what == "table":
        write_table(store, target)
        return "figures"
    model = settings.model or preferred_model(store)
    if what == "poses":
        write_poses(store, model, target)
        return "poses of the devices, the target and the scans"
    words = write_calibration_file(store, target, model)
    return f"{model} calibration of camera and projector, {words}"


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
