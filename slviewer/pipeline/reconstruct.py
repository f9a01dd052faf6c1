"""From captures to clouds, stored or by one of the session's calibrations; known shapes measured
with each model, which compares them; the points of merges."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import DetectionError, InputError, UsageError
from slviewer.evaluation.fit import Comparison, fit_clouds
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.sequence import Axis
from slviewer.geometry.vectors import finite_rows
from slviewer.inputs import RADIUS
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.cloud_corrections import (
    resolve_region,
    restrict_cloud,
    restriction_notes,
    scale_cloud,
    scale_factor,
)
from slviewer.pipeline.cloud_record import cloud_record, masked_share
from slviewer.pipeline.imported_calibration import check_calibration
from slviewer.pipeline.imported_verdict import warning_of_imported
from slviewer.pipeline.models import (
    Model,
    ModelName,
    frame_of,
    lens_warnings,
    load_model,
    load_models,
    load_projector,
    load_stereo,
    preferred_model,
)
from slviewer.pipeline.operation import (
    Found,
    Job,
    Warn,
    ignore_warnings,
    is_up_to_date,
    load_record,
    numbered_names,
    operation,
    placed_file,
)
from slviewer.reconstruction.axis_agreement import check_phases, check_sizes
from slviewer.reconstruction.cloud import Cloud, Misfit, choose_pixels, keep_pixels
from slviewer.reconstruction.projector_fill import fill_unseen
from slviewer.reconstruction.reconstruct import normals, reconstruct_cloud, triangulate_grid
from slviewer.reconstruction.relative_phase import resolve_phase
from slviewer.records.merge import Merge, Reconstruction
from slviewer.records.record import render_text
from slviewer.records.verification import Shape, Verification
from slviewer.session.capture import Capture
from slviewer.session.ply import Ply, read_ply, write_ply
from slviewer.session.store import Session
from slviewer.surface.shapes import PointSet
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect


@dataclass(frozen=True, eq=False)
class ReconstructedCapture:
    """A reconstructed capture: what is stored of it, with its PLY file of ``points`` points, and
    its cloud without what edits and region remove."""

    found: Found[Reconstruction]
    cloud: Cloud
    points: int


@dataclass(frozen=True)
class ReconstructSettings:
    """How a capture is reconstructed.

    Args:
        capture: Name of the capture.
        model: Which calibration to use, here and by what then works on this cloud; by default the
            best one available.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted
            noise.
        depth_range: For patterns that do not cover the projector: near and far end, mm, of the
            depths between which all surfaces lie; by default the calibrated depths.
        out: PLY file; by default in the session's exports. That of a board pose holds the points
            inside the board's outline.
        grid: Also write the whole organised cloud, (h, w, 3) float32 mm, NaN where invalid, as
            .npy.
        mesh: Put the triangles between neighbouring pixels into the PLY.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
        accept_rejected: Use the calibration although its verdict rejects it.
        supported_only: Omit from the files the points that no target pose supports; else they are
            marked by the property extrapolated.

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """

    UNRECORDED: ClassVar = ("out", "grid", "mesh", "roi", "check", "supported_only")
    capture: str
    model: ModelName | None = None
    axis: Axis | None = None
    depth_range: tuple[float, float] | None = None
    out: Path | str | None = None
    grid: Path | str | None = None
    mesh: bool = False
    roi: str = ""
    accept_rejected: bool = False
    check: bool = True
    supported_only: bool = False

    def __post_init__(self) -> None:
        for path, suffix in ((self.out, ".ply"), (self.grid, ".npy")):
            if path is not None and Path(path).suffix.lower() != suffix:
                raise InputError(
                    f"{path}: a cloud is written as .ply (--out), its whole grid as .npy (--grid)",
                    f"end its name in {suffix}; `slviewer export` writes other formats",
                )


@operation("reconstruct", Reconstruction, ReconstructSettings)
def reconstruct(job: Job, settings: ReconstructSettings) -> Iterator[Found[Reconstruction]]:
    """Reconstruct a capture as a cloud, and write it as PLY; for a board pose also how flat each
    model measures the board."""
    with reconstruct_capture(job, settings) as made:
        yield made.found  # and its file appears once that is stored


@contextmanager
def reconstruct_capture(job: Job, settings: ReconstructSettings) -> Iterator[ReconstructedCapture]:
    """Context manager: a capture whose frames become a cloud. It is not stored yet; its file gets
    its place at the end."""
    job, store, capture = job.accepting(settings), job.store, settings.capture
    store.load_capture(capture).require_frames("reconstruct")
    check_calibration(job)
    name = settings.model or preferred_model(store)
    check_capture_sizes(store, [capture])

    # frames to the phase of each axis: one that repeats is made absolute by the depths
    job.progress(0.1, "reading and decoding")
    shot, frames, decoded = next(
        decode_captures(store, [capture], job.warn, relative=True, check=settings.check)
    )
    phases = absolute_phases(store, capture, decoded, settings.depth_range, job.warn)

    # phases to a cloud; that of a board pose by every model, which are compared there
    is_pose = shot.role == "calibration"
    texture = capture_texture(shot, frames, stretch=is_pose)
    chosen = load_models(store, () if is_pose and settings.model is None else (name,))
    job.progress(0.6, "reconstructing")
    clouds = {
        n: replace(
            capture_cloud(job, m, shot, phases, settings.axis, extrapolates=not is_pose),
            texture=texture,
        )
        for n, m in chosen.items()
    }

    # cloud to the points that are written: inside the board's outline, or what edits and the
    # region of interest leave
    cloud, region = clouds[name], None
    restrictions, flatness = tuple[str, ...](), tuple[str, ...]()
    if not is_pose:
        box = resolve_region(store, settings.roi)
        cloud = restrict_cloud(store, capture, cloud, box)
        restrictions = restriction_notes(store, [capture], box)
    elif (region := segment_board(store, shot, texture, job.warn)) is not None:
        flatness = _describe_flatness(store, capture, clouds, phases, region)
    written = cloud.supported() if settings.supported_only else cloud
    mask = written.mask if region is None else written.mask & region
    if not mask.any():
        raise InputError(
            f"{capture}: no pixel could be reconstructed with {name}",
            "does the calibration belong to this camera and projector, and is the scene within its"
            " depths?",
        )

    # points to the file, which appears once the caller has stored the record
    job.progress(0.8, "writing")
    points = int(np.count_nonzero(mask))
    found = cloud_record(store, settings, chosen[name], clouds[name], phases[cloud.axis], region)
    origin = f"calibration {name}", *restrictions
    with _write_files(store, settings, written, mask, origin) as path:
        notes = (*restrictions, f"{points:,} points -> {path}", *flatness)
        found = replace(found, files=(path,), notes=notes)
        yield ReconstructedCapture(found, cloud.supported(), points)
    job.progress(1.0, "reconstructed")


def _describe_flatness(
    store: Session,
    capture: str,
    clouds: Mapping[str, Cloud],
    phases: PhaseMaps,
    region: np.ndarray,
) -> tuple[str, ...]:
    """Return how flat each model's cloud of a board pose is in the board's ``region`` (h, w)
    bool, as tables for the terminal."""
    illuminated = phases[next(iter(clouds.values())).axis].illuminated
    depths = load_stereo(store).depth_range_mm
    fit = fit_clouds("plane", clouds, illuminated, region=region, depth_range=depths)
    tables = Verification.tables({capture: fit.record()})
    return "inside the board's outline:", *map(render_text, tables)


@contextmanager
def _write_files(
    store: Session,
    settings: ReconstructSettings,
    cloud: Cloud,
    mask: np.ndarray,
    notes: Sequence[str],
) -> Iterator[Path]:
    """Context manager: the path of a PLY of a cloud's points under ``mask`` (h, w) bool, which
    appears there at the end; the cloud's grid is written too where that is wanted."""
    capture, points = settings.capture, cloud.points
    assert cloud.texture is not None
    faces = None
    if settings.mesh:  # surfaces end where depth jumps
        faces = triangulate_grid(keep_pixels(points, mask))
    notes = (f"scan {capture}, frame: {frame_of(store, cloud.model)}", *notes)
    name = f"{capture}_{cloud.model}{'_mesh' if settings.mesh else ''}.ply"
    with placed_file(store, settings.out, name) as (path, written):
        write_ply(
            written,
            choose_pixels(points, mask),
            cloud.texture[mask],
            normals(points)[mask],
            cloud.sigmas(mask),
            faces,
            notes,
        )
        if settings.grid is not None:
            grid = Path(settings.grid)
            grid.parent.mkdir(parents=True, exist_ok=True)
            with open(grid, "wb") as file:  # a file object, so that NumPy adds no suffix of its own
                np.save(file, points)
        yield path


