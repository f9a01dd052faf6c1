"""Meshing: closed or refused, holes by their size, and every change told in mm."""

import numpy as np
import pytest
import trimesh
from ball_scans import RADIUS, around, ball, off, rms
from facts import missing_facts, raises

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.reconstruction.cloud import Cloud
from slviewer.surface.edit import decimate, drop_small_parts, fill_holes, smooth
from slviewer.surface.fuse import fuse
from slviewer.surface.implicit import trim_far_patches, volume_surface
from slviewer.surface.meshing import (
    TRIANGLES_PER_POINT,
    BuiltMesh,
    MeshingPlan,
    build_mesh,
    grid_mesh,
    measure_spacing,
)
from slviewer.surface.shapes import Mesh, PointSet, analyse_topology, select_faces

pytestmark = pytest.mark.computes

VOLUME = 4 / 3 * np.pi * RADIUS**3


@pytest.fixture(scope="module")
def points() -> PointSet:
    return fuse(*around()).surface


@pytest.fixture(scope="module")
def closed(points: PointSet) -> BuiltMesh:
    return build_mesh(points, MeshingPlan(watertight=True))


@pytest.fixture(scope="module")
def open_points() -> PointSet:
    return fuse(*around(without=("bottom",))).surface


def test_scans_all_around_close(points: PointSet, closed: BuiltMesh) -> None:
    assert closed.topology.watertight and closed.topology.faults() == ""
    assert closed.topology.volume_mm3 == pytest.approx(VOLUME, rel=2e-3)
    assert rms(off(closed.mesh.vertices)) < rms(off(points.points)) < 0.04
    assert (
        closed.mesh.colours is not None
        and closed.mesh.sigma_mm is not None
        and closed.mesh.normals is not None
    )
    outwards = (closed.mesh.normals * closed.mesh.vertices).sum(axis=1) / RADIUS
    assert np.percentile(outwards, 1) > 0.98
    assert (
        missing_facts(closed.text(), "watertight", f"{closed.topology.volume_mm3 / 1000:.2f} cm3")
        == []
    )
    assert closed.to_json()["watertight"] is True


def test_a_mesh_has_no_more_triangles_than_the_points_hold(
    points: PointSet, closed: BuiltMesh
) -> None:
    plan = MeshingPlan(triangles=10**7, watertight=True)
    whole = build_mesh(points, plan)
    most = TRIANGLES_PER_POINT * len(points)
    assert whole.thinned is None and len(whole.mesh.faces) > most >= len(closed.mesh.faces)
    assert closed.thinned is not None and closed.thinned.before == len(whole.mesh.faces)
    # far below the noise, which is 0.03 mm or so
    assert 0 < closed.thinned.rms_mm < 0.1 * rms(off(points.points))
    assert missing_facts(closed.text(), f"{closed.thinned.rms_mm:.4f} mm") == []


@pytest.mark.slow
def test_what_no_scan_saw_stays_open_or_is_closed_as_asked(open_points: PointSet) -> None:
    plain = build_mesh(open_points)
    assert len(plain.topology.openings_mm) == 1 and not plain.topology.watertight
    across = plain.topology.openings_mm[0]
    assert 20 < across < 75
    with raises(SlviewerError, "1 opening"):
        build_mesh(open_points, MeshingPlan(fill_holes_mm=0.8 * across, watertight=True))
    wide = build_mesh(open_points, MeshingPlan(fill_holes_mm=1.2 * across))
    assert wide.topology.watertight and wide.trimmed is not None
    assert wide.trimmed.filled == 1 and 0.01 < wide.trimmed.imagined < 0.15
    assert wide.topology.volume_mm3 == pytest.approx(VOLUME, rel=0.03)
    assert missing_facts(wide.text(), f"{100 * wide.trimmed.imagined:.1f} %") == []


