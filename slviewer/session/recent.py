"""The sessions that were opened, the last first, in one file of the user's state folder; where new
ones are made, and where deleted ones go."""

from collections.abc import Iterator
from datetime import date
from itertools import chain, count
from pathlib import Path

import msgspec
import platformdirs

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.records.record import from_plain
from slviewer.session import atomic
from slviewer.session.layout import is_session, trash_place
from slviewer.session.reading import read_json
from slviewer.session.store import Session

MOST_RECENT = 8
TRASH = "slviewer-trash"
"""Folder beside a deleted session that it is moved to."""


def sessions_folder() -> Path:
    """Return the folder in which new sessions are made: slviewer in the user's documents."""
    return platformdirs.user_documents_path() / "slviewer"


def state_file() -> Path:
    """Return the file of the user's recent sessions."""
    return platformdirs.user_state_path("slviewer", appauthor=False) / "recent-sessions.json"


def unused_folder(folder: Path) -> Path:
    """Return ``folder``, or the first of folder-2, folder-3 ... where something has that name."""
    names = chain([folder.name], (f"{folder.name}-{n}" for n in count(2)))
    return next(path for name in names if not (path := folder.with_name(name)).exists())


def new_session_folder() -> Path:
    """Return an unused folder for a session, named after today."""
    return unused_folder(sessions_folder() / f"{date.today():%Y-%m-%d}")


class _Listed(msgspec.Struct):
    """The content of the file: folders of sessions, and of deleted ones (their folder, where they
    are now), the latest first."""

    sessions: list[str] = []
    deleted: list[tuple[str, str]] = []


class RecentSessions:
    """The sessions that were opened, and those that were deleted, the latest first.

    ``file`` None: they are remembered until the program ends. `fault`: why the file is not used,
    empty where it is.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._file, self._listed = file, _Listed()
        self.fault = ""

    def read(self) -> tuple[list[Path], Path | None]:
        """Return the folders of the sessions that still exist, at most `MOST_RECENT`, and of the
        session that was deleted last, None where none can be restored."""
        listed = self._read()
        deleted, _ = next(_restorable(listed), (None, None))
        return [*filter(is_session, map(Path, listed.sessions))][:MOST_RECENT], deleted

    def add(self, folder: Path) -> None:
        """Remember that a session was opened."""
        listed = self._read()
        others = [each for each in listed.sessions if each != str(folder)]
        listed.sessions = [str(folder), *others][: 4 * MOST_RECENT]
        self._write(listed)

    def trash(self, folder: Path) -> Path:
        """Move a session to the folder TRASH beside it; returns its place there. Raises
        SessionError where it is open for writing, here or elsewhere."""
        with Session.open(folder, write=True):
            pass
        place = trash_place(folder.parent / TRASH, folder.name)
        atomic.move(folder, place)
        listed = self._read()
        listed.deleted = [(str(folder), str(place)), *listed.deleted][:MOST_RECENT]
        self._write(listed)
        return place

    def restore(self) -> Path:
        """Bring the session that was deleted last back; returns its folder. Raises InputError
        without one, SessionError where its place is taken."""
        folder, place = next(_restorable(self._read()), (None, None))
        if folder is None or place is None:
            raise InputError("no deleted session can be restored")
        if folder.exists():
            raise SessionError(f"{folder} exists again", "move it away, then restore the session")
        atomic.move(place, folder)
        self.add(folder)
        return folder

    def _read(self) -> _Listed:
        """Return the content of the file: nothing where it is missing, or damaged, which is a
        fault."""
        if self._file is None:
            return self._listed
        self.fault = ""
        if self._file.exists():
            try:
                return from_plain(read_json(self._file, "it is written anew"), _Listed)
            except (DamagedError, InputError) as error:
                self.fault = f"The list of recent sessions, {self._file}, is ignored: {error}"
        return _Listed()

    def _write(self, listed: _Listed) -> None:
        """Save the list; where that is impossible, it is a fault."""
        self._listed = listed
        if self._file is not None:
            try:
                atomic.replace_file(self._file, atomic.to_json(msgspec.to_builtins(listed)))
            except SessionError as error:
                self.fault = f"The list of recent sessions, {self._file}, is not saved: {error}"


def _restorable(listed: _Listed) -> Iterator[tuple[Path, Path]]:
    """Yield (folder, place in the trash) of the deleted sessions that are still there."""
    for folder, place in listed.deleted:
        if is_session(place):
            yield Path(folder), Path(place)
