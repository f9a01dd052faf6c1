"""Numbers as tables: every value with its unit and its rival, and who wins in colour and in words."""

from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.report.data import ByModel, MergePair, PlaneRow, SpacingRow, SphereRow
from slviewer.report.page import Cell, Column, Mark, Table

EQUAL = 0.02
"""Two errors that differ by less than this share are called equal."""
UNKNOWN = Cell("–", "muted")


def number(value: float, digits: int = 3, signed: bool = False) -> str | Cell:
    """A value with so many decimals, halves rounded up as people do; a dash where it is unknown."""
    if not np.isfinite(value):
        return UNKNOWN
    return f"{value * (1 + 1e-9):{'+' if signed else ''}.{digits}f}".replace("-", "−")


def better_worse(error: float, rival: float) -> Mark:
    """How an error (its size) stands to its rival's."""
    error, rival = abs(error), abs(rival)
    if not (np.isfinite(error) and np.isfinite(rival)) or abs(error - rival) <= EQUAL * max(error, rival):
        return ""
    return "better" if error < rival else "worse"


def verdict(error: float, rival: float) -> str | Cell:
    """``2.6 times better``, in words and in colour."""
    error, rival = abs(error), abs(rival)
    if not (np.isfinite(error) and np.isfinite(rival) and error > 0 and rival > 0):
        return UNKNOWN
    mark = better_worse(error, rival)
    if not mark:
        return "equal"
    return Cell(f"{max(rival / error, error / rival):.2f} × {mark}", mark)


def mean_of(values: Sequence[float]) -> float:
    """The mean of the known values; NaN where there is none."""
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


def models_of(rows: Sequence[Mapping[str, float]]) -> list[str]:
    """The models of all rows, in the order in which they first come."""
    return list(dict.fromkeys(model for row in rows for model in row))


def plane_table(rows: Sequence[PlaneRow], caption: str) -> Table:
    """Incidence, RMS and floor by model, who wins, and, where rows have them, the Letter's own figures."""
    models = models_of([row.rms_mm for row in rows])
    letters = models_of([row.letter_rms_mm for row in rows])
    columns = [Column("plane", align="left"), Column("R1 / R2 / R3", "%", align="centre")]
    for model in models:
        columns += [Column("RMS", "mm", model), Column("floor", "mm", model)]
    columns += [Column("against " + models[0], "", model, "left") for model in models[1:]]
    group = "the Letter's rig"
    if letters:
        columns.append(Column("R1 / R2 / R3", "%", group, "centre"))
        columns += [Column(model, "mm", group) for model in letters]
        columns += [Column("against " + letters[0], "", group, "left") for _ in letters[1:]]

    def cells(
        name: str, incidence: str | Cell, rms: ByModel, floor: ByModel, letter_incidence: str | Cell, letter: ByModel
    ) -> list[str | Cell]:
        row: list[str | Cell] = [name, incidence]
        for model in models:
            row += [_won(model, rms, models), _muted(floor.get(model, np.nan))]
        row += [verdict(rms.get(model, np.nan), rms.get(models[0], np.nan)) for model in models[1:]]
        if letters:
            row.append(letter_incidence)
            row += [number(letter.get(model, np.nan)) for model in letters]
            row += [_plain(verdict(letter.get(m, np.nan), letter.get(letters[0], np.nan))) for m in letters[1:]]
        return row

    body = [
        cells(
            row.name,
            incidence_text(row.incidence),
            row.rms_mm,
            row.noise_floor_mm,
            incidence_text(row.letter_incidence),
            row.letter_rms_mm,
        )
        for row in rows
    ]
    footer = cells(
        "mean",
        "",
        {m: mean_of([row.rms_mm.get(m, np.nan) for row in rows]) for m in models},
        {m: mean_of([row.noise_floor_mm.get(m, np.nan) for row in rows]) for m in models},
        "",
        {m: mean_of([row.letter_rms_mm.get(m, np.nan) for row in rows]) for m in letters},
    )
    notes = ["RMS over the pixels that every model measures; floor: what the capture's noise alone would give."]
    return Table(columns, body, caption, notes, [footer] if len(rows) > 1 else [])


