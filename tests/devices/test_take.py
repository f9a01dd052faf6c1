"""Captures in several exposures and in colour, on devices that work and on those that do not."""

import msgspec
import numpy as np
import pytest
from colour_camera import ColouredCamera, coloured
from facts import raises
from faulty_rig import breakable

from slviewer.devices.browser import BrowserProjector, ProjectorChannel, Screen
from slviewer.devices.capture import capture_colour, capture_frames, capture_with_texture
from slviewer.devices.protocols import CameraSettings, ColourCamera, Rig
from slviewer.devices.replay import replay
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import Cancelled, DeviceError, InputError
from slviewer.fringe.hdr import merge_exposures
from slviewer.fringe.presets import complementary
from slviewer.simulation.rig import letter

WORLD = SimulatedWorld(letter(0.1))
SEQUENCE = complementary(WORLD.rig.projector.size)
N = len(SEQUENCE.frames)


def rig():
    return simulated_rig(WORLD)


def test_a_sequence_is_taken_in_every_exposure_the_shortest_first():
    seen = []
    with rig().opened() as one:
        one.camera.apply(CameraSettings(1.5, 2.0))
        taken = capture_with_texture(
            one, SEQUENCE, (4.0, 0.5), progress=lambda done, of: seen.append((done, of))
        )
        assert one.camera.settings() == CameraSettings(1.5, 2.0) == taken.settings
    assert taken.exposures_ms == (0.5, 4.0) and taken.texture is None
    assert taken.frames.shape == (2 * N, 120, 160)
    short, long = taken.frames[:N].astype(float), taken.frames[N:]
    # chosen by one, measured by both: no pixel is there for its noise
    clear = (long < 250) & (long > 100)
    assert (long[clear] - 3.0).mean() / (short[clear] - 3.0).mean() == pytest.approx(8, rel=0.05)
    assert (
        seen[0] == (0, 2 * N)
        and seen[-1] == (2 * N, 2 * N)
        and [d for d, _ in seen] == sorted(d for d, _ in seen)
    )
    frames, choice = merge_exposures([taken.frames[:N], long], taken.exposures_ms)
    assert frames.max() < 255 and 0.05 < np.mean(choice) < 0.95


def test_one_exposure_is_what_capture_gives():
    with rig().opened() as one:
        taken = capture_with_texture(one, SEQUENCE)
    with rig().opened() as other:
        np.testing.assert_array_equal(taken.frames, capture_frames(other, SEQUENCE))
    assert taken.exposures_ms == () and taken.settings == CameraSettings(1.0, 1.0)


def test_the_exposure_is_restored_whatever_happens():
    def stop(done, _):
        if done == N + 3:
            raise Cancelled("enough")

    with rig().opened() as one:
        with pytest.raises(Cancelled):
            capture_with_texture(one, SEQUENCE, (0.5, 4.0), progress=stop)
        assert one.camera.settings().exposure_ms == 1.0
    broken, faults = breakable(rig())
    with broken.opened():
        faults.plan("timeout", 4)
        with raises(DeviceError, f"5 of {N}"):
            capture_with_texture(broken, SEQUENCE, (0.5, 4.0))
        assert broken.camera.settings().exposure_ms == 1.0
        faults.plan("unplugged", 4)
        with pytest.raises(DeviceError):
            capture_with_texture(broken, SEQUENCE, (0.5, 4.0))


def test_exposures_that_cannot_be_are_refused():
    with rig().opened() as one:
        for exposures in (
            (2.0,),
            (2.0, 2.0),
            (-1.0, 2.0),
            tuple(range(1, 12)),
            (float("nan"), 1.0),
        ):
            with pytest.raises(InputError):
                capture_with_texture(one, SEQUENCE, exposures)
        with raises(DeviceError, "100 ms", "500 ms"):
            capture_with_texture(one, SEQUENCE, (200.0, 500.0))
        frames = capture_frames(one, SEQUENCE)
    with replay(frames, SEQUENCE).opened() as recorded:
        with pytest.raises(DeviceError):
            capture_with_texture(recorded, SEQUENCE, (1.0, 2.0))
        np.testing.assert_array_equal(capture_with_texture(recorded, SEQUENCE).frames, frames)


