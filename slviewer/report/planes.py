"""Pictures of verified planes: RMS of each by model, with the noise floor and the Letter's value,
and their positions in front of the camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from os.path import commonprefix
from typing import Any

import numpy as np

from slviewer.evaluation.letter import find_pose
from slviewer.geometry.vectors import finite_rows
from slviewer.records.record import DEPTHS
from slviewer.records.verification import Verification
from slviewer.report.page import (
    BAND,
    FULL,
    INK,
    REGIONS,
    SMALL_PT,
    SOFT,
    TITLE_PT,
    Figure,
    add_legend,
    add_legend_above,
    finish_figure,
    label_point,
    model_colour,
    new_figure,
    style_axes,
    style_image_axes,
)


def rms_bars(found: Mapping[str, Verification]) -> Figure:
    """Bars of every plane's RMS by model with the noise floor as a tick and the Letter's figure as
    a ring, and below them the share of each plane in R1, R2 and R3."""
    drawing = new_figure(FULL, 390)
    upper, lower = drawing.subplots(2, 1, height_ratios=(4.4, 1), sharex=True)
    _draw_rms(upper, found)
    _draw_shares(lower, found)
    return finish_figure(
        drawing,
        "RMS distance of the flat board from its own plane, by model. Black ticks: what the"
        " capture's noise alone would give. Rings: the Letter's own figures, from its rig. Below:"
        " the share of each board in R1, R2 and R3.",
        "Bars of the plane RMS by pose and model, with noise floor, the Letter's figures and the"
        " depth ranges",
    )


def _draw_rms(upper: Any, found: Mapping[str, Verification]) -> None:
    """Draw the bars of the RMS with noise floors, the Letter's figures and values."""
    models = list(next(iter(found.values())).models)
    width = 0.8 / len(models)
    style_axes(upper, "", "", "plane RMS, mm")
    upper.grid(False, axis="x")
    for i, model in enumerate(models):
        x = np.arange(len(found)) + (i - (len(models) - 1) / 2) * width
        figures = [
            (
                each.rms_mm[model],
                each.models[model].noise_floor_mm,
                find_pose(name, "plane").rms_mm.get(model),
            )
            for name, each in found.items()
        ]
        rms, floor, letter = np.array(figures, float).T
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
                label="the Letter's rig" if not i else None,
            )
        for place, value in zip(x, rms, strict=True):
            if np.isfinite(value):
                text = f"{value:.3f}".lstrip("0")
                label_point(upper, text, (place, value), ha="center", fontsize=7.2, color=INK)
    handles, labels = upper.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i] not in models)  # models first
    add_legend_above(
        upper,
        len(labels),
        handles=[handles[i] for i in order],
        labels=[labels[i] for i in order],
    )
    upper.tick_params(labelbottom=False)


def _draw_shares(lower: Any, found: Mapping[str, Verification]) -> None:
    """Draw the shares of each plane in R1, R2 and R3 as stacked bars, with the planes' names."""
    at = np.arange(len(found))
    style_axes(lower, "", "", "share", grid=False)
    bottom = np.zeros(len(found))
    for region in DEPTHS:
        share = np.array([(each.incidence or {}).get(region, 0.0) for each in found.values()]) / 100
        colour = {"R1": REGIONS["R1"], "R2": "#c3ced8", "R3": REGIONS["R3"]}[region]
        lower.bar(at, share, 0.8, bottom=bottom, color=colour, label=region)
        bottom += share
    lower.set_ylim(0, 1)
    lower.set_yticks([])
    lower.set_xlim(-0.6, len(found) - 0.4)
    lower.set_xticks(at, list(found), fontsize=SMALL_PT, rotation=45 if len(found) > 14 else 0)
    add_legend(lower, loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True, handlelength=1.0)


def planes_in_space(
    outlines: Mapping[str, np.ndarray], depth_range_mm: tuple[float, float]
) -> Figure:
    """Figure of the planes in the camera frame: in perspective, from the side and from above; R2 is
    shaded.

    ``outlines``: by name, three or more points (n, 3) mm of a plane; their hull within the plane is
    drawn.
    """
    hulls = {name: _convex_hull(points) for name, points in outlines.items()}
    near, far = depth_range_mm
    every = np.concatenate(list(hulls.values()))
    low, high = every.min(axis=0), every.max(axis=0)
    low[2], high[2] = min(low[2], near), max(high[2], far)
    # names without their common prefix and leading zeros: plane_01 becomes 1
    common = len(commonprefix(list(hulls))) if len(hulls) > 1 else 0  # noqa: RUF071, of letters
    short = {name: name[common:].lstrip("0_- ") or name for name in hulls}
    scene = _Scene(hulls, short, depth_range_mm, low, high)
    drawing = new_figure(FULL, 450)
    grid = drawing.add_gridspec(2, 2, width_ratios=(1.05, 1))
    scene.draw_perspective(drawing.add_subplot(grid[:, 0], projection="3d"))
    for row, (axis, title) in enumerate(((1, "from the side"), (0, "from above"))):
        axes = drawing.add_subplot(grid[row, 1])
        style_axes(axes, "", "z, mm" if row else "", f"{'xy'[axis]}, mm")
        axes.set_title(title, **_TITLE, pad=18)
        scene.draw_profile(axes, axis)
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


