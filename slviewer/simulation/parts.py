"""Nominal parts, wrong parts and scans of both, with the truth: which places deviate, by how much.

Parts are plates with features (bosses, pockets, ribs, steps) of flat faces, or free forms. All is
drawn at random from a seed, in proportion to the part. Nothing here is shared with the inspection.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slviewer.geometry.rigid import Floats, Mask
from slviewer.geometry.vectors import diagonal, lengths, unit_vectors
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.surface.shapes import Mesh

PartKind = Literal["pins", "holes", "slots", "steps", "ribs", "free form"]
LocalFault = Literal[
    "length", "missing", "extra", "moved", "width", "turned", "revision", "burr", "dirt", "dent"
]
GlobalFault = Literal["bent", "twisted", "scaled", "shrunk"]

TRUTH_SAMPLES = 12_000
MAX_SIZE_ERROR = 0.02


class UnsuitedPartError(ValueError):
    """The part has no feature, or no room, for the requested fault: draw another one."""


@dataclass(frozen=True)
class Feature:
    """A boss, or with negative ``height`` a pocket (-inf: a through hole), mm.

    ``half``: half its widths. ``is_dome``: it rises smoothly, like dirt or a dent. A feature of a
    free form is a Gaussian hill with the standard deviations ``half``.
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

    def outline(self, share: float = 1.0) -> Floats:
        """The corners (k, 2) mm, counter-clockwise; of a ``share`` of its size."""
        turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        corners = np.stack([np.cos(turn), np.sin(turn)], 1)
        if not self.is_round:
            corners = np.array([(-1.0, -1), (1, -1), (1, 1), (-1, 1)])
        return share * corners * self.half @ _turn_plane(self.angle).T + self.centre


def _turn_plane(angle: float) -> Floats:
    """The rotation (2, 2) by an angle in radians."""
    return np.array([(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))])


