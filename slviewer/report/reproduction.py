"""Report sections of the Letter's experiments, repeated: figures and tables, the Letter's values
beside ours."""

from collections.abc import Sequence

import numpy as np

from slviewer.records.table import Cell, Column, Table
from slviewer.report.canvas import HALF
from slviewer.report.data import PlaneRow, ReproductionData
from slviewer.report.maps import draw_error_maps, error_limit, pixel_curves, rms_maps
from slviewer.report.page import Headline, Item, PageNotice, Section
from slviewer.report.planes import planes_in_space, rms_bars
from slviewer.report.surfaces import draw_clouds, draw_merged_cloud
from slviewer.report.tables import (
    format_number,
    known_mean,
    merge_table,
    plane_table,
    spacing_error,
    spacing_table,
    sphere_table,
)

BASE, OURS = "stereo", "pixelwise"
INSIDE_PERCENT = 87.0
"""A plane with this share in R2 counts as inside the calibrated depths, as do the Letter's poses 3,
4, 9 and 10."""
LETTER = (
    "The Letter: Vargas, Romero, Zhang and Marrugo, Pixel-wise rational model for a structured"
    " light system, Optics Letters 2023"
)


def reproduction_title(data: ReproductionData) -> tuple[str, str]:
    """The page's title and the sentence below it."""
    size = f"camera {_format_size(data.camera)}, projector {_format_size(data.projector)} px"
    quick = "Quick run at reduced resolution: its figures are its own. " if data.quick else ""
    return (
        "The Letter's experiments, repeated on a simulated rig",
        (
            f"{quick}A rig of the Letter's geometry with local lens distortion and camera noise,"
            f" seed {data.seed}: {size}, calibrated by {data.poses} target poses at"
            f" {_format_depths(data)}. {LETTER}."
        ),
    )


def reproduction_headlines(data: ReproductionData) -> list[Headline]:
    """Headlines: flatness, flatness inside R2, sphere radius and spacing of spheres: stereo against
    pixelwise."""
    mean = {m: known_mean([row.rms_mm.get(m, np.nan) for row in data.planes]) for m in (BASE, OURS)}
    letter = {
        m: known_mean([row.letter_rms_mm.get(m, np.nan) for row in data.planes])
        for m in (BASE, OURS)
    }
    floor = known_mean([row.noise_floor_mm.get(OURS, np.nan) for row in data.planes])
    ratio, count = inside_ratio(data.planes)
    wins = sum(row.rms_mm.get(OURS, np.inf) < row.rms_mm.get(BASE, -np.inf) for row in data.planes)
    radius = {
        m: known_mean(
            [abs(row.radius_mm.get(m, np.nan) - row.true_radius_mm) for row in data.spheres]
        )
        for m in (BASE, OURS)
    }
    spacing = {m: spacing_error(data.spacings, m) for m in (BASE, OURS)}
    headlines = [
        _pair_headline(
            "mean plane RMS, all poses",
            mean,
            f"stereo → pixelwise; noise floor {_format_mm(floor)}. The Letter:"
            f" {_format_pair(letter)}",
        ),
        Headline(
            f"{ratio:.2f} ×" if np.isfinite(ratio) else "–",
            "flatter inside R2, pixelwise against stereo",
            f"mean of the {count} planes at least {INSIDE_PERCENT:.0f} % inside; pixelwise is ahead"
            f" on {wins} of all {len(data.planes)}",
            "better" if ratio > 1 else "worse" if ratio < 1 else "",
        ),
    ]
    if data.spheres:
        headlines.append(
            _pair_headline(
                "error of the sphere's radius",
                radius,
                "stereo → pixelwise; mean size over the spheres",
            )
        )
    if data.spacings:
        headlines.append(
            _pair_headline(
                "error of spheres' spacing", spacing, "stereo → pixelwise; mean size over the pairs"
            )
        )
    return headlines


def reproduction_sections(data: ReproductionData) -> list[Section]:
    """Sections: the calibration, the planes, the spheres and the merged object, in the Letter's
    order."""
    return [
        _calibration_section(data),
        _planes_section(data),
        _spheres_section(data),
        _merged_section(data),
    ]


def inside_ratio(rows: Sequence[PlaneRow]) -> tuple[float, int]:
    """Mean stereo RMS over mean pixelwise RMS of the planes inside R2, and how many these are."""
    inside = [row for row in rows if row.incidence.get("R2", 0.0) >= INSIDE_PERCENT]
    base, ours = (known_mean([row.rms_mm.get(m, np.nan) for row in inside]) for m in (BASE, OURS))
    return (base / ours if ours > 0 else float("nan")), len(inside)


def _calibration_section(data: ReproductionData) -> Section:
    """The section about the calibration: notices, reprojection errors, per-pixel fits and
    curves."""
    items: list[Item] = [PageNotice(note) for note in data.notes]
    items += [
        PageNotice(f"{name} was excluded: {why}") for name, why in data.poses_left_out.items()
    ]
    rows: list[list[str | Cell]] = [
        [
            f"reprojection, {device}",
            "px",
            format_number(data.reprojection_rms_px.get(device, np.nan)),
            format_number(data.letter_reprojection_rms_px.get(device, np.nan)),
        ]
        for device in ("camera", "projector")
    ]
    rows += [
        [
            f"pixel-wise fit in {axis}, median over the pixels",
            "mm",
            format_number(data.fit_rms_mm.get(axis, np.nan)),
            bound,
        ]
        for axis, bound in zip("zxy", ("below 0.15",) * 3, strict=True)
    ]
    columns = [
        Column("RMS", align="left"),
        Column("unit", align="centre"),
        Column("this rig"),
        Column("the Letter's rig"),
    ]
    items.append(Table(columns, rows, "How well the calibration fits its own poses"))
    if data.pixel_curve is not None:
        items.append(pixel_curves(data.pixel_curve))
    items.append(rms_maps(data.rms_maps_mm, data.pixel_curve.axis if data.pixel_curve else ""))
    return Section(
        "Experiment 1: calibration",
        "Stereo calibration: both lenses and their poses from"
        f" {data.poses - len(data.poses_left_out)} target poses. The pixel-wise model then learns,"
        " for every camera pixel, how depth follows from the absolute phase, from the same poses"
        " projected onto their ideal planes.",
        items,
    )


