"""Report sections of the Letter's experiments, repeated: figures and tables, the Letter's values
beside ours."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation import letter
from slviewer.records.merge import Merge
from slviewer.records.record import (
    Cell,
    Column,
    Rows,
    Table,
    Value,
    better_worse,
    compare_with_first,
    format_signed,
)
from slviewer.records.verification import Verification, average, list_fits
from slviewer.report.maps import (
    PixelCurve,
    error_limit,
    pixel_curves,
    rms_maps,
    verification_maps,
)
from slviewer.report.page import HALF, Headline, Item, PageNotice, Section, percentile
from slviewer.report.planes import planes_in_space, rms_bars
from slviewer.report.surfaces import draw_clouds, draw_merged_cloud
from slviewer.surface.fuse import Fused

BASE, OURS = "stereo", "pixelwise"
INSIDE_PERCENT = 87.0
"""A plane with this share in R2 counts as inside the calibrated depths, as do the Letter's poses 3,
4, 9 and 10."""
LETTER = (
    "The Letter: Vargas, Romero, Zhang and Marrugo, Pixel-wise rational model for a structured"
    " light system, Optics Letters 2023"
)
THEIRS = "the Letter's rig"

Verifications = Mapping[str, Verification]
Lengths = Mapping[str, tuple[float, Mapping[str, float]]]
"""{what: its known length, and the measured one by model}, mm."""


@dataclass(frozen=True, eq=False)
class ReproductionData:
    """The Letter's experiments on a simulated rig: the records of planes and spheres by capture,
    and what their pictures show.

    ``rms_maps_mm`` (3, h, w) are the pixel-wise fits' RMS in z, x, y. ``spacings_mm``: distances of
    the spheres' centres. ``error_maps``: the arrays of the verifications whose maps are shown;
    ``plane_outlines``: by plane, four or more points (n, 3) mm of it. ``clouds``: points (h, w, 3)
    mm of each scan; ``fused``: the surface merged from them.
    """

    quick: bool
    seed: int
    stereo: StereoModel
    pixel_curve: PixelCurve | None
    rms_maps_mm: np.ndarray
    planes: Verifications
    spheres: Verifications
    spacings_mm: Lengths
    error_maps: Mapping[str, Mapping[str, np.ndarray]]
    plane_outlines: Mapping[str, np.ndarray]
    merge: Merge | None
    clouds: Mapping[str, np.ndarray]
    fused: Fused | None


def reproduction_title(data: ReproductionData) -> tuple[str, str]:
    """The page's title and the sentence below it."""
    rig = data.stereo.rig
    sizes = "camera {}x{}, projector {}x{} px".format(*rig.camera.size, *rig.projector.size)
    depths = "{:.0f} to {:.0f} mm".format(*letter.DEPTH_RANGE_MM)
    quick = "Quick run at reduced resolution: its figures are its own. " if data.quick else ""
    return (
        "The Letter's experiments, repeated on a simulated rig",
        (
            f"{quick}A rig of the Letter's geometry with local lens distortion and camera noise,"
            f" seed {data.seed}: {sizes}, calibrated by {len(data.stereo.poses)} target poses at"
            f" {depths}. {LETTER}."
        ),
    )


def reproduction_headlines(data: ReproductionData) -> list[Headline]:
    """Headlines: flatness, flatness inside R2, sphere radius and spacing of spheres: stereo against
    pixelwise."""
    means = average("plane", data.planes.values())
    floor = Column("").format(means.models[OURS].noise_floor_mm if OURS in means.models else None)
    theirs = _format_pair(average("plane", letter.TABLE_1).rms_mm)
    ratio, count = inside_ratio(data.planes)
    wins = len(_list_flatter(data.planes, OURS, BASE))
    headlines = [
        _pair_headline(
            "mean plane RMS, all poses",
            means.rms_mm,
            f"stereo → pixelwise; noise floor {floor} mm. The Letter: {theirs}",
        ),
        Headline(
            f"{ratio:.2f} ×" if np.isfinite(ratio) else "–",
            "flatter inside R2, pixelwise against stereo",
            f"mean of the {count} planes at least {INSIDE_PERCENT:.0f} % inside; pixelwise is ahead"
            f" on {wins} of all {len(data.planes)}",
            "better" if ratio > 1 else "worse" if ratio < 1 else "",
        ),
    ]
    for what, lengths, of in (
        ("error of the sphere's radius", sphere_radii(data.spheres), "spheres"),
        ("error of spheres' spacing", data.spacings_mm, "pairs"),
    ):
        if lengths:
            note = f"stereo → pixelwise; mean size over the {of}"
            headlines.append(_pair_headline(what, mean_errors(lengths), note))
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


