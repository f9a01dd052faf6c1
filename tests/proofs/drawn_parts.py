"""Parts at random, and the same parts with errors of a given size.

Parts are plates with features (bosses, pockets, ribs, steps) of flat faces, or free forms; all
sizes are shares of the part's. Nothing here is shared with the inspection that it tests.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from slviewer.geometry.vectors import lengths
from slviewer.registration.open3d_loader import open3d, raycasting_scene

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
PartKind = Literal["pins", "holes", "slots", "steps", "ribs", "free form"]
ChangedFault = Literal["length", "moved", "width", "turned", "revision"]
AddedFault = Literal["missing", "extra", "burr", "dirt", "dent"]
LocalFault = Literal[ChangedFault, AddedFault]

COVER = 12_000
"""Points that cover a surface, beside its vertices."""
MAX_SIZE_ERROR = 0.02
GAP = 0.03
"""Between features, and to the part's edge, over the part's size: more than any fault moves one."""
SHRINK = 0.96
"""Of a feature without room, before the next try."""
CORNERS = 40
"""Of a round outline."""


class UnsuitedPartError(ValueError):
    """The part has no feature, or no room, for the requested fault: draw another one."""


@dataclass(frozen=True)
class PartFeature:
    """A boss, or with negative ``height`` a pocket (-inf: a through hole), mm.

    ``half``: half its widths. ``is_dome``: it rises smoothly, as dirt or a dent. On a free form a
    feature is a Gaussian hill with the standard deviations ``half``.
    """

    centre: tuple[float, float]
    half: tuple[float, float]
    angle: float
    height: float
    is_round: bool = False
    is_dome: bool = False

    @property
    def radius(self) -> float:
        """Of the circle around it, mm."""
        return self.half[0] if self.is_round else float(np.hypot(*self.half))

    def ring(self, z: float, share: float = 1.0) -> Floats:
        """Its outline (k, 3) mm at a height, counter-clockwise; of a ``share`` of its size."""
        turn = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
        corners = np.stack([np.cos(turn), np.sin(turn)], 1)
        if not self.is_round:
            corners = _box((-1, 1), (-1, 1))
        flat = share * corners * self.half @ _turn_plane(self.angle).T + self.centre
        return np.column_stack([flat, np.full(len(flat), z)])


def _turn_plane(angle: float) -> Floats:
    """The rotation (2, 2) by an angle in radians."""
    return np.array([(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))])


def _box(x: Sequence[float], y: Sequence[float]) -> Floats:
    """The corners (4, 2) of a rectangle."""
    return np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


@dataclass(frozen=True)
class Part:
    """A plate below z = 0 of a ``thickness``, whose top rises in strips between the ``edges`` (k +
    1) along x to the ``levels`` (k), mm.

    ``is_open``: its mesh is the top alone. ``splits``: how often its triangles are split in four.
    """

    edges: tuple[float, ...]
    levels: tuple[float, ...]
    half_width: float
    thickness: float
    is_free_form: bool
    is_open: bool
    splits: int
    features: tuple[PartFeature, ...] = ()

    @property
    def size(self) -> float:
        """Length of the plate's diagonal, mm."""
        return float(2 * np.hypot(self.edges[-1], self.half_width))

    def add(self, feature: PartFeature) -> "Part":
        """The part with one more feature."""
        return replace(self, features=(*self.features, feature))

    def build(self) -> trimesh.Trimesh:
        """Its mesh, watertight unless it is open."""
        corners = np.concatenate(self._hill_faces() if self.is_free_form else self._plate_faces())
        mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
        mesh.update_faces(mesh.nondegenerate_faces())
        for _ in range(self.splits):
            mesh = mesh.subdivide()
        return mesh

    def _plate_faces(self) -> list[Floats]:
        """Triangles (m, 3, 3) of each flat face."""
        x, y, bottom = self.edges, (-self.half_width, self.half_width), -self.thickness
        faces: list[Floats] = []
        for i, z in enumerate(self.levels):
            own = [f for f in self.features if x[i] < f.centre[0] < x[i + 1]]
            top = [_box(x[i : i + 2], y), *(f.ring(z)[:, :2] for f in own)]
            faces.append(_flat_face(top, z))
            for feature in own:
                faces += _feature_faces(feature, z, bottom)
            if i:
                wall = _box(y, sorted(self.levels[i - 1 : i + 1]))
                faces.append(_flat_face([wall], x[i], (1, 2, 0), np.sign(self.levels[i - 1] - z)))
        if self.is_open:
            return faces
        holes = [f.ring(0)[:, :2] for f in self.features if np.isinf(f.height)]
        faces.append(_flat_face([_box((x[0], x[-1]), y), *holes], bottom, sign=-1))
        tops = [(e, z) for i, z in enumerate(self.levels) for e in x[i : i + 2]]
        profile = np.array([(x[-1], bottom), *tops[::-1], (x[0], bottom)])
        for end, sign in ((0, -1), (-1, 1)):
            faces.append(_flat_face([profile], y[end], (0, 2, 1), sign))
            wall = _box(y, (bottom, self.levels[end]))
            faces.append(_flat_face([wall], x[end], (1, 2, 0), sign))
        return faces

    def _hill_faces(self) -> list[Floats]:
        """Triangles (m, 3, 3) of the relief, and of the base below it."""
        x, y = (
            np.linspace(-half, half, round(140 * half / self.size))
            for half in (self.edges[-1], self.half_width)
        )
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
        z = np.zeros(grid.shape[:2])
        for f in self.features:
            q = (grid - f.centre) @ _turn_plane(f.angle) / f.half
            z += f.height * np.exp(-0.5 * (q**2).sum(-1))
        top = np.dstack([grid, z])
        if self.is_open:
            return [_grid_face(top)]
        base = np.dstack([grid, np.full_like(z, min(z.min(), 0) - self.thickness)])
        both = np.stack([base, top], 2)
        rims = both[:, 0], both[-1], both[::-1, -1], both[0, ::-1]
        return [_grid_face(top), _grid_face(base)[:, ::-1], *map(_grid_face, rims)]


