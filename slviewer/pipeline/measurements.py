"""The measurements of a session: listed, renamed, deleted and restored, written as CSV."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.inspection.section import CutPlane
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.relate import relate as measure_relation
from slviewer.pipeline.stored_records import Stored, list_records, load_arrays, load_stored
from slviewer.printable import format_csv
from slviewer.records.measurement import Measurement
from slviewer.records.plain import from_plain, to_plain
from slviewer.session.atomic import replace_file
from slviewer.session.names import clean_label
from slviewer.session.store import Session

COLUMNS = (
    "id",
    "name",
    "kind",
    "scan",
    "quantity",
    "value",
    "unit",
    "U (k = 2)",
    "calibration in U",
    "state",
    "time",
)
_FOLDER = f"{Measurement.kind}/"


def load_measurements(session: SessionLike) -> list[Stored[Measurement]]:
    """Load all measurements, in the order in which they were made; stale where their inputs have
    changed."""
    with opened(session) as store:
        return list_records(store, Measurement)


def section_lines(session: SessionLike, name: str) -> tuple[CutPlane, list[np.ndarray]]:
    """Load the plane of a saved section, and its lines (k, 2) mm: along, and up."""
    with opened(session) as store:
        measured = load_stored(store, Measurement, name)
        if measured.record.plane is None:
            raise InputError(
                f"{measured.label} is a {measured.record.what}, not a section: choose a section"
            )
        arrays = load_arrays(store, f"{_FOLDER}{name}")
    lines = np.split(arrays["lines"].astype(np.float64), np.cumsum(arrays["lengths"])[:-1])
    return from_plain(to_plain(measured.record.plane), CutPlane), lines


def describe_measurement(measured: Stored[Measurement]) -> str:
    """A measurement as one line of text."""
    mark = "  [stale: measured on what has since changed]" if measured.stale else ""
    return f"{measured.name:<4} {measured.label}: {measured.record.summary()}{mark}"


def format_measurements(found: Sequence[Stored[Measurement]]) -> str:
    """Return measurements as comma-separated values, one row a quantity; U where it is known."""
    rows: list[Iterable[object]] = [COLUMNS]
    for each in found:
        record, state = each.record, "stale" if each.stale else "fresh"
        for q in record.quantities:
            known = ("", "") if q.U is None else (f"{q.U:.6g}", "yes" if q.whole else "no")
            value = (q.name, f"{q.value:.6f}", q.unit, *known)
            rows.append(
                [each.name, each.label, record.what, record.source, *value, state, record.time]
            )
    return format_csv(rows)


def export_measurements(session: SessionLike, out: Path | str) -> int:
    """Write all measurements to a CSV file; returns how many it holds."""
    out = Path(out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out.name} is not a table: end its name in .csv")
    found = load_measurements(session)
    replace_file(out.absolute(), format_measurements(found).encode("utf-8-sig"))
    return len(found)


def rename_measurement(store: Session, name: str, label: str) -> Stored[Measurement]:
    """Call a measurement otherwise; an empty label restores its original one."""
    load_stored(store, Measurement, name)
    store.decide(
        Measurement.labels, {**(store.decision(Measurement.labels) or {}), name: clean_label(label)}
    )
    return load_stored(store, Measurement, name)


def trash_measurement(store: Session, name: str) -> None:
    """Move a measurement to the trash; ``restore_measurement`` brings it back. What was made from
    it becomes stale."""
    load_stored(store, Measurement, name)
    store.trash_result(f"{_FOLDER}{name}")


def restore_measurement(store: Session, name: str = "") -> Stored[Measurement]:
    """Bring a deleted measurement back, by default the last one deleted. Raises InputError where
    there is none."""
    if not name:
        deleted = [each for each in store.deleted_results() if each.startswith(_FOLDER)]
        if not deleted:
            raise InputError("no measurement was deleted, so none can be restored: measure again")
        name = deleted[0].removeprefix(_FOLDER)
    store.restore_last(f"{_FOLDER}{name}")
    return load_stored(store, Measurement, name)


def edit_measurements(
    session: SessionLike,
    *,
    relate: tuple[str, str] | None = None,
    name: tuple[str, str] | None = None,
    delete: Sequence[str] = (),
    bring_back: bool = False,
    csv: Path | None = None,
    warn: Warn = ignore_warnings,
) -> str:
    """List the measurements that a session holds.

    Args:
        session: Session folder.
        relate: Two of them, such as m1 m2: their distances and angles are measured too.
        name: One of them, and what to call it from now on.
        delete: Some of them, to the trash.
        bring_back: Undo the last deletion.
        csv: Write them all to this table too.
    """
    if not (relate or name or delete or bring_back):
        return _list_measurements(session, csv)
    with opened(session, write=True) as store:
        if relate:
            for note in measure_relation(store, *relate).notes:
                warn(note)
        if name:
            rename_measurement(store, *name)
        for each in delete:
            trash_measurement(store, each)
        if bring_back:
            restore_measurement(store)
        return _list_measurements(store, csv)


def _list_measurements(session: SessionLike, csv: Path | None) -> str:
    """Return the session's measurements as text, and write them to a CSV file where one is
    given."""
    lines = [describe_measurement(each) for each in load_measurements(session)] or [
        "nothing was measured yet"
    ]
    if csv is not None:
        lines.append(f"{export_measurements(session, csv)} measurements -> {csv}")
    return "\n".join(lines)
