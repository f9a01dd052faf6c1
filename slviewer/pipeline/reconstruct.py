"""From a capture to a cloud."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import DetectionError, InputError
from slviewer.evaluation.compare import Comparison, compare
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_clouds import absolute_phases, capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
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
from slviewer.pipeline.open_session import SessionLike, opened_to_save, placed_file
from slviewer.pipeline.scale import describe_scale, scale_factor
from slviewer.pipeline.scan_edits import resolve_region, restrict_cloud, restriction_notes
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.mesh import triangulate_grid
from slviewer.reconstruction.reconstruct import JUMP, normals
from slviewer.session.capture import Capture
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect

REPORTED_RAISE = 1.2
"""Times its predicted noise that a calibration's residual is, from which raising sigma is reported."""


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed capture, the phases it came from, the file it went to, and for a board pose how flat each model
    measures the board. ``scale`` describes the correction of scale in it; ``masked`` is the share of the
    pixels that were masked because no target pose illuminated what they look through, None for models that mask none.
    ``frame``: the one that the points are in, in words. ``raised``: the calibration's residuals over their predicted
    noise, by which sigmas are raised. ``restrictions`` describes the edits and the region that it was cut by.
    """

    cloud: Cloud
    phases: Mapping[Axis, PhaseMap]
    ply: Path
    points: int
    board: Comparison | None = None
    scale: str = ""
    masked: float | None = None
    frame: str = ""
    raised: float = 1.0
    restrictions: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        cloud = self.cloud
        z, sigma = cloud.points[..., 2][cloud.mask], cloud.sigma_z[cloud.mask]
        lines = [
            f"{self.points} points by {cloud.model} from axis {cloud.axis}, z {np.percentile(z, 1):.0f}-"
            f"{np.percentile(z, 99):.0f} mm, predicted depth noise {np.median(sigma):.3f} mm -> {self.ply}"
        ]
        if cloud.sigma_calibration is not None:
            sigma_z = cloud.sigma_calibration[cloud.mask]
            lines.append(
                f"apart from a rigid motion, the calibration leaves {np.median(sigma_z):.4f} mm of depth uncertain in "
                f"the median, {np.percentile(sigma_z, 95):.4f} mm at 95 % (1 sigma)"
            )
        if self.raised > REPORTED_RAISE:
            lines.append(
                f"sigma was raised: the calibration's residuals in {cloud.axis} are {self.raised:.1f} times their "
                "predicted noise, and what disturbs its phases disturbs this capture's as well"
            )
        lines += self.restrictions
        if self.frame:
            lines.append(f"frame: {self.frame}")
        if self.scale:
            lines.append(self.scale)
        if self.masked is not None and self.masked > 0.005:
            lines.append(f"{100 * self.masked:.1f} % of the pixels are masked: they lie outside the calibrated region")
        if self.board is not None:
            lines += ["inside the board's outline:", self.board.text()]
        return "\n".join(lines)


def reconstruct(
    session: SessionLike,
    capture: str,
    *,
    model: ModelName | None = None,
    axis: Axis | None = None,
    depth_range: tuple[float, float] | None = None,
    out: Path | str | None = None,
    grid: Path | str | None = None,
    mesh: bool = False,
    roi: str = "",
    accept_rejected: bool = False,
    check: bool = True,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Reconstruction:
    """Reconstruct a capture as a cloud, and store it in the session; for a board pose also how flat each model measures
    the board.

    Args:
        session: Session folder.
        capture: Name of the capture.
        model: Which calibration to use, here and by what then works on this cloud; by default the best one available.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        depth_range: For patterns that do not cover the projector: near and far end, mm, of the depths between which
            all surfaces lie; by default the calibrated depths.
        out: PLY file; by default in the session's exports. That of a board pose holds the points inside the board's
            outline.
        grid: Also write the whole organised cloud, (h, w, 3) float32 mm, NaN where invalid, as .npy.
        mesh: Put the triangles between neighbouring pixels into the PLY.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the camera's frame
            (x right, y down, z away), a TOML file, or off; by default the session's.
        accept_rejected: Use the calibration although its verdict rejects it.

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """
    for path, suffix in ((out, ".ply"), (grid, ".npy")):
        if path is not None and Path(path).suffix.lower() != suffix:
            raise InputError(
                f"{path}: a cloud is written as .ply (--out), its whole grid as .npy (--grid): end its name in "
                f"{suffix}; `slviewer export` writes other formats"
            )
    with opened_to_save(session, warn) as store:
        check_accepted(store, accept_rejected)
        name = model or preferred_model(store)
        warn_if_stale(store, warn)
        check_capture_sizes(store, [capture])
        progress(0.1, "reading and decoding")
        shot, frames, decoded = next(decode_captures(store, [capture], warn, relative=True, check=check))
        phases = absolute_phases(store, capture, decoded, depth_range, warn)
        is_pose = shot.role == "calibration"
        texture = capture_texture(shot, frames, stretch=is_pose)
        chosen = load_models(store, () if is_pose and model is None else (name,))
        progress(0.6, "reconstructing")
        clouds = {
            n: capture_cloud(
                store, m, shot, phases, axis=axis, texture=texture, accept_rejected=accept_rejected, warn=warn
            )
            for n, m in chosen.items()
        }
        cloud = uncut = clouds[name]
        box = None if is_pose else resolve_region(store, roi)
        cloud = cloud if is_pose else restrict_cloud(store, capture, cloud, box)
        restrictions = () if is_pose else restriction_notes(store, [capture], box)
        region = segment_board(store, shot, texture, warn) if is_pose else None
        board = None
        if region is not None:
            depth_range = load_stereo(store).depth_range_mm
            board = compare("plane", clouds, illuminated_pixels(phases, clouds), region=region, depth_range=depth_range)
        mask = cloud.mask if region is None else cloud.mask & region
        if not mask.any():
            raise InputError(
                f"{capture}: no pixel could be reconstructed with {name}: does the calibration belong to this camera "
                "and projector, and is the scene within its depths?"
            )
        progress(0.8, "writing")
        faces = triangulate_points(cloud.points, mask) if mesh else None
        notes = (f"scan {capture}, frame: {frame_of(store, name)}", f"calibration {name}", *restrictions)
        scale, fitted, frame = describe_scale(store, name), chosen[name], frame_of(store, name)
        masked = masked_share(fitted, phases[cloud.axis], region)
        raised = fitted.residuals_over_noise(cloud.axis) if isinstance(fitted, SplinedModel) else 1.0
        with placed_file(store, out, f"{capture}_{name}{'_mesh' if mesh else ''}.ply") as (ply, written):
            write_ply(
                written,
                choose_pixels(cloud.points, mask),
                texture[mask],
                normals(cloud.points)[mask],
                cloud.sigmas(mask),
                faces,
                notes,
            )
            if grid is not None:
                write_grid(Path(grid), cloud.points)
            if store.is_writable:
                progress(0.95, "storing")
                save_cloud(store, capture, uncut, phases[cloud.axis], masked)
        progress(1.0, "reconstructed")
    count = int(np.count_nonzero(mask))
    return Reconstruction(cloud, phases, ply, count, board, scale, masked, frame, raised, restrictions)


def save_cloud(store: Session, capture: str, cloud: Cloud, phase: PhaseMap, masked: float | None) -> None:
    """Store a capture's cloud, before edits and region, as ``clouds/<capture>``; ``masked``: see `Reconstruction`."""
    near, far = np.percentile(cloud.points[..., 2][cloud.mask], [1, 99])
    meta = {
        "model": cloud.model,
        "axis": cloud.axis,
        "points": int(np.count_nonzero(cloud.mask)),
        "depth_mm": [float(near), float(far)],
        "noise_mm": float(np.median(cloud.sigma_z[cloud.mask])),
        "masked": masked,
        "scale": describe_scale(store, cloud.model),
        "scales": {cloud.model: scale_factor(store, cloud.model)},
        "inputs": store.input_hashes(capture, *dict.fromkeys(("calibration/stereo", f"calibration/{cloud.model}"))),
    }
    assert cloud.texture is not None
    arrays = {
        "points": cloud.points,
        "sigma_z": cloud.sigma_z,
        "phase": phase.phase,
        "modulation": phase.modulation,
        "texture": cloud.texture,
    }
    if cloud.sigma_calibration is not None:
        meta["sigma_calibration_mm"] = float(np.median(cloud.sigma_calibration[cloud.mask]))
        arrays["sigma_calibration"] = cloud.sigma_calibration
    if cloud.sigma_edges is not None:
        arrays["sigma_edges"] = cloud.sigma_edges
    store.save_result(f"clouds/{capture}", meta, arrays)


def triangulate_points(points: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Faces (m, 3) int32 over the pixels ``mask`` (h, w) bool of organised points; surfaces end where depth jumps."""
    masked_points = np.where(mask[..., None], points, np.float32(np.nan))
    return triangulate_grid(masked_points, JUMP * float(np.median(points[..., 2][mask])))


def segment_board(store: Session, shot: Capture, texture: np.ndarray, warn: Warn) -> np.ndarray | None:
    """Return the board's region (h, w) bool in a target pose; None, with a warning, where no board is detected."""
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
    """Return the pixels (h, w) bool that a perfect decoder could have measured on the axis that the clouds came
    from."""
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
        clouds[name] = capture_cloud(store, model, shot, phases, axis=axis, accept_rejected=accept_rejected, warn=warn)
        axis = axis or clouds[name].axis
    return clouds


def masked_share(model: Model, phase: PhaseMap, region: np.ndarray | None = None) -> float | None:
    """Share of the pixels (of ``region`` (h, w) bool, or of all) that could be measured and are masked, because they
    look through parts of camera or projector that no target pose illuminated; None for models that mask none."""
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
