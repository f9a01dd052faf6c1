"""PLY: binary, float32, mm, with normals, colours, the expected errors (sigma) and other values of
each point."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.session.ply import FACE, write_ply
from slviewer.session.shape_format import Columns, Shape, ShapeFormat, Sizes, split_shape


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    points, faces = split_shape(shape)
    write_ply(path, points, shape.colours, shape.normals, scalars, faces, notes)


def _read(path: Path, data: bytes) -> list[Columns]:
    """Return the properties of the vertices by name."""
    import trimesh

    loaded: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    vertices = loaded.metadata["_ply_raw"]["vertex"]
    values = vertices["data"]
    names = values if isinstance(values, dict) else values.dtype.names
    return [{name: np.ravel(values[name])[: vertices["length"]] for name in names}]


FORMAT = ShapeFormat(
    "ply",
    "mm; with colours, normals and sigma",
    Sizes(300, 24, 3, 4, FACE.itemsize),
    _write,
    takes_points=True,
    takes_meshes=True,
    read=_read,
)
