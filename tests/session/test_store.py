"""Captures, results and decisions: what goes in comes out, and what contradicts itself is
refused."""

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import zarr
from facts import missing_facts, raises

from slviewer.errors import Cancelled, InputError, SessionError
from slviewer.fringe.sequence import Frame
from slviewer.session.capture import NewCapture
from slviewer.session.store import Session


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_capture_comes_back_as_it_was(session, sequence, noise, dtype):
    frames = noise(2, dtype=dtype)
    frames[1] = 0  # Zarr leaves out chunks that are all fill value
    colours = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (30, 40, 3), dtype)
    saved = session.save_capture(
        "pose_1",
        "calibration",
        sequence,
        frames,
        source="camera 1",
        texture=colours,
        settings={"exposure_ms": 8},
    )
    loaded = Session.open(session.folder).load_capture("pose_1")
    assert loaded == saved
    assert (loaded.role, loaded.sequence, loaded.size) == ("calibration", sequence, (40, 30))
    assert loaded.meta["settings"] == {"exposure_ms": 8} and loaded.meta["source"] == "camera 1"
    assert loaded.frames.dtype == dtype and loaded.frames.flags.c_contiguous
    np.testing.assert_array_equal(loaded.frames, frames)
    np.testing.assert_array_equal(loaded.stack([3, 0, 3]), frames[[3, 0, 3]])
    np.testing.assert_array_equal(loaded.texture, colours)


def test_other_programs_read_the_frames_as_zarr(session, sequence, frames):
    strided = np.repeat(frames, 2, axis=2)[..., ::2]
    folder = session.save_capture("a", "scan", sequence, strided, source="").folder
    array = zarr.open_array(folder / "frames.zarr", mode="r")
    assert array.metadata.zarr_format == 3 and array.chunks == (1, 30, 40)
    np.testing.assert_array_equal(array[...], frames)


def test_a_stack_with_folders_for_each_frame_is_read_too(session, sequence, frames):
    saved = session.save_capture("a", "scan", sequence, frames, source="")
    stack = saved.folder / "frames.zarr"
    shutil.rmtree(stack)
    older = zarr.create_array(
        stack,
        shape=frames.shape,
        dtype=frames.dtype,
        chunks=(1, *frames.shape[1:]),
        compressors=None,
    )
    older[...] = frames
    assert (stack / "c" / "0" / "0" / "0").is_file()
    np.testing.assert_array_equal(session.load_capture("a").frames, frames)


def test_names_are_counted_and_safe(session, sequence, frames):
    for name in ("pose_10", "pose_2", "flat"):
        session.save_capture(
            name, "calibration" if "pose" in name else "scan", sequence, frames, source=""
        )
    assert session.capture_names() == ["flat", "pose_2", "pose_10"]
    assert [capture.name for capture in session.captures("calibration")] == ["pose_2", "pose_10"]
    for name in ("", "a/b", "../a", ".hidden", "a b", "-a", "a.", "é", "a\n", "x" * 200):
        with pytest.raises(InputError):
            session.save_capture(name, "scan", sequence, frames, source="")
    with raises(InputError, "'pose_3'", "flat, pose_2, pose_10"):
        session.load_capture("pose_3")


@pytest.mark.parametrize(
    ("role", "bad", "texture", "facts"),
    [
        ("scan", lambda frames: frames[:3], None, ("3 frames", 4)),
        ("scan", lambda frames: frames[0], None, ("(n, h, w)", "(30, 40)")),
        ("scan", lambda frames: frames.astype(np.float32), None, ("float32", "uint8", "uint16")),
        ("scan", lambda frames: frames[:, :0], None, ("(n, h, w)", "(4, 0, 40)")),
        ("pose", lambda frames: frames, None, ("'pose'", "'calibration'", "'scan'")),
        (
            "scan",
            lambda frames: frames,
            np.zeros((30, 40), np.uint8),
            ("texture", "(30, 40, 3)", "(30, 40)"),
        ),
    ],
)
def test_frames_that_do_not_fit_are_refused(session, sequence, frames, role, bad, texture, facts):
    with raises(InputError, *facts):
        session.save_capture("a", role, sequence, bad(frames), source="", texture=texture)
    assert session.capture_names() == [] and not list((session.folder / "captures").iterdir())


