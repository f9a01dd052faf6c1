"""From a capture to a cloud."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import DetectionError, InputError
from slviewer.evaluation.compare import Comparison, fit_clouds
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_clouds import absolute_phases, capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.models import (
    Model,
    ModelName,
    check_accepted,
    frame_of,
    load_models,
    load_stereo,
    preferred_model,
    warn_if_stale,
)
from slviewer.pipeline.open_session import placed_file
from slviewer.pipeline.operation import Found, Job, operation, plain_settings
from slviewer.pipeline.scale import describe_scale, scale_factor
from slviewer.pipeline.scan_edits import resolve_region, restrict_cloud, restriction_notes
from slviewer.reconstruction.cloud import Cloud, choose_pixels, keep_pixels
from slviewer.reconstruction.reconstruct import normals, triangulate_grid
from slviewer.records.reconstruction import Reconstruction
from slviewer.records.table import render_text
from slviewer.records.verification import Verification
from slviewer.session.capture import Capture
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect


@dataclass(frozen=True, eq=False)
class ReconstructedCapture:
    """A reconstructed capture: what is stored of it; its cloud without what edits and region
    remove; the phases that it came from; its PLY file with ``points`` points; for a board pose how
    flat each model measures the board. ``restrictions`` describes edits and region.
    """

    found: Found[Reconstruction]
    cloud: Cloud
    phases: Mapping[Axis, PhaseMap]
    ply: Path
    points: int
    board: Comparison | None = None
    restrictions: tuple[str, ...] = ()


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

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """

    UNRECORDED: ClassVar = ("out", "grid", "mesh", "roi", "check")
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

    def __post_init__(self) -> None:
        for path, suffix in ((self.out, ".ply"), (self.grid, ".npy")):
            if path is not None and Path(path).suffix.lower() != suffix:
                raise InputError(
                    f"{path}: a cloud is written as .ply (--out), its whole grid as .npy (--grid):"
                    f" end its name in {suffix}; `slviewer export` writes other formats"
                )


@operation("reconstruct", Reconstruction, ReconstructSettings)
def reconstruct(job: Job, settings: ReconstructSettings) -> Iterator[Found[Reconstruction]]:
    """Reconstruct a capture as a cloud, and write it as PLY; for a board pose also how flat each
    model measures the board."""
    with _reconstructing(job, settings) as made:  # whose file appears once the record is stored
        notes = (*made.restrictions, f"{made.points:,} points -> {made.ply}")
        if made.board is not None:
            tables = Verification.tables({settings.capture: made.board.record()})
            notes += ("inside the board's outline:", *map(render_text, tables))
        yield replace(made.found, files=(made.ply,), notes=notes)


def reconstruct_capture(job: Job, settings: ReconstructSettings) -> ReconstructedCapture:
    """Reconstruct a capture, and write its file; nothing is stored."""
    with _reconstructing(job, settings) as made:
        return made


@contextmanager
def _reconstructing(job: Job, settings: ReconstructSettings) -> Iterator[ReconstructedCapture]:
    """Context manager: a reconstructed capture; its file gets its place at the end."""
    store, capture, warn = job.store, settings.capture, job.warn
    check_accepted(store, settings.accept_rejected)
    name = settings.model or preferred_model(store)
    warn_if_stale(store, warn)
    check_capture_sizes(store, [capture])
    job.progress(0.1, "reading and decoding")
    shot, frames, decoded = next(
        decode_captures(store, [capture], warn, relative=True, check=settings.check)
    )
    phases = absolute_phases(store, capture, decoded, settings.depth_range, warn)
    is_pose = shot.role == "calibration"
    texture = capture_texture(shot, frames, stretch=is_pose)
    chosen = load_models(store, () if is_pose and settings.model is None else (name,))
    job.progress(0.6, "reconstructing")
    options: dict[str, Any] = {
        "axis": settings.axis,
        "texture": texture,
        "accept_rejected": settings.accept_rejected,
    }
    clouds = {
        n: capture_cloud(store, m, shot, phases, warn=warn, **options) for n, m in chosen.items()
    }
    board, region = None, segment_board(store, shot, texture, warn) if is_pose else None
    if region is not None:
        depths = load_stereo(store).depth_range_mm
        board = fit_clouds(
            "plane", clouds, illuminated_pixels(phases, clouds), region=region, depth_range=depths
        )
    cloud, restrictions = clouds[name], tuple[str, ...]()
    if not is_pose:
        box = resolve_region(store, settings.roi)
        cloud, restrictions = (
            restrict_cloud(store, capture, cloud, box),
            restriction_notes(store, [capture], box),
        )
    mask = cloud.mask if region is None else cloud.mask & region
    if not mask.any():
        raise InputError(
            f"{capture}: no pixel could be reconstructed with {name}: does the calibration belong"
            " to this camera and projector, and is the scene within its depths?"
        )
    job.progress(0.8, "writing")
    found = cloud_record(store, settings, chosen[name], clouds[name], phases[cloud.axis], region)
    with _write_files(store, settings, cloud, mask, (f"calibration {name}", *restrictions)) as path:
        yield ReconstructedCapture(
            found, cloud, phases, path, int(np.count_nonzero(mask)), board, restrictions
        )
    job.progress(1.0, "reconstructed")


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
    faces = triangulate_points(points, mask) if settings.mesh else None
    notes = (f"scan {capture}, frame: {frame_of(store, cloud.model)}", *notes)
    name = f"{capture}_{cloud.model}{'_mesh' if settings.mesh else ''}.ply"
    with placed_file(store, settings.out, name) as (path, written):
        chosen = choose_pixels(points, mask)
        write_ply(
            written,
            chosen,
            cloud.texture[mask],
            normals(points)[mask],
            cloud.sigmas(mask),
            faces,
            notes,
        )
        if settings.grid is not None:
            write_grid(Path(settings.grid), points)
        yield path


