"""Recorded captures as a rig: those of a session, or of a folder that can be imported, one after
another."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from slviewer.devices.protocols import Rig
from slviewer.devices.replay import Recording, recording_rig
from slviewer.errors import InputError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.feedback import ignore_warnings
from slviewer.pipeline.import_captures import check_imported_capture, find_captures
from slviewer.session.importers.imported import ImportableRecording
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user
from slviewer.session.store import Session

Shot = tuple[np.ndarray, PatternSequence]


class Reel:
    """A rig that replays recorded captures; it has only the `sequence` of the current one until it
    is wound on."""

    def __init__(self, shots: dict[str, Callable[[], Shot]]) -> None:
        """`shots` read the frames (n, h, w) and the sequence of one capture each, by name, in
        order."""
        self.names = list(shots)
        self._shots, self._at = shots, 0
        self._recording = Recording(*shots[self.names[0]]())
        self.rig: Rig = recording_rig(self._recording)

    @property
    def sequence(self) -> PatternSequence:
        """The patterns of the capture that is played."""
        return self._recording.played[1]

    @property
    def has_dark(self) -> bool:
        """Whether that capture holds a dark frame."""
        return any(frame.kind == "black" for frame in self.sequence.frames)

    def wind_on(self) -> None:
        """Play the next capture; the first after the last. Raises InputError where it is not of the
        same rig."""
        self._at = (self._at + 1) % len(self.names)
        if len(self.names) > 1:
            self._recording.play(*self._shots[self.names[self._at]]())


def reel(
    source: Path | str,
    capture: str | None = None,
    layout: str | None = None,
    sequence: Path | str | None = None,
    projector: str | None = None,
) -> Reel:
    """Read the captures in `source`, or the one of that name, for a replayed rig.

    `layout` is session or one of `layouts.layouts()`, by default what `source` looks like;
    `sequence` is the TOML of the layout frames, `projector` its size, such as "912x1140", where it
    is not the layout's own. Raises InputError, SessionError.
    """
    folder = expand_user(source)
    if layout == "session" or (layout is None and is_session(folder)):
        shots = _read_recorded(folder)
    else:
        shots = _read_imported(folder, layout, sequence, projector)
    if capture is not None and capture not in shots:
        raise InputError(
            f"there is no capture {capture!r} in {folder}: the captures are"
            f" {', '.join(shots) or 'none'}"
        )
    chosen = shots if capture is None else {capture: shots[capture]}
    if not chosen:
        raise InputError(f"{folder} holds no capture to play back: name a folder that does")
    return Reel(chosen)


def _read_recorded(folder: Path) -> dict[str, Callable[[], Shot]]:
    """Return {name: function that reads frames and sequence} of a session's captures."""
    with Session.open(folder) as store:
        captures = store.captures()
    return {capture.name: lambda shot=capture: (shot.frames, shot.sequence) for capture in captures}  # type: ignore[misc]


def _read_imported(
    folder: Path, layout: str | None, sequence: Path | str | None, projector: str | None
) -> dict[str, Callable[[], Shot]]:
    """Return {name: function that reads frames and sequence} of a folder of imported captures."""

    def read(recording: ImportableRecording) -> Shot:
        """Return the frames (n, h, w) and the sequence of a recording."""
        capture = check_imported_capture(recording.read(), ignore_warnings)
        return capture.frames, capture.sequence

    recordings = find_captures(folder, layout or "detect", sequence, projector=projector).recordings
    return {recording.name: partial(read, recording) for recording in recordings}
