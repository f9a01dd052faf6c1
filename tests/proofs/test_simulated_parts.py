"""Parts and their errors against independent figures."""

from typing import get_args

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from slviewer.geometry.rigid import move_points
from tests.proofs.drawn_parts import (
    LocalFault,
    Part,
    PartFeature,
    PartKind,
    PartSurface,
    UnsuitedPartError,
    draw_change,
    draw_part,
    solve_part_change,
)
from tests.proofs.part_cases import CaseSetup, make_case, plan_part_cases

PLATE = Part((-20.0, 20.0), (0.0,), 10.0, 5.0, False, False, 0)


def draw_suited(seed, kind, fault, size):
    for attempt in range(100):
        rng = np.random.default_rng([seed, attempt])
        try:
            part = draw_part(rng, kind)
            return part, solve_part_change(draw_change(rng, part, kind, fault), size * part.size)
        except UnsuitedPartError:
            continue
    raise AssertionError("no part suits")


def mesh_of(case):
    return case.nominal.vertices, case.nominal.faces


@pytest.mark.parametrize("kind", get_args(PartKind))
def test_parts_are_watertight_and_their_tops_open(kind) -> None:
    part, _ = draw_suited(1, kind, "extra", 0.01)
    for splits in (0, 1):
        closed = Part(**vars(part) | {"is_open": False, "splits": splits}).build()
        assert closed.is_watertight and closed.is_winding_consistent and closed.volume > 0
    opened = Part(**vars(part) | {"is_open": True}).build()
    assert not opened.is_watertight and opened.area < closed.area


def test_area_and_volume_follow_from_the_features() -> None:
    boss = PartFeature((-8.0, 1.0), (3.0, 2.0), 0.3, 4.0)
    slot = PartFeature((6.0, 0.0), (2.0, 1.0), -0.2, -np.inf)
    mesh = PLATE.add(boss).add(slot).build()
    assert mesh.volume == pytest.approx(40 * 20 * 5 + 6 * 4 * 4 - 4 * 2 * 5)
    walls = 2 * (40 + 20) * 5 + 2 * (6 + 4) * 4 + 2 * (4 + 2) * 5
    assert mesh.area == pytest.approx(2 * (40 * 20 - 4 * 2) + walls)
    steps = Part((-20.0, 0.0, 20.0), (0.0, 3.0), 10.0, 5.0, False, False, 1).build()
    assert steps.volume == pytest.approx(40 * 20 * 5 + 20 * 20 * 3)


@pytest.mark.parametrize("fault", get_args(LocalFault))
def test_local_faults_have_the_requested_size(fault) -> None:
    """Against the largest distance between dense samples of both surfaces."""
    kind = "slots" if fault == "turned" else "pins"
    part, (nominal, true) = draw_suited(2, kind, fault, 0.02)
    meshes = [Part(**vars(each) | {"splits": 0}).build() for each in (nominal, true)]
    clouds = [
        np.concatenate([m.vertices, trimesh.sample.sample_surface(m, 60_000, seed=3)[0]])
        for m in meshes
    ]
    away = [cKDTree(a).query(b)[0].max() for a, b in (clouds, clouds[::-1])]
    assert max(away) / part.size == pytest.approx(0.02, rel=0.15)


def test_cases_are_reproducible_and_balanced() -> None:
    setups = plan_part_cases(240, seed=5)
    assert setups == plan_part_cases(240, seed=5) != plan_part_cases(240, seed=6)
    for kind in get_args(PartKind):
        assert sum(s.kind == kind for s in setups) == 40
    one, two = make_case(setups[0]), make_case(setups[0])
    assert np.array_equal(one.points, two.points) and one.tolerance_mm == two.tolerance_mm


@pytest.mark.parametrize(("view", "source"), [("full", "imported"), ("three views", "own")])
def test_points_of_right_parts_lie_on_the_nominal(view, source) -> None:
    case = make_case(CaseSetup(3, 1, "pins", "none", 0.0, view, "none", source))
    nominal = trimesh.Trimesh(*mesh_of(case))
    _, away = PartSurface(nominal).closest(move_points(case.T_nominal_scan, case.points))
    assert np.sqrt(np.mean(away**2)) == pytest.approx(np.median(case.sigma_mm), rel=0.15)
    part = case.placed_at(case.T_nominal_scan)
    assert part.conforms and part.evidence == 0 and not part.in_view
    assert (case.views is None) == (source == "imported")


@pytest.mark.parametrize("fault", ["bent", "twisted", "scaled", "shrunk"])
def test_deformed_parts_have_the_requested_size(fault) -> None:
    case = make_case(CaseSetup(4, 2, "ribs", fault, 5.0, "full", "none", "imported"))
    nominal = trimesh.Trimesh(*mesh_of(case))
    _, away = PartSurface(nominal).closest(move_points(case.T_nominal_scan, case.points))
    assert np.sort(away)[-12] / case.tolerance_mm == pytest.approx(5, abs=1)
    assert case.placed_at(case.T_nominal_scan).in_view


def test_table_is_not_measured_below_the_part() -> None:
    setups = [CaseSetup(5, i, "pins", "none", 0.0, "full", "table", "imported") for i in range(20)]
    case = next(c for c in map(make_case, setups) if trimesh.Trimesh(*mesh_of(c)).is_watertight)
    points, vertices = move_points(case.T_nominal_scan, case.points), case.nominal.vertices
    is_low = points[:, 2] < vertices[:, 2].min() + case.tolerance_mm
    inner = np.abs(points[:, :2]) < vertices[:, :2].max(axis=0) - case.tolerance_mm
    assert 0.2 < is_low.mean() < 0.9
    assert not (is_low & inner.all(axis=1)).any()
