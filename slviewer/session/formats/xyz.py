"""Text, mm: x y z of a point a line, and its red green blue; no other line, which most readers
would not bear. Read with headers, separators and normals too."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.session.atomic import arriving_file
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.shape_format import DECIMALS, Columns, Shape, ShapeFormat, Sizes, split_shape

_SIZES = Sizes(0, 33, 12)


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    points, _ = split_shape(shape)
    columns = np.round(points.astype(np.float64), DECIMALS) + 0.0  # no "-0.000000"
    formats = [f"%.{DECIMALS}f"] * 3
    has_colours = shape.colours is not None
    if shape.colours is not None:
        columns, formats = np.hstack([columns, shape.colours]), [*formats, "%d", "%d", "%d"]
    with arriving_file(path, _SIZES.estimate(len(points), 0, has_colours, 0)) as file:
        np.savetxt(file, columns, formats)


def _read(path: Path, data: bytes) -> list[Columns]:
    """Return the columns of a text: x y z first, then normals and colours where numbers are
    such."""
    lines = data.decode("utf-8-sig", "replace").splitlines()
    first = next((i for i, line in enumerate(lines) if _is_row(line)), None)
    if first is None:
        raise InputError(
            f"{path.name} has no line of three numbers",
            "write x y z of a point a line, with decimal points",
        )
    separator = next((each for each in ";," if each in lines[first]), None)
    rows = np.loadtxt(lines[first:], delimiter=separator, comments=("#", "//"), ndmin=2)
    columns, k = dict(zip(PLACE, rows.T[:3], strict=True)), 3
    while k + 3 <= rows.shape[1]:
        triple = rows[:, k : k + 3]
        names: tuple[str, ...] = ()
        some = triple[finite_rows(triple)]
        if len(some) and np.percentile(np.abs(lengths(some) - 1), 99) < 0.01:
            names = NORMAL
        elif len(some) and (some == np.rint(some)).all() and 0 <= some.min() < 2 < some.max() < 256:
            names, triple = COLOURS, np.nan_to_num(triple).astype(np.uint8)
        columns |= dict(zip(names, triple.T, strict=False))
        k += len(names) or 1
    return [columns]


def _is_row(line: str) -> bool:
    """Whether a line holds three numbers or more, with decimal points."""
    words = re.split(r"[;\s]\s*" if ";" in line or "," not in line else r",\s*", line.strip())
    try:
        return len([float(word) for word in words if word]) >= 3
    except ValueError:
        return False


FORMAT = ShapeFormat(
    "xyz",
    "mm; text, x y z of a point a line, and its colour",
    _SIZES,
    _write,
    takes_points=True,
    read=_read,
    others=("txt", "asc", "pts", "csv"),
)
