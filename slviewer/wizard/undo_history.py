"""What was done last in the session and can be undone, with its name; and the steps that take
changes of a session back.

A step makes a change and returns the step that reverses it. The history is kept in memory: it ends
with the program, and another session begins with an empty one.
"""

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TypeAlias

from slviewer.errors import InputError
from slviewer.pipeline.edit import step_edits
from slviewer.session.store import Session

Step: TypeAlias = "Callable[[], Step]"
MOST_CHANGES = 200
"""Older ones can no longer be undone."""


class UndoHistory:
    """The changes that were made, each with its name and the step that takes it back, and those of
    them that were undone. Every method may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._done: list[tuple[str, Step]] = []
        self._undone: list[tuple[str, Step]] = []

    @property
    def next_undo(self) -> str:
        """The name of the change that `undo` takes back; empty where there is none."""
        with self._lock:
            return self._done[-1][0] if self._done else ""

    @property
    def next_redo(self) -> str:
        """The name of the change that `redo` makes again; empty where there is none."""
        with self._lock:
            return self._undone[-1][0] if self._undone else ""

    def clear(self) -> None:
        """Forget everything: another session is open."""
        with self._lock:
            self._done, self._undone = [], []

    def add(self, name: str, reverse: Step) -> None:
        """Add a change that was made; what was undone can no longer be made again."""
        with self._lock:
            self._done = [*self._done[1 - MOST_CHANGES :], (name, reverse)]
            self._undone = []

    def undo(self) -> str:
        """Take the last change back; returns its name. Raises InputError where there is none, or
        where it can no longer be taken back: it is then forgotten."""
        return self._move(self._done, self._undone, "undo")

    def redo(self) -> str:
        """Make the change again that was undone last; returns its name. Raises as `undo`."""
        return self._move(self._undone, self._done, "redo")

    def _move(
        self, source: list[tuple[str, Step]], target: list[tuple[str, Step]], verb: str
    ) -> str:
        """Make the last step of one list, and put the one that reverses it into the other."""
        with self._lock:
            if not source:
                raise InputError(f"there is nothing to {verb}")
            name, step = source[-1]
            try:
                target.append((name, step()))
            except InputError as error:  # no later attempt would succeed
                source.pop()
                raise InputError(f"{name}: {error}") from error
            source.pop()
            return name


def combine(*steps: Step) -> Step:
    """Return the step that makes several, one after the other; the last is reversed first."""

    def act() -> Step:
        """Make all steps."""
        return combine(*[step() for step in steps][::-1])

    return act


def decide_step(store: Session, what: str, change: Callable[[], object]) -> Step:
    """Return the step that calls ``change``, which changes a decision of the session."""

    def act() -> Step:
        """Make the change."""
        before = store.decision(what)
        change()
        return partial(replace, store.decision(what), before)

    def replace(old: object, new: object) -> Step:
        """Change what differs between two values of the decision."""
        store.replace_decision(what, old, new)
        return partial(replace, new, old)

    return act


def exchange_step(store: Session, contents: Mapping[str, Path | None]) -> Step:
    """Return the step that `Session.exchange` makes of captures and results {name: place in the
    trash}; the reverse exchanges them back."""
    contents = dict(contents)
    return lambda: exchange_step(store, store.exchange(contents))


def trash_step(store: Session, names: Iterable[str]) -> Step:
    """Return the step that moves captures, and results such as ``merge/1``, to the trash."""
    return exchange_step(store, dict.fromkeys(names))


def restore_step(store: Session, name: str) -> Step:
    """Return the step that brings the last deleted capture or result of a name back."""

    def act() -> Step:
        """Bring it back."""
        store.restore_last(name)
        return trash_step(store, [name])

    return act


def edit_step(store: Session, made: Mapping[str, str], redo: bool = False) -> Step:
    """Return the step that undoes the last edit of each scan, which was made at a time {scan:
    time}; or (``redo``) brings it back."""

    def act() -> Step:
        """Undo the edits, or bring them back."""
        step_edits(store, made, redo=redo)
        return edit_step(store, made, not redo)

    return act


def move_step(source: Path, target: Path) -> Step:
    """Return the step that moves a file; a missing one is left out."""

    def act() -> Step:
        """Move the file."""
        if source.is_file():
            os.replace(source, target)
        return move_step(target, source)

    return act
