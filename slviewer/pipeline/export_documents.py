"""Documents of a session for other programs: the calibration, its coefficients, poses, figures."""

from pathlib import Path
from typing import Any

import numpy as np

from slviewer import __version__
from slviewer.calibration.pinhole_fit import fit_splined, pixelwise_residuals
from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import rigid_transform
from slviewer.pipeline.models import available_models, frame_of, load_model, load_stereo
from slviewer.pipeline.scale import scale_factor
from slviewer.pipeline.stored_records import Stored, list_records
from slviewer.printable import format_csv
from slviewer.records.kinds import RECORDS
from slviewer.records.merge import Merge
from slviewer.records.table import Value
from slviewer.session.atomic import arriving_file, replace_file
from slviewer.session.exporters import write_calibration
from slviewer.session.names import natural_key
from slviewer.session.store import Session

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
        "baseline_mm": factor * float(np.linalg.norm(rig.t)),
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
            "only the pixelwise and the splined model have coefficients for each pixel: calibrate"
            " these"
        )
    model = load_model(store, name or there[0])
    assert isinstance(model, PixelwiseModel | SplinedModel)
    arrays = (
        _collect_pixelwise_arrays(model)
        if isinstance(model, PixelwiseModel)
        else _collect_splined_arrays(model)
    )
    factor = scale_factor(store, model.name)
    arrays |= {"scale_factor": np.array(factor)}
    with arriving_file(path, sum(array.nbytes for array in arrays.values())) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return model.name


def _collect_pixelwise_arrays(model: PixelwiseModel) -> dict[str, np.ndarray]:
    """Return the arrays of a pixelwise model's .npz file, with ``about`` as documentation."""
    about = (
        "slviewer, model pixelwise: for axis x or y and camera pixel (row, column), c ="
        " <axis>_coefficients[:, row, column], phi the absolute phase in rad of fringes of"
        " <axis>_period_px projector px, phi = 2 pi u/period: z = (c0 + c1 phi)/(1 + c2 phi), x ="
        " c3 z, y = c4 z, in mm in the camera's frame, all times scale_factor. <axis>_rms_mm: the"
        " fit's RMS in z, x, y; <axis>_poses: target poses used; <axis>_phase_min, _phase_max: the"
        " phases used. NaN where not fitted."
    )
    arrays = {"about": np.array(about)}
    for axis, fit in model.fits.items():
        arrays[f"{axis}_period_px"] = np.array(model.periods_px[axis])
        for key in ("coefficients", "rms_mm", "poses", "phase_min", "phase_max"):
            arrays[f"{axis}_{key}"] = getattr(fit, key)
    return arrays


def _collect_splined_arrays(model: SplinedModel) -> dict[str, np.ndarray]:
    """Return the arrays of a splined model's .npz file, with ``about`` as documentation."""
    about = (
        "slviewer, model splined, compiled: for axis x or y and camera pixel (row, column), c ="
        " <axis>_coefficients[:, row, column], s = projector coordinate in px less"
        " <axis>_centre_px: z0 = (c0 + c1 s)/(1 + c2 s); z = z0 + g, g interpolated linearly in"
        " <axis>_grid at (row/step, column/step, (z0 - near)/(far - near) (n - 1)) with"
        " <axis>_grid_step_px, near and far = <axis>_depths_mm and n the grid's last length; x ="
        " rays[0] z, y = rays[1] z, in mm in the camera's frame, all times scale_factor. NaN: not"
        " measured."
    )
    arrays = {"about": np.array(about), "rays": model.rays}
    for axis in model.axes:
        fast = model.fast_axis(axis)
        arrays |= {
            f"{axis}_coefficients": fast.coefficients,
            f"{axis}_centre_px": np.array(fast.centre),
            f"{axis}_grid": fast.supported_grid,
            f"{axis}_grid_step_px": np.array(fast.step),
            f"{axis}_depths_mm": np.array([fast.near, fast.far]),
        }
    return arrays


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
    fitted = load_model(store, model)
    if isinstance(fitted, SplinedModel):
        bundle = fitted.bundle
        rms = {name: (fit.camera_rms_px, fit.projector_rms_px) for name, fit in bundle.fits.items()}
        T_camera_board = rigid_transform(bundle.state.R_board, bundle.state.t_board)
        poses = dict(zip(bundle.poses, T_camera_board, strict=True))
    else:
        stereo = load_stereo(store)
        poses, rms = dict(stereo.poses), dict(stereo.pose_rms_px)
    targets, factor = [], scale_factor(store, model)
    for name in sorted(poses, key=natural_key):
        figures = dict(
            zip(("camera_rms_px", "projector_rms_px"), map(float, rms.get(name, ())), strict=False)
        )
        T = np.array(poses[name], float)
        T[:3, 3] *= factor
        targets.append({"name": name, "T_camera_board": T, **figures})
    return targets


def _merge_entry(store: Session, each: Stored[Merge]) -> dict[str, Any]:
    """Return a merge's scans with their transforms (4, 4) mm to the reference and their
    registration figures."""
    made = each.record
    projector = np.linalg.inv(
        _projector_transform(
            store, made.model if made.model in available_models(store) else "stereo"
        )
    )
    scans = []
    for scan in made.scans:
        pair = made.pairs.get(scan)
        T = np.eye(4) if pair is None else np.array(pair.T_reference_scan, float)
        figures = {
            key: value for key in _FIGURES if (value := getattr(pair, key, None)) is not None
        }
        scans.append(
            {"name": scan, "T_reference_scan": T, "T_reference_projector": T @ projector, **figures}
        )
    return {"name": each.name, "reference": made.reference, "model": made.model, "scans": scans}


def _projector_transform(store: Session, model: str) -> np.ndarray:
    """T_projector_camera (4, 4) mm by a model, with its correction of scale."""
    fitted = load_model(store, model)
    rig = fitted.rig if isinstance(fitted, SplinedModel) else load_stereo(store).rig
    return rigid_transform(rig.R, scale_factor(store, model) * rig.t)


def write_table(store: Session, path: Path) -> None:
    """Write the tables of all records as one CSV: a line for each of theirs, the kind and whether
    it is up to date."""
    every = [each for kind in RECORDS.values() for each in list_records(store, kind)]
    if not every:
        raise InputError("nothing was found yet: verify, reconstruct or merge captures first")
    rows: list[dict[str, Value]] = []
    for each in every:
        for table in each.record.tables({each.name: each.record}):
            headings = [column.heading for column in table.columns]
            start = {
                "kind": each.record.kind,
                "record": each.name,
                "label": each.label,
                "up to date": "no" if each.stale else "yes",
            }
            rows += [
                {**start, **dict(zip(headings, table.values(row), strict=True))}
                for row in table.rows
            ]
    titles = list(dict.fromkeys(title for row in rows for title in row))
    replace_file(
        path, format_csv([titles, *([row.get(title) for title in titles] for row in rows)]).encode()
    )
