"""What a file format of points and meshes is: each is declared in a module of `session.formats`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.session.atomic import replace_file
from slviewer.session.columns import Columns
from slviewer.session.ply import replace_nan
from slviewer.session.units import Units
from slviewer.surface.shapes import Mesh, PointSet

Shape = PointSet | Mesh
Write = Callable[[Path, Shape, Columns, Sequence[str]], None]
Read = Callable[[Path, bytes, list[str]], list[Columns]]
DECIMALS = 6
"""Of lengths in text: a nanometre, below what a float32 of some hundred mm resolves."""


@dataclass(frozen=True)
class Sizes:
    """Bytes of a file, of each of its points, their colours and scalars, and of each face."""

    file: int
    point: int
    colour: int = 0
    scalar: int = 0
    face: int = 0
    digit: int = 0
    """Of each face, by the digits of the number of points."""

    def estimate(self, points: int, faces: int, colours: bool, scalars: int) -> int:
        """Estimate the size of a file of so many points and faces."""
        face = self.face + self.digit * len(str(points))
        point = self.point + self.colour * colours + self.scalar * scalars
        return self.file + points * point + faces * face


@dataclass(frozen=True)
class ShapeFormat:
    """A file format of points or meshes.

    ``name``: the suffix in lower case, without the dot, under which it is written, ``others`` under
    which it is read too. ``what``: unit and content, in a few words. ``write(path, shape, scalars,
    notes)`` writes a shape in mm; scalars and notes as in `write_shape`.
    ``read(path, data, notes)``: the columns of the clouds of a file, in its ``unit``, by their
    names in it; what it holds besides is named in ``notes``. None where its points are read as
    those of a nominal model, or not at all. Both raise InputError with what to do.
    ``holds_scalars``: values of each point by name; ``holds_origin``: coordinates far from the
    origin, in more than float32.
    """

    name: str
    what: str
    sizes: Sizes = Sizes(0, 33, 12)
    write: Write | None = None
    takes_points: bool = False
    takes_meshes: bool = False
    read: Read | None = None
    others: tuple[str, ...] = ()
    unit: Units = "mm"
    holds_scalars: bool = False
    holds_origin: bool = True

    @property
    def suffixes(self) -> tuple[str, ...]:
        """All its suffixes, with their dots."""
        return tuple(f".{each}" for each in (self.name, *self.others))


def split_shape(shape: Shape) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points (n, 3) mm of a shape, float64 where it has an origin, which is added, and
    the triangles (m, 3) of a mesh."""
    points, faces = (
        (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    )
    return points if shape.origin is None else points + shape.origin, faces


def writing(encode: Callable[[Any, Sequence[str]], bytes]) -> Write:
    """Return what writes a file from ``encode(shape, notes)``, its content."""

    def write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
        """Write the content; it appears whole or not at all."""
        replace_file(path, encode(shape, notes))

    return write


def to_trimesh(shape: Shape, scale: float = 1.0) -> Any:
    """A trimesh.Trimesh or PointCloud with colours and normals, which are zero where unknown."""
    import trimesh

    points, faces = split_shape(shape)
    points = scale * points.astype(np.float64)
    if faces is None:
        return trimesh.PointCloud(points, shape.colours)
    normals = None if shape.normals is None else replace_nan("nx", shape.normals)
    return trimesh.Trimesh(
        points,
        faces,
        vertex_normals=normals,
        vertex_colors=shape.colours,
        process=False,
    )
