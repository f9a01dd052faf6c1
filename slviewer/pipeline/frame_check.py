"""Whether the frames of a capture fit each other and their description: computed once, saved as
`trust/<name>`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_check import FrameReadings, check_description
from slviewer.fringe.residual import FrameResidual, FrameResiduals, capture_residuals
from slviewer.fringe.sequence import PatternSequence
from slviewer.fringe.suspect import Suspect
from slviewer.records.plain import from_plain, to_plain
from slviewer.session.capture import Capture
from slviewer.session.store import Session

VERSION = 2
"""Of the checks; results of another version are computed anew."""
MAX_WARNINGS = 4
"""About one capture."""


@dataclass(frozen=True)
class FrameCheck:
    """``axes``: how the frames of each axis fit together; ``contradictions`` of the description,
    the most probable first. Both report nothing for a sound capture."""

    axes: tuple[FrameResiduals, ...]
    contradictions: tuple[Contradiction, ...]

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Frames that contradict the others, of all axes."""
        return tuple(suspect for axis in self.axes for suspect in axis.suspects)

    def warnings(self) -> list[str]:
        """Contradictions of the description, then suspects that these do not name; at most
        ``MAX_WARNINGS``."""
        messages = [contradiction.message for contradiction in self.contradictions]
        sentences = [suspect.sentence for suspect in self.suspects]
        joined = list(
            dict.fromkeys(messages + [s for s in sentences if not any(s in m for m in messages)])
        )
        if len(joined) <= MAX_WARNINGS:
            return joined
        more = len(joined) - MAX_WARNINGS + 1
        return [
            *joined[: MAX_WARNINGS - 1],
            f"and {more} more frames do not fit: run the preflight, then capture again",
        ]

    def to_json(self) -> dict[str, Any]:
        """Plain values; residuals are rounded, those that are not known are None."""
        plain: dict[str, Any] = to_plain(self)
        for axis in plain["axes"]:
            for frame in axis["frames"]:
                frame |= {
                    key: round(frame[key], 4) if np.isfinite(frame[key]) else None
                    for key in _FIGURES
                }
        return plain

    @classmethod
    def from_json(cls, plain: Mapping[str, Any]) -> "FrameCheck":
        """The inverse of ``to_json``."""
        axes = [
            {
                **axis,
                "frames": [
                    {k: np.nan if v is None else v for k, v in f.items()} for f in axis["frames"]
                ],
            }
            for axis in plain["axes"]
        ]
        return from_plain({"axes": axes, "contradictions": plain["contradictions"]}, cls)


_FIGURES = tuple(name for name in FrameResidual.__annotations__ if name != "frame")


_NUMBERED = re.compile(
    r"\b((?:frame|image)s? )(\d+(?:(?:, | and )\d+)*)\b(?! is missing)", re.IGNORECASE
)


def name_frames(text: str, sequence: PatternSequence, files: Sequence[str]) -> str:
    """Return a message with the file after each number of a frame, counted from 1; unchanged where
    none are known.

    ``files``: one a frame of every exposure in turn.
    """
    count = len(sequence.frames)

    def name(number: re.Match[str]) -> str:
        """Return the number with the frame's files."""
        there = files[int(number[0]) - 1 :: count] if 0 < int(number[0]) <= count else ()
        return f"{number[0]} ({' and '.join(there)})" if there else number[0]

    return _NUMBERED.sub(lambda match: match[1] + re.sub(r"\d+", name, match[2]), text)


def check_frames(
    sequence: PatternSequence, stack: np.ndarray, files: Sequence[str] = ()
) -> FrameCheck:
    """Check the frames (n, h, w) of a capture; messages name their ``files``, see `name_frames`."""
    readings = FrameReadings(sequence, stack)
    axes = [
        replace(
            axis,
            suspects=tuple(
                replace(s, sentence=name_frames(s.sentence, sequence, files)) for s in axis.suspects
            ),
        )
        for axis in capture_residuals(sequence, stack, readings)
    ]
    return FrameCheck(tuple(axes), describe_contradictions(sequence, stack, files, readings))


def describe_contradictions(
    sequence: PatternSequence,
    stack: np.ndarray,
    files: Sequence[str],
    readings: FrameReadings | None = None,
) -> tuple[Contradiction, ...]:
    """Return what `check_description` does, in messages that name the ``files`` of the frames."""
    contradictions = check_description(sequence, stack, readings)
    return tuple(
        replace(c, message=name_frames(c.message, sequence, files)) for c in contradictions
    )


def save_check(session: Session, capture: Capture, frames: np.ndarray | None = None) -> FrameCheck:
    """Check a capture's ``frames`` (n, h, w), read here if None, and save the result in a writable
    session."""
    check = check_frames(
        capture.sequence, capture.frames if frames is None else frames, capture.files
    )
    if session.is_writable:
        meta = {"inputs": {capture.name: capture.hash}, "version": VERSION, **check.to_json()}
        session.save_result(f"trust/{capture.name}", meta, {})
    return check


def load_or_save_check(
    session: Session, capture: Capture, frames: np.ndarray | None = None
) -> FrameCheck:
    """The saved check of a capture, else a new one as ``save_check`` makes it."""
    return load_check(session, capture.name) or save_check(session, capture, frames)


def load_check(session: Session, name: str) -> FrameCheck | None:
    """The saved check of a capture; None where it is missing, of other frames or of another
    version."""
    return session.decode_fresh(
        f"trust/{name}",
        lambda meta, _: FrameCheck.from_json(meta) if meta.get("version") == VERSION else None,
    )
