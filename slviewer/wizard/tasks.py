"""The worker's jobs that are not operations yet, one function each.

What they save names its inputs, so that stale results are detected. The frames of a capture are
compared with each other by a job of their own (`engine`), which no cloud waits for.
"""

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.pipeline.edit import SUPPORT, Selection, delete_points
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.merge import MergeSettings
from slviewer.pipeline.models import POSES_FOR_PIXELWISE, accepts_rejected
from slviewer.pipeline.operation import Findings
from slviewer.pipeline.turn import WATERTIGHT, merge_turn
from slviewer.records.merge import Merge
from slviewer.session.scan_edits import load_edits
from slviewer.session.store import Session
from slviewer.surface.selection import select_support
from slviewer.wizard.export_files import export_file
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.result_views import used_points, whole_cloud


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
