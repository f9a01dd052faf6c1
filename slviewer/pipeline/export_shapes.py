"""Scans and merges as shapes for other programs: those stored in the session, or computed from its
frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Progress, Warn, part
from slviewer.pipeline.models import frame_of, load_model
from slviewer.pipeline.open_session import numbered_results
from slviewer.pipeline.scale import describe_scale
from slviewer.pipeline.scan_edits import resolve_region, restrict_cloud, restriction_notes
from slviewer.pipeline.stored_records import is_up_to_date
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.session.ply import Ply, read_ply
from slviewer.session.store import Session
from slviewer.surface.meshing import BuiltMesh, MeshingPlan, build_mesh
from slviewer.surface.shapes import Mesh, PointSet


@dataclass(frozen=True, eq=False)
class DescribedShape:
    """A shape, whose it is, values of its points by name, the comments of its file, and of these
    what was done to make a mesh."""

    shape: PointSet | Mesh
    whose: str
    scalars: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    done: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        if isinstance(self.shape, Mesh):
            return f"{self.whose}: {'; '.join(self.done)}"
        return f"{self.whose}: {len(self.shape)} points"


def scan_shape(
    store: Session,
    name: str,
    model: str | None,
    plan: MeshingPlan | None,
    progress: Progress,
    warn: Warn,
    accept_rejected: bool = False,
    roi: str = "",
) -> DescribedShape:
    """A scan's measured points with normals, colours and sigmas, or where there is a ``plan`` a
    mesh of them."""
    cloud = scan_cloud(store, name, model, part(progress, 0, 0.5), warn, accept_rejected, roi)
    mask = cloud.mask
    if not mask.any():
        raise InputError(
            f"{name}: no pixel was measured: does the calibration belong to this camera and"
            " projector?"
        )
    frame = f"frame: {frame_of(store, cloud.model)}, x right, y down, z away"
    restrictions = restriction_notes(store, [name], resolve_region(store, roi))
    notes = (f"scan {name}, {frame}", *_model_notes(store, cloud.model), *restrictions)
    if plan is not None:
        return _describe_mesh(name, build_mesh(cloud, plan, part(progress, 0.5, 1)), notes)
    progress(0.7, "normals")
    normals = grid_normals(cloud.points)[mask]
    colours = None if (rgb := cloud.rgb) is None else rgb[mask]
    note = "sigma: expected error of the depth, mm"
    return DescribedShape(
        PointSet(cloud.measured, normals, colours), name, cloud.sigmas(mask), (*notes, note)
    )


def scan_cloud(
    store: Session,
    name: str,
    model: str | None,
    progress: Progress,
    warn: Warn,
    accept_rejected: bool = False,
    roi: str = "",
) -> Cloud:
    """A capture's cloud: the stored one where it is up to date and of the requested model, else
    reconstructed; without what was deleted from it, and what lies outside of the region ``roi``, as
    `resolve_region` reads it.
    """
    region = resolve_region(store, roi)
    cloud = _whole_cloud(store, name, model, progress, warn, accept_rejected)
    return restrict_cloud(store, name, cloud, region)


def _whole_cloud(
    store: Session,
    name: str,
    model: str | None,
    progress: Progress,
    warn: Warn,
    accept_rejected: bool,
) -> Cloud:
    """Return a capture's cloud as `scan_cloud`, with all of its points."""
    capture, model, stored = store.load_capture(name), model or None, f"clouds/{name}"
    if store.has_result(stored) and is_up_to_date(store, stored):
        meta = store.load_result(stored, only=())[0]
        if model in (None, meta["model"]):
            names = {"points", "sigma_z", "texture", "sigma_calibration", "sigma_edges"} & set(
                meta["arrays"]
            )
            arrays = store.load_result(stored, only=names)[1]
            return Cloud(axis=meta["axis"], model=meta["model"], **arrays)
    fitted = load_model(store, model)
    progress(0.1, f"reading {name}")
    check_capture_sizes(store, [name])
    _, frames, phases = next(decode_captures(store, [name], warn))
    progress(0.4, f"reconstructing {name}")
    texture = capture_texture(capture, frames, stretch=False)
    return capture_cloud(
        store, fitted, capture, phases, texture=texture, accept_rejected=accept_rejected, warn=warn
    )


def merge_name(store: Session, name: str) -> str:
    """The merge of that number, or the last one where none is named; raises InputError where it
    does not exist."""
    there = [result.removeprefix("merge/") for result in numbered_results(store, "merge")]
    if not there:
        raise InputError("there is no merge yet: merge scans first")
    if name and name not in there:
        raise InputError(f"there is no merge {name!r}: the merges are {', '.join(there)}")
    return name or there[-1]


def merge_shape(
    store: Session, name: str, plan: MeshingPlan | None, progress: Progress, warn: Warn
) -> DescribedShape:
    """The points of a merge, or where there is a ``plan`` one mesh through them."""
    name = merge_name(store, name)
    progress(0.1, "reading the merged points")
    meta, merged = read_merge(store, f"merge/{name}", warn)
    model = str(meta.get("model", ""))
    notes = (
        (
            f"merge {name} of {', '.join(meta['scans'])}, frame: {frame_of(store, model)}, at"
            f" {meta['reference']}"
        ),
        *_model_notes(store, model),
        *meta.get("restrictions", ()),
    )
    if plan is None:
        note = "sigma: expected error along the normal, mm"
        points = PointSet(merged.points, merged.normals, merged.colours)
        return DescribedShape(points, f"merge {name}", merged.scalars, (*notes, note))
    return _describe_mesh(
        f"merge {name}",
        build_mesh(_points_with_normals(merged), plan, part(progress, 0.1, 1)),
        notes,
    )


def merged_points(store: Session, name: str, warn: Warn) -> PointSet:
    """The points of a merge whose normals are known, to make a mesh of; of the last one where none
    is named."""
    return _points_with_normals(read_merge(store, f"merge/{merge_name(store, name)}", warn)[1])


def read_merge(store: Session, result: str, warn: Warn) -> tuple[dict[str, Any], Ply]:
    """The record and the points of a merge that the session stores as ``merge/<number>``; warns of
    a stale one."""
    if not is_up_to_date(store, result):
        warn(f"{result} came from scans or a calibration that have changed since: merge again")
    meta = store.load_result(result, only=())[0]
    return meta, read_ply(store.exports / str(meta["ply"]))


def _points_with_normals(merged: Ply) -> PointSet:
    """Return the points of a merge that have normals; InputError for a merge without any."""
    if merged.normals is None:
        raise InputError("the merged cloud has no normals: merge the scans again")
    known, sigma = np.isfinite(merged.normals).all(axis=1), merged.scalars.get("sigma")
    if sigma is not None and not np.isfinite(sigma[known]).all():
        sigma = None
    return PointSet(
        merged.points[known],
        merged.normals[known],
        None if merged.colours is None else merged.colours[known],
        None if sigma is None else sigma[known],
    )


def _describe_mesh(whose: str, made: BuiltMesh, notes: tuple[str, ...]) -> DescribedShape:
    """Return a built mesh with its owner, file comments, and the lines on how it was made."""
    done = tuple(made.text().splitlines())
    return DescribedShape(
        made.mesh, whose, {}, (*notes, "sigma: expected error along the normal, mm", *done), done
    )


def _model_notes(store: Session, model: str) -> tuple[str, ...]:
    """Return file comments that name the calibration and its scale correction; empty without a
    model."""
    scale = describe_scale(store, model) if model else ""
    return (f"calibration {model}", *((scale,) if scale else ())) if model else ()
