"""Scans of right and wrong parts, with the truth: what deviates from the nominal part, where, and
whether the scan shows it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import trimesh
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
from slviewer.inspection.exclusion import label_clusters
from slviewer.surface.shapes import Mesh
from tests.proofs.drawn_parts import (
    LocalFault,
    Part,
    PartKind,
    PartSurface,
    UnsuitedPartError,
    draw_change,
    draw_part,
    measure_largest_distance,
    solve_part_change,
)

GlobalFault = Literal["bent", "twisted", "scaled", "shrunk"]
Fault = Literal["none", LocalFault, GlobalFault, "mirrored"]
View = Literal["full", "one side", "three views"]
Clutter = Literal["none", "table", "clamp", "touching clamp", "spikes"]
Source = Literal["imported", "own"]

LEAST_WRONG = 1.2
"""Tolerances, from which a part is a wrong one."""
SIZES = (0.5, LEAST_WRONG, 2.0, 5.0, 20.0)
MAX_ATTEMPTS = 100
MIN_COSINE = 0.2
"""Of the angle of incidence at which a camera measures."""
MIN_SEEN, MIN_EVIDENCE, MIN_SIGMAS = 0.2, 6, 3.0
"""Share of the faulty region, points in one place that deviate by more than the tolerance, and
standard deviations by which the mean of some of them exceeds it, without which a fault is not in
view."""
MIN_SHOWN = 0.2
"""Of a deformation, over its largest displacement, what the measured points have to deviate by."""
SPACINGS = 3.0
"""From a place to the nearest one that was measured, or that deviates."""
EYE = np.eye(4)
TOUCHING = 1e-4
"""Distance of what touches, over the part's size."""


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
        return "fail" if self.size >= LEAST_WRONG else "pass"


