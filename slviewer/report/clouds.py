"""Shaded views of scans and of merged clouds."""

from collections.abc import Sequence

import numpy as np

from slviewer.report.canvas import (
    DENSITY,
    FULL,
    HALF,
    INK,
    TEXT_PT,
    add_colour_bar,
    add_legend,
    finish_figure,
    new_figure,
    style_image_axes,
)
from slviewer.report.data import CloudView
from slviewer.report.page import Figure
from slviewer.report.shaded import render_points, view_rotation

YAW_DEG, PITCH_DEG = 24.0, 18.0
SCANS = ("#5b8fd0", "#e0a13c", "#63b28a", "#c8718f", "#8f83c9")
CLAY = (0.80, 0.79, 0.77)
MOST_POINTS = 300_000
"""Points drawn of one cloud: more change nothing at the size of a page."""


SQUARES, FINER = 14, 8
"""Squares across a chequered view, and how much finer it is told which scans measured there."""


def draw_clouds(views: Sequence[CloudView]) -> Figure:
    """The scans side by side, each coloured by its own depth."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    columns = min(len(views), 3)
    rows = -(-len(views) // columns)
    width = FULL // 3 if columns > 1 else 760
    across, down = round(0.76 * width), round(0.66 * width)
    drawing = new_figure(columns * width, rows * (down + 62))
    axes = drawing.subplots(rows, columns, squeeze=False).ravel()
    size = (DENSITY * across, DENSITY * down)
    palette = ListedColormap(colormaps["YlGnBu_r"](np.linspace(0.18, 0.92, 256)))
    for ax, view in zip(axes, views, strict=False):
        points, normals, _ = _sample_points(view)
        z = points[:, 2]
        near, far = (np.percentile(z, [1, 99]) if len(z) else (0.0, 1.0)) + np.array([-1e-3, 1e-3])
        shades = palette(np.clip((z - near) / (far - near), 0, 1))[:, :3]
        picture = render_points(points, normals, shades, size, view_rotation(YAW_DEG, PITCH_DEG))
        style_image_axes(ax, view.name)
        ax.imshow(picture)
        ax.set_xlabel(_format_count(view), fontsize=TEXT_PT, color=INK, loc="left")
        add_colour_bar(
            drawing,
            ScalarMappable(Normalize(near, far), palette),
            ax,
            "z, mm",
            shrink=0.7,
            aspect=20,
        )
    for ax in axes[len(views) :]:
        ax.set_axis_off()
    return finish_figure(
        drawing,
        "Each scan as measured, seen from above and aside, shaded by its own surface normals and"
        " coloured by depth.",
        "Shaded views of " + ", ".join(f"{view.name} ({_format_count(view)})" for view in views),
    )


def draw_merged_cloud(view: CloudView) -> Figure:
    """The merged cloud: illuminated as one surface, and coloured by the scan that each point comes
    from."""
    points, normals, source = _sample_points(view)
    size = (2 * HALF - 40, 2 * HALF - 240)
    rotation = view_rotation(YAW_DEG, PITCH_DEG)
    drawing = new_figure(FULL, HALF - 40)
    left, right = drawing.subplots(1, 2)
    style_image_axes(left, "as one surface")
    left.imshow(render_points(points, normals, np.broadcast_to(CLAY, points.shape), size, rotation))
    left.set_xlabel(_format_count(view), fontsize=TEXT_PT, color=INK, loc="left")
    style_image_axes(right, "by scan, in turns")
    palette = np.array([_parse_colour(colour) for colour in SCANS])
    shown = _select_mosaic(points, source) if len(points) else np.arange(0)
    points, normals, source = points[shown], normals[shown], source[shown]
    right.imshow(render_points(points, normals, palette[source % len(SCANS)], size, rotation))
    for i, name in enumerate(view.names):
        right.plot([], [], "s", color=SCANS[i % len(SCANS)], markersize=8, label=name)
    add_legend(
        right,
        loc="upper left",
        bbox_to_anchor=(0, 0),
        ncols=max(len(view.names), 1),
        handletextpad=0.2,
    )
    return finish_figure(
        drawing,
        "The merged cloud in the reference scan's frame. Right: each square shows the points of one"
        " scan alone, so that a step where squares meet would be a misalignment.",
        f"Shaded views of the merged cloud, {_format_count(view)}, as one surface and coloured by"
        " scan",
    )


def _sample_points(view: CloudView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and source (n,) of at most MOST_POINTS measured points, evenly thinned."""
    from slviewer.reconstruction.reconstruct import normals as grid_normals

    points, normals = view.points, view.normals
    if points.ndim == 3:
        step = max(1, int(np.ceil(np.sqrt(np.isfinite(points[..., 2]).sum() / MOST_POINTS))))
        points = np.ascontiguousarray(points[::step, ::step], np.float32)
        normals = grid_normals(points) if normals is None else normals[::step, ::step]
        points, normals = points.reshape(-1, 3), normals.reshape(-1, 3)
        source = np.zeros(len(points), np.intp)
    else:
        step = max(1, -(-len(points) // MOST_POINTS))
        points = points[::step]
        normals = np.full(points.shape, np.nan) if normals is None else normals[::step]
        source = (
            np.zeros(len(points), np.intp)
            if view.source is None
            else view.source[::step].astype(np.intp)
        )
    known = np.isfinite(points).all(axis=1)
    return points[known], normals[known], source[known]


def _select_mosaic(points: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Indices of the points of a chequered view, which shows one scan only in each square of x and
    y.

    The scans take turns from square to square, among those that measured there (decided on finer
    squares).
    """
    low, high = np.percentile(points[:, :2], [0.5, 99.5], axis=0)
    fine = float(np.max(high - low)) / (SQUARES * FINER)
    at = np.clip(((points[:, :2] - low) / fine).astype(np.intp), 0, SQUARES * FINER + FINER)
    place = at[:, 1] * (at[:, 0].max() + 1) + at[:, 0]
    scans = int(source.max()) + 1
    present = np.zeros((int(place.max()) + 1, scans), bool)
    present[place, source] = True
    turn = (at // FINER).sum(axis=1) % np.maximum(present[place].sum(axis=1), 1)
    # the how-manieth of the scans that are present each one is
    rank = np.cumsum(present, axis=1) - 1
    return np.flatnonzero(rank[place, source] == turn)


def _format_count(view: CloudView) -> str:
    """Text with the number of valid points of a view, and its note."""
    count = int(np.isfinite(view.points[..., 2]).sum())
    return f"{count:,} points" + (f"; {view.note}" if view.note else "")


def _parse_colour(colour: str) -> tuple[float, ...]:
    """RGB, 0 to 1, of a colour ``#rrggbb``."""
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
