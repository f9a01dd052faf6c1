"""A surface cut by a plane: ordered lines to read heights, widths and radii off."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import finite_rows, lengths, median_spacing, unit_vectors
from slviewer.records.measurement import Quantity
from slviewer.registration.open3d_loader import open3d, point_cloud

BAND = 12.0
"""Spacings from the plane within which points are joined to triangles."""


@dataclass(frozen=True, eq=False)
class CutPlane:
    """``origin`` (3,) mm, and the two unit axes (3,) of the drawing: ``along`` to the right,
    ``up``."""

    origin: Floats
    along: Floats
    up: Floats

    @classmethod
    def through(cls, a: Floats, b: Floats, up: Floats) -> "CutPlane":
        """Through two points (3,) mm, a at 0 and b to its right, with ``up`` (3,) in it as nearly
        as can be; for a scan that is towards the camera, (0, 0, -1). Raises InputError for points
        that are one, or lie above one another.
        """
        a, b, up = (np.asarray(v, np.float64) for v in (a, b, up))
        along = b - a
        length = np.linalg.norm(along)
        if not length > 1e-6:
            raise InputError("The section's two points are one: pick them apart.")
        along = along / length
        across = up - (up @ along) * along
        if not np.linalg.norm(across) > 1e-3 * np.linalg.norm(up):
            raise InputError(
                "The section's two points lie above one another: pick one beside the other."
            )
        return cls(a, along, unit_vectors(across))

    @property
    def normal(self) -> Floats:
        """(3,): unit normal of the plane."""
        return np.cross(self.along, self.up)

    def drawn(self, points: Floats) -> Floats:
        """Return points (n, 3) in the drawing, (n, 2) mm: along and up."""
        return (points - self.origin) @ np.stack([self.along, self.up]).T


def section(vertices: np.ndarray, faces: np.ndarray, plane: CutPlane) -> list[np.ndarray]:
    """The lines (k, 2) mm in the plane's drawing in which it cuts triangles ``faces`` (m, 3) over
    ``vertices`` (n, 3).

    Each line's points follow one another, a closed line ends where it began; the longest line
    first, open ones from left to right. Raises InputError where nothing is cut.
    """
    heights = (np.asarray(vertices, np.float64) - plane.origin) @ plane.normal
    # what lies in the plane counts as above: every triangle is cut through two sides or none
    above = heights >= 0
    cut = faces[above[faces].any(axis=1) & ~above[faces].all(axis=1)]
    if not len(cut):
        raise InputError("The section's plane does not meet the surface: pick two points on it.")
    sides = np.stack([cut, np.roll(cut, -1, axis=1)], axis=2)  # (m, 3, 2)
    crossed = above[sides[..., 0]] != above[sides[..., 1]]
    ends = np.sort(sides[crossed].reshape(-1, 2), axis=1)  # two a triangle, in its order
    edges, segments = np.unique(ends, axis=0, return_inverse=True)
    segments = segments.reshape(-1, 2)
    low, high = (heights[edges[:, k]] for k in (0, 1))
    share = (low / (low - high))[:, None]
    places = vertices[edges[:, 0]] * (1 - share) + vertices[edges[:, 1]] * share
    drawn = plane.drawn(places)
    lines = [drawn[chain] for chain in _join_segments(segments, len(edges))]
    # a closed line begins and ends at one place
    lines = [line if line[0, 0] <= line[-1, 0] else line[::-1] for line in lines]
    return sorted(lines, key=lambda line: -float(lengths(np.diff(line, axis=0)).sum()))


def triangulate_near(
    points: Floats, normals: Floats, plane: CutPlane
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and triangles (m, 3) between the points (k, 3) mm of a cloud near a
    plane, to cut them.

    Balls roll over the points on the side of their ``normals`` (k, 3), three and six of the points'
    spacings in radius, so that wider gaps stay open (Bernardini et al. 1999). Raises InputError
    where no points lie near the plane.
    """
    known = finite_rows(normals)
    points, normals = points[known].astype(np.float64), normals[known].astype(np.float64)
    spacing = median_spacing(cKDTree(points), 2000) if len(points) > 1 else 0.0
    near = np.abs((points - plane.origin) @ plane.normal) < BAND * spacing
    if np.count_nonzero(near) < 3:
        raise InputError("The section's plane does not meet the surface: pick two points on it.")
    o3d = open3d()
    cloud = point_cloud(points[near], normals[near])
    radii = o3d.utility.DoubleVector([3.0 * spacing, 6.0 * spacing])
    mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    return points[near], np.asarray(mesh.triangles, np.int64)


def _join_segments(segments: np.ndarray, count: int) -> list[list[int]]:
    """Segments (m, 2) of numbered places as lines of places that follow one another; open ones
    first."""
    # by place: numbers of the segments that touch it, and their other ends
    touching: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for number, (a, b) in enumerate(segments.tolist()):
        touching[a].append((number, b))
        touching[b].append((number, a))
    unused = set(range(len(segments)))
    # where more than two triangles share a side, lines end
    starts = [place for place in range(count) if len(touching[place]) != 2]
    chains = []
    for place in [*starts, *range(count)]:
        for first in touching[place]:
            chain, (number, end) = [place], first
            while number in unused:
                unused.remove(number)
                chain.append(end)
                if len(touching[end]) == 2:
                    number, end = next((n for n in touching[end] if n[0] in unused), first)
            if len(chain) > 1:
                chains.append(chain)
    return chains


def measure_cursors(a: Floats, b: Floats) -> list[Quantity]:
    """Return the distance between two cursors (2,) mm on a section, along it and in height."""
    width, height = (float(value) for value in np.subtract(b, a))
    return [
        Quantity("distance", float(np.hypot(width, height)), "mm"),
        Quantity("along", width, "mm"),
        Quantity("height difference", height, "mm"),
    ]


def radius_through(a: Floats, b: Floats, c: Floats) -> Quantity:
    """Return the radius of the circle through three cursors (2,) mm. Raises InputError for cursors
    on a straight line."""
    edges = np.stack([np.subtract(b, a), np.subtract(c, a), np.subtract(c, b)])
    area, sides = abs(float(np.linalg.det(edges[:2]))), lengths(edges)
    if not area > 1e-6 * sides.max() ** 2:
        raise InputError("The three cursors lie on a straight line: put the middle one on a curve.")
    return Quantity("radius", float(sides.prod()) / (2 * area), "mm")


def nearest_on_section(lines: list[Floats], x: float) -> Floats:
    """(2,) mm: where a cursor at ``x`` meets the section, at the highest line; the nearest point
    drawn where no line passes x."""
    left, right = (
        np.concatenate([line[part] for line in lines]) for part in (np.s_[:-1], np.s_[1:])
    )
    passes = (left[:, 0] - x) * (right[:, 0] - x) <= 0
    passes &= left[:, 0] != right[:, 0]
    left, right = left[passes], right[passes]
    share = (x - left[:, 0]) / (right[:, 0] - left[:, 0])
    heights = left[:, 1] + share * (right[:, 1] - left[:, 1])
    if not heights.size:
        drawn = np.concatenate(lines)
        return drawn[np.argmin(np.abs(drawn[:, 0] - x))]
    return np.array([x, heights.max()])
