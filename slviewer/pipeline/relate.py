"""Distances and angles between two points or fits that were measured before."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from slviewer.errors import InputError
from slviewer.inspection.features import KINDS, Feature, relation
from slviewer.inspection.uncertainty import Spread
from slviewer.pipeline.measure import uncertainty_notes
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.stored_records import Stored, load_arrays, load_stored, next_name
from slviewer.records.measurement import Measurement
from slviewer.records.plain import from_plain, to_plain
from slviewer.session.store import Session


@dataclass(frozen=True)
class RelateSettings:
    """Which measurements are related.

    Args:
        a: A point or a fit, such as m1.
        b: Another one.
    """

    a: str
    b: str


@operation("relate", Measurement, RelateSettings)
def relate(job: Job, settings: RelateSettings) -> Iterator[Found[Measurement]]:
    """Measure the distances and angles between two points or fits.

    Raises InputError where one is neither, is stale, or is in another camera's frame.
    """
    store = job.store
    first, second = (load_stored(store, Measurement, each) for each in (settings.a, settings.b))
    if settings.a == settings.b:
        raise InputError(f"{first.label} was chosen twice: choose two measurements")
    for each in (first, second):
        if each.stale:
            raise InputError(
                f"{each.label} is stale, what it was measured on has changed: measure it again"
            )
    (one, one_spread), (other, other_spread) = (
        load_feature(store, each) for each in (first, second)
    )
    _check_frames(store, first, second)
    a, b = first.record, second.record
    record = Measurement(
        what="relation",
        name=f"{first.label} – {second.label}",
        source=", ".join(dict.fromkeys((a.source, b.source))),
        model=", ".join(dict.fromkeys((a.model, b.model))),
        quantities=relation(one, one_spread, other, other_spread),
        where=f"{first.label} and {second.label}",
        of=(settings.a, settings.b),
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        inputs=store.input_hashes(*(f"{Measurement.kind}/{each.name}" for each in (first, second))),
        scales=a.scales | b.scales,
    )
    yield Found(next_name(store, Measurement), record, notes=uncertainty_notes(store, record))


def load_feature(store: Session, measured: Stored[Measurement]) -> tuple[Feature, Spread]:
    """Load the point, plane, sphere or cylinder of a measurement, and its uncertainty."""
    found = measured.record.feature
    if found is None:
        raise InputError(
            f"{measured.label} is a {measured.record.what}: choose one of {', '.join(KINDS)}"
        )
    shared = load_arrays(store, f"{Measurement.kind}/{measured.name}").get("shared")
    shared = None if shared is None else shared.astype(np.float64)
    return from_plain(to_plain(found), Feature), Spread(
        np.array(found.scatter), shared, found.calibration
    )


def _check_frames(store: Session, a: Stored[Measurement], b: Stored[Measurement]) -> None:
    """Two scans are in one frame only while camera and calibration are the same; a merged surface
    has its own."""
    one, other = a.record, b.record
    if one.source == other.source:
        return
    if one.model != other.model or not {one.source, other.source} <= set(store.capture_names()):
        raise InputError(
            f"{a.label} was measured on {one.source} with {one.model}, {b.label} on {other.source}"
            f" with {other.model}: they do not lie in one frame; measure both on one surface"
        )
