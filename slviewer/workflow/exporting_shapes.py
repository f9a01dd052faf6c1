"""Scans and merges as shapes for other programs: what is kept in the session, or what its frames give."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.mesh import grid_triangles
from slviewer.reconstruction.reconstruct import JUMP
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.registration.open3d_loader import open3d
from slviewer.session.names import natural_key
from slviewer.session.ply import Ply, read_ply
from slviewer.session.store import Session
from slviewer.surface.shapes import Mesh, PointSet
from slviewer.workflow.decoding import capture_texture, decode_capture
from slviewer.workflow.feedback import Progress, Warn, part
from slviewer.workflow.models import load_model, preferred
from slviewer.workflow.scaling import corrected_cloud, scale_factor, told_scale
from slviewer.workflow.trust import told

_CELLS = 400  # along the longest side of a merged cloud: what its mesh resolves


@dataclass(frozen=True, eq=False)
class Described:
    """A shape, whose it is, values of its points by name, and what a file's comments say of it."""

    shape: PointSet | Mesh
    whose: str
    scalars: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """For people."""
        if isinstance(self.shape, Mesh):
            return f"{self.whose}: {len(self.shape.faces)} triangles between {len(self.shape.vertices)} points"
        return f"{self.whose}: {len(self.shape)} points"


def is_fresh(store: Session, result: str) -> bool:
    """Whether a result's inputs are as they were, and no correction of scale has changed since."""
    if store.state_of(result) != "fresh":
        return False
    scales = store.load_result(result, only=())[0].get("scales", {})
    return all(scale_factor(store, model) == factor for model, factor in scales.items())


def scan_shape(store: Session, name: str, model: str | None, mesh: bool, progress: Progress, warn: Warn) -> Described:
    """A scan's measured points, or the triangles between neighbouring pixels, with normals, colours and sigmas."""
    cloud = scan_cloud(store, name, model, part(progress, 0, 0.6), warn)
    mask = cloud.mask
    if not mask.any():
        raise InputError(f"{name}: no pixel was measured: does the calibration belong to this camera and projector?")
    progress(0.7, "normals")
    normals, colours = grid_normals(cloud.points)[mask], cloud.colours()
    if colours is not None and colours.ndim == 1:
        colours = np.repeat(colours[:, None], 3, axis=1)
    notes = (f"scan {name}, frame: the camera's, x right, y down, z away", *_of_model(store, cloud.model))
    scalars = cloud.sigmas(mask)
    if not mesh:
        return Described(PointSet(cloud.measured, normals, colours), name, scalars, notes)
    progress(0.8, "triangles")
    faces = grid_triangles(cloud.points, JUMP * float(np.median(cloud.points[..., 2][mask])))
    if not len(faces):
        raise InputError(f"{name}: no three neighbouring pixels were measured: export its points instead")
    used, faces = np.unique(faces, return_inverse=True)  # points alone among pixels that were not measured are left out
    shape = Mesh(
        cloud.measured[used],
        faces.reshape(-1, 3),
        normals[used],
        None if colours is None else colours[used],
    )
    shape = replace(shape, normals=_completed(shape))
    return Described(shape, name, {what: values[used] for what, values in scalars.items()}, notes)


def scan_cloud(store: Session, name: str, model: str | None, progress: Progress, warn: Warn) -> Cloud:
    """A capture's cloud: the one that is kept, where it is up to date and of the model wanted, else made now."""
    capture, model, kept = store.load_capture(name), model or None, f"clouds/{name}"
    if store.has_result(kept) and is_fresh(store, kept):
        meta = store.load_result(kept, only=())[0]
        if model in (None, meta["model"]):
            names = {"points", "sigma_z", "texture", "sigma_calibration"} & set(meta["arrays"])
            arrays = store.load_result(kept, only=names)[1]
            return Cloud(axis=meta["axis"], model=meta["model"], **arrays)
    fitted = load_model(store, model or preferred(store))
    progress(0.1, f"reading {name}")
    frames = capture.stack()
    for sentence in told(store, name, frames):
        warn(f"{name}: {sentence}")
    progress(0.4, f"reconstructing {name}")
    phases = decode_capture(capture, frames)
    return corrected_cloud(store, fitted, phases, texture=capture_texture(capture, frames))


