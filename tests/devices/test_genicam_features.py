"""What is made of a camera's features, on plain objects that have a node's attributes: viky has few
of them."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
from facts import raises

from slviewer.devices.genicam import Features
from slviewer.devices.pixel_formats import pixel_format
from slviewer.devices.protocols import CameraSettings
from slviewer.errors import DeviceError, InputError

NOT_NOW, WRITE, READ, BOTH = 1, 2, 3, 4


@dataclass
class Number:
    value: float
    min: float = 0
    max: float = 1e6
    unit: str = ""
    inc: float = 0
    access: int = BOTH

    def get_access_mode(self) -> int:
        return self.access

    def has_inc(self) -> bool:
        return bool(self.inc)


@dataclass
class Choices:
    value: str
    offered: tuple[str, ...]
    absent: tuple[str, ...] = ()
    access: int = BOTH

    @property
    def entries(self) -> list[SimpleNamespace]:
        both = [(name, READ) for name in self.offered] + [(name, NOT_NOW) for name in self.absent]
        return [
            SimpleNamespace(symbolic=name, get_access_mode=lambda mode=mode: mode)
            for name, mode in both
        ]

    def get_access_mode(self) -> int:
        return self.access


@dataclass
class Command:
    fired: int = 0
    access: int = WRITE

    def get_access_mode(self) -> int:
        return self.access

    def execute(self) -> None:
        self.fired += 1


@dataclass
class PerTrigger(Choices):
    """A mode that belongs to whatever trigger is selected."""

    selector: Choices | None = None
    modes: dict[str, str] = field(default_factory=dict)

    @property
    def value(self) -> str:
        return self.modes.get(self.selector.value, "Off")

    @value.setter
    def value(self, mode: str) -> None:
        if self.selector is not None:
            self.modes[self.selector.value] = mode


def machine_vision_camera() -> SimpleNamespace:
    """As most have it, in the state that most are shipped in."""
    selector = Choices("AcquisitionStart", ("AcquisitionStart", "FrameStart"))
    mode = PerTrigger("Off", ("Off", "On"), selector=selector)
    mode.modes["AcquisitionStart"] = "On"
    return SimpleNamespace(
        Width=Number(2448),
        Height=Number(2048),
        PixelFormat=Choices("Mono8", ("Mono8", "Mono12", "Mono12p"), absent=("Mono10",)),
        ExposureAuto=Choices("Continuous", ("Off", "Once", "Continuous")),
        ExposureTime=Number(5000.0, 20.0, 1e5, "us", access=READ),
        GainAuto=Choices("Continuous", ("Off", "Continuous")),
        Gain=Number(12.0, 0.0, 24.0, "dB"),
        Gamma=Number(0.8, 0.25, 4.0),
        AcquisitionFrameRateEnable=Number(True),
        TriggerSelector=selector,
        TriggerMode=mode,
        TriggerSource=Choices("Line0", ("Software", "Line0", "Line3")),
        TriggerSoftware=Command(access=NOT_NOW),
    )


def features(nodes: SimpleNamespace) -> Features:
    return Features(nodes, "the camera")


def test_the_state_of_a_motorised_lens_is_read():
    nodes = machine_vision_camera()
    assert features(nodes).read_lens() == {}
    nodes.FocusStepper, nodes.FocalLength = Number(1200), Number(25.1)
    nodes.Iris = Number(4, access=NOT_NOW)
    assert features(nodes).read_lens() == {"focus": 1200.0, "zoom": 25.1}


def test_a_camera_is_made_comparable():
    nodes = machine_vision_camera()
    nodes.ExposureTime.access = BOTH
    camera = features(nodes)
    assert camera.size() == (2448, 2048)
    chosen, trigger = camera.choose_format(), camera.choose_trigger(None, None)
    assert chosen.name == "Mono12" and trigger == "software"
    camera.prepare(chosen, trigger, None)
    assert nodes.PixelFormat.value == "Mono12"
    assert nodes.ExposureAuto.value == nodes.GainAuto.value == "Off"
    assert nodes.Gamma.value == 1.0 and nodes.AcquisitionFrameRateEnable.value is False
    assert nodes.TriggerMode.modes == {"AcquisitionStart": "Off", "FrameStart": "On"}
    assert (nodes.TriggerSelector.value, nodes.TriggerSource.value) == ("FrameStart", "Software")
    camera.fire()
    assert nodes.TriggerSoftware.fired == 1
    camera.release()
    assert set(nodes.TriggerMode.modes.values()) == {"Off"}


def test_a_line_triggers_where_it_is_named():
    nodes = machine_vision_camera()
    camera = features(nodes)
    camera.prepare(
        camera.choose_format("Mono8"), camera.choose_trigger("hardware", "Line3"), "Line3"
    )
    assert nodes.TriggerSource.value == "Line3" and nodes.TriggerMode.modes["FrameStart"] == "On"
    for line in (None, "Line7", "Software"):
        with raises(InputError, "Line0", "Line3"):
            camera.choose_trigger("hardware", line)
    with raises(InputError, "often", "software", "hardware", "free"):
        camera.choose_trigger("often", None)
    assert camera.choose_trigger("free", None) == "free"


def test_a_camera_without_triggers_runs_free_and_says_so():
    nodes = machine_vision_camera()
    del nodes.TriggerSoftware
    assert features(nodes).choose_trigger(None, None) == "free"
    with raises(InputError, "software"):
        features(nodes).choose_trigger("software", None)
    del nodes.TriggerMode
    with raises(InputError, "lines"):
        features(nodes).choose_trigger("hardware", "Line0")


def test_a_trigger_without_selector_is_turned_off():
    nodes = SimpleNamespace(TriggerMode=Choices("On", ("Off", "On")))
    features(nodes).release()
    assert nodes.TriggerMode.value == "Off"


@pytest.mark.parametrize(
    ("unit", "there"), [("us", 1000.0), ("µs", 1000.0), ("", 1000.0), ("ms", 1.0), ("s", 1e-3)]
)
def test_exposures_are_ms_whatever_the_unit(unit, there):
    nodes = SimpleNamespace(ExposureTime=Number(7 * there, 0.5 * there, 40 * there, unit))
    camera = features(nodes)
    assert camera.settings().exposure_ms == pytest.approx(7)
    for wanted, taken in ((3.25, 3.25), (0.01, 0.5), (500, 40)):
        camera.apply(CameraSettings(wanted))
        assert nodes.ExposureTime.value == pytest.approx(taken * there)
        assert camera.settings().exposure_ms == pytest.approx(taken)


def test_the_nearest_step_is_taken():
    nodes = SimpleNamespace(ExposureTimeAbs=Number(100, 35, 1000, "us", inc=35))
    camera = features(nodes)
    for us, taken in ((200, 210), (36, 35), (5000, 980), (1, 35)):
        camera.apply(CameraSettings(us / 1000))
        assert nodes.ExposureTimeAbs.value == taken and isinstance(nodes.ExposureTimeAbs.value, int)
    nodes = SimpleNamespace(ExposureTime=Number(100.0, 10.0, 995.0, "us", inc=10.0))
    features(nodes).apply(CameraSettings(0.994))
    assert nodes.ExposureTime.value == 990.0


def test_gain_in_decibels_is_a_factor():
    nodes = machine_vision_camera()
    camera = features(nodes)
    assert camera.settings().gain == pytest.approx(3.98, abs=0.01)
    camera.apply(CameraSettings(gain=2.0))
    assert nodes.Gain.value == pytest.approx(6.02, abs=0.01)
    camera.apply(CameraSettings(gain=0.5))
    assert camera.settings().gain == 1.0
    camera.apply(CameraSettings(gain=1000.0))
    assert camera.settings().gain == pytest.approx(10**1.2)


def test_a_gain_in_steps_of_its_own_is_unknown():
    nodes = machine_vision_camera()
    nodes.Gain = Number(240, 0, 480)
    camera = features(nodes)
    camera.apply(CameraSettings(gain=4.0))
    assert nodes.Gain.value == 240 and camera.settings().gain is None
    with pytest.raises(InputError):
        camera.check_settings(CameraSettings(gain=4.0))
    del nodes.Gain, nodes.ExposureTime
    assert camera.settings() == CameraSettings()
    with raises(InputError, "gain"):
        camera.check_settings(CameraSettings(gain=4.0))
    with raises(InputError, "exposure"):
        camera.check_settings(CameraSettings(4.0))


def test_an_exposure_that_is_read_only_is_told_and_stays():
    camera = features(nodes := machine_vision_camera())
    camera.apply(CameraSettings(1.0))
    assert nodes.ExposureTime.value == 5000.0 and camera.settings().exposure_ms == 5.0
    camera.check_settings(CameraSettings(1.0))  # once its automatic is off, it can be set


def test_formats_that_it_has_not_are_refused():
    camera = features(nodes := machine_vision_camera())
    for name in ("Mono10", "BayerRG8", "rubbish"):
        with raises(InputError, "Mono8", "Mono12", "Mono12p", "pixel_format"):
            camera.choose_format(name)
    assert camera.choose_format("Mono12p").packing == "p"
    nodes.PixelFormat.offered = ("YUV422_8",)
    with pytest.raises(InputError):
        camera.choose_format()
    with raises(DeviceError, "pixel format"):
        camera.prepare(pixel_format("Mono12"), "free", None)


def test_a_camera_that_does_not_say_its_size_cannot_be_used():
    with pytest.raises(DeviceError):
        features(SimpleNamespace(Width=Number(3))).size()
