"""Folders and files that are complete or absent, also after `kill -9` or with a full disk.

A folder is written as `.<name>.tmp-<pid>-<random>` next to its place, every file synced, then
renamed in. Where it replaces another it is first renamed to `.<name>.new-<pid>-<random>`: from then
on the replacement is decided, and `recover` finishes it if the program dies between moving the old
folder away and moving the new one in. A folder that waits for others to be renamed with it is
called `.<name>.done-<pid>-<random>`: it is complete, and `recover` renames it too. Folders that
replace others in one step are listed in a file `.together.new-<pid>-<random>`: once it exists, all
of these replacements are decided.
"""

import errno
import json
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from slviewer.errors import DamagedError, SessionError
from slviewer.records.record import to_plain
from slviewer.session.reading import decoding, read_json

_LEFTOVER = re.compile(r"\.(?P<name>.+)\.(?P<state>tmp|done|new)-\d+-[0-9a-f]+")
_TOGETHER = "together"
_SYNCS_FOLDERS = os.name != "nt"
_PATIENCE_S = 2.0 if os.name == "nt" else 0.0
_SPARE_BYTES = 1 << 20  # metadata, folders, the file system's own rounding


def sync_folder(folder: Path) -> None:
    """Sync a folder to disk, so that the names in it survive a power failure; Windows opens no
    folders for that."""
    if not _SYNCS_FOLDERS:
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename(source: Path, target: Path) -> None:
    """Rename a file over another one, or a folder to a name that is free.

    Windows refuses while another program has it open, such as a virus scanner, an indexer or a copy
    of the folder: it is tried again for some seconds.
    """
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            os.replace(source, target) if source.is_file() else os.rename(source, target)
            return
        except PermissionError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)


def write_bytes(path: Path, *parts: Any) -> None:
    """Write buffers one after another to a new file and sync it; its name is durable once its
    folder is synced."""
    with open(path, "xb") as file:
        for part in parts:
            file.write(part)
        file.flush()
        os.fsync(file.fileno())


