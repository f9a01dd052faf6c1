"""The driver of DSLR cameras on a stand-in for libgphoto2's Python package: cameras of two makers
with their own names for settings, pictures in their memory, and what goes wrong with them."""

import io
import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from facts import raises
from raw_files import write_dng

from slviewer.devices import gphoto2 as driver_module
from slviewer.devices.capture import capture_colour, capture_frames
from slviewer.devices.drivers import driver
from slviewer.devices.gphoto2 import DslrCamera
from slviewer.devices.protocols import CameraSettings, ColourCamera, Rig, read_lens
from slviewer.devices.simulated import preset_rig
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.presets import gray

SIZE, BLACK, WHITE = (96, 64), 512, 4095
SHUTTERS = ["bulb", "30", "1", "0.4", "1/4", "1/8", "1/15", "1/30", "1/60", "1/125"]
CANON = {
    "autoexposuremode": ("AV", ["P", "TV", "AV", "Manual", "Bulb"]),
    "drivemode": ("Continuous", ["Continuous", "Single", "Timer 2 sec"]),
    "focusmode": ("Manual", ["One Shot", "AI Focus", "Manual"]),
    "imageformat": ("L", ["L", "RAW + L", "RAW"]),
    "capturetarget": ("Memory card", ["Internal RAM", "Memory card"]),
    "shutterspeed": ("1/60", SHUTTERS),
    "aperture": ("5.6", ["4", "5.6", "8", "11"]),
    "iso": ("100", ["Auto", "100", "200", "400", "800"]),
}
NIKON = {
    "expprogram": ("M", None),  # its dial: it can only be read
    "capturemode": ("Single Shot", None),
    "focusmode": ("Manual", None),
    "autoiso": ("On", ["On", "Off"]),
    "imagequality": ("NEF+Fine", ["JPEG Fine", "NEF (Raw)", "NEF+Fine"]),
    "capturetarget": ("Memory card", ["Internal RAM", "Memory card"]),
    "shutterspeed": ("0.0125s", ["0.0125s", "0.0250s"]),
    "shutterspeed2": ("1/80", ["1/80", "1/40", "13/10"]),
    "f-number": ("f/8", ["f/5.6", "f/8"]),
    "focallength": (70.0, None),
    "iso": ("200", ["100", "200", "400"]),
}
SUFFIXES = {
    "RAW": "cr2", "RAW + L": "cr2", "L": "jpg", "NEF (Raw)": "nef", "NEF+Fine": "nef",
}  # fmt: skip


class GPhoto2Error(Exception):
    def __init__(self, code: int) -> None:
        texts = {-53: "Could not claim the USB device", -110: "I/O in progress"}
        super().__init__(f"[{code}] {texts.get(code, 'Unspecified error')}")
        self.code = code


class Widget:
    def __init__(self, name: str, value: Any, choices: list[str] | None) -> None:
        self.name, self.value, self.choices = name, value, choices

    def get_name(self) -> str:
        return self.name

    def get_value(self) -> Any:
        return self.value

    def set_value(self, value: Any) -> None:
        self.value = value

    def get_readonly(self) -> int:
        return int(self.choices is None)

    def get_choices(self) -> Any:
        if self.choices is None:
            raise GPhoto2Error(-2)
        return iter(self.choices)


class Names(list):
    """A CameraList."""

    count = list.__len__

    def get_name(self, index: int) -> str:
        return self[index][0]

    def get_value(self, index: int) -> str:
        return self[index][1]


class Body:
    """A camera, as it stands there: what is set, what lies in its memory, and what it sees."""

    def __init__(self, model: str, port: str, settings: dict[str, Any]) -> None:
        self.model, self.port = model, port
        self.settings = {name: list(each) for name, each in settings.items()}
        self.light, self.size = (400, 400, 400), SIZE
        self.files: dict[str, bytes] = {}
        self.shots, self.claimed, self.faults = 0, False, list[int]()
        self.refuses: set[str] = set()
        self.is_card_full = False

    def expose(self) -> bytes:
        """A RAW file; 1/60 s at ISO 100 gives the light's own level."""
        name = next(n for n in ("shutterspeed2", "shutterspeed") if n in self.settings)
        top, _, below = self.settings[name][0].rstrip("s").partition("/")
        factor = 60 * float(top) / float(below or 1) * float(self.settings["iso"][0]) / 100
        pixels = np.empty(self.size[::-1])
        for y, x, colour in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
            pixels[y::2, x::2] = self.light[colour] * factor
        return write_dng(np.minimum(np.round(pixels) + BLACK, WHITE), BLACK, WHITE)


@pytest.fixture
def bodies() -> list[Body]:
    return [Body("Canon EOS 80D", "usb:001,004", CANON)]


