"""What is picked or fitted on a measured surface: a point, a plane, a sphere, a cylinder; distances
and angles between them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.inspection.uncertainty import Spread, joint_covariance, propagate_covariance
from slviewer.records.measurement import Quantity, Unit

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
    place: Floats
    direction: Floats | None = None
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

    def jacobian(self, points: np.ndarray) -> Floats:
        """Return the derivatives (n, p) of ``distance`` of the points (n, 3) by the parameters."""
        offsets, normals = np.asarray(points, np.float64) - self.place, self.normals(points)
        minus = -np.ones((len(offsets), 1))
        if self.kind == "point":
            return -normals
        if self.kind == "sphere":
            return np.hstack([-normals, minus])
        e = perpendicular_axes(self.unit_direction)
        if self.kind == "plane":
            return np.hstack([offsets @ e.T, minus])
        shifts = -normals @ e.T
        return np.hstack([(offsets @ self.unit_direction)[:, None] * shifts, shifts, minus])

    def moved(self, step: Floats) -> "Feature":
        """Return the feature with its parameters changed by a step (p,)."""
        tilts, shifts, direction = self._tilts, self._shifts, self.direction
        place = self.place + step[tilts : tilts + len(shifts)] @ shifts
        if direction is not None:
            direction = unit_vectors(direction + step[:2] @ perpendicular_axes(direction))
        radius = None if self.radius is None else self.radius + step[-1]
        return replace(self, place=place, direction=direction, radius=radius)

    @property
    def parameters(self) -> int:
        """Number of the feature's parameters."""
        return self._tilts + len(self._shifts) + (self.radius is not None)

    @property
    def _tilts(self) -> int:
        """Number of the parameters that tilt the direction."""
        return 0 if self.direction is None else 2

    @property
    def _shifts(self) -> Floats:
        """Return the unit vectors (k, 3) along which the parameters shift the place."""
        if self.direction is None:
            return np.eye(3)
        axis = self.direction
        return axis[None] if self.kind == "plane" else perpendicular_axes(axis)

    @property
    def unit_direction(self) -> Floats:
        """Unit normal or axis (3,); InputError for a feature without one."""
        if self.direction is None:
            raise InputError(f"A {self.kind} has no direction: choose a plane or a cylinder.")
        return self.direction

    def _across(self, offsets: Floats) -> Floats:
        """Return the offsets (n, 3) from the feature's place, for a cylinder only their part across
        the axis."""
        if self.kind != "cylinder":
            return offsets
        return offsets - (offsets @ self.unit_direction)[..., None] * self.unit_direction


def perpendicular_axes(direction: Floats) -> Floats:
    """Return two unit vectors (2, 3) perpendicular to a unit direction (3,) and to each other."""
    first = unit_vectors(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]))
    return np.stack([first, np.cross(direction, first)])


PARALLEL_DEG = 5.0
"""Axes nearer to parallel than this are as far apart as they are in the measured region: where they
would meet, if they do, is far away and means nothing."""


@dataclass(frozen=True)
class Meaning:
    """A quantity between two kinds of features, and how it is computed; the first kind comes first
    in `KINDS`."""

    name: str
    unit: Unit
    of: Callable[[Feature, Feature], float]


def _distance(a: Feature, b: Feature) -> float:
    """Return the distance in mm between the places of two features."""
    return float(np.linalg.norm(b.place - a.place))


def _angle(a: Feature, b: Feature) -> float:
    """Return the angle between two directions, 0 to 90 degrees."""
    u, v = a.unit_direction, b.unit_direction
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), abs(u @ v))))


def _offset(a: Feature, axis: Feature) -> float:
    """Return the distance in mm of a feature's place from an axis."""
    return float(np.linalg.norm(np.cross(a.place - axis.place, axis.unit_direction)))


def _height(a: Feature, plane: Feature) -> float:
    """Return the signed distance in mm of a feature's place from a plane."""
    return float((a.place - plane.place) @ plane.unit_direction)


