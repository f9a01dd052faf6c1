"""Replay, drivers by name, and devices broken on purpose."""

import numpy as np
import pytest
from facts import raises
from faulty_rig import breakable

from slviewer.devices import drivers as drivers_module
from slviewer.devices.capture import capture_frames
from slviewer.devices.drivers import Driver, available, driver, drivers
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.replay import Recording, recording_rig, replay
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.presets import gray, p18
from slviewer.fringe.sequence import Frame, PatternSequence

PROJECTOR = (64, 48)
SEQUENCE = p18(PROJECTOR)


def recorded(sequence: PatternSequence, seed: int = 0, dtype: type = np.uint8) -> np.ndarray:
    return (
        np.random.default_rng(seed).integers(0, 200, (len(sequence.frames), 12, 16)).astype(dtype)
    )


def grabbed(rig: Rig) -> np.ndarray:
    out = np.zeros(rig.camera.size[::-1], rig.camera.dtype)
    rig.camera.grab(out)
    return out


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_replay_gives_back_what_was_recorded(dtype):
    frames = recorded(SEQUENCE, dtype=dtype)
    with replay(frames, SEQUENCE).opened() as rig:
        again = capture_frames(rig, SEQUENCE)
        assert again.dtype == dtype and np.array_equal(again, frames)
        rig.projector.show(7)
        assert np.array_equal(grabbed(rig), frames[7])
        rig.projector.show_level(255)
        assert np.array_equal(grabbed(rig), frames[25])
        assert rig.camera.apply(CameraSettings(3.0)) == rig.camera.settings() == CameraSettings()
        rig.projector.show_level(None)
        with raises(DeviceError, "dark"):
            grabbed(rig)


def test_a_recorded_dark_frame_is_what_dark_looks_like():
    sequence = gray(PROJECTOR)
    frames = recorded(sequence)
    with replay(frames, sequence).opened() as rig:
        assert np.array_equal(grabbed(rig), frames[-1])


def test_replay_refuses_another_sequence_and_says_so():
    with replay(recorded(SEQUENCE), SEQUENCE).opened() as rig:
        for other in (
            gray(PROJECTOR),
            p18((60, 48)),
            PatternSequence(PROJECTOR, SEQUENCE.frames, phase_sign=-1),
        ):
            with pytest.raises(DeviceError):
                capture_frames(rig, other)
        with pytest.raises(DeviceError):
            rig.projector.show(0)


def test_replay_plays_one_capture_after_another_but_never_a_mixture():
    first, second = recorded(SEQUENCE, 1), recorded(SEQUENCE, 2)
    recording = Recording(first, SEQUENCE)

    def change(done: int, n: int) -> None:
        if done == 5:
            recording.play(second, SEQUENCE)

    with recording_rig(recording).opened() as rig:
        assert np.array_equal(capture_frames(rig, SEQUENCE, progress=change), first)
        assert np.array_equal(capture_frames(rig, SEQUENCE), second)
    with pytest.raises(InputError):
        recording.play(recorded(SEQUENCE, dtype=np.uint16), SEQUENCE)
    with pytest.raises(InputError):
        replay(first[1:], SEQUENCE)


def test_a_timeout_ends_this_capture_only():
    frames = recorded(SEQUENCE)
    rig, faults = breakable(replay(frames, SEQUENCE))
    with rig.opened():
        faults.plan("timeout", 7)
        done = []
        with raises(DeviceError, "8 of 52", "2 s"):
            capture_frames(rig, SEQUENCE, progress=lambda k, n: done.append(k))
        assert done[-1] == 7
        assert np.array_equal(capture_frames(rig, SEQUENCE), frames)


@pytest.mark.parametrize(("fault", "broken"), [("unplugged", "camera"), ("projector", "projector")])
def test_an_unplugged_device_works_again_once_it_is_reopened(fault, broken):
    frames = recorded(SEQUENCE)
    rig, faults = breakable(replay(frames, SEQUENCE))
    with rig.opened():
        rig.projector.show_level(255)
        faults.plan(fault, 3)
        grabbed(rig)  # a preview sets nothing off
        with raises(DeviceError, "4 of 52", broken):
            capture_frames(rig, SEQUENCE)
        with raises(DeviceError, broken):
            capture_frames(rig, SEQUENCE)
    with rig.opened():
        assert np.array_equal(capture_frames(rig, SEQUENCE), frames)
    with raises(InputError, "lightning"):
        faults.plan("lightning", 0)


def test_a_rig_opens_as_a_whole_or_not_at_all():
    rig = replay(recorded(SEQUENCE), SEQUENCE)
    rig.camera.open()
    with pytest.raises(DeviceError):
        rig.open()
    rig.camera.close()
    with rig.opened():
        assert np.array_equal(capture_frames(rig, SEQUENCE)[0], recorded(SEQUENCE)[0])


def test_drivers_are_found_by_name():
    assert {"simulated", "replay"} <= set(drivers())
    assert all(d.what and (d.camera or d.projector or d.turntable or d.rig) for d in available())
    assert driver("simulated").rig(scale=0.1).camera.size == (160, 120)
    with raises(InputError, "nothing", "replay", "simulated"):
        driver("nothing")


def test_a_driver_without_its_package_says_how_to_install_it(monkeypatch):
    vendor = Driver(
        "vendor", "a camera", packages={"surely_not_there": "pip install 'slviewer[vendor]'"}
    )
    everything = drivers() | {"vendor": vendor}
    monkeypatch.setattr(drivers_module, "drivers", lambda: everything)
    assert available()[-1] is vendor
    with raises(DeviceError, "surely_not_there", "'slviewer[vendor]'"):
        driver("vendor")


def test_a_frame_without_patterns_is_no_capture():
    rig = replay(np.zeros((1, 4, 4), np.uint8), PatternSequence(PROJECTOR, (Frame("white"),)))
    with rig.opened(), raises(DeviceError, "patterns"):
        capture_frames(rig, PatternSequence(PROJECTOR, ()))
