"""What all figures share: a canvas without global state, the palette, the styles of axes.

matplotlib is used through its objects alone (no pyplot, no rcParams), so that reports may be
written by any thread.
"""

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slviewer.report.page import Figure

FULL = 1080
"""CSS px: a figure as wide as the page's text column."""
HALF = 528
"""CSS px: two figures side by side."""
DENSITY = 2
"""Device pixels drawn for each CSS px."""

INK, SOFT, RULE, EMPTY = "#1b2733", "#5a6877", "#e3e8ed", "#d5d9de"
MODELS = {"stereo": "#d9692b", "pixelwise": "#2270b8", "splined": "#1f9673"}
REGIONS = {"R1": "#7b5cc4", "R2": "#4f6375", "R3": "#b8436d"}
BAND = "#e8eef4"
_OTHERS = ("#6f7d8c", "#a04f9e")
TEXT_PT, SMALL_PT, TITLE_PT = 9.0, 8.2, 10.0

# Agg's text layout shares one font cache
_drawing = threading.Lock()


def model_colour(model: str) -> str:
    """The colour that represents a model in every figure."""
    return MODELS.get(model) or _OTHERS[sum(model.encode()) % len(_OTHERS)]


def new_figure(width: int, height: int) -> Any:
    """A matplotlib figure of ``width`` x ``height`` CSS px."""
    from matplotlib.figure import Figure as Drawing

    return Drawing(
        figsize=(width / 100, height / 100),
        dpi=100 * DENSITY,
        facecolor="white",
        layout="constrained",
    )


def finish_figure(drawing: Any, caption: str, alt: str) -> Figure:
    """Draw a matplotlib figure, and return it as a figure of a report."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with _drawing:
        canvas = FigureCanvasAgg(drawing)
        canvas.draw()
        rgb = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
    return Figure(rgb, caption, alt, rgb.shape[1] // DENSITY)


def style_axes(
    axes: Any, title: str = "", x: str = "", y: str = "", *, grid: bool = True, colour: str = INK
) -> None:
    """Style axes plainly: a light grid, two spines, labels in the page's sizes; ``x`` and ``y``
    name the axes."""
    axes.set_title(title, fontsize=TITLE_PT, color=colour, loc="left", fontweight="bold", pad=7)
    axes.set_xlabel(x, fontsize=TEXT_PT, color=SOFT)
    axes.set_ylabel(y, fontsize=TEXT_PT, color=SOFT)
    axes.tick_params(labelsize=SMALL_PT, colors=SOFT, length=3, width=0.7)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b9c2cb")
        spine.set_linewidth(0.8)
    if grid:
        axes.grid(True, color=RULE, linewidth=0.7)
        axes.set_axisbelow(True)


def style_image_axes(axes: Any, title: str = "", colour: str = INK) -> None:
    """Style the axes of an image: a title, no ticks and no frame."""
    style_axes(axes, title, grid=False, colour=colour)
    axes.set_xticks([])
    axes.yaxis.set_visible(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def add_legend(axes: Any, **options: Any) -> None:
    """Add a legend of the labelled artists to the axes, in the page's type."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**{"fontsize": SMALL_PT, "labelcolor": INK, "frameon": False, **options})


def add_legend_above(axes: Any, columns: int, **options: Any) -> None:
    """Add a legend in one line above the axes, at their left."""
    place = {"loc": "lower left", "bbox_to_anchor": (0, 1.0), "borderaxespad": 0.2}
    add_legend(axes, ncols=columns, **{**place, **options})


def label_point(
    axes: Any, text: str, place: Any, offset: tuple[float, float] = (0, 2), **style: Any
) -> None:
    """Write text beside a point of the axes, ``offset`` typographic points away."""
    axes.annotate(text, place, offset, textcoords="offset points", **style)


def add_colour_bar(drawing: Any, image: Any, axes: Any, label: str, **options: Any) -> None:
    """Add a colour bar beside ``axes``, in the page's type."""
    bar = drawing.colorbar(image, ax=axes, **{"shrink": 0.9, "aspect": 24, "pad": 0.02, **options})
    bar.ax.tick_params(labelsize=SMALL_PT, colors=SOFT, length=3, width=0.7)
    bar.set_label(label, fontsize=TEXT_PT, color=SOFT)
    bar.outline.set_visible(False)


def draw_map(
    axes: Any, image: NDArray[np.floating], colours: str, levels: int, low: float, high: float
) -> Any:
    """Draw a map (h, w), grey where NaN, with ``levels`` levels of a colour map ``low`` to
    ``high``; returns the image.

    Maps that are finer than the figure are averaged.
    """
    from matplotlib import colormaps

    return axes.imshow(
        np.ma.masked_invalid(image),
        cmap=colormaps[colours].resampled(levels).with_extremes(bad=EMPTY),
        vmin=low,
        vmax=high,
        interpolation="auto",
        interpolation_stage="rgba",
    )


def round_up(value: float) -> float:
    """The value rounded up to 1, 1.5, 2, 3, 4, 5, 6, 8 or 10 times a power of ten; 1 unless finite
    and positive."""
    if not (np.isfinite(value) and value > 0):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        next(s for s in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if s * power >= value * (1 - 1e-9))
        * power
    )


def percentile(values: np.ndarray, share: float) -> float:
    """A percentile of the finite values; NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")