def segment_board(
    store: Session, shot: Capture, texture: np.ndarray, warn: Warn
) -> np.ndarray | None:
    """Return the board's region (h, w) bool in a target pose; None, with a warning, where no board
    is detected."""
    if not (notation := load_stereo(store).board):
        return None
    board = Board.parse(notation)
    try:
        detection = detect(board, texture, several=True)
    except DetectionError as error:
        warn(f"{shot.name}: {error}")
        return None
    return board_mask(board, detection, texture.shape[:2])


@dataclass(frozen=True)
class VerifySettings:
    """How captures of a known shape are measured.

    Args:
        captures: Names of the captures.
        shape: What the captures show.
        models: Which calibrations to compare; by default all there are.
        depth_range: Near and far end of the calibrated depths R2, mm; by default those of the board
            poses.
        radius: Nominal radius of the sphere, mm: helps to detect it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted
            noise.
        accept_rejected: Use the calibration although its verdict rejects it.

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """

    UNRECORDED: ClassVar = ("check",)
    captures: Sequence[str]
    shape: Shape
    models: Sequence[ModelName] = ()
    depth_range: tuple[float, float] | None = None
    radius: Annotated[float | None, RADIUS] = None
    axis: Axis | None = None
    accept_rejected: bool = False
    check: bool = True

    def __post_init__(self) -> None:
        if not self.captures:
            raise UsageError(
                "no capture named", "give the captures to measure, for instance plane_01 plane_02"
            )
        if self.depth_range is not None and not 0 < self.depth_range[0] < self.depth_range[1]:
            near, far = self.depth_range
            raise UsageError(f"the range {near:g} {far:g} is empty", "give near and far in mm")