def to_json(data: Any) -> bytes:
    """Encode as readable UTF-8 JSON; NaN stays NaN, as Python's own reader understands it."""
    return (json.dumps(data, indent=2, ensure_ascii=False, default=to_plain) + "\n").encode()


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file by a new one in one step. Raises SessionError where the disk refuses, or
    another program still has the old one open after some seconds; the old one then stays."""
    with _arriving(path, len(data)) as temporary:
        write_bytes(temporary, data)


@contextmanager
def arriving_file(path: Path, needs_bytes: int = 0) -> Iterator[BinaryIO]:
    """A file to write that takes the place of `path` in one step when the block ends, and leaves no
    trace if it fails.

    For what is too large to be one `bytes`. Raises SessionError if the disk has not `needs_bytes`
    to spare, or refuses; what stood there then stays.
    """
    with arriving_path(path, needs_bytes) as temporary, open(temporary, "xb") as file:
        yield file


@contextmanager
def arriving_path(path: Path, needs_bytes: int) -> Iterator[Path]:
    """As `arriving_file`, of a file that does not exist yet, for a library that creates it
    itself."""
    with _arriving(path, needs_bytes) as temporary:
        _require_space(path.parent, needs_bytes)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())


@contextmanager
def _arriving(path: Path, needs_bytes: int) -> Iterator[Path]:
    """Context manager: a path beside ``path`` for a file that is renamed to it at the end, and
    removed where that fails."""
    temporary = _staging_path(path, "tmp")
    with disk_errors(path.parent, needs_bytes):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            rename(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


@contextmanager
def staged_folder(target: Path, needs_bytes: int) -> Iterator[Path]:
    """A new empty folder next to `target` to write into; synced when the block ends, gone if it
    fails.

    The caller then hands it to `commit`. Raises SessionError if the disk has not `needs_bytes` to
    spare, or fills up or fails while the block writes.
    """
    with disk_errors(target.parent, needs_bytes):
        target.parent.mkdir(parents=True, exist_ok=True)
        _require_space(target.parent, needs_bytes)
        folder = _staging_path(target, "tmp")
        folder.mkdir()
        try:
            yield folder
            for inner, _, _ in os.walk(folder):
                sync_folder(Path(inner))
        except BaseException:
            discard(folder)
            raise


def mark_complete(folder: Path) -> Path:
    """Rename a staged folder so that `recover` keeps it if the program dies before `commit`;
    returns its new path."""
    match = _LEFTOVER.fullmatch(folder.name)
    assert match is not None, folder
    complete = _staging_path(folder.with_name(match["name"]), "done")
    with disk_errors(folder.parent):
        rename(folder, complete)
    return complete


def commit(folder: Path, target: Path, old_to: Path | None = None) -> None:
    """Rename a staged folder to `target`. An existing one is moved to `old_to`, or deleted where
    that is None."""
    with disk_errors(target.parent):
        if target.exists():
            decided = _staging_path(target, "new")
            rename(folder, decided)
            sync_folder(target.parent)
            _move_away(target, old_to)
            folder = decided
        rename(folder, target)
        sync_folder(target.parent)


class Together:
    """Folders under ``root`` that replace others in one step; `recover` finishes it if the program
    dies meanwhile."""

    def __init__(self, root: Path) -> None:
        self._root = root
        # target: (what replaces it, where it goes)
        self._changes: dict[Path, tuple[Path | None, Path | None]] = {}

    def replace(self, target: Path, folder: Path | None, old_to: Path | None = None) -> None:
        """Let a folder, staged or from the trash, or nothing become ``target``, whose present one
        goes to ``old_to`` or is deleted."""
        replaced, first_to = self._changes.get(target, (None, None))
        self._changes[target] = folder, first_to or old_to
        if replaced is not None:
            discard(replaced)

    def folder_for(self, target: Path) -> Path:
        """Return where the content of ``target`` is now: a path that does not exist where it is to
        go."""
        staged, _ = self._changes.get(target, (target, None))
        return target.with_name(f".{target.name}.absent") if staged is None else staged

    def discard(self) -> None:
        """Remove what was staged."""
        for staged, _ in self._changes.values():
            if staged is not None and _LEFTOVER.fullmatch(staged.name):
                discard(staged)

    def commit(self) -> None:
        """Make the changes. Raises SessionError where the disk refuses: nothing is changed then,
        and what was staged is removed; or, where it refuses half-way, the next opening of the
        session finishes it."""
        if not self._changes:
            return
        listed = [
            [
                None if path is None else path.relative_to(self._root).as_posix()
                for path in (target, staged, old_to)
            ]
            for target, (staged, old_to) in self._changes.items()
        ]
        temporary, decided = (
            _staging_path(self._root / _TOGETHER, state) for state in ("tmp", "new")
        )
        try:
            with disk_errors(self._root):
                write_bytes(temporary, to_json({"changes": listed}))
                rename(temporary, decided)
        except BaseException:
            discard(temporary)
            self.discard()
            raise
        _finish_together(decided)


def _finish_together(decided: Path) -> None:
    """Make the changes that a file of `Together` lists, those that were not made yet, and remove
    the file."""
    root = decided.parent
    with disk_errors(root):
        sync_folder(root)
        for target, staged, old_to in _read_changes(decided):
            is_waiting = staged is not None and staged.exists()
            if target.exists() and (is_waiting or staged is None):
                _move_away(target, old_to)
                sync_folder(target.parent)
            if staged is not None and is_waiting:
                rename(staged, target)
                sync_folder(target.parent)
        decided.unlink()
        sync_folder(root)


def _read_changes(decided: Path) -> list[tuple[Path, Path | None, Path | None]]:
    """The changes that a file of `Together` lists; DamagedError where it lists anything but paths
    in its folder, or a link leads one out of it.

    The file may have come with the session from somebody else, who would so delete any folder of
    this user.
    """
    root, changes = decided.parent, []
    with decoding(decided):
        for listed in read_json(decided)["changes"]:
            target, staged, old_to = (None if name is None else root / name for name in listed)
            for path in filter(None, (target, staged, old_to)):
                if ".." in path.parts or not path.parent.resolve().is_relative_to(root.resolve()):
                    raise ValueError(f"{path} is outside of {root}")
            if target is None:
                raise ValueError("a change without a target")
            changes.append((target, staged, old_to))
    return changes


def move(folder: Path, target: Path) -> None:
    """Rename a folder within the session and make that durable."""
    with disk_errors(target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
        rename(folder, target)
        sync_folder(target.parent)
        sync_folder(folder.parent)


def discard(folder: Path) -> None:
    """Remove a staged folder or file that will not be used."""
    if folder.is_dir():
        shutil.rmtree(folder, ignore_errors=True)
    else:
        folder.unlink(missing_ok=True)


def list_leftovers(root: Path) -> list[Path]:
    """Unfinished files and folders under `root`, of writers that died or are still writing."""
    unfinished = []
    for parent, folders, files in os.walk(root):
        unfinished += [
            Path(parent, name) for name in (*folders, *files) if _LEFTOVER.fullmatch(name)
        ]
        # neither into leftovers nor into stacks, which hold a folder a frame
        folders[:] = [
            name for name in folders if not _LEFTOVER.fullmatch(name) and not name.endswith(".zarr")
        ]
    return unfinished


def recover(root: Path, trash_place: Callable[[Path], Path]) -> list[Path]:
    """Finish what dead writers began: rename complete folders to their places, which are returned,
    and remove the rest.

    Call with the session's lock held, nothing writing. A replacement that was decided moves the old
    folder to `trash_place(target)`; a complete folder whose place is taken is itself moved there.
    Raises SessionError where the disk refuses.
    """
    completed = []
    for path in list_leftovers(root):
        if path.parent == root and path.name.startswith(f".{_TOGETHER}.new-"):
            with suppress(DamagedError):
                _finish_together(path)
            discard(path)
    for path in list_leftovers(root):
        match = _LEFTOVER.fullmatch(path.name)
        if not match or match["state"] == "tmp":
            discard(path)
            continue
        target = path.with_name(match["name"])
        with disk_errors(target.parent):
            if target.exists() and match["state"] == "done":
                move(path, trash_place(target))
                continue
            if target.exists():
                move(target, trash_place(target))
            rename(path, target)
            sync_folder(target.parent)
        completed.append(target)
    return completed


def _move_away(target: Path, old_to: Path | None) -> None:
    """Move a folder to ``old_to``, or delete it where that is None."""
    if old_to is not None:
        move(target, old_to)
        return
    to_delete = _staging_path(target, "tmp")
    rename(target, to_delete)
    discard(to_delete)


def _staging_path(target: Path, state: str) -> Path:
    """Return a unique hidden path next to the target, for a state such as "tmp"."""
    return target.with_name(f".{target.name}.{state}-{os.getpid()}-{secrets.token_hex(4)}")


def _require_space(folder: Path, needs_bytes: int) -> None:
    """Raise SessionError unless the disk has ``needs_bytes`` and a reserve free."""
    if shutil.disk_usage(folder).free < needs_bytes + _SPARE_BYTES:
        raise _disk_full_error(folder, needs_bytes)


def _disk_full_error(folder: Path, needs_bytes: int) -> SessionError:
    """Return the error for a full disk, with the needed and the free space in words."""
    folder = next(each for each in (folder, *folder.parents) if each.exists())
    free = shutil.disk_usage(folder).free
    needs = (
        f"needs {format_bytes(needs_bytes)} and {format_bytes(_SPARE_BYTES)} to spare, "
        if needs_bytes
        else ""
    )
    return SessionError(
        f"the disk is full: the save {needs}{format_bytes(free)} are free on {folder}",
        "free some space or choose another folder",
    )


def format_bytes(count: int) -> str:
    """Format a number of bytes with its unit: `3.4 MB`."""
    size = float(count)
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "bytes" or size >= 100 else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


@contextmanager
def disk_errors(folder: Path, needs_bytes: int = 0) -> Iterator[None]:
    """Context manager: raise errors of the disk as SessionError; ``needs_bytes`` of a save that it
    refuses."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _disk_full_error(folder, needs_bytes) from error
        raise SessionError(
            f"{folder} cannot be written ({error})", "check its permissions and the disk"
        ) from error
