"""Laws of every reader of files: any bytes and any values give a typed value or one of our errors,
nothing else."""

import functools
import html
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slviewer.errors import SlviewerError
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.accept import read_artefact
from slviewer.pipeline.certificate import read_certificate
from slviewer.pipeline.cloud_corrections import parse_region
from slviewer.pipeline.rig_choice import load_rig
from slviewer.printable import escape_controls
from slviewer.report.page import CERTIFICATE
from slviewer.server.credentials import load_tokens
from slviewer.session.exporters import write_calibration
from slviewer.session.importers.filestorage import read_storage
from slviewer.session.importers.frames import read_description
from slviewer.session.importers.images import read_image
from slviewer.session.inspection_plan import read_plan
from slviewer.session.nominal import read_nominal
from slviewer.session.ply import read_ply, write_ply
from slviewer.session.reading import read_toml
from slviewer.session.stack import FrameStack
from slviewer.session.store import Session
from slviewer.session.toml import format_value
from slviewer.simulation.assets import asset

settings.register_profile(
    "readers",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.load_profile("readers")

FEW, MANY = 8, 80
"""Examples of each law: by default, and in the slow tier."""


def law(
    few: int = FEW, many: int = MANY, **drawn: st.SearchStrategy[Any]
) -> Callable[[Callable[..., None]], Any]:
    """Decorate a test of drawn values: it is run on few examples, and a slow test of its name and
    `_often` on many."""

    def decorate(check: Callable[..., None]) -> Any:
        """Return the test of few examples, and define the other one."""
        often = settings(max_examples=many)(given(**drawn)(check))
        globals()[f"{check.__name__}_often"] = pytest.mark.slow(often)
        return settings(max_examples=few)(given(**drawn)(check))

    return decorate


_TEXTS = st.text(max_size=8) | st.sampled_from(["\x1b[2J", "\u202e", "~nobody", "../x", "9" * 500])
_NUMBERS = (
    st.floats()
    | st.integers()
    | st.sampled_from([10**30, 2**63, -1, 1e308, float("nan"), float("inf")])
)
_VALUES = st.recursive(
    st.none() | st.booleans() | _NUMBERS | _TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_TEXTS, inner, max_size=4),
    max_leaves=12,
)


def _read(read: Callable[[], Any]) -> Any:
    """Return what a reader returns; None where it raises one of our errors, whose message a
    terminal can show."""
    try:
        return read()
    except SlviewerError as error:
        text = escape_controls(str(error))
        assert text.strip() and all(c.isprintable() or c in "\n\t" for c in text)
        return None


@st.composite
def _damaged(draw: st.DrawFn, sound: Any) -> Any:
    """Draw plain values like ``sound`` ones, with one of them, at any depth, replaced or
    missing."""
    if not isinstance(sound, dict | list) or not sound or draw(st.integers(0, 9)) == 0:
        return draw(_VALUES)
    key = draw(st.sampled_from(sorted(sound) if isinstance(sound, dict) else range(len(sound))))
    copy = sound.copy()
    if draw(st.integers(0, 9)) == 0:
        del copy[key]
    else:
        copy[key] = draw(_damaged(sound[key]))
    return copy


def _damaged_bytes(sound: bytes) -> st.SearchStrategy[bytes]:
    """Return a strategy of any bytes, and of ``sound`` ones cut short or with some replaced."""
    cut = st.integers(0, len(sound)).map(lambda n: sound[:n])
    patch = st.tuples(st.integers(0, len(sound)), st.binary(max_size=6))
    return (
        st.binary(max_size=200)
        | cut
        | patch.map(lambda p: sound[: p[0]] + p[1] + sound[p[0] + len(p[1]) :])
    )


@pytest.fixture
def full(session: Session) -> Session:
    """A session with a capture, a decision and a result with an array."""
    sequence = PatternSequence((96, 64), tuple(phase_steps("x", 4, 96.0)))
    session.save_capture("scan", "scan", sequence, np.zeros((4, 6, 8), np.uint8), source="test")
    session.decide("excluded", {"scan": "dark"})
    session.decide("levels", [0, 255])
    quantities = [{"name": "x", "value": 1.0, "unit": "mm", "sigma": None, "whole": True}]
    feature = {"kind": "point", "place": [1.0, 2.0, 3.0], "direction": None, "radius": None}
    data = {
        "scale": 1.0,
        "quantities": quantities,
        "at": [3, 4],
        "feature": feature,
        "scatter": [],
        "calibration": "",
    }
    meta = {
        "kind": "point",
        "name": "a",
        "source": "scan",
        "model": "stereo",
        "time": "",
        "data": data,
        "of": [],
    }
    session.save_result(
        "measurements/m1", {**meta, "inputs": session.input_hashes("scan")}, {"K": np.eye(3)}
    )
    return session