def test_what_floats_where_nothing_was_measured_goes_whatever_holes_are_filled(
    points: PointSet,
) -> None:
    ball = trimesh.creation.icosphere(4, RADIUS)
    n = len(ball.vertices)
    two = Mesh(
        np.concatenate([ball.vertices, ball.vertices + np.array([200, 0, 0])]),
        np.concatenate([ball.faces, ball.faces + n]),
    )
    kept, report = trim_far_patches(two, points, measure_spacing(points), np.inf)
    assert len(kept.faces) == len(ball.faces) and (report.filled, report.imagined, report.cut) == (
        0,
        0.0,
        1,
    )


@pytest.mark.slow
def test_a_foot_is_closed_flat() -> None:
    """What stood on a table was not measured from below, and its sides lean outwards there: no
    balloon grows on it."""
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(5, RADIUS)
    directions = ball.vertices[ball.vertices[:, 2] > -0.5 * RADIUS] / RADIUS
    points = PointSet(RADIUS * directions + rng.normal(0, 0.01, directions.shape), directions)
    found = build_mesh(points, MeshingPlan("poisson", watertight=True))
    assert found.trimmed is not None and (found.trimmed.filled, found.trimmed.flattened) == (1, 1)
    cap = np.pi * RADIUS**3 * (0.5**2 * (3 - 0.5)) / 3
    beyond = 3.0 * measure_spacing(points)  # so far the surface still counts as measured
    assert (
        VOLUME - cap
        < found.topology.volume_mm3
        < VOLUME - cap + beyond * np.pi * (0.87 * RADIUS) ** 2
    )
    assert found.mesh.vertices[:, 2].min() > -0.5 * RADIUS - beyond
    assert missing_facts(found.text(), "flat") == []


def test_one_side_alone_is_not_closed() -> None:
    with pytest.raises(SlviewerError):
        build_mesh(ball(300.0, 0.03, 0), MeshingPlan(watertight=True))


@pytest.mark.slow
def test_a_volume(points: PointSet) -> None:
    found = build_mesh(points, MeshingPlan("volume", fill_holes_mm=6.0))
    assert found.topology.watertight and found.topology.volume_mm3 == pytest.approx(
        VOLUME, rel=3e-3
    )
    assert rms(off(found.mesh.vertices)) < 0.04
    # whatever thread is first
    one, other = (volume_surface(points, found.cell_mm) for _ in range(2))
    assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)


def test_a_scans_grid_ends_where_depth_jumps() -> None:
    v, u = np.mgrid[:60, :80].astype(float)
    z = np.where(u < 40, 300.0, 330.0)
    points = np.stack([(u - 40) / 400 * z, (v - 30) / 400 * z, z], axis=2)
    mesh = grid_mesh(
        Cloud(points, "x", "stereo", np.full(z.shape, 0.02), np.full(z.shape, 90, np.uint8))
    )
    depths = mesh.vertices[mesh.faces][..., 2]
    assert np.ptp(depths, axis=1).max() == 0 and set(np.unique(depths)) == {300.0, 330.0}
    assert mesh.normals is not None and np.allclose(mesh.normals, [0, 0, -1], atol=1e-3)
    assert mesh.sigma_mm is not None and np.allclose(mesh.sigma_mm, 0.02, rtol=0.05)
    assert len(analyse_topology(mesh).openings_mm) == 2  # the rims of two sheets


