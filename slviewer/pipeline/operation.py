"""Operations: what computes records, on a session by its folder or one that is open already; the
records that the session stores, saved, loaded and listed by their kinds; and how work reports
progress and warnings.

One runner opens the session, runs an operation, stores what it finds, and returns that."""

import inspect
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from functools import partial, update_wrapper, wraps
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, cast

import msgspec
import numpy as np

from slviewer.errors import InputError, SessionError, SlviewerError, UsageError
from slviewer.inputs import check_inputs
from slviewer.pipeline.cloud_corrections import scale_factor
from slviewer.pipeline.imported_verdict import warning_of_imported
from slviewer.records.calibration import ModelCalibration
from slviewer.records.kinds import all_kinds
from slviewer.records.record import Meta, Record, from_plain, render_text, to_plain
from slviewer.session.layout import time_now
from slviewer.session.names import natural_key
from slviewer.session.store import Session

Progress = Callable[[float, str], None]
"""Called with the share done (0 to 1) and what is being done; it may raise Cancelled to stop the
work."""

Warn = Callable[[str], None]
"""Called with one sentence that the operator should know of."""

T = TypeVar("T")


def ignore_progress(done: float, doing: str) -> None:
    """Ignore the progress."""


def ignore_warnings(message: str) -> None:
    """Ignore the warning."""


def part(progress: Progress, start: float, end: float, label: str = "") -> Progress:
    """Map the progress 0 to 1 of a stage to ``start`` to ``end`` of the whole; ``label``: a
    prefix."""

    def report(done: float, doing: str) -> None:
        """Report the share ``done`` (0 to 1) of the stage as a share of the whole."""
        progress(start + (end - start) * done, f"{label}: {doing}" if label else doing)

    return report


def track(
    progress: Progress, named: Mapping[str, T], start: float = 0.0, end: float = 1.0
) -> Iterator[tuple[str, T, Progress]]:
    """Yield each item with its name, which is reported, and the progress of its share of ``start``
    to ``end``."""
    for i, (name, item) in enumerate(named.items()):
        begin, after = (start + (end - start) * k / len(named) for k in (i, i + 1))
        progress(begin, name)
        yield name, item, part(progress, begin, after, name)


def stage(progress: Progress, start: float, end: float, doing: str) -> Callable[[float], None]:
    """Report the start of a stage; returns a callback for the share of it, 0 to 1, that is done."""
    progress(start, doing)
    return lambda done: progress(start + (end - start) * done, doing)


SessionLike = Path | str | Session


def opened(session: SessionLike, write: bool = False) -> AbstractContextManager[Session]:
    """Return a context manager of the session; one that was opened here is closed at the end, one
    that was open stays so."""
    if isinstance(session, Session):
        return nullcontext(session)
    return Session.open(session, write=write)


def opened_to_save(session: SessionLike, warn: Warn) -> AbstractContextManager[Session]:
    """Return a context manager of the session, to store results in where ``is_writable``.

    One that another process is writing to, or that cannot be written, is opened for reading, with a
    warning.
    """
    try:
        return opened(session, write=True)
    except SessionError as error:
        store = opened(session)
        warn(f"the result is not stored in the session: {error}")
        return store


@contextmanager
def placed_file(store: Session, out: Path | str | None, name: str) -> Iterator[tuple[Path, Path]]:
    """Context manager: the file ``out``, or one of this name in the session's exports, and the path
    to write it to.

    In the exports it appears at the end of the block, unless that fails.
    """
    if out is not None:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        yield Path(out), Path(out)
        return
    with store.staged_export(name) as staged:
        yield store.exports / name, staged


@contextmanager
def opened_or_made(session: SessionLike) -> Iterator[Session]:
    """Context manager: the session, open for writing; one created for the block is removed again if
    nothing was saved in it."""
    if isinstance(session, Session):
        yield session
        return
    with Session.open_or_create(session) as store:
        try:
            yield store
        except BaseException:
            store.remove_if_new()
            raise


