"""From captures, or from a stored merge, to a mesh in a file, with a texture whose white may be
balanced by the board or a grey card."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.fringe.layout import to_eight_bits
from slviewer.pipeline.cloud_corrections import OFF, resolve_region, restriction_notes
from slviewer.pipeline.export import check_export
from slviewer.pipeline.measure import MERGED
from slviewer.pipeline.merge import MergedScans, MergeSettings, StartKind, merge_scans
from slviewer.pipeline.models import ModelName, check_accepted, load_stereo, warn_of_calibration
from slviewer.pipeline.operation import (
    Callbacks,
    Findings,
    Job,
    SessionLike,
    load_record,
    opened,
    part,
    show_found,
    stage,
    takes_settings,
)
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.reconstruct import (
    merge_name,
    points_with_normals,
    read_merge,
    scan_cloud,
)
from slviewer.process import call_apart
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.merge import Merge
from slviewer.session.capture import Capture
from slviewer.session.shape_files import write_shape, write_textured
from slviewer.session.store import Session
from slviewer.surface.meshing import BuiltMesh, MeshingPlan, build_mesh
from slviewer.surface.shapes import PointSet
from slviewer.surface.texture import TexturedMesh, texture_mesh

BOARD = "board"
WHITE_SHARE = 0.25
"""Of a reference's pixels, the brightest: a board has dark marks too."""
SATURATED, DARKEST = 250, 10
"""Grey levels between which a reference tells its colour."""
MAX_GAIN = 8.0
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
            session, as merge/1 or merge 1.
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
            raise UsageError("nothing was named", "name one scan, several to merge, or a merge")
        if len(sources) > 1 and any(name.startswith(MERGED) for name in sources):
            raise UsageError("a merge is meshed by itself", "name one merge, or scans")
        if len(sources) > 1 and self.plan is not None and self.plan.method == "grid":
            raise UsageError(
                "the method grid joins the pixels of one scan", "name one, or use poisson or volume"
            )
        if self.out is not None:
            suffix = Path(self.out).suffix.lower()
            check_export("mesh", suffix.removeprefix("."))
            if self.texture is not None and suffix not in (".glb", ".obj"):
                raise UsageError(
                    f"{Path(self.out).name} holds no texture", "end its name in .glb or .obj"
                )
        if self.white and self.texture is None:
            raise UsageError("--white balances the colours of a texture", "give --texture too")

    @property
    def sources(self) -> tuple[str, ...]:
        """The scans, or the merge, each once; ``merge 1`` is ``merge/1``."""
        match tuple(dict.fromkeys(self.names)):
            case (Merge.kind,):
                return (MERGED,)
            case (Merge.kind, number) if number.isdigit():
                return (f"{MERGED}{number}",)
            case names:
                return names


@takes_settings(MeshSettings)
def mesh(settings: MeshSettings) -> MeshResult:
    """Make a mesh of a scan, or of several that are merged, and write it as .ply, .stl, .obj or
    .glb. Extrapolated points are not used.

    ``merge/`` alone is the session's last merge. The points of merged scans are written next to the
    mesh.
    """
    sources, texture, progress = settings.sources, settings.texture, settings.progress
    warn, accept_rejected = settings.warn, settings.accept_rejected
    plan, merged = settings.plan or MeshingPlan(), None
    if texture is not None and plan.triangles is None:
        plan = replace(plan, triangles=TEXTURED_TRIANGLES)
    with opened(settings.session) as store:
        check_accepted(store, accept_rejected)
        gains = measure_white(store, settings.white) if settings.white else None
        suffix = ".ply" if texture is None else ".glb"
        file_name = f"{'_'.join(sources).replace('/', '_')}_mesh{suffix}"
        path = store.exports / file_name if settings.out is None else Path(settings.out)
        path.parent.mkdir(parents=True, exist_ok=True)
        job = settings.job(store).part(0, 0.5)
        shape: Cloud | PointSet
        if len(sources) > 1:
            merging = MergeSettings(
                sources, sources[0], path.with_name(f"{path.stem}_points.ply"), settings.model,
                settings.start, settings.angle, roi=settings.roi, accept_rejected=accept_rejected,
            )  # fmt: skip
            with merge_scans(job, merging) as merged:
                shape, restrictions = merged.fused.surface, tuple(merged.record.restrictions)
        elif sources[0].startswith(MERGED):
            name = merge_name(store, sources[0])
            stored, points = read_merge(store, f"merge/{name}", warn, settings.roi)
            shape, restrictions = points_with_normals(points), tuple(stored.restrictions)
        else:
            warn_of_calibration(store, warn)
            shape = scan_cloud(job, sources[0], settings.model, settings.roi)
            restrictions = restriction_notes(store, sources, resolve_region(store, settings.roi))
        if texture is not None:
            clouds, poses = _textured_scans(store, settings, shape, merged)
            rig = load_stereo(store).rig
    meshing = part(progress, 0.5, 0.95 if texture is None else 0.6)
    meshed = call_apart(build_mesh, shape, plan, progress=meshing)
    notes = (f"of {', '.join(sources)}", *restrictions, *meshed.text().splitlines())
    textured = None
    if texture is not None:
        if gains is not None:
            clouds = {name: _balance_cloud(name, cloud, gains) for name, cloud in clouds.items()}
        painting = stage(progress, 0.6, 0.95, "projecting the scans onto the mesh")
        light = -rig.R.T @ rig.t
        textured = call_apart(
            texture_mesh, meshed.mesh, clouds, poses, texture, light, progress=painting
        )
    progress(0.95, f"writing {path.name}")
    if textured is None:
        write_shape(path, meshed.mesh, notes=notes)
    else:
        write_textured(path, textured.mesh, textured.uv, textured.image, (*notes, textured.text()))
    progress(1.0, "meshed")
    return MeshResult(
        meshed, sources, path, None if merged is None else show_found(merged.found), textured
    )


