"""Scans aligned and judged against models."""

from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from slviewer.geometry.rigid import move_points, rigid_transform
from slviewer.pipeline.compare import compare
from slviewer.pipeline.measure import load_surface
from slviewer.pipeline.merge import merge
from slviewer.pipeline.operation import Job
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.measurement import NominalDeviation
from slviewer.records.merge import Merge
from slviewer.registration.markers import MeasuredMarkers
from slviewer.registration.multiway import Starts
from slviewer.registration.refusal import Refused
from slviewer.registration.static_scene import register_object
from slviewer.session.polygons import Polygons, triangulate_polygons
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.turning import STEPS, turning
from slviewer.surface.fuse import fuse
from tests.proofs.report_cases.case import BASE_SCALE, Case, Outcome, Workplace

RIG = letter(BASE_SCALE, 0)
HEIGHT, DEPTH, OFFSET = 20.0, 0.5, 0.4
PITCH, MOVED, TURNED_DEG = 24.0, 19.0, 25.0
STEP_DEG = 360.0 / STEPS
THICKNESS = 2.0
TOLERANCE = 0.3
STUDS = Pose(rotation(np.array([np.pi - 0.35, 0.0, 0.0])), np.array([0.0, 0.0, 620.0]))
NUT = Pose(rotation(np.array([np.pi - 0.75, 0.0, 0.0])), np.array([0.0, 15.0, 600.0]))
BLOCK = Pose(
    rotation(np.array([np.pi - 0.45, 0, 0])) @ rotation(np.array([0, 0.25, 0])),
    np.array([-55.0, 45.0, 620.0]),
)


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> Any:
    """Return a box between two corners, mm."""
    return trimesh.creation.box(bounds=(low, high))


def _block(with_slot: bool) -> Any:
    """Return a block of 120 x 90 mm with three bosses, and a slot on 15 % of its upper face."""
    bosses = [
        _box((10, 10, HEIGHT - 1), (30, 25, HEIGHT + 12)),
        _box((70, 8, HEIGHT - 1), (85, 30, HEIGHT + 7)),
        _box((8, 55, HEIGHT - 1), (28, 75, HEIGHT + 9)),
    ]
    body = _box((0, 0, 0), (120, 90, HEIGHT))
    if with_slot:
        slot = [(80, 90), (80, 50), (40, 50), (40, 90)]
        bottom = [(0, 0), (120, 0), (120, 90), (0, 90)]
        vertices = [(x, y, HEIGHT) for x, y in [(120, 90), *slot, (0, 90), (0, 0), (120, 0)]]
        vertices += [(x, y, HEIGHT - DEPTH) for x, y in slot]
        vertices += [(x, y, 0) for x, y in bottom]
        sides = [
            range(8), range(8, 12), range(15, 11, -1), (1, 8, 9, 2), (2, 9, 10, 3), (3, 10, 11, 4),
            (15, 5, 4, 11, 8, 1, 0, 14), (6, 12, 13, 7), (7, 13, 14, 0), (5, 15, 12, 6),
        ]  # fmt: skip
        polygons = Polygons(
            np.array(vertices, float),
            np.concatenate(sides),
            np.array([len(side) for side in sides]),
        )
        body = trimesh.Trimesh(vertices, triangulate_polygons(polygons, []), process=False)
        body.fix_normals()
    return trimesh.util.concatenate([body, *bosses])


def _studs(with_lug: bool) -> Any:
    """Return a plate larger than the view with a stud every `PITCH` mm, and a lug 3 mm wide."""
    bodies = [_box((-350, -350, -10), (350, 350, 0))]
    for x, y in np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)), -1).reshape(-1, 2):
        stud = trimesh.creation.cylinder(7, 8, sections=24)
        bodies.append(stud.apply_translation((PITCH * x, PITCH * y, 4)))
    return trimesh.util.concatenate(bodies + [_box((10.5, -6, 0), (13.5, 6, 6))] * with_lug)


def _nut() -> Any:
    """Return a hexagonal nut of 40 mm with a bore."""
    around = np.arange(48) * np.pi / 24
    apart = (around + np.pi / 6) % (np.pi / 3) - np.pi / 6
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    rims = [circle * (52 / np.cos(apart))[:, None], circle * 30.0]
    vertices = np.concatenate([np.c_[rim, np.full(48, z)] for rim in rims for z in (0, 40)])
    i, k = np.arange(48), (np.arange(48) + 1) % 48
    # around the section: outside, top, bore, bottom
    quads = [(0, 48), (48, 144), (144, 96), (96, 0)]
    faces = [
        np.stack(corners, axis=1)
        for a, b in quads
        for corners in ((i + a, k + a, k + b), (i + a, k + b, i + b))
    ]
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def _scene(mesh: Any, pose: Pose) -> MeshScene:
    return MeshScene(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), pose)


