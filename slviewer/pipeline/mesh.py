"""From captures, or from a stored merge, to a mesh in a file."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.pipeline.capture_clouds import (
    merge_name,
    points_with_normals,
    read_merge,
    scan_cloud,
)
from slviewer.pipeline.export import check_export
from slviewer.pipeline.feedback import ignore_progress, part, stage
from slviewer.pipeline.measured_surface import MERGED
from slviewer.pipeline.merge import MergedScans, MergeSettings, StartKind, merge_scans
from slviewer.pipeline.models import ModelName, check_accepted, load_stereo, warn_if_stale
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.operation import Findings, Job, show_found
from slviewer.pipeline.scan_edits import OFF, refuse_region, resolve_region, restriction_notes
from slviewer.pipeline.settings import Callbacks, takes_settings
from slviewer.pipeline.stored_records import load_record
from slviewer.pipeline.white_balance import balance, measure_white
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.merge import Merge
from slviewer.session.mesh_files import write_shape, write_textured
from slviewer.session.store import Session
from slviewer.surface.meshing import BuiltMesh, MeshingPlan, build_mesh
from slviewer.surface.shapes import PointSet
from slviewer.surface.texture import TexturedMesh, texture_mesh

TEXTURED_TRIANGLES = 100_000
"""To so many a mesh is thinned that gets a texture, unless another number is given."""


@dataclass(frozen=True, eq=False)
class MeshResult:
    """A mesh, its source, and the file that it was written to. ``merged``: the merge of several
    scans; ``textured``: the mesh with its texture."""

    meshed: BuiltMesh
    sources: tuple[str, ...]
    out: Path
    merged: Findings[Merge] | None = None
    textured: TexturedMesh | None = None

    def to_json(self) -> dict[str, Any]:
        """The contract of ``mesh --json``."""
        merged = None if self.merged is None else self.merged.to_json()
        return {
            "sources": list(self.sources),
            "out": str(self.out),
            **self.meshed.to_json(),
            "merge": merged,
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        lines = [] if self.merged is None else [self.merged.text()]
        lines.append(f"{', '.join(self.sources)}: {self.meshed.text()}")
        if self.textured is not None:
            lines.append(self.textured.text())
        return "\n".join([*lines, f"-> {self.out}"])


@dataclass(frozen=True)
class MeshSettings(Callbacks):
    """What is meshed, how, and into which file.

    Args:
        session: Session folder.
        names: One scan; several, to be merged into the frame of the first; or a merge of the
            session, as merge/1.
        out: The file; by default a .ply in the session's exports, with a texture a .glb.
        texture: Side of a texture image, px, such as 2048, projected from the scans onto the mesh;
            for .glb and .obj.
        white: White balance of a colour camera's texture: board takes the white of the target poses
            for neutral, any other name that capture, of a grey card or white sheet; by default
            colours are the camera's.
        start: Initial alignment of several scans: features estimates it from the scans; turntable
            uses the angles of the turntable; identity assumes that they are nearly aligned already.
        angle: Degrees that the turntable turns from each scan to the next, with --start turntable;
            by default as stored with the captures of `slviewer turn`.
        model: Which calibration to use; by default the best one available.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
            A merge was cut when it was made.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    session: SessionLike
    names: Sequence[str] = ()
    out: Path | str | None = None
    _: KW_ONLY
    plan: MeshingPlan | None = None
    texture: int | None = None
    white: str = ""
    model: ModelName | None = None
    start: StartKind = "features"
    angle: float | None = None
    roi: str = ""
    accept_rejected: bool = False

    def __post_init__(self) -> None:
        sources = self.sources
        if not sources:
            raise UsageError("nothing was named: name one scan, several to merge, or a merge")
        if len(sources) > 1 and any(name.startswith(MERGED) for name in sources):
            raise UsageError("a merge is meshed by itself: name one merge, or scans")
        if len(sources) > 1 and self.plan is not None and self.plan.method == "grid":
            raise UsageError(
                "the method grid joins the pixels of one scan: name one, or use poisson or volume"
            )
        if self.out is not None:
            suffix = Path(self.out).suffix.lower()
            check_export("mesh", suffix.removeprefix("."))
            if self.texture is not None and suffix not in (".glb", ".obj"):
                raise UsageError(
                    f"{Path(self.out).name} holds no texture: end its name in .glb or .obj"
                )
        if self.white and self.texture is None:
            raise UsageError("--white balances the colours of a texture: give --texture too")

    @property
    def sources(self) -> tuple[str, ...]:
        """The scans, or the merge, each once."""
        return tuple(dict.fromkeys(self.names))


