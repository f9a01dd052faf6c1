"""What the worker computes, and what it leaves in the session: one function a job.

=====================  ============================================================================================
`poses/<capture>`      what a target pose says (`workflow.poses`)
`clouds/<capture>`     the organised cloud, with phase and modulation at each pixel
`verify/<capture>`     error maps and figures of a plane or a sphere, model by model
`merge/<number>`       how scans lie on their reference; the points are in `exports/merged_<number>.ply`
=====================  ============================================================================================

All of them name their inputs, so that what has become stale is seen.
"""

import numpy as np

from slviewer.calibration.observe import Smoothing
from slviewer.evaluation.plane import PlaneResult
from slviewer.evaluation.sphere import SphereResult
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.workflow.calibrating import CalibrationResult, calibrate
from slviewer.workflow.feedback import Warn
from slviewer.workflow.merging import Merge, merge
from slviewer.workflow.models import available, best
from slviewer.workflow.poses import Judged, judge_all
from slviewer.workflow.reconstructing import reconstruct
from slviewer.workflow.verifying import Shape, verify
from slviewer.workflow.wizard.exporting import delivered
from slviewer.workflow.wizard.jobs import Reporter

SMOOTHING = Smoothing()


def judge_pose(session: Session, name: str, board: Board, report: Reporter) -> Judged:
    """Decode a target pose, find its board, and keep what it says."""
    report(0.0, f"looking at {name}")
    return next(judge_all(session.guarded(report.saving), [name], board, SMOOTHING))


def make_calibration(session: Session, target: str, report: Reporter, warn: Warn) -> CalibrationResult:
    """Calibrate both models from the poses that are not excluded."""
    return calibrate(session.guarded(report.saving), target, progress=report, warn=warn)


def make_cloud(session: Session, name: str, model: str | None, report: Reporter, warn: Warn) -> int:
    """Reconstruct a capture, keep its cloud, and put its PLY into the exports; returns how many points it has."""
    model = model or best(session)
    with delivered(session, f"{name}_{model}.ply", report) as ply:
        found = reconstruct(session, name, model=model, out=ply, progress=report.within(0, 0.9), warn=warn)
        cloud, phase = found.cloud, found.phases[found.cloud.axis]
        z = cloud.points[..., 2][cloud.mask]
        near, far = np.percentile(z, [1, 99])
        calibrations = dict.fromkeys(("calibration/stereo", f"calibration/{model}"))
        meta = {
            "model": model,
            "axis": cloud.axis,
            "points": found.points,
            "depth_mm": [float(near), float(far)],
            "noise_mm": float(np.median(cloud.sigma_z[cloud.mask])),
            "inputs": session.input_hashes(name, *calibrations),
        }
        assert cloud.texture is not None
        arrays = {
            "points": cloud.points,
            "sigma_z": cloud.sigma_z,
            "phase": phase.phase,
            "modulation": phase.modulation,
            "texture": cloud.texture,
        }
        report(0.95, "saving")
        session.guarded(report.saving).save_result(f"clouds/{name}", meta, arrays)
    report(1.0, "reconstructed")
    return found.points


def measure(
    session: Session, names: list[str], shape: Shape, radius: float | None, report: Reporter, warn: Warn
) -> dict[str, dict[str, float]]:
    """Compare the models on captures of a plane or a sphere, keep error maps and clouds; {capture: {model: RMS mm}}."""
    rms = {}
    for i, name in enumerate(names):
        span = report.within(i / len(names), (i + 1) / len(names))
        found = verify(session, [name], shape, radius=radius, progress=span.within(0, 0.5), warn=warn).captures[name]
        models = available(session)
        meta = {
            **found.to_dict(),
            "centres_mm": {m: r.sphere.centre for m, r in found.results.items() if isinstance(r, SphereResult)},
            "normals": {m: r.plane.normal for m, r in found.results.items() if isinstance(r, PlaneResult)},
            "inputs": session.input_hashes(name, *(f"calibration/{model}" for model in models)),
        }
        arrays = {f"error_{model}": result.error_map for model, result in found.results.items()}
        span(0.5, "saving")
        session.guarded(report.saving).save_result(f"verify/{name}", meta, arrays)
        make_cloud(session, name, None, span.within(0.5, 1), warn)
        rms[name] = {model: result.rms_mm for model, result in found.results.items()}
    report(1.0, "measured")
    return rms


def merge_scans(session: Session, names: list[str], reference: str, report: Reporter, warn: Warn) -> Merge:
    """Register scans to a reference, and keep how they lie; the merged PLY goes into the exports."""
    done = [int(name.removeprefix("merge/")) for name in session.result_names() if name.startswith("merge/")]
    number = max(done, default=0) + 1
    model = best(session)
    with delivered(session, f"merged_{number}.ply", report) as ply:
        found = merge(session, names, reference, ply, model=model, progress=report.within(0, 0.97), warn=warn)
        calibrations = dict.fromkeys(("calibration/stereo", f"calibration/{model}"))
        meta = {
            **found.to_json(),
            "scans": list(found.merged.names),
            "points": len(found.merged.points),
            "ply": f"merged_{number}.ply",
            "model": model,
            "inputs": session.input_hashes(*found.merged.names, *calibrations),
        }
        session.guarded(report.saving).save_result(f"merge/{number}", meta, {})
    report(1.0, "merged")
    return found
