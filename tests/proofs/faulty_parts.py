"""Parts of planes, cylinders and a sphere with one fault each, and what each characteristic of
their inspection plan truly is: by least squares and zones of dense points without noise, by code of
its own."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

Array = np.ndarray
Rng = np.random.Generator
ShapeKind = Literal["plane", "cylinder", "sphere"]
ANGLES = 192
"""Segments of circles in the nominal mesh."""
INSIDE = 0.9
"""Share of a face along each direction that its region shows."""
DENSE = 41
"""Places along each direction of a feature, at which its truth is evaluated."""
FAULTS: Mapping[ShapeKind, tuple[str, ...]] = {
    "plane": ("none", "moved", "tilted", "bent", "dent", "burr", "missing", "shrunk"),
    "cylinder": (
        *("none", "moved", "diameter", "tilted", "oval", "bent", "flat"),
        *("dent", "burr", "missing", "shrunk"),
    ),
    "sphere": ("none", "moved", "diameter", "oval", "dent", "burr", "missing", "shrunk"),
}
"""Of each kind of feature."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A surface of a part about ``origin`` (3,) mm, over coordinates u and v in -1 to 1.

    A plane spans ``size`` (half sides) along the first ``axes`` (3, 3); a cylinder has ``size``
    (radius, half length) about the third; a sphere is the half of radius ``size[0]`` above. A ring
    lies between a square of half side ``-size[0]`` and one of ``size[1]``, which are circles where
    ``size`` has the other sign. ``side``: -1 where material is outside, as around a hole.
    """

    name: str
    kind: Literal["plane", "cylinder", "sphere", "ring"]
    origin: Array
    size: tuple[float, float]
    axes: Array = field(default_factory=lambda: np.eye(3))
    side: float = 1.0

    @property
    def area(self) -> float:
        """Area in mm²."""
        a, b = self.size
        return float(
            {
                "plane": 4 * a * b,
                "cylinder": 4 * np.pi * a * b,
                "sphere": 2 * np.pi * a * a,
                "ring": (4 if b > 0 else np.pi) * b * b - (np.pi if a > 0 else 4) * a * a,
            }[self.kind]
        )

    def points(self, uv: Array) -> tuple[Array, Array]:
        """Places (n, 3) and directions (n, 3) along which distances from the shape grow."""
        a, b = self.size
        u, v = uv.T
        c, s, zero = np.cos(np.pi * u), np.sin(np.pi * u), 0 * u
        if self.kind == "cylinder":
            local, normals = np.stack([a * c, a * s, b * v], 1), np.stack([c, s, zero], 1)
        elif self.kind == "sphere":
            z = (1 + v) / 2
            q = np.sqrt(1 - z * z)
            normals = np.stack([q * c, q * s, z], 1)
            local = a * normals
        else:
            normals = np.tile([0.0, 0.0, 1.0], (len(u), 1))
            local = np.stack([a * u, b * v, zero], 1)
            if self.kind == "ring":
                square = 1 / np.maximum(np.abs(c), np.abs(s))
                inner, outer = (
                    abs(a) * np.where(a < 0, square, 1),
                    abs(b) * np.where(b > 0, square, 1),
                )
                r = (1 - v) / 2 * inner + (1 + v) / 2 * outer
                local = np.stack([r * c, r * s, zero], 1)
        return local @ self.axes + self.origin, normals @ self.axes

    def draw(self, count: int, rng: Rng) -> Array:
        """Coordinates (count, 2), about evenly over the area."""
        uv = rng.uniform(-1, 1, (count, 2))
        if self.kind == "ring":
            a, b = np.abs(self.size)
            uv[:, 1] = (
                2 * (np.sqrt(a * a + (b * b - a * a) * rng.uniform(size=count)) - a) / (b - a) - 1
            )
        return uv

    def mesh(self) -> tuple[Array, Array]:
        """Vertices (n, 3) and triangles (m, 3) that face outside."""
        rows = {"plane": 2, "ring": 2, "cylinder": 2, "sphere": 64}[self.kind]
        columns = 2 if self.kind == "plane" else ANGLES + 1
        u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
        vertices, normals = self.points(np.stack([u, v], -1).reshape(-1, 2))
        at = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        corners = vertices[faces]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        wrong = np.sum(facing * normals[faces[:, 0]], 1) * self.side < 0
        faces[wrong] = faces[wrong, ::-1]
        return vertices, faces[np.linalg.norm(facing, axis=1) > 0]


@dataclass(frozen=True, eq=False)
class PartFault:
    """A fault of one ``feature``: ``kind``, its size in ``tolerances`` and mm, and where it is:
    ``centre`` (u, v) and ``radius`` mm of what is local, ``direction`` (3,) of what is moved."""

    feature: str
    kind: str
    tolerances: float
    mm: float
    centre: Array
    radius: float
    direction: Array

    def displace(self, patch: Patch, uv: Array, places: Array) -> Array:
        """Distances (n,) mm by which a patch's places (n, 3) lie off it along their normals."""
        (u, v), e, a = uv.T, self.mm, self.centre[0]
        c = np.cos(np.pi * (u - a))
        if self.kind == "diameter":
            return np.full(len(u), e / 2)
        if self.kind == "oval":
            return e / 2 * np.cos(2 * np.pi * (u - a)) * (1 if patch.kind != "sphere" else 1 - v**2)
        if self.kind == "tilted":
            return e / 2 * (u if patch.kind == "plane" else v * c)
        if self.kind == "bent":
            return e * u**2 if patch.kind == "plane" else e * (v**2 - 1 / 3) * c
        if self.kind == "flat":
            R = patch.size[0]
            return -patch.side * np.maximum(R - (R - abs(e)) / np.maximum(c, 0.1), 0.0)
        if self.kind in ("dent", "burr"):
            away = np.linalg.norm(places - patch.points(self.centre[None])[0], axis=1)
            sign = patch.side * (1 if self.kind == "burr" else -1)
            return sign * abs(e) * np.cos(np.pi / 2 * np.minimum(away / self.radius, 1.0)) ** 2
        return np.zeros(len(u))