@takes_settings(MeshSettings)
def mesh(settings: MeshSettings) -> MeshResult:
    """Make a mesh of a scan, or of several that are merged, and write it as .ply, .stl, .obj or
    .glb.

    ``merge/`` alone is the session's last merge. The points of merged scans are written next to the
    mesh.
    """
    sources, texture = settings.sources, settings.texture
    progress, warn, accept_rejected = settings.progress, settings.warn, settings.accept_rejected
    plan = settings.plan or MeshingPlan()
    if texture is not None and plan.triangles is None:
        plan = replace(plan, triangles=TEXTURED_TRIANGLES)
    merged = None
    with opened(settings.session) as store:
        check_accepted(store, accept_rejected)
        gains = measure_white(store, settings.white) if settings.white else None
        suffix = ".ply" if texture is None else ".glb"
        file_name = f"{'_'.join(sources).replace('/', '_')}_mesh{suffix}"
        path = store.exports / file_name if settings.out is None else Path(settings.out)
        path.parent.mkdir(parents=True, exist_ok=True)
        before = part(progress, 0, 0.5)
        shape: Cloud | PointSet
        if len(sources) > 1:
            merging = MergeSettings(
                sources, sources[0], path.with_name(f"{path.stem}_points.ply"), settings.model,
                settings.start, settings.angle, roi=settings.roi, accept_rejected=accept_rejected,
            )  # fmt: skip
            merged = merge_scans(Job(store, before, warn), merging)
            shape, restrictions = merged.fused.surface, tuple(merged.record.restrictions)
        elif sources[0].startswith(MERGED):
            refuse_region(sources[0], settings.roi)
            name = merge_name(store, sources[0].removeprefix(MERGED))
            stored, points = read_merge(store, f"merge/{name}", warn)
            shape, restrictions = points_with_normals(points), tuple(stored.restrictions)
        else:
            warn_if_stale(store, warn)
            shape = scan_cloud(
                store, sources[0], settings.model, before, warn, accept_rejected, settings.roi
            )
            restrictions = restriction_notes(store, sources, resolve_region(store, settings.roi))
        if texture is not None:
            clouds, poses = _textured_scans(store, settings, shape, merged)
            rig = load_stereo(store).rig
    made = None if merged is None else show_found(merged.found)
    meshed = build_mesh(shape, plan, part(progress, 0.5, 0.95 if texture is None else 0.6))
    notes = (f"of {', '.join(sources)}", *restrictions, *meshed.text().splitlines())
    textured = None
    if texture is None:
        progress(0.95, f"writing {path.name}")
        write_shape(path, meshed.mesh, notes=notes)
    else:
        if gains is not None:
            clouds = {name: _balance_cloud(name, cloud, gains) for name, cloud in clouds.items()}
        projector, painting = (
            -rig.R.T @ rig.t,
            stage(progress, 0.6, 0.95, "projecting the scans onto the mesh"),
        )
        textured = texture_mesh(
            meshed.mesh, clouds, poses, size=texture, light=projector, progress=painting
        )
        progress(0.95, f"writing {path.name}")
        write_textured(path, textured.mesh, textured.uv, textured.image, (*notes, textured.text()))
    progress(1.0, "meshed")
    return MeshResult(meshed, sources, path, made, textured)


def _textured_scans(
    store: Session, settings: MeshSettings, shape: Cloud | PointSet, merged: MergedScans | None
) -> tuple[Mapping[str, Cloud], Mapping[str, np.ndarray]]:
    """Return the cloud of every scan that the mesh is made of, and its pose (4, 4) in the mesh's
    frame."""
    if merged is not None:
        return {
            name: merged.clouds[name] for name in merged.fused.names
        }, merged.alignment.T_reference_scan
    (source,) = settings.sources
    if isinstance(shape, Cloud):
        return {source: shape}, {source: np.eye(4)}
    made = load_record(store, Merge, merge_name(store, source.removeprefix(MERGED)))
    placed = {
        name: np.array(pair.T_reference_scan, np.float64) for name, pair in made.pairs.items()
    }
    placed |= {made.reference: np.eye(4)}
    used = made.model or settings.model
    clouds = {  # what lies outside of the region still hides the surface from a scan
        name: scan_cloud(
            store, name, used, ignore_progress, settings.warn, settings.accept_rejected, OFF
        )
        for name in made.scans
    }
    return clouds, placed


def _balance_cloud(name: str, cloud: Cloud, gains: np.ndarray) -> Cloud:
    """Return a cloud with a white balance applied to its texture. InputError where that has no
    colours."""
    if cloud.texture is None or cloud.texture.ndim != 3:
        raise InputError(
            f"the picture of {name} has no colours: make the texture without a white balance"
        )
    return replace(cloud, texture=balance(cloud.texture, gains))
