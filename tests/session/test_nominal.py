"""Nominal models from files: read where they are sound, refused in words where they are not, never rescaled unasked."""

import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from slviewer.errors import InputError, SessionError
from slviewer.session import nominal
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
        assert len(found.mesh.faces) == len(BALL.faces) and len(found.mesh.vertices) == len(BALL.vertices)
        assert found.size_mm == pytest.approx([80, 80, 80], abs=1e-3) and "320 triangles, closed" in found.text()


def test_step_and_3mf_state_their_units(tmp_path: Path) -> None:
    plate = read_nominal(PLATE)  # 60 x 40 x 8 mm with a bore of radius 12, and a pin of radius 5 and height 6
    assert plate.closed and plate.units == "mm" and plate.notes == ("its surfaces were triangulated within 0.005 mm",)
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
    assert ball.units == "mm" and ball.closed and ball.size_mm == pytest.approx([80, 80, 80], abs=1e-3)
    with zipfile.ZipFile(model) as archive, zipfile.ZipFile(tmp_path / "inch.3mf", "w") as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    assert read_nominal(tmp_path / "inch.3mf").size_mm == pytest.approx([2032] * 3, abs=0.1)


@pytest.mark.parametrize("suffix", ["step", "3mf"])
def test_damaged_cad_models_are_refused(tmp_path: Path, suffix: str) -> None:
    BALL.export(tmp_path / "ball.3mf")
    whole = PLATE.read_bytes() if suffix == "step" else (tmp_path / "ball.3mf").read_bytes()
    for content in (b"", whole[: len(whole) // 2], whole.replace(b"CARTESIAN_POINT", b"CARTESIAN_PAINT"), b"PK" * 999):
        if content == whole:
            continue
        path = tmp_path / f"damaged.{suffix}"
        path.write_bytes(content)
        with pytest.raises(SessionError, match="export the model again"):
            read_nominal(path)


def test_triangles_are_turned_outwards_and_empty_ones_left_out_and_it_is_said(tmp_path: Path) -> None:
    mixed = BALL.copy()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    mixed.export(tmp_path / "mixed.ply")
    inside = BALL.copy()
    inside.invert()
    inside.export(tmp_path / "inside.stl")
    for name, word in (("mixed.ply", "turn one way"), ("inside.stl", "inwards")):
        found = read_nominal(tmp_path / name)
        assert found.closed and word in found.notes[0]
        a, b, c = (found.mesh.vertices[found.mesh.faces[:, k]] for k in range(3))
        assert (np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) > 0).all()
    faces = np.concatenate([BALL.faces, [[0, 0, 1], [2, 3, 3]]])
    trimesh.Trimesh(BALL.vertices, faces, process=False).export(tmp_path / "flat.ply")
    found = read_nominal(tmp_path / "flat.ply")
    assert len(found.mesh.faces) == 320 and "2 of 322 triangles" in found.notes[0]
    trimesh.Trimesh(BALL.vertices, BALL.faces[:200], process=False).export(tmp_path / "open.ply")
    assert not read_nominal(tmp_path / "open.ply").closed
    assert "open" in read_nominal(tmp_path / "open.ply").notes[0]


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
    assert (upwards == (a[:, 0] < 100)).all() and "were turned" in found.notes[0]


def hostile(folder: Path) -> dict[str, tuple[bytes, str]]:
    BALL.export(folder / "s.stl")
    BALL.export(folder / "p.ply")
    stl, ply = (folder / "s.stl").read_bytes(), (folder / "p.ply").read_bytes()
    body = ply.index(b"end_header\n") + 11
    ascii_header = (
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    )
    return {
        "short.stl": (stl[:-100], "no triangles"),
        "many.stl": (stl[:80] + struct.pack("<I", 2**32 - 1) + stl[84:], "no triangles"),
        "noise.stl": (os.urandom(5000), "no triangles"),
        "tiny.stl": (b"abc", "no triangles"),
        "empty.stl": (b"", "no triangles"),
        "half.stl": (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "no triangles"),
        "none.stl": (stl[:80] + struct.pack("<I", 0), "no triangles"),
        "short.ply": (ply[:-50], "damaged"),
        "many.ply": (ply.replace(b"element vertex 162", b"element vertex 99999999999"), "damaged"),
        "more.ply": (ply.replace(b"element face 320", b"element face 9999999999999999"), "damaged"),
        "list.ply": (ply[: body + 162 * 12] + b"\xff" * (len(ply) - body - 162 * 12), "cannot be read"),
        "text.ply": (BALL.export(file_type="ply", encoding="ascii")[:-50], "of 320 triangles"),
        "nan.ply": (ply[:body] + struct.pack("<f", np.nan) + ply[body + 4 :], "no numbers"),
        "far.ply": (ply[:body] + struct.pack("<f", 1e30) + ply[body + 4 :], "reaches 1e"),
        "endless.ply": (b"ply\n" + b"comment x\n" * 20_000, "cannot be read"),
        "wrong.ply": (ascii_header + b"3 0 1 77\n", "cannot be read"),
        "cloud.ply": (ascii_header.replace(b"face 1", b"face 0"), "no triangles"),
        "wrong.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read|missing"),
        "points.obj": (b"v 0 0 0\nv 1 0 0\n", "no triangles"),
        "part.step": (b"ISO-10303-21;", "no surfaces"),
        "part.iges": (b"S      1", "STL, PLY, OBJ, STEP or 3MF"),
    }


