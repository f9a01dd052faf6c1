"""Is frame k of a capture pattern k? A burst of coded frames decides."""

from dataclasses import replace

import numpy as np

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import stated_full_scale
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.residual import frame_residuals
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.fringe.suspect import LIGHT_FAULTS
from slviewer.pipeline.check_results import Check
from slviewer.preflight.rig_under_test import RigUnderTest

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
    sequence = PatternSequence(projector, frames, full_scale=stated_full_scale(bench.rig.camera))
    bench.show(None, "order of the frames")
    bench.wait()
    stack = capture_frames(replace(bench.rig, settle_ms=bench.settle_ms), sequence, sleep=bench.clock.sleep)
    return _judge_order(bench, sequence, stack), check_repeats(sequence, stack)


def _judge_order(bench: RigUnderTest, sequence: PatternSequence, stack: np.ndarray) -> Check:
    """The check of the order of a captured stack (n, h, w): white and black frames, then fringe residuals."""
    n = len(stack)
    levels = {i: int(f.kind == "white") for i, f in enumerate(sequence.frames) if f.kind in ("white", "black")}
    shares = {
        i: bench.share(stack[i][:: bench.stride, :: bench.stride].astype(np.float32), bench.illuminated) for i in levels
    }
    wrong = [i for i, on in levels.items() if abs(shares[i] - on) > 0.4]
    part = max(0.08, 5 * bench.unsteady)
    mixed = [i for i, on in levels.items() if part < abs(shares[i] - on) <= 0.4]
    residuals = frame_residuals(sequence, stack, "x")
    # Where the light flickers, a frame that fits no step needs no other explanation.
    ignored = (*LIGHT_FAULTS, "strange") if bench.unsteady > 0.01 else LIGHT_FAULTS
    misplaced = [s for s in residuals.suspects if s.fault not in ignored]
    figures = {
        "frames": n,
        "light": [round(shares[i], 3) for i in sorted(shares)],
        "misplaced_frames": sorted({*(i + 1 for i in wrong), *(s.frame + 1 for s in misplaced)}),
    }
    lag = next((lag for lag in _LAGS if wrong and _is_lagging_by(shares, levels, lag)), 0)
    if lag:
        many = "one image" if lag == 1 else f"{lag} images"
        return Check(
            "order",
            "bad",
            f"Every frame is {many} late: frame k shows pattern k - {lag}.",
            "Switch the camera's buffering off, or wait longer between showing and grabbing.",
            figures | {"lag": lag},
        )
    if wrong or misplaced:
        sentences = [s.sentence for s in misplaced] or [f"frame {wrong[0] + 1} shows the wrong level of light"]
        sentence = "; ".join(sentences[:3])
        return Check(
            "order",
            "bad",
            f"Of {n} coded frames, {sentence}.",
            "Check the cable and the load of the computer, wait longer between showing and grabbing, then check again.",
            figures,
        )
    if mixed:
        return Check(
            "order",
            "warning",
            f"Frame {mixed[0] + 1} of {n} still shows part of the pattern before it.",
            "Wait longer between showing and grabbing, or lock the camera to the projector.",
            figures,
        )
    if residuals.said:
        return Check("order", "unknown", f"The order could not be proved: {residuals.said}.", "", figures)
    return Check("order", "good", f"All {n} coded frames came in order.", "", figures)


def _is_lagging_by(shares: dict[int, float], levels: dict[int, int], lag: int) -> bool:
    """Whether every white or black frame shows the level of `lag` frames before, where that was one too."""
    pairs = [(shares[i], levels[i - lag]) for i in shares if i - lag in levels]
    return all(abs(share - on) < 0.3 for share, on in pairs)


def check_repeats(sequence: PatternSequence, stack: np.ndarray) -> Check:
    """The check of images identical to the one before although the pattern changed; a camera may be without noise."""
    changed = [k for k in range(1, len(stack)) if sequence.frames[k] != sequence.frames[k - 1]]
    same = [k for k in changed if np.array_equal(stack[k], stack[k - 1])]
    figures = {"detect_copies": [k + 1 for k in same], "frames": len(stack)}
    if same:
        listed = ", ".join(str(k + 1) for k in same[:5])
        return Check(
            "repeats",
            "bad",
            f"{len(same)} of {len(stack)} images of the burst are the one before once more (frame {listed}).",
            "The driver hands out old images: lower the frame rate, or update it; then check again.",
            figures,
        )
    return Check("repeats", "good", f"No image of {len(stack)} came twice.", "", figures)
