"""Positions of the verified planes in front of the camera."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.report.canvas import (
    BAND,
    FULL,
    INK,
    REGIONS,
    SMALL_PT,
    SOFT,
    TITLE_PT,
    add_legend,
    finish_figure,
    new_figure,
    style_axes,
    style_image_axes,
)
from slviewer.report.page import Figure


def planes_in_space(
    outlines: Mapping[str, np.ndarray], depth_range_mm: tuple[float, float]
) -> Figure:
    """Figure of the planes in the camera frame: in perspective, from the side and from above; R2 is
    shaded.

    ``outlines``: by name, three or more points (n, 3) mm of a plane; their hull within the plane is
    drawn.
    """
    hulls = {name: _convex_hull(name, points) for name, points in outlines.items()}
    if not hulls:
        raise InputError("no plane was given: their positions cannot be drawn")
    short = _shorten_names(list(hulls))
    near, far = depth_range_mm
    every = np.concatenate(list(hulls.values()))
    low, high = every.min(axis=0), every.max(axis=0)
    low[2], high[2] = min(low[2], near), max(high[2], far)

    drawing = new_figure(FULL, 450)
    grid = drawing.add_gridspec(2, 2, width_ratios=(1.05, 1))
    space = drawing.add_subplot(grid[:, 0], projection="3d")
    _draw_perspective(space, hulls, short, depth_range_mm, low, high)
    for row, (axis, title) in enumerate(((1, "from the side"), (0, "from above"))):
        axes = drawing.add_subplot(grid[row, 1])
        style_axes(axes, "", "z, mm" if row else "", f"{'xy'[axis]}, mm")
        axes.set_title(title, fontsize=TITLE_PT, color=INK, loc="left", fontweight="bold", pad=18)
        _draw_profile(axes, axis, hulls, short, depth_range_mm, low, high)
        if not row:
            add_legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.08), borderaxespad=0.2)
    return finish_figure(
        drawing,
        f"Positions of the {len(hulls)} planes in the camera's frame. Shaded: R2, the calibrated"
        f" depths of {near:.0f} to {far:.0f} mm. Purple planes lie in front of it (R1), crimson"
        " ones behind it (R3), by the depth of their middle.",
        f"{len(hulls)} planes in space, from the side and from above, with the depth range"
        f" {near:.0f} to {far:.0f} mm",
    )


def _draw_profile(
    axes: Any,
    axis: int,
    hulls: Mapping[str, np.ndarray],
    short: Mapping[str, str],
    depth_range_mm: tuple[float, float],
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Draw depth to the right against x or y, each plane named above its upper end."""
    axes.axvspan(*depth_range_mm, color=BAND, zorder=0, label="R2, the calibrated depths")
    margin = 0.1 * (high[axis] - low[axis])
    bottom, top = low[axis] - margin, high[axis] + margin
    if axis == 1:  # y points down
        bottom, top = top, bottom
    edge = 0.03 * (high[2] - low[2])
    left, right = low[2] - edge, high[2] + edge
    ends = {name: hull[np.argmin(np.abs(hull[:, axis] - top))] for name, hull in hulls.items()}
    places = _spread_labels(
        {name: float(end[2]) for name, end in ends.items()}, 0.032 * (right - left), right
    )
    for name, hull in hulls.items():
        colour = REGIONS[_classify_depth(hull, depth_range_mm)]
        axes.fill(
            hull[:, 2],
            hull[:, axis],
            facecolor=(colour, 0.14),
            edgecolor=(colour, 0.9),
            linewidth=1.3,
        )
        axes.plot(
            [ends[name][2], places[name]],
            [ends[name][axis], top],
            color=colour,
            linewidth=0.5,
            alpha=0.6,
        )
        axes.annotate(
            short[name],
            (places[name], top),
            xytext=(0, 2),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=SMALL_PT,
            color=colour,
            fontweight="bold",
        )
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def _spread_labels(wanted: Mapping[str, float], gap: float, end: float) -> dict[str, float]:
    """Label positions near the wanted ones, at least ``gap`` apart and none beyond ``end``."""
    names = sorted(wanted, key=lambda name: wanted[name])
    places = np.array([wanted[name] for name in names])
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + gap)
    limit = end
    for i in reversed(range(len(places))):
        places[i] = min(places[i], limit)
        limit = places[i] - gap
    return dict(zip(names, places.tolist(), strict=True))


