"""Scans of right and wrong parts, with the truth: what deviates from the nominal part, where, and
whether the scan shows it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slviewer.geometry.rigid import (
    Floats,
    Mask,
    distance_jacobian,
    move_points,
    rigid_transform,
    turn_about,
)
from slviewer.geometry.vectors import lengths, median_spacing, unit_vectors
from slviewer.simulation.parts import (
    Distances,
    GlobalFault,
    LocalFault,
    Part,
    PartKind,
    UnsuitedPartError,
    draw_change,
    draw_part,
    measure_size,
    solve_change,
)
from slviewer.surface.shapes import Mesh

Fault = Literal["none", LocalFault, GlobalFault, "mirrored"]
View = Literal["full", "one side", "three views"]
Clutter = Literal["none", "table", "clamp", "touching clamp", "spikes"]
Source = Literal["imported", "own"]

LIKELY_FAIL = 1.2
"""Tolerances, from which a part is a wrong one."""
SIZES = (0.0, 0.5, LIKELY_FAIL, 2.0, 5.0, 20.0)
MAX_ATTEMPTS = 100
MIN_COSINE = 0.2
"""Of the angle of incidence at which a camera measures."""
MIN_SEEN, MIN_EVIDENCE = 0.2, 6
"""Share of the faulty region, and points that deviate, without which a fault is not in view."""
SPACINGS = 3.0
"""Between a place and the nearest point that was measured or changed."""


@dataclass(frozen=True)
class CaseSetup:
    """What `make_case` is to make; ``size``: of the fault, in tolerances."""

    seed: int
    index: int
    kind: PartKind
    fault: Fault
    size: float
    view: View
    clutter: Clutter
    source: Source

    @property
    def expected(self) -> Literal["pass", "fail"]:
        """The true verdict."""
        return "fail" if self.size >= LIKELY_FAIL else "pass"


@dataclass(frozen=True, eq=False)
class PartCase:
    """A scan of a part against its nominal, mm.

    ``points``, ``normals`` (n, 3) in the scan's frame; ``sigma_mm`` (n,) their noise along the
    normals. ``views``: centres (2, 3) of camera and projector of each view; None if unknown.
    ``changed`` (k, 3): places in the nominal's frame, on the true or the nominal surface, where
    both differ, and ``changed_mm`` (k,) by how much, positive for too much material. ``seen``:
    share of the faulty region that has scan points; ``evidence``: number of scan points that
    deviate by more than the tolerance. ``spacing_mm`` of the points.
    """

    setup: CaseSetup
    nominal: Mesh
    points: Floats
    normals: Floats
    sigma_mm: Floats
    views: list[Floats] | None
    tolerance_mm: float
    T_nominal_scan: Floats
    changed: Floats
    changed_mm: Floats
    seen: float
    evidence: int
    spacing_mm: float

    @property
    def in_view(self) -> bool:
        """Whether the scan shows the fault."""
        return self.seen >= MIN_SEEN and self.evidence >= MIN_EVIDENCE

    def within_changed(self, place: Floats) -> Mask:
        """Which of the changed places lie within a few spacings of a place (3,) mm, (k,) bool."""
        return lengths(self.changed - place) <= SPACINGS * self.spacing_mm


def plan_cases(count: int, seed: int) -> list[CaseSetup]:
    """The setups of cases: kinds, faults, sizes, views and clutter are equally frequent."""
    rng = np.random.default_rng(seed)

    def deal(levels: Sequence) -> list:
        return [levels[i] for i in rng.permutation(count) % len(levels)]

    faults = [f for each in (LocalFault, GlobalFault) for f in get_args(each)]
    # a quarter of the parts is right
    sizes = deal([0.0, *SIZES, 0.5, *SIZES[1:], *SIZES[1:], 0.0, 0.0, 0.0])
    columns = (get_args(PartKind), [*faults, "mirrored"], get_args(View), get_args(Clutter))
    dealt = zip(*map(deal, columns), sizes, deal(range(8)), strict=True)
    setups = []
    for index, (kind, fault, view, clutter, size, eighth) in enumerate(dealt):
        # a capture of one's own has no full view
        source: Source = "own" if eighth < 3 and view != "full" else "imported"
        if size == 0:
            fault = "none"
        elif fault == "mirrored":
            size = SIZES[-1]
        setups.append(CaseSetup(seed, index, kind, fault, size, view, clutter, source))
    return setups


def make_case(setup: CaseSetup) -> PartCase:
    """A case at random, the same at each call. Redraws the part where it has no place for the
    fault."""
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.default_rng([setup.seed, setup.index, attempt])
        try:
            return _draw_case(rng, setup)
        except UnsuitedPartError:
            continue
    raise UnsuitedPartError(f"no part suits {setup}")


def _draw_case(rng: np.random.Generator, setup: CaseSetup) -> PartCase:
    """A case; raises UnsuitedPartError where the part drawn does not suit."""
    part = draw_part(rng, setup.kind)
    if len(part.features) < 3:
        raise UnsuitedPartError("too few features")
    finest = 700 if setup.size > 5 else 250
    tolerance = part.size / np.exp(rng.uniform(np.log(finest), np.log(1500)))
    is_deformed = setup.fault in get_args(GlobalFault)
    nominal = true = (
        replace(part, max_edge=min(part.max_edge, part.size / 25)) if is_deformed else part
    )
    if setup.fault in get_args(LocalFault):
        change = draw_change(rng, part, setup.kind, setup.fault)  # type: ignore[arg-type]
        nominal, true = solve_change(change, setup.size * tolerance)
    meshes = [_build(each, setup) for each in (true, replace(true, is_open=False))]
    nominal_mesh = nominal.build()
    _check_asymmetry(meshes[0], nominal_mesh, setup, 4 * tolerance)
    count = int(np.exp(rng.uniform(np.log(5000), np.log(20_000))))
    scan = scan_part(rng, meshes[0], part, setup, count)
    is_part = scan.is_part
    if is_deformed:
        field = _draw_deformation(rng, setup.fault, part)
        measured = scan.points[is_part], scan.normals[is_part]
        rank = 1 if setup.expected == "pass" else 2 * MIN_EVIDENCE
        deform = _solve_deformation(field, *measured, nominal_mesh, setup.size * tolerance, rank)
        meshes = [Mesh(deform(each.vertices.astype(np.float64)), each.faces) for each in meshes]
        scan.points[is_part] = deform(scan.points[is_part])
        scan.normals[is_part] = Distances(meshes[0]).normals[scan.face[is_part]]
    sigma = tolerance / rng.choice([3, 10])
    truth = _compare(rng, meshes, (nominal_mesh, replace(nominal, is_open=False).build()))
    spacing = median_spacing(tree := cKDTree(scan.points[is_part]), 2000)
    changed, signed, feet = truth
    faulty = np.abs(signed) > tolerance
    near = tree.query(feet[faulty])[0] < SPACINGS * spacing
    off = Distances(nominal_mesh).closest(scan.points[is_part])[1]
    largest = np.abs(signed).max(initial=0)
    is_changed = np.abs(signed) > 0.25 * largest
    if setup.fault == "none":
        is_changed[:] = False
    T_scan_nominal = _draw_pose(rng, part.size, scan.views)
    along = (scan.rays * scan.normals).sum(axis=1)
    noise = rng.normal(0, sigma, (len(along), 1))
    points, normals = scan.points + noise * scan.rays, scan.normals
    normals = unit_vectors(normals + rng.normal(0, 0.02, normals.shape))
    if setup.clutter == "spikes":
        few = rng.choice(len(points), int(len(points) * rng.uniform(0.001, 0.005)), replace=False)
        low, high = points.min(axis=0), points.max(axis=0)
        points[few] = rng.uniform(low - 0.15 * part.size, high + 0.15 * part.size, (len(few), 3))
        normals[few] = unit_vectors(rng.normal(size=(len(few), 3)))
    return PartCase(
        setup,
        nominal_mesh,
        move_points(T_scan_nominal, points),
        normals @ T_scan_nominal[:3, :3].T,
        sigma * np.abs(along),
        [move_points(T_scan_nominal, v) for v in scan.views] if setup.source == "own" else None,
        float(tolerance),
        np.linalg.inv(T_scan_nominal).astype(np.float64),
        changed[is_changed],
        signed[is_changed],
        float(near.mean()) if faulty.any() else 1.0,
        int((off > tolerance).sum()),
        spacing,
    )


def _build(part: Part, setup: CaseSetup) -> Mesh:
    """The mesh of the part, mirrored where that is the fault."""
    mesh = part.build()
    if setup.fault != "mirrored":
        return mesh
    return Mesh(mesh.vertices * np.array([-1, 1, 1]), mesh.faces[:, ::-1])


def _check_asymmetry(true: Mesh, nominal: Mesh, setup: CaseSetup, least: float) -> None:
    """Raise UnsuitedPartError where the part looks alike after half a turn."""
    turns = [(-1, -1, 1)]
    if setup.fault == "mirrored":
        turns += [(1, 1, 1), (1, -1, -1), (-1, 1, -1)]
    for turn in turns:
        if measure_size(Mesh(true.vertices * np.array(turn), true.faces), nominal) < least:
            raise UnsuitedPartError("the part is symmetric")


def _draw_deformation(rng: np.random.Generator, fault: str, part: Part) -> Floats:
    """The displacement of points as a matrix (3, 10) for the monomials of `_list_monomials`, in
    mm, of about one at the part's ends."""
    field, half = np.zeros((3, 10)), part.size / 2
    if fault == "bent":
        field[2, rng.choice([4, 7])] = half**-2
    elif fault == "twisted":
        field[2, 5] = half**-2
    elif fault == "scaled":
        field[range(3), [1, 2, 3]] = 1 / half
    else:
        axis = rng.integers(2)
        field[axis, 1 + axis] = 1 / half
    return field * rng.choice([-1, 1])


