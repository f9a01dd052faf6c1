"""Unorganised point sets and triangle meshes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.errors import InputError


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of a surface, in one frame.

    ``points`` (n, 3) float32 mm, finite. Where known: ``normals`` (n, 3) float32, of unit length,
    outwards; ``colours`` (n, 3) uint8 RGB; ``sigma_mm`` (n,) float32, the expected error of each
    point along its normal.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None

    def __post_init__(self) -> None:
        _set_array(self, "points", self.points, np.float32, (len(self.points), 3))
        _set_attributes(self, len(self.points))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a surface.

    ``vertices`` (n, 3) float32 mm; ``faces`` (m, 3) int32, counter-clockwise seen from outside. Of
    each vertex where known: ``normals`` (n, 3) float32, ``colours`` (n, 3) uint8 RGB, ``sigma_mm``
    (n,) float32.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None

    def __post_init__(self) -> None:
        _set_array(self, "vertices", self.vertices, np.float32, (len(self.vertices), 3))
        _set_array(self, "faces", self.faces, np.int32, (len(self.faces), 3))
        if len(self.faces) and not (
            self.faces.min() >= 0 and self.faces.max() < len(self.vertices)
        ):
            raise InputError(
                f"Faces name vertices outside the {len(self.vertices)} that there are."
            )
        _set_attributes(self, len(self.vertices))


def pick_attributes(shape: PointSet | Mesh, which: np.ndarray) -> dict[str, Any]:
    """Return normals, colours and sigmas of some of the points, by index or mask; None where they
    are not known."""
    values = {name: getattr(shape, name) for name in ("normals", "colours", "sigma_mm")}
    return {name: None if value is None else value[which] for name, value in values.items()}


def _set_attributes(shape: "PointSet | Mesh", n: int) -> None:
    """Convert the optional attributes of ``n`` points to their dtypes, and check their shapes."""
    for name, dtype, expected in (
        ("normals", np.float32, (n, 3)),
        ("colours", np.uint8, (n, 3)),
        ("sigma_mm", np.float32, (n,)),
    ):
        value = getattr(shape, name)
        if value is not None:
            _set_array(shape, name, value, dtype, expected)


def _set_array(
    shape: "PointSet | Mesh", name: str, value: np.ndarray, dtype: type, expected: tuple[int, ...]
) -> None:
    """Set an attribute to an array of a dtype; raises InputError where its shape is not the
    expected one."""
    array: np.ndarray = np.asarray(value, dtype=dtype)
    if array.shape != expected:
        raise InputError(f"The {name} have shape {array.shape}: {expected} is needed.")
    object.__setattr__(shape, name, array)
