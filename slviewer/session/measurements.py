"""What was measured on a session's scans: each is a result of its own, numbered as they were
made."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.inspection.quantities import Quantity
from slviewer.records.plain import from_plain
from slviewer.session.names import clean_label, natural_key
from slviewer.session.store import Session

FOLDER = "measurements"
NAMES = "measurement names"


@dataclass(frozen=True)
class Measurement:
    """One measurement: its ``id`` (m1, m2, …), ``name``, ``kind``, the scan (or merged surface)
    ``source`` that it was made on, the calibration ``model``, ``time`` (ISO 8601, UTC), what its
    kind needs in ``data``, and whether what it was made from has changed since (``stale``). ``of``:
    the measurements that it was made from, by id.
    """

    id: str
    name: str
    kind: str
    source: str
    model: str
    time: str
    data: dict[str, Any]
    of: tuple[str, ...] = ()
    stale: bool = False

    @cached_property
    def quantities(self) -> list[Quantity]:
        """The measured values, the most important first, such as the radius and the diameter of a
        sphere."""
        return from_plain(self.data["quantities"], list[Quantity])

    def __getitem__(self, name: str) -> Quantity:
        """Return the quantity of that name, such as "diameter". Raises InputError for others."""
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise InputError(
            f"{self.name} has no {name!r}: it has"
            f" {', '.join(each.name for each in self.quantities)}"
        )


def save_measurement(
    store: Session,
    kind: str,
    *,
    source: str,
    model: str,
    inputs: Mapping[str, str],
    data: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    of: tuple[str, ...] = (),
    name: str = "",
) -> Measurement:
    """Save a new measurement. ``inputs``: {capture or result: hash} of all that it was made from,
    so that it becomes stale when one changes; the measurements ``of`` are added to them."""
    numbers = [int(each.removeprefix("m")) for each in _list_ids(store)] + _list_trashed_numbers(
        store
    )
    identity = f"m{1 + max(numbers, default=0)}"
    used = dict(inputs) | store.input_hashes(*(_result_name(store, each) for each in of))
    meta = {
        "kind": kind,
        "name": clean_label(name),
        "source": source,
        "model": model,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "of": list(of),
        "data": dict(data),
        "inputs": used,
    }
    store.save_result(f"{FOLDER}/{identity}", meta, arrays)
    return load_measurement(store, identity)


def list_measurements(store: Session) -> list[Measurement]:
    """All measurements, in the order in which they were made."""
    return [load_measurement(store, each) for each in _list_ids(store)]


def load_measurement(store: Session, identity: str) -> Measurement:
    """One measurement. Raises InputError where there is none of that id."""
    result = _result_name(store, identity)
    meta = store.load_result(result, only=())[0]
    return measurement_from_meta(
        identity, meta, store.valid_decision(NAMES) or {}, store.state_of(result) == "stale"
    )


def measurement_from_meta(
    identity: str, meta: Mapping[str, Any], names: Mapping[str, str], stale: bool
) -> Measurement:
    """The measurement of that id from its result's ``meta`` and the ``names`` that were given
    since."""
    kind = meta["kind"]
    return Measurement(
        identity,
        str(names.get(identity) or meta["name"] or f"{kind} {identity.removeprefix('m')}"),
        kind,
        meta["source"],
        meta["model"],
        meta["time"],
        meta["data"],
        tuple(meta["of"]),
        stale,
    )


def measurement_arrays(store: Session, identity: str) -> dict[str, np.ndarray]:
    """Return the stored arrays of a measurement, by name."""
    return store.load_result(_result_name(store, identity))[1]


def rename_measurement(store: Session, identity: str, name: str) -> Measurement:
    """Give a measurement another name; an empty one restores its original name."""
    _result_name(store, identity)
    store.decide(NAMES, {**(store.decision(NAMES) or {}), identity: clean_label(name)})
    return load_measurement(store, identity)


def trash_measurement(store: Session, identity: str) -> None:
    """Move a measurement to the trash; ``restore_measurement`` brings it back. What was made from
    it becomes stale."""
    store.trash_result(_result_name(store, identity))


def restore_measurement(store: Session, identity: str = "") -> Measurement:
    """Bring a deleted measurement back, by default the last one deleted. Raises InputError where
    there is none."""
    if not identity:
        deleted = [each for each in store.deleted_results() if each.startswith(f"{FOLDER}/")]
        if not deleted:
            raise InputError("no measurement was deleted, so none can be restored: measure again")
        identity = deleted[0].removeprefix(f"{FOLDER}/")
    store.restore_last(f"{FOLDER}/{identity}")
    return load_measurement(store, identity)


def _list_ids(store: Session) -> list[str]:
    """Return the ids of the saved measurements, in natural order."""
    names = [name for name in store.result_names() if name.startswith(f"{FOLDER}/m")]
    return sorted((name.removeprefix(f"{FOLDER}/") for name in names), key=natural_key)


def _list_trashed_numbers(store: Session) -> list[int]:
    """Numbers of deleted measurements, which may be restored and are not used again."""
    numbers = [
        each.removeprefix(f"{FOLDER}/m")
        for each in store.deleted_results()
        if each.startswith(f"{FOLDER}/m")
    ]
    return [int(number) for number in numbers if number.isdecimal()]


def _result_name(store: Session, identity: str) -> str:
    """Return the name of a measurement's result; InputError where it does not exist."""
    result = f"{FOLDER}/{identity}"
    if not store.has_result(result):
        raise InputError(
            f"there is no measurement {identity!r}: there are"
            f" {', '.join(_list_ids(store)) or 'none'}"
        )
    return result
