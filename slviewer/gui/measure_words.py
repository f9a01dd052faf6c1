"""Measurements in words: the list, one in full, and a deviation with its verdict and histogram."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slviewer.gui.measure_drawing import value_words
from slviewer.gui.pictures import PLOT_PX
from slviewer.gui.widgets import Html, Tone, block, boxed, cell, table, toned
from slviewer.inspection.colours import deviation_colours
from slviewer.inspection.tolerance import DECIDED
from slviewer.pipeline.measurements import quantities_of
from slviewer.report.canvas import finish_figure, new_figure, style_axes
from slviewer.report.measurements import draw_deviations
from slviewer.report.page import Figure
from slviewer.session.measurements import Measurement

_HEADLINES = {"point": 3, "deviation": 2}
"""How many of a measurement's numbers the list shows, two where nothing is said."""
_TONES: dict[str, Tone] = {"pass": "good", "fail": "error", "undecided": "warning"}
_WHOLE = "± is the expanded uncertainty, k = 2."
_PART = "* without the calibration's part, which this calibration does not know."
_HIGH = 230


def measurements_table(measured: Sequence[Measurement], chosen: str, labels: Mapping[str, str]) -> Html:
    """Every measurement with what it is about; ``labels``: what scans are called."""
    rows: list[tuple[object, object, object]] = []
    for each in reversed(measured):
        name = toned(each.name, "warning" if each.stale else "plain", bold=each.id == chosen)
        on = labels.get(each.source, each.source)
        about = toned(f"{each.kind} on {on}" + (", stale" if each.stale else ""), "warning" if each.stale else "dim")
        for i, quantity in enumerate(quantities_of(each)[: _HEADLINES.get(each.kind, 2)]):
            rows.append((Html(f"{name}<br>{about}") if i == 0 else "", quantity.name, _unbroken(value_words(quantity))))
    return Html(table(("Measurement", "", "value"), rows) + _notes(measured))


def measurement_words(measured: Measurement, labels: Mapping[str, str]) -> Html:
    """One measurement in full."""
    on = labels.get(measured.source, measured.source)
    rows = [(quantity.name, _unbroken(value_words(quantity))) for quantity in quantities_of(measured)]
    about = f"{measured.kind} on {on}, by {measured.model}"
    if where := measured.data.get("where"):
        about += f"; {where}"
    said = Html(table((measured.name, ""), rows) + block(toned(f"{about}.", "dim")) + _notes([measured]))
    for warning in measured.data.get("fit", {}).get("warnings", ()):
        said = Html(said + boxed(f"{warning[:1].upper()}{warning[1:]}.", "warning"))
    if measured.stale:
        said = Html(boxed("Stale: what it was measured on has changed since; measure it again.", "warning") + said)
    return said


def verdict_words(data: Mapping[str, Any]) -> Html:
    """A deviation's verdict in a box, and what was counted."""
    verdict, numbers = data["verdict"], data["statistics_mm"]
    said = Html("")
    if verdict is not None:
        words = f"Tolerance ± {verdict['tolerance_mm']:g} mm: {DECIDED[verdict['decision']]}"
        U = verdict["U_mm"]
        said = Html(
            boxed(Html(f"<b>{cell(words)}</b>"), _TONES[verdict["decision"]])
            + table(
                ("Points", "share"),
                [
                    (f"inside by more than U = {U:.3f} mm", f"{verdict['inside']:.2f} %"),
                    ("too close to tell", f"{verdict['close']:.2f} %"),
                    ("outside by more than U", f"{verdict['outside']:.2f} %"),
                ],
            )
        )
    left = numbers["left_out"] / max(numbers["points"] + numbers["left_out"], 1)
    about = (
        f"{numbers['points']:,} points; {100 * left:.1f} % lie farther than {data['reach_mm']:.3g} mm off or face "
        "another way, and are left out."
    )
    return Html(said + block(toned(about, "dim")))


def deviation_bar(limit: float) -> Html:
    """The legend of a surface that is coloured by its deviation."""
    stops = ",".join(f"rgb{tuple(int(c) for c in rgb)}" for rgb in deviation_colours(np.linspace(-1, 1, 13), 1.0))
    return block(
        Html(
            f'<div style="display:flex;gap:0.6em;align-items:center"><span>−{limit:.3g} mm</span>'
            f'<div style="flex:1;height:10px;border-radius:3px;background:linear-gradient(90deg,{stops})"></div>'
            f"<span>+{limit:.3g} mm</span></div>"
            '<div style="text-align:center">deviation; red: outside the nominal, blue: inside, grey: not measured</div>'
        )
    )


def deviation_figure(name: str, edges: np.ndarray, counts: np.ndarray, limit: float, tolerance: float | None) -> Figure:
    """How many of the points lie how far off: edges (n + 1,) mm and counts (n,)."""
    drawing = new_figure(PLOT_PX, _HIGH)
    axes = drawing.subplots()
    style_axes(axes, "", "deviation, mm", "points, %")
    draw_deviations(axes, edges, counts, limit, tolerance)
    if tolerance is not None:
        far = max(float(edges[-1]), 1.15 * tolerance)
        axes.set_xlim(-far, far)
    return finish_figure(drawing, "How many of the points lie how far off the nominal.", name)


def _notes(measured: Sequence[Measurement]) -> str:
    found = [quantity for each in measured for quantity in quantities_of(each) if quantity.U is not None]
    if not found:
        return ""
    return block(toned(_WHOLE if all(quantity.whole for quantity in found) else f"{_WHOLE} {_PART}", "dim"))


def _unbroken(text: str) -> Html:
    return Html(f'<span style="white-space:nowrap">{cell(text)}</span>')