def _list_monomials(p: Floats) -> Floats:
    """(n, 10): 1, x, y, z, xx, xy, xz, yy, yz, zz of points (n, 3)."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(p)), p, p[:, i] * p[:, j]])


def _solve_deformation(
    field: Floats, points: Floats, normals: Floats, nominal: Mesh, size_mm: float, rank: int
) -> Callable[[Floats], Floats]:
    """A function that displaces points by a multiple of the field and the best rigid motion, such
    that the ``rank``-th farthest of the measured points is ``size_mm`` off the nominal."""
    J, surface = distance_jacobian(points, normals), Distances(nominal)
    off = (_list_monomials(points) @ field.T * normals).sum(axis=1)
    motion = np.linalg.lstsq(J, off, rcond=None)[0]
    amount = size_mm / float(np.abs(off - J @ motion).max())

    def deform(places: Floats) -> Floats:
        T = turn_about(-amount * motion[:3], np.zeros(3), -amount * motion[3:])
        return move_points(T, places + amount * _list_monomials(places) @ field.T)

    for _ in range(4):
        amount *= size_mm / np.partition(surface.closest(deform(points))[1], -rank)[-rank]
    if amount > 5 * size_mm:
        raise UnsuitedPartError("what was measured hardly shows the deformation")
    return deform


def _compare(
    rng: np.random.Generator, true: Sequence[Mesh], nominal: Sequence[Mesh]
) -> tuple[Floats, Floats, Floats]:
    """Of places on both surfaces: themselves (n, 3), the signed deviation (n,) mm, and what shows
    it: the nearest place on the true surface (n, 3). ``true``, ``nominal``: as they are, and
    closed."""
    surfaces, solids = [
        [Distances(mesh) for mesh in pair] for pair in zip(true, nominal, strict=True)
    ]
    on_true, on_nominal = (each.cover(rng) for each in surfaces)
    _, excess = surfaces[1].closest(on_true)
    feet, lack = surfaces[0].closest(on_nominal)
    excess *= np.where(solids[1].contain(on_true), -1, 1)
    lack *= np.where(solids[0].contain(on_nominal), 1, -1)
    places = np.concatenate([on_true, on_nominal])
    return places, np.concatenate([excess, lack]), np.concatenate([on_true, feet])


@dataclass(frozen=True, eq=False)
class PartScan:
    """Measured points and normals (n, 3) without noise, in the nominal's frame; ``rays`` (n, 3):
    unit vectors along which noise acts; ``face`` (n,) of the part's mesh, where ``is_part``;
    ``views``: the centres (2, 3) of each view's camera and projector."""

    points: Floats
    normals: Floats
    rays: Floats
    face: np.ndarray
    is_part: Mask
    views: list[Floats]


