"""The driver of Raspberry Pi cameras on a stand-in for picamera2 with a clock of its own: a sensor
that exposes one frame after the other, whose frames and settings arrive late."""

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from facts import raises

from slviewer.devices import picamera2 as driver_module
from slviewer.devices.capture import capture_colour, capture_frames
from slviewer.devices.drivers import driver
from slviewer.devices.picamera2 import PiCamera
from slviewer.devices.protocols import CameraSettings, ColourCamera, Rig
from slviewer.devices.simulated import preset_rig
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.presets import gray

SIZE, BINNED = (96, 64), (48, 32)
ROW_US, LATENCY, SETTLING, BLACK = 20, 2, 3, 16
"""A row's time, to which exposures are rounded; frames under way; frames until settings apply."""


class Job:
    def __init__(self, request: Any) -> None:
        self.request = request

    def get_result(self, timeout: float | None = None) -> Any:
        if self.request is None:
            raise TimeoutError
        return self.request


class Request:
    def __init__(self, data: np.ndarray, metadata: dict[str, Any]) -> None:
        self.data, self.metadata, self.released = data, metadata, False

    def make_buffer(self, name: str) -> np.ndarray:
        assert name == "raw" and not self.released
        return self.data

    def get_metadata(self) -> dict[str, Any]:
        return self.metadata

    def release(self) -> None:
        assert not self.released
        self.released = True


class Picamera2:
    """One IMX477-like sensor on a Raspberry Pi 4; `scene` is the light on red, green and blue."""

    sensors: ClassVar[list[str]] = ["imx477"]
    sensor_format = "SRGGB12_CSI2P"
    delivered = "SRGGB12"
    claimed: ClassVar[set[int]] = set()
    scene: ClassVar[list[tuple[int, tuple[int, int, int]]]] = [(0, (0, 0, 0))]
    now = 10**12
    unplugged = False
    has_raw = True

    @classmethod
    def global_camera_info(cls) -> list[dict[str, Any]]:
        return [{"Model": model, "Num": k} for k, model in enumerate(cls.sensors)]

    def __init__(self, number: int = 0) -> None:
        if number >= len(self.sensors) or number in self.claimed:
            raise RuntimeError("Camera __init__ sequence did not complete.")
        self.claimed.add(number)
        self.number, self.sensor_resolution = number, SIZE
        self.camera_controls = {
            "ExposureTime": (20, 600_000, None),
            "AnalogueGain": (1.0, 16.0, None),
            "AeEnable": (False, True, None),
            "AwbEnable": (False, True, None),
        }
        self.queued = [{"ExposureTime": 20_000, "AnalogueGain": 1.0}] * SETTLING
        self.set_: dict[str, Any] = {}
        self.next_begin, self.cancelled, self.automatic = 0, False, True

    def create_still_configuration(self, **options: Any) -> dict[str, Any]:
        return {"controls": {}} | options

    def configure(self, config: dict[str, Any]) -> None:
        assert not config["queue"] and config["raw"]["format"] == "SRGGB12"
        size = min((SIZE, BINNED), key=lambda s: abs(s[0] - config["raw"]["size"][0]))
        raw = {"format": self.delivered, "size": size, "stride": 2 * size[0] + 32}
        self.config = {"raw": raw if self.has_raw else None}

    def camera_configuration(self) -> dict[str, Any]:
        return self.config

    def set_controls(self, controls: dict[str, Any]) -> None:
        for name, value in controls.items():
            if name not in self.camera_controls:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")
            assert type(value) is type(self.camera_controls[name][0])
        self.automatic &= controls.get("AeEnable", True)
        self.set_.update(controls)

    def start(self) -> None:
        self.next_begin = self.now

    def capture_request(self, wait: bool | None = None) -> Job:
        assert wait is False
        if self.unplugged:
            return Job(None)
        settings = self.queued.pop(0)
        exposure = max(1, round(settings["ExposureTime"] / ROW_US)) * ROW_US
        latest = dict(self.queued[-1])
        latest.update({k: v for k, v in self.set_.items() if k in latest})
        self.queued.append(latest)
        period = max(33_000, exposure) * 1000
        while self.next_begin + (LATENCY + 1) * period < self.now:  # nobody took these
            self.next_begin += period
        began, self.next_begin = self.next_begin, self.next_begin + period
        type(self).now = max(self.now, began + LATENCY * period)
        light = [light for shown, light in self.scene if shown <= began][-1]
        metadata = {
            "SensorTimestamp": began + 1000 * exposure,
            "ExposureTime": exposure,
            "AnalogueGain": settings["AnalogueGain"],
        }
        if "LensPosition" in self.camera_controls:
            metadata["LensPosition"] = self.set_.get("LensPosition", 1.0)
        return Job(Request(self._expose(light, exposure * settings["AnalogueGain"]), metadata))

    def _expose(self, light: tuple[int, int, int], exposure_us: float) -> np.ndarray:
        raw = self.config["raw"]
        width, height = raw["size"]
        counts = np.empty((height, width))
        for y, x, colour in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
            counts[y::2, x::2] = light[colour] * exposure_us / 10_000
        counts = np.clip(np.round(counts) + BLACK, 0, 4095).astype("<u2")
        lines = np.full((height, raw["stride"]), 0xAB, np.uint8)  # rows end with padding
        lines[:, : 2 * width] = (counts << (4 if raw["format"].endswith("16") else 0)).view(
            np.uint8
        )
        return lines.ravel()

    def cancel_all_and_flush(self) -> None:
        self.cancelled = True

    def close(self) -> None:
        assert not self.unplugged or self.cancelled, "it would wait for a frame forever"
        self.claimed.discard(self.number)


