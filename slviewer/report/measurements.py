"""Pictures of measurements on scans: sections, and surfaces coloured by their deviation from a
nominal model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slviewer.inspection.colours import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.records.measurement import NominalDeviation
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
from slviewer.report.page import Figure
from slviewer.report.shaded import render_points, view_rotation

Lines = Sequence[NDArray[np.floating]]
YAW_DEG, PITCH_DEG = 12.0, 10.0
PICTURE = (560, 420)
LINE = "#2270b8"
TOLERANCE = "#b3261e"
CURSOR_COLOURS = ("#b3261e", "#1f9673", "#7b5cc4")
LEAST_HIGH, MOST_HIGH = 220, 460
FLAT = 0.1
"""Height over length of a section below which heights are enlarged, to be visible at all."""
MOST_DRAWN = 4000


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


def draw_deviation(
    name: str, source: str, found: NominalDeviation, arrays: Mapping[str, np.ndarray]
) -> Figure:
    """Figure of the scan coloured by its deviation, unmeasured parts of the nominal in grey, and
    the histogram.

    ``arrays``: some ``points`` (n, 3) mm of the scan with the nominal's ``normals`` there and
    ``signed`` (n,) mm deviations; ``uncovered`` (k, 3) mm; ``counts`` (m,) of all points between
    ``edges`` (m + 1,) mm.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    tolerance, against = found.tolerance_mm, f"{source} against {found.nominal.name}"
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
    style_image_axes(left, against)
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
    style_axes(right, f"RMS {found.statistics_mm.rms:.4f} mm", "deviation, mm", "points, %")
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
        f"{name}: red lies outside the nominal surface, blue inside it. Right: the distribution of"
        " the deviations.",
        f"{source} coloured by its deviation from {found.nominal.name}, with their histogram",
    )
