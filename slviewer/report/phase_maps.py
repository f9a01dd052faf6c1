"""Pictures of decoded captures: the projector coordinate of each camera pixel, or why there is
none."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.sequence import Axis
from slviewer.report.canvas import (
    DENSITY,
    FULL,
    INK,
    SMALL_PT,
    add_colour_bar,
    finish_figure,
    new_figure,
    style_image_axes,
)
from slviewer.report.page import Figure

REASON_LABELS = {
    Reason.VALID: "valid",
    Reason.DARK: "dark",
    Reason.SATURATED: "saturated",
    Reason.INCONSISTENT: "inconsistent",
    Reason.OUTSIDE: "outside of the projector",
    Reason.INDIRECT: "indirect light",
}
REASON_COLOURS = {
    Reason.DARK: "#3a424b",
    Reason.SATURATED: "#e5322d",
    Reason.INCONSISTENT: "#ff8ad8",
    Reason.OUTSIDE: "#ffffff",
    Reason.INDIRECT: "#ff9a1f",
}
"""None of them occurs in the colour scale of the coordinates."""
_AROUND_PX = 96  # titles above, the legend below


def reason_shares(phase: PhaseMap) -> dict[Reason, float]:
    """Share of the pixels for each reason, VALID included, 0 to 1."""
    counts = np.bincount(phase.reason.ravel(), minlength=max(Reason) + 1)
    return {reason: float(counts[reason] / max(1, phase.reason.size)) for reason in Reason}


def phase_maps(title: str, phases: Mapping[Axis, PhaseMap]) -> Figure:
    """The coordinates of each axis side by side; masked pixels in the colour of their reason, with
    their shares."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    h, w = next(iter(phases.values())).reason.shape
    map_px = (FULL - 70 * len(phases)) // len(phases)
    height = round(map_px * h / w) + _AROUND_PX
    drawing = new_figure(FULL, height)
    drawing.suptitle(title, x=0.004, ha="left", fontsize=SMALL_PT + 3, color=INK, fontweight="bold")
    step = max(1, -(-w // (DENSITY * map_px)))
    for axes, (axis, phase) in zip(
        np.atleast_1d(drawing.subplots(1, len(phases))), phases.items(), strict=True
    ):
        shares = reason_shares(phase)
        style_image_axes(
            axes, f"axis {axis}: {100 * shares[Reason.VALID]:.1f} % of the pixels valid"
        )
        coordinate, reason = phase.coordinate[::step, ::step], phase.reason[::step, ::step]
        image = axes.imshow(
            _mask_invalid(coordinate), cmap="viridis", aspect="equal", interpolation="nearest"
        )
        cover = np.zeros((*reason.shape, 4), np.float32)
        for code, colour in REASON_COLOURS.items():
            cover[reason == code] = (*to_rgb(colour), 1.0)
        axes.imshow(cover, aspect="equal", interpolation="nearest")
        add_colour_bar(
            drawing,
            image,
            axes,
            f"projector {'column' if axis == 'x' else 'row'}, px",
            orientation="vertical",
        )
        patches = [
            Patch(
                facecolor=colour,
                edgecolor=INK,
                linewidth=0.5,
                label=f"{REASON_LABELS[code]} {100 * shares[code]:.1f} %",
            )
            for code, colour in REASON_COLOURS.items()
        ]
        axes.legend(
            handles=patches,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.01),
            ncols=2,
            fontsize=SMALL_PT,
            frameon=False,
        )
    listed = ", ".join(
        f"axis {axis} {100 * float(phase.mask.mean()):.1f} % valid"
        for axis, phase in phases.items()
    )
    return finish_figure(
        drawing,
        f"{title}: the projector coordinate that each camera pixel sees, in px; masked pixels in"
        " the colour of their reason.",
        f"Maps of the decoded projector coordinates of {title}: {listed}",
    )


def _mask_invalid(values: np.ndarray) -> Any:
    """Invalid pixels masked; where all are, one value keeps the colour scale finite."""
    if not np.isfinite(values).any():
        values = np.zeros_like(values)
    return np.ma.masked_invalid(values)
