"""The GenICam driver on `viky.cti`, the producer of three small colour cameras that the package
genicam brings.

Each shows a square of its colour on white, which moves by one pixel with every frame, 20 a second:
where it is says which frame was seen.
"""

import gc
import signal
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from clocks import HANG_S, until
from facts import raises

genicam = pytest.importorskip("genicam", reason="the optional package genicam is not installed")
pytest.importorskip("harvesters", reason="the optional package harvesters is not installed")

from slviewer.devices import genicam as driver_module  # noqa: E402
from slviewer.devices.capture import capture_colour, capture_frames  # noqa: E402
from slviewer.devices.drivers import driver  # noqa: E402
from slviewer.devices.genicam import (  # noqa: E402
    IN_FLIGHT,
    Features,
    GenicamCamera,
    list_genicam_cameras,
)
from slviewer.devices.gentl import PRODUCERS_VARIABLE  # noqa: E402
from slviewer.devices.protocols import CameraSettings, ColourCamera, Rig  # noqa: E402
from slviewer.devices.simulated import preset_rig  # noqa: E402
from slviewer.errors import DeviceError, InputError  # noqa: E402
from slviewer.fringe.presets import gray  # noqa: E402

VIKY = Path(genicam.__file__).parent / "viky.cti"
pytestmark = pytest.mark.skipif(
    not VIKY.is_file(), reason="this build of the package genicam brings no viky.cti"
)


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    monkeypatch.setenv(PRODUCERS_VARIABLE, str(VIKY.parent))


@pytest.fixture
def camera():
    camera = GenicamCamera(serial=0)
    camera.open()
    yield camera
    camera.close()


def fast(camera: GenicamCamera) -> GenicamCamera:
    """At 200 frames a second."""
    camera._link.node_map.AcquisitionFrameRate.value = 200.0
    return camera


def grabbed(camera: GenicamCamera) -> np.ndarray:
    out = np.full(camera.size[::-1], 7, camera.dtype)
    camera.grab(out)
    return out


def fill_buffers(camera: GenicamCamera) -> None:
    """Wait until no buffer of the camera is left empty."""
    acquirer = camera._link._acquirer
    assert until(lambda: acquirer.data_streams[0].num_awaiting_delivery == acquirer.num_buffers)


def column(frame: np.ndarray) -> float:
    """Where the square is; it starts at the left and turns back at the right."""
    assert (frame == 0).sum() == 400 and (frame == 255).sum() == frame.size - 400
    return float(np.nonzero(frame == 0)[1].mean())


def test_cameras_are_found_and_chosen():
    assert list_genicam_cameras() == [
        f"Machine Vision Games Ltd. Viky, serial {k}" for k in range(3)
    ]
    assert (
        driver("genicam").list_connected is list_genicam_cameras
        and driver("genicam").camera is GenicamCamera
    )
    with raises(InputError, 3, "serial 0", "serial 1", "serial 2"):
        GenicamCamera()
    with raises(InputError, 3, "serial 0", "serial 1", "serial 2"):
        GenicamCamera(model="viky")
    with pytest.raises(DeviceError):
        GenicamCamera(serial="23")
    camera = GenicamCamera(serial="1", producer=str(VIKY))
    assert camera.name == "the camera Machine Vision Games Ltd. Viky, serial 1"
    assert (camera.size, camera.dtype) == ((400, 400), np.uint8)


def test_producers_that_are_missing_or_broken_are_named(monkeypatch, tmp_path):
    broken = tmp_path / "broken.cti"
    broken.write_text("no library")
    with raises(InputError, ".cti"):
        GenicamCamera(producer=str(tmp_path / "none.cti"))
    with raises(DeviceError, "broken.cti"):
        GenicamCamera(producer=str(broken))
    monkeypatch.setenv(PRODUCERS_VARIABLE, f"{tmp_path}:{VIKY.parent}:{tmp_path}")
    assert len(list_genicam_cameras()) == 3
    for folders in (str(tmp_path / "nothing"), ""):
        monkeypatch.setenv(PRODUCERS_VARIABLE, folders)
        with pytest.raises(DeviceError):
            list_genicam_cameras()