@dataclass(frozen=True, eq=False)
class ComparedCapture:
    """A capture that models were compared on: its phases, what was found, and {model: share of the
    shape's pixels that it masks, because no target pose illuminated what they look through} of
    models that do."""

    capture: Capture
    frames: np.ndarray
    phases: PhaseMaps
    found: Comparison
    masked: Mapping[str, float]


@operation("verify", Verification, VerifySettings)
def verify(
    job: Job, settings: VerifySettings
) -> Iterator[Found[Verification] | Found[Reconstruction]]:
    """Measure captures of a plane or a sphere with each model, over the pixels that all of them
    measure, and compare.

    The session stores the figures, the error maps, and the cloud of the model that it prefers, if
    that is compared.
    """
    store = job.store
    for each in compare_captures(job, settings):
        name, models = each.capture.name, tuple(each.found.results)
        record = each.found.record(
            each.masked,
            scales={model: scale_factor(store, model) for model in models},
            inputs=store.input_hashes(name, *(f"calibration/{model}" for model in models)),
        )
        yield Found(
            name, record, {f"error_{m}": r.error_map for m, r in each.found.results.items()}
        )
        if store.is_writable and (best := preferred_model(store)) in models:
            # by its own best axis, as reconstruct
            shot, axis, is_pose = each.capture, settings.axis, each.capture.role == "calibration"
            fitted = load_model(store, best)
            texture = capture_texture(shot, each.frames, stretch=is_pose)
            quiet = replace(job, warn=ignore_warnings)  # it has warned of this capture
            cloud = capture_cloud(quiet, fitted, shot, each.phases, axis, extrapolates=not is_pose)
            cloud = replace(cloud, texture=texture)
            how = ReconstructSettings(name, axis=axis, accept_rejected=job.accept_rejected)
            region = None if each.found.is_searched else each.found.region
            yield cloud_record(store, how, fitted, cloud, each.phases[cloud.axis], region)


