"""Pictures of surfaces: shaded views of scans and of merged clouds, sections, and surfaces coloured
by their deviation from a nominal model."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.geometry.vectors import finite_rows, subsample, thin_out
from slviewer.inspection.deviation import EXCLUDED_COLOUR, colour_limit, deviation_colours
from slviewer.records.measurement import NominalDeviation
from slviewer.report.page import (
    DENSITY,
    FULL,
    HALF,
    INK,
    SOFT,
    TEXT_PT,
    Figure,
    add_colour_bar,
    add_legend,
    finish_figure,
    label_point,
    new_figure,
    round_up,
    style_axes,
    style_image_axes,
)
from slviewer.surface.fuse import Fused

LIGHT = np.array([-0.45, -0.36, -0.82]) / np.linalg.norm([-0.45, -0.36, -0.82])
"""Towards the light, in the view's frame (x right, y down, z away): from above, left of the
viewer."""
AMBIENT = 0.34
BACKGROUND = (246, 248, 250)


def view_rotation(yaw_deg: float, pitch_deg: float) -> NDArray[np.float64]:
    """(3, 3) rotation of camera-frame points into the view's frame: the viewer steps aside by yaw
    and up by pitch."""
    turn = cv2.Rodrigues(np.radians([0, yaw_deg, 0]))[0].T
    tilt = cv2.Rodrigues(np.radians([pitch_deg, 0, 0]))[0]
    return np.asarray(tilt @ turn)


def render_points(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    colours: NDArray[np.floating],
    size: tuple[int, int],
    rotation: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: an orthographic view of points (n, 3) that fills ``size`` = (width,
    height).

    ``normals`` (n, 3) NaN where unknown; ``colours`` (n, 3) 0 to 1. Points that are not finite are
    skipped.
    """
    width, height = size
    background = np.array(BACKGROUND, np.float32) / 255
    known = finite_rows(points)
    if known.sum() < 3:
        return np.full((height, width, 3), BACKGROUND, np.uint8)
    view = points[known] @ rotation.T
    colours = colours[known] * _shade_lambert(normals[known] @ rotation.T)[:, None]
    low, high = np.percentile(view, [0.3, 99.7], axis=0)
    scale = 0.92 * float(
        min(width / max(high[0] - low[0], 1e-6), height / max(high[1] - low[1], 1e-6))
    )
    uv = np.round(
        (view[:, :2] - (low + high)[:2] / 2) * scale + np.array([width / 2, height / 2])
    ).astype(np.intp)
    inside = ((uv >= 0) & (uv < size)).all(axis=1)
    index, z, colours = uv[inside] @ [1, width], view[inside, 2], colours[inside]

    cells = width * height
    depth = np.full(cells, np.inf, np.float32)
    np.minimum.at(depth, index, z)
    # the points' spacing, px: in the area that they cover once gaps of up to 10 px are closed
    occupied = np.isfinite(depth).reshape(height, width).astype(np.uint8)
    covered = int(cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, np.ones((10, 10), np.uint8)).sum())
    sigma = float(np.clip(0.7 * np.sqrt(covered / max(occupied.sum(), 1)), 0.6, 5.0))
    reach = 2 * int(np.ceil(1.5 * sigma)) + 1
    nearest = cv2.erode(depth.reshape(height, width), np.ones((reach, reach), np.uint8)).ravel()
    # behind the front, noise in depth decides nothing
    front = z <= nearest[index] + 2.5 * reach / scale
    layers = [
        np.bincount(index[front], weights, cells)
        for weights in (*colours[front].T, np.ones(front.sum()))
    ]
    summed = np.stack(layers, axis=-1).reshape(height, width, 4).astype(np.float32)
    blurred = cv2.GaussianBlur(summed, (0, 0), sigma)
    weight = blurred[..., 3:]
    image = np.where(
        weight > 0.03 * occupied.sum() / covered,
        blurred[..., :3] / np.maximum(weight, 1e-9),
        background,
    )
    return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)


