"""The report on many parts: the table of part by characteristic, capability, and a trend chart of
each."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer.evaluation.render import format_count
from slviewer.records.acceptance import MARKS, Decision
from slviewer.records.inspection import Characteristic, CharacteristicResult, Inspection
from slviewer.report.canvas import HALF, INK, SOFT, finish_figure, new_figure, style_axes
from slviewer.report.page import Figure, Headline, Section, write_page

COLOURS: dict[Decision, str] = {"pass": "#1f9673", "fail": "#c2362e", "undecided": "#c98a12"}


def write_parts_page(path: Path, found: Inspection) -> None:
    """Write the report on parts as one HTML file."""
    headlines = [Headline(str(len(found.parts)), "parts")]
    for decision, count in found.count_parts().items():
        is_marked = decision == "pass" or (decision == "fail" and count)
        headlines.append(Headline(str(count), decision, "", MARKS[decision] if is_marked else ""))
    names = [each.part for each in found.parts]
    charts = [
        _trend_chart(wanted, names, [each.results[k] for each in found.parts])
        for k, wanted in enumerate(found.characteristic)
    ]
    sections = [
        Section("Parts and characteristics", "", Inspection.tables({found.plan: found})),
        Section(
            "Trends",
            "Values with U (k = 2) in the order of the parts; lines are the limits.",
            charts,
        ),
    ]
    subtitle = format_count(len(found.characteristic), "characteristic")
    frame = "in the camera's frame" if found.alignment == "none" else "in part coordinates"
    write_page(path, f"Inspection: {found.plan}", subtitle, headlines, sections, frame=frame)


def _trend_chart(
    wanted: Characteristic, names: Sequence[str], results: Sequence[CharacteristicResult]
) -> Figure:
    """The values of one characteristic over the parts, with U and the limits."""
    drawing = new_figure(HALF, 260)
    axes = drawing.add_subplot()
    style_axes(axes, wanted.name, "part", f"{wanted.kind}, {wanted.unit}")
    for decision, colour in COLOURS.items():
        at = [
            k
            for k, each in enumerate(results)
            if each.value is not None and each.decision == decision
        ]
        values, U = ([getattr(results[k], what) for k in at] for what in ("value", "U"))
        axes.errorbar(
            np.array(at) + 1,
            values,
            U,
            fmt="o",
            color=colour,
            markersize=3.6,
            linewidth=0.9,
            capsize=1.5,
        )
    for limit, style, colour in (
        (wanted.lower, "--", INK),
        (wanted.upper, "--", INK),
        (wanted.nominal, ":", SOFT),
    ):
        if limit is not None:
            axes.axhline(limit, color=colour, linewidth=0.9, linestyle=style)
    axes.set_xlim(0.5, len(results) + 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    listed = ", ".join(
        f"{k + 1} {names[k]}" for k, each in enumerate(results) if each.decision == "fail"
    )
    words = f"Fail: {listed}." if listed else "No part fails."
    return finish_figure(
        drawing,
        f"{wanted.name}. {words}",
        f"Trend of {wanted.name} over {len(results)} parts. {words}",
    )
