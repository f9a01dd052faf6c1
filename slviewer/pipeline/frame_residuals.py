"""What a capture says about itself: frames that were late, lost, out of order or lit otherwise."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_check import check_description
from slviewer.fringe.residual import FrameResiduals, frame_residuals
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.store import Session

_MOST = 4  # sentences about one capture


def residuals(sequence: PatternSequence, stack: np.ndarray) -> list[FrameResiduals]:
    """How the frames of each axis fit together; an axis that cannot be decoded alone is left out."""
    found = []
    for axis in sequence.axes:
        try:
            found.append(frame_residuals(sequence, stack, axis))
        except InputError:  # decoding says it, with what to do
            continue
    return found


def keep_residuals(session: Session, name: str) -> list[str]:
    """Look at a capture's frames, keep what is found as the result `trust/<name>`, and return what must be told."""
    capture = session.load_capture(name)
    frames = capture.frames
    found, contradictions = residuals(capture.sequence, frames), check_description(capture.sequence, frames)
    meta = {
        "inputs": session.input_hashes(name),
        "axes": described(found),
        "contradictions": [asdict(contradiction) for contradiction in contradictions],
    }
    session.save_result(f"trust/{name}", meta, {})
    return warnings_of(found, contradictions)


def told(session: Session, name: str, frames: np.ndarray) -> list[str]:
    """What must be told of a capture with these `frames`: as it was kept, else as it is found now."""
    result = f"trust/{name}"
    if session.state_of(result) != "fresh":
        return capture_warnings(session.load_capture(name).sequence, frames)
    meta = session.load_result(result)[0]
    messages = [contradiction["message"] for contradiction in meta.get("contradictions", ())]
    return _joined(messages, [suspect["sentence"] for axis in meta["axes"] for suspect in axis["suspects"]])


def capture_warnings(sequence: PatternSequence, stack: np.ndarray) -> list[str]:
    """What contradicts the description of a capture (n, h, w), and each frame that contradicts the others; nothing for
    a sound one.
    """
    return warnings_of(residuals(sequence, stack), check_description(sequence, stack))


def warnings_of(found: list[FrameResiduals], contradictions: Sequence[Contradiction] = ()) -> list[str]:
    """The same, from what `residuals` and `check_description` returned."""
    messages = [contradiction.message for contradiction in contradictions]
    return _joined(messages, [s.sentence for axis in found for s in axis.suspects])


def _joined(messages: list[str], sentences: list[str]) -> list[str]:
    """Contradictions of the description, then the frames that these do not speak of already."""
    return _shortened(messages + [s for s in sentences if not any(s in message for message in messages)])


def _shortened(sentences: list[str]) -> list[str]:
    sentences = list(dict.fromkeys(sentences))
    if len(sentences) > _MOST:
        more = len(sentences) - _MOST + 1
        sentences = [
            *sentences[: _MOST - 1],
            f"and {more} more frames do not fit: run the preflight, then capture again",
        ]
    return sentences


def described(found: list[FrameResiduals]) -> list[dict[str, Any]]:
    """Plain values to keep beside a capture: each frame's residual, and its relative light."""
    return [
        {
            "axis": axis.axis,
            "frames": [
                {"frame": f.frame, "rms": _plain(f.rms), "sigmas": _plain(f.sigmas), "light": _plain(f.light)}
                for f in axis.frames
            ],
            "suspects": [{"frame": s.frame, "fault": s.fault, "sentence": s.sentence} for s in axis.suspects],
            "said": axis.said,
        }
        for axis in found
    ]


def _plain(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