def show(*light: int) -> None:
    """The projector's light changes now."""
    Fake = Picamera2
    Fake.now += 1_000_000
    Fake.scene.append((Fake.now, light if len(light) == 3 else light * 3))


@pytest.fixture(autouse=True)
def pi(monkeypatch):
    fake = type("Picamera2", (Picamera2,), {"claimed": set(), "scene": [(0, (0, 0, 0))]})
    module = ModuleType("picamera2")
    module.Picamera2 = fake
    for name, each in (("picamera2", module), ("libcamera", ModuleType("libcamera"))):
        each.__spec__ = ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, each)
    clock = SimpleNamespace(monotonic_ns=lambda: fake.now)
    monkeypatch.setattr(driver_module, "time", clock)
    monkeypatch.setattr(sys.modules[__name__], "Picamera2", fake)
    driver_module._describe_stream.cache_clear()
    return fake


@pytest.fixture
def camera():
    camera = PiCamera()
    camera.open()
    yield camera
    camera.close()


def grabbed(camera: PiCamera) -> np.ndarray:
    out = np.full(camera.size[::-1], 7, camera.dtype)
    camera.grab(out)
    return out


def test_cameras_are_listed_and_described_before_they_are_open(pi):
    assert driver("picamera2").list_connected() == ["number 0: imx477"]
    camera = PiCamera()
    assert (camera.size, camera.dtype, camera.full_scale) == (SIZE, np.uint16, 4095)
    assert isinstance(camera, ColourCamera) and not pi.claimed
    camera.open()
    assert PiCamera().size == SIZE  # while it is in use here
    camera.close()
    assert not pi.claimed


def test_the_package_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.delitem(sys.modules, "picamera2")
    with raises(DeviceError, "picamera2", "pip install 'slviewer[picamera2]'"):
        driver("picamera2")


def test_every_frame_began_after_the_pattern_was_shown(camera):
    for level in (900, 100, 2000, 30):
        show(level)
        assert (grabbed(camera) == level + BLACK).all()


@pytest.mark.parametrize(("delivered", "shift"), [("SRGGB12", 0), ("SRGGB16", 4)])
def test_channels_of_the_mosaic(pi, delivered, shift):
    pi.delivered = delivered
    camera = PiCamera()
    camera.open()
    show(100, 1000, 400)
    expected = (np.array([100, 1000, 400]) + BLACK) << shift
    colours = camera.grab_colour()
    assert colours.dtype == np.uint16 and (colours == expected).all()
    for channel, level in zip(("red", "green", "blue"), expected, strict=True):
        camera.channel = channel
        assert (grabbed(camera) == level).all()
    show(5000)
    assert grabbed(camera).min() >= camera.full_scale  # seen as saturated
    camera.close()


