"""What files from outside can do to a reader: nothing but end in one sentence."""

import json
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from facts import raises

from slviewer import terminal
from slviewer.errors import DamagedError, InputError, SlviewerError
from slviewer.fringe.sequence import PatternSequence, parse_size
from slviewer.session import store
from slviewer.session.names import clean_label
from slviewer.session.nominal import read_nominal
from slviewer.session.reading import MAX_TOML_BYTES, expand_user, read_file, read_json, read_toml
from slviewer.session.results import read_meta

FAR_TOO_DEEP = (
    "[" * 100_000,
    '{"a":' * 100_000,
    '{"a": ' + "[" * 50 + "]" * 50 + "}",
    '{"a": 1' + "0" * 5000 + "}",
)
FOREIGN = (
    None,
    True,
    -1,
    1e308,
    float("inf"),
    10**30,
    "x",
    "",
    [],
    {},
    [[]],
    [None],
    {"a": {}},
    [1.5] * 3,
)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "circle", "sparse", "missing"])
def test_only_regular_files_of_limited_size_are_read(tmp_path, kind):
    path = tmp_path / "file.toml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "circle":
        path.symlink_to(path)
    elif kind == "sparse":
        with path.open("wb") as file:
            file.truncate(3 << 30)
    with pytest.raises(OSError):
        read_file(path, MAX_TOML_BYTES)
    with pytest.raises(InputError):
        read_toml(path)
    with pytest.raises(DamagedError):
        read_json(path)


@pytest.mark.parametrize(
    "text", [*FAR_TOO_DEEP, '{"a": "\\ud800"}', "a = " + "[" * 100_000, "a" + ".a" * 100_000 + "=1"]
)
def test_values_that_no_record_has_are_refused(tmp_path, text):
    path = tmp_path / "file"
    path.write_text(text)
    with pytest.raises(DamagedError):
        read_json(path)
    with pytest.raises(InputError):
        read_toml(path)


