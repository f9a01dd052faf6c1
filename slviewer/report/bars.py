"""Bar charts: RMS of each plane by model, with the noise floor and the Letter's value."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.report.canvas import (
    FULL,
    INK,
    REGIONS,
    SMALL_PT,
    add_legend,
    finish_figure,
    model_colour,
    new_figure,
    style_axes,
)
from slviewer.report.data import PlaneRow
from slviewer.report.page import Figure


def rms_bars(rows: Sequence[PlaneRow]) -> Figure:
    """Bars of every plane's RMS by model with the noise floor as a tick and the Letter's figure as
    a ring, and below them the share of each plane in R1, R2 and R3."""
    if not rows:
        raise InputError("no plane was given: their RMS cannot be drawn")
    drawing = new_figure(FULL, 390)
    upper, lower = drawing.subplots(2, 1, height_ratios=(4.4, 1), sharex=True)
    _draw_rms(upper, rows)
    _draw_shares(lower, rows)
    return finish_figure(
        drawing,
        "RMS distance of the flat board from its own plane, by model. Black ticks: what the"
        " capture's noise alone would give. Rings: the Letter's own figures, from its rig. Below:"
        " the share of each board in R1, R2 and R3.",
        "Bars of the plane RMS by pose and model, with noise floor, the Letter's figures and the"
        " depth ranges",
    )


def _draw_rms(upper: Any, rows: Sequence[PlaneRow]) -> None:
    """Draw the bars of the RMS with noise floors, the Letter's figures and values."""
    models = list(rows[0].rms_mm)
    width = 0.8 / len(models)
    style_axes(upper, "", "", "plane RMS, mm")
    upper.grid(False, axis="x")
    for i, model in enumerate(models):
        x = np.arange(len(rows)) + (i - (len(models) - 1) / 2) * width
        rms, floor, letter = np.array(
            [
                [
                    values.get(model, np.nan)
                    for values in (row.rms_mm, row.noise_floor_mm, row.letter_rms_mm)
                ]
                for row in rows
            ]
        ).T
        upper.bar(x, rms, 0.92 * width, color=model_colour(model), label=model)
        upper.hlines(
            floor,
            x - 0.46 * width,
            x + 0.46 * width,
            color=INK,
            linewidth=1.6,
            label="noise floor" if not i else None,
        )
        if np.isfinite(letter).any():
            upper.plot(
                x,
                letter,
                "o",
                markersize=5.5,
                markerfacecolor="white",
                markeredgecolor=INK,
                markeredgewidth=1.1,
                linestyle="none",
                label="the Letter's rig" if not i else None,
            )
        for place, value in zip(x, rms, strict=True):
            if np.isfinite(value):
                upper.annotate(
                    f"{value:.3f}".lstrip("0"),
                    (place, value),
                    xytext=(0, 2),
                    textcoords="offset points",
                    ha="center",
                    fontsize=7.2,
                    color=INK,
                )
    handles, labels = upper.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i] not in models)  # models first
    add_legend(
        upper,
        handles=[handles[i] for i in order],
        labels=[labels[i] for i in order],
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=len(labels),
        borderaxespad=0.2,
    )
    upper.tick_params(labelbottom=False)


def _draw_shares(lower: Any, rows: Sequence[PlaneRow]) -> None:
    """Draw the shares of each plane in R1, R2 and R3 as stacked bars, with the planes' names."""
    at = np.arange(len(rows))
    style_axes(lower, "", "", "share", grid=False)
    bottom = np.zeros(len(rows))
    for region in ("R1", "R2", "R3"):
        share = np.array([row.incidence.get(region, 0.0) for row in rows]) / 100
        colour = {"R1": REGIONS["R1"], "R2": "#c3ced8", "R3": REGIONS["R3"]}[region]
        lower.bar(at, share, 0.8, bottom=bottom, color=colour, label=region)
        bottom += share
    lower.set_ylim(0, 1)
    lower.set_yticks([])
    lower.set_xlim(-0.6, len(rows) - 0.4)
    lower.set_xticks(
        at, [row.name for row in rows], fontsize=SMALL_PT, rotation=45 if len(rows) > 14 else 0
    )
    add_legend(lower, loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True, handlelength=1.0)
