"""What makes a folder a session: `session.json` with a schema that this program reads; its trash,
and the exclusive lock of its one writer."""

import contextlib
import json
import os
import socket
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from slviewer import __version__
from slviewer.errors import DamagedError, SessionError
from slviewer.session.atomic import disk_errors, replace_file, to_json
from slviewer.session.reading import expand_user, read_json

_IS_WINDOWS = sys.platform == "win32"
_LONGEST_FOLDER = 120
"""Characters of a session's path under Windows, which leave the rest to the names of captures and
their frames."""
SCHEMA = 2
"""Of new sessions: 1, and since 2 frames and arrays have checksums, which programs that know only 1
do not read."""


def is_session(path: str | Path) -> bool:
    """Whether a session, readable or not, is in this folder."""
    return (expand_user(path) / "session.json").is_file()


def session_folder(path: str | Path) -> Path:
    """The absolute folder of an existing session; SessionError where it is missing, damaged or
    newer."""
    folder = expand_user(path).absolute()
    if not is_session(folder):
        raise SessionError(
            f"{folder} is not a session folder (it holds no session.json)",
            "give the folder of a session, or make one with `slviewer import` or `slviewer"
            " simulate`",
        )
    schema = read_json(folder / "session.json").get("schema")
    if not isinstance(schema, int) or schema < 1:
        raise SessionError(
            f"{folder / 'session.json'} names no schema", "restore the file from a copy"
        )
    if schema > SCHEMA:
        raise SessionError(
            f"{folder} was made by a newer slviewer (schema {schema}; this one reads {SCHEMA})",
            "update slviewer",
        )
    return folder


def new_folder(path: str | Path) -> tuple[Path, bool]:
    """A folder that a session may be made in, and whether it was made here, else empty;
    SessionError otherwise."""
    folder = expand_user(path).absolute()
    if _IS_WINDOWS and len(str(folder)) > _LONGEST_FOLDER:
        raise SessionError(
            f"the path of the session has {len(str(folder))} characters, and Windows allows 259 for"
            " each file in it",
            f"choose a place with at most {_LONGEST_FOLDER}",
        )
    if is_session(folder):
        raise SessionError(f"{folder} is a session already", "open it, or choose another folder")
    try:
        existed = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        unknown = [entry.name for entry in folder.iterdir() if not _is_leftover(entry)]
    except OSError as error:
        raise SessionError(
            f"{folder} cannot be made ({error})", "choose a folder that you may write to"
        ) from error
    if unknown:
        raise SessionError(
            f"{folder} holds other things ({unknown[0]})",
            "choose a new or an empty folder for the session",
        )
    return folder, not existed


def create_layout(folder: Path) -> None:
    """Make a session of a folder from `new_folder`; it becomes one with its last file."""
    with disk_errors(folder):
        for inner in ("captures", "results"):
            (folder / inner).mkdir(exist_ok=True)
    described = {"schema": SCHEMA, "created": time_now(), "program": f"slviewer {__version__}"}
    replace_file(folder / "session.json", to_json(described))


def time_now() -> str:
    """Return the time in UTC, as the files of a session state it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def raise_schema(folder: Path) -> None:
    """State the newest schema in an older session, before anything is saved that needs it."""
    described = read_json(folder / "session.json")
    if described["schema"] < SCHEMA:
        replace_file(folder / "session.json", to_json({**described, "schema": SCHEMA}))


def remove_layout(folder: Path) -> bool:
    """Remove what `create_layout` made, and decisions; returns False, and removes nothing, where
    more was saved.

    Call with the session's lock held: its files stay.
    """
    own = ("captures", "results", "exports", "trash")
    inner = [folder / name for name in own if (folder / name).is_dir()]
    files = {"session.json", "decisions.json", ".lock", ".lock-holder"}
    if any(entry not in inner and entry.name not in files for entry in folder.iterdir()):
        return False
    if any(any(each.iterdir()) for each in inner):
        return False
    for each in inner:
        each.rmdir()
    for name in ("decisions.json", "session.json"):
        (folder / name).unlink(missing_ok=True)
    return True


def inner_folders(folder: Path) -> list[str]:
    """Names of the folders in a folder, without hidden ones, in no order; none where it is
    missing."""
    if not folder.is_dir():
        return []
    return [
        entry.name
        for entry in folder.iterdir()
        if entry.is_dir() and not entry.name.startswith(".")
    ]


def _is_leftover(entry: Path) -> bool:
    """Whether this may be a leftover of an interrupted creation of a session, or a file of
    macOS."""
    if entry.name in ("captures", "results"):
        return entry.is_dir() and not any(entry.iterdir())
    return entry.name in (".lock", ".lock-holder", ".DS_Store") or entry.name.startswith(
        ".session.json.tmp-"
    )


_TIME = "%Y%m%dT%H%M%S%f"


@dataclass(frozen=True)
class Trashed:
    """A capture or result in the trash: its name, when it was deleted, and its folder there."""

    name: str
    is_capture: bool
    time: datetime
    place: Path


def trash_place(trash: Path, name: str) -> Path:
    """Return a new path in the trash for a capture or result of that name."""
    return trash / f"{name}-{datetime.now(UTC).strftime(_TIME)}"


def list_trash(trash: Path) -> list[Trashed]:
    """Return what is in the trash and complete, the last deleted first."""
    entries = []
    for place in trash.glob("*-*"):
        name, _, when = place.name.rpartition("-")
        is_capture = (place / "capture.json").is_file()
        with contextlib.suppress(ValueError):
            time = datetime.strptime(when, _TIME).replace(tzinfo=UTC)
            if is_capture or (place / "meta.json").is_file():
                entries.append(
                    Trashed(
                        name if is_capture else name.replace("-", "/", 1), is_capture, time, place
                    )
                )
    return sorted(entries, key=lambda each: each.time, reverse=True)


_PATIENCE_S = (
    0.3  # outlasts a reader that holds the lock for the moment it needs to clear leftovers
)


class WriterLock:
    """The session's lock, released by the system if its holder dies."""

    def __init__(self, folder: Path):
        self._folder = folder
        # closed by another thread than opened it
        self._lock = FileLock(folder / ".lock", thread_local=False)
        self._holder = folder / ".lock-holder"

    def acquire(self, patience_s: float = _PATIENCE_S) -> None:
        """Take the lock or raise a SessionError that names the process that holds it."""
        try:
            self._lock.acquire(timeout=patience_s, poll_interval=0.02)
        except Timeout as error:
            raise SessionError(
                f"{self._folder} is open for writing in {self._who()}",
                "close it there, or wait until it has finished",
            ) from error
        except OSError as error:
            raise SessionError(
                f"{self._folder} cannot be written ({error})", "check its permissions"
            ) from error
        with contextlib.suppress(OSError):  # it is only for the message to others
            self._holder.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))

    def release(self, remove: bool = False) -> None:
        """Release the lock for the next writer, and remove its file where the folder is a session
        no more: a writer that waits for it then begins with a new one."""
        if self._lock.is_locked:
            with contextlib.suppress(OSError):  # Windows removes no open file: an empty one stays
                self._holder.unlink(missing_ok=True)
                if remove:
                    Path(self._lock.lock_file).unlink()
            self._lock.release()

    @property
    def held(self) -> bool:
        """Whether this object holds the lock."""
        return self._lock.is_locked

    def _who(self) -> str:
        """Describe the process that holds the lock."""
        try:
            holder = read_json(self._holder)
            return f"process {holder['pid']} on {holder['host']}"
        except (DamagedError, KeyError):
            return "another process"