def _draw_perspective(
    axes: Any,
    hulls: Mapping[str, np.ndarray],
    short: Mapping[str, str],
    depth_range_mm: tuple[float, float],
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Draw the perspective view: depth increases to the right, the image's up is up."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    style_image_axes(axes)
    for i, (name, hull) in enumerate(hulls.items()):
        colour = REGIONS[_classify_depth(hull, depth_range_mm)]
        shown = np.stack([hull[:, 2], hull[:, 0], -hull[:, 1]], axis=1)
        axes.add_collection3d(
            Poly3DCollection(
                [shown],
                facecolors=[colour],
                alpha=0.2,
                edgecolors=[colour],
                linewidths=1.1,
                clip_on=False,
            )
        )
        corner, side = (np.argmin, "top") if i % 2 else (np.argmax, "bottom")
        end = shown[corner(shown[:, 2])]
        axes.text(
            *end,
            short[name],
            fontsize=SMALL_PT,
            color=colour,
            fontweight="bold",
            ha="center",
            va=side,
        )
    for z in depth_range_mm:
        wall = np.array([[z, x, -y] for x, y in _list_corners(low, high)])
        axes.add_collection3d(
            Poly3DCollection(
                [wall],
                facecolors=["#9fb4c6"],
                alpha=0.14,
                edgecolors=["#7f97ab"],
                linewidths=0.8,
                clip_on=False,
            )
        )
        axes.text(
            z, low[0], -high[1], f"{z:.0f} mm", fontsize=SMALL_PT, color=SOFT, ha="center", va="top"
        )
    axes.set_xlim(low[2], high[2])
    axes.set_ylim(low[0], high[0])
    axes.set_zlim(-high[1], -low[1])
    axes.set_zticks([])
    axes.set_box_aspect((high[2] - low[2], high[0] - low[0], high[1] - low[1]), zoom=1.3)
    axes.view_init(elev=20, azim=-62)
    axes.set_axis_off()
    axes.set_title(
        "in space: the camera looks from the left",
        fontsize=TITLE_PT,
        color=INK,
        loc="left",
        fontweight="bold",
    )


def _convex_hull(name: str, points: np.ndarray) -> np.ndarray:
    """The corners (m, 3), in order, of the convex hull of points close to one plane."""
    from scipy.spatial import ConvexHull

    points = np.asarray(points, float).reshape(-1, np.shape(points)[-1])
    points = points[np.isfinite(points).all(axis=1)]
    if points.shape[1:] != (3,) or len(points) < 3:
        raise InputError(
            f"plane '{name}' has {len(points)} usable points: three or more (x, y, z) are needed"
        )
    centred = points - points.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    return points[ConvexHull(centred @ directions[:2].T).vertices]


def _list_corners(low: np.ndarray, high: np.ndarray) -> list[tuple[float, float]]:
    """The four corners, in order, of the axis-aligned rectangle between two corners (2,)."""
    return [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]


def _classify_depth(hull: np.ndarray, depth_range_mm: tuple[float, float]) -> str:
    """Depth region of the hull (n, 3) mm by its mean depth: R1 nearer, R2 inside, R3 beyond the
    range."""
    z = float(hull[:, 2].mean())
    return "R1" if z < depth_range_mm[0] else "R3" if z > depth_range_mm[1] else "R2"


def _shorten_names(names: list[str]) -> dict[str, str]:
    """Names without their common prefix and leading zeros: plane_01 becomes 1."""
    common = 0
    while (
        len(names) > 1
        and len({name[: common + 1] for name in names}) == 1
        and common < len(names[0])
    ):
        common += 1
    return {name: name[common:].lstrip("0_- ") or name for name in names}
