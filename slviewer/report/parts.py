"""The report on many parts: the table of part by characteristic, capability, and a trend chart of
each."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer.evaluation.capability import Capability
from slviewer.evaluation.render import format_count
from slviewer.inspection.parts import CharacteristicResult, PartResult
from slviewer.records.acceptance import Decision
from slviewer.records.table import Cell, Column, Mark, Table
from slviewer.report.canvas import HALF, INK, SOFT, finish_figure, new_figure, style_axes
from slviewer.report.page import Figure, Headline, PageNotice, Section, write_page
from slviewer.report.tables import UNKNOWN, format_number
from slviewer.session.inspection_plan import Characteristic, Plan

MARKS: dict[Decision, Mark] = {"pass": "better", "fail": "worse", "undecided": "strong"}
COLOURS: dict[Decision, str] = {"pass": "#1f9673", "fail": "#c2362e", "undecided": "#c98a12"}
COLUMNS_PER_TABLE = 6


def write_parts_page(
    path: Path,
    plan: Plan,
    parts: Sequence[PartResult],
    capabilities: Sequence[Capability | None],
    rule: str,
) -> None:
    """Write the report on parts as one HTML file."""
    counts = {decision: sum(each.decision == decision for each in parts) for decision in MARKS}
    headlines = [
        Headline(str(len(parts)), "parts"),
        *(
            Headline(str(count), decision, "", _headline_mark(decision, count))
            for decision, count in counts.items()
        ),
    ]
    unmeasured: dict[tuple[str, str], list[str]] = {}
    for each in parts:
        for result in each.results:
            if result.reason:
                unmeasured.setdefault((result.name, result.reason), []).append(each.part)
    reasons = [
        PageNotice(f"{name}: {why} ({', '.join(named)})")
        for (name, why), named in unmeasured.items()
    ]
    whole = all(result.whole for each in parts for result in each.results)
    partial = (
        []
        if whole
        else [
            "Some U hold no part of the calibration's uncertainty: the model does not predict it."
        ]
    )
    charts = [
        _trend_chart(wanted, [each.part for each in parts], [each.results[k] for each in parts])
        for k, wanted in enumerate(plan.characteristic)
    ]
    sections = [
        Section(
            "Parts and characteristics",
            [rule[0].upper() + rule[1:] + ".", *partial],
            _part_tables(plan, parts),
        ),
        Section(
            "Capability",
            "Cp and Cpk with their 95 % confidence intervals; the spread of the values includes the"
            " measurement's.",
            [_capability_table(plan, capabilities)],
        ),
        Section(
            "Trends",
            "Values with U (k = 2) in the order of the parts; lines are the limits.",
            charts,
        ),
    ]
    if reasons:
        sections.insert(1, Section("Not measured", "", reasons))
    subtitle = format_count(len(plan.characteristic), "characteristic")
    frame = "in the camera's frame" if plan.alignment.kind == "none" else "in part coordinates"
    write_page(path, f"Inspection: {plan.name}", subtitle, headlines, sections, frame=frame)


def _headline_mark(decision: Decision, count: int) -> Mark:
    """The mark of how many parts have a decision."""
    return "" if decision == "undecided" or (decision == "fail" and not count) else MARKS[decision]


def _part_tables(plan: Plan, parts: Sequence[PartResult]) -> list[Table]:
    """Tables of part by characteristic, a few columns each, so that they fit a page."""
    tables = []
    wanted = plan.characteristic
    for start in range(0, len(wanted), COLUMNS_PER_TABLE):
        some = range(start, min(start + COLUMNS_PER_TABLE, len(wanted)))
        columns = [Column("part", align="left"), Column("part is", align="left")]
        columns += [Column(wanted[k].name, wanted[k].unit) for k in some]
        rows = [
            [
                each.part,
                Cell(each.decision, MARKS[each.decision]),
                *(_value_cell(each.results[k]) for k in some),
            ]
            for each in parts
        ]
        footer = [
            [
                name,
                "",
                *(UNKNOWN if (v := getattr(wanted[k], name)) is None else f"{v:g}" for k in some),
            ]
            for name in ("lower", "nominal", "upper")
        ]
        last = (
            f"{some.start + 1} to {some.stop} of {len(wanted)}"
            if len(wanted) > COLUMNS_PER_TABLE
            else "all"
        )
        tables.append(Table(columns, rows, f"Characteristics, {last}", footer=footer))
    return tables


def _value_cell(result: CharacteristicResult) -> str | Cell:
    """A value with its U and decision."""
    if result.value is None or result.U is None:
        return Cell("not measured", "strong")
    text = f"{result.value:.4f} ± {result.U:.4f}".replace("-", "−")
    return Cell(
        text if result.decision == "pass" else f"{text} {result.decision}", MARKS[result.decision]
    )


def _capability_table(plan: Plan, capabilities: Sequence[Capability | None]) -> Table:
    """Table of mean, standard deviation, Cp and Cpk of each characteristic."""
    titles = ("parts", "mean", "std. dev.", "Cp", "95 % interval", "Cpk", "95 % interval")
    rows: list[list[str | Cell]] = []
    for wanted, c in zip(plan.characteristic, capabilities, strict=True):
        if c is None:
            rows.append([wanted.name, wanted.unit, *([UNKNOWN] * len(titles))])
            continue
        row: list[str | Cell] = [wanted.name, wanted.unit, str(c.parts), format_number(c.mean, 4)]
        row.append(format_number(c.sigma, 4))
        for index in (c.cp, c.cpk):
            row += (
                [UNKNOWN, UNKNOWN]
                if index is None
                else [f"{index[0]:.2f}", f"{index[1]:.2f} to {index[2]:.2f}"]
            )
        rows.append(row)
    columns = [
        Column("characteristic", align="left"),
        Column("unit", align="left"),
        *(Column(t) for t in titles),
    ]
    note = "A dash: fewer than 3 parts, no limit, or values that do not vary; Cp needs both limits."
    return Table(columns, rows, "Capability", [note])


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