@dataclass(frozen=True, eq=False)
class FaultyPart:
    """A part of ``patches`` with a ``fault``; ``size_mm`` across, ``tolerance_mm``."""

    patches: Mapping[str, Patch]
    replaced: Mapping[str, Patch]
    fault: PartFault
    size_mm: float
    tolerance_mm: float

    def true_points(self, name: str, uv: Array) -> tuple[Array, Array]:
        """Places (n, 3) of the real surface of a patch, and its normals to the outside."""
        patch, fault = self.patches[name], self.fault
        if fault.kind == "missing" and name == fault.feature:
            patch = self.replaced.get(name, patch)
            places, normals = patch.points(uv)
            return places, normals * patch.side
        places, normals = patch.points(uv)
        if name == fault.feature:
            places = places + fault.displace(patch, uv, places)[:, None] * normals
            if fault.kind == "moved":
                places = places + fault.mm * fault.direction
        if fault.kind == "shrunk":
            places = places * (1 - fault.mm / self.size_mm)
        return places, normals * patch.side

    def dense(self, name: str, seen: Callable[[Array, Array], Array] | None = None) -> Array:
        """Places (n, 3) evenly over the region of a feature, those ``seen`` alone."""
        v = INSIDE * np.linspace(-1, 1, DENSE)
        u = v if self.patches[name].kind == "plane" else np.arange(2 * DENSE) / DENSE - 1
        if self.patches[name].kind == "sphere":
            v = np.linspace(-0.8, 1, DENSE)
        uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
        if self.fault.kind in ("dent", "burr") and self.fault.feature == name:
            uv = np.vstack([uv, self.fault.centre])
        places, normals = self.true_points(name, uv)
        return places if seen is None else places[seen(places, normals)]