def match_names(
    names: Sequence[str],
    patterns: Sequence[str],
    kind: str,
    error: type[SlviewerError] = UsageError,
) -> list[str]:
    """Return those of ``names`` that match a pattern such as ``pose_0*``, in their order.

    Raises ``error`` for a pattern that matches none; ``kind``: what they are names of.
    """
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise error(f"no {kind} is called {pattern!r}: there are {', '.join(names) or 'none'}")
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def numbered_names(store: Session, kind: str) -> list[str]:
    """Names of the session's results of a kind, ``merge/1``, ``merge/2``, ..., without it, in the
    order of their numbers."""
    names = (name for name in store.result_names() if name.startswith(f"{kind}/"))
    return sorted((name.removeprefix(f"{kind}/") for name in names), key=natural_key)


R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class Stored(Generic[R]):
    """A record of a session: the capture that it is of, or its number; the operator's label;
    whether it is stale."""

    name: str
    label: str
    record: R
    stale: bool = False


def save_record(
    store: Session, name: str, record: Record, arrays: Mapping[str, np.ndarray]
) -> None:
    """Store a record of a capture, or with a number, and its arrays; it replaces one of the same
    kind and name."""
    store.save_result(f"{record.kind}/{name}", to_plain(record), arrays)


def read_record(kind: type[R], meta: Meta) -> R:
    """Return the record of a result's `meta`, also of one that an older version stored. InputError
    where it is none."""
    return from_plain(kind.upgrade(meta), kind)


def load_record(store: Session, kind: type[R], name: str) -> R:
    """Load a record, without its arrays. InputError where there is none, DamagedError where it is
    damaged."""
    return store.decode_result(
        f"{kind.kind}/{name}", lambda meta, _: read_record(kind, meta), only=()
    )


def load_arrays(session: SessionLike, result: str) -> dict[str, np.ndarray]:
    """Return the arrays of a result of a session by name, such as ``verify/plane_01``. InputError
    where there is none.

    Which there are says the docstring of the record.
    """
    with opened(session) as store:
        return store.load_result(result)[1]


def captures_of(name: str, record: Record) -> list[str]:
    """Return the captures that a record is of, if any: what it is named after, or what it was made
    from."""
    if not record.is_of_captures:
        return []
    return [each for each in record.inputs if "/" not in each] if record.is_number(name) else [name]


def load_stored(store: Session, kind: type[R], name: str) -> Stored[R]:
    """Load a record with its label and whether it is stale. Raises InputError where there is none
    of that name."""
    result = f"{kind.kind}/{name}"
    if not store.has_result(result):
        there = numbered_names(store, kind.kind)
        noun = kind.title.lower().removesuffix("s")
        raise InputError(f"there is no {noun} {name!r}: there are {', '.join(there) or 'none'}")
    record, labels = load_record(store, kind, name), store.valid_decision(kind.labels) or {}
    label = str(labels.get(name) or record.label(name))
    return Stored(name, label, record, stale=not is_up_to_date(store, result))


def list_records(store: Session, kind: type[R]) -> list[Stored[R]]:
    """Return the records of a kind in natural order of their names; those of deleted captures are
    skipped."""
    there = set(store.capture_names())
    records = (load_stored(store, kind, name) for name in numbered_names(store, kind.kind))
    return [each for each in records if there.issuperset(captures_of(each.name, each.record))]


def next_name(store: Session, kind: type[Record]) -> str:
    """Return the name of the next numbered record of a kind; those in the trash can come back, and
    keep theirs."""
    start = f"{kind.kind}/{kind.prefix}"
    taken = [each.removeprefix(start) for each in (*store.result_names(), *store.deleted_results())]
    return f"{kind.prefix}{1 + max((int(each) for each in taken if each.isdecimal()), default=0)}"


def name_records(found: Sequence[Stored[R]]) -> dict[str, R]:
    """Return records by their labels, with the name beside a label that several have."""
    counts = Counter(each.label for each in found)
    return {
        each.label if counts[each.label] == 1 else f"{each.label} ({each.name})": each.record
        for each in found
    }