def _shade_lambert(normals: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n,) factor of Lambert's law with ambient light, for unit normals (n, 3); NaN normals face
    the viewer."""
    facing = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, [0.0, 0.0, -1.0])
    return np.asarray(AMBIENT + (1.08 - AMBIENT) * np.clip(facing @ LIGHT, 0, 1))


YAW_DEG, PITCH_DEG = 24.0, 18.0
SCANS = ("#5b8fd0", "#e0a13c", "#63b28a", "#c8718f", "#8f83c9")
CLAY = (0.80, 0.79, 0.77)
PICTURE = (DENSITY * HALF, DENSITY * 396)
"""Width and height of the pictures of a title page, px."""
MOST_POINTS = 300_000
"""Points drawn of one cloud: more change nothing at the size of a page."""


SQUARES, FINER = 14, 8
"""Squares across a chequered view, and how much finer it is told which scans measured there."""


def draw_clouds(clouds: Mapping[str, np.ndarray]) -> Figure:
    """The scans, points (h, w, 3) mm, side by side, each coloured by its own depth."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    columns = min(len(clouds), 3)
    rows = -(-len(clouds) // columns)
    width = FULL // 3 if columns > 1 else 760
    across, down = round(0.76 * width), round(0.66 * width)
    drawing = new_figure(columns * width, rows * (down + 62))
    axes = drawing.subplots(rows, columns, squeeze=False).ravel()
    size = (DENSITY * across, DENSITY * down)
    palette = ListedColormap(colormaps["YlGnBu_r"](np.linspace(0.18, 0.92, 256)))
    for ax, (name, cloud) in zip(axes, clouds.items(), strict=False):
        points, normals = _sample_grid(cloud)
        z = points[:, 2]
        near, far = (np.percentile(z, [1, 99]) if len(z) else (0.0, 1.0)) + np.array([-1e-3, 1e-3])
        shades = palette(np.clip((z - near) / (far - near), 0, 1))[:, :3]
        picture = render_points(points, normals, shades, size, view_rotation(YAW_DEG, PITCH_DEG))
        style_image_axes(ax, name)
        ax.imshow(picture)
        ax.set_xlabel(_format_count(cloud), fontsize=TEXT_PT, color=INK, loc="left")
        add_colour_bar(
            drawing,
            ScalarMappable(Normalize(near, far), palette),
            ax,
            "z, mm",
            shrink=0.7,
            aspect=20,
        )
    for ax in axes[len(clouds) :]:
        ax.set_axis_off()
    return finish_figure(
        drawing,
        "Each scan as measured, seen from above and aside, shaded by its own surface normals and"
        " coloured by depth.",
        "Shaded views of "
        + ", ".join(f"{name} ({_format_count(cloud)})" for name, cloud in clouds.items()),
    )


def draw_photo(name: str, texture: np.ndarray, points: np.ndarray) -> Figure:
    """The part as the camera sees it: ``texture`` (h, w) or (h, w, 3) uint8 around the measured
    pixels of ``points`` (h, w, 3)."""
    (h, w), (width, height) = texture.shape[:2], PICTURE
    v, u = np.nonzero(np.isfinite(points[..., 2]))
    box = (u.min(), u.max() + 1, v.min(), v.max() + 1) if len(u) else (0, w, 0, h)
    # a cut-out of the picture's shape, with a margin, as far as the image has it
    tall = min(
        1.15 * max(box[3] - box[2], (box[1] - box[0]) * height / width), h, w * height / width
    )
    size = max(round(tall * width / height), 1), max(round(tall), 1)
    left, top = (
        int(np.clip((low + high - length) // 2, 0, full - length))
        for low, high, length, full in zip(box[::2], box[1::2], size, (w, h), strict=True)
    )
    shown = texture[top : top + size[1], left : left + size[0]]
    way = cv2.INTER_AREA if size[0] > width else cv2.INTER_CUBIC
    resized = cv2.resize(np.ascontiguousarray(shown), PICTURE, interpolation=way)
    image = np.asarray(resized, np.uint8)
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    words = f"The part as the camera sees it ({name})"
    return Figure(rgb, f"{words}.", words, HALF)


def draw_surface(words: str, points: np.ndarray, normals: np.ndarray | None) -> Figure:
    """A surface of ``points`` (n, 3) mm in clay, seen from above and aside; ``normals`` (n, 3) NaN
    or None where unknown; ``words``: what it is of."""
    shown = subsample(points, MOST_POINTS)
    facing = np.full_like(shown, np.nan) if normals is None else subsample(normals, MOST_POINTS)
    clay = np.broadcast_to(CLAY, shown.shape)
    image = render_points(shown, facing, clay, PICTURE, view_rotation(YAW_DEG, PITCH_DEG))
    words = f"{words}, {_format_count(points)}"
    return Figure(image, f"{words}, shaded.", f"Shaded view of the surface: {words}", HALF)


def draw_merged_cloud(fused: Fused) -> Figure:
    """The merged cloud: illuminated as one surface, and coloured by the scan that each point comes
    from."""
    from matplotlib.colors import to_rgba_array

    surface = fused.surface
    assert surface.normals is not None
    points, normals, source = (
        subsample(each, MOST_POINTS) for each in (surface.points, surface.normals, fused.source)
    )
    source, count = source.astype(np.intp), _format_count(surface.points)
    size = (2 * HALF - 40, 2 * HALF - 240)
    rotation = view_rotation(YAW_DEG, PITCH_DEG)
    drawing = new_figure(FULL, HALF - 40)
    left, right = drawing.subplots(1, 2)
    style_image_axes(left, "as one surface")
    left.imshow(render_points(points, normals, np.broadcast_to(CLAY, points.shape), size, rotation))
    left.set_xlabel(count, fontsize=TEXT_PT, color=INK, loc="left")
    style_image_axes(right, "by scan, in turns")
    palette = to_rgba_array(SCANS)[:, :3]
    shown = _select_mosaic(points, source) if len(points) else np.arange(0)
    points, normals, source = points[shown], normals[shown], source[shown]
    right.imshow(render_points(points, normals, palette[source % len(SCANS)], size, rotation))
    for i, name in enumerate(fused.names):
        right.plot([], [], "s", color=SCANS[i % len(SCANS)], markersize=8, label=name)
    add_legend(
        right,
        loc="upper left",
        bbox_to_anchor=(0, 0),
        ncols=max(len(fused.names), 1),
        handletextpad=0.2,
    )
    return finish_figure(
        drawing,
        "The merged cloud in the reference scan's frame. Right: each square shows the points of one"
        " scan alone, so that a step where squares meet would be a misalignment.",
        f"Shaded views of the merged cloud, {count}, as one surface and coloured by scan",
    )


def _sample_grid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) of at most MOST_POINTS measured points (h, w, 3), evenly
    thinned."""
    from slviewer.reconstruction.reconstruct import normals

    step = max(1, int(np.ceil(np.sqrt(np.isfinite(points[..., 2]).sum() / MOST_POINTS))))
    points = np.ascontiguousarray(points[::step, ::step], np.float32)
    known = np.isfinite(points).all(axis=2)
    return points[known], normals(points)[known]


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


def _format_count(points: np.ndarray) -> str:
    """Text with the number of valid points."""
    return f"{np.isfinite(points[..., 2]).sum():,} points"


Lines = Sequence[NDArray[np.floating]]
DEVIATION_PICTURE = (DENSITY * 560, DENSITY * 420)
"""Width and height of the picture of a deviation, px."""
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
        axes.plot(*thin_out(line, MOST_DRAWN).T, color=LINE, linewidth=1.3)
    for (letter, cursor), colour in zip((cursors or {}).items(), CURSOR_COLOURS, strict=False):
        axes.axvline(cursor[0], color=colour, linewidth=0.9, linestyle=":")
        axes.plot(*cursor, "o", color=colour, markersize=5)
        label_point(axes, letter, cursor, (4, 5), color=colour, fontsize=10, weight="bold")
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
            DEVIATION_PICTURE,
            view_rotation(12.0, 10.0),
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