_TITLE: dict[str, Any] = {
    "fontsize": TITLE_PT,
    "color": INK,
    "loc": "left",
    "fontweight": "bold",
}


@dataclass(frozen=True)
class _Scene:
    """Planes as hulls (n, 3) mm by name, their short names, the calibrated depths, and the corners
    (3,) of the box around all."""

    hulls: Mapping[str, np.ndarray]
    short: Mapping[str, str]
    depth_range_mm: tuple[float, float]
    low: np.ndarray
    high: np.ndarray

    def label(self, name: str) -> tuple[str, dict[str, Any]]:
        """Colour of a plane by the depth of its middle (R1 nearer, R2 inside, R3 beyond the
        calibrated depths), and the style of its name."""
        z, (near, far) = float(self.hulls[name][:, 2].mean()), self.depth_range_mm
        colour = REGIONS["R1" if z < near else "R3" if z > far else "R2"]
        return colour, {
            "ha": "center",
            "fontsize": SMALL_PT,
            "color": colour,
            "fontweight": "bold",
        }

    def draw_profile(self, axes: Any, axis: int) -> None:
        """Draw depth to the right against x or y, each plane named above its upper end."""
        low, high = self.low, self.high
        axes.axvspan(*self.depth_range_mm, color=BAND, zorder=0, label="R2, the calibrated depths")
        margin = 0.1 * (high[axis] - low[axis])
        bottom, top = low[axis] - margin, high[axis] + margin
        if axis == 1:  # y points down
            bottom, top = top, bottom
        edge = 0.03 * (high[2] - low[2])
        left, right = low[2] - edge, high[2] + edge
        ends = {n: hull[np.argmin(np.abs(hull[:, axis] - top))] for n, hull in self.hulls.items()}
        places = _spread_labels(
            {name: float(end[2]) for name, end in ends.items()}, 0.032 * (right - left), right
        )
        for name, hull in self.hulls.items():
            colour, style = self.label(name)
            axes.fill(
                hull[:, 2],
                hull[:, axis],
                facecolor=(colour, 0.14),
                edgecolor=(colour, 0.9),
                linewidth=1.3,
            )
            place, end = places[name], ends[name]
            axes.plot([end[2], place], [end[axis], top], color=colour, linewidth=0.5, alpha=0.6)
            label_point(axes, self.short[name], (place, top), va="bottom", **style)
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)

    def draw_perspective(self, axes: Any) -> None:
        """Draw the perspective view: depth increases to the right, the image's up is up."""
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        style_image_axes(axes)
        for i, (name, hull) in enumerate(self.hulls.items()):
            colour, style = self.label(name)
            shown = np.stack([hull[:, 2], hull[:, 0], -hull[:, 1]], axis=1)
            polygon = Poly3DCollection(
                [shown], color=colour, alpha=0.2, linewidths=1.1, clip_on=False
            )
            axes.add_collection3d(polygon)
            corner, side = (np.argmin, "top") if i % 2 else (np.argmax, "bottom")
            axes.text(*shown[corner(shown[:, 2])], self.short[name], va=side, **style)
        (left, top, near), (right, bottom, far) = self.low, self.high
        for z in self.depth_range_mm:
            corners = (left, top), (right, top), (right, bottom), (left, bottom)
            shown = np.array([[z, x, -y] for x, y in corners])
            polygon = Poly3DCollection(
                [shown],
                facecolor="#9fb4c6",
                edgecolor="#7f97ab",
                alpha=0.14,
                linewidths=0.8,
                clip_on=False,
            )
            axes.add_collection3d(polygon)
            style = {"fontsize": SMALL_PT, "color": SOFT, "ha": "center", "va": "top"}
            axes.text(z, left, -bottom, f"{z:.0f} mm", **style)
        axes.set_xlim(near, far)
        axes.set_ylim(left, right)
        axes.set_zlim(-bottom, -top)
        axes.set_zticks([])
        axes.set_box_aspect((far - near, right - left, bottom - top), zoom=1.3)
        axes.view_init(elev=20, azim=-62)
        axes.set_axis_off()
        axes.set_title("in space: the camera looks from the left", **_TITLE)


def _spread_labels(wanted: Mapping[str, float], gap: float, end: float) -> dict[str, float]:
    """Label positions near the wanted ones, at least ``gap`` apart and none beyond ``end``."""
    names = sorted(wanted, key=lambda name: wanted[name])
    steps = gap * np.arange(len(names))
    places = np.maximum.accumulate(np.array([wanted[name] for name in names]) - steps) + steps
    return dict(zip(names, np.minimum(places, end - steps[::-1]).tolist(), strict=True))


def _convex_hull(points: np.ndarray) -> np.ndarray:
    """The corners (m, 3), in order, of the convex hull of points close to one plane."""
    from scipy.spatial import ConvexHull

    points = points[finite_rows(points)]
    centred = points - points.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    return points[ConvexHull(centred @ directions[:2].T).vertices]
