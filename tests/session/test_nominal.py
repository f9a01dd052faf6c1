"""Nominal models from files: read where they are sound, refused in words where they are not, never
rescaled unasked."""

import errno
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from facts import missing_facts, raises

from slviewer.errors import InputError, SessionError
from slviewer.session import nominal, polygons
from slviewer.session.nominal import check_size, read_nominal

PLATE = Path(__file__).with_name("plate.step")
BALL = trimesh.creation.icosphere(2, 40.0)


def test_every_format_gives_the_same_closed_mesh(tmp_path: Path) -> None:
    for name, options in {
        "a.stl": {},
        "b.ply": {},
        "c.obj": {},
        "d.ply": {"encoding": "ascii"},
        "e.stl": {"file_type": "stl_ascii"},
    }.items():
        BALL.export(tmp_path / name, **options)
        found = read_nominal(tmp_path / name)
        assert found.closed and not found.notes and found.units is None
        assert len(found.mesh.faces) == len(BALL.faces) and len(found.mesh.vertices) == len(
            BALL.vertices
        )
        assert found.size_mm == pytest.approx([80, 80, 80], abs=1e-3)
        assert missing_facts(found.text(), name, "320 triangles", "closed") == []


@pytest.mark.slow
@pytest.mark.process
def test_step_and_3mf_state_their_units(tmp_path: Path) -> None:
    # 60 x 40 x 8 mm with a bore of radius 12, and a pin of radius 5 and height 6
    plate = read_nominal(PLATE)
    assert plate.closed and plate.units == "mm" and len(plate.notes) == 1
    assert missing_facts(plate.notes[0], "0.005 mm") == []
    assert plate.size_mm == pytest.approx([60, 40, 14], abs=1e-5)
    x, y = plate.mesh.vertices[:, :2].T
    bore = np.hypot(x, y)[(np.hypot(x, y) < 13)]
    assert bore == pytest.approx(12, abs=1e-4)
    middles = plate.mesh.vertices[plate.mesh.faces].mean(axis=1)
    inside = middles[np.hypot(middles[:, 0], middles[:, 1]) < 12.01]
    assert 0.0005 < 12 - np.hypot(*inside[:, :2].T).min() < 0.006
    model = tmp_path / "ball.3mf"
    BALL.export(model)
    ball = read_nominal(model, "inch")
    assert (
        ball.units == "mm" and ball.closed and ball.size_mm == pytest.approx([80, 80, 80], abs=1e-3)
    )
    with zipfile.ZipFile(model) as archive, zipfile.ZipFile(tmp_path / "inch.3mf", "w") as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    assert read_nominal(tmp_path / "inch.3mf").size_mm == pytest.approx([2032] * 3, abs=0.1)


DAMAGE = {
    "cut short": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "misspelt": lambda data: data.replace(b"CARTESIAN_POINT", b"CARTESIAN_PAINT"),
    "of another kind": lambda data: b"PK" * 999,
    "a header alone": lambda data: b"ISO-10303-21;",
}


@pytest.mark.process
@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        pytest.param(suffix, name, marks=[] if name == "cut short" else pytest.mark.slow)
        for suffix in ("step", "3mf")
        for name in DAMAGE
        if (suffix, name) != ("3mf", "misspelt")  # a zip holds the word in no readable form
    ],
)
def test_damaged_cad_models_are_refused(tmp_path: Path, suffix: str, damage: str) -> None:
    BALL.export(tmp_path / "ball.3mf")
    whole = PLATE.read_bytes() if suffix == "step" else (tmp_path / "ball.3mf").read_bytes()
    path = tmp_path / f"damaged.{suffix}"
    path.write_bytes(DAMAGE[damage](whole))
    with raises(SessionError, path.name):
        read_nominal(path)


def test_triangles_are_turned_outwards_and_empty_ones_left_out_and_it_is_said(
    tmp_path: Path,
) -> None:
    mixed = BALL.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    mixed.export(tmp_path / "mixed.ply")
    inside = BALL.copy()
    inside.invert()
    inside.export(tmp_path / "inside.stl")
    for name, facts in (("mixed.ply", ("turned",)), ("inside.stl", ("inwards", "turned"))):
        found = read_nominal(tmp_path / name)
        assert (
            found.closed and len(found.notes) == 1 and missing_facts(found.notes[0], *facts) == []
        )
        a, b, c = (found.mesh.vertices[found.mesh.faces[:, k]] for k in range(3))
        assert (np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) > 0).all()
    faces = np.concatenate([BALL.faces, [[0, 0, 1], [2, 3, 3]]])
    trimesh.Trimesh(BALL.vertices, faces, process=False).export(tmp_path / "flat.ply")
    found = read_nominal(tmp_path / "flat.ply")
    assert (
        len(found.mesh.faces) == 320 and missing_facts(found.notes[0], "2 of 322 triangles") == []
    )
    trimesh.Trimesh(BALL.vertices, BALL.faces[:200], process=False).export(tmp_path / "open.ply")
    assert not read_nominal(tmp_path / "open.ply").closed
    assert missing_facts(read_nominal(tmp_path / "open.ply").notes[0], "open") == []


def test_an_open_model_keeps_the_side_that_most_of_it_faces(tmp_path: Path) -> None:
    cap = BALL.copy()
    cap.update_faces(cap.triangles_center[:, 2] > 25)
    cap.faces[0] = cap.faces[0, ::-1]  # the first one, which the others must not follow
    far = cap.copy()
    far.apply_translation([200, 0, 0])
    far.faces[:] = far.faces[:, ::-1]  # a part that faces inwards, and was meant to
    trimesh.util.concatenate([cap, far]).export(tmp_path / "caps.ply")
    found = read_nominal(tmp_path / "caps.ply")
    a, b, c = (found.mesh.vertices[found.mesh.faces[:, k]] for k in range(3))
    upwards = np.cross(b - a, c - a)[:, 2] > 0
    assert (upwards == (a[:, 0] < 100)).all() and missing_facts(found.notes[0], "turned") == []


