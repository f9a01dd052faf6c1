"""HTML of measurements: the list, one in full, and a deviation with its verdict and histogram."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slviewer.gui.measure_drawing import format_quantity
from slviewer.gui.pictures import PLOT_PX
from slviewer.gui.widgets import Html, Tone, alert, colour_bar, coloured, paragraph, table, to_html
from slviewer.inspection.colours import deviation_colours
from slviewer.inspection.tolerance import DECIDED
from slviewer.report.canvas import finish_figure, new_figure, style_axes
from slviewer.report.measurements import draw_deviations
from slviewer.report.page import Figure
from slviewer.session.measurements import Measurement

_HEADLINES = {"point": 3}
"""How many of a measurement's quantities the list shows; 2 by default."""
_TONES: dict[str, Tone] = {"pass": "good", "fail": "error", "undecided": "warning"}
_COMPLETE = "±: expanded uncertainty, k = 2."
_PARTIAL = "*: without the unknown part of the calibration."
_HIGH = 230


def measurements_table(
    measured: Sequence[Measurement], chosen: str, labels: Mapping[str, str]
) -> Html:
    """Return a table of all measurements with kind and surface; ``labels``: {scan: the operator's
    name}."""
    rows: list[tuple[object, object, object]] = []
    for each in reversed(measured):
        name = coloured(each.name, "warning" if each.stale else "plain", bold=each.id == chosen)
        on = labels.get(each.source, each.source)
        about = coloured(
            f"{each.kind} on {on}" + (", stale" if each.stale else ""),
            "warning" if each.stale else "dim",
        )
        for i, quantity in enumerate(each.quantities[: _HEADLINES.get(each.kind, 2)]):
            rows.append(
                (
                    Html(f"{name}<br>{about}") if i == 0 else "",
                    quantity.name,
                    format_quantity(quantity),
                )
            )
    return Html(table(("Result", "", "Value"), rows) + _format_notes(measured))


def measurement_html(measured: Measurement, labels: Mapping[str, str]) -> Html:
    """Return all quantities of one measurement, with its source and warnings."""
    on = labels.get(measured.source, measured.source)
    rows = [(quantity.name, format_quantity(quantity)) for quantity in measured.quantities]
    about = f"{measured.kind} on {on}, by {measured.model}"
    if where := measured.data.get("where"):
        about += f"; {where}"
    html = Html(
        table((measured.name, ""), rows)
        + paragraph(coloured(f"{about}.", "dim"))
        + _format_notes([measured])
    )
    for warning in measured.data.get("fit", {}).get("warnings", ()):
        html = Html(html + alert(f"{warning[:1].upper()}{warning[1:]}.", "warning"))
    if measured.stale:
        html = Html(
            alert("Out of date: the measured surface has changed; measure again.", "warning") + html
        )
    return html


def deviation_html(data: Mapping[str, Any]) -> Html:
    """Return a deviation's verdict, and the number of points evaluated."""
    verdict, numbers = data["verdict"], data["statistics_mm"]
    html = Html("")
    if verdict is not None:
        text = f"Tolerance ± {verdict['tolerance_mm']:g} mm: {DECIDED[verdict['decision']]}"
        U = verdict["U_mm"]
        html = Html(
            alert(Html(f"<b>{to_html(text)}</b>"), _TONES[verdict["decision"]])
            + table(
                ("Points", "Share"),
                [
                    (f"Within by more than U = {U:.3f} mm", f"{verdict['inside']:.2f} %"),
                    ("Undecided", f"{verdict['close']:.2f} %"),
                    ("Outside by more than U", f"{verdict['outside']:.2f} %"),
                ],
            )
        )
    excluded = numbers["left_out"] / max(numbers["points"] + numbers["left_out"], 1)
    about = (
        f"{numbers['points']:,} points; {100 * excluded:.1f} % excluded: beyond"
        f" {data['reach_mm']:.3g} mm, or facing another direction."
    )
    return Html(html + paragraph(coloured(about, "dim")))


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


def _format_notes(measured: Sequence[Measurement]) -> str:
    """Return a note on the uncertainties of the measurements; empty where none is known."""
    known = [
        quantity for each in measured for quantity in each.quantities if quantity.U is not None
    ]
    if not known:
        return ""
    return paragraph(
        coloured(
            _COMPLETE if all(quantity.whole for quantity in known) else f"{_COMPLETE} {_PARTIAL}",
            "dim",
        )
    )