@pytest.fixture(autouse=True)
def library(monkeypatch, bodies):
    class Camera:
        def __init__(self) -> None:
            self.body: Body | None = None

        @staticmethod
        def autodetect() -> Names:
            return Names((body.model, body.port) for body in bodies)

        def set_port_info(self, info: str) -> None:
            self.body = next(body for body in bodies if body.port == info)

        def init(self) -> None:
            if self.body.claimed:
                raise GPhoto2Error(-53)
            self.body.claimed = True

        def exit(self) -> None:
            self.body.claimed = False

        def reach(self) -> Body:
            assert self.body.claimed
            if self.body not in bodies:
                raise GPhoto2Error(-7)
            if self.body.faults:
                raise GPhoto2Error(self.body.faults.pop(0))
            return self.body

        def list_config(self) -> Names:
            return Names((name, "") for name in self.reach().settings)

        def get_single_config(self, name: str) -> Widget:
            return Widget(name, *self.reach().settings[name])

        def set_single_config(self, name: str, widget: Widget) -> None:
            body = self.reach()
            if widget.choices is None or widget.value not in widget.choices:
                raise GPhoto2Error(-2)
            if name not in body.refuses:
                body.settings[name][0] = widget.value

        def capture(self, kind: int) -> SimpleNamespace:
            body = self.reach()
            assert kind == 0
            if body.is_card_full and "card" in body.settings["capturetarget"][0]:
                raise GPhoto2Error(-115)
            quality = body.settings[
                "imageformat" if "imageformat" in body.settings else "imagequality"
            ]
            name = f"capt{body.shots:04d}.{SUFFIXES[quality[0]]}"
            body.files[name], body.shots = body.expose(), body.shots + 1
            return SimpleNamespace(folder="/", name=name)

        def file_get(self, folder: str, name: str, kind: int) -> SimpleNamespace:
            data = self.reach().files[name]
            return SimpleNamespace(get_data_and_size=lambda: memoryview(data))

        def file_delete(self, folder: str, name: str) -> None:
            del self.reach().files[name]

    class PortInfoList:
        def load(self) -> None:
            self.ports = [body.port for body in bodies]

        def lookup_path(self, path: str) -> int:
            if path not in self.ports:
                raise GPhoto2Error(-5)
            return self.ports.index(path)

        def __getitem__(self, index: int) -> str:
            return self.ports[index]

    module = ModuleType("gphoto2")
    module.Camera, module.PortInfoList, module.GPhoto2Error = Camera, PortInfoList, GPhoto2Error
    module.GP_CAPTURE_IMAGE, module.GP_FILE_TYPE_NORMAL = 0, 1
    module.__spec__ = ModuleSpec("gphoto2", None)
    monkeypatch.setitem(sys.modules, "gphoto2", module)
    if find_spec("rawpy") is None:
        monkeypatch.setitem(sys.modules, "rawpy", stand_in_for_rawpy())
    driver_module._take_first.cache_clear()
    return module


def stand_in_for_rawpy() -> ModuleType:
    """Develops the DNGs of this file, whose pixels are the same in every group of four."""

    class Raw:
        def __init__(self, file: io.BytesIO) -> None:
            data = file.read()
            width, height = (int.from_bytes(data[at : at + 4], "little") for at in (30, 42))
            if data[:4] != b"II*\0" or len(data) < 2 * width * height:
                raise ValueError("not a RAW file")
            pixels = np.frombuffer(data[-2 * width * height :], "<u2").reshape(height, width)
            self.mosaic, self.sizes = pixels, SimpleNamespace(raw_width=width, raw_height=height)
            self.white_level, self.camera_white_level_per_channel = WHITE, None
            self.black_level_per_channel = [BLACK] * 4
            self.other = SimpleNamespace(focal_length=35.0)

        def __enter__(self) -> "Raw":
            return self

        def __exit__(self, *raised: object) -> None:
            pass

        def postprocess(self, **options: Any) -> np.ndarray:
            assert options["gamma"] == (1, 1) and options["no_auto_scale"]
            groups = [self.mosaic[y::2, x::2] for y, x in ((0, 0), (0, 1), (1, 1))]
            return np.dstack([group.repeat(2, 0).repeat(2, 1) for group in groups]) - BLACK

    module = ModuleType("rawpy")
    module.imread = Raw
    module.DemosaicAlgorithm = SimpleNamespace(LINEAR=0)
    module.ColorSpace = SimpleNamespace(raw=0)
    module.__spec__ = ModuleSpec("rawpy", None)
    return module


@pytest.fixture
def camera():
    camera = DslrCamera()
    camera.open()
    yield camera
    camera.close()


