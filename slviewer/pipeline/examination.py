"""Examination of a capture's frames, computed once and saved as `trust/<name>`."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slviewer.examination.examine import examine
from slviewer.examination.light import Look
from slviewer.fringe.sequence import PatternSequence
from slviewer.records.plain import from_plain, to_plain
from slviewer.records.verdict import Examination
from slviewer.session.capture import Capture
from slviewer.session.store import Session

VERSION = 8
"""Of the examination; results of another version are computed anew."""
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


def examine_frames(
    sequence: PatternSequence,
    stack: np.ndarray,
    files: Sequence[str] = (),
    look: Look | None = None,
) -> Examination:
    """Examine the frames (n, h, w) of a capture; findings name their ``files``, see
    `name_frames`. ``look`` at the frames: taken if None."""
    examination = examine(sequence, stack, look)
    named = [
        replace(finding, sentence=name_frames(finding.sentence, sequence, files))
        for finding in examination.findings
    ]
    return Examination(tuple(named), examination.light_rms)


def load_or_save_examination(
    session: Session, capture: Capture, look: Look | None = None
) -> Examination:
    """Return the saved examination of a capture; without one, examine its frames by a ``look`` at
    them, taken here if None, and save the result in a writable session."""
    if (saved := load_examination(session, capture.name)) is not None:
        return saved
    stack = look.stack if look else capture.frames
    examination = examine_frames(capture.sequence, stack, capture.files, look)
    if session.is_writable:
        meta = {
            "inputs": {capture.name: capture.hash},
            "version": VERSION,
            "examination": to_plain(examination),
        }
        session.save_result(f"trust/{capture.name}", meta, {})
    return examination


def load_examination(session: Session, name: str) -> Examination | None:
    """Return the saved examination of a capture; None where it is missing, of other frames or of
    another version."""
    return session.decode_fresh(
        f"trust/{name}",
        lambda meta, _: (
            from_plain(meta["examination"], Examination) if meta.get("version") == VERSION else None
        ),
    )