@pytest.mark.computes
def test_a_hundred_frames_fill_the_array_they_are_given(camera):
    fast(camera)
    frames = np.zeros((100, 400, 400), np.uint8)
    for frame in frames:
        camera.grab(frame)
    places = np.array([column(frame) for frame in frames])
    steps = np.abs(np.diff(places))
    assert places.min() >= 9.5 and places.max() <= 390.5
    # no two are the same, and none had begun before the call
    assert np.median(steps) >= IN_FLIGHT + 1
    assert (steps >= IN_FLIGHT + 1).mean() > 0.9  # where it turns, it may come back to where it was
    assert len({frame.tobytes() for frame in frames}) > 80


def test_an_armed_camera_keeps_every_frame(camera):
    fast(camera)
    camera._arm(12)
    fill_buffers(camera)
    frames = np.zeros((12, 400, 400), np.uint8)
    assert all(camera.fetch(frame) for frame in frames)
    steps = np.abs(np.diff([column(frame) for frame in frames]))
    assert (steps <= 1).all() and (steps == 1).sum() >= 10  # none is missing; it may turn back
    camera.disarm()
    camera._link.node_map.AcquisitionFrameRate.value = 1.0
    camera._arm(3)
    assert not camera.fetch(frames[0])  # the first takes a second
    camera.disarm()
    fast(camera)
    assert column(grabbed(camera)) > 0


def test_frames_that_waited_are_not_returned(camera):
    first, began = column(grabbed(camera)), time.monotonic()
    fill_buffers(camera)
    second = column(grabbed(camera))
    periods = (time.monotonic() - began) / 0.05
    # a buffer that waited would be one of the three that came next
    assert 2 * (IN_FLIGHT + 1) <= second - first <= periods + 1


@pytest.mark.parametrize(("serial", "colour"), [(0, "red"), (1, "green"), (2, "blue")])
def test_colours_and_the_channel_that_is_decoded(serial, colour):
    rgb = [255 * (colour == name) for name in ("red", "green", "blue")]
    camera = GenicamCamera(serial=serial, channel=colour)
    assert isinstance(camera, ColourCamera)
    camera.open()
    try:
        assert (
            grabbed(fast(camera)) == 255
        ).all()  # the square is as bright as the paper in its own colour
        seen = camera.grab_colour()
        assert seen.shape == (400, 400, 3) and seen.dtype == np.uint8
        other = ("red", "green", "blue")[(serial + 1) % 3]
        camera.channel = other
        square = grabbed(camera) == 0
        assert square.sum() == 400
        inside = (seen != 255).any(2)
        assert inside.sum() == 400 and (seen[inside] == rgb).all()
        seen[:] = 1  # its own memory, not the camera's buffer
        camera.channel = "grey"
        assert set(np.unique(grabbed(camera))) == {85, 255}
    finally:
        camera.close()


def test_mono_is_one_number_a_pixel():
    camera = GenicamCamera(serial=0, pixel_format="Mono8")
    assert not isinstance(camera, ColourCamera)
    camera.open()
    try:
        column(grabbed(fast(camera)))
    finally:
        camera.close()


@pytest.mark.computes
def test_a_capture_of_a_sequence(camera):
    projector = preset_rig(scale=0.05).projector
    sequence = gray(projector.size)
    rig = Rig("bench", fast(camera), projector)
    projector.open()
    frames = capture_frames(rig, sequence)
    assert len(np.unique([column(frame) for frame in frames])) > len(frames) - 3
    assert capture_colour(rig).shape == (400, 400, 3)


def test_what_the_camera_lacks_is_said(camera):
    assert camera.settings() == CameraSettings() == camera.apply(CameraSettings(5.0, 2.0))
    for options, lacks in (
        ({"exposure_ms": 5.0}, ("exposure",)),
        ({"gain": 2.0}, ("gain",)),
        ({"trigger": "software"}, ("software trigger",)),
        ({"trigger": "hardware", "line": "Line1"}, ("trigger lines",)),
        ({"pixel_format": "Mono12"}, ("Mono12", "RGBa8", "Mono8")),
        ({"channel": "infrared"}, ("infrared", "red", "green", "blue", "grey")),
    ):
        with raises(InputError, *lacks):
            GenicamCamera(serial=1, **options)


def test_a_camera_opens_again_and_again():
    camera = GenicamCamera(serial=0)
    for _ in range(3):
        with pytest.raises(DeviceError):
            camera.grab(np.zeros((400, 400), np.uint8))
        camera.open()
        with pytest.raises(DeviceError):
            camera.open()
        column(grabbed(fast(camera)))
        camera.close()
        camera.close()


