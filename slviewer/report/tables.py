"""Tables of results: every value with its unit beside the value of another model, and which is
better."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from slviewer.records.table import Cell, Column, Table, better_worse, compare_errors
from slviewer.report.data import ByModel, MergePair, PlaneRow, SpacingRow, SphereRow

UNKNOWN = Cell("–", "muted")


def format_number(value: float, digits: int = 3, signed: bool = False) -> str | Cell:
    """The value as text with ``digits`` decimals, halves rounded up; a dash for NaN."""
    if not np.isfinite(value):
        return UNKNOWN
    return f"{value * (1 + 1e-9):{'+' if signed else ''}.{digits}f}".replace("-", "−")


def known_mean(values: Sequence[float]) -> float:
    """The mean of the known values; NaN where there is none."""
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


def models_of(rows: Sequence[Mapping[str, float]]) -> list[str]:
    """The models of all rows, in the order in which they first come."""
    return list(dict.fromkeys(model for row in rows for model in row))


def plane_table(rows: Sequence[PlaneRow], caption: str) -> Table:
    """Table of planes: incidence, RMS and floor by model, the better one, and the Letter's figures
    where given."""
    rms, floor = _values_by_model(rows, "rms_mm"), _values_by_model(rows, "noise_floor_mm")
    letter = _values_by_model(rows, "letter_rms_mm")
    columns: list[_CellColumn] = [
        (Column("plane", align="left"), [*(row.name for row in rows), "mean"]),
        (
            Column("R1 / R2 / R3", "%", align="centre"),
            [*(format_incidence(row.incidence) for row in rows), ""],
        ),
    ]
    for model in rms:
        columns.append((Column("RMS", "mm", model), _error_cells(model, rms)))
        columns.append(
            (Column("floor", "mm", model), _format_muted_cells(floor.get(model, []), len(rows)))
        )
    columns += _comparison_columns(rms, "against")
    if letter:
        group = "the Letter's rig"
        shares = [*(format_incidence(row.letter_incidence) for row in rows), ""]
        columns.append((Column("R1 / R2 / R3", "%", group, "centre"), shares))
        columns += [
            (Column(model, "mm", group), [format_number(v) for v in values])
            for model, values in letter.items()
        ]
        columns += [
            (replace(column, group=group), [_remove_mark(cell) for cell in cells])
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
        (Column("sphere", align="left"), [*(row.name for row in rows), "mean"]),
        (Column("range", align="centre"), [*(row.region for row in rows), ""]),
    ]
    for model in rms:
        columns.append((Column("RMS", "mm", model), _error_cells(model, rms)))
        columns.append(
            (Column("floor", "mm", model), _format_muted_cells(floor.get(model, []), len(rows)))
        )
        columns.append(
            (
                Column("radius", "mm", model),
                [format_number(r) for r in radius.get(model, [np.nan] * (len(rows) + 1))],
            )
        )
        columns.append((Column("error", "mm", model), _error_cells(model, errors, signed=True)))
    columns += _comparison_columns(errors, "radius against")
    for model, values in letter.items():
        *radii, mean = _values_by_model(rows, "letter_radius_mm")[model]
        group = f"the Letter's rig, {model}"
        columns.append((Column("RMS", "mm", group), [format_number(v) for v in values]))
        columns.append(
            (
                Column("radius", "mm", group),
                [*(format_number(r, 2) for r in radii), format_number(mean)],
            )
        )
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
    names: _CellColumn = (
        Column("spheres", align="left"),
        [*(row.name for row in rows), "mean size of the error"],
    )
    errors = _signed_errors(measured, measured, [row.known_mm for row in rows])
    columns: list[_CellColumn] = [
        names,
        (Column("known", "mm"), [*(format_number(row.known_mm) for row in rows), ""]),
    ]
    for model, values in measured.items():
        columns.append(
            (Column("measured", "mm", model), [*(format_number(v) for v in values[:-1]), ""])
        )
        columns.append((Column("error", "mm", model), _error_cells(model, errors, signed=True)))
    return _build_table(columns + _comparison_columns(errors, "against"), caption)


def spacing_error(rows: Sequence[SpacingRow], model: str) -> float:
    """The mean absolute spacing error of a model, mm."""
    return known_mean([abs(row.measured_mm.get(model, np.nan) - row.known_mm) for row in rows])


def merge_table(pairs: Sequence[MergePair], caption: str) -> Table:
    """Table of the alignment of each scan to the reference, beside the Letter's value where there
    is one."""
    letter = any(np.isfinite(pair.letter_rms_mm) for pair in pairs)
    columns = [
        Column("scan", align="left"),
        Column("reference", align="left"),
        Column("ICP RMS", "mm"),
    ]
    columns += [Column("overlap", "%")] + ([Column("the Letter's ICP RMS", "mm")] if letter else [])
    rows = [
        [
            pair.name,
            pair.reference,
            format_number(pair.rms_mm),
            format_number(100 * pair.overlap, 0),
        ]
        + ([format_number(pair.letter_rms_mm, 2)] if letter else [])
        for pair in pairs
    ]
    return Table(columns, rows, caption)


def format_incidence(incidence: Mapping[str, float]) -> str | Cell:
    """Shares in R1, R2 and R3 in percent as text, such as ``9 / 91 / 0``; a dash where unknown."""
    if not incidence:
        return UNKNOWN
    return " / ".join(
        f"{abs(incidence.get(region, 0.0)):.1f}".removesuffix(".0") for region in ("R1", "R2", "R3")
    )


_CellColumn = tuple[Column, list[str | Cell]]
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
    values = {model: [each.get(model, np.nan) for each in figures] for model in models_of(figures)}
    return {model: [*of_rows, known_mean(of_rows)] for model, of_rows in values.items()}


def _signed_errors(
    models: Iterable[str], measured: Mapping[str, Sequence[float]], true: Sequence[float]
) -> dict[str, list[float]]:
    """{model: measured less true value in every row, then the mean of their magnitudes}."""
    unknown = [np.nan] * (len(true) + 1)
    errors = {
        m: [v - t for v, t in zip(measured.get(m, unknown)[:-1], true, strict=True)] for m in models
    }
    return {
        model: [*each, known_mean([abs(error) for error in each])] for model, each in errors.items()
    }


def _comparison_columns(errors: Mapping[str, Sequence[float]], words: str) -> list[_CellColumn]:
    """Columns that compare each further model's errors with the first model's."""
    first, *others = errors
    return [
        (
            Column(f"{words} {first}", "", model, "left"),
            list(map(compare_errors, errors[model], errors[first])),
        )
        for model in others
    ]


def _error_cells(
    model: str, errors: Mapping[str, Sequence[float]], signed: bool = False
) -> list[str | Cell]:
    """A model's errors; marked better where one beats every other model's, worse where the first
    model beats it. The last, a mean, is ``signed`` in no case."""
    cells: list[str | Cell] = []
    first, others = next(iter(errors)), [each for name, each in errors.items() if name != model]
    for i, mine in enumerate(errors[model]):
        text = format_number(mine, signed=signed and i < len(errors[model]) - 1)
        if (
            isinstance(text, str)
            and others
            and all(better_worse(mine, each[i]) == "better" for each in others)
        ):
            text = Cell(text, "better")
        elif (
            isinstance(text, str)
            and model != first
            and better_worse(mine, errors[first][i]) == "worse"
        ):
            text = Cell(text, "worse")
        cells.append(text)
    return cells


def _format_muted_cells(values: Sequence[float], rows: int) -> list[str | Cell]:
    """Cells in muted colour of the Letter's values; dashes where ``values`` is empty."""
    texts = [format_number(value) for value in values or [np.nan] * (rows + 1)]
    return [text if isinstance(text, Cell) else Cell(text, "muted") for text in texts]


def _remove_mark(cell: str | Cell) -> str | Cell:
    """Return the cell without its mark, unless it is muted."""
    return cell if isinstance(cell, str) or cell.mark == "muted" else Cell(cell.value)
