"""Distances and angles between features."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slviewer.inspection.features import KINDS, Feature
from slviewer.inspection.uncertainty import Spread, joint_covariance, propagate_covariance
from slviewer.records.quantities import Quantity, Unit

PARALLEL_DEG = 5.0
"""Axes nearer to parallel than this are as far apart as they are in the measured region: where they
would meet, if they do, is far away and means nothing."""


@dataclass(frozen=True)
class Meaning:
    """A quantity between two kinds of features, in words, and how it is computed; the first kind
    comes first in ``features.KINDS``."""

    name: str
    unit: Unit
    words: str
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
    ("point", "point"): (Meaning("distance", "mm", "between the two points", _distance),),
    ("point", "plane"): (
        Meaning("height", "mm", "of the point over the plane, positive on the camera's side",
        _height),
    ),
    ("point", "sphere"): (
        Meaning("distance from the centre", "mm", "of the point", _distance),
        Meaning(
            "distance from the surface", "mm", "of the point, negative inside", lambda p,
            s: _distance(p, s) - _size(s)
        ),
    ),
    ("point", "cylinder"): (
        Meaning("distance from the axis", "mm", "of the point", _offset),
        Meaning(
            "distance from the surface", "mm", "of the point, negative inside", lambda p,
            c: _offset(p, c) - _size(c)
        ),
    ),
    ("plane", "plane"): (
        Meaning("angle", "deg", "between the planes, 0 to 90", _angle),
        Meaning("distance", "mm",
                "of the middle of each region from the other's plane, the mean of both",
                _plane_gap),
    ),
    ("plane", "sphere"): (
        Meaning("height of the centre", "mm", "over the plane", lambda p, s: _height(s, p)),
        Meaning("gap", "mm", "to the sphere, negative where they cut", lambda p,
        s: abs(_height(s, p)) - _size(s)),
    ),
    ("plane", "cylinder"): (
        Meaning("angle", "deg", "between the axis and the plane", lambda p, c: 90.0 - _angle(p, c)),
        Meaning("height of the axis", "mm",
        "over the plane, in the middle of the cylinder's region",
                lambda p, c: _height(c, p)),
    ),
    ("sphere", "sphere"): (
        Meaning("distance of the centres", "mm", "of the two spheres", _distance),
        Meaning("gap", "mm", "between the spheres", lambda a,
        b: _distance(a, b) - _size(a) - _size(b)),
    ),
    ("sphere", "cylinder"): (
        Meaning("distance from the axis", "mm", "of the sphere's centre", _offset),
    ),
    ("cylinder", "cylinder"): (
        Meaning("angle", "deg", "between the axes, 0 to 90", _angle),
        Meaning("distance of the axes", "mm",
        f"the shortest; within {PARALLEL_DEG:g} degrees of parallel, that in the "
                "middle of the regions", _axis_gap),
    ),
}  # fmt: skip
"""The quantities of each pair of feature kinds."""


def relation(a: Feature, a_spread: Spread, b: Feature, b_spread: Spread) -> list[Quantity]:
    """Compute all quantities between two features, in either order, with their uncertainty where it
    is known.

    The uncertainty that both share through one calibration counts once.
    """
    if KINDS.index(a.kind) > KINDS.index(b.kind):
        a, a_spread, b, b_spread = b, b_spread, a, a_spread
    covariance = joint_covariance(a_spread, b_spread)
    whole = a_spread.shared is not None and b_spread.shared is not None
    p = a.parameters

    def quantity(meaning: Meaning) -> Quantity:
        """Return the value of one quantity between both features, with its uncertainty."""

        def moved(step: np.ndarray) -> float:
            """Return the quantity after the features' parameters change by a step (p + q,)."""
            return meaning.of(a.moved(step[:p]), b.moved(step[p:]))

        return Quantity(
            meaning.name,
            meaning.of(a, b),
            meaning.unit,
            propagate_covariance(moved, covariance),
            whole,
        )

    return [quantity(meaning) for meaning in MEANINGS[a.kind, b.kind]]


def distance(a: np.ndarray, b: np.ndarray, a_spread: Spread, b_spread: Spread) -> Quantity:
    """Return the distance between two picked points (3,) mm, with its uncertainty."""
    return relation(
        Feature("point", np.asarray(a)), a_spread, Feature("point", np.asarray(b)), b_spread
    )[0]