def _planes_section(data: ReproductionData) -> Section:
    """The section about the planes: table, bars, positions in space and error maps."""
    near, far = data.depth_range_mm
    lost = [
        row.name for row in data.planes if row.rms_mm.get(OURS, 0.0) > row.rms_mm.get(BASE, np.inf)
    ]
    text = [
        f"A flat board is measured in front of (R1, nearer than {near:.0f} mm), inside (R2) and"
        f" behind (R3, beyond {far:.0f} mm) the depths that were calibrated, and each cloud is"
        " compared with its own best plane."
    ]
    items: list[Item] = []
    ratio, count = inside_ratio(data.planes)
    if count and np.isfinite(ratio):
        compared = (
            f"{ratio:.2f} times flatter" if ratio >= 1 else f"{1 / ratio:.2f} times less flat"
        )
        items.append(
            PageNotice(
                f"Inside the calibrated depths the pixel-wise model is {compared} than stereo in"
                " the mean.",
                "good" if ratio >= 1 else "warning",
            )
        )
    if lost:
        items.append(
            PageNotice(
                f"Stereo is flatter on {', '.join(lost)}: a pixel's rational function extrapolates"
                " beyond the depths that it was fitted to."
            )
        )
    if data.planes:
        items += [
            rms_bars(data.planes),
            plane_table(data.planes, "Table 1: RMS distance from the best plane"),
        ]
    items += [draw_error_maps(m.title, m.maps, m.rms_mm, m.noise_floor_mm) for m in data.plane_maps]
    if data.plane_outlines:
        items.append(planes_in_space(data.plane_outlines, data.depth_range_mm))
    return Section("Experiment 2a: planes", text, items)


def _spheres_section(data: ReproductionData) -> Section:
    """The section about the spheres: table, distances between centres, and error maps."""
    items: list[Item] = []
    if data.spheres:
        items.append(
            sphere_table(data.spheres, "Table 2: RMS distance from the best sphere, and its radius")
        )
    if data.spacings:
        items.append(spacing_table(data.spacings, "Distances between the centres of spheres"))
    if data.sphere_maps:
        limit = error_limit([errors for m in data.sphere_maps for errors in m.maps.values()])
        items += [
            draw_error_maps(
                m.title,
                m.maps,
                m.rms_mm,
                m.noise_floor_mm,
                limit_mm=limit,
                width=HALF,
                sign="red is outwards",
            )
            for m in data.sphere_maps
        ]
    return Section(
        "Experiment 2b: spheres",
        "Flatness is not a measure of scale: a projector turned by a tenth of a milliradian leaves"
        " a plane flat and distorts scale. A sphere of known radius, and the distances between"
        " spheres, show it. The fitted radius is free. All error maps of this experiment share one"
        " colour scale.",
        items,
    )


def _merged_section(data: ReproductionData) -> Section:
    """The section about the merged object: alignment, scans and the merged cloud."""
    items: list[Item] = []
    if data.pairs:
        items.append(merge_table(data.pairs, "Alignment of the scans by point-to-plane ICP"))
    if data.clouds:
        items.append(draw_clouds(data.clouds))
    if data.merged is not None:
        items.append(draw_merged_cloud(data.merged))
    letter = ""
    if data.letter_points:
        counts = ", ".join(f"{count:,} ({name})" for name, count in data.letter_points.items())
        letter = f" The Letter's clouds held {counts} points, of another object."
    return Section(
        "Experiment 3: a complex object at three depths",
        "One object is scanned in front of, inside and behind the calibrated depths by the"
        f" pixel-wise model; ICP brings the scans into one frame.{letter}",
        items,
    )


def _pair_headline(label: str, values: dict[str, float], note: str) -> Headline:
    """Headline that compares the pixel-wise error with the stereo error, mm, marked better or
    worse."""
    better = values[OURS] < values[BASE]
    known = np.isfinite(list(values.values())).all()
    return Headline(
        _format_pair(values), label, note, ("better" if better else "worse") if known else ""
    )


def _format_pair(values: dict[str, float]) -> str:
    """Text "stereo → pixelwise mm" of an error by model, mm."""
    base, ours = (format_number(values[model]) for model in (BASE, OURS))
    return (
        f"{base if isinstance(base, str) else base.value} →"
        f" {ours if isinstance(ours, str) else ours.value} mm"
    )


def _format_mm(value: float) -> str:
    """Text of a length in mm to three decimals; "unknown" for NaN."""
    return f"{value:.3f} mm" if np.isfinite(value) else "unknown"


def _format_size(size: tuple[int, int]) -> str:
    """Text "width x height" of an image size in px."""
    return f"{size[0]}x{size[1]}"


def _format_depths(data: ReproductionData) -> str:
    """Text of the calibrated depth range, mm."""
    return f"{data.depth_range_mm[0]:.0f} to {data.depth_range_mm[1]:.0f} mm"