def test_a_taken_name_is_refused_and_the_replaced_capture_is_in_the_trash(
    session, sequence, frames
):
    first = session.save_capture("a", "scan", sequence, frames, source="")
    with raises(InputError, "'a'", "--force"):
        session.save_capture("a", "scan", sequence, frames[::-1], source="")
    np.testing.assert_array_equal(first.frames, frames)
    session.save_capture("a", "scan", sequence, frames[::-1], source="", force=True)
    np.testing.assert_array_equal(session.load_capture("a").frames, frames[::-1])
    with pytest.raises(SessionError):
        first.stack()
    (trashed,) = (session.folder / "trash").iterdir()
    np.testing.assert_array_equal(zarr.open_array(trashed / "frames.zarr", mode="r")[...], frames)


def test_the_hash_follows_everything_that_is_decoded(session, sequence, frames):
    hashes = {
        session.save_capture(name, "scan", said, stack, source=name).hash
        for name, said, stack in (
            ("a", sequence, frames),
            ("b", replace(sequence, phase_sign=-1), frames),
            ("c", sequence, frames[::-1]),
            ("d", sequence, frames.reshape(4, 40, 30)),
            ("e", sequence, frames),
        )
    }
    assert len(hashes) == 4


def test_captures_are_saved_all_or_none(session, sequence, frames, noise):
    def source(fails: bool) -> Iterator[NewCapture]:
        for i in range(3):
            yield NewCapture(f"pose_{i}", sequence, noise(i), None, "elsewhere", {"i": i})
        if fails:
            raise InputError("pose_3 is unreadable")

    with pytest.raises(InputError):
        session.save_captures(source(True), "calibration")
    assert not list((session.folder / "captures").iterdir())
    saved = session.save_captures(source(False), "calibration", board="circles:21x16:9")
    assert [capture.name for capture in saved] == ["pose_0", "pose_1", "pose_2"]
    np.testing.assert_array_equal(saved[2].frames, noise(2))
    assert saved[2].meta["settings"] == {"i": 2} and saved[2].meta["board"] == "circles:21x16:9"
    with pytest.raises(InputError):
        session.save_captures(
            [NewCapture("new", sequence, frames, None, ""), *source(False)], "calibration"
        )
    with pytest.raises(InputError):
        session.save_captures([NewCapture("new", sequence, frames, None, "")] * 2, "calibration")
    assert session.capture_names() == ["pose_0", "pose_1", "pose_2"]


@pytest.mark.parametrize(
    "damage", ["missing chunk", "short chunk", "other layout", "no json", "half json", "empty json"]
)
def test_damage_is_an_error_and_never_a_black_frame(session, sequence, frames, damage):
    folder = session.save_capture("a", "scan", sequence, frames, source="").folder
    chunk, array, meta = (
        folder / "frames.zarr/c.2.0.0",
        folder / "frames.zarr/zarr.json",
        folder / "capture.json",
    )
    if damage == "missing chunk":
        chunk.unlink()
    elif damage == "short chunk":
        chunk.write_bytes(chunk.read_bytes()[:-7])
    elif damage == "other layout":
        array.write_text(array.read_text().replace('"bytes"', '"gzip"'))
    elif damage == "no json":
        meta.unlink()
    elif damage == "half json":
        meta.write_bytes(meta.read_bytes()[:100])
    else:
        meta.write_text("{}")
    with pytest.raises(SessionError):
        _ = session.load_capture("a").frames


def test_frames_outside_the_stack_are_refused(session, sequence, frames):
    capture = session.save_capture("a", "scan", sequence, frames, source="")
    for index in (-1, 4):
        with raises(InputError, f"[{index}]", "4 frames"):
            capture.stack([index])
    assert capture.stack([]).shape == (0, 30, 40)


