"""The records of a session: saved, loaded and listed by their kinds."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from slviewer.pipeline.open_session import SessionLike, numbered_results, opened
from slviewer.pipeline.scale import scale_factor
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
    return [each for each in record.inputs if "/" not in each] if name.isdecimal() else [name]


def list_records(store: Session, kind: type[R]) -> list[Stored[R]]:
    """Return the records of a kind in natural order of their names; those of deleted captures are
    skipped."""
    labels, there = store.valid_decision("names") or {}, set(store.capture_names())
    records = []
    for result in numbered_results(store, kind.kind):
        name = result.removeprefix(f"{kind.kind}/")
        record = load_record(store, kind, name)
        if there.issuperset(captures_of(name, record)):
            stale = store.state_of(result) != "fresh" or not _has_scales(store, record.scales)
            records.append(Stored(name, str(labels.get(name, name)), record, stale))
    return records


def name_records(found: Sequence[Stored[R]]) -> dict[str, R]:
    """Return records by their labels, with the name beside a label that several have."""
    counts = Counter(each.label for each in found)
    names = (
        each.label if counts[each.label] == 1 else f"{each.label} ({each.name})" for each in found
    )
    return {name: each.record for name, each in zip(names, found, strict=True)}


def is_up_to_date(store: Session, result: str) -> bool:
    """Whether a result's inputs are as they were, and no correction of scale has changed since."""
    if store.state_of(result) != "fresh":
        return False
    return _has_scales(store, store.load_result(result, only=())[0].get("scales", {}))


def _has_scales(store: Session, scales: Mapping[str, float]) -> bool:
    """Whether these are the corrections of scale in force, by model."""
    return all(scale_factor(store, model) == factor for model, factor in scales.items())