def cloud_record(
    store: Session,
    settings: ReconstructSettings,
    model: Model,
    cloud: Cloud,
    phase: PhaseMap,
    region: np.ndarray | None,
) -> Found[Reconstruction]:
    """Return what is stored of a capture's cloud, before edits and region; ``region`` (h, w) bool:
    of the board."""
    near, far = np.percentile(cloud.points[..., 2][cloud.mask], [1, 99])
    assert cloud.texture is not None
    arrays = {
        "points": cloud.points,
        "sigma_z": cloud.sigma_z,
        "phase": phase.phase,
        "modulation": phase.modulation,
        "texture": cloud.texture,
        "sigma_calibration": cloud.sigma_calibration,
        "sigma_edges": cloud.sigma_edges,
    }
    left = cloud.sigma_calibration
    inputs = (
        settings.capture,
        *dict.fromkeys(("calibration/stereo", f"calibration/{cloud.model}")),
    )
    record = Reconstruction(
        operation="reconstruct",
        settings=plain_settings(settings),
        model=cloud.model,
        axis=cloud.axis,
        points=int(np.count_nonzero(cloud.mask)),
        depth_mm=(float(near), float(far)),
        noise_mm=float(np.median(cloud.sigma_z[cloud.mask])),
        sigma_calibration_mm=None if left is None else float(np.median(left[cloud.mask])),
        raised=model.residuals_over_noise(cloud.axis) if isinstance(model, SplinedModel) else 1.0,
        masked=masked_share(model, phase, region),
        frame=frame_of(store, cloud.model),
        scale=describe_scale(store, cloud.model),
        scales={cloud.model: scale_factor(store, cloud.model)},
        inputs=store.input_hashes(*inputs),
    )
    return Found(
        settings.capture,
        record,
        {name: array for name, array in arrays.items() if array is not None},
    )


def triangulate_points(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Faces (m, 3) int32 over the pixels ``mask`` (h, w) bool of organised points; surfaces end
    where depth jumps."""
    return triangulate_grid(keep_pixels(points, mask))


def segment_board(
    store: Session, shot: Capture, texture: np.ndarray, warn: Warn
) -> np.ndarray | None:
    """Return the board's region (h, w) bool in a target pose; None, with a warning, where no board
    is detected."""
    board = load_stereo(store).board
    if not board:
        return None
    try:
        detection = detect(Board.parse(board), texture)
    except DetectionError as error:
        warn(f"{shot.name}: {error}")
        return None
    return board_mask(Board.parse(board), detection, texture.shape[:2])


def illuminated_pixels(phases: Mapping[Axis, PhaseMap], clouds: Mapping[str, Cloud]) -> np.ndarray:
    """Return the pixels (h, w) bool that a perfect decoder could have measured on the axis that the
    clouds came from."""
    return phases[next(iter(clouds.values())).axis].illuminated


def reconstruct_models(
    store: Session,
    chosen: Mapping[str, Model],
    shot: Capture,
    phases: Mapping[Axis, PhaseMap],
    axis: Axis | None,
    *,
    accept_rejected: bool = False,
    warn: Warn = ignore_warnings,
) -> dict[str, Cloud]:
    """One cloud a model, all from the same axis so that they can be compared pixel by pixel."""
    clouds: dict[str, Cloud] = {}
    for name, model in chosen.items():
        clouds[name] = capture_cloud(
            store, model, shot, phases, axis=axis, accept_rejected=accept_rejected, warn=warn
        )
        axis = axis or clouds[name].axis
    return clouds


def masked_share(model: Model, phase: PhaseMap, region: np.ndarray | None = None) -> float | None:
    """Share of the pixels (of ``region`` (h, w) bool, or of all) that could be measured and are
    masked, because they look through parts of camera or projector that no target pose illuminated;
    None for models that mask none.
    """
    if not isinstance(model, SplinedModel):
        return None
    every = np.isfinite(model.points(phase, supported=False)[..., 2])
    if region is not None:
        every &= region
    return float(1 - model.support(phase)[every].mean()) if every.any() else 0.0


def write_grid(path: Path, points: np.ndarray) -> None:
    """Write an organised cloud as .npy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:  # a file object, so that NumPy adds no suffix of its own
        np.save(file, points)