def compare_captures(job: Job, settings: VerifySettings) -> Iterator[ComparedCapture]:
    """Yield the comparison of models on each capture."""
    job, store, names = job.accepting(settings), job.store, settings.captures
    for name in names:
        store.load_capture(name).require_frames("verify")
    chosen = load_models(store, settings.models)
    check_calibration(job)
    check_capture_sizes(store, names)
    depths = settings.depth_range or load_stereo(store).depth_range_mm
    for i, (shot, frames, phases) in enumerate(
        decode_captures(store, names, job.warn, check=settings.check)
    ):
        job.progress(i / len(names), f"measuring {shot.name}")
        # the axis is that of the first, so that all can be compared pixel by pixel
        clouds, axis = dict[str, Cloud](), settings.axis
        for model, fitted in chosen.items():
            clouds[model] = capture_cloud(job, fitted, shot, phases, axis)
            axis = axis or clouds[model].axis
        assert axis is not None
        phase, region = phases[axis], None
        if settings.shape == "plane" and shot.role == "calibration":
            region = segment_board(store, shot, capture_texture(shot, frames), job.warn)
        try:
            found = fit_clouds(
                settings.shape, clouds, phase.illuminated, region=region, depth_range=depths,
                radius=settings.radius,
            )  # fmt: skip
        except InputError as error:
            raise error.within(shot.name) from error
        for message in found.warnings:
            job.warn(f"{shot.name}: {message}")
        masked = {
            name: share
            for name, each in chosen.items()
            if (share := masked_share(each, phase, found.region)) is not None
        }
        yield ComparedCapture(shot, frames, phases, found, masked)
    job.progress(1.0, "measured")


def check_capture_sizes(store: Session, names: Iterable[str]) -> None:
    """Raise InputError where a capture's camera or projector has not the size that the session's
    calibration has: before anything is decoded, which would fail for reasons that follow from
    it."""
    rig = load_stereo(store).rig
    for capture in (store.load_capture(name) for name in names):
        capture.require_frames("reconstruct")
        check_sizes(capture.name, capture.size, capture.other_size, rig)


def capture_cloud(
    job: Job,
    model: Model,
    capture: Capture,
    phases: PhaseMaps,
    axis: Axis | None = None,
    *,
    extrapolates: bool = False,
) -> Cloud:
    """Reconstruct the organised cloud of a decoded capture, with the scale of its calibration
    applied; ``extrapolates`` as in `reconstruct_cloud`. What the second of two cameras does not see
    is filled by the projector, where that was calibrated too.

    Raises InputError where capture and calibration do not belong together: by their sizes, or by
    how far the axes of the capture miss each other, which is a warning where the job accepts
    a rejected calibration.
    Where they miss each other by more than noise explains, the cloud has that `Misfit`, with a
    warning.
    """
    store = job.store
    stereo = load_stereo(store)
    check_sizes(capture.name, capture.size, capture.other_size, stereo.rig)
    calibration = model if isinstance(model, SplinedModel) else stereo
    depths = stereo.depth_range_mm
    try:
        check = check_phases(capture.name, phases, calibration, depths, job.accept_rejected)
    except InputError as refusal:
        raise InputError(capture.name_devices(str(refusal))) from refusal
    for message in (*lens_warnings(store, capture), *check.warnings):
        job.warn(capture.name_devices(message))
    cloud = scale_cloud(
        reconstruct_cloud(model, phases, axis=axis, extrapolates=extrapolates),
        scale_factor(store, model.name),
    )
    if (misfit := check.misfit) is not None:
        noise_px, known = phases[cloud.axis].sigma_px, cloud.sigma_edges
        excess = cv2.resize(misfit.excess_px, noise_px.shape[::-1], interpolation=cv2.INTER_LINEAR)
        error = cloud.sigma_z * excess / np.maximum(noise_px, np.float32(1e-9))
        edges = error if known is None else np.hypot(known, error)
        cloud = replace(cloud, sigma_edges=edges, misfit=misfit)
    phase = phases[cloud.axis]
    if model.name != "splined" or phase.light is None or (beside := load_projector(store)) is None:
        return cloud
    lit = scale_cloud(
        reconstruct_cloud(beside, phase.light, extrapolates=extrapolates),
        scale_factor(store, model.name),
    )
    cloud = fill_unseen(cloud, lit, phase.reason == Reason.UNSEEN)
    if cloud.fill and not cloud.fill.is_used and (text := cloud.fill.text()):
        job.warn(f"{capture.name}: {text}")
    return cloud


