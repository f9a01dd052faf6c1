"""What makes a folder a session: `session.json` with a schema that this program reads."""

import sys
from datetime import UTC, datetime
from pathlib import Path

from slviewer import __version__
from slviewer.errors import SessionError
from slviewer.session.atomic import disk_errors, replace_json
from slviewer.session.names import safe_path
from slviewer.session.reading import expand_user, read_json
from slviewer.session.result_types import RENAMED

_IS_WINDOWS = sys.platform == "win32"
_LONGEST_FOLDER = 120
"""Characters of a session's path under Windows, which leave the rest to the names of captures and
their frames."""
SCHEMA = 2
"""Of new sessions: 1, and since 2 frames and arrays have checksums, which programs that know only 1
do not read."""


def is_session(path: str | Path) -> bool:
    """Whether a session, readable or not, is in this folder."""
    return (_absolute_path(path) / "session.json").is_file()


def session_folder(path: str | Path) -> Path:
    """The absolute folder of an existing session; SessionError where it is missing, damaged or
    newer."""
    folder = _absolute_path(path)
    if not is_session(folder):
        raise SessionError(
            f"{folder} is not a session folder (it holds no session.json): give the folder of a"
            " session, or make one with `slviewer import` or `slviewer simulate`"
        )
    schema = read_json(folder / "session.json").get("schema")
    if not isinstance(schema, int) or schema < 1:
        raise SessionError(
            f"{folder / 'session.json'} names no schema: restore the file from a copy"
        )
    if schema > SCHEMA:
        raise SessionError(
            f"{folder} was made by a newer slviewer (schema {schema}; this one reads {SCHEMA}):"
            " update slviewer"
        )
    return folder


def locate_result(root: Path, name: str) -> Path:
    """Return the folder of a result under ``root``, also of one that an older version named
    otherwise.

    Raises InputError for an unsafe name.
    """
    folder = root / safe_path(name)
    former = next((root / old for old, today in RENAMED.items() if today == name), folder)
    return former if former.is_dir() and not folder.is_dir() else folder


def new_folder(path: str | Path, is_windows: bool = _IS_WINDOWS) -> tuple[Path, bool]:
    """A folder that a session may be made in, and whether it was made here, else empty;
    SessionError otherwise.

    ``is_windows``: paths are limited.
    """
    folder = _absolute_path(path)
    if is_windows and len(str(folder)) > _LONGEST_FOLDER:
        raise SessionError(
            f"the path of the session has {len(str(folder))} characters, and Windows allows 259 for"
            f" each file in it: choose a place with at most {_LONGEST_FOLDER}"
        )
    if is_session(folder):
        raise SessionError(f"{folder} is a session already: open it, or choose another folder")
    try:
        existed = folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        unknown = [entry.name for entry in folder.iterdir() if not _is_leftover(entry)]
    except OSError as error:
        raise SessionError(
            f"{folder} cannot be made ({error}): choose a folder that you may write to"
        ) from error
    if unknown:
        raise SessionError(
            f"{folder} holds other things ({unknown[0]}): choose a new or an empty folder for the"
            " session"
        )
    return folder, not existed


def create_layout(folder: Path) -> None:
    """Make a session of a folder from `new_folder`; it becomes one with its last file."""
    with disk_errors(folder):
        for inner in ("captures", "results"):
            (folder / inner).mkdir(exist_ok=True)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    replace_json(
        folder / "session.json",
        {"schema": SCHEMA, "created": created, "program": f"slviewer {__version__}"},
    )


def raise_schema(folder: Path) -> None:
    """State the newest schema in an older session, before anything is saved that needs it."""
    described = read_json(folder / "session.json")
    if described["schema"] < SCHEMA:
        replace_json(folder / "session.json", {**described, "schema": SCHEMA})


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


def _absolute_path(path: str | Path) -> Path:
    """Return an absolute path, with "~" expanded."""
    return expand_user(path).absolute()
