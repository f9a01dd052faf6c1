"""A session: the folder that holds captures, results and decisions, and the only access to it."""

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, get_args

import numpy as np

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.fringe.sequence import PatternSequence
from slviewer.session import atomic, layout
from slviewer.session.capture import (
    Capture,
    Comparison,
    NewCapture,
    Role,
    compare_stored,
    read_capture,
    write_capture,
)
from slviewer.session.decisions import Decisions
from slviewer.session.layout import Trashed, WriterLock, list_trash, trash_place
from slviewer.session.names import is_safe_name, natural_key, new_name, safe_name, safe_path
from slviewer.session.reading import decoding
from slviewer.session.results import (
    check_place,
    check_result,
    list_results,
    locate_result,
    read_arrays,
    read_meta,
    write_result,
)

_MAX_INPUTS_CHAIN = 32

T = TypeVar("T")
State = Literal["absent", "fresh", "stale"]


class Session(Decisions):
    """An open session folder. Use `Session.create`, `Session.open` or `Session.open_or_create`, in
    a `with` block.

    Readers need no lock and may be many; one writer at a time holds the folder. Saving from several
    threads of the writer is safe.
    """

    def __init__(self, folder: Path, lock: WriterLock | None):
        super().__init__(folder)
        self._lock = lock
        self._allow: Callable[[], None] | None = None
        self._created: Literal["", "session", "folder"] = ""  # what this object made
        self._together: atomic.Together | None = None
        self._kept: dict[str, Path | None] | None = None  # of `keep_replaced`
        self._kinds: tuple[str, ...] = ()
        self.recovered: tuple[str, ...] = ()  # captures of a dead writer, completed on opening

    # opening and closing

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """A new session, open for writing, in a new or empty folder; SessionError where something
        is there already."""
        folder, is_new_folder = layout.new_folder(path)
        lock = WriterLock(folder)
        lock.acquire()
        try:
            layout.new_folder(path)  # another process may have made one before the lock was taken
            layout.create_layout(folder)
        except BaseException:
            lock.release()
            raise
        session = cls(folder, lock)
        session._created = "folder" if is_new_folder else "session"
        return session

    @classmethod
    def open(cls, path: str | Path, write: bool = False) -> Self:
        """Open an existing session, for reading, or for writing by this process alone. Raises
        SessionError where there is no session, where it is damaged or of a newer schema, or where
        another process is writing to it."""
        folder = layout.session_folder(path)
        session = cls(folder, WriterLock(folder) if write else None)
        try:
            if session._lock is not None:
                session._lock.acquire()
                # its creator may have removed it before the lock was taken
                layout.session_folder(path)
            session._recover()
        except BaseException:
            session.close()
            raise
        return session

    @classmethod
    def open_or_create(cls, path: str | Path) -> Self:
        """The session in a folder, open for writing; made where the folder is missing or empty."""
        before = ""
        for _ in range(5):  # attempts: another process may create or remove it meanwhile
            try:
                return cls.open(path, write=True) if layout.is_session(path) else cls.create(path)
            except SessionError as error:
                if str(error) == before:
                    raise
                before = str(error)
        return cls.create(path)

    def remove_if_new(self) -> None:
        """Close a session that this object created, and remove it, unless something was saved in
        it."""
        if not self._created or self._lock is None or not self._lock.held:
            return
        with contextlib.suppress(OSError):  # what cannot be removed stays
            if layout.remove_layout(self.folder):
                self._lock.release(remove=True)
                if self._created == "folder":
                    self.folder.rmdir()

    def close(self) -> None:
        """Let the next writer in. Does nothing for a reader or when called again."""
        if self._lock is not None:
            self._lock.release()

    def guarded(self, allow: Callable[[], None]) -> Self:
        """This session for one piece of work: `allow` is called before each save takes effect; it
        may raise to stop it.

        So work that was given up can run on without ever changing the folder. Closing it closes
        this session too.
        """
        view = type(self)(self.folder, self._lock)
        view._decisions_lock = self._decisions_lock
        view._allow = allow
        return view

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # captures

    def capture_names(self, role: Role | None = None) -> list[str]:
        """Names of the captures (of one role, as far as they can be read), `pose_2` before
        `pose_10`."""
        if role is not None:
            return [capture.name for capture in self.captures(role)]
        return [
            name
            for name in self.taken_names()
            if is_safe_name(name) and self._has_description(name)
        ]

    def taken_names(self) -> list[str]:
        """Names that a new capture cannot have: of the captures, and of other folders in their
        place."""
        return sorted(layout.inner_folders(self.folder / "captures"), key=natural_key)

    def captures(self, role: Role | None = None, *, with_frames: bool = False) -> list[Capture]:
        """The captures (of one role) in the order of `capture_names`, without damaged ones; frames
        stay on disk. ``with_frames``: without imported clouds."""
        return [
            each
            for each in self.read_captures()[0]
            if role in (None, each.role) and not (with_frames and each.is_imported_cloud)
        ]

    def read_captures(self) -> tuple[list[Capture], dict[str, str]]:
        """The captures, and of every other folder in their place {name: what is wrong with it, and
        the remedy}."""
        captures, faults = [], {}
        for name in self.taken_names():
            folder = self.folder / "captures" / name
            if not is_safe_name(name):
                faults[name] = (
                    f"{folder} is not read: rename it, with letters, digits, '_', '-' and '.', or"
                    " move it away"
                )
            elif not self._has_description(name):
                faults[name] = (
                    f"{folder} is not a capture (it holds no capture.json): restore the file, or"
                    " move it away"
                )
            else:
                try:
                    captures.append(read_capture(folder))
                except SessionError as error:
                    faults[name] = str(error)
        return captures, faults

    def compare_capture(self, new: NewCapture, role: Role) -> Comparison:
        """How the capture of the name of `new`, checked, compares with it."""
        return compare_stored(self._capture_folder(new.name), new, role)

    def load_capture(self, name: str) -> Capture:
        """A capture; its frames stay on disk until they are read. InputError where it does not
        exist."""
        folder = self._capture_folder(name)
        if not folder.is_dir():
            there = ", ".join(self.capture_names()) or "none"
            raise InputError(
                f"there is no capture {name!r} in {self.folder}: the captures are {there}"
            )
        return read_capture(folder)

    def save_capture(
        self,
        name: str,
        role: Role,
        sequence: PatternSequence,
        frames: np.ndarray,
        *,
        board: object | None = None,
        force: bool = False,
        **details: Any,
    ) -> Capture:
        """Save frames (n, h, w), uint8 or uint16, in the order of the sequence. ``details``: as of
        `NewCapture`.

        Of two or more `exposures_ms`, the frames are (k n, h, w): the whole sequence in the first,
        then in the second.

        Complete on disk when this returns; absent if it raises: InputError for a name that is in
        use (unless `force`, which moves the old capture to the trash) or frames that do not fit,
        SessionError where the disk refuses.
        """
        return self.save_captures(
            [NewCapture(name, sequence, frames, **details)], role, board=board, force=force
        )[0]

    def save_captures(
        self,
        captures: Iterable[NewCapture],
        role: Role,
        *,
        board: object | None = None,
        force: bool | Collection[str] = False,
    ) -> list[Capture]:
        """Save all of `captures` or, where any of them fails (or the iterable raises), none.

        Takes them one at a time, so that a generator needs memory for one; returns them in that
        order. `force`: whether those of the same name are replaced, or the names of those that are.
        If the program dies, the next one to open the session completes those that were written.
        """
        self._require_writer()
        layout.raise_schema(self.folder)
        staged: dict[str, Path] = {}
        taken = self.taken_names()
        try:
            for new in captures:
                if new.name in staged:
                    raise InputError(
                        f"two captures are named {new.name!r}", "rename one of their folders"
                    )
                new_name(new.name, (*taken, *staged))
                target = self._capture_folder(new.name)
                replaces = force if isinstance(force, bool) else new.name in force
                if target.exists() and not replaces:
                    raise InputError(
                        f"there is a capture {new.name!r} already",
                        "choose another name, or replace it with --force",
                    )
                if role not in get_args(Role):
                    raise InputError(f"role {role!r} is unknown", "use 'calibration' or 'scan'")
                new.check()
                with atomic.staged_folder(target, new.nbytes) as written:
                    write_capture(written, new, role, None if board is None else str(board))
                staged[new.name] = atomic.mark_complete(written)
                del new  # before the next one is made
        except BaseException:
            for folder in staged.values():
                atomic.discard(folder)
            raise
        for name, folder in staged.items():
            target = self._capture_folder(name)
            atomic.commit(folder, target, self._trash_place(target))
        return [self.load_capture(name) for name in staged]

    def trashed(self) -> list[Trashed]:
        """Return what is in the trash and complete, the last deleted first."""
        return list_trash(self.folder / "trash")

    def _place_of(self, name: str) -> Path:
        """Return the folder of a capture or result."""
        if "/" not in name:
            return self._capture_folder(name)
        return locate_result(self.folder / "results", name)

    def exchange(self, contents: Mapping[str, Path | None]) -> dict[str, Path | None]:
        """Replace captures and results {name: its place in the trash, or None to remove it} in one
        step.

        Returns the same of what they replaced, which exchanges them back. InputError where one is
        no longer there.
        """
        self._require_writer()
        changes, replaced = atomic.Together(self.folder), dict[str, Path | None]()
        for name, place in contents.items():
            target = self._place_of(name)
            if not (place or target).is_dir():
                where = "in the session" if place is None else "in its trash"
                raise InputError(f"{name} is no longer {where}")
            target.parent.mkdir(parents=True, exist_ok=True)
            replaced[name] = self._trash_place(target) if target.exists() else None
            changes.replace(target, place, replaced[name])
        changes.commit()
        return replaced

    @contextmanager
    def keep_replaced(self, *kinds: str) -> Iterator[dict[str, Path | None]]:
        """Context manager: results of these kinds that are replaced in it go to the trash. Gives
        what `exchange` reverses it with, complete at its end. For one thread."""
        kept = self._kept = dict[str, Path | None]()
        self._kinds = kinds
        try:
            yield kept
        finally:
            self._kept = None

    def _keep(self, name: str) -> Path | None:
        """Return where in the trash the result goes that is replaced; None: it is deleted."""
        if self._kept is None or name in self._kept or name.partition("/")[0] not in self._kinds:
            return None
        target = self._place_of(name)
        place = self._kept[name] = self._trash_place(target) if target.exists() else None
        return place

    def restore_last(self, name: str) -> None:
        """Bring the last deleted capture or result of that name back. InputError without one, or
        where it is in use."""
        found = next((each for each in self.trashed() if each.name == name), None)
        if found is None:
            raise InputError(
                f"there is no deleted {'result' if '/' in name else 'capture'} {name!r}"
            )
        if self._place_of(name).exists():
            raise InputError(f"there is a {name!r} again", "delete that one first")
        self.exchange({name: found.place})

    # results

    @contextmanager
    def together(self) -> Iterator[None]:
        """Context manager: results that are saved or moved to the trash in it change in one step,
        at its end.

        Where it raises, or the program dies or the disk refuses before the end, all stay as they
        were. Within it this session already reads the new ones. For one thread.
        """
        if self._together is not None:  # part of a larger step
            yield
            return
        self._require_writer()
        changes = self._together = atomic.Together(self.folder)
        try:
            yield
            self._require_writer()
        except BaseException:
            changes.discard()
            if self._kept is not None:
                self._kept.clear()
            raise
        finally:
            self._together = None
        changes.commit()

    def _result_folder(self, name: str) -> Path:
        """Return the folder of a result, where `together` has staged it; InputError for an unsafe
        name."""
        target = locate_result(self.folder / "results", name)
        return target if self._together is None else self._together.folder_for(target)

    def result_names(self) -> list[str]:
        """Names of the results, such as `calibration/stereo`, sorted."""
        return sorted(list_results(self.folder / "results"), key=natural_key)

    def has_result(self, name: str) -> bool:
        """Whether there is a result of that name, fresh or stale: `state_of` reads all that it was
        made from."""
        return (self._result_folder(name) / "meta.json").is_file()

    def save_result(
        self, name: str, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
    ) -> None:
        """Save a result; it replaces one of that name in one step, which stays if this fails.

        `meta["inputs"]` = {capture or result: its hash} is what `state_of` goes by; `input_hashes`
        gives it.
        """
        self._require_writer()
        target = self.folder / "results" / safe_path(name)
        check_place(self.folder / "results", name)
        checked = check_result(meta, arrays)
        size = sum(array.nbytes for array in checked.values())
        with atomic.staged_folder(target, size) as staged:
            write_result(staged, meta, checked)
            self._require_writer()
        old_to = self._keep(name)
        if self._together is None:
            atomic.commit(staged, target, old_to)
        else:
            self._together.replace(target, staged, old_to)

    def load_meta(self, name: str) -> dict[str, Any]:
        """The `meta` of a result, without its arrays; raises as `load_result`."""
        return self.load_result(name, only=())[0]

    def load_result(
        self, name: str, only: Collection[str] | None = None
    ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """`meta` as saved with its content `hash`, and the arrays (those named in `only`). Raises
        InputError where there is no such result, SessionError where it is damaged."""
        folder = self._result_folder(name)
        if not (folder / "meta.json").is_file():
            there = ", ".join(self.result_names()) or "none"
            raise InputError(
                f"there is no result {name!r} in {self.folder}: the results are {there}"
            )
        return (meta := read_meta(folder)), read_arrays(folder, meta, only)

    def decode_result(
        self,
        name: str,
        decode: Callable[[dict[str, Any], dict[str, np.ndarray]], T],
        only: Collection[str] | None = None,
    ) -> T:
        """Return what ``decode(meta, arrays)`` makes of a result.

        Raises as `load_result`, and DamagedError where ``decode`` meets a value that it does not
        expect.
        """
        meta, arrays = self.load_result(name, only)
        with decoding(self._result_folder(name)):
            return decode(meta, arrays)

    def trash_result(self, name: str) -> Path:
        """Move a result to the trash folder; returns its place there."""
        self._require_writer()
        self.load_result(name, only=())
        folder = self.folder / "results" / name
        target = self._keep(name) or self._trash_place(folder)
        if self._together is None:
            atomic.move(folder, target)
        else:
            self._together.replace(folder, None, target)
        return target

    def deleted_results(self) -> list[str]:
        """Names of the results in the trash, the last deleted first."""
        return list(dict.fromkeys(each.name for each in self.trashed() if not each.is_capture))

    def input_hashes(self, *names: str) -> dict[str, str]:
        """Return {name: content hash} of captures and results, for `meta["inputs"]`. Raises
        InputError where absent."""
        hashes = {}
        for name in names:
            content_hashes = self._hashes(name)
            if not content_hashes:
                raise InputError(f"there is no capture or result {name!r} in {self.folder}")
            hashes[name] = content_hashes[0]
        return hashes

    def state_of(self, name: str) -> State:
        """Return `fresh`, `stale` or `absent`; fresh if every input of the result is fresh and has
        the hash it had.

        An absent input has the hash "", a damaged one makes it stale, as do inputs in a circle.
        Raises DamagedError.
        """
        return self._state_of(name, {}, 0)

    def _state_of(self, name: str, known: dict[str, State], depth: int) -> State:
        """Return the state of a result ``depth`` inputs away; ``known``: states of those that were
        met before."""
        folder = self._result_folder(name)
        if name in known or not (folder / "meta.json").is_file():
            return known.get(name, "absent")
        inputs = read_meta(folder).get("inputs", {})
        known[name] = "stale"  # while it is examined, or if that fails
        with contextlib.suppress(DamagedError, InputError):
            for other, used in inputs.items():
                changed = used not in (self._hashes(other) or [""]) or depth == _MAX_INPUTS_CHAIN
                if changed or (
                    other != name and self._state_of(other, known, depth + 1) == "stale"
                ):
                    return "stale"
            known[name] = "fresh"
        return known[name]

    def decode_fresh(
        self,
        name: str,
        decode: Callable[[dict[str, Any], dict[str, np.ndarray]], T],
        only: Collection[str] | None = None,
    ) -> T | None:
        """What `decode_result` returns for a result that is fresh and whole; None for any other, to
        be computed again."""
        with contextlib.suppress(DamagedError):
            if self.state_of(name) == "fresh":
                return self.decode_result(name, decode, only)
        return None

    # decisions and exports

    def exclude(self, name: str, why: str = "by hand") -> None:
        """Exclude a capture from calibrations from now on, with the reason."""
        self.load_capture(name)
        self._decide("excluded", lambda: {**self.excluded(), name: why})

    @property
    def exports(self) -> Path:
        """The folder of exported files, created where it is missing."""
        folder = self.folder / "exports"
        with atomic.disk_errors(self.folder):
            folder.mkdir(exist_ok=True)
        return folder

    def staged_export(self, name: str) -> AbstractContextManager[Path]:
        """Context manager: as `staged_file`, of a file in the exports."""
        return self.staged_file(self.exports / safe_name(name))

    @contextmanager
    def staged_file(self, target: Path, needs_bytes: int = 0) -> Iterator[Path]:
        """Context manager: a path for a file that goes to its place at the end, unless that fails
        or is given up."""
        with atomic.staged_folder(target, needs_bytes) as folder:
            yield folder / target.name
            if self._allow is not None:
                self._allow()
            atomic.rename(folder / target.name, target)
        atomic.discard(folder)

    # inside

    def _recover(self) -> None:
        """Finish what dead writers began; a reader does so only without a writer, in a writable
        folder."""
        if not atomic.list_leftovers(self.folder):
            return
        lock = WriterLock(self.folder)  # a reader's, for the moment
        with contextlib.suppress(*((SessionError, OSError) if self._lock is None else ())):
            try:
                if self._lock is None:
                    lock.acquire(patience_s=0)
                completed = atomic.recover(self.folder, self._trash_place)
            finally:
                lock.release()
            self.recovered = tuple(
                path.name for path in completed if path.parent == self.folder / "captures"
            )

    @property
    def is_writable(self) -> bool:
        """Whether the session is open for writing."""
        return self._lock is not None and self._lock.held

    def _require_writer(self) -> None:
        """Raise SessionError unless the session is open for writing and the write is allowed."""
        if not self.is_writable:
            raise SessionError(f"{self.folder} is open for reading only", "open it with write=True")
        if self._allow is not None:
            self._allow()

    def _capture_folder(self, name: str) -> Path:
        """Return the folder of a capture; InputError for an unsafe name."""
        return self.folder / "captures" / safe_name(name)

    def _has_description(self, name: str) -> bool:
        """Whether the folder of a capture holds its description, sound or not."""
        return (self._capture_folder(name) / "capture.json").is_file()

    def _trash_place(self, folder: Path) -> Path:
        """Return a new path in the trash for the folder of a capture or result, with the time of
        deletion."""
        parts = folder.relative_to(self.folder).parts
        return trash_place(self.folder / "trash", "-".join(parts[1:]) or parts[0])

    def _hashes(self, name: str) -> list[str]:
        """Content hashes of the capture, decision and result of that name; of a result its
        ``content`` where stated."""
        is_capture = "/" not in name and self._has_description(name)
        content_hashes = (
            [self.load_capture(name).hash] if is_capture else self.decision_hashes(name)
        )
        if self.has_result(name):
            meta = read_meta(self._result_folder(name))
            content_hashes.append(str(meta.get("content", meta.get("hash"))))
        return content_hashes
