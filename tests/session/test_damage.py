"""What is on disk is what was saved, or it is named and not used."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr
from facts import missing_facts, raises

from slviewer.errors import CalibrationRejected, DamagedError, InputError, SessionError
from slviewer.pipeline import poses
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.examination import load_or_save_examination
from slviewer.pipeline.report import inspect
from slviewer.session.store import Session

DAMAGE = {
    "a zeroed frame": lambda data: bytes(len(data)),
    "zeros inside": lambda data: data[:300] + bytes(200) + data[500:],
    "one bit": lambda data: data[:700] + bytes([data[700] ^ 16]) + data[701:],
    "cut short": lambda data: data[:-7],
    "too long": lambda data: data + b"more",
    "empty": lambda data: b"",
    "missing": lambda data: None,
}


def damage_file(path: Path, damage: str) -> None:
    """Damage a file in place, or remove it."""
    data = DAMAGE[damage](path.read_bytes())
    path.unlink()
    if data is not None:
        path.write_bytes(data)


def save_as_older(session: Session, frames: np.ndarray) -> None:
    """Replace the stacks of all captures, of these frames, by the ones that older versions wrote:
    no checksums."""
    for capture in session.captures():
        stack = capture.folder / "frames.zarr"
        shutil.rmtree(stack)
        plain = zarr.create_array(
            stack,
            shape=frames.shape,
            dtype=frames.dtype,
            chunks=(1, *frames.shape[1:]),
            compressors=None,
        )
        plain[...] = frames


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_frame_is_named_and_never_used(session, sequence, frames, damage):
    capture = session.save_capture("pose_03", "scan", sequence, frames, source="")
    damage_file(capture.folder / "frames.zarr" / "c.2.0.0", damage)
    for read in (lambda: capture.frames, lambda: capture.stack([0, 2]), capture.verify):
        with raises(DamagedError, "pose_03", "frame 3 of 4", "c.2.0.0"):
            read()
    np.testing.assert_array_equal(capture.stack([0, 1, 3]), frames[[0, 1, 3]])


def test_a_damaged_frame_of_several_exposures_is_named(session, sequence, noise):
    capture = session.save_capture(
        "a", "scan", sequence, noise(1, 8), source="", exposures_ms=(2.0, 8.0)
    )
    damage_file(capture.folder / "frames.zarr" / "c.5.0.0", "zeros inside")
    with raises(DamagedError, "a", "frame 6 of 8", "c.5.0.0"):
        _ = capture.frames


@pytest.mark.parametrize(
    "damage", ["a zeroed frame", "zeros inside", "one bit", "cut short", "missing"]
)
def test_older_stacks_are_compared_with_their_hash_once(
    session, sequence, frames, damage, monkeypatch
):
    capture = session.save_capture("a", "scan", sequence, frames, source="")
    save_as_older(session, frames)
    verified = []
    whole = type(capture).verify
    monkeypatch.setattr(
        type(capture), "verify", lambda self: (verified.append(self.name), whole(self))
    )
    for _ in range(3):
        np.testing.assert_array_equal(session.load_capture("a").frames, frames)
    assert verified == ["a"]
    damage_file(capture.folder / "frames.zarr" / "c" / "2" / "0" / "0", damage)
    with raises(DamagedError, "captures/a"):
        _ = capture.frames


def test_a_changed_description_or_texture_is_damage(session, sequence, frames):
    colours = np.random.default_rng(3).integers(0, 255, (30, 40, 3), np.uint8)
    capture = session.save_capture("a", "scan", sequence, frames, source="", texture=colours)
    capture.verify()
    description, texture = capture.folder / "capture.json", capture.folder / "texture.png"
    saved = description.read_text()
    description.write_text(saved.replace("16.0", "17.0"))
    with raises(DamagedError, "captures/a", "hash"):
        session.load_capture("a").verify()
    description.write_text(saved)
    damage_file(texture, "zeros inside")
    with raises(DamagedError, "captures/a/texture.png"):
        _ = capture.texture


@pytest.mark.parametrize("damage", ["zeros inside", "one bit", "cut short", "missing"])
def test_a_damaged_array_of_a_result_is_named_and_computed_again(session, damage):
    arrays = {"a": np.arange(200.0), "b": np.zeros((0, 3)), "c": np.array(7)}
    session.save_result("clouds/x", {}, arrays)
    damage_file(session.folder / "results/clouds/x/arrays/a.npy", damage)
    with raises(DamagedError, "clouds/x", "array a"):
        session.load_result("clouds/x")
    assert session.decode_fresh("clouds/x", lambda *found: found) is None
    np.testing.assert_array_equal(session.load_result("clouds/x", only=["c"])[1]["c"], 7)


def test_results_without_checksums_are_read(session):
    session.save_result("a", {}, {"x": np.arange(3)})
    meta = session.folder / "results/a/meta.json"
    meta.write_text(meta.read_text().replace('"checksums"', '"other"'))
    np.testing.assert_array_equal(session.load_result("a")[1]["x"], np.arange(3))


def test_what_is_computed_from_a_capture_survives_its_own_damage(session, sequence, frames):
    capture = session.save_capture("a", "scan", sequence, frames, source="")
    examination = load_or_save_examination(session, capture)
    for text in ("", "{", "[]"):
        (session.folder / "results/trust/a/meta.json").write_text(text)
        assert session.decode_fresh("trust/a", lambda *found: found) is None
        assert load_or_save_examination(session, capture) == examination
        assert session.state_of("trust/a") == "fresh"


def test_a_damaged_pose_is_refused_and_the_others_are_read(session, sequence, frames, monkeypatch):
    for name in ("pose_1", "pose_2", "pose_3"):
        session.save_capture(name, "calibration", sequence, frames, source="")
    damage_file(session.folder / "captures/pose_2/frames.zarr/c.1.0.0", "zeros inside")
    monkeypatch.setattr(
        poses,
        "read_stored_pose",
        lambda store, capture, *_: poses.Judged(capture.name, None, "sound"),
    )
    monkeypatch.setattr(poses, "load_judged", lambda store, name, *_: None)
    judged = list(poses.read_stored_poses(session, session.capture_names(), None, None))
    assert [pose.name for pose in judged] == ["pose_1", "pose_2", "pose_3"]
    assert [pose.refused for pose in judged][::2] == ["sound", "sound"]
    assert missing_facts(judged[1].refused, "frame 2 of 4", "pose_2/frames.zarr/c.1.0.0") == []


@pytest.fixture
def untidy(session, sequence, frames):
    """A session with two sound captures beside a stray folder, a copy, and two damaged
    descriptions."""
    for name in ("a", "b", "pose_1", "pose_2"):
        session.save_capture(
            name, "calibration" if "pose" in name else "scan", sequence, frames, source=""
        )
    captures = session.folder / "captures"
    shutil.copytree(captures / "pose_1", captures / "pose_1 (copy)")
    (captures / "stray").mkdir()
    (captures / "pose_2" / "capture.json").write_text('{"role": "calib')
    (captures / "b" / "capture.json").write_text("{}")
    return session


def test_what_is_sound_opens_and_what_is_not_is_named(untidy):
    session = Session.open(untidy.folder)
    sound, faults = session.read_captures()
    assert (
        [capture.name for capture in sound]
        == ["a", "pose_1"]
        == [c.name for c in session.captures()]
    )
    assert session.capture_names("calibration") == ["pose_1"]
    assert set(faults) == {"b", "pose_1 (copy)", "pose_2", "stray"}
    for name, fault in faults.items():
        assert missing_facts(fault, session.folder / "captures" / name) == []
    assert set(session.taken_names()) == {"a", "b", "pose_1", "pose_2", *faults}
    for name in ("pose_2", "b"):
        with raises(DamagedError, name):
            session.load_capture(name)
    text = inspect(session.folder)
    assert missing_facts(text, "2 captures", *faults.values()) == []
    for name in ("pose_2", "stray"):  # a new capture never takes the place of what is there
        with raises(InputError, name, "--force"):
            untidy.save_capture(name, "scan", sound[0].sequence, sound[0].frames, source="")


def test_a_calibration_names_what_it_does_not_use(untidy):
    warnings = []
    untidy.close()
    with pytest.raises((CalibrationRejected, InputError)):
        calibrate.run(untidy.folder, CalibrateSettings("circles:7x5:20"), warn=warnings.append)
    assert any(missing_facts(warning, "captures/pose_2/capture.json") == [] for warning in warnings)


def test_check_reads_everything_and_lists_what_is_damaged(session, sequence, frames):
    for name in ("a", "b", "c"):
        session.save_capture(name, "scan", sequence, frames, source="")
    for name in ("clouds/a", "clouds/b"):
        session.save_result(name, {"x": float("nan"), "t": (1, 2.5)}, {"z": np.arange(100.0)})
    session.exclude("a", "why")
    assert missing_facts(inspect(session.folder, check=True), "3 captures", "2 results") == []
    damage_file(session.folder / "captures/b/frames.zarr/c.3.0.0", "a zeroed frame")
    damage_file(session.folder / "results/clouds/b/arrays/z.npy", "one bit")
    meta = session.folder / "results/clouds/a/meta.json"
    meta.write_text(meta.read_text().replace("2.5", "2.6"))
    (session.folder / "decisions.json").write_text("{")
    (session.folder / "captures/c/capture.json").write_text("")
    with pytest.raises(DamagedError) as damage:
        inspect(session.folder, check=True)
    lines = str(damage.value).splitlines()[1:]
    named = ["captures/c/capture.json", "decisions.json", "b: frame 4 of 4", "clouds/a", "clouds/b"]
    assert len(lines) == len(named) and all(
        name in line for name, line in zip(named, lines, strict=True)
    )


def test_check_finds_damage_of_older_sessions(session, sequence, frames):
    session.save_capture("a", "scan", sequence, frames, source="")
    save_as_older(session, frames)
    inspect(session.folder, check=True)
    damage_file(session.folder / "captures/a/frames.zarr/c/1/0/0", "one bit")
    with raises(SessionError, "captures/a", "hash"):
        inspect(session.folder, check=True)


def test_an_array_whose_header_ends_too_early_is_damaged(tmp_path: Path) -> None:
    """NumPy's reader of old headers raises an error of the tokenizer there."""
    with Session.create(tmp_path / "session") as store:
        store.save_result("edits/one", {}, {"0": np.arange(5)})
        file = tmp_path / "session/results/edits/one/arrays/0.npy"
        file.write_bytes(file.read_bytes().replace(b"}", b"{", 1))
        with raises(DamagedError, "edits/one", "array 0"):
            store.load_result("edits/one")