def _use_capture(store: Session) -> None:
    """Use every entry of a capture."""
    capture = store.load_capture("scan")
    assert capture.frames.shape == (4, capture.size[1], capture.size[0]) and isinstance(
        capture.exposures_ms, tuple
    )


def _use_decisions(store: Session) -> None:
    """Use decisions."""
    assert all(isinstance(why, str) for why in store.excluded().values())
    assert all(0 <= level <= 255 for level in store.decision("levels") or ())


def _use_result(store: Session) -> None:
    """Use a result's meta and arrays, and its state."""
    meta, arrays = store.load_result("measurements/m1")
    assert isinstance(meta["name"], str) and all(
        isinstance(array, np.ndarray) for array in arrays.values()
    )
    assert store.state_of("measurements/m1") in ("fresh", "stale")


_RECORDS: dict[str, Callable[[Session], object]] = {
    "captures/scan/capture.json": _use_capture,
    "captures/scan/frames.zarr/zarr.json": _use_capture,
    "decisions.json": _use_decisions,
    "results/measurements/m1/meta.json": _use_result,
    "session.json": lambda store: Session.open(store.folder).close(),
}
_LISTED = {
    "changes": [
        ["results/measurements/m1", None, "trash/m1"],
        ["results/a", "results/.a.tmp-1-ab", None],
    ]
}


@law(data=st.data())
@pytest.mark.parametrize("name", _RECORDS)
def test_a_damaged_record_is_refused_or_typed(
    full: Session, name: str, data: st.DataObject
) -> None:
    path = full.folder / name
    sound = path.read_bytes()
    _RECORDS[name](full)
    damage = _damaged(json.loads(sound)).map(
        lambda values: json.dumps(values).encode()
    ) | _damaged_bytes(sound)
    path.write_bytes(data.draw(damage))
    try:
        _read(lambda: _RECORDS[name](full))
    finally:
        path.write_bytes(sound)


@law(data=st.data())
def test_a_damaged_array_is_refused_or_read(full: Session, data: st.DataObject) -> None:
    path = full.folder / "results/measurements/m1/arrays/K.npy"
    sound = path.read_bytes()
    path.write_bytes(data.draw(_damaged_bytes(sound)))
    _read(lambda: _use_result(full))
    _read(lambda: full.load_result("measurements/m1", only=["K"]))
    path.write_bytes(sound)


@law(data=st.data())
def test_a_damaged_list_of_changes_is_finished_or_discarded(
    tmp_path: Path, data: st.DataObject
) -> None:
    """And nothing beside the session changes."""
    folder = Path(tempfile.mkdtemp(dir=tmp_path)) / "session"
    Session.create(folder).close()
    (folder.parent / "results").mkdir()
    sound = json.dumps(_LISTED).encode()
    damage = _damaged(_LISTED).map(lambda values: json.dumps(values).encode()) | _damaged_bytes(
        sound
    )
    (folder / ".together.new-1-ab").write_bytes(data.draw(damage))
    Session.open(folder, write=True).close()
    assert not list(folder.glob(".together*")) and len(list(folder.parent.iterdir())) == 2


@law(data=_damaged({"shape": [4, 6, 8]}))
def test_a_stack_is_never_larger_than_its_files(full: Session, data: Any) -> None:
    path = full.folder / "captures/scan/frames.zarr/zarr.json"
    sound = path.read_text()
    path.write_text(json.dumps({**json.loads(sound), **(data if isinstance(data, dict) else {})}))
    described = _read(lambda: FrameStack.open(path.parent))
    path.write_text(sound)
    assert described is None or all(1 <= extent <= 1 << 16 for extent in described.shape)


def _asset(name: str) -> dict[str, Any]:
    """Return the tables of a TOML file that comes with the program."""
    kind, _, file = name.partition("/")
    return read_toml(asset(kind) / file)


_FRAMES = [
    frame.to_dict() | {"file": f"{i}.png"} for i, frame in enumerate(phase_steps("x", 3, 96.0))
]
_SPHERE = {
    "name": "ball",
    "kind": "sphere",
    "region": {"kind": "ball", "centre": [0.0, 0.0, 500.0], "size": [150.0]},
}
_SIZE = {
    "name": "d",
    "kind": "diameter",
    "features": ["ball"],
    "nominal": 250.0,
    "lower": 249.0,
    "upper": 251.0,
}
_PLAN = {
    "version": 1,
    "name": "plan",
    "alignment": {"kind": "none"},
    "feature": [_SPHERE],
    "characteristic": [_SIZE],
}
_BOX = {
    "centre_mm": [0.0, 0.0, 600.0],
    "size_mm": [9.0, 9.0, 9.0],
    "rotation_deg": [0.0, 10.0, 0.0],
}
_TABLES: dict[str, tuple[dict[str, Any], Callable[[Path], object]]] = {
    "frames": ({"projector": "96x64", "phase_sign": 1, "frame": _FRAMES}, read_description),
    "artefact": (_asset("artefacts/sphere_196.toml"), read_artefact),
    "rig": (_asset("rigs/simulated.toml"), load_rig),
    "plan": (_PLAN, read_plan),
    "region": (_BOX, lambda path: parse_region(str(path))),
    "tokens": ({"operate": "o" * 20, "watch": "w" * 20}, load_tokens),
    "any": ({"a": {"b": [1]}}, read_toml),
}