def scan_part(
    rng: np.random.Generator, mesh: Mesh, part: Part, setup: CaseSetup, count: int
) -> PartScan:
    """Scan a part and the clutter beside it with about so many points."""
    size = part.size
    clutter = _draw_clutter(rng, mesh, part, setup.clutter, count)
    scene = Distances(_join([mesh, *clutter]))
    views = [] if setup.view == "full" else _draw_views(rng, size, setup)
    scans = [_scan_around(rng, scene, size, 3 * count)] if not views else []
    for centres in views:
        if setup.source == "own":
            scans.append(_scan_raster(rng, scene, mesh, centres, count // len(views)))
        else:
            scans.append(_scan_from(rng, scene, size, centres[0], 4 * count))
    points, face, origin = (np.concatenate(each) for each in zip(*scans, strict=True))
    chosen = rng.permutation(len(points))[:count]
    points, face, origin = points[chosen], face[chosen], origin[chosen]
    normals = scene.normals[face]
    rays = unit_vectors(origin - points) if setup.source == "own" else normals
    is_part = face < len(mesh.faces)
    if np.count_nonzero(is_part) < count / 10:
        raise UnsuitedPartError("the part is hardly seen")
    return PartScan(points, normals, rays, face, is_part, views)


Sampled = tuple[Floats, np.ndarray, Floats]
"""Points (n, 3), the face of each, and the centre (n, 3) of the camera that saw it."""


def _scan_around(rng: np.random.Generator, scene: Distances, size: float, count: int) -> Sampled:
    """Points all around, but where something touches or lies on the ground."""
    points, face = scene.sample(rng, count)
    normals = scene.normals[face]
    # the ground's two triangles come last
    reach = np.where(face >= len(scene.areas) - 2, 2.0, 0.004)[:, None] * size
    free = ~scene.is_hidden(points + 1e-5 * size * normals, points + reach * normals)
    return points[free], face[free], np.full((np.count_nonzero(free), 3), np.nan)


def _scan_from(
    rng: np.random.Generator, scene: Distances, size: float, camera: Floats, count: int
) -> Sampled:
    """Points that a camera sees: the more oblique, the fewer."""
    points, face = scene.sample(rng, count)
    normals = scene.normals[face]
    cosine = (unit_vectors(camera - points) * normals).sum(axis=1)
    seen = (cosine > MIN_COSINE) & (rng.random(count) < cosine)
    seen[seen] = ~scene.is_hidden(points[seen] + 1e-4 * size * normals[seen], camera)
    return points[seen], face[seen], np.broadcast_to(camera, points[seen].shape)


def _scan_raster(
    rng: np.random.Generator, scene: Distances, mesh: Mesh, centres: Floats, count: int
) -> Sampled:
    """Points in a camera's pixel raster that the projector lights too."""
    camera, projector = centres
    forward = unit_vectors(-camera)
    right = unit_vectors(np.cross(forward, projector - camera))
    frame = np.stack([right, np.cross(forward, right), forward])
    local = (mesh.vertices.astype(np.float64) - camera) @ frame.T
    image = local[:, :2] / local[:, 2:]
    low, high = image.min(axis=0), image.max(axis=0)
    low, high = low - 0.1 * (high - low), high + 0.1 * (high - low)

    def cast(step: float) -> Sampled:
        u, v = (np.arange(a, b, step) for a, b in zip(low, high, strict=True))
        pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
        directions = np.column_stack([pixels, np.ones(len(pixels))]) @ frame
        points, face = scene.cast(camera, directions)
        facing = [
            (unit_vectors(c - points) * scene.normals[face]).sum(axis=1) > MIN_COSINE
            for c in centres
        ]
        seen = facing[0] & facing[1]
        lift = 1e-4 * lengths(camera)[..., None] * scene.normals[face[seen]]
        seen[seen] = ~scene.is_hidden(points[seen] + lift, projector)
        return points[seen], face[seen], np.broadcast_to(camera, points[seen].shape)

    coarse = float(np.sqrt(np.prod(high - low) / 3000))
    found = max(len(cast(coarse)[0]), 1)
    return cast(coarse * np.sqrt(found / count))


def _draw_views(rng: np.random.Generator, size: float, setup: CaseSetup) -> list[Floats]:
    """The centres (2, 3) of camera and projector of each view, from above."""
    far, start = size * rng.uniform(2, 4), rng.uniform(0, 2 * np.pi)
    views = []
    for k in range(1 if setup.view == "one side" else 3):
        polar = rng.uniform(0, 0.8) if setup.view == "one side" else rng.uniform(0.4, 0.9)
        around = start + 2 * np.pi / 3 * k
        camera = far * np.array(
            [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)]
        )
        aside = unit_vectors(np.cross(camera, rng.normal(size=3)))
        views.append(np.stack([camera, camera + rng.uniform(0.15, 0.35) * far * aside]))
    return views


def _draw_clutter(
    rng: np.random.Generator, mesh: Mesh, part: Part, clutter: Clutter, count: int
) -> list[Mesh]:
    """Meshes of what surrounds the part; a table comes last."""
    size = part.size
    bottom = min(float(mesh.vertices[:, 2].min()), -part.thickness) - 1e-4 * size
    if clutter == "table":
        half = size * rng.uniform(0.55, 0.75, 2)
        x, y = rng.uniform(-0.1, 0.1, 2) * size
        corners = [
            (x + a * half[0], y + b * half[1], bottom)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        return [Mesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]))]
    if "clamp" not in clutter:
        return []
    axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
    edge = (part.edges[-1], part.half_width)
    area = 3 * 4 * edge[0] * edge[1]
    gap = 1e-4 * size if clutter == "touching clamp" else rng.uniform(2, 5) * np.sqrt(area / count)
    centre, half = np.zeros(3), size * rng.uniform(0.05, 0.1, 3)
    half[2] = (rng.uniform(0.02, 0.15) * size - bottom) / 2
    centre[axis] = sign * (edge[axis] + gap + half[axis])
    centre[1 - axis] = rng.uniform(-0.7, 0.7) * edge[1 - axis]
    centre[2] = bottom + half[2]
    block = Part((-half[0], half[0]), (half[2],), half[1], half[2], ()).build()
    return [
        Mesh(block.vertices + centre, block.faces),
        Mesh(np.empty((0, 3)), np.empty((0, 3))),
    ][:1]


def _join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several, their faces in order."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def _draw_pose(rng: np.random.Generator, size: float, views: Sequence[Floats]) -> Floats:
    """The pose (4, 4) of the nominal in the scan's frame; of an own capture the first camera is at
    its origin."""
    R = Rotation.random(rng=rng).as_matrix()
    if views:
        camera = views[0][0]
        forward = unit_vectors(-camera)
        right = unit_vectors(np.cross(forward, R[0]))
        R = np.stack([right, np.cross(forward, right), forward])
        return rigid_transform(R, -R @ camera)
    return rigid_transform(R, rng.uniform(-3, 3, 3) * size)
