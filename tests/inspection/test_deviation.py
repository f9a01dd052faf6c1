"""Deviation from a nominal model: against analytic truth, and against the simulated object's own
mesh."""

import numpy as np
import pytest
import trimesh
from facts import raises

from slviewer.errors import InputError
from slviewer.inspection import nominal_pose
from slviewer.inspection.deviation import (
    EXCLUDED_COLOUR,
    Deviation,
    colour_limit,
    deviation,
    deviation_colours,
)
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.tolerance import judge_deviation
from slviewer.records.measurement import ToleranceVerdict
from slviewer.records.record import from_plain, to_plain
from slviewer.registration.refusal import Refused
from slviewer.simulation.boards import Pose
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.plans import rotation
from slviewer.surface.shapes import Mesh

NOISE = 0.04
POSE = Pose(rotation(np.radians([8.0, -5.0, 4.0])), np.array([-3.0, 4.0, 455.0]))


def looked_at(scene: MeshScene, width: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Exact points and normals (h, w, 3) that a camera sees."""
    u, v = np.meshgrid(np.linspace(-0.2, 0.2, width), np.linspace(-0.16, 0.16, round(0.8 * width)))
    seen = scene.trace(np.stack([u, v], -1))
    return seen.points, seen.normals


def noisy(points: np.ndarray, seed: int = 0) -> np.ndarray:
    return (
        points
        + points
        / points[..., 2:]
        * (NOISE * np.random.default_rng(seed).normal(size=points.shape[:2]))[..., None]
    )


@pytest.fixture(scope="module")
def ammonite() -> tuple[MeshScene, Mesh, np.ndarray, np.ndarray]:
    scene = demo_object(POSE)
    return scene, Mesh(scene.vertices, scene.triangles), *looked_at(scene)


@pytest.fixture(scope="module")
def found(ammonite) -> Deviation:
    _, nominal, points, normals = ammonite
    seen = np.isfinite(points[..., 0])
    return deviation(noisy(points)[seen], nominal, normals=normals[seen], sigma_mm=NOISE)


@pytest.mark.slow
@pytest.mark.computes
def test_the_simulated_object_deviates_from_its_own_mesh_by_its_noise(found, ammonite) -> None:
    _, _, points, normals = ammonite
    seen = np.isfinite(points[..., 0])
    towards = np.abs(np.sum(points / points[..., 2:] * normals, -1))[seen]
    expected = float(np.sqrt(np.mean((NOISE * towards) ** 2)))
    numbers = found.statistics()
    assert 0.93 * expected < numbers["rms"] < 1.05 * expected
    assert abs(numbers["mean"]) < 0.003 and numbers["left_out"] < 0.02 * numbers["points"]
    assert 1.8 * numbers["rms"] < numbers["within_95"] < 2.1 * numbers["rms"]
    assert 0.4 < found.coverage < 0.65 and len(found.uncovered)  # its back was not seen
    edges, counts = found.histogram()
    assert edges[0] == -edges[-1] and 0.99 * numbers["points"] < counts.sum() <= numbers["points"]


def test_the_best_fit_lies_within_microns_of_the_truth(found) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = POSE.R, POSE.t
    wrong = found.T_nominal_scan @ T
    assert np.linalg.norm(wrong[:3, 3]) < 0.02
    assert np.degrees(np.arccos((np.trace(wrong[:3, :3]) - 1) / 2)) < 0.01
    assert found.alignment_mm < 0.005


@pytest.mark.computes
def test_a_table_is_left_out_and_told(ammonite, found) -> None:
    _, nominal, points, normals = ammonite
    seen = np.isfinite(points[..., 0])
    scan, facing = noisy(points)[seen], normals[seen]
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(-150, 150, (4000, 2)), np.full(4000, 500.0)])
    together = np.concatenate([scan, table])
    normals = np.concatenate([facing, np.tile([0.0, 0.0, -1.0], (4000, 1))])
    again = deviation(together, nominal, normals=normals, initial=found.T_nominal_scan)
    assert again.statistics()["rms"] < 0.05
    left_out = ~again.counted[len(scan) :]
    assert left_out.mean() > 0.97 and again.reach_mm == pytest.approx(
        0.02 * NominalSurface(nominal).diagonal
    )


def bumped(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A box's top with a bump 0.1 mm high."""
    return 0.1 * np.clip(1.2 - np.hypot(x - 8, y - 4) / 4, 0, 1)


def box_scan(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Three sides of a box of 60 x 40 x 20 mm, with the bump on its top; points and normals."""
    rng = np.random.default_rng(2)
    a, b = rng.uniform(-0.5, 0.5, (2, 12_000))
    top = np.column_stack([60 * a, 40 * b, np.full(12_000, 10.0)])
    front, side = top[:4000] * [1, 0, 0], top[:4000] * [0, 1, 0]
    front[:, 1:] = np.column_stack([np.full(4000, -20.0), 20 * b[4000:8000]])
    side[:, [0, 2]] = np.column_stack([np.full(4000, 30.0), 20 * a[4000:8000]])
    points = np.concatenate([top, front, side])
    normals = np.repeat([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]], [12_000, 4000, 4000], axis=0)
    height = np.zeros(len(points))
    height[:12_000] = bumped(top[:, 0], top[:, 1])
    return points + normals * (height + noise * rng.normal(size=len(points)))[:, None], normals


def test_a_bump_of_a_tenth_is_seen_within_5_microns() -> None:
    box = trimesh.creation.box((60, 40, 20))
    points, normals = box_scan(0.01)
    R, t = rotation(np.radians([160.0, 10.0, 20.0])), np.array([10.0, -5.0, 480.0])
    found = deviation(
        points @ R.T + t,
        Mesh(box.vertices, box.faces),
        normals=normals @ R.T,
        initial=np.linalg.inv(_pose(R, t)),
        views=[np.zeros((1, 3))],
    )
    x, y = points[:12_000, 0] - 8, points[:12_000, 1] - 4
    plateau = np.hypot(x, y) < 0.7
    away = np.hypot(x, y) > 6
    height = np.nanmean(found.signed[:12_000][plateau]) - np.nanmean(found.signed[:12_000][away])
    assert height == pytest.approx(0.1, abs=0.005)
    verdict = judge_deviation(found, np.full(len(points), 0.01), 0.06)
    assert (
        verdict.decision == "fail" and verdict.highest[1] == "fail" and verdict.lowest[1] == "pass"
    )
    assert verdict.inside > 90 and 0.05 < verdict.outside < 5
    assert verdict.inside + verdict.outside + verdict.close == pytest.approx(100)
    assert from_plain(to_plain(verdict), ToleranceVerdict) == verdict
    assert judge_deviation(found, np.full(len(points), 0.01), 0.3).decision == "pass"
    assert (
        judge_deviation(found, np.full(len(points), 0.01), verdict.highest[0]).decision
        == "undecided"
    )


def test_a_verdict_needs_most_of_what_the_views_can_see() -> None:
    box = Mesh(*(lambda each: (each.vertices, each.faces))(trimesh.creation.box((60, 40, 20))))
    points, normals = box_scan(0.01)
    part = (points[:, 0] < 12) | (normals[:, 2] < 0.5)
    above = [np.array([[0.0, 0.0, 500.0], [200.0, 0.0, 450.0]])]
    initial = np.eye(4)
    for chosen, percent, decision in ((part, 73, "undecided"), (part | True, 100, "pass")):
        found = deviation(
            points[chosen], box, normals=normals[chosen], initial=initial, views=above
        )
        verdict = judge_deviation(found, np.full(chosen.sum(), 0.01), 0.3)
        assert verdict.area == pytest.approx(percent, abs=4) and verdict.decision == decision
        assert found.coverage < 0.7  # of all six sides
        lenient = judge_deviation(found, np.full(chosen.sum(), 0.01), 0.3, 60.0)
        assert lenient.decision == "pass"


def test_triangles_that_a_scan_shows_from_behind_are_turned() -> None:
    box = trimesh.creation.box((60, 40, 20))
    points, normals = box_scan(0.01)
    top = box.face_normals[:, 2] > 0.5
    for wrong in (top, np.ones(12, bool), np.zeros(12, bool)):
        faces = np.where(wrong[:, None], box.faces[:, ::-1], box.faces)
        surface = NominalSurface(Mesh(box.vertices, faces))
        turned = surface.seen_from_behind(points, normals, np.eye(4), 1.0)
        assert np.array_equal(turned, wrong)
    found = deviation(
        points, Mesh(box.vertices, box.faces[:, ::-1]), normals=normals, initial=np.eye(4)
    )
    assert found.turned == 12 and np.nanmax(found.signed[:12_000]) > 0.09  # the bump lies outside


@pytest.mark.slow
@pytest.mark.computes
def test_a_missing_step_does_not_keep_a_scan_from_its_place() -> None:
    low, high = trimesh.creation.box((120, 90, 20)), trimesh.creation.box((30, 20, 12))
    high.apply_translation((-40, 20, 15))
    rng = np.random.default_rng(3)
    x, y = rng.uniform([[-60], [-45]], [[60], [45]], (2, 20_000))
    on_boss = (np.abs(x + 40) < 15) & (np.abs(y - 20) < 10)
    z = np.where(on_boss, 21.0, 10.0) + np.where((np.abs(x - 20) < 20) & (y < 0), 0.5, 0.0)
    points = np.column_stack([x, y, z + 0.03 * rng.normal(size=len(x))])
    normals = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    R, t = rotation(np.radians([175.0, 12.0, 20.0])), np.array([10.0, -5.0, 480.0])
    part = trimesh.util.concatenate([low, high])
    found = deviation(points @ R.T + t, Mesh(part.vertices, part.faces), normals=normals @ R.T)
    wrong = found.T_nominal_scan @ _pose(R, t)
    assert np.abs(wrong[:2, 3]).max() < 1.5  # nothing but edges holds it there
    assert 0.35 < found.statistics()["p_high"] < 0.65


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("seed", range(41, 49))
def test_an_open_model_is_found_whichever_way_its_triangles_face(seed) -> None:
    rng = np.random.default_rng(seed)
    bodies = [trimesh.creation.box((120, 90, 10))]
    for x, y in ((-40, 25), (30, -20), (35, 25)):
        size = rng.uniform([15, 10, 16], [30, 25, 30])
        bodies.append(trimesh.creation.box(size))
        bodies[-1].apply_translation([x, y, size[2] / 2 - 3])
    body = trimesh.util.concatenate(bodies)
    upper = body.submesh([np.flatnonzero(body.face_normals[:, 2] > -0.5)], append=True)
    places, face = trimesh.sample.sample_surface(upper, 30_000, seed=seed)
    hidden = [(np.abs(places - each.centroid) < each.extents / 2 - 1e-6).all(1) for each in bodies]
    places, normals = (a[~np.any(hidden, axis=0)] for a in (places, upper.face_normals[face]))
    points = places + 0.03 * rng.normal(size=(len(places), 1)) * normals
    R = rotation(np.radians([180, *rng.uniform(-20, 20, 2)]))
    t = np.array([10.0, -5.0, 480.0])
    over = _pose(rotation(np.array([np.pi, 0, 0])), np.zeros(3))  # a plate lies so too
    for faces in (upper.faces, upper.faces[:, ::-1]):
        surface = NominalSurface(Mesh(upper.vertices, faces))
        found_T = nominal_pose.improve_pose(points, normals, surface, 0.03, over)
        assert np.abs(found_T - np.eye(4)).max() < 0.1
        found = deviation(points @ R.T + t, Mesh(upper.vertices, faces), normals=normals @ R.T)
        wrong = found.T_nominal_scan @ _pose(R, t)
        assert np.abs(wrong - np.eye(4)).max() < 0.02
        assert 0.028 < found.statistics()["rms"] < 0.032


@pytest.mark.slow
@pytest.mark.computes
def test_a_part_that_looks_alike_from_two_sides_is_placed_on_either() -> None:
    box = trimesh.creation.box((60, 40, 20))
    points, normals = box_scan(0.01)
    z = np.array([-0.5, 0.5, -0.7071])  # the camera sees all three sides
    x = np.cross([0.0, 1.0, 0.0], z)
    R = np.stack([x / np.linalg.norm(x), np.cross(z, x) / np.linalg.norm(x), z])
    scan, facing, nominal = (
        points @ R.T + [10, -5, 480],
        normals @ R.T,
        Mesh(box.vertices, box.faces),
    )
    # corners; a box has no front
    start = nominal_pose.search_pose(
        scan,
        facing,
        NominalSurface(nominal),
        None,
        lambda share: None,
        views=nominal_pose.VIEWS[-2:],
    )
    found = deviation(scan, nominal, normals=facing, initial=start)
    assert 0.0095 < found.statistics()["rms"] < 0.0125 and found.statistics()["left_out"] < 100


def _pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def test_signed_distances_are_those_of_a_box_inside_outside_and_round_its_corners() -> None:
    box = trimesh.creation.box((60, 40, 20))
    places = np.random.default_rng(0).uniform(-45, 45, (3000, 3))
    beyond = np.abs(places) - [30, 20, 10]
    true = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    away, normals = NominalSurface(Mesh(box.vertices, box.faces)).signed(places)
    assert np.abs(away - true).max() < 1e-3
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6
    moved, _ = NominalSurface(Mesh(box.vertices, box.faces)).signed(places + 1e-2 * normals)
    assert np.allclose((moved - away)[np.abs(away) > 0.1], 1e-2, atol=2e-3)


def test_an_open_nominal_has_two_sides_and_nothing_beyond_its_rim() -> None:
    sheet = Mesh([[-10, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]], [[0, 1, 2], [0, 2, 3]])
    surface = NominalSurface(sheet)
    away, _ = surface.signed(np.array([[0, 0, 0.3], [3, 4, -0.2], [12.0, 0, 0.1], [10.05, 0, 0.3]]))
    assert (
        away[:2] == pytest.approx([0.3, -0.2], abs=1e-5)
        and away[2] == np.inf
        and np.isfinite(away[3])
    )


def test_round_sharp_corners_of_a_closed_nominal_nothing_is_beyond() -> None:
    corners = np.array([[0, 0, 0], [60, 0, 0], [0, 40, 0], [60, 40, 0], [0, 0, 8], [0, 40, 8.0]])
    wedge = trimesh.convex.convex_hull(corners)
    edge = np.column_stack([np.full(50, 60.0), np.linspace(1, 39, 50), np.zeros(50)])
    for direction in ([1, 0, 0], [0.3, 0, -0.95], [0.4, 0, 0.92]):
        places = edge + 0.5 * np.array(direction) / np.linalg.norm(direction)
        away, normals = NominalSurface(Mesh(wedge.vertices, wedge.faces)).signed(places)
        assert away == pytest.approx(0.5, abs=1e-4)
        assert np.allclose(normals, (places - edge) / 0.5, atol=1e-3)


def test_a_scan_without_points_is_refused(ammonite) -> None:
    for points in (np.zeros((0, 3)), np.full((600, 3), np.nan)):
        with pytest.raises(InputError):
            deviation(points, ammonite[1], initial=np.eye(4))


def test_another_part_is_refused_without_refining_any_pose(ammonite, monkeypatch) -> None:
    monkeypatch.setattr(
        nominal_pose,
        "fit_pose",
        lambda *given, **options: pytest.fail("a pose was refined"),
    )
    _, _, points, normals = ammonite
    seen = np.isfinite(points[..., 0])
    box = trimesh.creation.box((120, 100, 70))
    other = NominalSurface(Mesh(box.vertices, box.faces))
    with raises(Refused, "nominal model", "%") as refusal:
        nominal_pose.search_pose(
            points[seen][::3],
            normals[seen][::3],
            other,
            None,
            lambda share: None,
            views=nominal_pose.VIEWS[:2],
        )
    assert refusal.value.reason == "overlap"
    with raises(InputError, "triangles"):
        NominalSurface(Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)))


def test_colours_run_from_blue_through_pale_to_red() -> None:
    blue, pale, red, more, unknown = deviation_colours(
        np.array([-0.1, 0.0, 0.1, 0.5, np.nan]), 0.1
    ).tolist()
    assert blue[2] > 2 * blue[0] and min(pale) > 200 and red[0] > 3 * red[2]
    assert more == red and tuple(unknown) == EXCLUDED_COLOUR
    assert colour_limit(np.array([np.nan, 1.0]), 0.2) == 0.2 and colour_limit(
        np.full(9, -0.3)
    ) == pytest.approx(0.3)
