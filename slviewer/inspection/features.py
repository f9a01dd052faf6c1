"""What is picked or fitted on a measured surface: a point, a plane, a sphere, a cylinder."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import lengths, unit_vectors

Kind = Literal["point", "plane", "sphere", "cylinder"]
KINDS: tuple[Kind, ...] = ("point", "plane", "sphere", "cylinder")


@dataclass(frozen=True, eq=False)
class Feature:
    """A point (``place``); a plane (``place`` on it, in the middle of what was measured, unit
    normal ``direction``); a sphere (centre, ``radius``); a cylinder (``place`` on its axis, in the
    middle of what was measured, unit ``direction``, ``radius``). mm.

    Its parameters, by which it can be ``moved``: of a point and a sphere the shift of ``place``
    (3), of a sphere then that of the radius; of a plane the tilt of its normal towards two
    directions across (rad) and its shift along the normal; of a cylinder the tilts of its axis, its
    shifts across, and that of its radius.
    """

    kind: Kind
    place: np.ndarray
    direction: np.ndarray | None = None
    radius: float | None = None

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return distances (n,) mm of points (n, 3) from the feature: from a plane signed by the
        normal, else positive outwards."""
        offsets = np.asarray(points, np.float64) - self.place
        if self.kind == "plane":
            return offsets @ self.unit_direction
        return lengths(self._across(offsets)) - (self.radius or 0.0)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Return the unit vectors (n, 3) along which ``distance`` grows."""
        offsets = np.asarray(points, np.float64) - self.place
        if self.kind == "plane":
            return np.broadcast_to(self.unit_direction, offsets.shape)
        return unit_vectors(self._across(offsets))

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, p) of ``distance`` of the points (n, 3) by the parameters."""
        offsets, normals = np.asarray(points, np.float64) - self.place, self.normals(points)
        minus = -np.ones((len(offsets), 1))
        if self.kind == "point":
            return -normals
        if self.kind == "sphere":
            return np.hstack([-normals, minus])
        e = self._tangents()
        if self.kind == "plane":
            return np.hstack([offsets @ e.T, minus])
        shifts = -normals @ e.T
        return np.hstack([(offsets @ self.unit_direction)[:, None] * shifts, shifts, minus])

    def moved(self, step: np.ndarray) -> "Feature":
        """Return the feature with its parameters changed by a step (p,)."""
        step = np.asarray(step, np.float64)
        if self.kind in ("point", "sphere"):
            radius = None if self.radius is None else self.radius + step[3]
            return replace(self, place=self.place + step[:3], radius=radius)
        e = self._tangents()
        tilted = unit_vectors(self.unit_direction + step[:2] @ e)
        if self.kind == "plane":
            return replace(self, place=self.place + step[2] * self.unit_direction, direction=tilted)
        assert self.radius is not None
        return replace(
            self, place=self.place + step[2:4] @ e, direction=tilted, radius=self.radius + step[4]
        )

    @property
    def parameters(self) -> int:
        """Number of the feature's parameters."""
        return {"point": 3, "plane": 3, "sphere": 4, "cylinder": 5}[self.kind]

    @property
    def unit_direction(self) -> np.ndarray:
        """Unit normal or axis (3,); InputError for a feature without one."""
        if self.direction is None:
            raise InputError(f"A {self.kind} has no direction: choose a plane or a cylinder.")
        return self.direction

    def _across(self, offsets: np.ndarray) -> np.ndarray:
        """Return the offsets (n, 3) from the feature's place, for a cylinder only their part across
        the axis."""
        if self.kind != "cylinder":
            return offsets
        return offsets - (offsets @ self.unit_direction)[..., None] * self.unit_direction

    def _tangents(self) -> np.ndarray:
        """Return two unit vectors (2, 3) perpendicular to the direction and to each other."""
        least = np.eye(3)[np.argmin(np.abs(self.unit_direction))]
        first = unit_vectors(_cross(self.unit_direction, least))
        return np.stack([first, _cross(self.unit_direction, first)])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product (3,) of two vectors (3,); `numpy.cross` takes ten times as long for
    so few."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])
