"""Captures of two cameras: stored, verified and imported as one."""

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import DamagedError, InputError
from slviewer.pipeline.import_captures import find_captures
from slviewer.session.capture import NewCapture
from slviewer.session.store import Session


@pytest.fixture
def pair(noise, sequence):
    return NewCapture(
        "a", sequence, noise(1), second=NewCapture("a", sequence, noise(2)[:, :20, :30].copy())
    )


def test_what_both_cameras_saw_comes_back(session, pair):
    (saved,) = session.save_captures([pair], "scan")
    loaded = Session.open(session.folder).load_capture("a")
    assert loaded.hash == saved.hash == pair.hash
    assert loaded.second is not None and loaded.other_size == loaded.second.size == (30, 20)
    np.testing.assert_array_equal(loaded.frames, pair.frames)
    np.testing.assert_array_equal(loaded.second.frames, pair.second.frames)
    loaded.verify()


def test_the_hash_is_of_both_cameras(session, pair, noise, sequence):
    alone = NewCapture("a", sequence, noise(1))
    other = NewCapture("a", sequence, noise(1), second=NewCapture("a", sequence, noise(3)))
    assert len({alone.hash, other.hash, pair.hash}) == 3
    (saved,) = session.save_captures([alone], "scan")
    assert saved.second is None and saved.other_size == (96, 64)
    assert session.compare_capture(pair, "scan") == "different"


def test_damaged_frames_of_the_second_camera_are_noticed(session, pair):
    (saved,) = session.save_captures([pair], "scan")
    chunk, _ = saved.second.frame_file(2)
    data = bytearray(chunk.read_bytes())
    data[40] ^= 1
    chunk.write_bytes(data)
    with raises(DamagedError, "frame 3 of 4", "second"):
        saved.second.frames  # noqa: B018
    with raises(DamagedError, "second"):
        Session.open(session.folder).load_capture("a").verify()


def test_two_cameras_see_the_same_patterns(session, sequence, noise):
    other = NewCapture("a", sequence, noise(2)[:3])
    with raises(InputError, "3", "4"):
        session.save_captures([NewCapture("a", sequence, noise(1), second=other)], "scan")
    assert session.captures() == []


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ("bolt/L/{}.png", "bolt/R/{}.png", "bolt"),
        ("bolt/left/{}.png", "bolt/right/{}.png", "bolt"),
        ("bolt/cam0/{}.png", "bolt/cam1/{}.png", "bolt"),
        ("bolt_left/{}.png", "bolt_right/{}.png", "bolt"),
        ("bolt/{}_left.png", "bolt/{}_right.png", "bolt"),
    ],
)
def test_names_say_which_camera_files_are_of(tmp_path, noise, first, second, name):
    files = first.rpartition("/")[2].format("*")
    (tmp_path / "sequence.toml").write_text(
        'projector = "96x64"\n[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\n'
        f'period_px = 16.0\nfiles = "{files}"\n'
    )
    for seed, pattern in enumerate((first, second)):
        for k, frame in enumerate(noise(seed)):
            file = tmp_path / pattern.format(k)
            file.parent.mkdir(exist_ok=True, parents=True)
            cv2.imwrite(str(file), frame)
    source = tmp_path / "bolt" if first.count("/") == 2 else tmp_path
    imports = find_captures(source, sequence=tmp_path / "sequence.toml")
    (capture,) = imports
    assert capture.name == name
    np.testing.assert_array_equal(capture.frames, noise(0))
    np.testing.assert_array_equal(capture.second.frames, noise(1))
    assert any("two cameras" in each for each in imports.warnings)


def test_a_description_names_both_cameras(tmp_path, noise):
    entry = '[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\nperiod_px = 16.0\n'
    left, right = (
        f'{entry}camera = "{camera}"\nfiles = "{files}"\n'
        for camera, files in (("left", "A*.png"), ("right", "B*.png"))
    )
    described = tmp_path / "sequence.toml"
    described.write_text(f'projector = "96x64"\n{right}{left}')
    for seed, start in enumerate("AB"):
        for k, frame in enumerate(noise(seed)):
            cv2.imwrite(str(tmp_path / f"{start}{k}.png"), frame)
    cv2.imwrite(str(tmp_path / "other.png"), noise(0)[0])
    imports = find_captures(tmp_path, sequence=described)
    (capture,) = imports
    np.testing.assert_array_equal(capture.frames, noise(0))
    np.testing.assert_array_equal(capture.second.frames, noise(1))
    (warning,) = imports.warnings
    assert "other.png" in warning and "B0.png" not in warning
    (tmp_path / "B3.png").unlink()
    with raises(InputError, "B*.png", "3", "4"):
        find_captures(tmp_path, sequence=described)
    described.write_text(f'projector = "96x64"\n{left}{entry}files = "B*.png"\n')
    with raises(InputError, "camera", "[[frames]] 2"):
        find_captures(tmp_path, sequence=described)
    described.write_text(f'projector = "96x64"\n{left}{right.replace("steps = 4", "steps = 3")}')
    with raises(InputError, "left", "right"):
        find_captures(tmp_path, sequence=described)


def test_files_that_neither_camera_took_are_named(tmp_path, noise):
    (tmp_path / "sequence.toml").write_text(
        'projector = "96x64"\n[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\n'
        'period_px = 16.0\nfiles = "*_left.png"\n'
    )
    for seed, camera in enumerate(("left", "right")):
        for k, frame in enumerate(noise(seed)):
            cv2.imwrite(str(tmp_path / f"{k}_{camera}.png"), frame)
    cv2.imwrite(str(tmp_path / "other.png"), noise(0)[0])
    warnings = find_captures(tmp_path, sequence=tmp_path / "sequence.toml").warnings
    assert any("other.png" in each for each in warnings)
    assert not any("right.png" in each for each in warnings)


def test_poses_called_left_and_right_are_two_poses(tmp_path, noise):
    (tmp_path / "sequence.toml").write_text(
        'projector = "96x64"\norder = "name"\n[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\n'
        "period_px = 16.0\n"
    )
    for seed, name in enumerate(("left", "middle", "right")):
        (tmp_path / name).mkdir()
        for k, frame in enumerate(noise(seed)):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), frame)
    imports = find_captures(tmp_path)
    assert [each.name for each in imports.recordings] == ["left", "middle", "right"]
    assert all(each.second is None for each in imports.recordings)