def _scenes() -> Mapping[str, Callable[[], MeshScene]]:
    """Of each scan, what makes its scene."""
    beside = Pose(STUDS.R, STUDS.t + np.array([MOVED, 0, 0]))
    around = Pose(NUT.R @ rotation(np.array([0, 0, np.radians(TURNED_DEG)])), NUT.t)
    return {
        "stud_a": lambda: _scene(_studs(False), STUDS),
        "stud_b": lambda: _scene(_studs(False), beside),
        "lug_a": lambda: _scene(_studs(True), STUDS),
        "lug_b": lambda: _scene(_studs(True), beside),
        "nut_a": lambda: _scene(_nut(), NUT),
        "nut_b": lambda: _scene(_nut(), around),
        "stone_1": lambda: turning()["turn_01"],
        "stone_2": lambda: turning()["turn_02"],
        "slot_good": lambda: _scene(_block(True), BLOCK),
        "slot_missing": lambda: _scene(_block(False), BLOCK),
    }


def _scan(workplace: Workplace, *names: str) -> Path:
    """Return a calibrated session with these scans."""
    scenes = _scenes()
    return workplace.capture(RIG, {name: scenes[name]() for name in names})


def _merge(session: Path, scan: str, onto: str, **options: Any) -> tuple[Merge, list[str]]:
    """Merge a scan onto another; returns the record and the warnings."""
    warnings: list[str] = []
    found = merge.run(session, merge.settings([scan], onto, **options), warn=warnings.append)
    return next(iter(found.values())), warnings


def _try_identity(session: Path, scan: str, onto: str) -> str:
    """Merge a scan that has another pose that fits as well from identity; returns the refusal."""
    try:
        _merge(session, scan, onto, start="identity")
    except Refused as refused:
        return refused.reason
    return "merged"


def _moved_x(record: Merge, scan: str) -> float:
    """Return how far a scan was moved along x, mm, at the middle of the view."""
    T = np.array(record.pairs[scan].T_reference_scan)
    return float((move_points(T, STUDS.t[None]) - STUDS.t)[0, 0])


def _studs_case(kind: str) -> Case:
    """The case of studs moved by most of a pitch: identity is refused, picked points decide."""

    def case(workplace: Workplace) -> Outcome:
        onto, scan = f"{kind}_a", f"{kind}_b"
        session = _scan(workplace, onto, scan)
        reason = _try_identity(session, scan, onto)
        picks = STUDS.t + np.array([[0.0, 0, 0], [48, 0, 0], [0, 40, -15]])
        picked = {(scan, onto): (picks + np.array([MOVED + 0.4, 0.3, 0]), picks)}
        record, warnings = _merge(session, scan, onto, picked=picked)
        moved = _moved_x(record, scan)
        return Outcome(
            f"from identity {reason}; from picked points {moved:.3f} mm, {len(warnings)} warnings",
            f"refused or said; {-MOVED:g} mm",
            reason == "ambiguous"
            and 0 < abs(moved + MOVED) < 0.1
            and any(f"{PITCH:.0f}" in each and "rests" in each for each in warnings),
        )

    return case


def _turn_nut(workplace: Workplace) -> Outcome:
    """A nut turned by most of half its symmetry: the remedy is the turntable's angle."""
    session = _scan(workplace, "nut_a", "nut_b")
    reason = _try_identity(session, "nut_b", "nut_a")
    settings = {"start": "turntable", "angle": TURNED_DEG}
    record, warnings = _merge(session, "nut_b", "nut_a", **settings)
    turned = record.pairs["nut_b"].turned_deg
    return Outcome(
        f"from identity {reason}; by the turntable's angle {turned:.3f} degrees",
        f"refused or said; {TURNED_DEG:g} degrees",
        reason == "ambiguous"
        and 0 < abs(turned - TURNED_DEG) < 0.05
        and any("rests" in each for each in warnings),
    )


def _turn_stone(workplace: Workplace) -> Outcome:
    """A worn stone has one pose: it merges from the turntable's angle without a warning."""
    session = _scan(workplace, "stone_1", "stone_2")
    record, warnings = _merge(session, "stone_2", "stone_1", start="turntable", angle=STEP_DEG)
    turned = record.pairs["stone_2"].turned_deg
    return Outcome(
        f"{turned:.3f} degrees, {len(warnings)} warnings",
        f"{STEP_DEG:g} degrees, none",
        0 < abs(turned - STEP_DEG) < 0.05 and not warnings,
    )