def test_cameras_of_one_producer_are_used_side_by_side(camera):
    first = fast(camera)
    again = GenicamCamera(serial=0)  # can be chosen anew while it is open, as with other options
    with pytest.raises(DeviceError):
        again.open()
    second = GenicamCamera(serial=2)
    second.open()
    assert len(list_genicam_cameras()) == 3
    column(grabbed(first))
    column(grabbed(fast(second)))
    second.close()
    column(grabbed(first))
    first.close()
    again.open()
    column(grabbed(fast(again)))
    again.close()


def test_a_camera_that_sends_nothing_ends_this_grab_only(camera):
    fast(camera)._timeout_s = 0.2
    camera._link.node_map.AcquisitionStop.execute()
    began = time.monotonic()
    with raises(DeviceError, "0.2 s"):
        grabbed(camera)
    assert 0.2 <= time.monotonic() - began < HANG_S
    column(grabbed(camera))


def test_an_incomplete_frame_ends_this_grab_only(camera, monkeypatch):
    import genicam.gentl as library

    whole, left = library.Buffer.is_complete, [IN_FLIGHT + 1]

    def damaged(buffer):
        left[0] -= 1
        return whole(buffer) if left[0] > 0 else False

    fast(camera)
    camera._link.drop_filled()
    monkeypatch.setattr(library.Buffer, "is_complete", damaged)
    out = np.full((400, 400), 7, np.uint8)
    with pytest.raises(DeviceError):
        for _ in range(3):
            camera.grab(out)
    monkeypatch.undo()
    column(grabbed(camera))


def test_a_camera_that_vanishes_can_be_opened_again(camera):
    fast(
        camera
    )._link._acquirer.device.module.close()  # what a producer does when the cable is pulled
    with pytest.raises(DeviceError):
        grabbed(camera)
    with pytest.raises(DeviceError):
        grabbed(camera)
    camera.close()
    for _ in range(2):
        camera.open()
        column(grabbed(fast(camera)))
        camera.close()


def test_a_camera_that_fails_to_open_is_given_back(camera):
    camera.close()
    camera.size = (300, 200)
    for _ in range(2):
        with raises(DeviceError, "400x400", "300x200"):
            camera.open()
    camera.size = (400, 400)
    camera.open()
    column(grabbed(camera))


def test_nothing_of_a_closed_camera_stays(camera):
    grabbed(fast(camera))
    left = weakref.ref(camera._link._acquirer), weakref.ref(camera._link._harvester)
    threads = threading.active_count()
    camera.close()
    gc.collect()
    assert [ref() for ref in left] == [None, None] and threading.active_count() <= threads


def test_interrupts_and_other_threads_go_on_while_it_waits():
    before = signal.getsignal(signal.SIGINT)
    camera = GenicamCamera(serial=0)
    camera.open()
    ticks, done = [0], threading.Event()

    def tick() -> None:
        while not done.wait(0.001):
            ticks[0] += 1

    def goes_on() -> bool:
        """Whether the thread wakes often during three grabs: 9 times where the library waits by
        itself."""
        before, began = ticks[0], time.monotonic()
        for _ in range(3):
            grabbed(camera)
        assert time.monotonic() - began > 0.3
        return ticks[0] - before > 60

    thread = threading.Thread(target=tick)
    thread.start()
    try:
        assert until(goes_on)  # on a busy machine it wakes less often, though not always
    finally:
        done.set()
        thread.join()
        camera.close()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_software_trigger_takes_the_next_frame(camera, monkeypatch):
    """Viky has none and runs on: here only that each grab fires once, after the buffers that waited
    are gone."""
    fired = []
    monkeypatch.setattr(camera, "_trigger", "software")
    monkeypatch.setattr(Features, "fire", lambda self: fired.append(time.monotonic()))
    first = column(grabbed(camera))
    fill_buffers(camera)
    second = column(grabbed(camera))
    assert len(fired) == 2 and second - first > camera._link._acquirer.num_buffers


def test_frames_of_another_shape_are_refused(camera):
    for out in (
        np.zeros((400, 300), np.uint8),
        np.zeros((400, 400), np.uint16),
        np.zeros((400, 800), np.uint8)[:, ::2],
    ):
        with pytest.raises(InputError):
            camera.grab(out)
    assert driver_module.DRIVER.missing == ""