def sphere_table(rows: Sequence[SphereRow], caption: str) -> Table:
    """RMS, floor and fitted radius by model, who wins in the radius, and the Letter's own figures where known."""
    models = models_of([row.rms_mm for row in rows])
    letters = models_of([row.letter_rms_mm for row in rows])
    columns = [Column("sphere", align="left"), Column("range", align="centre")]
    for model in models:
        columns += [Column("RMS", "mm", model), Column("floor", "mm", model)]
        columns += [Column("radius", "mm", model), Column("error", "mm", model)]
    columns += [Column("radius against " + models[0], "", model, "left") for model in models[1:]]
    for model in letters:
        columns += [
            Column("RMS", "mm", f"the Letter's rig, {model}"),
            Column("radius", "mm", f"the Letter's rig, {model}"),
        ]
    body: list[list[str | Cell]] = []
    for row in rows:
        errors = {m: row.radius_mm.get(m, np.nan) - row.true_radius_mm for m in models}
        line: list[str | Cell] = [row.name, row.region]
        for m in models:
            line += [_won(m, row.rms_mm, models), _muted(row.noise_floor_mm.get(m, np.nan))]
            line += [number(row.radius_mm.get(m, np.nan)), _won(m, errors, models, signed=True)]
        line += [verdict(errors[m], errors[models[0]]) for m in models[1:]]
        for m in letters:
            line += [number(row.letter_rms_mm.get(m, np.nan)), number(row.letter_radius_mm.get(m, np.nan), 2)]
        body.append(line)
    sizes = {m: mean_of([abs(row.radius_mm.get(m, np.nan) - row.true_radius_mm) for row in rows]) for m in models}
    footer: list[str | Cell] = ["mean", ""]
    for m in models:
        footer += [number(mean_of([row.rms_mm.get(m, np.nan) for row in rows]))]
        footer += [_muted(mean_of([row.noise_floor_mm.get(m, np.nan) for row in rows]))]
        footer += [number(mean_of([row.radius_mm.get(m, np.nan) for row in rows])), number(sizes[m])]
    footer += [verdict(sizes[m], sizes[models[0]]) for m in models[1:]]
    for m in letters:
        footer += [number(mean_of([row.letter_rms_mm.get(m, np.nan) for row in rows]))]
        footer += [number(mean_of([row.letter_radius_mm.get(m, np.nan) for row in rows]), 3)]
    true = sorted({row.true_radius_mm for row in rows if np.isfinite(row.true_radius_mm)})
    notes = [
        f"True radius {' or '.join(f'{r:g} mm' for r in true)}; the mean of the errors is that of their sizes."
        if true
        else "The true radius is not known."
    ]
    return Table(columns, body, caption, notes, [footer] if len(rows) > 1 else [])


def spacing_table(rows: Sequence[SpacingRow], caption: str) -> Table:
    """Distances between spheres, known (where they are) and measured; flatness is blind to scale and shear, these are
    not."""
    models = models_of([row.measured_mm for row in rows])
    if not any(np.isfinite(row.known_mm) for row in rows):
        plain = [[row.name, *(number(row.measured_mm.get(m, np.nan)) for m in models)] for row in rows]
        return Table([Column("spheres", align="left"), *(Column(m, "mm") for m in models)], plain, caption)
    columns = [Column("spheres", align="left"), Column("known", "mm")]
    for model in models:
        columns += [Column("measured", "mm", model), Column("error", "mm", model)]
    columns += [Column("against " + models[0], "", model, "left") for model in models[1:]]
    body: list[list[str | Cell]] = []
    for row in rows:
        errors = {m: row.measured_mm.get(m, np.nan) - row.known_mm for m in models}
        line: list[str | Cell] = [row.name, number(row.known_mm)]
        for m in models:
            line += [number(row.measured_mm.get(m, np.nan)), _won(m, errors, models, signed=True)]
        body.append(line + [verdict(errors[m], errors[models[0]]) for m in models[1:]])
    sizes = {m: spacing_error(rows, m) for m in models}
    footer: list[str | Cell] = ["mean size of the error", ""]
    for m in models:
        footer += ["", number(sizes[m])]
    footer += [verdict(sizes[m], sizes[models[0]]) for m in models[1:]]
    return Table(columns, body, caption, (), [footer] if len(rows) > 1 else [])


def spacing_error(rows: Sequence[SpacingRow], model: str) -> float:
    """The mean size of a model's spacing errors, mm."""
    return mean_of([abs(row.measured_mm.get(model, np.nan) - row.known_mm) for row in rows])


def merge_table(pairs: Sequence[MergePair], caption: str) -> Table:
    """How each scan lies on the reference, beside the Letter's figure where there is one."""
    letter = any(np.isfinite(pair.letter_rms_mm) for pair in pairs)
    columns = [Column("scan", align="left"), Column("reference", align="left"), Column("ICP RMS", "mm")]
    columns += [Column("overlap", "%")] + ([Column("the Letter's ICP RMS", "mm")] if letter else [])
    rows = [
        [pair.name, pair.reference, number(pair.rms_mm), number(100 * pair.overlap, 0)]
        + ([number(pair.letter_rms_mm, 2)] if letter else [])
        for pair in pairs
    ]
    return Table(columns, rows, caption)


def incidence_text(incidence: Mapping[str, float]) -> str | Cell:
    """``9 / 91 / 0``; a dash where it is unknown."""
    if not incidence:
        return UNKNOWN
    return " / ".join(f"{abs(incidence.get(region, 0.0)):.1f}".removesuffix(".0") for region in ("R1", "R2", "R3"))


def _won(model: str, errors: ByModel, models: Sequence[str], signed: bool = False) -> str | Cell:
    """A model's error; marked better where it beats every other, worse where the first model beats it."""
    mine = errors.get(model, np.nan)
    text = number(mine, signed=signed)
    if isinstance(text, Cell):
        return text
    others = [errors.get(other, np.nan) for other in models if other != model]
    if others and all(better_worse(mine, other) == "better" for other in others):
        return Cell(text, "better")
    lost = model != models[0] and better_worse(mine, errors.get(models[0], np.nan)) == "worse"
    return Cell(text, "worse") if lost else text


def _muted(value: float) -> Cell:
    text = number(value)
    return text if isinstance(text, Cell) else Cell(text, "muted")


def _plain(cell: str | Cell) -> str | Cell:
    return cell if isinstance(cell, str) or cell.mark == "muted" else Cell(cell.text)