def test_a_colour_camera_brings_its_colours_home():
    with coloured(rig()).opened() as one:
        assert isinstance(one.camera, ColourCamera)
        taken = capture_with_texture(one, SEQUENCE)
        assert taken.texture is not None and taken.texture.shape == (120, 160, 3)
        illuminated = taken.texture[..., 1] > 60
        ratio = taken.texture[illuminated].astype(float) / taken.texture[illuminated][:, 1:2]
        np.testing.assert_allclose(
            ratio.mean(axis=0), [ColouredCamera.RED, 1, ColouredCamera.BLUE], atol=0.02
        )
    with rig().opened() as grey:
        assert capture_colour(grey) is None


@pytest.mark.parametrize("fault", [DeviceError("the video has ended"), RuntimeError("no buffer")])
@pytest.mark.parametrize("call", ["grab_colour", "settings"])
def test_what_fails_after_the_last_frame_loses_none(call: str, fault: Exception):
    with coloured(rig()).opened() as one:

        def fail() -> np.ndarray:
            raise fault

        one.camera.grab = one.camera._camera.grab
        setattr(one.camera, call, fail)
        taken = capture_with_texture(one, SEQUENCE)
        assert len(taken.frames) == N and taken.frames[-1].any()
        if call == "settings":
            assert taken.settings == CameraSettings() and taken.texture is not None
        else:
            assert taken.settings.exposure_ms and taken.texture is None


def test_a_device_that_fails_to_close_takes_no_frames_with_it():
    one, closed = coloured(rig()), []

    def fail() -> None:
        raise RuntimeError("the cable is out")

    close = one.projector.close
    one.camera.close = fail
    one.projector.close = lambda: (closed.append(True), close())
    with one.opened() as devices:
        taken = capture_with_texture(devices, SEQUENCE)
    assert closed == [True] and len(taken.frames) == N


class _Page:
    """A projector page that says at once that it has done what it was asked."""

    def __init__(self, channel: ProjectorChannel, size: tuple[int, int]) -> None:
        shown = Screen(1.0, size, size, size, True, True, True, 1.0)
        hello = {"op": "hello", "window": "a", "take": False, "facts": shown}
        self._channel, self.asked = channel, []
        self._page = channel.connect(msgspec.json.encode(hello), self._receive)

    def _receive(self, message: bytes | None) -> None:
        if message is None:
            return
        header = msgspec.json.decode(message[4 : 4 + int.from_bytes(message[:4], "little")])
        self.asked.append(header["op"])
        if "number" in header and self._page is not None:
            done = {"op": "done", "number": header["number"]}
            self._channel.handle_message(self._page, msgspec.json.encode(done).decode())


def test_a_page_that_is_reloaded_between_two_exposures_ends_the_capture():
    channel, camera = ProjectorChannel(), rig().camera
    first = _Page(channel, SEQUENCE.projector)
    with Rig("r", camera, BrowserProjector(SEQUENCE.projector, channel)).opened() as one:
        assert len(capture_with_texture(one, SEQUENCE, (0.5, 4.0)).frames) == 2 * N
        assert first.asked.count("load") == 1 and first.asked.count("show") == 2 * (N + 1)

        def reload(done: int, _: int) -> None:
            if done == N:
                _Page(channel, SEQUENCE.projector)

        with pytest.raises(DeviceError):
            capture_with_texture(one, SEQUENCE, (0.5, 4.0), progress=reload)
        with pytest.raises(InputError):
            capture_with_texture(one, SEQUENCE, (0.5, 4.0), out=np.empty((N, 120, 160), np.uint8))


def test_a_driver_that_fails_in_its_own_way_is_named():
    class Failing(type(rig().camera)):  # type: ignore[misc]
        def grab(self, out):
            raise ValueError("the sensor says 7")

    good = rig()
    failing = Rig("failing", Failing(WORLD), good.projector)
    with failing.opened(), raises(DeviceError, "frame 1", "the sensor says 7"):
        capture_frames(failing, SEQUENCE)
    with failing.opened(), pytest.raises(Cancelled):

        def stop(done, of):
            raise Cancelled("enough")

        capture_frames(failing, SEQUENCE, progress=stop)
