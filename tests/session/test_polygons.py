"""Models as other programs write them hold what their files say."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises

from slviewer.errors import SessionError
from slviewer.session.nominal import read_nominal
from slviewer.session.polygons import Polygons, triangulate_polygons
from tests.proofs.report_cases.case import Workplace
from tests.proofs.report_cases.models import CASES


@pytest.mark.parametrize("name", [name for name in CASES if not name.startswith("3mf")])
def test_a_reported_file_gives_its_volume_and_bodies(tmp_path: Path, name: str) -> None:
    outcome = CASES[name](Workplace(tmp_path, tmp_path))
    assert outcome.holds, outcome


@pytest.mark.process
def test_supports_are_named_and_skipped(tmp_path: Path) -> None:
    outcome = CASES["3mf-support"](Workplace(tmp_path, tmp_path))
    assert outcome.holds and missing_facts(outcome.measured, "object 2", "support") == []


def test_a_turned_polygon_with_collinear_corners_stays_closed(tmp_path: Path) -> None:
    ring = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)]
    n = len(ring)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    points = np.array([(x, y, z) for z in (0, 1) for x, y in ring]) @ turn.T
    faces = [list(range(n))[::-1], list(range(n, 2 * n))]
    faces += [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    lines = ["v {:.6g} {:.6g} {:.6g}".format(*p) for p in points]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    found = read_nominal(tmp_path / "a.obj")
    volume = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False).volume
    assert found.closed and not found.notes and volume == pytest.approx(5, rel=1e-4)


def test_polygons_that_are_not_flat_or_cross_themselves_are_named() -> None:
    skew = [(0, 0, 0), (9, 0, 0.3), (9, 9, 0), (0, 9, 0.3)]
    crossing = [(0, 0, 0), (9, 9, 0), (9, 0, 0), (0, 5, 0)]
    notes: list[str] = []
    vertices = np.array(skew + crossing)
    triangulate_polygons(Polygons(vertices, np.arange(8), np.array([4, 4])), notes)
    assert missing_facts(" ".join(notes), "1 of 2", "not flat", "0.3 mm", "cross") == []


def test_bytes_that_may_be_triangles_are_refused(tmp_path: Path) -> None:
    content = trimesh.creation.box().export(file_type="stl")
    (tmp_path / "a.stl").write_bytes(content + content[84:184])
    with raises(SessionError, "a.stl", "12 triangles", "14"):
        read_nominal(tmp_path / "a.stl")