@dataclass(frozen=True, eq=False)
class PartCase:
    """A scan of a part against its nominal, mm.

    ``points``, ``normals`` (n, 3) in the scan's frame; ``sigma_mm`` (n,) their noise along the
    normals. ``views``: centres (2, 3) of camera and projector of each view; None if unknown.
    ``measured`` (m, 3): the part's points without noise, in the nominal's frame at the part's true
    pose ``T_nominal_scan``. ``seen``: share of the faulty region that has scan points.
    ``spacing_mm`` of the points.
    """

    setup: CaseSetup
    nominal: Mesh
    points: Floats
    normals: Floats
    sigma_mm: Floats
    views: list[Floats] | None
    tolerance_mm: float
    T_nominal_scan: Floats
    measured: Floats
    truth: "PartTruth"
    seen: float
    spacing_mm: float

    def placed_at(self, T_nominal_scan: Floats) -> "PlacedPart":
        """The part as it deviates at a pose (4, 4)."""
        T = T_nominal_scan @ np.linalg.inv(self.T_nominal_scan)
        places, deviations, _ = self.truth.compare(np.random.default_rng(self.setup.index), T)
        measured = move_points(T, self.measured)
        off, is_inside = self.truth.measure(measured)
        excess, link, shown = off - self.tolerance_mm, SPACINGS * self.spacing_mm, []
        for side in (is_inside, ~is_inside):
            own = np.flatnonzero(side & (excess > 0))
            shown += [excess[own[each]] for each in label_clusters(measured[own], link)]
        return PlacedPart(
            self,
            np.concatenate([places, measured]),
            np.concatenate([deviations, np.where(is_inside, -off, off)]),
            shown,
        )


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part at a pose: ``places`` (k, 3) in the nominal's frame, all over the true surface and the
    nominal one and where it was measured, and their ``deviations`` (k,) mm, positive for too much
    material; and of each cluster of measured points that are out of tolerance by how much,
    ``excess_mm``."""

    case: PartCase
    places: Floats
    deviations: Floats
    excess_mm: Sequence[Floats]

    @property
    def evidence(self) -> int:
        """Number of measured points that deviate by more than the tolerance."""
        return sum(map(len, self.excess_mm))

    @property
    def in_view(self) -> bool:
        """Whether the scan shows that the part is wrong, and noise does not hide it."""
        sigma = float(np.median(self.case.sigma_mm))
        best = 0.0
        for excess in self.excess_mm:
            sums, counts = np.cumsum(np.sort(excess)[::-1]), np.arange(1, len(excess) + 1)
            best = max(best, *(sums / np.sqrt(counts) / sigma)[MIN_EVIDENCE - 1 :], 0.0)
        return self.case.seen >= MIN_SEEN and best >= MIN_SIGMAS

    @property
    def conforms(self) -> bool:
        """Whether all of the part lies within the tolerance here."""
        return float(np.abs(self.deviations).max()) <= self.case.tolerance_mm

    def deviations_near(self, place: Floats, sign: float) -> Floats:
        """The deviations (m,) mm of such a sign, out of tolerance, within a few spacings of a place
        (3,)."""
        is_near = lengths(self.places - place) <= SPACINGS * self.case.spacing_mm
        return self.deviations[is_near & (sign * self.deviations > self.case.tolerance_mm)]


def plan_part_cases(count: int, seed: int) -> list[CaseSetup]:
    """The setups of cases: kinds, faults, sizes, views and clutter are equally frequent."""
    rng = np.random.default_rng(seed)

    def deal(levels: Sequence[Any]) -> list[Any]:
        return [levels[i] for i in rng.permutation(count) % len(levels)]

    faults = (*get_args(LocalFault), *get_args(GlobalFault), "mirrored")
    columns = map(deal, (get_args(PartKind), faults, get_args(View), get_args(Clutter)))
    # a quarter of the parts is right, three eighths of the other views are captures of one's own
    sizes, eighths = deal([*3 * SIZES, *5 * [0.0]]), deal(range(8))
    setups = []
    for index, (*drawn, size, eighth) in enumerate(zip(*columns, sizes, eighths, strict=True)):
        kind, fault, view, clutter = drawn
        source: Source = "own" if eighth < 3 and view != "full" else "imported"
        if not size:
            fault = "none"
        elif fault == "mirrored":
            size = SIZES[-1]
        setups.append(CaseSetup(seed, index, kind, fault, size, view, clutter, source))
    return setups


def make_case(setup: CaseSetup) -> PartCase:
    """A case at random, the same at each call. Redraws the part where the fault does not suit
    it."""
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.default_rng([setup.seed, setup.index, attempt])
        try:
            return _draw_case(rng, setup)
        except UnsuitedPartError:
            continue
    raise UnsuitedPartError(f"no part suits {setup}")


def _draw_case(rng: np.random.Generator, setup: CaseSetup) -> PartCase:
    """A case. Raises UnsuitedPartError where the part drawn does not suit."""
    nominal = true = draw_part(rng, setup.kind)
    # of a large error the tolerance is small, or no feature could have it
    coarsest = 700 if setup.size == SIZES[-1] else 250
    tolerance = nominal.size / np.exp(rng.uniform(np.log(coarsest), np.log(1500)))
    if setup.fault in get_args(LocalFault):
        change = draw_change(rng, nominal, setup.kind, setup.fault)  # type: ignore[arg-type]
        nominal, true = solve_part_change(change, setup.size * tolerance)
    truth = PartTruth(nominal, true, setup.fault == "mirrored")
    surface = truth.nominal
    if _is_symmetric(truth.surface.mesh, surface.mesh, setup.fault == "mirrored", 4 * tolerance):
        raise UnsuitedPartError("the part is symmetric")
    count = int(np.exp(rng.uniform(np.log(5000), np.log(20_000))))
    scan = scan_part(rng, truth.surface.mesh, nominal, setup, count)
    is_part = scan.is_part
    measured = scan.points[is_part], scan.normals[is_part]
    if setup.fault in get_args(GlobalFault):
        field = _draw_deformation(rng, setup.fault, nominal)
        rank = 1 if setup.expected == "pass" else 2 * MIN_EVIDENCE
        deform = _solve_deformation(field, *measured, surface, setup.size * tolerance, rank)
        measured = deform(measured[0]), _deform_normals(deform, *measured, tolerance)
        scan.points[is_part], scan.normals[is_part] = measured
        truth.deform = deform
    _, signed, showing = truth.compare(rng)
    tree = cKDTree(measured[0])
    spacing = median_spacing(tree, 2000)
    shown = tree.query(showing[np.abs(signed) > tolerance])[0] < SPACINGS * spacing
    T_scan_nominal = _draw_pose(rng, nominal.size, scan.views)
    sigma = tolerance / rng.choice([3, 10])
    points, normals = _add_noise(rng, scan, sigma, setup.clutter == "spikes", nominal.size)
    views = [move_points(T_scan_nominal, centres) for centres in scan.views]
    return PartCase(
        setup,
        Mesh(surface.mesh.vertices, surface.mesh.faces),
        move_points(T_scan_nominal, points),
        normals @ T_scan_nominal[:3, :3].T,
        sigma * np.abs((scan.rays * scan.normals).sum(axis=1)),
        views if setup.source == "own" else None,
        float(tolerance),
        np.linalg.inv(T_scan_nominal).astype(np.float64),
        measured[0],
        truth,
        float(shown.mean()) if len(shown) else 1.0,
        spacing,
    )


class PartTruth:
    """The true part, and by how much it deviates from the ``nominal`` one. ``deform``: displaces
    points (n, 3) of the true part further."""

    def __init__(self, nominal: Part, true: Part, is_mirrored: bool):
        meshes = [replace(true, is_open=is_open).build() for is_open in (true.is_open, False)]
        if is_mirrored:
            for mesh in meshes:
                mesh.apply_scale([-1, 1, 1])
        self.surface, self._solid = map(PartSurface, meshes)
        self.nominal = PartSurface(nominal.build())
        self._closed = PartSurface(replace(nominal, is_open=False).build())
        self.deform: Callable[[Floats], Floats] | None = None

    def compare(self, rng: np.random.Generator, T: Floats = EYE) -> tuple[Floats, Floats, Floats]:
        """Of places on both surfaces, the part moved by ``T`` (4, 4): themselves (n, 3), the signed
        deviation (n,) mm, and the nearest places on the true surface (n, 3), which show it."""
        on_true, on_nominal = self.surface.cover(rng), self.nominal.cover(rng)
        if self.deform:
            on_true, on_nominal = self.deform(on_true), on_nominal[:0]
        on_true, back = move_points(T, on_true), np.linalg.inv(T)
        excess, is_inside = self.measure(on_true)
        excess = np.where(is_inside, -excess, excess)
        feet, lack = self.surface.closest(move_points(back, on_nominal))
        lack *= np.where(self._solid.contains(move_points(back, on_nominal)), 1, -1)
        places, feet = np.concatenate([on_true, on_nominal]), move_points(T, feet)
        return places, np.concatenate([excess, lack]), np.concatenate([on_true, feet])

    def measure(self, points: Floats) -> tuple[Floats, Mask]:
        """Distances (n,) mm of points (n, 3) from the nominal part, and which are inside it."""
        return self.nominal.closest(points)[1], self._closed.contains(points)


def _is_symmetric(
    true: trimesh.Trimesh, nominal: trimesh.Trimesh, is_mirrored: bool, least_mm: float
) -> bool:
    """Whether the part fits its nominal after half a turn, or a mirrored one in any position."""
    turns = [(1, 1, 1), (1, -1, -1), (-1, 1, -1)] if is_mirrored else []
    for turn in [(-1, -1, 1), *turns]:
        turned = trimesh.Trimesh(true.vertices * turn, true.faces, process=False)
        if measure_largest_distance(turned, nominal) < least_mm:
            return True
    return False


def _draw_deformation(rng: np.random.Generator, fault: str, part: Part) -> Floats:
    """The displacement, mm, of about 1 at the part's ends, as factors (3, 10) of the terms of
    `_list_monomials`."""
    field, half = np.zeros((3, 10)), part.size / 2
    axis = rng.integers(2)
    if fault == "bent":
        field[2, (4, 7)[axis]] = half**-2
    elif fault == "twisted":
        field[2, 5] = half**-2
    elif fault == "scaled":
        field[range(3), range(1, 4)] = 1 / half
    else:
        field[axis, 1 + axis] = 1 / half
    return field * rng.choice([-1, 1])


def _list_monomials(p: Floats) -> Floats:
    """(n, 10): 1, x, y, z, xx, xy, xz, yy, yz, zz of points (n, 3)."""
    i, j = np.triu_indices(3)
    return np.column_stack([np.ones(len(p)), p, p[:, i] * p[:, j]])


def _solve_deformation(
    field: Floats, points: Floats, normals: Floats, nominal: PartSurface, size_mm: float, rank: int
) -> Callable[[Floats], Floats]:
    """A function that displaces points by a multiple of the field and the best rigid motion, such
    that the ``rank``-th farthest of the measured points is ``size_mm`` off the nominal."""
    J = distance_jacobian(points, normals)
    off = (_list_monomials(points) @ field.T * normals).sum(axis=1)
    motion = np.linalg.lstsq(J, off, rcond=None)[0]
    if not (largest := float(np.abs(off - J @ motion).max())) > MIN_SHOWN:
        raise UnsuitedPartError("what was measured hardly shows the deformation")
    amount = size_mm / largest

    def deform(places: Floats) -> Floats:
        T = turn_about(-amount * motion[:3], np.zeros(3), -amount * motion[3:])
        return move_points(T, places + amount * _list_monomials(places) @ field.T)

    for _ in range(4):
        amount *= size_mm / np.partition(nominal.closest(deform(points))[1], -rank)[-rank]
    return deform


def _deform_normals(
    deform: Callable[[Floats], Floats], points: Floats, normals: Floats, step: float
) -> Floats:
    """The normals (n, 3) of the deformed surface, by two tangents of the length ``step``."""
    across = unit_vectors(np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)]))
    a, b = (deform(points + step * t) for t in (across, np.cross(normals, across)))
    return unit_vectors(np.cross(a - deform(points), b - deform(points)))


@dataclass(frozen=True, eq=False)
class PartScan:
    """Points and normals (n, 3) without noise, in the nominal's frame; ``rays`` (n, 3): directions
    in which noise acts; ``is_part`` (n,) bool; ``views``: the centres (2, 3) of each view's camera
    and projector."""

    points: Floats
    normals: Floats
    rays: Floats
    is_part: Mask
    views: list[Floats]


def scan_part(
    rng: np.random.Generator, mesh: trimesh.Trimesh, part: Part, setup: CaseSetup, count: int
) -> PartScan:
    """Scan a part and the clutter beside it with at most ``count`` points."""
    clutter = _draw_clutter(rng, mesh, part, setup.clutter, count)
    joined: Any = trimesh.util.concatenate([mesh, *clutter])
    scene = PartSurface(joined)
    normals = np.asarray(scene.mesh.face_normals)
    views = [] if setup.view == "full" else _draw_views(rng, part.size, setup.view)
    if views:
        scans = [
            _scan_view(rng, scene, centres, part.size, 3 * count // len(views), setup.source)
            for centres in views
        ]
        points, face, rays = (np.concatenate(each) for each in zip(*scans, strict=True))
    else:
        points, face = scene.sample(rng, 2 * count)
        rays = normals[face]
        # nothing is measured where something touches, nor of the table what lies below something
        is_table = (setup.clutter == "table") & (face >= len(mesh.faces))
        reach = np.where(is_table, 2, 40 * TOUCHING)[:, None] * part.size
        is_free = ~scene.is_hidden(
            points + 0.1 * TOUCHING * part.size * rays, points + reach * rays
        )
        points, face, rays = points[is_free], face[is_free], rays[is_free]
    chosen = rng.permutation(len(points))[:count]
    points, face, rays = points[chosen], face[chosen], rays[chosen]
    is_part = face < len(mesh.faces)
    if np.count_nonzero(is_part) < count / 10:
        raise UnsuitedPartError("the part is hardly seen")
    if setup.source == "imported":
        rays = normals[face]
    return PartScan(points, normals[face], rays, is_part, views)


def _scan_view(
    rng: np.random.Generator,
    scene: PartSurface,
    centres: Floats,
    size: float,
    count: int,
    source: Source,
) -> tuple[Floats, np.ndarray, Floats]:
    """Points (n, 3) that a camera sees, the face of each, and its ray (n, 3): of an own capture in
    a raster of pixels, where the projector lights them."""
    camera, projector = centres
    side = int(np.sqrt(count))
    pixels = np.stack(np.meshgrid(*2 * [np.linspace(-0.6, 0.6, side)]), -1).reshape(-1, 2)
    if source == "imported":
        pixels = rng.uniform(-0.6, 0.6, pixels.shape)
        projector = camera
    frame = _look_at_origin(camera, projector - camera + rng.normal(size=3))
    directions = np.column_stack([size * pixels, np.full(len(pixels), lengths(camera))]) @ frame
    points, face = scene.cast(camera, directions)
    normals = np.asarray(scene.mesh.face_normals)[face]
    rays, light = (unit_vectors(centre - points) for centre in (camera, projector))
    cosine = np.minimum((rays * normals).sum(axis=1), (light * normals).sum(axis=1))
    seen = cosine > MIN_COSINE
    seen &= ~scene.is_hidden(points + TOUCHING * size * normals, projector[None])
    return points[seen], face[seen], rays[seen]


def _look_at_origin(camera: Floats, right: Floats) -> Floats:
    """The axes (3, 3) of a camera: about ``right``, down, and towards the origin."""
    forward = -unit_vectors(camera)
    down = unit_vectors(np.cross(forward, right))
    return np.stack([np.cross(down, forward), down, forward])


def _draw_views(rng: np.random.Generator, size: float, view: View) -> list[Floats]:
    """The centres (2, 3) of camera and projector of each view, from above."""
    far, start = size * rng.uniform(2, 4), rng.uniform(0, 2 * np.pi)
    views = []
    for k in range(1 if view == "one side" else 3):
        polar = rng.uniform(0, 0.8) if view == "one side" else rng.uniform(0.4, 0.9)
        around = start + 2 * np.pi / 3 * k
        sine = np.sin(polar)
        camera = far * np.array([sine * np.cos(around), sine * np.sin(around), np.cos(polar)])
        aside = unit_vectors(np.cross(camera, rng.normal(size=3)))
        views.append(np.stack([camera, camera + rng.uniform(0.15, 0.35) * far * aside]))
    return views


def _draw_clutter(
    rng: np.random.Generator, mesh: trimesh.Trimesh, part: Part, clutter: Clutter, count: int
) -> list[trimesh.Trimesh]:
    """Meshes of what surrounds the part: a table below it, or a block beside it."""
    size, edge = part.size, np.array([part.edges[-1], part.half_width])
    bottom = min(mesh.bounds[0, 2], -part.thickness) - TOUCHING * size
    if clutter == "table":
        half = size * rng.uniform(0.55, 0.75, 2)
        corners = [
            (a * half[0], b * half[1], bottom) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        return [trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)])]
    if "clamp" not in clutter:
        return []
    spacing = np.sqrt(12 * edge.prod() / count)
    gap = TOUCHING * size if "touching" in clutter else spacing * rng.uniform(2, 5)
    axis, half = rng.integers(2), size * rng.uniform(0.05, 0.1, 2)
    centre = rng.uniform(-0.7, 0.7, 2) * edge
    centre[axis] = rng.choice([-1, 1]) * (edge[axis] + gap + half[axis])
    bounds = [(*centre - half, bottom), (*centre + half, size * rng.uniform(0.02, 0.15))]
    return [trimesh.creation.box(bounds=bounds)]


def _add_noise(
    rng: np.random.Generator, scan: PartScan, sigma_mm: float, has_spikes: bool, size: float
) -> tuple[Floats, Floats]:
    """Points and normals (n, 3) with noise, and some points that are wrong altogether."""
    points = scan.points + rng.normal(0, sigma_mm, (len(scan.points), 1)) * scan.rays
    normals = unit_vectors(scan.normals + rng.normal(0, 0.02, points.shape))
    if has_spikes:
        few = rng.random(len(points)) < rng.uniform(0.001, 0.005)
        low, high = points.min(axis=0) - 0.15 * size, points.max(axis=0) + 0.15 * size
        points[few] = rng.uniform(low, high, (few.sum(), 3))
        normals[few] = unit_vectors(rng.normal(size=(few.sum(), 3)))
    return points, normals


def _draw_pose(rng: np.random.Generator, size: float, views: Sequence[Floats]) -> Floats:
    """The pose (4, 4) of the nominal in the scan's frame, whose origin the first camera is."""
    if views:
        R = _look_at_origin(views[0][0], rng.normal(size=3))
        return rigid_transform(R, -R @ views[0][0])
    R = Rotation.random(random_state=rng).as_matrix()
    return rigid_transform(R, rng.uniform(-3, 3, 3) * size)
