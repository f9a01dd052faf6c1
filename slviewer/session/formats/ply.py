"""PLY: binary, float32, mm, with normals, colours, the expected errors (sigma) and other values of
each point."""

from collections.abc import Sequence
from pathlib import Path

from slviewer.session.columns import Columns
from slviewer.session.ply import FACE, write_ply
from slviewer.session.polygons import read_polygons
from slviewer.session.shape_format import Shape, ShapeFormat, Sizes, split_shape


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    points, faces = split_shape(shape)
    write_ply(path, points, shape.colours, shape.normals, scalars, faces, notes)


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the properties of the vertices by name."""
    return [read_polygons(path.name, data, notes).columns]


FORMAT = ShapeFormat(
    "ply",
    "mm; with colours, normals and sigma",
    Sizes(300, 24, 3, 4, FACE.itemsize),
    _write,
    takes_points=True,
    takes_meshes=True,
    read=_read,
    holds_scalars=True,
)
