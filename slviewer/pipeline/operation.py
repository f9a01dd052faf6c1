"""Operations: what computes records. One runner opens the session, runs one, stores what it finds,
and returns that."""

import inspect
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import partial, update_wrapper, wraps
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, cast

import msgspec
import numpy as np

from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.stored_records import SessionLike, next_name, opened_to_save, save_record
from slviewer.records.plain import to_plain
from slviewer.records.record import Record
from slviewer.records.table import render_text
from slviewer.session.store import Session

P = ParamSpec("P")
R = TypeVar("R", bound=Record)
V = TypeVar("V")
S = TypeVar("S")


@dataclass(frozen=True)
class Job:
    """One run of an operation: its session, and what takes its progress and warnings."""

    store: Session
    progress: Progress = ignore_progress
    warn: Warn = ignore_warnings


@dataclass(frozen=True, eq=False)
class Found(Generic[R]):
    """One record that an operation found, and its arrays. ``name``: the capture that it is of, or
    its number, empty for the next one; where it is not to be ``stored``, that of its file.
    ``files``: what else was written, ``notes`` on it in words. ``settings``: with what was chosen
    for want of any, where these are not the operation's.
    """

    name: str
    record: R
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    stored: bool = True
    settings: Any = None


class Findings(dict[str, R]):
    """The records that an operation found, by name, the files that it wrote, and notes on these."""

    def __init__(
        self,
        kind: type[R],
        records: Mapping[str, R],
        files: tuple[Path, ...] = (),
        notes: tuple[str, ...] = (),
    ) -> None:
        super().__init__(records)
        self.kind, self.files, self.notes = kind, files, notes

    @property
    def only(self) -> R:
        """The record, where there is a single one. Raises ValueError otherwise."""
        (record,) = self.values()
        return record

    @property
    def failure(self) -> str:
        """Why the command ends with status 1; empty where it ends with 0."""
        return "; ".join(filter(None, (each.failure for each in self.values())))

    def to_json(self) -> dict[str, Any]:
        """Return the records as they are stored: {kind: {name: record}}."""
        return {self.kind.kind: dict(self)}

    def summary(self) -> str:
        """Return the records in one sentence."""
        return "; ".join(
            each.summary() if each.is_number(name) else f"{name}: {each.summary()}"
            for name, each in self.items()
        )

    def text(self) -> str:
        """Return the records' tables and the notes for the terminal."""
        named = {
            " ".join(dict.fromkeys((name, each.label(name)))): each for name, each in self.items()
        }
        tables = (f"{table.caption}\n{render_text(table)}" for table in self.kind.tables(named))
        return "\n".join([*tables, *self.notes])


def show_found(found: Found[R]) -> Findings[R]:
    """Return one record as findings."""
    return Findings(type(found.record), {found.name: found.record}, found.files, found.notes)