def inside_ratio(planes: Verifications) -> tuple[float, int]:
    """Mean stereo RMS over mean pixelwise RMS of the planes inside R2, and how many these are."""
    inside = [
        each for each in planes.values() if (each.incidence or {}).get("R2", 0.0) >= INSIDE_PERCENT
    ]
    means = average("plane", inside).rms_mm
    return means.get(BASE, np.nan) / means.get(OURS, np.nan), len(inside)


def _list_flatter(planes: Verifications, model: str, other: str) -> list[str]:
    """The planes that a model measures with less RMS than another does."""
    rms_mm = {name: each.rms_mm for name, each in planes.items()}
    return [name for name, mm in rms_mm.items() if mm.get(model, np.nan) < mm.get(other, np.nan)]


def _calibration_section(data: ReproductionData) -> Section:
    """The section about the calibration: notices, reprojection errors, per-pixel fits and
    curves."""
    stereo, curve = data.stereo, data.pixel_curve
    figures: list[tuple[str, str, float | None, Value]] = [
        (f"reprojection, {device}", "px", stereo.reprojection_rms_px.get(device), theirs)
        for device, theirs in letter.REPROJECTION_RMS_PX.items()
    ]
    figures += [
        (
            f"pixel-wise fit in {axis}, median over the pixels",
            "mm",
            percentile(rms, 50),
            "below 0.15",
        )
        for axis, rms in zip("zxy", data.rms_maps_mm, strict=True)
    ]
    rows = [
        {"RMS": what, Column("unit", align="centre"): unit, "this rig": ours, THEIRS: theirs}
        for what, unit, ours, theirs in figures
    ]
    items: list[Item] = [
        *(PageNotice(f"{name} was excluded: {why}") for name, why in stereo.excluded.items()),
        Table.of(rows, "How well the calibration fits its own poses"),
        *([] if curve is None else [pixel_curves(curve)]),
        rms_maps(data.rms_maps_mm, "" if curve is None else curve.axis),
    ]
    return Section(
        "Experiment 1: calibration",
        f"Stereo calibration: both lenses and their poses from {len(stereo.poses)} target poses."
        " The pixel-wise model then learns, for every camera pixel, how depth follows from the"
        " absolute phase, from the same poses projected onto their ideal planes.",
        items,
    )


def _planes_section(data: ReproductionData) -> Section:
    """The section about the planes: table, bars, positions in space and error maps."""
    near, far = letter.DEPTH_RANGE_MM
    items: list[Item] = []
    ratio, _ = inside_ratio(data.planes)
    if np.isfinite(ratio):
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
    if lost := _list_flatter(data.planes, BASE, OURS):
        items.append(
            PageNotice(
                f"Stereo is flatter on {', '.join(lost)}: a pixel's rational function extrapolates"
                " beyond the depths that it was fitted to."
            )
        )
    if data.planes:
        table = shape_table(data.planes, "Table 1: RMS distance from the best plane")
        items += [rms_bars(data.planes), table]
    items += [
        verification_maps(name, data.planes[name], arrays)
        for name, arrays in data.error_maps.items()
        if name in data.planes
    ]
    if data.plane_outlines:
        items.append(planes_in_space(data.plane_outlines, letter.DEPTH_RANGE_MM))
    return Section(
        "Experiment 2a: planes",
        f"A flat board is measured in front of (R1, nearer than {near:.0f} mm), inside (R2) and"
        f" behind (R3, beyond {far:.0f} mm) the depths that were calibrated, and each cloud is"
        " compared with its own best plane.",
        items,
    )