def test_results_come_back_and_replace_each_other(session):
    arrays = {
        "x/coefficients": np.arange(30.0).reshape(5, 2, 3),
        "mask": np.array([[True, False]]),
        "empty": np.zeros((0, 3), np.float32),
        "number": np.float64(np.nan),
        "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
    }
    for version in (1, 2):
        session.save_result(
            "calibration/pixelwise",
            {"version": version, "rms": np.float32(0.5), "inputs": {}},
            arrays,
        )
    meta, loaded = session.load_result("calibration/pixelwise")
    assert meta["version"] == 2 and meta["rms"] == 0.5
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)
    assert list(session.load_result("calibration/pixelwise", only=["mask"])[1]) == ["mask"]
    assert session.result_names() == ["calibration/pixelwise"]
    assert [path.name for path in (session.folder / "results/calibration").iterdir()] == [
        "pixelwise"
    ]
    with pytest.raises(InputError):
        session.load_result("calibration/pixelwise", only=["y"])
    with raises(InputError, "'calibration/stereo'", "calibration/pixelwise"):
        session.load_result("calibration/stereo")
    for name in ("calibration", "calibration/pixelwise/more", "../a", "calibration//a"):
        with pytest.raises(InputError):
            session.save_result(name, {}, {})
    with pytest.raises(InputError):
        session.save_result("other", {}, {"a": np.array([None])})
    session.trash_result("calibration/pixelwise")
    assert session.state_of("calibration/pixelwise") == "absent"


def test_a_damaged_array_is_an_error(session):
    session.save_result("a", {}, {"z": np.arange(100.0)})
    path = session.folder / "results/a/arrays/z.npy"
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(SessionError):
        session.load_result("a")


def test_a_result_is_stale_when_any_of_its_inputs_is(session, sequence, frames):
    session.save_capture("pose_1", "calibration", sequence, frames, source="")
    session.save_capture("scan_1", "scan", sequence, frames, source="")
    session.save_result(
        "calibration/stereo", {"inputs": session.input_hashes("pose_1")}, {"K": np.eye(3)}
    )
    session.save_result(
        "clouds/scan_1", {"inputs": session.input_hashes("scan_1", "calibration/stereo")}, {}
    )
    session.save_result("made/elsewhere", {}, {})
    results = ("calibration/stereo", "clouds/scan_1", "made/elsewhere")
    assert [session.state_of(name) for name in results] == ["fresh"] * 3

    session.save_capture("pose_1", "calibration", sequence, frames, source="", force=True)
    assert [session.state_of(name) for name in results] == ["fresh"] * 3  # the same frames again
    session.save_capture("pose_1", "calibration", sequence, frames[::-1], source="", force=True)
    assert [session.state_of(name) for name in results] == ["stale", "stale", "fresh"]
    session.save_result(
        "calibration/stereo", {"inputs": session.input_hashes("pose_1")}, {"K": np.eye(3)}
    )
    assert [session.state_of(name) for name in results] == ["fresh", "stale", "fresh"]
    session.exchange({"pose_1": None})
    assert session.state_of("calibration/stereo") == "stale"
    with raises(InputError, "'pose_1'"):
        session.input_hashes("pose_1")


def test_decisions_are_kept(session, sequence, frames):
    for name in ("a", "b"):
        session.save_capture(name, "calibration", sequence, frames, source="")
    session.exclude("a", "the board moved")
    session.exclude("b", "blurred")
    session.include("b")
    assert Session.open(session.folder).excluded() == {"a": "the board moved"}
    with pytest.raises(InputError):
        session.exclude("c", "there is none")


def test_decisions_of_any_kind_stand_beside_each_other(session, sequence, frames):
    session.save_capture("a", "calibration", sequence, frames, source="")
    assert session.decision("target") is None
    session.decide("target", "circles:21x16:9")
    session.exclude("a", "blurred")
    session.decide("rig", {"driver": "simulated", "scale": 0.5})
    again = Session.open(session.folder)
    assert again.decision("target") == "circles:21x16:9" and again.decision("rig")["scale"] == 0.5
    assert again.excluded() == {"a": "blurred"}