def is_up_to_date(store: Session, result: str) -> bool:
    """Whether a record's inputs are as they were, and no correction of scale has changed since,
    also in records that it was made from; other results are taken to be."""
    kind, _, name = result.partition("/")
    if kind not in all_kinds():
        return True
    is_fresh = store.state_of(result) == "fresh"
    return is_fresh and _has_scales(store, load_record(store, all_kinds()[kind], name))


def _has_scales(store: Session, record: Record) -> bool:
    """Whether the corrections of scale in a record, and in those that it was made from, are in
    force; calibrations are made without any."""
    made_from = (each.partition("/") for each, used in record.inputs.items() if used)
    return all(scale_factor(store, model) == used for model, used in record.scales.items()) and all(
        _has_scales(store, load_record(store, all_kinds()[kind], name))
        for kind, _, name in made_from
        if kind in all_kinds() and kind != ModelCalibration.kind
    )


P = ParamSpec("P")
V = TypeVar("V")
S = TypeVar("S")


@dataclass(frozen=True)
class Job:
    """One run of an operation: its session, what takes its progress and warnings, and whether a
    calibration is used although its verdict rejects it."""

    store: Session
    progress: Progress = ignore_progress
    warn: Warn = ignore_warnings
    accept_rejected: bool = False

    def accepting(self, settings: Any) -> "Job":
        """Return the job that uses a rejected calibration where settings accept that."""
        accepts = self.accept_rejected or getattr(settings, "accept_rejected", False)
        return replace(self, accept_rejected=accepts)

    def part(self, start: float, end: float, label: str = "") -> "Job":
        """Return the job of a stage, whose progress is mapped as by `part`."""
        return replace(self, progress=part(self.progress, start, end, label))


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
        others: tuple[type[Record], ...],
        function: Callable[[Job, S], Iterator[Found[Any]]],
    ) -> None:
        update_wrapper(self, function)
        self.name, self.function, self.record, self.settings = name, function, record, settings
        self.others = others
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        session = inspect.Parameter("session", kind, annotation=SessionLike)
        self.__signature__ = inspect.Signature(
            [session, *inspect.signature(settings).parameters.values()],
            return_annotation=Findings[R],
        )
        self.__doc__ = describe(function, settings)
        if name in OPERATIONS:
            raise ValueError(f"an operation is called {name} already")
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
        records, kind = dict[str, Any](), self.record
        files, notes = list[Path](), list[str]()
        with opened_to_save(session, warn) as store:
            for found in self.find(Job(store, progress, warn), settings):
                if isinstance(found.record, (self.record, *self.others)):
                    records[found.name] = found.record
                    kind = cast("type[R]", type(found.record))
                files += found.files
                notes += found.notes
        return Findings(kind, records, tuple(files), tuple(notes))

    def find(self, job: Job, settings: S) -> Iterator[Found[Any]]:
        """Yield everything that the operation finds, of any kind, once it is stored."""
        check_inputs(settings)
        function = self.function(job.accepting(settings), settings)
        everything = cast("Generator[Found[Any], None, None]", function)
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
                        origin["time"] = time_now()
                    record = msgspec.structs.replace(record, **origin)
                if any(each.startswith("calibration/") for each in record.inputs):
                    warning = warning_of_imported(job.store)
                    record = msgspec.structs.replace(record, calibration_warning=warning)
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
    name: str, record: type[R], settings: Callable[P, S], others: tuple[type[Record], ...] = ()
) -> Callable[[Callable[[Job, S], Iterator[Found[Any]]]], Operation[P, S, R]]:
    """Return a decorator that makes a function the operation of that name, which finds records with
    settings; in some sessions one of a kind of the ``others`` instead."""
    return partial(Operation, name, record, settings, others)


@dataclass(frozen=True, kw_only=True)
class Callbacks:
    """What takes the progress and the warnings of work; the base of settings."""

    progress: Progress = ignore_progress
    warn: Warn = ignore_warnings

    def job(self, store: Session) -> Job:
        """Return the work on a session."""
        return Job(store, self.progress, self.warn).accepting(self)


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
            chosen = settings(*args, **kwargs)
            check_inputs(chosen)
            return function(chosen)

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
