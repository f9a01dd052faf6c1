"""What the program finds in a capture, and what it decodes: all that the proof of captures uses of
it."""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture_phases import check_capture, decode_frames
from slviewer.pipeline.examination import examine_frames
from slviewer.pipeline.exposure_check import check_capture_exposure

Severity = Literal["bad", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("bad", "warning", "note")
_SEVERITIES: dict[str, Severity] = {"rejected": "bad", "doubtful": "warning", "note": "note"}
_REFUSALS = (
    (r"are saturated", "saturation"),
    (r"light from other surfaces", "indirect-light"),
    (r"outside the projector", "projector-size"),
    (r"which the projector spans", "fringe-period|projector-size"),
    (r"which a Gray cell spans", "gray-cell|fringe-period"),
    (r"Gray bits number", "fringe-period|gray-cell|projector-size"),
    (r"modulation is", "dark"),
    (r"rows and between the frames", "flicker"),
    (r"light of the room", "room-light"),
    (r"brightness varies", "exposure-drift"),
)
"""Causes that messages of refusals state in words."""


@dataclass(frozen=True)
class Named:
    """A finding: its cause, or the causes between which it leaves the choice, joined by "|"; the
    frames that it names (from 0, none for all); and its severity."""

    cause: str
    frames: tuple[int, ...]
    severity: Severity
    message: str = ""


def examine(sequence: PatternSequence, stack: np.ndarray) -> list[Named]:
    """What the program finds in a capture (n, h, w): the worst first, else in its own order."""
    examination = examine_frames(sequence, stack)
    found = [
        Named(f.cause, f.frames, _SEVERITIES[f.severity], f.sentence) for f in examination.findings
    ]
    if examination.rejected:
        return found
    try:
        phases = decode_frames("capture", sequence, stack)
        check_capture("capture", sequence, stack, phases, examination)
    except InputError as error:
        return [_name_refusal(error), *found]
    exposure = check_capture_exposure(sequence, stack, phases)
    if exposure.verdict in ("bad", "warning"):
        cause = "saturation" if "saturated." in exposure.sentence else "dark"
        severity: Severity = "bad" if exposure.verdict == "bad" else "warning"
        found.append(Named(cause, (), severity, exposure.sentence))
    return sorted(found, key=lambda named: SEVERITIES.index(named.severity))


def decode_coordinates(sequence: PatternSequence, stack: np.ndarray) -> dict[Axis, np.ndarray]:
    """The decoded coordinate (h, w) px of each axis, NaN where masked; empty where it is
    refused."""
    try:
        phases = decode_frames("capture", sequence, stack)
    except InputError:
        return {}
    return {axis: phase.coordinate for axis, phase in phases.items()}


def _name_refusal(error: InputError) -> Named:
    """The finding of a capture that is refused; "unreadable" where the message names no cause."""
    text = str(error)
    cause = next((cause for words, cause in _REFUSALS if re.search(words, text)), "unreadable")
    return Named(cause, (), "bad", text)