def test_work_that_was_given_up_saves_nothing(session, sequence, frames):
    session.save_capture("a", "calibration", sequence, frames, source="")
    given_up = []

    def allow():
        if given_up:
            raise Cancelled("given up")

    work = session.guarded(allow)
    work.save_result("early", {}, {"x": np.ones(2)})
    given_up.append(True)
    for save in (
        lambda: work.save_result("late", {}, {"x": np.ones(2)}),
        lambda: work.decide("target", "other"),
        lambda: work.exchange({"a": None}),
    ):
        with pytest.raises(Cancelled):
            save()
    assert session.result_names() == ["early"] and session.capture_names() == ["a"]
    session.save_result("mine", {}, {})
    assert [p.name for p in (session.folder / "results").iterdir() if p.name.startswith(".")] == []


@pytest.mark.process
def test_one_writer_and_any_number_of_readers(session, sequence, frames):
    session.save_capture("a", "scan", sequence, frames, source="")
    with raises(SessionError, session.folder, f"process {os.getpid()}", socket.gethostname()):
        Session.open(session.folder, write=True)
    code = f"""
import sys
from slviewer.errors import SessionError
from slviewer.session.store import Session
print(len(Session.open({str(session.folder)!r}).load_capture("a").frames))
try:
    Session.open({str(session.folder)!r}, write=True)
except SessionError as error:
    print(error)
"""
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert (
        said.startswith("4\n")
        and missing_facts(said, f"process {os.getpid()}", socket.gethostname()) == []
    )
    reader = Session.open(session.folder)
    for change in (
        lambda: reader.save_capture("b", "scan", sequence, frames, source=""),
        lambda: reader.save_result("b", {}, {}),
        lambda: reader.exclude("a", "why"),
        lambda: reader.exchange({"a": None}),
    ):
        with pytest.raises(SessionError):
            change()
    session.close()
    with Session.open(session.folder, write=True) as next_writer:
        next_writer.exclude("a", "why")
    with pytest.raises(SessionError):
        session.exclude("a", "closed already")


def test_folders_that_are_no_session(tmp_path):
    with raises(SessionError, tmp_path, "session.json", "slviewer import"):
        Session.open(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SessionError):
        Session.create(tmp_path)
    with pytest.raises(SessionError):
        Session.create(tmp_path / "notes.txt" / "session")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_sessions_from_elsewhere(tmp_path):
    folder = tmp_path / "s"
    Session.open_or_create(folder).close()
    Session.open_or_create(folder).close()
    with pytest.raises(SessionError):
        Session.create(folder)
    about = folder / "session.json"
    good = json.loads(about.read_text())
    about.write_text(json.dumps({**good, "schema": 3}))
    with raises(SessionError, folder, "schema 3", 2):
        Session.open(folder)
    about.write_text(json.dumps({**good, "schema": "one"}))
    with raises(SessionError, about, "schema"):
        Session.open(folder, write=True)
    about.write_bytes(b'{"schema": 1, "cre')
    with pytest.raises(SessionError):
        Session.open_or_create(folder)


def test_a_sequence_with_every_kind_survives(session, sequence, noise):
    mixed = replace(
        sequence,
        frames=(
            *sequence.frames,
            Frame("gray", "x", bit=0, bits=1),
            Frame("complementary", "x"),
            Frame("texture"),
        ),
        gray_origin_px=1.25,
    )
    session.save_capture("a", "scan", mixed, noise(1, 7), source="")
    assert session.load_capture("a").sequence == mixed


def test_a_session_of_the_first_schema_is_read_and_raised_when_it_is_saved_in(
    session, sequence, frames
):
    path = session.folder / "session.json"
    described = json.loads(path.read_text())
    assert described["schema"] == 2
    session.save_capture("a", "scan", sequence, frames, source="")
    path.write_text(json.dumps({**described, "schema": 1}))
    session.close()
    with Session.open(session.folder, write=True) as store:
        assert store.capture_names() == ["a"] and json.loads(path.read_text())["schema"] == 1
        store.save_capture("b", "scan", sequence, frames, source="")
    assert json.loads(path.read_text()) == described
