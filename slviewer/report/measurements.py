"""Measurements on scans, and deviations of scans from nominal models: tables, sections, coloured
surfaces."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slviewer.inspection.colours import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.inspection.tolerance import DECIDED, RULE
from slviewer.records.table import Cell, Column, Mark, Table
from slviewer.report.canvas import (
    DENSITY,
    FULL,
    SOFT,
    TEXT_PT,
    add_colour_bar,
    add_legend,
    finish_figure,
    new_figure,
    round_up,
    style_axes,
    style_image_axes,
)
from slviewer.report.page import Figure, Item, PageNotice, Section
from slviewer.report.shaded import render_points, view_rotation
from slviewer.report.tables import UNKNOWN, format_number
from slviewer.session.measurements import Measurement

Lines = Sequence[NDArray[np.floating]]
YAW_DEG, PITCH_DEG = 12.0, 10.0
PICTURE = (560, 420)
LINE = "#2270b8"
TOLERANCE = "#b3261e"
MARKS: dict[str, Mark] = {"pass": "better", "fail": "worse", "undecided": "strong"}
CURSOR_COLOURS = ("#b3261e", "#1f9673", "#7b5cc4")
LEAST_HIGH, MOST_HIGH = 220, 460
FLAT = 0.1
"""Height over length of a section below which heights are enlarged, to be visible at all."""
MOST_DRAWN = 4000


def measurements_section(
    rows: Sequence[Measurement], sections: Sequence[tuple[str, Lines]]
) -> Section:
    """The section with every measurement, its unit and uncertainty, and a plot of each
    cross-section."""
    items: list[Item] = [
        PageNotice(f"{row.name} is out of date: its surface has changed. Measure again.")
        for row in rows
        if row.stale
    ]
    items += [
        PageNotice(f"{row.name}: {note}.")
        for row in rows
        for note in row.data.get("fit", {}).get("warnings", ())
    ]
    body = [cells for row in rows for cells in _measurement_rows(row)]
    columns = [
        Column("measurement", align="left"),
        Column("kind", align="left"),
        Column("scan", align="left"),
    ]
    columns += [Column("quantity", align="left"), Column("value"), Column("unit", align="left")]
    columns += [Column("U, k = 2"), Column("of", align="left")]
    notes = [
        "U is the expanded uncertainty: the scatter of the points, and the calibration's"
        " uncertainty. –: a residual or a plain reading, which has none."
    ]
    if any(q.U is not None and not q.whole for row in rows for q in row.quantities):
        notes.append("* without the calibration's part, which is unknown.")
    if body:
        items.append(Table(columns, body, "Measured on the scans", notes))
    items += [section_plot(name, lines) for name, lines in sections]
    return Section("Measurements", "Distances, fitted shapes and their relations.", items)


def _measurement_rows(measured: Measurement) -> Iterator[list[str | Cell]]:
    """Yield the cells of each quantity of a measurement; what they share stands in the first
    row."""
    name = Cell(f"{measured.name} (stale)", "worse") if measured.stale else measured.name
    named: list[str | Cell] = [name, measured.kind, measured.source]
    data = measured.data
    where = " and ".join(data["between"]) if "between" in data else data.get("where", "")
    for q in measured.quantities:
        digits = 1 if q.unit == "%" else 4
        U = UNKNOWN if q.U is None else f"{q.U:.{digits}f}{'' if q.whole else ' *'}"
        unit = "°" if q.unit == "deg" else q.unit
        yield [*named, q.name, format_number(q.value, digits), unit, U, where]
        named, where = ["", "", ""], ""


def section_plot(
    name: str,
    lines: Lines,
    cursors: Mapping[str, NDArray[np.floating]] | None = None,
    *,
    width: int = FULL,
) -> Figure:
    """The lines (k, 2) mm of a section, along and up, with named ``cursors`` (2,) mm; heights of
    flat ones enlarged."""
    length, height = np.maximum(np.ptp(np.concatenate(lines), axis=0), 1e-6)
    enlarged = height < FLAT * length
    high = int(np.clip(width * height / length + 90, LEAST_HIGH, MOST_HIGH))
    drawing = new_figure(width, high)
    axes = drawing.subplots()
    style_axes(axes, name if cursors is None else "", "along, mm", "height, mm")
    for line in lines:
        axes.plot(*line[:: max(1, len(line) // MOST_DRAWN)].T, color=LINE, linewidth=1.3)
    for (letter, cursor), colour in zip((cursors or {}).items(), CURSOR_COLOURS, strict=False):
        axes.axvline(cursor[0], color=colour, linewidth=0.9, linestyle=":")
        axes.plot(*cursor, "o", color=colour, markersize=5)
        axes.annotate(
            letter,
            cursor,
            (4, 5),
            textcoords="offset points",
            color=colour,
            fontsize=10,
            weight="bold",
        )
    axes.set_aspect("auto" if enlarged else "equal", adjustable="datalim")
    axes.margins(y=0.15)
    return finish_figure(
        drawing,
        f"{name}: section through the picked points and the camera; up: towards the camera; "
        f"{'heights are enlarged' if enlarged else 'equal scales'}.",
        f"Section {name}, {length:.1f} mm long and {height:.2f} mm high",
    )


def deviations_section(
    deviations: Sequence[tuple[Measurement, Mapping[str, np.ndarray]]],
) -> Section:
    """Return the section with each comparison with a nominal model: verdict, picture and
    statistics."""
    items: list[Item] = []
    for measured, arrays in deviations:
        items += _deviation_items(measured, arrays)
    text = (
        "Scans against nominal models, after the best fit of the one to the other: distances from"
        " the nominal surface, positive outside it. The tolerance is " + RULE + "."
    )
    return Section("Deviation from nominal", text, items)


def _deviation_items(view: Measurement, arrays: Mapping[str, np.ndarray]) -> list[Item]:
    """Verdict, notices, pictures and table of one comparison with a nominal model."""
    verdict = view.data["verdict"]
    items: list[Item] = []
    if verdict is not None:
        words = DECIDED[verdict["decision"]]
        kind = {"pass": "good", "fail": "warning", "undecided": "warning"}[verdict["decision"]]
        items.append(
            PageNotice(f"{view.name}, tolerance ± {verdict['tolerance_mm']:g} mm: {words}.", kind)  # type: ignore[arg-type]
        )
    if view.stale:
        items.append(
            PageNotice(
                f"{view.name}: the scan or its calibration has changed since; compare it again."
            )
        )
    items += [draw_deviation(view, arrays), _deviation_table(view)]
    return items


def _deviation_table(view: Measurement) -> Table:
    """Table of the statistics of one comparison, with the decision for each where a tolerance is
    set."""
    data, verdict = view.data, view.data["verdict"]
    numbers = data["statistics_mm"]
    columns = [Column("quantity", align="left"), Column("value"), Column("unit", align="left")]
    columns.append(Column("decision", align="left"))

    def end(key: str) -> str | Cell:
        """The cell with the decision for a statistic; empty without a tolerance."""
        return "" if verdict is None else _decision_cell(verdict[key][1])

    rows: list[list[str | Cell]] = [
        ["mean", format_number(numbers["mean"], 4, signed=True), "mm", ""],
        ["RMS", format_number(numbers["rms"], 4), "mm", ""],
        ["RMS of the scan's noise alone", format_number(data["noise_mm"], 4), "mm", ""],
        [
            "95 % of the points deviate by less than",
            format_number(numbers["within_95"], 4),
            "mm",
            "",
        ],
        [
            "range of 99.7 % of the points, lower end",
            format_number(numbers["p_low"], 4, signed=True),
            "mm",
            end("lowest"),
        ],
        [
            "range of 99.7 % of the points, upper end",
            format_number(numbers["p_high"], 4, signed=True),
            "mm",
            end("highest"),
        ],
        [
            "lowest, highest point",
            f"{numbers['lowest']:+.3f}, {numbers['highest']:+.3f}".replace("-", "−"),
            "mm",
            "",
        ],
    ]
    if verdict is not None:
        rows += [
            [
                "expanded uncertainty U of a point, k = 2",
                format_number(verdict["U_mm"], 4),
                "mm",
                "",
            ],
            [
                f"within ± {verdict['tolerance_mm']:g} mm",
                format_number(verdict["within"], 2),
                "%",
                "",
            ],
            ["inside by more than U", format_number(verdict["inside"], 2), "%", ""],
            ["outside by more than U", format_number(verdict["outside"], 2), "%", ""],
            ["undecided", format_number(verdict["close"], 2), "%", ""],
        ]
    rows.append(
        ["area of the nominal that was measured", format_number(100 * data["coverage"], 1), "%", ""]
    )
    share = 100 * numbers["left_out"] / max(numbers["points"] + numbers["left_out"], 1)
    notes = [
        f"{numbers['points']:,} points. {numbers['left_out']:,} ({share:.1f} %) lie farther than"
        f" {data['reach_mm']:.3g} mm from the nominal or face another direction, and are excluded."
        f" The best fit adds {data['alignment_mm']:.4f} mm (1 sigma)."
    ]
    return Table(columns, rows, f"{view.source} against {view.data['nominal']['name']}", notes)


def _decision_cell(decision: str) -> Cell:
    """Return the table cell of a decision, with its colour: pass, fail or undecided."""
    return Cell(DECIDED[decision], MARKS[decision])  # type: ignore[index]


def draw_deviations(
    axes: Any, edges: np.ndarray, counts: np.ndarray, limit: float, tolerance: float | None
) -> None:
    """Draw the histogram of deviations as bars of counts (n,) between edges (n + 1,) mm, as shares
    of all.

    The bars have the colours of the surface, whose scale ends at ``limit`` mm; lines mark plus and
    minus ``tolerance`` mm.
    """
    middles = (edges[1:] + edges[:-1]) / 2
    axes.bar(
        middles,
        100 * counts / max(counts.sum(), 1),
        0.98 * np.diff(edges),
        color=deviation_colours(middles, limit) / 255,
        edgecolor="#9aa6b2",
        linewidth=0.3,
    )
    if tolerance is not None:
        for side in (-tolerance, tolerance):
            axes.axvline(side, color=TOLERANCE, linewidth=1.2, linestyle="--")
        axes.plot(
            [],
            [],
            color=TOLERANCE,
            linewidth=1.2,
            linestyle="--",
            label=f"tolerance ± {tolerance:g} mm",
        )
        add_legend(axes, loc="lower right", bbox_to_anchor=(1, 1.0), borderaxespad=0.2)


def draw_deviation(view: Measurement, arrays: Mapping[str, np.ndarray]) -> Figure:
    """Figure of the scan coloured by its deviation, unmeasured parts of the nominal in grey, and
    the histogram.

    ``arrays``: some ``points`` (n, 3) mm of the scan with the nominal's ``normals`` there and
    ``signed`` (n,) mm deviations; ``uncovered`` (k, 3) mm; ``counts`` (m,) of all points between
    ``edges`` (m + 1,) mm.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    verdict = view.data["verdict"]
    tolerance = None if verdict is None else float(verdict["tolerance_mm"])
    limit = colour_limit(arrays["signed"], tolerance)
    limit = round_up(limit) if tolerance is None else limit
    palette = ListedColormap(deviation_colours(np.linspace(-1, 1, 255), 1.0) / 255)
    drawing = new_figure(FULL, 480)
    left, right = drawing.subplots(1, 2, width_ratios=(1.35, 1))
    width, height = PICTURE
    points = np.concatenate([arrays["points"], arrays["uncovered"]]).astype(np.float64)
    normals = np.concatenate([arrays["normals"], np.full(arrays["uncovered"].shape, np.nan)])
    grey = np.broadcast_to(np.array(EXCLUDED_COLOUR, np.uint8), arrays["uncovered"].shape)
    colours = np.concatenate([deviation_colours(arrays["signed"], limit), grey]) / 255.0
    style_image_axes(left, f"{view.source} against {view.data['nominal']['name']}")
    left.imshow(
        render_points(
            points,
            normals,
            colours,
            (DENSITY * width, DENSITY * height),
            view_rotation(YAW_DEG, PITCH_DEG),
        )
    )
    mapped = ScalarMappable(Normalize(-limit, limit), palette)
    add_colour_bar(
        drawing, mapped, left, "deviation, mm", location="bottom", shrink=0.7, aspect=40, pad=0.02
    )
    numbers = view.data["statistics_mm"]
    style_axes(right, f"RMS {numbers['rms']:.4f} mm", "deviation, mm", "points, %")
    edges = arrays["edges"]
    draw_deviations(right, edges, arrays["counts"], limit, tolerance)
    far = max(edges[-1], 0.0 if tolerance is None else 1.15 * tolerance)
    right.set_xlim(-far, far)
    left.set_xlabel(
        "grey: parts of the nominal that were not measured",
        fontsize=TEXT_PT,
        color=SOFT,
        loc="left",
    )
    return finish_figure(
        drawing,
        f"{view.name}: red lies outside the nominal surface, blue inside it. Right: the "
        "distribution of the deviations.",
        f"{view.source} coloured by its deviation from {view.data['nominal']['name']}, with their"
        " histogram",
    )
