"""How well the target poses agree with a calibration, and where in the image they lay."""

from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.errors import InputError
from slviewer.report.canvas import FULL, HALF, INK, SMALL_PT, SOFT, bare, finish, legend, new_figure, rounded_up, tidy
from slviewer.report.page import Figure

CAMERA, PROJECTOR = "#3c6e9e", "#c98a1b"


def pose_bars(pose_rms_px: Mapping[str, tuple[float, float]]) -> Figure:
    """Reprojection RMS of each pose, camera and projector side by side, the worst of either named."""
    if not pose_rms_px:
        raise InputError("no pose was given: its reprojection error cannot be drawn")
    names = list(pose_rms_px)
    values = np.array([pose_rms_px[name] for name in names], float)
    drawing = new_figure(FULL, 300)
    axes = drawing.subplots()
    tidy(axes, "", "", "reprojection RMS, px")
    axes.grid(False, axis="x")
    at = np.arange(len(names))
    for i, (device, colour) in enumerate((("camera", CAMERA), ("projector", PROJECTOR))):
        rms = float(np.sqrt(np.nanmean(values[:, i] ** 2)))
        axes.bar(at + 0.4 * i - 0.2, values[:, i], 0.38, color=colour, label=f"{device}, all poses {rms:.3f} px")
        axes.axhline(rms, color=colour, linewidth=1, linestyle=(0, (4, 2)))
    axes.set_xticks(at, names, rotation=90 if len(names) > 12 else 0, fontsize=SMALL_PT)
    axes.set_xlim(-0.7, len(names) - 0.3)
    legend(axes, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.2)
    worst = names[int(np.nanargmax(np.nanmax(values, axis=1)))]
    return finish(
        drawing,
        f"Reprojection error of each target pose. Dashed: the RMS over the poses. The worst pose is {worst}.",
        f"Bars of the reprojection error of {len(names)} poses, camera and projector; worst {worst}",
    )


def residual_arrows(title: str, pixels: np.ndarray, residuals: np.ndarray, size: tuple[int, int]) -> Figure:
    """Residuals (n, 2) px as arrows at ``pixels`` (n, 2) in an image of ``size`` = (width, height), magnified."""
    if pixels.shape != residuals.shape or pixels.ndim != 2 or pixels.shape[1] != 2:
        raise InputError(f"{pixels.shape} pixels and {residuals.shape} residuals cannot be drawn: (n, 2) are needed")
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(residuals).all(axis=1)
    at, away = pixels[known], residuals[known]
    lengths = np.hypot(away[:, 0], away[:, 1])
    rms = float(np.sqrt(np.mean(lengths**2))) if len(lengths) else float("nan")
    scale = rounded_up(0.05 * size[0] / max(float(np.percentile(lengths, 95)), 1e-3)) if len(lengths) else 1.0
    drawing, axes = _image_axes(size)
    tidy(axes, f"{title}: RMS {rms:.3f} px", "column, px", "row, px")
    if len(at):
        arrows = axes.quiver(
            *at.T, *(scale * away.T), lengths, angles="xy", scale_units="xy", scale=1, cmap="plasma", width=0.003
        )
        arrows.set_clim(0, rounded_up(float(np.percentile(lengths, 98))))
        key = rounded_up(rms)
        axes.quiverkey(arrows, 0.86, 1.045, scale * key, f"{key:g} px", labelpos="E", fontproperties={"size": SMALL_PT})
    return finish(
        drawing,
        f"{title}: measured minus predicted features, arrows drawn {scale:g} times as long as they are. Arrows "
        "without a pattern are noise; a swirl or a common direction means a lens, board or pose that the model lacks.",
        f"Residual arrows of {len(at)} features in {title}; RMS {rms:.3f} px",
    )


def coverage(title: str, size: tuple[int, int], poses: Sequence[np.ndarray]) -> Figure:
    """Where the features (n, 2) px of each pose lay in an image of ``size``: their hulls, and how much they cover."""
    import cv2

    drawing, axes = _image_axes(size)
    seen = np.zeros((size[1], size[0]), np.uint8)
    for pixels in poses:
        known = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        if len(known) < 3:
            continue
        hull = cv2.convexHull(known)[:, 0]
        filled = np.zeros_like(seen)
        cv2.fillConvexPoly(filled, np.round(hull).astype(np.int32), 1)
        seen += filled
        axes.plot(*np.vstack([hull, hull[:1]]).T, color=INK, linewidth=0.5, alpha=0.35)
        axes.plot(*known.T, ".", color=INK, markersize=1.1, alpha=0.35)
    share = 100 * float((seen > 0).mean())
    tidy(axes, f"{title}: {share:.0f} % of the image covered", "column, px", "row, px", grid=False)
    shown = np.ma.masked_equal(seen, 0)
    extent = (-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
    step = max(1, size[0] // 600)
    image = axes.imshow(shown[::step, ::step], cmap="YlGn", vmin=0, extent=extent, interpolation="nearest", zorder=0)
    bar = drawing.colorbar(image, ax=axes, shrink=0.85, aspect=24, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL_PT, colors=SOFT)
    bar.outline.set_visible(False)
    bar.set_label("poses", fontsize=SMALL_PT, color=SOFT)
    return finish(
        drawing,
        f"{title}: how many of the {len(poses)} poses cover each part of the image. "
        "A lens is known only where a target was.",
        f"Coverage of {title} by {len(poses)} poses: {share:.0f} % of the image",
    )


def _image_axes(size: tuple[int, int]):  # type: ignore[no-untyped-def]
    drawing = new_figure(HALF, int(np.clip(HALF * size[1] / size[0], 280, 640)) + 20)
    axes = drawing.subplots()
    bare(axes)
    axes.set_aspect("equal")
    axes.set_xlim(-0.5, size[0] - 0.5)
    axes.set_ylim(size[1] - 0.5, -0.5)
    return drawing, axes
