"""A session by its folder, or one that is open already, and names in it; its records: saved, loaded
and listed by their kinds."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from slviewer.errors import InputError, SessionError, SlviewerError, UsageError
from slviewer.pipeline.feedback import Warn
from slviewer.pipeline.scale import scale_factor
from slviewer.records.calibration import ModelCalibration
from slviewer.records.kinds import RECORDS
from slviewer.records.plain import from_plain, to_plain
from slviewer.records.record import Record
from slviewer.session.names import natural_key
from slviewer.session.store import Session

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


def read_record(kind: type[R], meta: Mapping[str, Any]) -> R:
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
    if kind not in RECORDS:
        return True
    is_fresh = store.state_of(result) == "fresh"
    return is_fresh and _has_scales(store, load_record(store, RECORDS[kind], name))


def _has_scales(store: Session, record: Record) -> bool:
    """Whether the corrections of scale in a record, and in those that it was made from, are in
    force; calibrations are made without any."""
    made_from = (each.partition("/") for each in record.inputs)
    return all(scale_factor(store, model) == used for model, used in record.scales.items()) and all(
        _has_scales(store, load_record(store, RECORDS[kind], name))
        for kind, _, name in made_from
        if kind in RECORDS and kind != ModelCalibration.kind
    )
