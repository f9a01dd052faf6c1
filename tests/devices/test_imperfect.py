"""Devices that lie do so as they were told."""

import numpy as np
import pytest
from clocks import SteppingClock
from facts import raises
from imperfect_rig import Imperfections, imperfect, resampled_rig

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import CameraSettings
from slviewer.devices.replay import replay
from slviewer.devices.simulated import preset_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError
from slviewer.fringe.presets import gray
from slviewer.simulation.rig import letter

SEQUENCE = gray((64, 48))
FRAMES = np.random.default_rng(0).integers(0, 200, (len(SEQUENCE.frames), 12, 16)).astype(np.uint8)
LAST = len(FRAMES) - 1


@pytest.mark.parametrize(
    ("wrong", "shown"),
    [
        (Imperfections(), range(LAST + 1)),
        (Imperfections(lag=1), [0, *range(LAST)]),
        (Imperfections(lag=2), [0, 0, *range(LAST - 1)]),
        (Imperfections(late={3, 7}), [0, 1, 2, 2, 4, 5, 6, 6, *range(8, LAST + 1)]),
        (Imperfections(repeated={5}), [0, 1, 2, 3, 4, 4, *range(6, LAST + 1)]),
        (Imperfections(dropped=4), [0, 1, 2, 3, *range(5, LAST + 1), LAST]),
        (Imperfections(swapped=2), [0, 1, 3, 2, *range(4, LAST + 1)]),
    ],
)
def test_the_frames_come_as_the_fault_says(wrong, shown):
    rig, _ = imperfect(replay(FRAMES, SEQUENCE), wrong)
    with rig.opened():
        assert np.array_equal(capture_frames(rig, SEQUENCE), FRAMES[list(shown)])


def test_light_that_is_late_shows_the_frame_before_until_it_comes():
    time = SteppingClock()
    rig, wrong = imperfect(replay(FRAMES, SEQUENCE), Imperfections(latency_ms=30), time.clock)
    image = np.empty((12, 16), np.uint8)
    with rig.opened():
        rig.projector.load(SEQUENCE)
        for k in (4, 5):
            rig.projector.show(k)
            time.sleep(0.045)
            rig.camera.grab(image)
            assert np.array_equal(image, FRAMES[k])
        rig.projector.show(6)
        rig.camera.grab(image)
        assert np.array_equal(image, FRAMES[5])
        wrong.elsewhere = True
        rig.projector.show(9)
        time.sleep(0.045)
        rig.camera.grab(image)
        assert np.array_equal(image, FRAMES[6])


def test_a_camera_by_its_own_clock_gives_so_many_images_a_second():
    time = SteppingClock()
    rig, _ = imperfect(replay(FRAMES, SEQUENCE), Imperfections(frame_ms=10), time.clock)
    image = np.empty((12, 16), np.uint8)
    with rig.opened():
        rig.projector.show_level(255)
        begin = time.now()
        for _ in range(10):
            rig.camera.grab(image)
        assert 0.09 < time.now() - begin < 0.111


def test_mains_light_vanishes_in_an_exposure_of_its_period():
    def swing(exposure_ms: float) -> float:
        time = SteppingClock()
        rig, _ = imperfect(
            preset_rig(scale=0.1), Imperfections(room=40, mains_depth=0.5), time.clock
        )
        image, means = np.empty(rig.camera.size[::-1], np.uint8), []
        with rig.opened():
            rig.camera.apply(CameraSettings(exposure_ms))
            for _ in range(25):
                time.sleep(0.0013)
                rig.camera.grab(image)
                means.append(image.mean())
        return float(np.std(means))

    assert swing(1.0) > 5 > 0.5 > swing(10.0)


@pytest.mark.computes
def test_a_display_that_scales_makes_fine_stripes_grey():
    rig = resampled_rig(SimulatedWorld(letter(0.1)), 1.1)
    with raises(InputError, "zoom", 3):
        resampled_rig(SimulatedWorld(letter(0.1)), 3.0)
    with rig.opened():
        sequence = gray(rig.projector.size)
        plain = preset_rig(scale=0.1)
        with plain.opened():
            same = np.abs(
                capture_frames(rig, sequence).astype(int) - capture_frames(plain, sequence)
            ).mean(axis=(1, 2))
    assert same[-1] < 2 < same[0]
