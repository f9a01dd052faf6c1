"""Tables of points as text, of random form: CSV, TXT, XYZ, ASC and PTS."""

import numpy as np

from tests.proofs.file_variants.variant import (
    Form,
    Points,
    Variant,
    draw_comment,
    draw_shift,
    draw_surface,
    draw_unit,
    end_lines,
)

_SIZE = 40
_XYZ = {
    "plain": ("x", "y", "z"),
    "capital": ("X", "Y", "Z"),
    "unit": ("X [{}]", "Y [{}]", "Z [{}]"),
    "under": ("x_{}", "y_{}", "z_{}"),
    "quoted": ('"x"', '"y"', '"z"'),
    "parted": ("Points:0", "Points:1", "Points:2"),
}
_COLOURS = {
    "plain": ("red", "green", "blue"),
    "capital": ("R", "G", "B"),
    "unit": ("Red", "Green", "Blue"),
    "under": ("red", "green", "blue"),
    "quoted": ('"r"', '"g"', '"b"'),
    "parted": ("R", "G", "B"),
}
_NORMALS = {
    "plain": ("nx", "ny", "nz"),
    "capital": ("Nx", "Ny", "Nz"),
    "unit": ("NormalX", "NormalY", "NormalZ"),
    "under": ("nx", "ny", "nz"),
    "quoted": ('"nx"', '"ny"', '"nz"'),
    "parted": ("Normals:0", "Normals:1", "Normals:2"),
}


def _mark_number(text: str, decimals: str, thousands: str) -> str:
    """Return a number with another mark of decimals, and one between thousands where it has
    decimals too."""
    whole, point, rest = text.partition(".")
    if thousands and point:
        whole = f"{int(whole):,}".replace(",", thousands) if whole != "-0" else whole
    return whole + (decimals if point else "") + rest