class Operation(Generic[P, S, R]):
    """A function that computes records, ``function(job, settings)``, which yields each as `Found`.

    Called with a session and the fields of its settings, it runs and returns the records. The
    function's docstring describes it, and that of the settings their fields: for Python, for the
    command's help, and for the pages.
    """

    def __init__(
        self,
        name: str,
        record: type[R],
        settings: Callable[P, S],
        function: Callable[[Job, S], Iterator[Found[Any]]],
    ) -> None:
        update_wrapper(self, function)
        self.name, self.function, self.record, self.settings = name, function, record, settings
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        session = inspect.Parameter("session", kind, annotation=SessionLike)
        self.__signature__ = inspect.Signature(
            [session, *inspect.signature(settings).parameters.values()],
            return_annotation=Findings[R],
        )
        self.__doc__ = describe(function, settings)
        OPERATIONS[name] = self

    def __call__(self, session: SessionLike, *args: P.args, **kwargs: P.kwargs) -> Findings[R]:
        """Run the operation on a session with these settings, and return what it found."""
        return self.run(session, self.settings(*args, **kwargs))

    def __get__(self, session: Session, owner: type | None = None) -> Callable[P, Findings[R]]:
        """Return the operation as a method of a session."""
        return partial(self, session)

    def run(
        self,
        session: SessionLike,
        settings: S,
        progress: Progress = ignore_progress,
        warn: Warn = ignore_warnings,
    ) -> Findings[R]:
        """Run the operation on a session; each record is stored, with its arrays, before the next
        is computed.

        A session that another process writes to, or that is open for reading, is left as it is,
        with a warning for the former.
        """
        records: dict[str, R] = {}
        files, notes = list[Path](), list[str]()
        with opened_to_save(session, warn) as store:
            for found in self.find(Job(store, progress, warn), settings):
                if isinstance(found.record, self.record):
                    records[found.name] = found.record
                files += found.files
                notes += found.notes
        return Findings(self.record, records, tuple(files), tuple(notes))

    def find(self, job: Job, settings: S) -> Iterator[Found[Any]]:
        """Yield everything that the operation finds, of any kind, once it is stored."""
        everything = cast("Generator[Found[Any], None, None]", self.function(job, settings))
        with closing(everything):  # a file that it is about to place is given up where saving fails
            for found in everything:
                record = found.record
                name = found.name or next_name(job.store, type(record))
                if not record.operation:
                    origin: dict[str, Any] = {
                        "operation": self.name,
                        "settings": plain_settings(found.settings or settings),
                    }
                    if hasattr(record, "time"):
                        origin["time"] = datetime.now(UTC).isoformat(timespec="seconds")
                    record = msgspec.structs.replace(record, **origin)
                if found.stored and job.store.is_writable:
                    save_record(job.store, name, record, found.arrays)
                yield replace(found, name=name, record=record)


def plain_settings(settings: Any) -> dict[str, Any]:
    """Return the settings that are not the default as plain values, but those that its
    ``UNRECORDED`` names, which do not influence what is found."""
    unrecorded = getattr(settings, "UNRECORDED", ())
    chosen = {
        each.name: value
        for each in fields(settings)
        if each.name not in unrecorded and (value := getattr(settings, each.name)) != each.default
    }
    return to_plain(chosen)  # type: ignore[no-any-return]


OPERATIONS: dict[str, Operation[Any, Any, Any]] = {}
"""The operations by the name of their command."""


def operation(
    name: str, record: type[R], settings: Callable[P, S]
) -> Callable[[Callable[[Job, S], Iterator[Found[Any]]]], Operation[P, S, R]]:
    """Return a decorator that makes a function the operation of that name, which finds records with
    settings."""
    return partial(Operation, name, record, settings)


@dataclass(frozen=True, kw_only=True)
class Callbacks:
    """What takes the progress and the warnings of work; the base of settings."""

    progress: Progress = ignore_progress
    warn: Warn = ignore_warnings


def takes_settings(settings: Callable[P, S]) -> Callable[[Callable[[S], V]], Callable[P, V]]:
    """Return a decorator of a function of such settings: it is called with their fields; further
    keywords become their field ``options``, if they have one.

    The function's docstring describes it, and those of the settings and their bases the fields.
    """

    def decorate(function: Callable[[S], V]) -> Callable[P, V]:
        """Return the function that takes the fields."""

        signature = inspect.signature(settings)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> V:
            if "options" in signature.parameters:
                further = kwargs.keys() - signature.parameters.keys()
                options = {name: kwargs.pop(name) for name in further}
                kwargs.setdefault("options", options)
            return function(settings(*args, **kwargs))

        call.__doc__ = describe(function, settings)
        returned = inspect.signature(function).return_annotation
        call.__signature__ = signature.replace(return_annotation=returned)  # type: ignore[attr-defined]
        return call

    return decorate


def describe(function: Callable[..., Any], settings: Callable[..., Any]) -> str:
    """Return the docstring of a function, with the fields that its settings and their bases
    describe."""
    assert inspect.isclass(settings)
    docs = [
        inspect.cleandoc(each.__doc__ or "").partition("Args:\n")[2] for each in settings.__mro__
    ]
    own, *inherited = docs
    described, _, rest = own.partition("\n\n")
    fields = "\n".join([described, *(doc.partition("\n\n")[0] for doc in inherited if doc)])
    return "\n\n".join(
        filter(None, (inspect.getdoc(function), fields and f"Args:\n{fields}", rest))
    )