def hostile(folder: Path) -> dict[str, tuple[bytes, str]]:
    BALL.export(folder / "s.stl")
    BALL.export(folder / "p.ply")
    stl, ply = (folder / "s.stl").read_bytes(), (folder / "p.ply").read_bytes()
    body = ply.index(b"end_header\n") + 11
    ascii_header = (
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty"
        b" float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0"
        b" 0\n0 1 0\n"
    )
    return {
        "short.stl": (stl[:-100], "320 triangles"),
        "many.stl": (stl[:80] + struct.pack("<I", 2**32 - 1) + stl[84:], "4,294,967,295 triangles"),
        "noise.stl": (os.urandom(5000), "triangles"),
        "tiny.stl": (b"abc", "0 triangles"),
        "empty.stl": (b"", "0 triangles"),
        "half.stl": (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "triangles"),
        "none.stl": (stl[:80] + struct.pack("<I", 0), "triangles"),
        "short.ply": (ply[:-50], "damaged"),
        "many.ply": (ply.replace(b"element vertex 162", b"element vertex 99999999999"), "damaged"),
        "more.ply": (
            ply.replace(b"element face 320", b"element face 9999999999999999"),
            "9,999,999,999,999,999",
        ),
        "list.ply": (ply[: body + 162 * 12] + b"\xff" * (len(ply) - body - 162 * 12), "damaged"),
        "text.ply": (BALL.export(file_type="ply", encoding="ascii")[:-50], "320"),
        "nan.ply": (ply[:body] + struct.pack("<f", np.nan) + ply[body + 4 :], "NaN"),
        "far.ply": (ply[:body] + struct.pack("<f", 1e30) + ply[body + 4 :], "1e+30 mm"),
        "endless.ply": (b"ply\n" + b"comment x\n" * 20_000, "damaged"),
        "wrong.ply": (ascii_header + b"3 0 1 77\n", "missing"),
        "cloud.ply": (ascii_header.replace(b"face 1", b"face 0"), "triangles"),
        "wrong.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "missing"),
        "points.obj": (b"v 0 0 0\nv 1 0 0\n", "triangles"),
        "part.iges": (b"S      1", "STEP"),
    }


def test_damaged_and_hostile_files_are_refused_with_the_reason(tmp_path: Path) -> None:
    for name, (content, fact) in hostile(tmp_path).items():
        (tmp_path / name).write_bytes(content)
        with raises(SessionError, name, fact):
            read_nominal(tmp_path / name)
    with raises(SessionError, "absent.stl", os.strerror(errno.ENOENT)):
        read_nominal(tmp_path / "absent.stl")
    (tmp_path / "folder.stl").mkdir()
    with raises(SessionError, "folder.stl"):
        read_nominal(tmp_path / "folder.stl")


def test_files_that_a_model_names_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "trap.mtl")  # whoever opens it waits for ever
    text = "mtllib trap.mtl\nusemtl a\nv 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n"
    (tmp_path / "m.obj").write_text(text)
    assert len(read_nominal(tmp_path / "m.obj").mesh.faces) == 1


def test_size_and_triangles_are_limited_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open(tmp_path / "large.stl", "wb") as file:
        file.truncate(nominal.MAX_BYTES + 1)  # sparse
    with raises(SessionError, "large.stl", "268 MB"):
        read_nominal(tmp_path / "large.stl")
    monkeypatch.setattr(polygons, "MAX_TRIANGLES", 100)
    for name in ("many.stl", "many.ply", "many.obj"):
        BALL.export(tmp_path / name)
        with raises(SessionError, name, 320, 100):
            read_nominal(tmp_path / name)


@pytest.mark.parametrize(
    ("factor", "facts"),
    [
        (25.4, ("--units inch", "--units mm", "5.46 mm")),
        (1000.0, ("--units m", "--units mm", "0.139 mm")),
        (10.0, ("--units cm", "--units mm", "13.9 mm")),
        (0.1, ("--units mm", "1,386 mm", "10.4 times smaller")),
        (100.0, ("--units mm", "1.39 mm", "96.2 times larger")),
        (0.001, ("--units mm", "138,564 mm", "1,040 times smaller")),
    ],
)
def test_other_units_are_asked_for_with_both_sizes(
    tmp_path: Path, factor: float, facts: tuple[str, ...]
) -> None:
    scan = BALL.vertices.astype(np.float64)
    small = BALL.copy()
    small.apply_scale(1 / factor)
    small.export(tmp_path / "b.stl")
    with raises(InputError, "b.stl", *facts):
        check_size(read_nominal(tmp_path / "b.stl"), scan)
    check_size(read_nominal(tmp_path / "b.stl", "mm"), scan)  # the operator has said so
    # as it was
    assert read_nominal(tmp_path / "b.stl").size_mm.max() == pytest.approx(80 / factor, rel=1e-3)


def test_units_that_are_given_are_taken(tmp_path: Path) -> None:
    small = BALL.copy()
    small.apply_scale(1 / 25.4)
    small.export(tmp_path / "b.stl")
    found = read_nominal(tmp_path / "b.stl", "inch")
    assert found.size_mm == pytest.approx([80, 80, 80], rel=1e-3)
    check_size(found, BALL.vertices)
    # three times larger: a part of it, or more
    check_size(read_nominal(tmp_path / "b.stl"), BALL.vertices / 25.4 * 3)