def _plane_gap(a: Feature, b: Feature) -> float:
    """Return the distance in mm of two nearly parallel planes: mean of each place's distance from
    the other."""
    return 0.5 * (abs(_height(a, b)) + abs(_height(b, a)))


def _axis_gap(a: Feature, b: Feature) -> float:
    """Return the shortest distance in mm between two axes, which may be parallel."""
    if _angle(a, b) < PARALLEL_DEG:
        return 0.5 * (_offset(a, b) + _offset(b, a))
    across = np.cross(a.unit_direction, b.unit_direction)
    return float(abs((b.place - a.place) @ across) / np.linalg.norm(across))


def _size(feature: Feature) -> float:
    """Return the feature's radius in mm; 0 where it has none."""
    return feature.radius or 0.0


MEANINGS: dict[tuple[str, str], tuple[Meaning, ...]] = {
    ("point", "point"): (Meaning("distance", "mm", _distance),),
    # positive on the camera's side
    ("point", "plane"): (Meaning("height", "mm", _height),),
    ("point", "sphere"): (
        Meaning("distance from the centre", "mm", _distance),
        # negative inside
        Meaning("distance from the surface", "mm", lambda p, s: _distance(p, s) - _size(s)),
    ),
    ("point", "cylinder"): (
        Meaning("distance from the axis", "mm", _offset),
        Meaning("distance from the surface", "mm", lambda p, c: _offset(p, c) - _size(c)),
    ),
    ("plane", "plane"): (
        Meaning("angle", "deg", _angle),
        # of the middle of each region from the other's plane, the mean of both
        Meaning("distance", "mm", _plane_gap),
    ),
    ("plane", "sphere"): (
        Meaning("height of the centre", "mm", lambda p, s: _height(s, p)),
        # negative where they cut
        Meaning("gap", "mm", lambda p, s: abs(_height(s, p)) - _size(s)),
    ),
    ("plane", "cylinder"): (
        # between the axis and the plane
        Meaning("angle", "deg", lambda p, c: 90.0 - _angle(p, c)),
        # in the middle of the cylinder's region
        Meaning("height of the axis", "mm", lambda p, c: _height(c, p)),
    ),
    ("sphere", "sphere"): (
        Meaning("distance of the centres", "mm", _distance),
        Meaning("gap", "mm", lambda a, b: _distance(a, b) - _size(a) - _size(b)),
    ),
    ("sphere", "cylinder"): (Meaning("distance from the axis", "mm", _offset),),
    ("cylinder", "cylinder"): (
        Meaning("angle", "deg", _angle),
        # the shortest; near parallel, that in the middle of the regions
        Meaning("distance of the axes", "mm", _axis_gap),
    ),
}
"""The quantities of each pair of feature kinds."""


def relation(a: Feature, a_spread: Spread, b: Feature, b_spread: Spread) -> list[Quantity]:
    """Compute all quantities between two features, in either order, with their uncertainty where it
    is known.

    The uncertainty that both share through one calibration counts once.
    """
    if KINDS.index(a.kind) > KINDS.index(b.kind):
        a, a_spread, b, b_spread = b, b_spread, a, a_spread
    covariance = joint_covariance(a_spread, b_spread)
    whole = a_spread.whole and b_spread.whole
    p = a.parameters

    def quantity(meaning: Meaning) -> Quantity:
        """Return the value of one quantity between both features, with its uncertainty."""

        def moved(step: Floats) -> float:
            """Return the quantity after the features' parameters change by a step (p + q,)."""
            return meaning.of(a.moved(step[:p]), b.moved(step[p:]))

        sigma = propagate_covariance(moved, covariance)
        return Quantity(meaning.name, meaning.of(a, b), meaning.unit, sigma, whole)

    return [quantity(meaning) for meaning in MEANINGS[a.kind, b.kind]]


def distance(a: np.ndarray, b: np.ndarray, a_spread: Spread, b_spread: Spread) -> Quantity:
    """Return the distance between two picked points (3,) mm, with its uncertainty."""
    return relation(
        Feature("point", np.asarray(a)), a_spread, Feature("point", np.asarray(b)), b_spread
    )[0]