def test_mono_sensors_are_no_colour_cameras(pi):
    pi.delivered = "R12"
    camera = PiCamera()
    assert not isinstance(camera, ColourCamera)
    camera.open()
    show(700)
    assert (grabbed(camera) == 700 + BLACK).all()
    camera.close()


def test_settings_are_in_effect_when_apply_returns(pi, camera):
    assert not camera._camera.automatic
    assert camera.settings() == CameraSettings(10.0, 1.0)
    show(400)
    for exposure, gain in ((20.0, 1.0), (2.0, 4.0), (40.0, 1.0)):
        assert camera.apply(CameraSettings(exposure, gain)) == CameraSettings(exposure, gain)
        assert (grabbed(camera) == 400 * exposure * gain / 10 + BLACK).all()
    assert camera.apply(CameraSettings(1e5)).exposure_ms == 600.0  # its longest
    assert camera.apply(CameraSettings(10.007)).exposure_ms == 10.0  # whole rows
    assert camera.apply(CameraSettings(gain=99.0)).gain == 16.0


def test_focus_of_a_module_that_has_one(pi, camera):
    assert camera.read_lens() == {}
    camera.close()
    make = pi.__init__

    def with_lens(self, number=0):
        make(self, number)
        self.camera_controls |= {"AfMode": (0, 2, 0), "LensPosition": (0.0, 32.0, 1.0)}

    pi.__init__ = with_lens
    camera = PiCamera(focus=2.5)
    camera.open()
    assert camera.read_lens() == {"focus": 2.5} and camera._camera.set_["AfMode"] == 0
    camera.close()


def test_modes_of_the_sensor(pi):
    camera = PiCamera(size=[48, 32])
    camera.open()
    show(300)
    assert camera.size == BINNED and (grabbed(camera) == 300 + BLACK).all()
    camera.close()
    with raises(InputError, "50x40", "[48, 32]"):
        PiCamera(size=[50, 40])
    pi.has_raw = False
    with raises(InputError, "opencv"):
        PiCamera(number=0, size=[96, 64])
    assert not pi.claimed
    pi.has_raw, pi.delivered = True, "SRGGB12_CSI2P"
    driver_module._describe_stream.cache_clear()
    with raises(InputError, "SRGGB12_CSI2P"):
        PiCamera()
    with raises(InputError, "infrared", "red", "green", "blue", "grey"):
        PiCamera(channel="infrared")


def test_cameras_that_are_missing_or_in_use_are_named(pi):
    with raises(DeviceError, 3, "rpicam-hello"):
        PiCamera(number=3)
    camera = PiCamera()
    pi.claimed.add(0)  # by another program
    with raises(DeviceError, "close other programs"):
        camera.open()
    pi.claimed.clear()
    camera.open()
    camera.close()


def test_an_unplugged_camera_is_an_error_and_opens_again(pi, camera):
    show(500)
    grabbed(camera)
    pi.unplugged = True
    with raises(DeviceError, "ribbon cable"):
        grabbed(camera)
    camera.close()
    assert not pi.claimed
    with raises(DeviceError, "ribbon cable"):
        camera.open()
    pi.unplugged = False
    camera.open()
    assert (grabbed(camera) == 500 + BLACK).all()


def test_another_module_is_noticed(pi, camera):
    camera.close()
    pi.delivered = "SRGGB16"
    with raises(DeviceError, "choose it anew"):
        camera.open()
    assert PiCamera().full_scale == 0xFFC0


def test_frames_that_are_always_late_end_the_grab(pi, camera, monkeypatch):
    clock = SimpleNamespace(monotonic_ns=lambda: pi.now + 10**12)
    monkeypatch.setattr(driver_module, "time", clock)
    with raises(DeviceError, 20):
        grabbed(camera)


def test_a_capture_of_a_sequence(camera):
    projector = preset_rig(scale=0.05).projector
    frames_shown = []
    projector.show = lambda index: (frames_shown.append(index), show(100 + 7 * index))
    projector.show_level = lambda grey: show(grey, grey, grey)
    projector.open()
    sequence = gray(projector.size)
    frames = capture_frames(Rig("bench", camera, projector), sequence)
    for k, frame in enumerate(frames):
        assert (frame == 100 + 7 * k + BLACK).all()
    assert (capture_colour(Rig("bench", camera, projector)) == 255 + BLACK).all()