def sheet(holes: list[tuple[slice, slice]]) -> Mesh:
    v, u = np.mgrid[:40, :50].astype(float)
    points = np.stack([u, v, np.full(u.shape, 600.0)], axis=2)
    index = np.arange(2000).reshape(40, 50)
    kept = np.ones((39, 49), bool)
    for hole in holes:
        kept[hole] = False
    a, b, c, d = (
        index[s][kept] for s in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return select_faces(Mesh(points.reshape(-1, 3), faces), np.ones(len(faces), bool))


def test_holes_are_filled_up_to_their_size() -> None:
    # the first and last share a corner
    mesh = sheet([np.s_[5:8, 5:8], np.s_[20:30, 20:30], np.s_[8:10, 8:10]])
    assert analyse_topology(mesh).openings_mm == pytest.approx((62.6, 14.1, 4.2, 2.8), rel=0.05)
    filled, report = fill_holes(mesh, 5.0)
    assert (report.holes, report.left) == (2, 2) and report.largest_mm == pytest.approx(
        4.2, rel=0.05
    )
    found = analyse_topology(filled)
    assert len(found.openings_mm) == 2 and not found.crowded and not found.turned
    assert filled.normals is not None and np.allclose(filled.normals[:, 2], filled.normals[0, 2])
    assert fill_holes(mesh, 1.0)[1] == type(report)(0, 0.0, 4)


def test_small_parts_go(closed: BuiltMesh) -> None:
    chip = Mesh([[90, 0, 0], [91, 0, 0], [90, 1, 0]], [[0, 1, 2]])
    n = len(closed.mesh.vertices)
    both = Mesh(
        np.concatenate([closed.mesh.vertices, chip.vertices]),
        np.concatenate([closed.mesh.faces, chip.faces + n]),
    )
    # it is large, for all that the other is larger
    assert drop_small_parts(both, 0.1)[1].parts == 0
    cleaned, report = drop_small_parts(both, 1.0)
    assert len(cleaned.faces) == len(closed.mesh.faces) and report.parts == 1
    assert report.largest_mm2 == pytest.approx(0.5)


@pytest.mark.slow
def test_decimating_and_smoothing_report_how_far_they_moved_the_surface(closed: BuiltMesh) -> None:
    thinned, report = decimate(closed.mesh, 3000)
    assert 2900 <= len(thinned.faces) <= 3000 and analyse_topology(thinned).watertight
    assert 0.001 < report.rms_mm < 0.2 and report.rms_mm < report.max_mm < 1.0
    assert thinned.colours is not None and thinned.sigma_mm is not None
    small = Mesh(0.01 * closed.mesh.vertices, closed.mesh.faces)
    assert decimate(small, 3000)[1].rms_mm == pytest.approx(0.01 * report.rms_mm, rel=0.1)
    rough = Mesh(
        closed.mesh.vertices + np.random.default_rng(0).normal(0, 0.1, closed.mesh.vertices.shape),
        closed.mesh.faces,
    )
    calm, moved = smooth(rough, 10)
    assert rms(off(calm.vertices)) < 0.8 * rms(off(rough.vertices))
    assert 0.01 < moved.rms_mm < 0.1 < moved.max_mm < 1.0
    assert analyse_topology(calm).volume_mm3 == pytest.approx(VOLUME, rel=5e-3)


def test_what_is_wrong_with_a_mesh_is_said(closed: BuiltMesh) -> None:
    faces = closed.mesh.faces
    inside_out = analyse_topology(Mesh(closed.mesh.vertices, faces[:, ::-1]))
    assert (
        inside_out.volume_mm3 < 0 and missing_facts(inside_out.faults(), "normals", "inwards") == []
    )
    turned = faces.copy()
    turned[10] = turned[10, ::-1]
    assert (
        missing_facts(analyse_topology(Mesh(closed.mesh.vertices, turned)).faults(), "3 edges")
        == []
    )
    crowded = np.concatenate([faces, [[faces[0, 0], faces[0, 1], faces[len(faces) // 2, 0]]]])
    assert (
        missing_facts(analyse_topology(Mesh(closed.mesh.vertices, crowded)).faults(), "1 edges")
        == []
    )
    assert (
        missing_facts(analyse_topology(Mesh(closed.mesh.vertices, faces[1:])).faults(), "1 opening")
        == []
    )


def test_refusals(points: PointSet) -> None:
    with pytest.raises(InputError):
        build_mesh(points, MeshingPlan("grid"))
    with raises(InputError, "normals"):
        build_mesh(PointSet(points.points))
    with raises(InputError, "NaN"):
        build_mesh(PointSet(np.full((300, 3), np.nan), np.zeros((300, 3))))
    for plan in ({"triangles": 2}, {"smooth": -1}, {"fill_holes_mm": float("nan")}):
        with raises(UsageError, "give a number from"):
            MeshingPlan(**plan)
