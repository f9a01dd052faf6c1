"""Recordings as rigs: sessions and imported folders, one capture after another."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError, SessionError
from slviewer.fringe.presets import complementary
from slviewer.pipeline.rig_choice import reel
from slviewer.session.exporters import write_pattern_folder
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

SEQUENCE = complementary((64, 48), 4, 16.0)
N = len(SEQUENCE.frames)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "session"
    with Session.create(folder) as store:
        for number in (1, 2):
            frames = np.random.default_rng(number).integers(0, 255, (N, 30, 40), np.uint8)
            store.save_capture(f"scan_{number}", "scan", SEQUENCE, frames, source="")
    return folder


def frames_of(folder: Path, name: str) -> np.ndarray:
    with Session.open(folder) as store:
        return store.load_capture(name).frames


def seen(rig, k: int) -> np.ndarray:
    frame = np.empty((30, 40), np.uint8)
    rig.projector.show(k)
    rig.camera.grab(frame)
    return frame


def test_a_session_is_played_in_order_and_again(recorded: Path):
    played = reel(recorded)
    assert played.names == ["scan_1", "scan_2"] and played.sequence == SEQUENCE
    with played.rig.opened() as rig:
        for name in ("scan_1", "scan_2", "scan_1"):
            rig.projector.load(played.sequence)
            np.testing.assert_array_equal(seen(rig, 3), frames_of(recorded, name)[3])
            played.advance()


def test_one_capture_is_played_again_and_again(recorded: Path):
    played = reel(recorded, capture="scan_2")
    played.advance()
    with played.rig.opened() as rig:
        rig.projector.load(played.sequence)
        np.testing.assert_array_equal(seen(rig, 0), frames_of(recorded, "scan_2")[0])
    with raises(InputError, "scan_3", "scan_1", "scan_2"):
        reel(recorded, capture="scan_3")


@pytest.mark.computes
def test_a_folder_of_images_is_played_by_its_toml(tmp_path: Path):
    write_pattern_folder(tmp_path / "patterns", SEQUENCE)
    toml = tmp_path / "patterns" / "sequence.toml"
    images = tmp_path / "shot_1"
    images.mkdir()
    for file in sorted((tmp_path / "patterns").glob("*.png")):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(images / file.name), image // 2 + 20)
    played = reel(images, sequence=toml)
    assert len(played.names) == 1 and played.sequence.projector == (64, 48)
    assert played.rig.camera.size == (64, 48)


def test_folders_that_hold_nothing_are_refused(tmp_path: Path, recorded: Path):
    with raises(InputError, "p18", "procam-calibration"):
        reel(tmp_path)
    with raises(InputError, "sequence"):
        reel(tmp_path, layout="frames")
    with raises(InputError, "'films'"):
        reel(tmp_path, layout="films")  # type: ignore[arg-type]
    with raises(SessionError):
        reel(tmp_path, layout="session")
    with Session.create(tmp_path / "empty"):
        pass
    with raises(InputError, "empty"):
        reel(tmp_path / "empty")


@pytest.mark.computes
def test_the_wizard_captures_what_is_played(recorded: Path, tmp_path: Path):
    with Operator(tmp_path / "session", {"driver": "replay", "source": str(recorded)}) as operator:
        assert operator.wait_for(lambda s: s.rig.state == "open", 120.0) is not None
        assert operator.choose_target("circles:11x9:14")
        for _ in range(2):
            assert operator.capture_pose()
        operator.wait_until_idle()
        assert operator.session is not None
        for number in (1, 2):
            shot = operator.session.load_capture(f"pose_0{number}")
            np.testing.assert_array_equal(shot.frames, frames_of(recorded, f"scan_{number}"))