@pytest.mark.parametrize("element", ["[]", "{}", "[" * 29 + "]" * 29])
def test_containers_without_end_are_refused_before_they_take_memory(tmp_path, element):
    path = tmp_path / "file.json"
    path.write_text('{"a": [' + f"{element}," * (25_000_000 // len(element)) + "0]}")
    with raises(DamagedError, "file.json", "MB"):
        read_json(path)


def test_a_user_that_does_not_exist_is_named():
    with raises(InputError, "~nobody-of-that-name/x"):
        expand_user("~nobody-of-that-name/x")


@pytest.mark.parametrize("key", ["model", "inputs", "arrays", "checksums", "hash"])
@pytest.mark.parametrize("value", FOREIGN)
def test_an_entry_of_another_type_is_damage(session, key, value):
    session.save_result("calibration/stereo", {"model": {}, "inputs": {}}, {"K": np.eye(3)})
    path = session.folder / "results/calibration/stereo/meta.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    try:
        meta, arrays = session.load_result("calibration/stereo")
    except SlviewerError:
        return
    assert (
        isinstance(meta["model"], dict)
        and isinstance(meta["inputs"], dict)
        and isinstance(meta["hash"], str)
    )
    assert set(arrays) <= {"K"}


def test_an_entry_that_is_missing_is_damage(session):
    session.save_result("poses/one", {}, {})
    with raises(DamagedError, "poses/one", "'target'"):
        session.load_result("poses/one")[0]["target"]
    session.save_result("merge/1", {}, {})
    with raises(DamagedError, "merge/1", "reference"):  # of a record
        session.load_result("merge/1")


def test_inputs_that_form_a_circle_or_many_paths_are_examined_once(session, monkeypatch):
    names = [f"made/n{i}" for i in range(30)]
    for before, name in zip([None, *names], names, strict=False):
        inputs = {} if before is None else session.input_hashes(before)
        session.save_result(name, {"inputs": inputs}, {})
        session.save_result(f"{name}b", {"inputs": inputs}, {})
        session.save_result(name, {"inputs": session.input_hashes(f"{name}b") | inputs}, {})
    examined: Counter[Path] = Counter()
    monkeypatch.setattr(
        store, "read_meta", lambda folder: examined.update([folder]) or read_meta(folder)
    )
    assert session.state_of(names[-1]) in ("fresh", "stale")
    assert max(examined.values()) <= 2  # not once for each path
    path = session.folder / "results/made/n0/meta.json"
    meta = json.loads(path.read_text())
    path.write_text(json.dumps({**meta, "inputs": {"made/n0b": "x", "made/n29": "y"}}))
    assert session.state_of("made/n0") == "stale"


@pytest.mark.parametrize("shape", [(99_999_999_999,), (-1,), (3, 3, 3)])
def test_an_array_that_is_not_what_its_header_announces_is_damage(session, shape):
    session.save_result("made/one", {}, {"K": np.eye(3)})
    path = session.folder / "results/made/one/arrays/K.npy"
    data = path.read_bytes()
    path.write_bytes(data.replace(b"(3, 3)", str(shape).encode()[:40]))
    with pytest.raises(DamagedError):
        session.load_result("made/one")


@pytest.mark.parametrize(
    "key", ["excluded", "names", "model", "levels", "exposures", "rig", "measurement names"]
)
@pytest.mark.parametrize("value", [3, "x", ["x"], {"x": 3}, [float("inf")]])
def test_decisions_are_of_their_types(session, key, value):
    (session.folder / "decisions.json").write_text(json.dumps({key: value}))
    if (key, value) in (("model", "x"), ("rig", {"x": 3})):
        assert session.decision(key) == value
        return
    with raises(DamagedError, "decisions.json", key):
        session.decision(key)


@pytest.mark.parametrize("value", [*FOREIGN, float("nan"), 10**9, "1e30"])
@pytest.mark.parametrize("key", ["step", "steps", "bit", "bits", "period_px", "axis", "kind"])
def test_a_frame_has_numbers_in_range(key, value):
    frame = {"kind": "phase", "axis": "x", "step": 0, "steps": 4, "period_px": 20.0, key: value}
    try:
        sequence = PatternSequence.from_dict({"projector": "96x64", "frame": [frame]})
    except InputError:
        return
    assert len(sequence.frames) == 1


@pytest.mark.parametrize(
    "value", [float("inf"), [1e400, 2], "9" * 5000 + "x1", [[1], [2]], 10**9, "1000000x1000000"]
)
def test_a_size_is_two_numbers_in_range(value):
    with pytest.raises(InputError):
        parse_size(value)


def test_a_model_of_repeated_facets_is_welded(tmp_path):
    one = np.array([0, 0, 1, 0, 0, 0, 9, 0, 0, 0, 9, 0], "<f4").tobytes() + b"\0\0"
    (tmp_path / "same.stl").write_bytes(bytes(80) + (20_000).to_bytes(4, "little") + one * 20_000)
    assert len(read_nominal(tmp_path / "same.stl").mesh.faces) == 1
    facet = (
        b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1"
        b" 0\nendloop\nendfacet\n"
    )
    (tmp_path / "parts.stl").write_bytes(
        b"".join(b"solid s%d\n" % i + facet + b"endsolid\n" for i in range(3000))
    )
    assert len(read_nominal(tmp_path / "parts.stl").mesh.faces) == 1
    groups = b"".join(b"g g%d\nf 1 2 3\n" % i for i in range(3000))
    (tmp_path / "groups.obj").write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + groups)
    assert len(read_nominal(tmp_path / "groups.obj").mesh.faces) == 1


def test_what_is_printed_does_not_drive_the_terminal(capsys):
    terminal.print_message("pose\x1b[2J \u202eevil\u202c µm – ok\n2")
    assert capsys.readouterr().err == "pose\\x1b[2J \\u202eevil\\u202c µm – ok\n2\n"
    assert clean_label("  hall\u00a0 5 ") == "hall 5"
    with pytest.raises(InputError):
        clean_label("a\u202eb")
