"""HTML of measurements: the list, one in full, and the histogram of a deviation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from slviewer.gui.pictures import PLOT_PX
from slviewer.gui.widgets import (
    Html,
    Tone,
    alert,
    colour_bar,
    coloured,
    paragraph,
    records_html,
    relabel,
    report_table,
    to_html,
)
from slviewer.inspection.deviation import deviation_colours
from slviewer.pipeline.stored_records import Stored
from slviewer.records.measurement import Measurement, list_quantities
from slviewer.report.canvas import finish_figure, new_figure, style_axes
from slviewer.report.page import Figure
from slviewer.report.surfaces import draw_deviations

_TONES: dict[str, Tone] = {"pass": "good", "fail": "error", "undecided": "warning"}
_HIGH = 230


def measurements_table(measured: Sequence[Stored[Measurement]], labels: Mapping[str, str]) -> Html:
    """Return a table of all measurements, the latest first; ``labels``: {scan: the operator's
    name}."""
    named = {
        f"{each.label} ({each.name}{', stale' if each.stale else ''})": each.record
        for each in reversed(measured)
    }
    listed = relabel(list_quantities(named), labels)
    # a panel is too narrow for a column of scans
    rows = [[f"{name} on {scan}", what, scan, *rest] for name, what, scan, *rest in listed.rows]
    shown = [column for column in listed.columns if column.title != "scan"]
    return report_table(replace(listed, rows=rows).select(shown))


def measurement_html(measured: Stored[Measurement], labels: Mapping[str, str]) -> Html:
    """Return all figures of one measurement, with its source and warnings."""
    record = measured.record
    about = f"{record.what} on {labels.get(record.source, record.source)}, by {record.model}"
    about += f"; {record.where}." if record.where else "."
    html = Html(records_html([measured], labels, named=False) + paragraph(coloured(about, "dim")))
    if record.deviation is not None and (verdict := record.deviation.verdict) is not None:
        html = Html(
            alert(Html(f"<b>{to_html(verdict.text())}</b>"), _TONES[verdict.decision]) + html
        )
    if measured.stale:
        html = Html(
            alert("Out of date: the measured surface has changed; measure again.", "warning") + html
        )
    return html


def deviation_bar(limit: float) -> Html:
    """Return the legend of a surface coloured by its deviation, ± `limit` mm."""
    title = "deviation; red: outside, blue: inside, grey: not measured"
    return colour_bar(
        f"−{limit:.3g} mm",
        f"+{limit:.3g} mm",
        deviation_colours(np.linspace(-1, 1, 13), 1.0),
        title,
    )


def deviation_figure(
    name: str, edges: np.ndarray, counts: np.ndarray, limit: float, tolerance: float | None
) -> Figure:
    """Plot the histogram of the deviations: edges (n + 1,) mm and counts (n,)."""
    drawing = new_figure(PLOT_PX, _HIGH)
    axes = drawing.subplots()
    style_axes(axes, "", "deviation, mm", "points, %")
    draw_deviations(axes, edges, counts, limit, tolerance)
    if tolerance is not None:
        far = max(float(edges[-1]), 1.15 * tolerance)
        axes.set_xlim(-far, far)
    return finish_figure(drawing, "Histogram of the deviations.", name)