def merge_name(store: Session, name: str) -> str:
    """The merge of that number, or the last one where none is named; InputError where there is none."""
    there = sorted((n.removeprefix("merge/") for n in store.result_names() if n.startswith("merge/")), key=natural_key)
    if not there:
        raise InputError("there is no merge yet: merge scans first")
    if name and name not in there:
        raise InputError(f"there is no merge {name!r}: the merges are {', '.join(there)}")
    return name or there[-1]


def merge_shape(store: Session, name: str, mesh: bool, progress: Progress, warn: Warn) -> Described:
    """The points of a merge, or one surface through them, cut off where nothing was measured."""
    name = merge_name(store, name)
    if not is_fresh(store, f"merge/{name}"):
        warn(f"merge {name} came from scans or a calibration that have changed since: merge again")
    meta = store.load_result(f"merge/{name}", only=())[0]
    progress(0.1, "reading the merged points")
    merged = read_ply(store.exports / str(meta["ply"]))
    notes = (
        f"merge {name} of {', '.join(meta['scans'])}, frame: the camera's at {meta['reference']}",
        *_of_model(store, str(meta.get("model", ""))),
    )
    if not mesh:
        return Described(PointSet(merged.points, merged.normals, _rgb(merged)), f"merge {name}", merged.scalars, notes)
    if merged.normals is None:
        raise InputError("the merged cloud has no normals: merge the scans again")
    surface = _surface(merged.points, merged.normals, part(progress, 0.1, 0.9))
    return Described(surface, f"merge {name}", {}, notes)


def _of_model(store: Session, model: str) -> tuple[str, ...]:
    scale = told_scale(store, model) if model else ""
    return (f"calibration {model}", *((scale,) if scale else ())) if model else ()


def _rgb(merged: Ply) -> np.ndarray | None:
    colours = merged.colours
    return np.repeat(colours[:, None], 3, axis=1) if colours is not None and colours.ndim == 1 else colours


def _completed(shape: Mesh) -> np.ndarray:
    """The normals of the grid, and at its borders, where it gives none, those of the triangles around."""
    import trimesh  # a third of a second

    assert shape.normals is not None
    lacking = ~np.isfinite(shape.normals).all(axis=1)
    if not lacking.any():
        return shape.normals
    around = trimesh.Trimesh(shape.vertices, shape.faces, process=False).vertex_normals
    return np.where(lacking[:, None], around, shape.normals).astype(np.float32)


def _surface(points: np.ndarray, normals: np.ndarray, progress: Progress) -> Mesh:
    """One surface through the points, by Poisson; cut off where no points are near."""
    o3d = open3d()
    known = np.isfinite(normals).all(1) & normals.any(1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[known].astype(float)))
    cloud.normals = o3d.utility.Vector3dVector(normals[known].astype(float))
    extent = float(np.ptp(np.percentile(points, [1, 99], axis=0), axis=0).max())
    cloud = cloud.voxel_down_sample(extent / _CELLS)
    # no finer than the points lie apart: the rest would be invented
    spacing = float(np.median(np.asarray(cloud.compute_nearest_neighbor_distance())))
    cell = max(extent / _CELLS, spacing)
    progress(0.3, "a surface through the points")
    depth = int(np.ceil(np.log2(1.1 * extent / cell)))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth)
    progress(0.8, "cutting off what was not measured")
    skin = o3d.geometry.PointCloud(mesh.vertices)
    mesh.remove_vertices_by_mask(np.asarray(skin.compute_point_cloud_distance(cloud)) > 3 * cell)
    if not len(mesh.triangles):
        raise SlviewerError("no surface could be laid through the merged points: merge scans that overlap more")
    mesh.compute_vertex_normals()
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(mesh.vertex_normals))