def test_damaged_and_hostile_files_are_refused_in_words(tmp_path: Path) -> None:
    for name, (content, said) in hostile(tmp_path).items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SessionError, match=said):
            read_nominal(tmp_path / name)
    with pytest.raises(SessionError):
        read_nominal(tmp_path / "absent.stl")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(SessionError):
        read_nominal(tmp_path / "folder.stl")


def test_files_that_a_model_names_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "trap.mtl")  # whoever opens it waits for ever
    text = "mtllib trap.mtl\nusemtl a\nv 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n"
    (tmp_path / "m.obj").write_text(text)
    assert len(read_nominal(tmp_path / "m.obj").mesh.faces) == 1


def test_size_and_triangles_are_limited_before_anything_is_loaded(tmp_path: Path, monkeypatch) -> None:
    with open(tmp_path / "large.stl", "wb") as file:
        file.truncate(nominal.MAX_BYTES + 1)  # sparse
    with pytest.raises(SessionError, match="268 MB"):
        read_nominal(tmp_path / "large.stl")
    monkeypatch.setattr(nominal, "MAX_TRIANGLES", 100)
    for name in ("many.stl", "many.ply", "many.obj"):
        BALL.export(tmp_path / name)
        with pytest.raises(SessionError, match=r"320.*100"):
            read_nominal(tmp_path / name)


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (25.4, "--units inch if it is so"),
        (1000.0, "--units m if"),
        (10.0, "--units cm if"),
        (0.1, "times smaller: see that it is the same part"),
        (100.0, "times larger: see that"),
        (0.001, r"138,564 mm across .* about 1,0\d\d times smaller"),
    ],
)
def test_other_units_are_asked_for_with_what_was_seen(tmp_path: Path, factor: float, said: str) -> None:
    scan = BALL.vertices.astype(np.float64)
    small = BALL.copy()
    small.apply_scale(1 / factor)
    small.export(tmp_path / "b.stl")
    with pytest.raises(InputError, match=said):
        check_size(read_nominal(tmp_path / "b.stl"), scan)
    check_size(read_nominal(tmp_path / "b.stl", "mm"), scan)  # the operator has said so
    assert read_nominal(tmp_path / "b.stl").size_mm.max() == pytest.approx(80 / factor, rel=1e-3)  # as it was


def test_units_that_are_given_are_taken(tmp_path: Path) -> None:
    small = BALL.copy()
    small.apply_scale(1 / 25.4)
    small.export(tmp_path / "b.stl")
    found = read_nominal(tmp_path / "b.stl", "inch")
    assert found.size_mm == pytest.approx([80, 80, 80], rel=1e-3)
    check_size(found, BALL.vertices)
    check_size(read_nominal(tmp_path / "b.stl"), BALL.vertices / 25.4 * 3)  # three times larger: a part of it, or more