def absolute_phases(
    store: Session,
    name: str,
    phases: PhaseMaps,
    depth_range: tuple[float, float] | None,
    warn: Warn,
) -> PhaseMaps:
    """Return a capture's phases, ambiguous ones made absolute by the depth range (near, far) mm of
    the scene; by default the calibrated one. An axis that more than one depth fits is solved by the
    other axis, with a warning.

    Raises InputError where no axis is unique in the range, and where no range is known.
    """
    if not any(phase.is_relative for phase in phases.values()):
        if depth_range is not None:
            warn(
                f"{name}: its phase is absolute, and the depth range is not needed: it was not used"
            )
        return dict(phases)
    stereo = load_stereo(store)
    near_far = depth_range or stereo.depth_range_mm
    whose = "" if depth_range else ", the calibrated depths"
    if near_far is None:
        raise InputError(
            f"{name}: its phase is not absolute, and the calibration knows no depths",
            "state those of the scene with --depth-range NEAR FAR, mm",
        )
    absolute, refusals = dict[Axis, PhaseMap](), list[str]()
    for axis, phase in phases.items():
        if not phase.is_relative:
            absolute[axis] = phase
            continue
        try:
            resolved = resolve_phase(stereo.rig, phase, near_far)
        except InputError as error:
            refusals.append(str(error))
            continue
        absolute[axis] = resolved.phase
        warn(
            f"{name}: the phase of axis {axis} repeats every {phase.unambiguous_px:g} px, and each"
            f" pixel was given its one depth between {near_far[0]:.0f} and {near_far[1]:.0f}"
            f" mm{whose}; {100 * resolved.outside:.1f} % of the decoded pixels have none and are"
            " masked. A surface outside of this range would be measured about"
            f" {resolved.spacing_mm:.0f} mm from its place: change it with --depth-range"
        )
    if not absolute:
        raise InputError(
            f"{name}: {'; '.join(refusals)} (--depth-range NEAR"
            f" FAR{whose and '; by default' + whose[1:]})"
        )
    for refusal in refusals:
        warn(f"{name}: {refusal}; this axis was not used")
    return absolute


def reconstruct_captures(
    job: Job,
    model: Model,
    names: Sequence[str],
    doing: str = "reconstructing",
    *,
    examine: bool = True,
) -> Iterator[tuple[Capture, np.ndarray, Cloud]]:
    """Yield captures, in order, with their frames and their textured clouds. ``doing``: how the
    progress calls that; ``examine``: warn of what is wrong with the frames.

    Raises InputError like `check_capture_sizes` and `capture_cloud`.
    """
    store = job.store
    check_capture_sizes(store, names)
    decoded = decode_captures(store, names, job.warn if examine else ignore_warnings)
    for i, (capture, frames, phases) in enumerate(decoded):
        job.progress(i / len(names), f"{doing} {capture.name}")
        texture = capture_texture(capture, frames, stretch=False)
        cloud = capture_cloud(job, model, capture, phases)
        yield capture, frames, replace(cloud, texture=texture)