def _grid_face(grid: Floats) -> Floats:
    """Triangles (m, 3, 3) between points (h, w, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.stack([a, b, c, a, c, d], 2).reshape(-1, 3, 3)


def _flat_face(
    rings: Sequence[Floats], offset: float, axes: Sequence[int] = (0, 1, 2), sign: float = 1
) -> Floats:
    """Triangles (m, 3, 3) of a polygon: an outer ring and rings of holes (k, 2), in two of the
    ``axes``, at an ``offset`` along the third, which the ``sign`` says to face."""
    from mapbox_earcut import triangulate_float64

    flat = np.concatenate(rings)
    points = np.full((len(flat), 3), offset)
    points[:, axes[:2]] = flat
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    corners = points[triangulate_float64(flat, ends).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = sign * normals[:, axes[2]] < 0
    corners[turned] = corners[turned][:, ::-1]
    return corners


def _feature_faces(feature: PartFeature, level: float, bottom: float) -> list[Floats]:
    """Triangles (m, 3, 3) of the faces of a feature that stands on a level."""
    top = max(bottom, level + feature.height)
    rings = [feature.ring(level), feature.ring(top)]
    if feature.is_dome:
        shares = np.linspace(1, 0, 7)
        rings = [
            feature.ring(level + feature.height * (1 + np.cos(np.pi * s)) / 2, s) for s in shares
        ]
    grid = np.stack(rings, 1)
    wall = _grid_face(np.concatenate([grid, grid[:1]]))
    is_closed = feature.is_dome or np.isinf(feature.height)
    return [wall] if is_closed else [wall, _flat_face([feature.ring(top)[:, :2]], top)]


def draw_part(rng: np.random.Generator, kind: PartKind) -> Part:
    """A part of a kind, 8 to 400 mm across, with 3 to 7 features of different sizes."""
    size, ratio = np.exp(rng.uniform(np.log(8), np.log(400))), rng.uniform(0.45, 0.85)
    half_length = size / 2 / np.hypot(1, ratio)
    count = int(rng.integers(2, 4)) if kind == "steps" else 1
    inner = half_length * np.sort(rng.uniform(-0.5, 0.5, count - 1))
    levels = size * np.cumsum([0.0, *rng.uniform(0.02, 0.05, count - 1)])[:: rng.choice([1, -1])]
    part = Part(
        (-half_length, *inner, half_length),
        tuple(levels),
        ratio * half_length,
        size * rng.uniform(0.06, 0.12),
        kind == "free form",
        bool(rng.random() < 0.3),
        0 if kind == "free form" else int(rng.integers(3)),
    )
    for i in range(rng.integers(3, 8)):
        own = kind if i < 3 or rng.random() < 0.7 or part.is_free_form else "pins"
        with suppress(UnsuitedPartError):
            part = part.add(place_feature(rng, part, draw_feature(rng, part, own)))
    if len(part.features) < 3:
        raise UnsuitedPartError("room for fewer than three features")
    return part


def draw_feature(rng: np.random.Generator, part: Part, kind: PartKind) -> PartFeature:
    """A feature of a kind at no place yet."""
    uniform = rng.uniform
    if kind == "steps":
        kind = "holes" if rng.random() < 0.5 else "pins"
    depth = -np.inf if rng.random() < 0.5 else -uniform(0.3, 0.6) * part.thickness / part.size
    options: dict[str, tuple[bool, Floats, float]] = {
        "pins": (rng.random() < 0.5, uniform(0.025, 0.08, 2), uniform(0.03, 0.12)),
        "holes": (True, uniform(0.02, 0.07, 2), depth),
        "slots": (False, uniform((0.05, 0.015), (0.12, 0.035)), depth),
        "ribs": (False, uniform((0.08, 0.006), (0.18, 0.015)), uniform(0.04, 0.12)),
        "free form": (False, uniform(0.06, 0.16, 2), uniform(-0.06, 0.08)),
    }
    is_round, (a, b), height = options[kind]
    half = part.size * a, part.size * (a if is_round else b)
    return PartFeature((0.0, 0.0), half, uniform(0, np.pi), part.size * height, is_round)


def place_feature(rng: np.random.Generator, part: Part, feature: PartFeature) -> PartFeature:
    """The feature at a place that has room for it, shortened if need be. Raises UnsuitedPartError
    where none has."""
    gap = GAP * part.size
    for _ in range(40):
        a, b = feature.half
        margin = gap if part.is_free_form else feature.radius + gap
        i = rng.integers(len(part.levels))
        low = np.array([part.edges[i], -part.half_width]) + margin
        high = np.array([part.edges[i + 1], part.half_width]) - margin
        if (low <= high).all():
            x, y = rng.uniform(low, high)
            room = [np.hypot(x - f.centre[0], y - f.centre[1]) - f.radius for f in part.features]
            if part.is_free_form or min(room, default=np.inf) > feature.radius + 2 * gap:
                return replace(feature, centre=(x, y))
        feature = replace(feature, half=(a * SHRINK if a >= b else a, b * SHRINK if b >= a else b))
    raise UnsuitedPartError("no room")


Change = Callable[[float], tuple[Part, Part]]
"""From an amount, mm, to the nominal and the true part."""


def draw_change(rng: np.random.Generator, part: Part, kind: PartKind, fault: LocalFault) -> Change:
    """A local fault of the part. Raises UnsuitedPartError where the part has no feature for it."""
    if fault not in ("length", "moved", "width", "turned", "revision"):
        added = _draw_added(rng, part, kind, fault)

        def add(amount: float) -> tuple[Part, Part]:
            other = part.add(replace(added, height=added.height * amount))
            return (other, part) if fault == "missing" else (part, other)

        return add
    count = int(rng.integers(2, 4)) if fault == "revision" else 1
    chosen = rng.permutation(len(part.features))[:count]
    if fault == "turned" and not part.is_free_form:
        # few parts have a slim feature of their own
        slim = draw_feature(rng, part, "ribs" if kind == "ribs" else "slots")
        part, chosen = part.add(place_feature(rng, part, slim)), np.array([len(part.features)])
    weights, steps = (1.0, *rng.uniform(0.3, 0.9, count - 1)), []
    for weight, i in zip(weights, chosen, strict=True):
        own = str(rng.choice(["length", "moved", "width"])) if fault == "revision" else fault
        steps.append((i, own, weight * rng.choice([-1, 1]), rng.uniform(0, 2 * np.pi)))

    def change(amount: float) -> tuple[Part, Part]:
        changed = list(part.features)
        for i, own, weight, way in steps:
            changed[i] = _change_feature(changed[i], own, weight * amount, way)
        return part, replace(part, features=tuple(changed))

    return change


def _change_feature(feature: PartFeature, fault: str, amount: float, way: float) -> PartFeature:
    """The feature changed by an amount, mm; ``way``: direction of a shift, radians."""
    (x, y), (a, b), height = feature.centre, feature.half, feature.height
    is_slim = not feature.is_round and max(a, b) > 1.5 * min(a, b)
    if (fault == "length" and np.isinf(height)) or (fault == "turned" and not is_slim):
        raise UnsuitedPartError("the feature has no such size")
    if amount < -0.9 * min(a, b, abs(height)):
        raise UnsuitedPartError("nothing of the feature remains")
    if fault == "length":
        return replace(feature, height=height + np.sign(height) * amount)
    if fault == "moved":
        return replace(feature, centre=(x + amount * np.cos(way), y + amount * np.sin(way)))
    if fault == "turned":
        return replace(feature, angle=feature.angle + amount / feature.radius)
    return replace(feature, half=(a + amount, b + amount * feature.is_round))


def _draw_added(
    rng: np.random.Generator, part: Part, kind: PartKind, fault: LocalFault
) -> PartFeature:
    """A feature of the height 1 or -1: one that is missing or too many, a burr along the part's
    edge, dirt on it, or a dent in it."""
    if fault == "burr" and not part.is_free_form:
        i = rng.integers(len(part.levels))
        start, end = part.edges[i : i + 2]
        length, width = (
            rng.uniform(0.1, 0.3) * (end - start),
            rng.uniform(0.1, 0.3) * GAP * part.size,
        )
        x = rng.uniform(start + 1.1 * length, end - 1.1 * length)
        return PartFeature(
            (x, rng.choice([-1, 1]) * (part.half_width - 1.1 * width)), (length, width), 0, 1
        )
    feature = draw_feature(rng, part, kind)
    if fault in ("burr", "dirt", "dent"):
        radius = part.size * rng.uniform(0.02, 0.04)
        feature = PartFeature((0, 0), (radius, radius), 0, -1 if fault == "dent" else 1, True, True)
    return place_feature(rng, part, replace(feature, height=np.sign(feature.height)))


def solve_part_change(change: Change, size_mm: float) -> tuple[Part, Part]:
    """The nominal and the true part that are ``size_mm`` apart. Raises UnsuitedPartError where no
    amount of the change does it."""
    amount = size_mm
    for _ in range(4):
        nominal, true = change(amount)
        coarse = [replace(part, splits=0).build() for part in (nominal, true)]
        share = measure_largest_distance(coarse[0], coarse[1]) / size_mm
        if abs(share - 1) < MAX_SIZE_ERROR:
            return nominal, true
        amount /= share
    raise UnsuitedPartError("the fault cannot be so large")


def measure_largest_distance(mesh: trimesh.Trimesh, other: trimesh.Trimesh, seed: int = 0) -> float:
    """The largest distance of the surface of one mesh from the other's, of both ways, mm."""
    rng, one, two = np.random.default_rng(seed), PartSurface(mesh), PartSurface(other)
    return max(float(a.closest(b.cover(rng))[1].max()) for a, b in ((one, two), (two, one)))


