"""Pictures of per-pixel quantities: RMS of the fit, error of the measured point, decoded projector
coordinate, and the Letter's picture of one pixel's fit; and of the reprojection errors of target
poses, and their coverage of the image."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.sequence import Size
from slviewer.geometry.vectors import finite_rows, rms_length, shared_rms, subsample, thin_out
from slviewer.records.calibration import Reprojection, is_pattern
from slviewer.records.verification import Verification
from slviewer.report.page import (
    DENSITY,
    FULL,
    HALF,
    INK,
    MODELS,
    SMALL_PT,
    SOFT,
    TITLE_PT,
    Figure,
    add_colour_bar,
    add_legend,
    add_legend_above,
    draw_map,
    finish_figure,
    model_colour,
    new_figure,
    percentile,
    round_up,
    style_axes,
    style_image_axes,
)

TITLE_PX = 34
WIDE_PX = 250  # maps that have room for longer titles
BINS = 121


def rms_maps(rms_mm: np.ndarray, axis: str = "", *, width: int = FULL) -> Figure:
    """The RMS of each pixel's fit (3, h, w) mm in z, x, y; grey where a pixel was not fitted.

    A narrow figure has x and y below z.
    """
    _, h, w = rms_mm.shape
    narrow = width <= HALF
    if narrow:
        heights = [round(share * width * h / w) + TITLE_PX + 8 for share in (0.84, 0.37)]
        layout = [["z", "z"], ["x", "y"]]
    else:
        heights, layout = [round(width / 3 * 0.84 * h / w) + TITLE_PX + 16], [["z", "x", "y"]]
    drawing = new_figure(width, sum(heights))
    places = drawing.subplot_mosaic(layout, height_ratios=heights)
    medians = [percentile(rms, 50) for rms in rms_mm]
    for name, rms, median in zip("zxy", rms_mm, medians, strict=True):
        axes, top = places[name], round_up(percentile(rms, 99))
        style_image_axes(axes, f"{name}: {_format_median(median)}")
        image = draw_map(axes, rms, "viridis", 100, 0, top)
        label = "" if narrow and name != "z" else "RMS of the fit, mm"
        add_colour_bar(drawing, image, axes, label, extend="max")
    named = f" along axis {axis}" if axis else ""
    return finish_figure(
        drawing,
        f"RMS of each camera pixel's fit over the target poses{named}, in z, x and y. Each colour"
        " scale ends at the 99th percentile; grey pixels saw the board too rarely to be fitted.",
        "Three maps of the fit's RMS in z, x and y; "
        + ", ".join(
            f"{name} {_format_median(median)}" for name, median in zip("zxy", medians, strict=True)
        ),
    )


def draw_error_maps(
    title: str,
    maps: Mapping[str, np.ndarray],
    rms_mm: Mapping[str, float],
    floor_mm: float = float("nan"),
    *,
    limit_mm: float | None = None,
    width: int = FULL,
    sign: str = "red is towards the camera",
) -> Figure:
    """Signed errors (h, w) mm of each model on one colour scale, cropped to the data, and their
    histograms.

    ``limit_mm`` ends the scale on either side (by default where 99 % of all errors lie within). A
    narrow figure has the histogram below the maps.
    """
    if not maps or len({m.shape for m in maps.values()}) != 1:
        raise InputError(
            f"the error maps of '{title}' differ in size, or there are none",
            "give each model's, one size",
        )
    rows, columns = _crop_slices(list(maps.values()))
    cropped = {model: errors[rows, columns] for model, errors in maps.items()}
    limit = limit_mm or error_limit(list(cropped.values()))
    h, w = next(iter(cropped.values())).shape
    drawing, axes, histogram, map_width = _arrange_axes(width, len(maps), h / w)
    drawing.suptitle(
        title, x=0.004, ha="left", fontsize=TITLE_PT + 1.5, color=INK, fontweight="bold"
    )
    image = None
    for ax, (model, errors) in zip(axes, cropped.items(), strict=True):
        style_image_axes(
            ax,
            f"{model}: {'RMS ' if map_width > WIDE_PX else ''}{rms_mm[model]:.3f} mm",
            model_colour(model),
        )
        image = draw_map(ax, errors, "RdBu_r", 101, -limit, limit)
    add_colour_bar(drawing, image, axes, "error, mm", extend="both")
    _draw_histogram(histogram, cropped, rms_mm, floor_mm, limit)
    listed = ", ".join(f"{model} {rms_mm[model]:.3f} mm" for model in maps)
    floor = f"; dotted: noise alone ({floor_mm:.3f} mm)" if np.isfinite(floor_mm) else ""
    return finish_figure(
        drawing,
        f"{title}: errors on one colour scale, {sign}; grey: not measured. Dashed: plus and minus"
        f" the RMS{floor}.",
        f"Error maps and histograms of {title}; RMS {listed}",
    )


SIGN = {"plane": "red is towards the camera", "sphere": "red is outwards"}
"""What a positive error of a shape means in its maps."""


def verification_maps(
    title: str,
    found: Verification,
    arrays: Mapping[str, np.ndarray],
    width: int = FULL,
    limit_mm: float | None = None,
) -> Figure:
    """Error maps of a verification, with its arrays."""
    names = {model: f"error_{model}" for model in found.models}
    maps = {model: arrays[name] for model, name in names.items() if name in arrays}
    floors = [found.models[model].noise_floor_mm for model in maps]
    floor = next((mm for mm in reversed(floors) if mm is not None), np.nan)
    return draw_error_maps(
        title, maps, found.rms_mm, floor, limit_mm=limit_mm, width=width, sign=SIGN[found.shape]
    )


def error_limit(maps: list[np.ndarray]) -> float:
    """Upper limit, mm, of a symmetric colour scale for all of ``maps``: 99 % of the absolute errors
    are below it."""
    samples = [thin_out(m.ravel(), 300_000) for m in maps]
    return round_up(percentile(np.abs(np.concatenate(samples)), 99))


def _arrange_axes(width: int, count: int, aspect: float) -> tuple[Any, Any, Any, int]:
    """Figure, the maps' axes, the histogram's, and the width of one map in CSS px."""
    names = [str(index) for index in range(count)]
    if width < 800:  # more than two maps in a row would be too small to read
        across = min(count, 2)
        rows = -(-count // across)
        map_width = int((width - 70) / across)
        map_height = int(map_width * min(aspect, 1.4)) + (TITLE_PX if rows > 1 else 0)
        height, heights = rows * map_height + 2 * TITLE_PX + 120, (*(map_height,) * rows, 120)
        filled = [*names, *["."] * (rows * across - count), *["histogram"] * across]
        layout, widths = np.reshape(filled, (-1, across)).tolist(), [1.0] * across
    else:
        map_width = int((width - 90) / (count + 1.1))
        height, heights = int(np.clip(map_width * aspect, 200, 460)) + 2 * TITLE_PX + 8, (1,)
        layout, widths = [[*names, "histogram"]], [*[1.0] * count, 1.1]
    drawing = new_figure(width, height)
    places = drawing.subplot_mosaic(layout, width_ratios=widths, height_ratios=heights)
    return drawing, [places[name] for name in names], places["histogram"], map_width


def _draw_histogram(
    axes: Any,
    maps: Mapping[str, np.ndarray],
    rms_mm: Mapping[str, float],
    floor_mm: float,
    limit: float,
) -> None:
    """Draw the histogram of each model's errors, mm, with its RMS; dotted: the distribution of
    noise alone."""
    reach = 1.25 * limit
    edges = np.linspace(-reach, reach, BINS)
    centres = (edges[1:] + edges[:-1]) / 2
    style_axes(axes, "", "error, mm", "share of points")
    for model, errors in maps.items():
        finite = errors[np.isfinite(errors)]
        counts, _ = np.histogram(finite, BINS - 1, (-reach, reach))
        density = counts / max(finite.size, 1) / (edges[1] - edges[0])
        colour = model_colour(model)
        axes.fill_between(centres, density, color=colour, alpha=0.22, linewidth=0)
        axes.plot(centres, density, color=colour, linewidth=1.4, label=model)
        for side in (-1, 1):
            axes.axvline(side * rms_mm[model], color=colour, linewidth=1.1, linestyle=(0, (4, 2)))
    if np.isfinite(floor_mm) and floor_mm > 0:
        noise = np.exp(-0.5 * (centres / floor_mm) ** 2) / (floor_mm * np.sqrt(2 * np.pi))
        axes.plot(centres, noise, color=SOFT, linewidth=1.1, linestyle=":", label="noise alone")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(bottom=0)
    axes.set_yticks([])
    add_legend_above(axes, 4, columnspacing=1.1)


def _crop_slices(maps: list[np.ndarray]) -> tuple[slice, slice]:
    """Rows and columns around the finite pixels of any map, with a small margin; everything where
    there is none."""
    finite = np.logical_or.reduce([np.isfinite(m) for m in maps])
    if not finite.any():
        return slice(None), slice(None)
    spans = []
    for along in (1, 0):
        hit = np.nonzero(finite.any(axis=along))[0]
        margin = max(2, (hit[-1] - hit[0]) // 50)
        spans.append(slice(max(hit[0] - margin, 0), hit[-1] + margin + 1))
    return spans[0], spans[1]


def _format_median(value: float) -> str:
    """Text of a median RMS in mm; "no pixel fitted" for NaN."""
    return f"median {value:.3f} mm" if np.isfinite(value) else "no pixel fitted"


REASON_LABELS = {
    Reason.VALID: "valid",
    Reason.DARK: "dark",
    Reason.SATURATED: "saturated",
    Reason.INCONSISTENT: "inconsistent",
    Reason.OUTSIDE: "outside of the projector",
    Reason.INDIRECT: "indirect light",
    Reason.UNSEEN: "not seen by the second camera",
}
REASON_COLOURS = {
    Reason.DARK: "#3a424b",
    Reason.SATURATED: "#e5322d",
    Reason.INCONSISTENT: "#ff8ad8",
    Reason.OUTSIDE: "#ffffff",
    Reason.INDIRECT: "#ff9a1f",
    Reason.UNSEEN: "#4f9dde",
}
"""None of them occurs in the colour scale of the coordinates."""
_AROUND_PX = 96  # titles above, the legend below


def reason_shares(phase: PhaseMap) -> dict[Reason, float]:
    """Share of the pixels for each reason, VALID included, 0 to 1; without UNSEEN where no second
    camera is the reason."""
    counts = np.bincount(phase.reason.ravel(), minlength=max(Reason) + 1)
    shares = {reason: float(counts[reason] / max(1, phase.reason.size)) for reason in Reason}
    return {why: share for why, share in shares.items() if share or why != Reason.UNSEEN}


def phase_maps(title: str, phases: PhaseMaps) -> Figure:
    """The coordinates of each axis side by side; masked pixels in the colour of their reason, with
    their shares."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    h, w = next(iter(phases.values())).reason.shape
    map_px = (FULL - 70 * len(phases)) // len(phases)
    height = round(map_px * h / w) + _AROUND_PX
    drawing = new_figure(FULL, height)
    drawing.suptitle(title, x=0.004, ha="left", fontsize=SMALL_PT + 3, color=INK, fontweight="bold")
    step = max(1, -(-w // (DENSITY * map_px)))
    palette = ListedColormap(list(REASON_COLOURS.values()))
    for axes, (axis, phase) in zip(
        np.atleast_1d(drawing.subplots(1, len(phases))), phases.items(), strict=True
    ):
        shares = reason_shares(phase)
        style_image_axes(
            axes, f"axis {axis}: {100 * shares[Reason.VALID]:.1f} % of the pixels valid"
        )
        coordinate, reason = phase.coordinate[::step, ::step], phase.reason[::step, ::step]
        if not np.isfinite(coordinate).any():  # one value keeps the colour scale finite
            coordinate = np.zeros_like(coordinate)
        image = axes.imshow(
            np.ma.masked_invalid(coordinate),
            cmap="viridis",
            aspect="equal",
            interpolation="nearest",
        )
        cover = np.ma.masked_equal(reason, Reason.VALID)
        axes.imshow(
            cover,
            palette,
            aspect="equal",
            interpolation="nearest",
            vmin=min(REASON_COLOURS),
            vmax=max(REASON_COLOURS),
        )
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
            if code in shares
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


DATA = "#c2502e"
_Fitted = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class PixelCurve:
    """One camera pixel's data, (n,) each, and the functions fitted to it (the Letter, eq. 9-11).

    ``coefficients`` (5,) c0 ... c4 for phase in rad and lengths in mm; ``rms_mm`` (3,) in z, x, y.
    """

    pixel: tuple[int, int]
    axis: str
    phase: np.ndarray
    z: np.ndarray
    x: np.ndarray
    y: np.ndarray
    coefficients: np.ndarray
    rms_mm: np.ndarray


def pixel_curves(curve: PixelCurve, *, width: int = FULL) -> Figure:
    """The rational function and the two lines of one camera pixel with their data, residuals in um
    below.

    A narrow figure has one curve a row, its residuals beside it.
    """
    known = np.isfinite([curve.phase, curve.z, curve.x, curve.y]).all(axis=0)
    phase, z, x, y = (np.asarray(v, float)[known] for v in (curve.phase, curve.z, curve.x, curve.y))
    c0, c1, c2, c3, c4 = curve.coefficients

    def depth(at: np.ndarray) -> np.ndarray:
        """Depth z in mm by the rational function, at projector coordinates (n,)."""
        return (c0 + c1 * at) / (1 + c2 * at)

    curves: tuple[tuple[str, str, np.ndarray, np.ndarray, _Fitted], ...] = (
        ("z over phase (eq. 9)", "absolute phase, rad", phase, z, depth),
        ("x over z (eq. 10)", "z, mm", z, x, partial(np.multiply, c3)),
        ("y over z (eq. 11)", "z, mm", z, y, partial(np.multiply, c4)),
    )
    narrow = width <= HALF
    if narrow:
        layout = [["0", "residuals 0"], ["1", "residuals 1"], ["2", "residuals 2"]]
        height, ratios = 540, {"width_ratios": (1.35, 1.0)}
    else:
        layout = [["0", "1", "2"], ["residuals 0", "residuals 1", "residuals 2"]]
        height, ratios = 400, {"height_ratios": (3.0, 1.15)}
    drawing = new_figure(width, height)
    places = drawing.subplot_mosaic(layout, **ratios)
    for i, (title, along, at, values, fitted) in enumerate(curves):
        name, rms = "zxy"[i], curve.rms_mm[i]
        upper, lower = places[str(i)], places[f"residuals {i}"]
        lower.sharex(upper)
        stated = f"RMS {1e3 * rms:.0f} µm"
        style_axes(upper, f"{title}: {stated}", along if narrow else "", f"{name}, mm")
        style_axes(lower, "", along, f"{name} - fit, µm")
        upper.tick_params(labelbottom=narrow)
        if phase.size:
            _draw_fit(upper, lower, at, values, fitted)
            if i == 0:
                add_legend(upper, loc="best")
        lower.axhline(0, color=SOFT, linewidth=0.8)
    u, v = curve.pixel
    listed = ", ".join(
        f"{name} {1e3 * rms:.0f} µm" for name, rms in zip("zxy", curve.rms_mm, strict=True)
    )
    return finish_figure(
        drawing,
        f"Fit of camera pixel ({u}, {v}) to {phase.size} target poses: z as a rational function of"
        f" the absolute phase of axis {curve.axis}, x and y as lines through the camera's centre."
        f" {'Beside' if narrow else 'Below'}: the residuals (RMS {listed}).",
        f"Curves of z over phase, x over z and y over z at camera pixel ({u}, {v}) with residuals;"
        f" RMS {listed}",
    )


def _draw_fit(
    upper: Any,
    lower: Any,
    at: np.ndarray,
    values: np.ndarray,
    fitted: _Fitted,
) -> None:
    """Draw values (n,) mm of a pixel over phases or depths (n,) with the function fitted to them
    into the upper axes, the residuals in um into the lower ones."""
    margin = 0.06 * (np.ptp(at) or 1.0)
    line = np.linspace(at.min() - margin, at.max() + margin, 200)
    upper.plot(line, fitted(line), color=MODELS["pixelwise"], linewidth=1.5, label="fit")
    style: dict[str, Any] = {"color": DATA, "markeredgewidth": 0}
    upper.plot(at, values, "o", markersize=4.2, alpha=0.85, label="target poses", **style)
    residuals = 1e3 * (values - fitted(at))
    lower.vlines(at, 0, residuals, color=DATA, linewidth=0.9, alpha=0.6)
    lower.plot(at, residuals, "o", markersize=3.4, **style)
    reach = 1.25 * max(float(np.abs(residuals).max()), 1.0)
    lower.set_ylim(-reach, reach)


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


def residual_arrows(title: str, pixels: np.ndarray, residuals: np.ndarray, size: Size) -> Figure:
    """Residuals (n, 2) px as arrows at ``pixels`` (n, 2) in an image of ``size`` = (width, height),
    magnified, at most ``MOST_ARROWS``; consecutive ones are neighbours, and the caption says
    whether these agree."""
    shared = shared_rms(residuals)
    known = finite_rows(pixels, residuals)
    at, away = pixels[known], residuals[known]
    lengths = np.hypot(away[:, 0], away[:, 1])
    rms = rms_length(away) if len(away) else np.nan
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


def coverage(title: str, size: Size, poses: Sequence[np.ndarray]) -> Figure:
    """Figure of the features (n, 2) px of each pose in an image of ``size``, their hulls and
    covered share."""
    import cv2

    coverage_count = np.zeros((size[1], size[0]), np.uint8)
    hulls = []
    for pixels in poses:
        known = pixels[finite_rows(pixels)].astype(np.float32)
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


def _new_image_axes(size: Size, title: str) -> tuple[Any, Any]:
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
