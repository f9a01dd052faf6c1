"""Is frame k of a capture pattern k?"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import structs

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import BurstProjector, stated_full_scale
from slviewer.errors import DeviceError
from slviewer.examination.examine import examine
from slviewer.fringe.presets import bits_for, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, Kind, PatternSequence
from slviewer.pipeline.examination import Check, CheckVerdict
from slviewer.preflight.rig_under_test import RigUnderTest
from slviewer.printable import capitalize
from slviewer.records.verdict import ORDER_CAUSES, Examination, Finding

MISPLACING_CAUSES = (*ORDER_CAUSES, "ghosting")
_STEPS = 12
_PERIODS = 10  # across the projector
_REMEDY = (
    "Switch the camera's buffering off, wait longer between showing and grabbing, check the cable"
    " and the load of the computer, then check again."
)


def check_order(bench: RigUnderTest) -> tuple[Check, Check]:
    """Check the order of the images, and whether images are delivered twice."""
    projector, full_scale = bench.rig.projector.size, stated_full_scale(bench.rig.camera)
    period_px = max(4.0, projector[0] / _PERIODS)
    bits = range(bits_for(projector[0] / period_px))
    kinds: tuple[Kind, ...] = ("gray", "inverse")
    code = (Frame(kind, "x", bit=bit) for bit in bits for kind in kinds)
    frames = (*phase_steps("x", _STEPS, period_px), *code)
    sequence = PatternSequence(projector, frames, full_scale=full_scale)
    bench.show(None, "order of the frames")
    bench.wait()
    stack = capture_frames(
        replace(bench.rig, settle_ms=bench.settle_ms), sequence, sleep=bench.clock.sleep
    )
    order = judge_order(sequence, examine(sequence, stack))
    if order.verdict != "good":
        order = structs.replace(order, remedy=_REMEDY)
    return order, check_repeats(sequence, stack)


def judge_order(sequence: PatternSequence, examination: Examination) -> Check:
    """Check that every frame shows the pattern of its place in the sequence."""
    found = [f for f in examination.findings if f.cause in MISPLACING_CAUSES]
    n = len(sequence.frames)
    figures: dict[str, Any] = {
        "frames": n,
        "misplaced_frames": sorted({i + 1 for f in found for i in f.frames}),
    }
    if not found:
        return Check("order", "good", f"All {n} frames are in order.", "", figures)
    if found[0].cause == "frame-lag" and found[0].value:
        figures["lag"] = int(found[0].value)
    findings = "; ".join(dict.fromkeys(f.observation for f in found[:3]))
    remedy = format_sentence(found[0].remedy)
    return Check("order", rate_findings(found), f"Of {n} frames, {findings}.", remedy, figures)


def rate_findings(findings: Iterable[Finding]) -> CheckVerdict:
    """Return the verdict of a check with findings: bad where one of them rejects the capture."""
    return "bad" if any(f.severity == "rejected" for f in findings) else "warning"


def format_sentence(text: str) -> str:
    """Return an observation or a remedy as a sentence; "" for none."""
    return text and f"{capitalize(text)}."


def check_burst(bench: RigUnderTest) -> Check:
    """Check that a burst captures what the same patterns do one by one, and time both."""
    rig, size = bench.rig, bench.rig.projector.size
    bits = max(7, bits_for(size[0] / 18))
    sequence = PatternSequence(size, (*phase_steps("x", 18, 18.0), *gray_bits("x", bits)))
    began = bench.clock.now()
    single = capture_frames(
        replace(rig, settle_ms=bench.settle_ms), sequence, sleep=bench.clock.sleep
    )
    single_s = bench.clock.now() - began
    assert isinstance(rig.projector, BurstProjector)
    burst_s, n = rig.projector.prepare().seconds, len(single)
    figures: dict[str, Any] = {
        "frames": n,
        "burst_s": round(burst_s, 3),
        "single_s": round(single_s, 3),
    }
    try:
        burst = capture_frames(replace(rig, bursts=True), sequence)
    except DeviceError as error:
        sentence, remedy = format_sentence(error.observation), format_sentence(error.remedy)
        return Check("burst", "bad", sentence, remedy, figures)
    bursts, singles = (
        stack[:, :: bench.stride, :: bench.stride][:, bench.illuminated].astype(np.float32)
        for stack in (burst, single)
    )
    looks_like = [int(np.abs(row - singles).mean(axis=1).argmin()) for row in bursts]
    wrong = [k + 1 for k, other in enumerate(looks_like) if other != k]
    figures |= {"misplaced_frames": wrong}
    if wrong:
        sentence = f"Frame {wrong[0]} of a burst of {n} does not show pattern {wrong[0]}."
        remedy = "Set refresh_hz to the refresh rate of the projector's display."
        return Check("burst", "bad", sentence, remedy, figures)
    sentence = (
        f"A burst shows {n} frames in {burst_s:.2f} s, all in order; one by one they take"
        f" {single_s:.2f} s."
    )
    return Check("burst", "good", sentence, "", figures)


def check_repeats(sequence: PatternSequence, stack: np.ndarray) -> Check:
    """The check of images identical to the one before although the pattern changed; a camera may be
    without noise."""
    changed = [k for k in range(1, len(stack)) if sequence.frames[k] != sequence.frames[k - 1]]
    same = [k for k in changed if np.array_equal(stack[k], stack[k - 1])]
    figures = {"detect_copies": [k + 1 for k in same], "frames": len(stack)}
    if same:
        listed = ", ".join(str(k + 1) for k in same[:5])
        return Check(
            "repeats",
            "bad",
            f"{len(same)} of {len(stack)} images of the burst are the one before once more (frame"
            f" {listed}).",
            "The driver hands out old images: lower the frame rate, or update it; then check"
            " again.",
            figures,
        )
    return Check("repeats", "good", f"No image of {len(stack)} came twice.", "", figures)
