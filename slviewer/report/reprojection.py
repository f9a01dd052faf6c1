"""Figures of reprojection errors of the target poses, and of their coverage of the image."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slviewer.geometry.vectors import shared_rms, subsample
from slviewer.records.calibration import Reprojection, is_pattern
from slviewer.report.canvas import (
    FULL,
    HALF,
    INK,
    SMALL_PT,
    add_colour_bar,
    add_legend_above,
    finish_figure,
    new_figure,
    percentile,
    round_up,
    style_axes,
)
from slviewer.report.page import Figure

MOST_ARROWS = 600
CAMERA, PROJECTOR = "#3c6e9e", "#c98a1b"


def pose_bars(of: Reprojection, *, width: int = FULL) -> Figure:
    """Reprojection RMS of each pose by a model, both devices side by side."""
    names = list(of.pose_rms_px)
    values = np.array([of.pose_rms_px[name] for name in names], float)
    narrow = width <= HALF
    drawing = new_figure(width, 260 if narrow else 300)
    axes = drawing.subplots()
    style_axes(axes, "", "", f"reprojection RMS, {of.model}, px")
    axes.grid(False, axis="x")
    at = np.arange(len(names))
    for i, ((device, name), colour) in enumerate(
        zip(of.devices.items(), (CAMERA, PROJECTOR), strict=True)
    ):
        rms = of.rms_px.get(device, np.nan)
        label = (
            f"{name}, {'all' if narrow else 'all poses'} {rms:.3f} px" if np.isfinite(rms) else name
        )
        axes.bar(at + 0.4 * i - 0.2, values[:, i], 0.38, color=colour, label=label)
        if np.isfinite(rms):
            axes.axhline(rms, color=colour, linewidth=1, linestyle=(0, (4, 2)))
    crowded = len(names) * max(map(len, names)) > width / 9
    axes.set_xticks(at, names, rotation=90 if crowded else 0, fontsize=SMALL_PT)
    axes.set_xlim(-0.7, len(names) - 0.3)
    add_legend_above(axes, 2, columnspacing=1.2)
    worst = names[int(np.argmax(np.nan_to_num(values).max(axis=1)))]
    return finish_figure(
        drawing,
        f"Reprojection error of each target pose by the {of.model} model. Dashed: the RMS over all"
        f" poses. The worst pose is {worst}.",
        f"Bars of the reprojection error of {len(names)} poses, camera and {of.other}; worst"
        f" {worst}",
    )


def residual_arrows(
    title: str, pixels: np.ndarray, residuals: np.ndarray, size: tuple[int, int]
) -> Figure:
    """Residuals (n, 2) px as arrows at ``pixels`` (n, 2) in an image of ``size`` = (width, height),
    magnified, at most ``MOST_ARROWS``; consecutive ones are neighbours, and the caption says
    whether these agree."""
    shared = shared_rms(residuals)
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(residuals).all(axis=1)
    at, away = pixels[known], residuals[known]
    lengths = np.hypot(away[:, 0], away[:, 1])
    rms = float(np.sqrt(np.mean(lengths**2))) if len(lengths) else np.nan
    # round_up(NaN) is 1
    scale = round_up(0.05 * size[0] / max(percentile(lengths, 95), 1e-3))
    drawing, axes = _new_image_axes(size, f"{title}: RMS {rms:.3f} px")
    if len(at):
        arrows = axes.quiver(
            *subsample(at, MOST_ARROWS).T,
            *(scale * subsample(away, MOST_ARROWS).T),
            subsample(lengths, MOST_ARROWS),
            angles="xy",
            scale_units="xy",
            scale=1,
            cmap="plasma",
            width=0.0035,
        )
        arrows.set_clim(0, round_up(float(np.percentile(lengths, 98))))
        arrows.set_clip_on(False)
        arrows.set_in_layout(False)
        key = round_up(rms)
        axes.quiverkey(
            arrows,
            *(0.86, 0.035),
            scale * key,
            f"{key:g} px",
            coordinates="figure",
            labelpos="E",
            color=INK,
            labelcolor=INK,
            fontproperties={"size": SMALL_PT},
        )
    return finish_figure(
        drawing,
        f"{title}: measured minus predicted positions, arrows drawn {scale:g} times as long as they"
        f" are. Neighbours share {shared:.3f} px of {rms:.3f} px: "
        + (
            "a pattern, of a lens, board or pose as this model does not know it."
            if is_pattern(shared, rms)
            else "noise."
        ),
        f"Residual arrows of {len(at)} positions in {title}; RMS {rms:.3f} px",
    )


def coverage(title: str, size: tuple[int, int], poses: Sequence[np.ndarray]) -> Figure:
    """Figure of the features (n, 2) px of each pose in an image of ``size``, their hulls and
    covered share."""
    import cv2

    coverage_count = np.zeros((size[1], size[0]), np.uint8)
    hulls = []
    for pixels in poses:
        known = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        if len(known) < 3:
            continue
        hull = cv2.convexHull(known)[:, 0]
        filled = np.zeros_like(coverage_count)
        cv2.fillConvexPoly(filled, np.round(hull).astype(np.int32), 1)
        coverage_count += filled
        hulls.append(np.vstack([hull, hull[:1]]))
    share = 100 * float((coverage_count > 0).mean())
    drawing, axes = _new_image_axes(size, f"{title}: {share:.0f} % of the image covered")
    for hull in hulls:
        axes.plot(*hull.T, color=INK, linewidth=0.6, alpha=0.4)
    step = max(1, size[0] // 600)
    image = axes.imshow(
        np.ma.masked_equal(coverage_count, 0)[::step, ::step],
        cmap="YlGn",
        vmin=0,
        vmax=max(len(poses), 1),
        extent=(-0.5, size[0] - 0.5, size[1] - 0.5, -0.5),
        interpolation="nearest",
        zorder=0,
    )
    add_colour_bar(drawing, image, axes, "poses", shrink=0.7)
    return finish_figure(
        drawing,
        f"{title}: how many of the {len(poses)} poses cover each part of the image. "
        "A lens is known only where a target was.",
        f"Coverage of {title} by {len(poses)} poses: {share:.0f} % of the image",
    )


def _new_image_axes(size: tuple[int, int], title: str) -> tuple[Any, Any]:
    """A figure and its axes, framed as an image of ``size``."""
    drawing = new_figure(HALF, 420)
    axes = drawing.subplots()
    style_axes(axes, title, "column, px", "row, px", grid=False)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color("#b9c2cb")
    axes.set_aspect("equal")
    axes.set_xlim(-0.5, size[0] - 0.5)
    axes.set_ylim(size[1] - 0.5, -0.5)
    return drawing, axes
