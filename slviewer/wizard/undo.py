"""What can be undone in a session, also once it was closed and opened again: changes with the steps
that take them back, kept beside the trash that these need."""

import os
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.pipeline.edit import step_edits
from slviewer.records.record import from_plain
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.reading import read_json
from slviewer.session.store import Session

MOST_CHANGES = 200
"""Older ones can no longer be undone."""

_Place = Annotated[str, msgspec.Meta(pattern=r"^(trash|exports)/[^./\\][^/\\]*$")]
"""A file or folder of the session, relative to it."""


class Exchange(msgspec.Struct, frozen=True, tag="exchange"):
    """Replace captures and results {name: its place in the trash, None to remove it}."""

    contents: dict[str, _Place | None]

    def make(self, store: Session) -> "Exchange":
        """Replace them; returns the step that exchanges them back."""
        places = {
            name: None if place is None else store.folder / place
            for name, place in self.contents.items()
        }
        return replaced_by(store, store.exchange(places))


class Restore(msgspec.Struct, frozen=True, tag="restore"):
    """Bring the last deleted capture or result of a name back."""

    name: str

    def make(self, store: Session) -> Exchange:
        """Bring it back; returns the step that removes it."""
        store.restore_last(self.name)
        return remove([self.name])


class Decide(msgspec.Struct, frozen=True, tag="decide"):
    """Change what differs between two values of a decision."""

    what: str
    old: Any
    new: Any

    def make(self, store: Session) -> "Decide":
        """Change it; returns the step that changes it back."""
        store.replace_decision(self.what, self.old, self.new)
        return Decide(self.what, self.new, self.old)


class StepEdits(msgspec.Struct, frozen=True, tag="edits"):
    """Undo the last edit of each scan, made at a time {scan: time}; or (``redo``) bring it back."""

    made: dict[str, str]
    redo: bool = False

    def make(self, store: Session) -> "StepEdits":
        """Undo the edits, or bring them back; returns the reverse."""
        step_edits(store, self.made, redo=self.redo)
        return StepEdits(self.made, not self.redo)


class Move(msgspec.Struct, frozen=True, tag="move"):
    """Move a file of the session; a missing one is omitted."""

    source: _Place
    target: _Place

    def make(self, store: Session) -> "Move":
        """Move it; returns the step that moves it back."""
        if (store.folder / self.source).is_file():
            os.replace(store.folder / self.source, store.folder / self.target)
        return Move(self.target, self.source)


class Several(msgspec.Struct, frozen=True, tag="several"):
    """Make several steps, one after the other; the last is reversed first."""

    steps: "Sequence[Exchange | Restore | Decide | StepEdits | Move | Several]"

    def make(self, store: Session) -> "Several":
        """Make them; returns the reverse."""
        return Several([step.make(store) for step in self.steps][::-1])


Step = Exchange | Restore | Decide | StepEdits | Move | Several


def replaced_by(store: Session, contents: Mapping[str, Path | None]) -> Exchange:
    """Return the step for what `Session.exchange` takes and returns."""
    return Exchange(
        {
            name: None if place is None else place.relative_to(store.folder).as_posix()
            for name, place in contents.items()
        }
    )


def remove(names: Iterable[str]) -> Exchange:
    """Return the step that moves captures, and results such as ``merge/1``, to the trash."""
    return Exchange(dict.fromkeys(names))


def decide(store: Session, what: str, change: Callable[[], object]) -> Decide:
    """Call ``change``, which changes a decision of the session; returns the reverse."""
    before = store.decision(what)
    change()
    return Decide(what, store.decision(what), before)


class _Changes(msgspec.Struct):
    """The content of the file, the latest change last."""

    done: list[tuple[str, Step]] = []
    undone: list[tuple[str, Step]] = []


class UndoHistory:
    """The changes that were made in a session, each with its name and the step that takes it back,
    and those of them that were undone. Every method may be called from any thread.

    `fault`: why those of the last time are forgotten, else empty.
    """

    def __init__(self, store: Session | None = None) -> None:
        self._lock, self._store, self.fault = threading.RLock(), store, ""
        self._changes = _Changes()
        if store and self._file(store).exists():
            try:
                self._changes = from_plain(read_json(self._file(store)), _Changes)
            except (DamagedError, InputError, SessionError) as error:
                why = f"what was done before cannot be undone ({error})"
                self.fault = f"{self._file(store).relative_to(store.folder)} is ignored: {why}"

    @staticmethod
    def _file(store: Session) -> Path:
        """Where the changes of a session are kept."""
        return store.folder / "trash" / "changes.json"

    @property
    def next_undo(self) -> str:
        """The name of the change that `undo` takes back; empty where there is none."""
        with self._lock:
            return self._changes.done[-1][0] if self._changes.done else ""

    @property
    def next_redo(self) -> str:
        """The name of the change that `redo` makes again; empty where there is none."""
        with self._lock:
            return self._changes.undone[-1][0] if self._changes.undone else ""

    def add(self, name: str, reverse: Step) -> None:
        """Add a change that was made; what was undone can no longer be made again."""
        with self._lock:
            done = [*self._changes.done[1 - MOST_CHANGES :], (name, reverse)]
            self._changes = _Changes(done)
            self._save()

    def undo(self) -> str:
        """Take the last change back; returns its name. Raises InputError where there is none, or
        where it can no longer be taken back: it is then forgotten."""
        return self._move("undo")

    def redo(self) -> str:
        """Make the change again that was undone last; returns its name. Raises as `undo`."""
        return self._move("redo")

    def _move(self, verb: Literal["undo", "redo"]) -> str:
        """Make the last step of one list, and put the one that reverses it into the other."""
        with self._lock:
            source, target = self._changes.done, self._changes.undone
            if verb == "redo":
                source, target = target, source
            if not source or self._store is None:
                raise InputError(f"there is nothing to {verb}")
            name, step = source[-1]
            try:
                target.append((name, step.make(self._store)))
            except InputError as error:  # no later attempt would succeed
                source.pop()
                self._save()
                raise error.within(name) from error
            source.pop()
            self._save()
            return name

    def _save(self) -> None:
        """Write the file; where the disk refuses, the changes are undone until the session is
        closed."""
        with suppress(SessionError, OSError):
            if self._store:
                file = self._file(self._store)
                file.parent.mkdir(exist_ok=True)
                replace_file(file, to_json(self._changes))