def draw_planned_part(rng: Rng, points: int) -> FaultyPart:
    """Draw a plate with a block, a pin, a hole and a dome in six tiles, and a fault. ``points``:
    of its cloud."""
    S = float(np.exp(rng.uniform(np.log(10), np.log(400))))
    t, T, H = float(S * np.exp(rng.uniform(np.log(1e-3), np.log(3e-3)))), S / 6, S / 6
    r, h, R = (float(x) * T for x in rng.uniform([0.5, 0.5, 0.5], [0.62, 0.7, 0.62]))
    tiles = [np.array([x, y, 0.0]) for x in (-2 * T, 0.0, 2 * T) for y in (-T, T)]
    order = rng.permutation(6)
    shown = ("base", "plain", "block", "pin", "hole", "dome")
    where = {name: tiles[k] for name, k in zip(shown, order, strict=True)}
    z, x, y = np.eye(3)[[2, 0, 1]]
    up, towards_x, towards_y = np.eye(3), np.array([y, z, x]), np.array([z, x, y])
    made = [
        Patch("base", "plane", where["base"], (T, T)),
        Patch("plain", "plane", where["plain"], (T, T)),
        *(Patch(f"ring {n}", "ring", where[n], (r, T)) for n in ("pin", "hole")),
        Patch("ring dome", "ring", where["dome"], (R, T)),
        Patch("ring block", "ring", where["block"], (-r, T)),
        Patch("pin", "cylinder", where["pin"] + h / 2 * z, (r, h / 2)),
        Patch("hole", "cylinder", where["hole"] - 0.4 * H * z, (r, 0.4 * H), up, -1.0),
        Patch("dome", "sphere", where["dome"], (R, R)),
        Patch("block", "plane", where["block"] + h * z, (r, r)),
        Patch("pin top", "ring", where["pin"] + h * z, (1e-9, -r)),
        Patch("hole floor", "ring", where["hole"] - 0.8 * H * z, (1e-9, -r)),
        Patch("left", "plane", -3 * T * x - H / 2 * z, (2 * T, H / 2), towards_x, -1.0),
        Patch("right", "plane", 3 * T * x - H / 2 * z, (2 * T, H / 2), towards_x),
        Patch("front", "plane", -2 * T * y - H / 2 * z, (H / 2, 3 * T), towards_y, -1.0),
        Patch("back", "plane", 2 * T * y - H / 2 * z, (H / 2, 3 * T), towards_y),
    ]
    for name, axes, n in (("x", towards_x, x), ("y", towards_y, y)):
        size = (r, h / 2) if name == "x" else (h / 2, r)
        for side in (-1.0, 1.0):
            middle = where["block"] + h / 2 * z + side * r * n
            made.append(Patch(f"wall {name} {side:g}", "plane", middle, size, axes, side))
    floor = {n: Patch(n, "ring", where[n], (1e-9, -r)) for n in ("pin", "hole")}
    floor["dome"] = Patch("dome", "ring", where["dome"], (1e-9, -R))
    floor["block"] = Patch("block", "plane", where["block"], (r, r))
    patches = {each.name: each for each in made}
    return FaultyPart(patches, floor, _draw_fault(rng, patches, t, points), S, t)


def _draw_fault(rng: Rng, patches: Mapping[str, Patch], tolerance: float, points: int) -> PartFault:
    """Draw a fault, whose local ones some thirty points show at least."""
    name = str(rng.choice(["block", "pin", "hole", "dome", "left"]))
    patch = patches[name]
    kind = str(rng.choice(FAULTS[patch.kind]))  # type: ignore[index]
    size = float(rng.choice([0.5, 1.2, 2, 5, 20])) if kind != "none" else 0.0
    if name == "left" and kind == "missing":
        kind = "moved"
    density = weigh(patch) * points / sum(weigh(each) * each.area for each in patches.values())
    direction = patch.axes[2] if patch.kind == "plane" else patch.axes[0]
    if patch.kind == "sphere":
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
    return PartFault(
        name,
        kind,
        size,
        size * tolerance * float(rng.choice([-1, 1])),
        rng.uniform(-0.7, 0.7, 2),
        float(np.sqrt(rng.uniform(40, 120) / density / np.pi)),
        direction,
    )


