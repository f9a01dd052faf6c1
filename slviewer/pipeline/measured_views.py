"""A session's measurements as its report shows them."""

from typing import Any

from slviewer.inspection.quantities import Quantity
from slviewer.pipeline.measurements import measurements, quantities_of, section_lines
from slviewer.report.data import DeviationView, MeasurementRow, Reading, SectionView
from slviewer.session.measurements import Measurement, measurement_arrays
from slviewer.session.store import Session

UNITS = {"deg": "°"}
MOST_DRAWN = 6
"""Sections, and comparisons with nominal models, that are drawn, the last ones; the CSV holds all."""


def measured_views(store: Session) -> dict[str, Any]:
    """``measurements``, ``sections`` and ``deviations`` of a report's data."""
    every = measurements(store)
    sections = [each for each in every if each.kind == "section"]
    deviations = [each for each in every if each.kind == "deviation"]
    return {
        "measurements": [_row(each) for each in every if each.kind != "deviation"],
        "sections": [SectionView(each.name, section_lines(store, each.id)[1]) for each in sections[-MOST_DRAWN:]],
        "deviations": [_deviation(store, each) for each in deviations[-MOST_DRAWN:]],
    }


def _row(measured: Measurement) -> MeasurementRow:
    data = measured.data
    where = data.get("where", "")
    if "between" in data:
        where = " and ".join(data["between"])
    notes = tuple(data["fit"]["warnings"]) if "fit" in data else ()
    readings = [_reading(quantity) for quantity in quantities_of(measured)]
    return MeasurementRow(measured.name, measured.kind, measured.source, readings, where, notes, measured.stale)


def _reading(quantity: Quantity) -> Reading:
    return Reading(quantity.name, quantity.value, UNITS.get(quantity.unit, quantity.unit), quantity.U, quantity.whole)


def _deviation(store: Session, measured: Measurement) -> DeviationView:
    arrays = measurement_arrays(store, measured.id)
    return DeviationView(
        name=measured.name,
        source=measured.source,
        nominal=measured.data["nominal"]["name"],
        found=measured.data,
        stale=measured.stale,
        **arrays,
    )