def scan_cloud(job: Job, name: str, model: str | None = None, roi: str = "") -> Cloud:
    """A capture's cloud: the stored one where it was imported, or is up to date and of the
    requested model, else reconstructed; without what is extrapolated, what was deleted from it,
    and what lies outside of the region ``roi``, as `resolve_region` reads it.
    """
    store, stored = job.store, f"clouds/{name}"
    region = resolve_region(store, roi)
    capture, fresh = store.load_capture(name), is_up_to_date(store, stored)
    if capture.is_imported_cloud and not fresh:
        raise InputError(f"the points of {name} are missing", "import its file again with --force")
    meta = store.load_meta(stored) if fresh else {}
    if meta and (capture.is_imported_cloud or model in (None, "", meta["model"])):
        names = set(meta["arrays"]) - {"phase", "modulation"}
        arrays: dict[str, Any] = store.load_result(stored, only=names)[1]
        for message in lens_warnings(store, capture):
            job.warn(message)
        misfit = Misfit.pop_from(arrays)
        if "scalars" in arrays:
            values = np.moveaxis(arrays["scalars"], -1, 0)
            arrays["scalars"] = dict(zip(meta["imported"]["scalars"], values, strict=True))
        cloud = Cloud(axis=meta["axis"], model=meta["model"], misfit=misfit, **arrays).supported()
    else:
        *_, cloud = next(reconstruct_captures(job, load_model(store, model), [name]))
    return restrict_cloud(store, name, cloud, region)


def load_origin(store: Session, scan: str) -> np.ndarray | None:
    """Return the origin (3,) mm that the coordinates of an imported scan count from; None where
    nothing was subtracted."""
    stored = f"clouds/{scan}"
    meta = store.load_meta(stored) if store.has_result(stored) else {}
    origin = (meta.get("imported") or {}).get("origin_mm")
    return None if origin is None else np.array(origin)


def merge_name(store: Session, name: str) -> str:
    """The merge of that number, ``1`` or ``merge/1``, or the last one where none is named; raises
    InputError where it does not exist."""
    name, there = name.removeprefix(f"{Merge.kind}/"), numbered_names(store, "merge")
    if not there:
        raise InputError("there is no merge yet", "merge scans first")
    if name and name not in there:
        raise InputError(f"there is no merge {name!r}: the merges are {', '.join(there)}")
    return name or there[-1]


def read_merge(store: Session, result: str, warn: Warn, roi: str) -> tuple[Merge, Ply]:
    """The record and the points of a merge that the session stores as ``merge/<number>``; warns of
    a stale one. Raises UsageError where a region ``roi`` was stated: its scans were cut when it was
    made."""
    if roi:
        raise UsageError(
            f"{result} was cut by the region when its scans were merged",
            f"merge them again with --roi {roi}",
        )
    if not is_up_to_date(store, result):
        warn(f"{result} came from scans or a calibration that have changed since: merge again")
    if warning := warning_of_imported(store):
        warn(warning)
    merge = load_record(store, Merge, result.removeprefix(f"{Merge.kind}/"))
    return merge, read_ply(store.exports / merge.ply)


def points_with_normals(merged: Ply) -> PointSet:
    """Return the points of a merge whose normals are known, to make a mesh of; InputError for a
    merge without any."""
    if merged.normals is None:
        raise InputError("the merged cloud has no normals", "merge the scans again")
    known, sigma = finite_rows(merged.normals), merged.scalars.get("sigma")
    if sigma is not None and not np.isfinite(sigma[known]).all():
        sigma = None
    return PointSet(
        merged.points[known],
        merged.normals[known],
        None if merged.colours is None else merged.colours[known],
        None if sigma is None else sigma[known],
    )
