"""CSV: text, mm, a column for each of x y z, normals, colours and other values of each point, named
in its first line."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer.session.atomic import arriving_file
from slviewer.session.columns import Columns
from slviewer.session.formats.xyz import read_table
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.shape_format import DECIMALS, Shape, ShapeFormat, Sizes, split_shape

_SIZES = Sizes(100, 66, 12, 12)


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    points, _ = split_shape(shape)
    groups: list[tuple[tuple[str, ...], np.ndarray | None, str]] = [
        (PLACE, points, f"%.{DECIMALS}f"),
        (NORMAL, shape.normals, "%.7f"),
        (COLOURS, shape.colours, "%d"),
    ]
    groups += [
        ((name,), each[:, None], "%.9g" if each.dtype == np.float32 else "%.17g")
        for name, each in scalars.items()
    ]
    known = [(names, each, form) for names, each, form in groups if each is not None]
    titles = [f"{name} [mm]" if name in PLACE else name for names, _, _ in known for name in names]
    formats = [form for names, _, form in known for _ in names]
    values = np.hstack([each for _, each, _ in known], dtype=np.float64)
    with arriving_file(path, _SIZES.estimate(len(points), 0, True, len(scalars))) as file:
        np.savetxt(file, values, formats, ",", header=",".join(titles), comments="")


FORMAT = ShapeFormat(
    "csv",
    "mm; text with a header, and all values of each point",
    _SIZES,
    _write,
    takes_points=True,
    read=read_table,
    holds_scalars=True,
)
