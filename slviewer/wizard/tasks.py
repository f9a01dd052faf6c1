"""The worker's jobs that are no operations yet, one function each.

What they save names its inputs, so that stale results are detected. The frames of a capture are
compared with each other by a job of their own (`engine`), which no cloud waits for.
"""

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.evaluation.crossvalidation import CrossValidation
from slviewer.pipeline.calibrate import CalibrationResult, calibrate
from slviewer.pipeline.edit import SUPPORT, Selection, delete_points
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.merge import MergeSettings
from slviewer.pipeline.models import POSES_FOR_PIXELWISE, accepts_rejected, available_models
from slviewer.pipeline.operation import Findings
from slviewer.pipeline.turn import WATERTIGHT, merge_turn
from slviewer.pipeline.validate import validate
from slviewer.records.merge import Merge
from slviewer.session.scan_edits import load_edits
from slviewer.session.store import Session
from slviewer.surface.selection import select_support
from slviewer.wizard.export_files import export_file
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.result_views import used_points, whole_cloud
from slviewer.wizard.snapshot import Level


def calibrate_session(
    session: Session, target: str, report: Reporter, warn: Warn
) -> CalibrationResult:
    """Calibrate every model that the included poses allow; models that they no longer allow go to
    the trash."""
    guarded = session.guarded(report.saving)
    models = ["stereo", "pixelwise"]
    if missing := missing_for_splined(session):
        warn(f"no splined model: {missing}")
    else:
        models.append("splined")
    made = calibrate(guarded, target, models=models, progress=report, warn=warn)
    for name in available_models(session):
        if getattr(made, name) is None:
            guarded.trash_result(f"calibration/{name}")
    return made


def describe_calibration(made: CalibrationResult) -> tuple[Level, str]:
    """Describe a calibration result in one sentence: (level, text)."""
    rms = made.stereo.reprojection_rms_px["stereo"]
    text = f"calibrated from {len(made.stereo.poses)} poses: reprojection RMS {rms:.3f} px"
    return (
        ("good", text)
        if made.verdict.level == "good"
        else ("warning", f"{text}; doubtful: {made.verdict.reason}")
    )


def missing_for_splined(session: Session) -> str:
    """Describe what the poses lack for the splined model; empty where they allow it."""
    excluded = session.excluded()
    poses = [capture for capture in session.captures("calibration") if capture.name not in excluded]
    both = sum(len(capture.sequence.axes) == 2 for capture in poses)
    if both >= POSES_FOR_PIXELWISE:
        return ""
    needed = f"it needs {POSES_FOR_PIXELWISE} target poses with patterns along both axes"
    if len(poses) < POSES_FOR_PIXELWISE:
        return f"{needed}, and there are {both}: capture more"
    return (
        f"{needed}, and only {both} of {len(poses)} have them: choose patterns of both axes, and"
        " capture more"
    )


def compare_models(session: Session, report: Reporter, warn: Warn) -> CrossValidation:
    """Cross-validate the models on poses they were not calibrated from, and save the comparison."""
    return validate(session.guarded(report.saving), progress=report, warn=warn)


def describe_comparison(compared: CrossValidation) -> str:
    """Describe the comparison of the models in one sentence: held-out errors, and the recommended
    model."""
    figures = ", ".join(
        f"{model} {compared.rms(model, 'board_mm'):.3f} mm" for model in compared.models
    )
    return f"held-out error of the models: {figures}; {compared.recommended} is recommended"


def remove_support(
    session: Session, names: list[str], report: Reporter, warn: Warn
) -> dict[str, int]:
    """Delete the plane that the object stands on, and all below it, from scans: {scan: points
    deleted}.

    Scans without such a plane, and those that it was deleted from before, stay as they are, with a
    warning. InputError where all of them do.
    """
    selections, refused = list[Selection](), list[str]()
    for i, name in enumerate(names):
        report(i / len(names), f"removing the support from {name}")
        if any(edit.plane is not None for edit in load_edits(session, name).active):
            refused.append(f"{name}: its support was removed before; Undo edit brings it back")
            continue
        try:
            cloud = used_points(session, whole_cloud(session, name))
            plane, selected = select_support(cloud.points, cloud.sigma_z)
            selections.append(Selection(name, cloud.points, selected, plane))
        except InputError as error:
            refused.append(f"{name}: {error}")
    if not selections:
        raise InputError("; ".join(refused) or "no scan is reconstructed yet")
    deleted = delete_points(session.guarded(report.saving), selections, SUPPORT)
    for reason in refused:
        warn(reason)
    report(1.0, "support removed")
    return deleted


def describe_removal(deleted: dict[str, int]) -> str:
    """Describe in a sentence what `remove_support` deleted."""
    counts = ", ".join(f"{name} {count:,} points" for name, count in deleted.items())
    return f"support removed: {counts}; Undo edit brings it back"


def merge_scanned_turn(
    session: Session, names: list[str], report: Reporter, warn: Warn
) -> tuple[Findings[Merge], str]:
    """Merge the scans of a turn by the angles of its turntable, and write a watertight mesh into
    the exports.

    Returns the merge, and a sentence about the mesh; where it does not close, the merge stays.
    """
    settings = MergeSettings(names, names[0], accept_rejected=accepts_rejected(session))
    merged = merge_turn(session.guarded(report.saving), settings, report.within(0, 0.7), warn)
    (number,) = merged
    try:
        words = export_file(
            session, "merged-mesh", number, "ply", WATERTIGHT, report.within(0.7, 1), warn
        )
    except Cancelled:
        raise
    except SlviewerError as error:
        words = "no watertight mesh was made"
        warn(f"{words}: {error}")
    report(1.0, "merged")
    return merged, words


def describe_turn(result: tuple[Findings[Merge], str]) -> str:
    """Describe the merge and the mesh of a turn in one sentence."""
    (merged,), words = result[0].values(), result[1]
    worst = max(pair.rms_mm for pair in merged.pairs.values())
    return (
        f"{len(merged.scans)} scans merged on {merged.reference}, RMS up to {worst:.3f} mm; {words}"
    )
