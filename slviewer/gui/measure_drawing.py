"""Measurements in the 3D view: their lines, and the labels beside them."""

from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.inspection.features import Feature
from slviewer.inspection.section import CutPlane
from slviewer.pipeline.stored_records import Stored
from slviewer.records.measurement import Measurement
from slviewer.records.plain import from_plain, to_plain

_ROUND = 48
_OFF = 0.01
"""Lines on the surface are drawn above it by this share of its size, so as to be visible."""
_LEG, _SHORTEST_LEG_MM = 0.15, 5.0
"""Length of a dimension's legs, as a share of the dimension and at least."""
_EXTENT_MM = 15.0
"""Half size of a plane or a cylinder whose region has none."""


def label(measured: Stored[Measurement]) -> str:
    """Return a measurement's label in 3D: the name, and the first quantity."""
    what, first = measured.record.what, measured.record.quantities[0]
    if what in ("point", "section", "deviation"):
        return measured.label
    named = "" if what in ("distance", "relation") else f"{first.name} "
    return f"{measured.label}: {named}{first.format()}" + (" (stale)" if measured.stale else "")


def drawn(
    measured: Measurement, others: Mapping[str, Measurement], lines: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw a measurement: ((n, 2, 3) segments, (3,) position of its label) mm; None where nothing
    can be drawn.

    ``others``: all measurements by id; ``lines`` (k, 2) mm: of a section.
    """
    if measured.ends is not None:
        a, b = (np.array(end) for end in measured.ends)
        return _draw_dimension(a, b)
    if measured.plane is not None:
        return _draw_section(from_plain(to_plain(measured.plane), CutPlane), lines)
    if measured.what == "relation":
        return _draw_relation([feature_of(others[each]) for each in measured.of if each in others])
    feature = feature_of(measured)
    if feature is None:
        return None
    extent = _EXTENT_MM if measured.region is None else max(measured.region.size)
    return _draw_outline(feature, extent), feature.place


def feature_of(measured: Measurement) -> Feature | None:
    """Return the point, plane, sphere or cylinder of a measurement; None for other kinds."""
    return None if measured.feature is None else from_plain(to_plain(measured.feature), Feature)


def lifted(plane: CutPlane, points: np.ndarray) -> np.ndarray:
    """Convert points (n, 2) mm of a section's drawing to points (n, 3) in space."""
    return np.asarray(plane.origin + points[..., :1] * plane.along + points[..., 1:] * plane.up)


def _draw_section(plane: CutPlane, lines: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Draw the lines (k, 2) mm of a section, and return them as `drawn` does."""
    if not lines:
        return np.empty((0, 2, 3)), plane.origin
    off = _OFF * float(np.ptp(np.concatenate(lines)[:, 0]))
    cut = [lifted(plane, line + np.array([0.0, off])) for line in lines]
    return (
        np.concatenate([_join_segments(each) for each in cut]),
        cut[0][np.argmax(cut[0] @ plane.up)],
    )


def _draw_relation(features: Sequence[Feature | None]) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw the dimension line between two features; None unless there are two."""
    ends = [feature for feature in features if feature is not None]
    if len(ends) != 2:
        return None
    # outside of both; a point is on the surface already
    clear = (
        0.0
        if any(end.kind == "point" for end in ends)
        else 1.2 * max(end.radius or 0.0 for end in ends)
    )
    return _draw_dimension(ends[0].place, ends[1].place, clear)


def _draw_outline(feature: Feature, extent: float) -> np.ndarray:
    """Draw a feature as segments (n, 2, 3) mm: great circles, a disc with its normal, a cylinder's
    rings and axis."""
    if feature.kind == "point":
        return _draw_cross(feature.place, 2.5)
    if feature.kind == "sphere":
        assert feature.radius is not None
        circles = [
            _draw_circle(feature.place, axis, (1 + _OFF) * feature.radius) for axis in np.eye(3)
        ]
        return np.concatenate([*circles, _draw_cross(feature.place, 0.1 * feature.radius)])
    assert feature.direction is not None
    along = extent * feature.direction
    if feature.kind == "plane":
        normal = np.array([[feature.place, feature.place + 0.4 * along]])
        return np.concatenate(
            [_draw_circle(feature.place + _OFF * along, feature.direction, extent), normal]
        )
    assert feature.radius is not None
    ends = [feature.place - along, feature.place + along]
    rings = [_draw_circle(end, feature.direction, (1 + _OFF) * feature.radius) for end in ends]
    return np.concatenate([*rings, np.array([ends])])


def _draw_dimension(
    a: np.ndarray, b: np.ndarray, clear_mm: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a dimension line from `a` to `b`, offset towards the camera, with a leg to either end.

    Returns ((3, 2, 3) segments, (3,) position of the label) mm; the legs are at least `clear_mm`
    long.
    """
    middle = (a + b) / 2
    leg = max(_LEG * float(np.linalg.norm(b - a)), _SHORTEST_LEG_MM, clear_mm)
    up = -leg * middle / max(float(np.linalg.norm(middle)), 1e-9)
    return np.array([[a, a + up], [a + up, b + up], [b + up, b]]), middle + up


def _draw_circle(centre: np.ndarray, axis: np.ndarray, radius: float) -> np.ndarray:
    """Draw a circle as segments (n, 2, 3) mm around a centre (3,), perpendicular to an axis
    (3,)."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    t = np.linspace(0, 2 * np.pi, _ROUND + 1)[:, None]
    return _join_segments(centre + radius * (np.cos(t) * first + np.sin(t) * second))


def _draw_cross(centre: np.ndarray, half: float) -> np.ndarray:
    """Draw a cross along the axes as segments (3, 2, 3) mm, `half` mm to either side of its
    centre."""
    return np.stack([centre - half * np.eye(3), centre + half * np.eye(3)], axis=1)


def _join_segments(points: np.ndarray) -> np.ndarray:
    """Join consecutive points (n, 3) to segments (n - 1, 2, 3)."""
    return np.stack([points[:-1], points[1:]], axis=1)
