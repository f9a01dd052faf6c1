"""Recorded captures as a rig: those of a session, or of a folder that can be imported, one after
another."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer.devices.protocols import Rig
from slviewer.devices.replay import Recording, recording_rig
from slviewer.errors import InputError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.feedback import ignore_warnings
from slviewer.pipeline.import_captures import check_imported_capture, find_captures
from slviewer.session.capture import Capture
from slviewer.session.importers.imported import ImportableRecording
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user
from slviewer.session.store import Session

Recorded = Capture | ImportableRecording


class Reel:
    """A rig that replays recorded captures; it has only the `sequence` of the current one until it
    is wound on."""

    def __init__(self, recorded: Sequence[Recorded]) -> None:
        """Play these captures in order."""
        self.names = [each.name for each in recorded]
        self._recorded, self._at = recorded, 0
        self._recording = Recording(*_read_shot(recorded[0]))
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
            self._recording.play(*_read_shot(self._recorded[self._at]))


def _read_shot(recorded: Recorded) -> tuple[np.ndarray, PatternSequence]:
    """Read the frames (n, h, w) and the sequence of a recorded capture."""
    if isinstance(recorded, Capture):
        return recorded.frames, recorded.sequence
    imported = check_imported_capture(recorded.read(), ignore_warnings)
    return imported.frames, imported.sequence


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
    folder, recorded = expand_user(source), list[Recorded]()
    if layout == "session" or (layout is None and is_session(folder)):
        with Session.open(folder) as store:
            recorded += store.captures()
    else:
        layout = layout or "detect"
        recorded += find_captures(folder, layout, sequence, projector=projector).recordings
    names = [each.name for each in recorded]
    if capture is not None and capture not in names:
        raise InputError(
            f"there is no capture {capture!r} in {folder}: the captures are"
            f" {', '.join(names) or 'none'}"
        )
    if not recorded:
        raise InputError(f"{folder} holds no capture to play back: name a folder that does")
    return Reel([each for each in recorded if capture in (None, each.name)])