def _compare(
    session: Path, scan: str, mesh: Any, **options: Any
) -> tuple[NominalDeviation, list[str], str]:
    """Compare a scan with a mesh in a file; returns the record, warnings and why status is 1."""
    file, warnings = session.parent / "nominal.stl", list[str]()
    mesh.export(file)
    settings = compare.settings(scan, file, TOLERANCE, **options)
    found = compare.run(session, settings, warn=warnings.append)
    deviation = next(iter(found.values())).deviation
    assert deviation is not None
    return deviation, warnings, found.failure


def _judge_slot(workplace: Workplace) -> Outcome:
    """A slot that is missing on 15 % of a face: the part fails, and that with it passes."""
    session = _scan(workplace, "slot_good", "slot_missing")
    good, _, none = _compare(session, "slot_good", _block(True))
    bad, _, failure = _compare(session, "slot_missing", _block(True))
    assert good.verdict is not None and bad.verdict is not None
    numbers = bad.statistics_mm
    step = numbers.p_high - numbers.p_low
    return Outcome(
        f"with the slot {good.verdict.decision}, without {bad.verdict.decision}, up to"
        f" {numbers.p_high:.3f} mm",
        f"pass, fail, {DEPTH:g} mm less the best fit's part",
        good.verdict.decision == "pass"
        and bad.verdict.decision == "fail"
        and 0.7 * DEPTH < numbers.p_high < DEPTH + 0.1
        and step > DEPTH
        and bool(failure)
        and not none,
    )


def _judge_little(workplace: Workplace) -> Outcome:
    """A right part of which the scan holds a part: undecided, unless a smaller share is enough."""
    session = _scan(workplace, "slot_good")
    with Session.open(session) as store:
        surface = load_surface(Job(store), "slot_good")
    columns = np.cumsum(surface.measured.sum(axis=0))
    surface.points[:, columns > 0.6 * columns[-1]] = np.nan
    little, _, failure = _compare(session, "slot_good", _block(True), load=lambda store: surface)
    options = {"load": lambda store: surface, "min_area": 30.0}
    enough, *_ = _compare(session, "slot_good", _block(True), **options)
    assert little.verdict is not None and enough.verdict is not None
    return Outcome(
        f"{little.verdict.area:.0f} % measured: {little.verdict.decision}; with --min-area 30"
        f" {enough.verdict.decision}",
        "some 50 %: undecided; pass",
        30 < (little.verdict.area or 0) < 70
        and little.verdict.decision == "undecided"
        and enough.verdict.decision == "pass"
        and "90 %" in failure,
    )


def _open_block() -> Any:
    """Return the upper surfaces of the block, an open model."""
    block = _block(True)
    return block.submesh([np.flatnonzero(block.face_normals[:, 2] > -0.5)], append=True)


def _turned_case(change: Callable[[Any], Any], truth: str, turned: int) -> Case:
    """The case of a model some of whose triangles face the wrong way."""

    def case(workplace: Workplace) -> Outcome:
        session = _scan(workplace, "slot_good")
        found, warnings, _ = _compare(session, "slot_good", change(_open_block()))
        assert found.verdict is not None
        said = [each for each in warnings if "faced away" in each]
        rms = found.statistics_mm.rms
        return Outcome(
            f"{found.verdict.decision}, RMS {rms:.3f} mm; {said or 'nothing'} said",
            truth,
            found.verdict.decision == "pass"
            and 0.02 < rms < 0.06
            and len(said) == (turned > 0)
            and all(f"{turned} of " in each for each in said),
        )

    return case


def _invert(mesh: Any) -> Any:
    mesh.invert()
    return mesh


def _invert_bosses(mesh: Any) -> Any:
    """Turn the triangles of all but the largest body."""
    mesh.faces[len(mesh.faces) - 30 :] = mesh.faces[len(mesh.faces) - 30 :, ::-1]
    return mesh


def _judge_offset(workplace: Workplace) -> Outcome:
    """An open model, whose bosses alone are lower: the scan lies above it there, outside."""
    session = _scan(workplace, "slot_good")
    model = _open_block()
    model.vertices[model.vertices[:, 2] > HEIGHT + 1, 2] -= OFFSET
    found, *_ = _compare(session, "slot_good", model)
    assert found.verdict is not None
    highest = found.statistics_mm.p_high
    return Outcome(
        f"{found.verdict.decision}, up to {highest:+.3f} mm",
        f"fail, {OFFSET:+g} mm",
        found.verdict.decision == "fail" and 0.8 * OFFSET < highest < OFFSET + 0.15,
    )