def _spheres_section(data: ReproductionData) -> Section:
    """The section about the spheres: tables of RMS, radius and distances between centres, and error
    maps."""
    items: list[Item] = []
    if data.spheres:
        items += [
            shape_table(data.spheres, "Table 2: RMS distance from the best sphere"),
            radius_table(data.spheres, "Table 2: radius of the best sphere"),
        ]
    if data.spacings_mm:
        items.append(length_table(data.spacings_mm, "Distances between the centres of spheres"))
    if shown := {name: maps for name, maps in data.error_maps.items() if name in data.spheres}:
        limit_mm = error_limit([errors for maps in shown.values() for errors in maps.values()])
        items += [
            verification_maps(name, data.spheres[name], maps, HALF, limit_mm)
            for name, maps in shown.items()
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
    if data.merge is not None:
        rows = [
            {
                "scan": name,
                "reference": data.merge.reference,
                Column("ICP RMS", "mm"): pair.point_to_point_rms_mm,
                Column("overlap", "%", digits=0): 100 * pair.overlap,
                Column("the Letter's ICP RMS", "mm", digits=2): (
                    letter.EXPERIMENT_3_ICP_RMS_MM.get(name[-2:].upper())
                ),
            }
            for name, pair in data.merge.pairs.items()
        ]
        caption = "Alignment of the scans by point-to-plane ICP"
        items.append(Table.of(rows, caption).without_empty())
    if data.clouds:
        items.append(draw_clouds(data.clouds))
    if data.fused is not None:
        items.append(draw_merged_cloud(data.fused))
    counts = ", ".join(f"{n:,} ({name})" for name, n in letter.EXPERIMENT_3_POINTS.items())
    return Section(
        "Experiment 3: a complex object at three depths",
        "One object is scanned in front of, inside and behind the calibrated depths by the"
        f" pixel-wise model; ICP brings the scans into one frame. The Letter's clouds held {counts}"
        " points, of another object.",
        items,
    )


def _pair_headline(label: str, errors_mm: Mapping[str, float], note: str) -> Headline:
    """Headline that compares the pixel-wise model's error with that of stereo, marked better or
    worse."""
    mark = better_worse(errors_mm.get(OURS), errors_mm.get(BASE))
    return Headline(_format_pair(errors_mm), label, note, mark)


def _format_pair(errors_mm: Mapping[str, float]) -> str:
    """Text "stereo → pixelwise mm" of an error by both models, mm."""
    return f"{' → '.join(Column('').format(errors_mm.get(m)) for m in (BASE, OURS))} mm"


def shape_table(found: Verifications, caption: str) -> Table:
    """Table of planes or spheres by model, with the Letter's figures of the same poses beside ours,
    and the means of several below."""
    shape = next(iter(found.values())).shape
    pairs = [(each, letter.find_pose(name, shape)) for name, each in found.items()]
    ours, theirs = (average(shape, side) for side in zip(*pairs, strict=True))
    table = list_fits({**found, "mean": ours}, caption)
    table = table.select([column for column in table.columns if column.title != "points"])
    columns = [
        *table.columns,
        Column("R1 / R2 / R3", "%", THEIRS, "centre"),
        Column("RMS", "mm", THEIRS),
        Column(f"against {BASE}", group=THEIRS),
    ]
    letters: Rows = [
        [
            " / ".join(f"{share:g}" for share in (theirs.incidence or {}).values()),
            theirs.rms_mm.get(model),
            compare_with_first(theirs.rms_mm, model).value,
        ]
        for each, theirs in [*pairs, (ours, theirs)]
        for model in each.models
    ]
    rows: Rows = [[*row, *more] for row, more in zip(table.rows, letters, strict=True)]
    end = len(rows) - len(ours.models)
    footer = rows[end:] if len(found) > 1 else []
    return Table(columns, rows[:end], caption, table.notes, footer).without_empty()


def sphere_radii(spheres: Verifications) -> Lengths:
    """The radii of spheres, known and by model."""
    return {name: (letter.SPHERE_RADIUS_MM, each.radii_mm) for name, each in spheres.items()}


def radius_table(spheres: Verifications, caption: str) -> Table:
    """Table of the radii of spheres, with the Letter's."""
    letters = {name: letter.find_pose(name, "sphere").radii_mm for name in spheres}
    return length_table(sphere_radii(spheres), caption, letters)


def mean_errors(lengths: Lengths) -> dict[str, float]:
    """{model: mean size of its errors, mm}."""
    errors = defaultdict[str, list[float]](list)
    for known, measured in lengths.values():
        for model, mm in measured.items():
            errors[model].append(abs(mm - known))
    return {model: float(np.mean(sizes)) for model, sizes in errors.items()}


def length_table(
    lengths: Lengths,
    caption: str,
    letters: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> Table:
    """Table of lengths, known and as each model measures them, with the Letter's where given;
    flatness is blind to scale and shear, these are not."""
    columns = [
        Column("spheres"),
        Column("model"),
        Column("known", "mm"),
        Column("measured", "mm"),
        Column("error", "mm", align="right"),
        Column(f"against {BASE}"),
        Column("measured", "mm", THEIRS, digits=2),
    ]
    rows: Rows = []
    for name, (known, measured) in lengths.items():
        errors = {model: mm - known for model, mm in measured.items()}
        for model, error in errors.items():
            compared = compare_with_first(errors, model)
            signed = Cell(format_signed(error, digits=3), compared.mark)
            theirs = letters.get(name, {}).get(model)
            rows.append([name, model, known, measured[model], signed, compared, theirs])
    sizes = mean_errors(lengths)
    footer: Rows = []
    for model, size in sizes.items():
        of_model = np.array([[row[2], row[3], row[6]] for row in rows if row[1] == model], float)
        known, mean, theirs = map(float, of_model.mean(axis=0))
        footer.append(["mean", model, known, mean, size, compare_with_first(sizes, model), theirs])
    notes = ["The mean of the errors is that of their sizes."]
    return Table(columns, rows, caption, notes, footer).without_empty()