def weigh(patch: Patch) -> float:
    """How many times denser than elsewhere a patch is sampled."""
    return 5.0 if patch.name in ("block", "pin", "hole", "dome") else 1.0


def _distance(kind: ShapeKind, p: Array, axis: Array, points: Array) -> Array:
    """Distances (n,) of points from a shape of parameters (6,): place, tilts of ``axis``,
    radius."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    n = axis + p[3] * first + p[4] * np.cross(axis, first)
    n /= np.linalg.norm(n)
    offsets = points - p[:3]
    if kind == "plane":
        return np.asarray(offsets @ n)
    if kind == "cylinder":
        offsets = offsets - (offsets @ n)[:, None] * n
    return np.asarray(np.linalg.norm(offsets, axis=1) - p[5])


@dataclass(frozen=True, eq=False)
class TrueFeature:
    """The least-squares shape of dense ``points``: ``place`` in their middle, ``axis``, ``radius``,
    and their distances ``off`` (n,)."""

    kind: ShapeKind
    points: Array
    place: Array
    axis: Array
    radius: float
    off: Array

    def ends(self) -> Array:
        """The ends (2, 3) of its axis over the points."""
        along = (self.points - self.place) @ self.axis
        return np.asarray(self.place + np.array([[along.min()], [along.max()]]) * self.axis)


def fit_true(patch: Patch, points: Array, axis: Array) -> TrueFeature:
    """Fit the shape of a patch to points (n, 3); ``axis``: about its direction."""
    kind: ShapeKind = patch.kind  # type: ignore[assignment]
    middle = points.mean(axis=0)
    if kind == "plane":
        n = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        n = n * np.sign(n @ axis)
        return TrueFeature(kind, points, middle, n, 0.0, (points - middle) @ n)
    start = np.r_[middle if kind == "cylinder" else middle - 0.4 * patch.size[0] * axis, 0, 0]
    start = np.r_[start, patch.size[0]]
    scale = np.r_[np.ones(3), np.full(2, 1 / patch.size[0]), 1.0]
    found = least_squares(lambda p: _distance(kind, start + p * scale, axis, points), np.zeros(6))
    p = start + found.x * scale
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    n = axis + p[3] * first + p[4] * np.cross(axis, first)
    n /= np.linalg.norm(n)
    place = p[:3] + ((middle - p[:3]) @ n) * n if kind == "cylinder" else p[:3]
    return TrueFeature(kind, points, place, n, float(p[5]), found.fun)


def move_by(T: Array, points: Array) -> Array:
    """Points (n, 3) moved by T (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def true_datum_frame(features: Mapping[str, TrueFeature]) -> Array:
    """The motion (4, 4) into the frame of the datums base, left and front, as in the plan."""
    z = features["base"].axis
    x = features["left"].axis - (features["left"].axis @ z) * z
    x = x / np.linalg.norm(x)
    datums = [features[name] for name in ("base", "left", "front")]
    origin = np.linalg.solve(
        np.array([each.axis for each in datums]), [each.axis @ each.place for each in datums]
    )
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(z, x), z]
    T[:3, 3] = -T[:3, :3] @ origin
    return T


def best_fit(part: FaultyPart, names: Array, places: Array) -> Array:
    """The motion (4, 4) of least squared distances of true places (n, 3) of patches ``names`` (n,)
    from the nominal."""
    T = np.eye(4)
    for _ in range(4):
        rows, away = [], []
        for name, patch in part.patches.items():
            own = move_by(T, places[names == name])
            if not len(own):
                continue
            d, n = nominal_distance(patch, own)
            rows.append(np.hstack([np.cross(own, n), n]))
            away.append(d)
        step = -np.linalg.lstsq(np.vstack(rows), np.concatenate(away), rcond=None)[0]
        w = step[:3]
        turn = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        u, _, vt = np.linalg.svd(np.eye(3) + turn)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = u @ vt, step[3:]
        T = change @ T
    return T