class PartSurface:
    """A mesh, distances from it, mm, and rays cast at it."""

    def __init__(self, mesh: trimesh.Trimesh):
        self.mesh = mesh
        self._scene = raycasting_scene(mesh.vertices, mesh.faces)

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """The closest point (n, 3) of the mesh to each, and its distance (n,)."""
        feet = self._scene.compute_closest_points(_tensor(points))["points"].numpy()
        return feet.astype(np.float64), lengths(points - feet)

    def contains(self, points: Floats) -> Mask:
        """Whether points (n, 3) lie inside the closed mesh, (n,) bool."""
        return self._scene.compute_occupancy(_tensor(points), nsamples=3).numpy() > 0.5

    def sample(self, rng: np.random.Generator, count: int) -> tuple[Floats, np.ndarray]:
        """Points (n, 3) evenly over the area, and the face (n,) of each."""
        seed = int(rng.integers(2**31))
        points, face = trimesh.sample.sample_surface(self.mesh, count, seed=seed)
        return np.asarray(points), np.asarray(face)

    def cover(self, rng: np.random.Generator) -> Floats:
        """Points (n, 3) all over the surface, the vertices among them."""
        return np.concatenate([self.mesh.vertices, self.sample(rng, COVER)[0]])

    def is_hidden(self, points: Floats, towards: Floats) -> Mask:
        """Whether the mesh is between each point (n, 3) and the places ``towards`` (n or 1, 3)."""
        rays = _tensor(np.concatenate([points, towards - points], 1))
        return self._scene.test_occlusions(rays, 0.0, 1.0).numpy()

    def cast(self, origin: Floats, directions: Floats) -> tuple[Floats, np.ndarray]:
        """Where rays (n, 3) from an origin first meet the mesh (k, 3), and which faces (k,)."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], 1)
        cast = self._scene.cast_rays(_tensor(rays))
        far, face = cast["t_hit"].numpy(), cast["primitive_ids"].numpy()
        met = np.isfinite(far)
        return origin + far[met, None] * directions[met], face[met].astype(np.int64)


def _tensor(values: Floats) -> Any:
    """Open3D's array of single precision."""
    return open3d().core.Tensor(values.astype(np.float32))
