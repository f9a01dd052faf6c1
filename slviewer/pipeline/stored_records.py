"""The records of a session: saved, loaded and listed by their kinds."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from slviewer.errors import InputError
from slviewer.pipeline.open_session import SessionLike, numbered_names, opened
from slviewer.pipeline.scale import scale_factor
from slviewer.records.calibration import ModelCalibration
from slviewer.records.kinds import RECORDS
from slviewer.records.plain import from_plain, to_plain
from slviewer.records.record import Record
from slviewer.session.store import Session

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
