"""Report sections of the Letter's experiments, repeated: figures and tables, the Letter's values
beside ours."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from slviewer.records.table import (
    Cell,
    Column,
    Mark,
    Rows,
    Table,
    Value,
    better_worse,
    compare_errors,
)
from slviewer.report.canvas import HALF
from slviewer.report.data import (
    ByModel,
    MergePair,
    PlaneRow,
    ReproductionData,
    SpacingRow,
    SphereRow,
)
from slviewer.report.maps import draw_error_maps, error_limit, pixel_curves, rms_maps
from slviewer.report.page import Headline, Item, PageNotice, Section
from slviewer.report.planes import planes_in_space, rms_bars
from slviewer.report.surfaces import draw_clouds, draw_merged_cloud

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
    sizes = "camera {}x{}, projector {}x{} px".format(*data.camera, *data.projector)
    depths = "{:.0f} to {:.0f} mm".format(*data.depth_range_mm)
    quick = "Quick run at reduced resolution: its figures are its own. " if data.quick else ""
    return (
        "The Letter's experiments, repeated on a simulated rig",
        (
            f"{quick}A rig of the Letter's geometry with local lens distortion and camera noise,"
            f" seed {data.seed}: {sizes}, calibrated by {data.poses} target poses at {depths}."
            f" {LETTER}."
        ),
    )


def reproduction_headlines(data: ReproductionData) -> list[Headline]:
    """Headlines: flatness, flatness inside R2, sphere radius and spacing of spheres: stereo against
    pixelwise."""
    letter = _mean_of_both(lambda m: [row.letter_rms_mm.get(m, np.nan) for row in data.planes])
    floor = known_mean(row.noise_floor_mm.get(OURS, np.nan) for row in data.planes)
    known_floor = f"{floor:.3f} mm" if np.isfinite(floor) else "unknown"
    ratio, count = inside_ratio(data.planes)
    wins = sum(row.rms_mm.get(OURS, np.inf) < row.rms_mm.get(BASE, -np.inf) for row in data.planes)
    headlines = [
        _pair_headline(
            "mean plane RMS, all poses",
            lambda m: [row.rms_mm.get(m, np.nan) for row in data.planes],
            f"stereo → pixelwise; noise floor {known_floor}. The Letter: {_format_pair(letter)}",
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
                lambda m: [
                    abs(row.radius_mm.get(m, np.nan) - row.true_radius_mm) for row in data.spheres
                ],
                "stereo → pixelwise; mean size over the spheres",
            )
        )
    if data.spacings:
        headlines.append(
            _pair_headline(
                "error of spheres' spacing",
                lambda m: [
                    abs(row.measured_mm.get(m, np.nan) - row.known_mm) for row in data.spacings
                ],
                "stereo → pixelwise; mean size over the pairs",
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
    base, ours = (known_mean(row.rms_mm.get(m, np.nan) for row in inside) for m in (BASE, OURS))
    return (base / ours if ours > 0 else float("nan")), len(inside)


def _calibration_section(data: ReproductionData) -> Section:
    """The section about the calibration: notices, reprojection errors, per-pixel fits and
    curves."""
    items: list[Item] = [
        PageNotice(f"{name} was excluded: {why}") for name, why in data.poses_left_out.items()
    ]
    rows: Rows = [
        [
            f"reprojection, {device}",
            "px",
            data.reprojection_rms_px.get(device),
            data.letter_reprojection_rms_px.get(device),
        ]
        for device in ("camera", "projector")
    ]
    for axis in "zxy":
        name = f"pixel-wise fit in {axis}, median over the pixels"
        rows.append([name, "mm", data.fit_rms_mm.get(axis), "below 0.15"])
    columns = [
        Column("RMS"),
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


def _mean_of_both(errors: Callable[[str], list[float]]) -> tuple[float, float]:
    """Means of the known errors, mm, of the stereo and of the pixel-wise model."""
    return known_mean(errors(BASE)), known_mean(errors(OURS))


def _pair_headline(label: str, errors: Callable[[str], list[float]], note: str) -> Headline:
    """Headline that compares the mean of the pixel-wise errors with that of the stereo errors, mm,
    marked better or worse."""
    base, ours = pair = _mean_of_both(errors)
    mark: Mark = "better" if ours < base else "worse"
    return Headline(_format_pair(pair), label, note, mark if np.isfinite(pair).all() else "")


def _format_pair(pair: tuple[float, float]) -> str:
    """Text "stereo → pixelwise mm" of an error by both models, mm."""
    return f"{' → '.join(map(Column('').format, pair))} mm"


def known_mean(values: Iterable[float]) -> float:
    """The mean of the known values; NaN where there is none."""
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


def plane_table(rows: Sequence[PlaneRow], caption: str) -> Table:
    """Table of planes: incidence, RMS and floor by model, the better one, and the Letter's figures
    where given."""
    rms, floor = _values_by_model(rows, "rms_mm"), _values_by_model(rows, "noise_floor_mm")
    letter = _values_by_model(rows, "letter_rms_mm")
    shares = Column("R1 / R2 / R3", "%", align="centre")
    columns: list[_CellColumn] = [
        (Column("plane"), [*(row.name for row in rows), "mean"]),
        (shares, [*(_format_incidence(row.incidence) for row in rows), ""]),
    ]
    for model in rms:
        columns += _rms_columns(model, rms, floor)
    columns += _comparison_columns(rms, "against")
    if letter:
        group = "the Letter's rig"
        theirs = [*(_format_incidence(row.letter_incidence) for row in rows), ""]
        columns.append((replace(shares, group=group), theirs))
        columns += [(Column(model, "mm", group), values) for model, values in letter.items()]
        columns += [
            (replace(column, group=group), [cell.value for cell in cells])
            for column, cells in _comparison_columns(letter, "against")
        ]
    note = (
        "RMS over the pixels that every model measures; floor: what the capture's noise alone would"
        " give."
    )
    return _build_table(columns, caption, [note])


def sphere_table(rows: Sequence[SphereRow], caption: str) -> Table:
    """Table of spheres: RMS, floor and fitted radius by model, the better radius, the Letter's
    figures where given."""
    rms, floor = _values_by_model(rows, "rms_mm"), _values_by_model(rows, "noise_floor_mm")
    radius, letter = _values_by_model(rows, "radius_mm"), _values_by_model(rows, "letter_rms_mm")
    errors = _signed_errors(rms, radius, [row.true_radius_mm for row in rows])
    columns: list[_CellColumn] = [
        (Column("sphere"), [*(row.name for row in rows), "mean"]),
        (Column("range", align="centre"), [*(row.region for row in rows), ""]),
    ]
    for model in rms:
        columns += _rms_columns(model, rms, floor)
        columns += [
            (Column("radius", "mm", model), radius.get(model, [np.nan] * (len(rows) + 1))),
            (Column("error", "mm", model, "right"), _error_cells(model, errors, signed=True)),
        ]
    columns += _comparison_columns(errors, "radius against")
    for model, values in letter.items():
        *radii, mean = _values_by_model(rows, "letter_radius_mm")[model]
        group = f"the Letter's rig, {model}"
        columns += [
            (Column("RMS", "mm", group), values),
            (Column("radius", "mm", group, digits=2), [*radii, Column("").format(mean)]),
        ]
    true = sorted({row.true_radius_mm for row in rows if np.isfinite(row.true_radius_mm)})
    known = (
        f"True radius {' or '.join(f'{r:g} mm' for r in true)}; the mean of the errors is that of"
        " their sizes."
    )
    return _build_table(columns, caption, [known if true else "The true radius is not known."])


def spacing_table(rows: Sequence[SpacingRow], caption: str) -> Table:
    """Distances between spheres, known and measured; flatness is blind to scale and shear, these
    are not."""
    measured = _values_by_model(rows, "measured_mm")
    known = [row.known_mm for row in rows]
    errors = _signed_errors(measured, measured, known)
    columns: list[_CellColumn] = [
        (Column("spheres"), [*(row.name for row in rows), "mean size of the error"]),
        (Column("known", "mm"), [*known, ""]),
    ]
    for model, values in measured.items():
        columns += [
            (Column("measured", "mm", model), [*values[:-1], ""]),
            (Column("error", "mm", model, "right"), _error_cells(model, errors, signed=True)),
        ]
    return _build_table([*columns, *_comparison_columns(errors, "against")], caption)


def merge_table(pairs: Sequence[MergePair], caption: str) -> Table:
    """Table of the alignment of each scan to the reference, beside the Letter's value where there
    is one."""
    columns = [
        Column("scan"),
        Column("reference"),
        Column("ICP RMS", "mm"),
        Column("overlap", "%", digits=0),
        Column("the Letter's ICP RMS", "mm", digits=2),
    ]
    rows: Rows = [
        [pair.name, pair.reference, pair.rms_mm, 100 * pair.overlap, pair.letter_rms_mm]
        for pair in pairs
    ]
    table = Table(columns, rows, caption)
    has_letter = any(np.isfinite(pair.letter_rms_mm) for pair in pairs)
    return table if has_letter else table.select(table.columns[:-1])


def _format_incidence(incidence: Mapping[str, float]) -> str | None:
    """Shares in R1, R2 and R3 in percent as text, such as ``9 / 91 / 0``; None where unknown."""
    if not incidence:
        return None
    return " / ".join(
        f"{abs(incidence.get(region, 0.0)):.1f}".removesuffix(".0") for region in ("R1", "R2", "R3")
    )


_CellColumn = tuple[Column, Sequence[Value | Cell]]
"""A column with its cells, the last of which is that of the means."""


def _build_table(columns: Sequence[_CellColumn], caption: str, notes: Sequence[str] = ()) -> Table:
    """The columns side by side; the means are a footer where there is more than one row."""
    *rows, means = zip(*(cells for _, cells in columns), strict=True)
    return Table(
        [column for column, _ in columns], rows, caption, notes, [means] if len(rows) > 1 else []
    )


def _values_by_model(rows: Sequence[object], figure: str) -> dict[str, list[float]]:
    """{model: its figure in every row (NaN where unknown), then their mean}."""
    figures: list[ByModel] = [getattr(row, figure) for row in rows]
    values = {
        model: [each.get(model, np.nan) for each in figures]
        for model in dict.fromkeys(model for each in figures for model in each)
    }
    return {model: [*of_rows, known_mean(of_rows)] for model, of_rows in values.items()}


def _signed_errors(
    models: Iterable[str], measured: Mapping[str, Sequence[float]], true: Sequence[float]
) -> dict[str, list[float]]:
    """{model: measured less true value in every row, then the mean of their magnitudes}."""
    unknown = [np.nan] * (len(true) + 1)
    errors = {
        m: [v - t for v, t in zip(measured.get(m, unknown)[:-1], true, strict=True)] for m in models
    }
    return {model: [*each, known_mean(map(abs, each))] for model, each in errors.items()}


def _rms_columns(
    model: str, rms: Mapping[str, Sequence[float]], floor: Mapping[str, Sequence[float]]
) -> list[_CellColumn]:
    """The columns of a model's RMS, and of its noise floor in muted colour."""
    floors = floor.get(model, [np.nan] * len(rms[model]))
    return [
        (Column("RMS", "mm", model), _error_cells(model, rms)),
        (Column("floor", "mm", model), [Cell(value, "muted") for value in floors]),
    ]


def _comparison_columns(
    errors: Mapping[str, Sequence[float]], words: str
) -> list[tuple[Column, list[Cell]]]:
    """Columns that compare each further model's errors with the first model's."""
    first, *others = errors
    return [
        (
            Column(f"{words} {first}", "", model),
            list(map(compare_errors, errors[model], errors[first])),
        )
        for model in others
    ]


def _error_cells(
    model: str, errors: Mapping[str, Sequence[float]], signed: bool = False
) -> list[Value | Cell]:
    """A model's errors; marked better where one beats every other model's, worse where the first
    model beats it. The last, a mean, is ``signed`` in no case."""
    first, *_ = errors.values()
    others = [each for name, each in errors.items() if name != model]
    cells: list[Value | Cell] = []
    for i, mine in enumerate(errors[model]):
        marks = {better_worse(mine, each[i]) for each in others}
        is_worse = better_worse(mine, first[i]) == "worse"
        text = Column("").format(mine)
        if signed and mine >= 0 and i < len(first) - 1:
            text = f"+{text}"
        cells.append(Cell(text, "better" if marks == {"better"} else "worse" if is_worse else ""))
    return cells