def grabbed(camera: DslrCamera) -> np.ndarray:
    out = np.full(camera.size[::-1], 7, camera.dtype)
    camera.grab(out)
    return out


def level(expected: float) -> Any:
    """Counts are whole numbers."""
    return pytest.approx(expected, abs=0.51)


def test_cameras_are_listed_and_chosen(bodies):
    assert driver("gphoto2").list_connected() == ["Canon EOS 80D, port usb:001,004"]
    bodies.append(Body("Nikon D750", "usb:001,009", NIKON))
    with raises(InputError, 2, "Canon EOS 80D", "usb:001,009"):
        DslrCamera()
    camera = DslrCamera(model="nikon d750")
    assert camera.name == "the camera Nikon D750" and isinstance(camera, ColourCamera)
    assert (camera.size, camera.dtype, camera.full_scale) == (SIZE, np.uint16, WHITE - BLACK)
    assert DslrCamera(port="usb:001,004").name == "the camera Canon EOS 80D"
    with raises(DeviceError, "Nikon D750"):
        DslrCamera(model="Nikon D850")
    bodies.clear()
    with pytest.raises(DeviceError):
        DslrCamera()


def test_packages_are_named_where_they_are_missing(monkeypatch):
    monkeypatch.delitem(sys.modules, "gphoto2")
    if find_spec("gphoto2") is None:
        with raises(DeviceError, "gphoto2", "pip install 'slviewer[dslr]'"):
            driver("gphoto2")


def test_makers_write_numbers_in_their_own_ways():
    for text, number in (
        ("1/125", 0.008), ("13/10", 1.3), ("0.0125s", 0.0125), ("30", 30.0), ("f/5.6", 5.6),
        (70.0, 70.0), ("70 mm", 70.0), ("bulb", None), ("Auto", None), ("f/0", None), ("1/0", None),
    ):  # fmt: skip
        assert driver_module._parse_number(text) == number


@pytest.mark.parametrize("settings", [CANON, NIKON])
def test_pictures_are_made_comparable_and_deleted(bodies, settings):
    body = bodies[0] = Body("Canon EOS 80D", "usb:001,004", settings)
    camera = DslrCamera(exposure_ms=24.0)
    assert body.shots == 1 and not body.claimed and not body.files
    camera.open()
    now = {name: value for name, (value, _) in body.settings.items()}
    if settings is CANON:
        assert (now["autoexposuremode"], now["drivemode"]) == ("Manual", "Single")
        assert (now["imageformat"], now["shutterspeed"]) == ("RAW", "1/30")
    else:
        assert (now["imagequality"], now["autoiso"], now["shutterspeed2"]) == (
            "NEF (Raw)", "Off", "1/40",
        )  # fmt: skip
    assert now["capturetarget"] == "Internal RAM"
    assert DslrCamera().size == SIZE and body.shots == 1  # while it is in use here
    grabbed(camera)
    assert body.shots == 2 and not body.files
    camera.close()
    assert not body.claimed


def test_levels_are_proportional_to_light_and_exposure(bodies, camera):
    bodies[0].light = (100, 400, 200)
    for channel, expected in (("red", 100), ("green", 400), ("blue", 200), ("grey", 700 / 3)):
        camera.channel = channel
        assert grabbed(camera).mean() == level(expected)
    np.testing.assert_array_equal(camera.grab_colour()[5, 5], (100, 400, 200))
    camera.channel = "blue"
    for exposure, gain, factor in ((1000 / 30, 1.0, 2), (1000 / 60, 4.0, 4), (8.0, 2.0, 120 / 125)):
        applied = camera.apply(CameraSettings(exposure, gain))
        assert applied.exposure_ms == pytest.approx(exposure) and applied.gain == gain
        assert grabbed(camera).mean() == level(200 * factor)
    camera.apply(CameraSettings(1e4))
    assert (grabbed(camera) == camera.full_scale).all()


def test_settings_are_the_nearest_that_it_has(bodies, camera):
    for wanted, applied in ((5e5, 30_000.0), (600.0, 400.0), (650.0, 1000.0), (1.0, 8.0)):
        assert camera.apply(CameraSettings(wanted)).exposure_ms == pytest.approx(applied)
    assert camera.apply(CameraSettings(gain=3.0)).gain == 4.0
    camera.close()
    camera.aperture = 10.0
    camera.open()
    assert bodies[0].settings["aperture"][0] == "11"
    with raises(InputError, "aperture", 0):
        DslrCamera(aperture=0.0)


def test_the_lens_is_read(bodies, camera):
    assert read_lens(camera)["aperture"] == 5.6
    bodies[0] = Body("Nikon D750", "usb:001,009", NIKON)
    nikon = DslrCamera()
    nikon.open()
    assert read_lens(nikon) == {"aperture": 8.0, "zoom": 70.0}
    nikon.close()


