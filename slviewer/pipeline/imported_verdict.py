"""The verdict on a calibration that was imported: whether a capture has confirmed R and T."""

from pathlib import Path

import numpy as np

from slviewer.records.calibration import TransformCheck
from slviewer.records.record import from_plain
from slviewer.records.verdict import Finding, Severity, Verdict
from slviewer.session.store import Session

SIMULATED_TRUTH = "the simulation's truth"
"""Source of a stereo calibration that needs no check."""
MEASURING = (
    "capture its board and run `slviewer check SESSION CAPTURE --target BOARD`, or a sphere of"
    " known size, with --radius MM"
)
NEAR_MM = 150.0
"""Surfaces nearer than this make a unit doubtful that nothing states: few rigs focus there, and
most that are taken for mm instead of cm or inches."""


def list_transform_checks(store: Session) -> list[TransformCheck]:
    """The checks of the session's present calibration, which was imported; the oldest first."""
    now = store.input_hashes("calibration/stereo")["calibration/stereo"]
    names = [name for name in store.result_names() if name.startswith(f"{TransformCheck.kind}/")]
    checks = [
        store.decode_result(name, lambda meta, _: from_plain(meta, TransformCheck), only=())
        for name in names
    ]
    return [each for each in checks if each.inputs.get("calibration/stereo") == now]


def judge_imported(store: Session) -> Verdict | None:
    """Return the verdict on an imported calibration, by its checks; None for one that was made
    here, and without any."""
    if not store.has_result("calibration/stereo"):
        return None
    meta = store.load_meta("calibration/stereo")
    if "imported" not in meta or meta["source"] == SIMULATED_TRUTH:
        return None
    checks = list_transform_checks(store)
    measured = [each for each in checks if each.scale is not None and each.answer != "undecided"]
    checks = measured[-1:] or checks  # the last one that knows a length decides
    agreeing = [each for each in checks if each.is_good]
    contradicting = [each for each in checks if each.answer == "disagrees"]
    if not agreeing and contradicting:
        last = contradicting[-1]
        return Verdict.of([Finding("transform", "rejected", last.observation, last.remedy)])
    file, baseline = Path(meta["source"]).name, np.linalg.norm(meta["imported"]["T"])
    if not agreeing:
        sentence = (
            f"calibration not checked: no capture has confirmed R and T of {file}, baseline"
            f" {baseline:.1f} mm, which may be inverted, transposed or in another unit"
        )
        remedy = f"reconstruct a capture with patterns along both axes; or {MEASURING}"
        return Verdict.of([Finding("transform", "doubtful", sentence, remedy)])
    if meta.get("unit") or measured:
        return Verdict()
    depth_mm = min((each.depth_mm for each in agreeing if each.depth_mm), default=np.inf)
    sentence = (
        f"unit not checked: T of {file} is taken to be in mm, as nothing states its unit (baseline"
        f" {baseline:.1f} mm, and by that the surfaces lie at {depth_mm:.0f} mm)"
    )
    severity: Severity = "doubtful" if depth_mm < NEAR_MM else "note"
    remedy = f"import it with its --unit; or {MEASURING}"
    return Verdict.of([Finding("transform", severity, sentence, remedy)])


def warning_of_imported(store: Session) -> str:
    """Return why an imported calibration is doubtful, or rejected, and what to do; empty where it
    is neither."""
    verdict = judge_imported(store)
    return "" if verdict is None or verdict.level == "good" else verdict.reason