def _textured_scans(
    store: Session, settings: MeshSettings, shape: Cloud | PointSet, merged: MergedScans | None
) -> tuple[Mapping[str, Cloud], Mapping[str, np.ndarray]]:
    """Return the cloud of every scan that the mesh is made of, and its pose (4, 4) in the mesh's
    frame."""
    for name in settings.sources:
        if not name.startswith(MERGED):
            store.load_capture(name).require_frames("texture")
    if merged is not None:
        clouds = {name: merged.clouds[name] for name in merged.fused.names}
        return clouds, merged.alignment.T_reference_scan
    (source,) = settings.sources
    if isinstance(shape, Cloud):
        return {source: shape}, {source: np.eye(4)}
    made = load_record(store, Merge, merge_name(store, source))
    for name in made.scans:
        store.load_capture(name).require_frames("texture")
    used = made.model or settings.model
    job = Job(store, warn=settings.warn, accept_rejected=settings.accept_rejected)
    # what lies outside of the region still hides the surface from a scan
    clouds = {name: scan_cloud(job, name, used, OFF) for name in made.scans}
    return clouds, made.poses


def _balance_cloud(name: str, cloud: Cloud, gains: np.ndarray) -> Cloud:
    """Return a cloud with a white balance applied to its texture. InputError where that has no
    colours."""
    if cloud.texture is None or cloud.texture.ndim != 3:
        raise InputError(
            f"the picture of {name} has no colours", "make the texture without a white balance"
        )
    return replace(cloud, texture=balance(cloud.texture, gains))


def measure_white(store: Session, reference: str) -> np.ndarray:
    """Return the gains (3,) of red, green and blue, at most 1, that make a reference neutral.

    ``reference``: a capture of a grey card or white sheet that fills most of the view, a target
    pose, or ``board``: all target poses. Raises InputError for pictures without colours, and for
    white that is overexposed or too dark.
    """
    if reference != BOARD:
        return _measure_gains(store, store.load_capture(reference))
    captures = [capture for capture in store.captures("calibration") if capture.texture is not None]
    if not captures:
        raise InputError(
            "the target poses have no colours, so that the board's white is unknown",
            "capture them with a colour camera and a white image, or name a capture of a grey card",
        )
    gains, refusals = list[np.ndarray](), list[str]()
    for capture in captures:
        try:
            gains.append(_measure_gains(store, capture))
        except InputError as error:
            refusals.append(str(error))
    if not gains:
        raise InputError(refusals[0])
    middle = np.median(gains, axis=0)
    return np.asarray(middle / middle.max())


def balance(texture: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a texture (h, w, 3) uint8 with the gains (3,) applied; overexposed pixels become
    neutral."""
    return np.rint(np.minimum(texture * gains, 255 * gains.min())).astype(np.uint8)


def _measure_gains(store: Session, capture: Capture) -> np.ndarray:
    """Return the gains of one reference."""
    texture = capture.texture
    if texture is None:
        raise InputError(
            f"{capture.name} has no colours", "name a capture of a colour camera with a white image"
        )
    texture = to_eight_bits(texture, capture.sequence.full_scale)
    if observed := load_observations(store, [capture.name]):  # a target pose: its board
        hull = cv2.convexHull(np.rint(observed[0].camera).astype(np.int32))
        mask = cv2.fillConvexPoly(np.zeros(texture.shape[:2], np.uint8), hull, 1) == 1
    else:  # what is lit
        levels = texture.max(axis=2)
        mask = levels >= 0.5 * np.quantile(levels, 0.99)
    pixels = texture[mask].astype(np.float64)
    brightness = pixels.max(axis=1)
    white = pixels[brightness >= np.quantile(brightness, 1 - WHITE_SHARE)]
    usable = white[white.max(axis=1) < SATURATED]
    if len(usable) < len(white) / 2:
        share = 100 * (1 - len(usable) / len(white))
        raise InputError(
            f"{share:.0f} % of the white in {capture.name} is overexposed", "lower the exposure"
        )
    colour = np.median(usable, axis=0)
    if colour.min() < DARKEST or colour.max() > MAX_GAIN * colour.min():
        levels = ", ".join(f"{level:.0f}" for level in colour)
        raise InputError(
            f"the white in {capture.name} has {levels} grey levels of red, green and blue",
            f"expose it so that each has {DARKEST} or more, none {MAX_GAIN:g} times another",
        )
    return np.asarray(colour.min() / colour)