def _measure_thin(workplace: Workplace) -> Outcome:
    """A plate between octagonal posts with markers all around, from both sides: its thickness."""
    post = trimesh.creation.cylinder(24 / np.cos(np.pi / 8), 120, sections=8)
    post.apply_transform(_turn(np.pi / 2, 0) @ _turn(np.pi / 8, 2))
    posts = [post.copy().apply_translation((x, 0, 0)) for x in (-65, 65)]
    square = np.array([[-7.0, -7, -24], [7, -7, -24], [7, 7, -24], [-7, 7, -24]])
    places = list(product((-65, 65), np.arange(8) * np.pi / 4, (-40, 0, 40)))
    turns = [rotation(np.array([0, angle, 0])) for _, angle, _ in places]
    corners = [square @ R.T + [x, y, 0] for R, (x, _, y) in zip(turns, places, strict=True)]
    facing = [-R[:, 2] for R in turns]
    half = THICKNESS / 2
    mesh = trimesh.util.concatenate([_box((-35, -35, -half), (35, 35, half)), *posts])
    clouds, markers, rng = {}, {}, np.random.default_rng(0)
    for deg in (0, 45, 90, 135, 180):
        R = rotation(np.array([0.15, 0, 0])) @ rotation(np.array([0, np.radians(deg), 0]))
        pose = Pose(R, np.array([0.0, 0, 600.0]))
        truth = Renderer(RIG, _scene(mesh, pose)).truth()
        noise = 0.03 * rng.normal(size=truth.points.shape[:2])[..., None]
        points = truth.points + noise * truth.points / truth.points[..., 2:]
        clouds[f"at_{deg}"] = Cloud(
            np.where(truth.mask[..., None], points, np.nan).astype(np.float32), "x", "stereo",
            np.where(truth.mask, 0.03, np.nan).astype(np.float32),
        )  # fmt: skip
        seen = np.flatnonzero(np.array(facing) @ R[2] < -0.5)
        placed = np.array([corners[k] @ R.T + pose.t for k in seen])
        placed += 0.05 * rng.normal(size=placed.shape)
        markers[f"at_{deg}"] = MeasuredMarkers(seen, placed, np.full(placed.shape[:2], 0.09))
    found = register_object(clouds, "at_0", Starts(markers=markers))
    fused = fuse(found.clouds, found.alignment.T_reference_scan)
    front = Pose(rotation(np.array([0.15, 0, 0])), np.array([0.0, 0, 600.0]))
    back = rigid_transform(front.R.T, -front.R.T @ front.t)
    points = move_points(back, fused.surface.points.astype(float))
    assert fused.surface.normals is not None
    inner = (np.abs(points) < [30, 30, 3 * THICKNESS]).all(axis=1)
    outward = fused.surface.normals @ front.R
    near, far = (inner & (sign * outward[:, 2] > 0.7) for sign in (-1, 1))
    thickness = float(points[far, 2].mean() - points[near, 2].mean())
    return Outcome(
        f"{thickness:.3f} mm, {near.sum()} and {far.sum()} points",
        f"{THICKNESS:g} mm",
        0 < abs(thickness - THICKNESS) < 0.1 and min(near.sum(), far.sum()) > 1000,
    )


def _turn(angle: float, axis: int) -> np.ndarray:
    """Return the rotation (4, 4) by an angle, rad, about a coordinate axis."""
    return rigid_transform(rotation(angle * np.eye(3)[axis]), np.zeros(3))


CASES: dict[str, Case] = {
    "studs moved by most of a pitch, from identity": _studs_case("stud"),
    "studs with one small lug, from identity": _studs_case("lug"),
    "a nut turned within its symmetry, from identity": _turn_nut,
    "a stone without symmetry, by its angle": _turn_stone,
    "a shallow slot that is missing": _judge_slot,
    "a right part of which half was measured": _judge_little,
    "an open model that faces inwards": _turned_case(_invert, "pass, and said", 56),
    "an open model partly facing inwards": _turned_case(_invert_bosses, "pass, and said", 30),
    "an open model that faces outwards": _turned_case(lambda mesh: mesh, "pass, nothing said", 0),
    "an open model whose bosses are lower": _judge_offset,
    "both sides of a thin plate joined by markers": _measure_thin,
}