def nominal_distance(patch: Patch, points: Array) -> tuple[Array, Array]:
    """Distances (n,) of points from the nominal shape of a patch, and the directions (n, 3)."""
    offsets = points - patch.origin
    n = patch.axes[2]
    if patch.kind in ("plane", "ring"):
        return offsets @ n, np.broadcast_to(n, offsets.shape)
    if patch.kind == "cylinder":
        offsets = offsets - (offsets @ n)[:, None] * n
    size = np.linalg.norm(offsets, axis=1)
    return size - patch.size[0], offsets / size[:, None]


def true_value(
    kind: str, names: tuple[str, ...], part: FaultyPart, found: Mapping[str, Any]
) -> float:
    """The true value of a characteristic of features ``found``, in part coordinates."""
    f: TrueFeature = found[names[0]]
    d: TrueFeature = found[names[-1]]
    if len(names) == 2:
        return _true_relation(kind, f, d)
    patch = part.patches[names[0]]
    if kind == "diameter":
        return 2 * f.radius
    if kind == "roundness" and f.kind == "cylinder":
        return _section_range(f)
    if kind in ("flatness", "cylindricity", "roundness"):
        return float(np.ptp(f.off))
    if kind == "profile" or f.kind == "plane":
        return 2 * float(np.abs(nominal_distance(patch, f.points)[0]).max())
    places = f.place[None] if f.kind == "sphere" else f.ends()
    offsets = places - patch.origin
    if f.kind == "cylinder":
        offsets = offsets - (offsets @ patch.axes[2])[:, None] * patch.axes[2]
    return 2 * float(np.linalg.norm(offsets, axis=1).max())


def _true_relation(kind: str, f: TrueFeature, d: TrueFeature) -> float:
    """The true value of a characteristic of a feature to a datum."""
    if kind in ("parallelism", "perpendicularity") and f.kind == "cylinder":
        length = float(np.linalg.norm(np.diff(f.ends(), axis=0)))
        return length * float(np.linalg.norm(np.cross(f.axis, d.axis)))
    if kind in ("parallelism", "perpendicularity"):
        n = d.axis if kind == "parallelism" else f.axis - (f.axis @ d.axis) * d.axis
        return float(np.ptp(f.points @ (n / np.linalg.norm(n))))
    apart = d.place - f.place
    if kind == "distance":
        return 0.5 * float(abs(apart @ d.axis) + abs(apart @ f.axis))
    if kind == "angle":
        return float(np.degrees(np.arccos(min(abs(f.axis @ d.axis), 1.0))))
    if kind == "height of the centre":
        return float(apart @ f.axis)
    across = np.cross(f.axis, d.axis)
    if np.linalg.norm(across) > np.sin(np.radians(5)):
        return float(abs(apart @ across) / np.linalg.norm(across))
    # in the middle of nearly parallel ones
    return 0.5 * float(sum(np.linalg.norm(np.cross(apart, each.axis)) for each in (f, d)))


def _section_range(f: TrueFeature) -> float:
    """The largest range of the distances from the best circle of a section of a cylinder."""
    offsets = f.points - f.place
    along = offsets @ f.axis
    c = offsets - along[:, None] * f.axis
    columns = np.hstack([c / np.linalg.norm(c, axis=1, keepdims=True), np.ones((len(c), 1))])
    section = np.minimum((along - along.min()) / np.ptp(along) * 20, 19).astype(int)
    ranges = []
    for k in np.unique(section):  # a pin that stands askew has sections without points
        off, own = f.off[section == k], columns[section == k]
        ranges.append(np.ptp(off - own @ np.linalg.lstsq(own, off, rcond=None)[0]))
    return float(max(ranges))
