"""How points are coloured in the steps Scan, Merge and Measure: one table of colourings, their
legends, and the shading that shows the shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from slviewer.gui.scene import Colour
from slviewer.gui.widgets import Html, colour_bar, colours, note, paint, paragraph, to_html
from slviewer.pipeline.measure import MeasuredSurface
from slviewer.reconstruction.reconstruct import cloud_normals
from slviewer.report.maps import error_limit
from slviewer.session.ply import Ply
from slviewer.wizard.result_views import ScanCloud

SHAPE, TEXTURE, DEPTH, UNCERTAINTY = "shape", "texture", "depth", "uncertainty"
SCAN, SEEN, DISTANCE, ERROR = "scan", "seen", "distance between scans", "error"
SCAN_COLOURS: tuple[Colour, ...] = (
    (91, 143, 208), (224, 161, 60), (99, 178, 138), (200, 113, 143), (143, 131, 201),
    (120, 120, 120),
)  # fmt: skip
SEEN_COLOURS: tuple[Colour, ...] = ((232, 140, 30), (20, 150, 140))
SEEN_TITLES = ("seen by one scan", "by more than one")
_GREY: Colour = (190, 190, 190)
_LIGHT = np.array([-0.35, -0.5, -0.79])
"""(3,) unit vector to the light, which stands above the camera, to its left."""
_SHADOW = 0.2
"""Brightness of what faces away from the light."""


@dataclass(frozen=True)
class _Colouring:
    """What a colour stands for: its unit, digits, and factor from the stored unit; how it is drawn;
    and what is shown where it is not known."""

    unit: str = "mm"
    digits: int = 3
    factor: float = 1.0
    kind: Literal["value", "amount", "error", "category", "image", "plain"] = "value"
    missing: str = "Not known of these points."


_MERGE_AGAIN = "Not stored with this merge: merge again."
COLOURINGS: dict[str, _Colouring] = {
    SHAPE: _Colouring(kind="plain"),
    TEXTURE: _Colouring(kind="image", missing="There is no texture."),
    DEPTH: _Colouring(digits=1),
    "modulation": _Colouring("grey levels", 0),
    "noise": _Colouring(),
    UNCERTAINTY: _Colouring(missing=_MERGE_AGAIN),
    ERROR: _Colouring(
        kind="error", missing="No errors yet: measure this capture in the step Verify."
    ),
    DISTANCE: _Colouring(kind="amount", missing="No two scans lie on each other."),
    SCAN: _Colouring(kind="category", missing=_MERGE_AGAIN),
    SEEN: _Colouring(kind="category", missing=_MERGE_AGAIN),
}
"""What can colour points."""
SCAN_COLOURINGS = (TEXTURE, SHAPE, DEPTH, "modulation", "noise", UNCERTAINTY, ERROR)
MERGE_COLOURINGS = (DISTANCE, SHAPE, TEXTURE, SCAN, SEEN, UNCERTAINTY, DEPTH)
ALIGNED_COLOURINGS = (SCAN, SHAPE, TEXTURE)
SURFACE_COLOURINGS = (TEXTURE, SHAPE, DEPTH, UNCERTAINTY)


@dataclass(frozen=True, eq=False)
class PointValues:
    """Points (..., 3) mm, their unit normals (..., 3), and what is known of each, by the names of
    COLOURINGS: (...) numbers, NaN where unknown; a texture is (...) or (..., 3) uint8, a category
    counts from 0. ``titles``: of the legend, where other than the name; ``categories``: titles of
    each."""

    points: np.ndarray
    normals: np.ndarray | None
    values: Mapping[str, np.ndarray | None]
    titles: Mapping[str, str] = field(default_factory=dict)
    categories: Mapping[str, tuple[Sequence[str], Sequence[Colour]]] = field(default_factory=dict)


def paint_points(shown: PointValues, colour: str) -> tuple[np.ndarray, Html]:
    """Return the colours (..., 3) uint8 of points by one of COLOURINGS, shaded, and the legend;
    grey where it is not known."""
    how, values = COLOURINGS[colour], shown.values.get(colour)
    title = shown.titles.get(colour, colour)
    painted = np.broadcast_to(np.array(_GREY, np.uint8), shown.points.shape)
    legend = Html("")
    if how.kind == "plain":
        pass
    elif values is None:
        legend = note(how.missing, "warning")
    elif how.kind == "image":
        painted = values
    elif how.kind == "category":
        titles, palette = shown.categories[colour]
        painted = np.array(palette, np.uint8)[values.astype(np.int64) % len(palette)]
        legend = format_patches(titles, palette)
    elif how.kind == "error":
        limit = error_limit([values])
        painted = colours(values, -limit, limit, "error")
        legend = colour_bar(f"−{limit:g} {how.unit}", f"+{limit:g} {how.unit}", "error", title)
    else:
        known = np.where(np.isfinite(shown.points[..., 2]), how.factor * values, np.nan)
        unknown = np.isnan(known) & np.isfinite(shown.points[..., 2])
        grey = "; grey: unknown" if unknown.any() else ""
        painted, legend = paint(known, how.unit, how.digits, f"{title}{grey}", how.kind)
    return shade(painted, shown.normals), in_view(legend)


def shade(painted: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """Return colours (..., 3) of colours or grey levels (...) uint8, darker where the unit normals
    (..., 3) are turned away from the light."""
    if normals is None:
        return painted
    if painted.ndim < normals.ndim:
        painted = np.repeat(painted[..., None], 3, axis=-1)
    facing = 0.5 + 0.5 * (normals @ _LIGHT.astype(np.float32))
    share = np.where(np.isfinite(facing), _SHADOW + (1 - _SHADOW) * facing**2, 0.5)
    return np.asarray(painted * share[..., None].astype(np.float32)).astype(np.uint8)


def in_view(legend: str) -> Html:
    """Return a legend that the page shows in the 3D view, in its lower right corner."""
    return Html(f"<div data-legend>{legend}</div>" if legend else "")


def patch(colour: Colour) -> Html:
    """Return a square of a colour, for a legend."""
    return Html(f'<span style="color:rgb{tuple(colour)};font-size:1.3em">■</span>')


def format_patches(titles: Sequence[str], palette: Sequence[Colour]) -> Html:
    """Return a legend with a coloured square for each title."""
    items = [
        f"<span>{patch(palette[i % len(palette)])} {to_html(title)}</span>"
        for i, title in enumerate(titles)
    ]
    row = (
        '<div style="display:flex;flex-wrap:wrap;gap:0'
        f' 1em;align-items:center">{"".join(items)}</div>'
    )
    return paragraph(Html(row) if items else "")


def scan_values(cloud: ScanCloud) -> PointValues:
    """Return what is known of the points of a scan."""
    model = cloud.model if cloud.model in cloud.errors else next(iter(cloud.errors), "")
    title = "uncertainty of z (1 sigma), noise and calibration"
    if cloud.sigma_calibration is None:
        title = f"uncertainty of z (1 sigma), noise only: unknown for the model {cloud.model}"
    values = {
        TEXTURE: cloud.texture,
        DEPTH: cloud.points[..., 2],
        "modulation": cloud.modulation,
        "noise": cloud.sigma_z,
        UNCERTAINTY: uncertainty(cloud),
        ERROR: cloud.errors.get(model),
    }
    titles = {UNCERTAINTY: title, ERROR: f"error of {model}"}
    return PointValues(cloud.points, cloud_normals(cloud), values, titles)


def merge_values(
    surface: Ply, scans: Sequence[str], spread_mm: np.ndarray | None = None
) -> PointValues:
    """Return what is known of the points of a merged surface, from ``scans`` of these titles, which
    lie ``spread_mm`` (n,) apart."""
    known = surface.scalars
    sigma, seen_by = known.get("sigma"), known.get("seen_by")
    values = {
        TEXTURE: surface.colours,
        DEPTH: surface.points[:, 2],
        SCAN: known.get("source"),
        SEEN: None if seen_by is None else seen_by > 1,
        UNCERTAINTY: None if sigma is None else np.where(sigma > 0, sigma, np.nan),
        DISTANCE: spread_mm,
    }
    titles = {UNCERTAINTY: "uncertainty along the normal (1 sigma)"}
    categories = {SCAN: (scans, SCAN_COLOURS), SEEN: (SEEN_TITLES, SEEN_COLOURS)}
    return PointValues(surface.points, surface.normals, values, titles, categories)


def surface_values(on: MeasuredSurface) -> PointValues:
    """Return what is known of the points of a surface to measure on."""
    sigma = on.sigma_mm if on.left_mm is None else np.hypot(on.sigma_mm, on.left_mm)
    what = "uncertainty of z" if on.organised else "uncertainty along the normal"
    title = f"{what} (1 sigma){'' if on.left_mm is not None else ', noise only'}"
    values = {
        TEXTURE: on.texture,
        DEPTH: on.points[..., 2],
        UNCERTAINTY: np.where(on.measured, sigma, np.nan),
    }
    return PointValues(on.points, on.normals, values, {UNCERTAINTY: title})


def uncertainty(cloud: ScanCloud) -> np.ndarray:
    """Return the standard deviation of z (h, w) mm from noise, calibration and edges, as far as
    known."""
    sigma = np.where(np.isfinite(cloud.points[..., 2]), cloud.sigma_z, np.nan)
    for part in (cloud.sigma_calibration, cloud.sigma_edges):
        sigma = sigma if part is None else np.hypot(sigma, part)
    return np.asarray(sigma)
