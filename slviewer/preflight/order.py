"""Is frame k of a capture pattern k? A burst of coded frames decides."""

from dataclasses import replace
from typing import Any

import numpy as np

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import BurstProjector, stated_full_scale
from slviewer.errors import DeviceError
from slviewer.examination.examine import examine
from slviewer.fringe.presets import bits_for, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.examination import Check, CheckVerdict
from slviewer.preflight.rig_under_test import RigUnderTest
from slviewer.records.verdict import ORDER_CAUSES

_BEFORE, _AFTER = (1, 0, 0, 1, 0, 1), (0, 1, 1, 0)
_STEPS = 12
_PERIODS = 10  # across the projector
_LAGS = (1, 2, 3)


def check_order(bench: RigUnderTest) -> tuple[Check, Check]:
    """Check the order of the images, and whether images are delivered twice."""
    projector = bench.rig.projector.size
    levels = {1: Frame("white"), 0: Frame("black")}
    frames = (
        *(levels[on] for on in _BEFORE),
        *phase_steps("x", _STEPS, max(4.0, projector[0] / _PERIODS)),
        *(levels[on] for on in _AFTER),
    )
    full_scale = stated_full_scale(bench.rig.camera)
    sequence = PatternSequence(projector, frames, full_scale=full_scale, relative=True)
    bench.show(None, "order of the frames")
    bench.wait()
    stack = capture_frames(
        replace(bench.rig, settle_ms=bench.settle_ms), sequence, sleep=bench.clock.sleep
    )
    return _judge_order(bench, sequence, stack), check_repeats(sequence, stack)


def _judge_order(bench: RigUnderTest, sequence: PatternSequence, stack: np.ndarray) -> Check:
    """The check of the order of a captured stack (n, h, w): white and black frames, then fringe
    residuals."""
    n = len(stack)
    levels = {
        i: int(f.kind == "white")
        for i, f in enumerate(sequence.frames)
        if f.kind in ("white", "black")
    }
    shares = {
        i: bench.share(
            stack[i][:: bench.stride, :: bench.stride].astype(np.float32), bench.illuminated
        )
        for i in levels
    }
    errors = {i: abs(shares[i] - on) for i, on in levels.items()}
    wrong = [i for i, error in errors.items() if error > 0.4]
    mixed = [i for i, error in errors.items() if max(0.08, 5 * bench.unsteady) < error <= 0.4]
    misplaced = [f for f in examine(sequence, stack).findings if f.cause in ORDER_CAUSES]
    figures = {
        "frames": n,
        "light": [round(shares[i], 3) for i in sorted(shares)],
        "misplaced_frames": sorted(
            {*(i + 1 for i in wrong), *(i + 1 for f in misplaced for i in f.frames)}
        ),
    }
    if wrong and (lag := next((lag for lag in _LAGS if _is_lagging_by(shares, levels, lag)), 0)):
        many = "one image" if lag == 1 else f"{lag} images"
        sentence = f"Every frame is {many} late: frame k shows pattern k - {lag}."
        remedy = "Switch the camera's buffering off, or wait longer between showing and grabbing."
        return Check("order", "bad", sentence, remedy, figures | {"lag": lag})
    verdict, sentence, remedy = _describe_order(n, wrong, mixed, [f.sentence for f in misplaced])
    return Check("order", verdict, sentence, remedy, figures)


def _describe_order(
    n: int, wrong: list[int], mixed: list[int], misplaced: list[str]
) -> tuple[CheckVerdict, str, str]:
    """Verdict, sentence and remedy for ``n`` frames that do not lag: indices of frames of a wrong
    level of light, and of those that mix two; sentences on misplaced ones."""
    if wrong or misplaced:
        sentence = (
            "; ".join(misplaced[:3]) or f"frame {wrong[0] + 1} shows the wrong level of light"
        )
        remedy = (
            "Check the cable and the load of the computer, wait longer between showing and"
            " grabbing, then check again."
        )
        return "bad", f"Of {n} coded frames, {sentence}.", remedy
    if mixed:
        sentence = f"Frame {mixed[0] + 1} of {n} still shows part of the pattern before it."
        return (
            "warning",
            sentence,
            "Wait longer between showing and grabbing, or lock the camera to the projector.",
        )
    return "good", f"All {n} coded frames came in order.", ""


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
        what, _, remedy = str(error).rpartition(": ")
        sentence, remedy = (f"{part[:1].upper()}{part[1:]}." for part in (what, remedy))
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


def _is_lagging_by(shares: dict[int, float], levels: dict[int, int], lag: int) -> bool:
    """Whether every white or black frame shows the level of `lag` frames before, where that was one
    too."""
    pairs = [(shares[i], levels[i - lag]) for i in shares if i - lag in levels]
    return all(abs(share - on) < 0.3 for share, on in pairs)


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