@law(data=st.data())
@pytest.mark.parametrize("name", _TABLES)
def test_a_damaged_table_is_refused_or_typed(
    tmp_path: Path, name: str, data: st.DataObject
) -> None:
    sound, read = _TABLES[name]
    path = tmp_path / "table.toml"
    path.touch(0o600)
    path.write_bytes(_to_toml(sound))
    read(path)
    values = data.draw(_damaged(sound) | _damaged_bytes(_to_toml(sound)))
    path.write_bytes(values if isinstance(values, bytes) else _to_toml(values))
    _read(lambda: read(path))


def _to_toml(values: Any) -> bytes:
    """Return values, without those that TOML has not, as TOML."""

    def known(value: Any) -> Any:
        """Return a value that TOML can hold."""
        if isinstance(value, dict):
            return {key: known(each) for key, each in value.items() if each is not None}
        return (
            [known(each) for each in value if each is not None]
            if isinstance(value, list)
            else value
        )

    table = (
        known(values)
        if isinstance(values, dict)
        else {"a": known(values if values is not None else "")}
    )
    return "".join(
        f"{format_value(key)} = {format_value(value)}\n" for key, value in table.items()
    ).encode()


@law(data=st.data())
@pytest.mark.parametrize("kind", ["ply", "stl", "obj", "png", "tif", "nominal.ply"])
def test_a_damaged_file_of_points_or_pixels_is_refused_or_read(
    tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    path = tmp_path / f"file.{kind}"
    points = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 3]])
    read: Callable[[Path], Any]
    if kind in ("png", "tif"):
        sound, read = (
            cv2.imencode(f".{kind}", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes(),
            read_image,
        )
    elif kind == "stl":
        facets = np.zeros(
            2, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        )
        facets["corners"] = points[faces]
        sound, read = bytes(80) + (2).to_bytes(4, "little") + facets.tobytes(), read_nominal
    elif kind == "obj":
        sound, read = b"v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 2 3\nf 1 2 4\n", read_nominal
    else:
        write_ply(path, points, faces=faces)
        sound, read = path.read_bytes(), read_ply if kind == "ply" else read_nominal
    path.write_bytes(sound)
    read(path)
    path.write_bytes(data.draw(_damaged_bytes(sound)))
    _read(lambda: read(path))


_CERTIFIED = {
    **{
        "schema": 1,
        "session": "s",
        "software": {},
        "results": {},
        "figures": {"verify/a": {"rms_mm": 1.0}},
    },
    "captures": {"a": {"role": "scan", "hash": "0", "frames": ["0"]}},
}


@law(data=st.data())
def test_a_damaged_certificate_is_refused_or_typed(tmp_path: Path, data: st.DataObject) -> None:
    def page(values: Any) -> bytes:
        """Return a page with these values as its certificate."""
        return html.escape(json.dumps(values)).join(CERTIFICATE).encode()

    path = tmp_path / "report.html"
    path.write_bytes(page(_CERTIFIED))
    read_certificate(path)
    path.write_bytes(data.draw(_damaged(_CERTIFIED).map(page) | _damaged_bytes(page(_CERTIFIED))))
    _read(lambda: read_certificate(path))


@functools.cache
def _make_sound_file(kind: str) -> bytes:
    """Return a sound file of this kind; cached, because a 3MF file holds random UUIDs and varies in
    size."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"file.{kind}")
        if kind in ("yml", "json"):
            write_calibration(path, {"K": np.eye(3)})
        elif kind == "step":
            shutil.copy(Path(__file__).parent / "plate.step", path)
        else:
            trimesh.creation.box((10, 20, 30)).export(path)
        return path.read_bytes()


@law(few=2, many=5, data=st.data())
@pytest.mark.process
@pytest.mark.parametrize(
    "kind",
    ["yml", "json", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("step", "3mf"))],
)
def test_a_damaged_file_that_another_process_parses_is_refused_or_read(
    tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    path = tmp_path / f"file.{kind}"
    read: Callable[[Path], Any] = read_storage if kind in ("yml", "json") else read_nominal
    path.write_bytes(data.draw(_damaged_bytes(_make_sound_file(kind))))
    _read(lambda: read(path))