@pytest.mark.parametrize(
    ("name", "value", "facts"),
    [
        ("autoexposuremode", "AV", ("AV", "dial to M")),
        ("drivemode", "Continuous", ("Continuous", "single")),
        ("focusmode", "One Shot", ("One Shot", "MF")),
        ("imageformat", "RAW + L", ("RAW + L", "RAW alone")),
    ],
)
def test_what_it_refuses_is_named_with_its_remedy(bodies, name, value, facts):
    body = bodies[0]
    body.settings[name][0] = value
    body.refuses = {name}
    with raises(DeviceError, "Canon EOS 80D", *facts):
        DslrCamera()
    body.settings[name][1] = None  # it can only be read
    with raises(DeviceError, "Canon EOS 80D", *facts):
        DslrCamera()
    assert not body.claimed and body.shots == 0


def test_a_camera_that_stores_on_its_card_alone_is_used(bodies):
    body = bodies[0]
    body.refuses = {"capturetarget"}
    camera = DslrCamera()
    camera.open()
    assert grabbed(camera).mean() == level(400) and not body.files
    body.is_card_full = True
    with raises(DeviceError, "full", "card"):
        grabbed(camera)
    camera.close()


def test_refused_and_automatic_exposures(bodies, camera):
    bodies[0].refuses = {"shutterspeed"}
    with raises(DeviceError, "1/8", "dial to M"):
        camera.apply(CameraSettings(125.0))
    camera.close()
    bodies[0].settings["iso"][0] = "Auto"
    with raises(DeviceError, "ISO", "gain"):
        camera.open()
    del bodies[0].settings["iso"]
    with raises(DeviceError, "ISO"):
        DslrCamera(gain=1.0).open()


@pytest.mark.parametrize(
    ("code", "facts"),
    [(-53, ("gio mount",)), (-115, ("full", "card")), (-7, ("cable", "battery")), (-10, ("-10",))],
)
def test_faults_are_named_and_the_camera_opens_again(bodies, camera, code, facts):
    bodies[0].faults = [code]
    with raises(DeviceError, "Canon EOS 80D", code, *facts):
        grabbed(camera)
    camera.close()
    camera.open()
    assert grabbed(camera).mean() == level(400)


def test_a_busy_camera_is_asked_again(bodies, camera):
    bodies[0].faults = [-110, -110]
    grabbed(camera)
    bodies[0].faults = [-110] * 3
    with raises(DeviceError, -110, "MF"):
        grabbed(camera)


def test_a_camera_in_use_elsewhere_is_named(bodies):
    camera = DslrCamera()
    bodies[0].claimed = True
    with raises(DeviceError, "Could not claim the USB device", "file managers"):
        camera.open()
    bodies[0].claimed = False
    camera.open()
    camera.close()


def test_an_unplugged_camera_opens_at_its_new_port(bodies, camera):
    body = bodies.pop()
    with raises(DeviceError, "cable"):
        grabbed(camera)
    camera.close()
    with pytest.raises(DeviceError):
        camera.open()
    body.port = "usb:001,005"
    bodies.append(body)
    camera.open()
    assert grabbed(camera).mean() == level(400)


def test_pictures_that_are_not_comparable_are_refused(bodies, camera):
    bodies[0].settings["imageformat"][0] = "L"  # at the camera, meanwhile
    with raises(DeviceError, "capt0001.jpg", "RAW"):
        grabbed(camera)
    bodies[0].settings["imageformat"][0] = "RAW"
    bodies[0].size = (48, 32)
    with raises(DeviceError, "48x32", "96x64"):
        grabbed(camera)
    assert not bodies[0].files
    bodies[0].expose = lambda: b"II*\0 cut short"
    with raises(DeviceError, "Canon EOS 80D", "capt0003.cr2"):
        grabbed(camera)
    del bodies[0].expose
    camera.close()
    assert DslrCamera().size == (48, 32)


def test_a_capture_of_a_sequence(bodies, camera):
    def show(light: int) -> None:
        bodies[0].light = (light,) * 3

    projector = preset_rig(scale=0.05).projector
    projector.show = lambda index: show(100 + 7 * index)
    projector.show_level = show
    projector.open()
    rig, sequence = Rig("bench", camera, projector), gray(projector.size)
    frames = capture_frames(rig, sequence)
    for k, frame in enumerate(frames):
        assert (frame == 100 + 7 * k).all()
    assert (capture_colour(rig) == 255).all()
    bodies[0].faults = [-7]
    with raises(DeviceError, f"frame 1 of {len(frames)}", "cable"):
        capture_frames(rig, sequence)