def draw_table(rng: np.random.Generator) -> Variant:
    """Draw a table whose header names its columns."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    count, scalars = len(truth.points), dict[str, np.ndarray]()
    style = form.draw("header", *_XYZ)
    unit, mm = draw_unit(form, "mm", "cm", "m", "in")
    points = truth.points + draw_shift(form)
    suffix = form.draw("suffix", "csv", "txt", "xyz", "asc")
    separator = form.draw("separator", ",", ";", "\t", " ")
    if separator == " " and style == "unit":
        separator = "\t"
    decimals = "."
    if separator in (";", "\t"):
        decimals = form.draw("decimals", ".", ".", ",")
    prefix = form.draw("prefix", "", "", "# ", "//") if style != "quoted" else ""
    if style == "under" and not unit:
        unit = "mm"
    named = [name.format(unit or "mm") for name in _XYZ[style]]
    groups = [[(name, [f"{v:.8f}" for v in points[:, i] / mm]) for i, name in enumerate(named)]]
    colours, normals = form.draw("colours", "none", "levels", "fractions"), False
    if colours != "none":
        text = [
            [f"{v:d}" if colours == "levels" else f"{v / 255:.5f}" for v in column]
            for column in truth.colours.T
        ]
        groups.append(list(zip(_COLOURS[style], text, strict=True)))
    if normals := form.draw("normals", False, True):
        text = [[f"{v:.6f}" for v in column] for column in truth.normals.T]
        groups.append(list(zip(_NORMALS[style], text, strict=True)))
    for names in (("index",), ("u", "v"), ("intensity",), ("phase",)):
        if form.draw(names[0], False, True):
            numbers = rng.integers(0, 5000, (len(names), count))
            values = [[f"{v:d}" for v in row] for row in numbers]
            groups.append(list(zip(names, values, strict=True)))
            scalars |= dict(zip(names, numbers, strict=True))
    if form.draw("shuffled", False, True):
        groups = [groups[i] for i in rng.permutation(len(groups))]
    columns = [each for group in groups for each in group]
    lines = [prefix + separator.join(name for name, _ in columns)]
    is_stated = style in ("unit", "under") or not unit
    if separator != " " and (form.draw("units below", False, False, True) or not is_stated):
        is_stated = True
        lines.append(separator.join((unit or "mm") if n in named else "" for n, _ in columns))
    if not is_stated or (form.draw("commented", False, False, True) and prefix):
        lines.insert(0, f"{prefix or '# '}{draw_comment(form, unit)}")
    marks = form.draw("thousands", "", "", "", "," if decimals == "." else ".")
    is_quoted = separator == "," and form.draw("cells", "plain", "plain", "quoted") == "quoted"
    for row in zip(*(values for _, values in columns), strict=True):
        cells = [_mark_number(each, decimals, marks) for each in row]
        if is_quoted:  # as programs of countries with decimal commas write them
            cells = [f'"{_mark_number(each, ",", "")}"' for each in row]
        elif separator == "," and marks:
            cells = [f'"{each}"' if "," in each else each for each in cells]
        lines.append(separator.join(cells))
    mark = "\ufeff" if form.draw("mark", False, False, True) else ""
    content = end_lines(mark + "\n".join(lines) + "\n", form.draw("end", "\n", "\r\n"))
    truth = Points(
        points,
        truth.colours if colours != "none" else None,
        truth.normals if normals else None,
        scalars,
    )
    return Variant("table", form.text(), f"a.{suffix}", content, truth)


def draw_plain_text(rng: np.random.Generator) -> Variant:
    """Draw a table without a header: x y z, and colours or normals in three columns each, and at
    times a column that nothing explains."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    suffix = form.draw("suffix", "xyz", "txt", "asc", "csv")
    separator = form.draw("separator", " ", "\t", ",", ";", "  ")
    columns, extras = [[f"{v:.5f}" for v in column] for column in truth.points.T], list[list[str]]()
    scalars = dict[str, np.ndarray]()
    colours = form.draw("colours", False, True)
    normals = form.draw("normals", False, True)
    blocks = [
        *([[[f"{v:d}" for v in column] for column in truth.colours.T]] if colours else []),
        *([[[f"{v:.6f}" for v in column] for column in truth.normals.T]] if normals else []),
    ]
    if form.draw("normals first", False, True):
        blocks.reverse()
    columns += [column for block in blocks for column in block]
    if form.draw("last", False, False, True):
        last = np.round(rng.uniform(0, 3000, len(truth.points)), 3)
        columns.append([f"{v:.3f}" for v in last])
        scalars["last"] = last
    reasons, first = (
        ["column", "decimal"],
        form.draw("first", *["none"] * 5, "index", "u v", "name"),
    )
    if first != "none":
        rows = range(len(truth.points))
        before: dict[str, list[list[int]]] = {
            "index": [[*rows]],
            "u v": [[i % 40 for i in rows], [i // 40 for i in rows]],
        }
        words = [[f"{i}" for i in values] for values in before.get(first, [])]
        columns = (words or [[f"P{i}" for i in rows]]) + columns
        extras += [["column 1", "index"]] if first == "name" else [["indices"]]
    if separator == "\t" and form.draw("decimals", ".", ",") == ",":
        columns = [[v.replace(".", ",") for v in column] for column in columns]
    if scalars:
        scalars = {f"column {len(columns)}": scalars["last"]}
    text = "".join(separator.join(row) + "\n" for row in zip(*columns, strict=True))
    if form.draw("blank", False, False, True):
        text = "\n" + text + "\n\n"
    truth = Points(
        truth.points,
        truth.colours if colours else None,
        truth.normals if normals else None,
        scalars,
    )
    content = end_lines(text, form.draw("end", "\n", "\r\n"))
    return Variant("text", form.text(), f"a.{suffix}", content, truth, extras, reasons)


def draw_pts(rng: np.random.Generator) -> Variant:
    """Draw a PTS: counts before blocks of x y z, intensity, and colours."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None
    intensity = form.draw("intensity", False, True)
    colours = form.draw("colours", False, True)
    low, high = form.draw("levels", (0, 63), (-2048, 2047))
    columns = [[f"{v:.5f}" for v in column] for column in truth.points.T]
    if intensity:
        levels = rng.integers(low, high, len(truth.points))
        columns.append([f"{v:d}" for v in levels])
    if colours:
        columns += [[f"{v:d}" for v in column] for column in truth.colours.T]
    rows = [" ".join(row) for row in zip(*columns, strict=True)]
    blocks = form.draw("blocks", 1, 1, 2, 3)
    parts = [list(part) for part in np.array_split(np.array(rows, object), blocks)]
    text = "".join("\n".join([str(len(part)), *part]) + "\n" for part in parts)
    scalars = {"intensity": levels} if intensity else {}
    truth = Points(truth.points, truth.colours if colours else None, scalars=scalars)
    content = end_lines(text, form.draw("end", "\n", "\r\n"))
    return Variant("pts", form.text(), "a.pts", content, truth)