@dataclass(frozen=True)
class Part:
    """A plate below z = 0 of a ``thickness``, whose top rises in strips between the ``edges`` (k +
    1) along x to the ``levels`` (k), mm.

    ``is_open``: its mesh is the top alone. ``max_edge``: triangles are split to it.
    """

    edges: tuple[float, ...]
    levels: tuple[float, ...]
    half_width: float
    thickness: float
    features: tuple[Feature, ...]
    is_free_form: bool = False
    is_open: bool = False
    max_edge: float = np.inf

    @property
    def size(self) -> float:
        """Length of the plate's diagonal, mm."""
        return float(np.hypot(2 * self.edges[-1], 2 * self.half_width))

    def level_at(self, x: float) -> float:
        """Height of the strip at ``x`` mm."""
        return self.levels[int(np.searchsorted(self.edges[1:-1], x))]

    def is_apart(self) -> bool:
        """Whether the circles around its features neither meet nor cross a strip's edges."""
        centres = np.array([f.centre for f in self.features])
        radii = np.array([f.radius for f in self.features])
        room = lengths(centres[:, None] - centres) - radii[:, None] - radii
        np.fill_diagonal(room, 1)
        x = np.abs(centres[:, :1] - self.edges).min(axis=1)
        y = self.half_width - np.abs(centres[:, 1])
        return bool((room > 0).all() and (np.minimum(x, y) > radii).all())

    def build(self) -> Mesh:
        """Its mesh, watertight unless it is open."""
        mesh = _weld(np.concatenate(self._hills() if self.is_free_form else self._faces()))
        return mesh if np.isinf(self.max_edge) else split_long_edges(mesh, self.max_edge)

    def _faces(self) -> list[Floats]:
        """Triangles (m, 3, 3) of each flat face."""
        x, w, bottom = self.edges, self.half_width, -self.thickness
        faces: list[Floats] = []
        for i, z in enumerate(self.levels):
            own = [f for f in self.features if x[i] < f.centre[0] < x[i + 1]]
            faces.append(_flat_face([_box(x[i : i + 2], (-w, w)), *(f.outline() for f in own)], z))
            for feature in own:
                faces += _feature_faces(feature, z, bottom)
            if i and z != self.levels[i - 1]:
                wall = [_box((-w, w), sorted((self.levels[i - 1], z)))]
                sign = 1 if z < self.levels[i - 1] else -1
                faces.append(_flat_face(wall, x[i], (1, 2, 0), sign))
        if self.is_open:
            return faces
        holes = [f.outline() for f in self.features if np.isinf(f.height)]
        faces.append(_flat_face([_box((x[0], x[-1]), (-w, w)), *holes], bottom, sign=-1))
        tops = [(e, z) for i, z in enumerate(self.levels) for e in x[i : i + 2]]
        profile = np.array([(x[-1], bottom), *tops[::-1], (x[0], bottom)])
        for sign in (-1, 1):
            faces.append(_flat_face([profile], sign * w, (0, 2, 1), sign))
            end = _box((-w, w), (bottom, self.levels[0 if sign < 0 else -1]))
            faces.append(_flat_face([end], x[0 if sign < 0 else -1], (1, 2, 0), sign))
        return faces

    def _hills(self) -> list[Floats]:
        """Triangles (m, 3, 3) of the relief, and of the base below it."""
        step = self.size / 70
        x, y = (
            np.linspace(-h, h, round(2 * h / step))
            for h in (float(self.edges[-1]), self.half_width)
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
        rims = [(slice(None), 0), (-1, slice(None)), (slice(None, None, -1), -1)]
        rims.append((0, slice(None, None, -1)))
        walls = [_grid_face(np.stack([base[rim], top[rim]], 1)) for rim in rims]
        return [_grid_face(top), _grid_face(base)[:, ::-1], *walls]


def _box(x: Sequence[float], y: Sequence[float]) -> Floats:
    """The corners (4, 2) of a rectangle."""
    return np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _grid_face(grid: Floats) -> Floats:
    """Triangles (m, 3, 3) between points (h, w, 3)."""
    a, b, c, d = (
        each.reshape(-1, 3) for each in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:])
    )
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _flat_face(
    rings: Sequence[Floats], offset: float, axes: Sequence[int] = (0, 1, 2), sign: int = 1
) -> Floats:
    """Triangles (m, 3, 3) of a polygon: an outer ring and rings of holes (k, 2), in two of the
    ``axes``, at an ``offset`` along the third, which the ``sign`` says to face."""
    from mapbox_earcut import triangulate_float64

    flat = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    points = np.empty((len(flat), 3))
    points[:, axes[:2]], points[:, axes[2]] = flat, offset
    corners = points[triangulate_float64(flat, ends).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = sign * normals[:, axes[2]] < 0
    corners[turned] = corners[turned][:, ::-1]
    return corners


def _feature_faces(feature: Feature, level: float, bottom: float) -> list[Floats]:
    """Triangles (m, 3, 3) of the faces of a feature that stands on a level."""

    def ring(share: float, z: float) -> Floats:
        corners = feature.outline(share)
        return np.column_stack([corners, np.full(len(corners), z)])

    if feature.is_dome:
        shares = np.linspace(1, 0, 7)
        rings = [ring(s, level + feature.height * np.cos(np.pi / 2 * s) ** 2) for s in shares]
        return [_grid_face(np.stack([*each, each[0]])) for each in [np.stack(rings, 1)]]
    end = max(bottom, level + feature.height)
    wall = np.stack([ring(1, level), ring(1, end)], 1)
    faces = [_grid_face(np.stack([*wall, wall[0]]))]
    return faces if np.isinf(feature.height) else [*faces, _flat_face([feature.outline()], end)]


def _weld(corners: Floats) -> Mesh:
    """Mesh of triangles (m, 3, 3) whose equal corners are joined; those without area vanish."""
    points = corners.reshape(-1, 3)
    keys = np.round(points / (1e-7 * diagonal(points))).astype(np.int64)
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = which.reshape(-1, 3)
    used = (faces != np.roll(faces, 1, 1)).all(axis=1)
    return Mesh(points[first], faces[used])


def split_long_edges(mesh: Mesh, longest: float) -> Mesh:
    """Return the same surface with no edge longer than ``longest`` mm; it stays watertight."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    while True:
        pairs = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
        edges, which = np.unique(pairs, axis=0, return_inverse=True)
        ends = vertices[edges]
        is_long = lengths(ends[:, 1] - ends[:, 0]) > longest
        if not is_long.any():
            return Mesh(vertices, faces)
        number = np.where(is_long, len(vertices) + np.cumsum(is_long) - 1, -1)
        vertices = np.concatenate([vertices, ends[is_long].mean(axis=1)])
        middles = number[which.reshape(-1, 3)]
        split, count = middles >= 0, (middles >= 0).sum(axis=1)
        # turn each triangle so that its first edge is split, and of two edges the first two
        first = np.where(count == 1, split.argmax(1), np.where(count == 2, 1 + split.argmin(1), 0))
        order = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (ab, bc, ca) = (
            np.take_along_axis(each, order, 1).T for each in (faces, middles)
        )
        patterns = {
            0: [(a, b, c)],
            1: [(a, ab, c), (ab, b, c)],
            2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
            3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
        }
        faces = np.concatenate(
            [np.stack(each, 1)[count == n] for n, parts in patterns.items() for each in parts]
        )


def draw_part(rng: np.random.Generator, kind: PartKind) -> Part:
    """A part of a kind, 8 to 400 mm across, with 3 to 7 features of different sizes."""
    size = np.exp(rng.uniform(np.log(8), np.log(400)))
    half_length = size / 2 / np.hypot(1, ratio := rng.uniform(0.45, 0.85))
    edges, levels = [-half_length, half_length], [0.0]
    if kind == "steps":
        middles = half_length * np.sort(rng.uniform(-0.5, 0.5, rng.integers(1, 3)))
        edges[1:1] = middles
        levels = list(size * np.cumsum([0.0, *rng.uniform(0.02, 0.05, len(middles))]))
        levels = levels[:: rng.choice([1, -1])]
    max_edge = rng.choice([np.inf, np.inf, size / rng.uniform(15, 40)])
    part = Part(
        tuple(edges),
        tuple(levels),
        ratio * half_length,
        size * rng.uniform(0.05, 0.12),
        (),
        kind == "free form",
        bool(rng.random() < 0.3),
        float(max_edge),
    )
    for _ in range(count := int(rng.integers(3, 8))):
        part = add_feature(rng, part, kind if rng.random() < 0.75 or count < 4 else "pins")
    return part


def add_feature(
    rng: np.random.Generator, part: Part, kind: PartKind, height: float | None = None
) -> Part:
    """The part with one more feature of a kind, where it has room; else the part."""
    uniform, size = rng.uniform, part.size
    if kind == "steps":
        kind = rng.choice(["pins", "holes"])
    through = -np.inf if rng.random() < 0.5 else -uniform(0.3, 0.6) * part.thickness
    is_round, half, own = {
        "pins": (rng.random() < 0.5, uniform(0.025, 0.08, 2), size * uniform(0.03, 0.12)),
        "holes": (True, uniform(0.02, 0.07, 2), through),
        "slots": (False, (uniform(0.05, 0.12), uniform(0.015, 0.035)), through),
        "ribs": (False, (uniform(0.08, 0.18), uniform(0.006, 0.015)), size * uniform(0.04, 0.12)),
        "free form": (False, uniform(0.06, 0.16, 2), size * uniform(-0.06, 0.08)),
    }[kind]
    if is_round:
        half = (half[0], half[0])
    first = Feature(
        (0.0, 0.0),
        (float(size * half[0]), float(size * half[1])),
        float(uniform(0, np.pi)),
        float(own if height is None else height),
        bool(is_round),
    )
    return place_feature(rng, part, first)


def place_feature(rng: np.random.Generator, part: Part, feature: Feature) -> Part:
    """The part with a feature at a place that has room for it; else the part."""
    gap = 0.015 * part.size
    for _ in range(30):
        i = rng.integers(len(part.levels))
        margin = (feature.radius if not part.is_free_form else feature.radius / 2) + gap
        room = np.array([(part.edges[i], part.edges[i + 1]), (-part.half_width, part.half_width)])
        low, high = room[:, 0] + margin, room[:, 1] - margin
        if (low >= high).any():
            continue
        x, y = map(float, rng.uniform(low, high))
        others = [np.hypot(x - f.centre[0], y - f.centre[1]) - f.radius for f in part.features]
        if part.is_free_form or min(others, default=np.inf) > feature.radius + gap:
            placed = replace(feature, centre=(x, y))
            return replace(part, features=(*part.features, placed))
    return part


def measure_size(part: Mesh, other: Mesh, seed: int = 0) -> float:
    """The largest distance of the surface of one mesh from the other's, of both ways, mm."""
    rng, both = np.random.default_rng(seed), (Distances(part), Distances(other))
    return max(float(onto.closest(one.cover(rng))[1].max()) for one, onto in (both, both[::-1]))


def solve_change(change: "Change", size_mm: float) -> tuple[Part, Part]:
    """The nominal and the true part that are ``size_mm`` apart. Raises UnsuitedPartError where no
    amount of the change does it."""
    amount = size_mm
    for _ in range(4):
        nominal, true = change(amount)
        coarse = (replace(part, max_edge=np.inf).build() for part in (nominal, true))
        share = measure_size(*coarse) / size_mm
        if abs(share - 1) < MAX_SIZE_ERROR:
            return nominal, true
        amount /= share
    raise UnsuitedPartError("the fault cannot be so large")


Change = Callable[[float], tuple[Part, Part]]
"""From an amount, mm, to the nominal and the true part."""


def draw_change(rng: np.random.Generator, part: Part, kind: PartKind, fault: LocalFault) -> Change:
    """A local fault of the part. Raises UnsuitedPartError where the part has no feature for it."""
    features = part.features
    if fault in ("burr", "dirt", "dent"):
        return _draw_blemish(rng, part, fault)
    if fault == "extra":
        sign = 1 if rng.random() < 0.6 or kind in ("pins", "ribs") else -1
        added = add_feature(rng, part, kind, sign).features[len(features) :]
        if not added:
            raise UnsuitedPartError("no room")
        return lambda d: (
            part,
            replace(part, features=(*features, replace(added[0], height=sign * d))),
        )
    suited = [
        i
        for i, f in enumerate(features)
        if not (fault in ("length", "missing") and np.isinf(f.height))
        and not (fault == "turned" and (f.is_round or max(f.half) < 1.5 * min(f.half)))
    ]
    if not suited:
        raise UnsuitedPartError("no feature suits")
    count = min(len(suited), int(rng.integers(2, 5))) if fault == "revision" else 1
    chosen = rng.permutation(suited)[:count]
    if fault == "missing":
        sign = np.sign(features[i := int(chosen[0])].height)
        others = features[:i] + features[i + 1 :]
        low = lambda d: replace(features[i], height=float(sign * d))  # noqa: E731
        return lambda d: (
            replace(part, features=(*others, low(d))),
            replace(part, features=others),
        )
    steps = []
    for i, weight in zip(chosen, (1.0, *rng.uniform(0.3, 0.9, count - 1)), strict=True):
        own: str = fault
        if fault == "revision":
            own = str(
                rng.choice(["moved", "width"] + ["length"] * bool(np.isfinite(features[i].height)))
            )
        steps.append((int(i), weight, own, int(rng.choice([-1, 1])), rng.uniform(0, 2 * np.pi)))

    def change(amount: float) -> tuple[Part, Part]:
        changed = list(features)
        for i, weight, own, sign, way in steps:
            changed[i] = _change_feature(features[i], own, sign * weight * amount, way)
        true = replace(part, features=tuple(changed))
        if not (part.is_free_form or true.is_apart()):
            raise UnsuitedPartError("features meet")
        return part, true

    return change


def _change_feature(feature: Feature, fault: str, amount: float, way: float) -> Feature:
    """The feature changed by an amount, mm; ``way``: direction of a shift, radians."""
    (x, y), (a, b) = feature.centre, feature.half
    if amount < -0.9 * (abs(feature.height) if fault == "length" else min(a, b)):
        raise UnsuitedPartError("nothing of the feature remains")
    if fault == "length":
        return replace(feature, height=feature.height + np.sign(feature.height) * amount)
    if fault == "moved":
        return replace(feature, centre=(x + amount * np.cos(way), y + amount * np.sin(way)))
    if fault == "turned":
        return replace(feature, angle=feature.angle + amount / feature.radius)
    is_second = feature.is_round or way > np.pi
    half = (a + amount * (feature.is_round or not is_second), b + amount * is_second)
    return replace(feature, half=half)


def _draw_blemish(rng: np.random.Generator, part: Part, fault: LocalFault) -> Change:
    """A burr along the part's edge, dirt on it, or a dent in it."""
    radius, sign = part.size * rng.uniform(0.02, 0.04), -1 if fault == "dent" else 1
    first = Feature((0.0, 0.0), (radius, radius), 0.0, 1.0, True, is_dome=True)
    if fault == "burr" and not part.is_free_form:
        half = (part.size * rng.uniform(0.04, 0.1), part.size * rng.uniform(0.003, 0.006))
        i = int(rng.integers(len(part.levels)))
        half = (min(half[0], 0.4 * (part.edges[i + 1] - part.edges[i])), half[1])
        room = part.edges[i] + 1.1 * half[0], part.edges[i + 1] - 1.1 * half[0]
        y = float(rng.choice([-1, 1])) * (part.half_width - 1.1 * half[1])
        added = [Feature((float(rng.uniform(*room)), y), half, 0.0, 1.0)]
    else:
        added = list(place_feature(rng, part, first).features[len(part.features) :])
        if not added:
            raise UnsuitedPartError("no room")
    return lambda d: (
        part,
        replace(part, features=(*part.features, replace(added[0], height=sign * d))),
    )


class Distances:
    """Distances of points from a mesh, mm, and rays cast at it."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        self.areas, self.normals = lengths(across) / 2, unit_vectors(across)
        self._scene = raycasting_scene(mesh.vertices, mesh.faces)

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """The closest point (n, 3) of the mesh to each, and its distance (n,)."""
        query = open3d().core.Tensor(points.astype(np.float32))
        feet = self._scene.compute_closest_points(query)["points"].numpy().astype(np.float64)
        return feet, lengths(points - feet)

    def contain(self, points: Floats) -> Mask:
        """Whether points (n, 3) lie inside the closed mesh, (n,) bool."""
        query = open3d().core.Tensor(points.astype(np.float32))
        return self._scene.compute_occupancy(query, nsamples=3).numpy() > 0.5

    def sample(self, rng: np.random.Generator, count: int) -> tuple[Floats, np.ndarray]:
        """Points (n, 3) evenly over the area, and the face (n,) of each."""
        face = rng.choice(len(self.areas), count, p=self.areas / self.areas.sum())
        s, t = rng.random((2, count, 1))
        s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
        a, b, c = self.mesh.vertices[self.mesh.faces[face]].astype(np.float64).swapaxes(0, 1)
        return a + s * (b - a) + t * (c - a), face

    def cover(self, rng: np.random.Generator) -> Floats:
        """Points (n, 3) all over the surface, the vertices among them."""
        sampled, _ = self.sample(rng, TRUTH_SAMPLES)
        return np.concatenate([self.mesh.vertices.astype(np.float64), sampled])

    def is_hidden(self, points: Floats, towards: Floats) -> Mask:
        """Whether the mesh is between each point (n, 3) and the place ``towards`` (3,) mm."""
        rays = np.concatenate([points, towards - points], 1).astype(np.float32)
        return self._scene.test_occlusions(open3d().core.Tensor(rays), 0.0, 1.0).numpy()

    def cast(self, origin: Floats, directions: Floats) -> tuple[Floats, np.ndarray]:
        """Where rays (n, 3) from an origin first hit the mesh (k, 3), and which faces (k,)."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], 1)
        hit = self._scene.cast_rays(open3d().core.Tensor(rays.astype(np.float32)))
        far, face = hit["t_hit"].numpy().astype(np.float64), hit["primitive_ids"].numpy()
        met = np.isfinite(far)
        return origin + far[met, None] * directions[met], face[met].astype(np.int64)
