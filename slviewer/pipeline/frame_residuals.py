"""What a capture says about itself: frames that were late, lost, out of order or illuminated otherwise."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_check import check_description
from slviewer.fringe.residual import FrameResiduals, capture_residuals
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.store import Session

_MOST = 4  # warnings about one capture


def save_residuals(session: Session, name: str) -> list[str]:
    """Check a capture's frames, store the result as `trust/<name>`, and return the warnings for the operator."""
    capture = session.load_capture(name)
    frames = capture.frames
    found, contradictions = capture_residuals(capture.sequence, frames), check_description(capture.sequence, frames)
    meta = {"inputs": session.input_hashes(name), "axes": describe(found), "contradictions": contradictions}
    session.save_result(f"trust/{name}", meta, {})
    return warnings_of(found, contradictions)


def frame_warnings(session: Session, name: str, frames: np.ndarray) -> list[str]:
    """The warnings about a capture with these `frames`: as they were stored, else as they are computed now."""
    result = f"trust/{name}"
    if session.state_of(result) != "fresh":
        return capture_warnings(session.load_capture(name).sequence, frames)
    meta = session.load_result(result)[0]
    messages = [contradiction["message"] for contradiction in meta.get("contradictions", ())]
    return _join(messages, [suspect["sentence"] for axis in meta["axes"] for suspect in axis["suspects"]])


def capture_warnings(sequence: PatternSequence, stack: np.ndarray) -> list[str]:
    """What contradicts the description of a capture (n, h, w), and each frame that contradicts the others; nothing for
    a sound one.
    """
    return warnings_of(capture_residuals(sequence, stack), check_description(sequence, stack))


def warnings_of(found: list[FrameResiduals], contradictions: Sequence[Contradiction] = ()) -> list[str]:
    """The same, from what `capture_residuals` and `check_description` returned."""
    messages = [contradiction.message for contradiction in contradictions]
    return _join(messages, [s.sentence for axis in found for s in axis.suspects])


def _join(messages: list[str], sentences: list[str]) -> list[str]:
    """Contradictions of the description, then the frames that these do not name already; the first of many."""
    joined = messages + [s for s in sentences if not any(s in message for message in messages)]
    joined = list(dict.fromkeys(joined))
    if len(joined) <= _MOST:
        return joined
    more = len(joined) - _MOST + 1
    return [*joined[: _MOST - 1], f"and {more} more frames do not fit: run the preflight, then capture again"]


def describe(found: list[FrameResiduals]) -> list[dict[str, Any]]:
    """Plain values to store beside a capture: each frame's residual, and its relative light."""
    figures = ("frame", "rms", "sigmas", "light")
    return [
        {
            "axis": axis.axis,
            "frames": [{name: _plain(getattr(frame, name)) for name in figures} for frame in axis.frames],
            "suspects": [{"frame": s.frame, "fault": s.fault, "sentence": s.sentence} for s in axis.suspects],
            "said": axis.said,
        }
        for axis in found
    ]


def _plain(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
