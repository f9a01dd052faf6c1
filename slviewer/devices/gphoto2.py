"""DSLR and mirrorless cameras at a USB port, through libgphoto2 (the package gphoto2): each frame
is one RAW picture, developed without a tone curve.

What makers call settings and choices: libgphoto2's camlibs/ptp2/config.c, and the lists of its
camlibs/ptp2/cameras.
"""

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import (
    CameraDriver,
    CameraSettings,
    Channel,
    check_channel,
    choose_only,
    extract_channel,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.raw_image import RAW_SUFFIXES, RawImage, develop

_BUSY, _TRIES = -110, 3
_BASE_ISO = 100
_SHUTTER, _ISO = ("shutterspeed2", "shutterspeed"), ("iso",)
_APERTURE, _FOCAL = ("aperture", "f-number"), ("focallength",)
_NUMBER = re.compile(r"(?:f/)?(\d+(?:\.\d+)?)(?:/([1-9][\d.]*))?(?: ?(?:s|mm))?")

_REQUIRED = (
    ("exposure mode", ("autoexposuremode", "expprogram"), "m|manual", "turn its dial to M"),
    ("drive mode", ("drivemode", "capturemode"), "single.*", "set it to single frames"),
    ("focus mode", ("focusmode",), "manual|mf.*", "set its lens to MF, and focus by hand"),
    ("automatic ISO", ("autoiso",), "off", "switch it off in its menu"),
    ("image quality", ("imageformat", "imagequality"), r"c?raw|nef \(raw\)", "set it to RAW alone"),
    ("capture target", ("capturetarget",), "internal ram|sdram", ""),  # a card is slower
)
"""Settings with which frames can be compared: words, names, choices that are right, and the remedy
where the camera does not take one; "" where it may refuse."""

_REMEDIES = {
    _BUSY: "set its lens to MF, as the shutter waits for the focus, and wait until its pictures are"
    " stored",
    -115: "its memory is full: empty its card, or take it out",
    -105: "plug it in, and switch it on",
    -53: "close what else uses it, such as photo programs and file managers (on GNOME, run gio"
    " mount -s gphoto2)",
    -52: "plug it in, and switch it on",
}
"""By the errors of gphoto2-result.h and gphoto2-port-result.h."""


@contextlib.contextmanager
def _as_device_error(name: str) -> Iterator[None]:
    """Convert errors of libgphoto2 to a DeviceError about `name`."""
    import gphoto2

    try:
        yield
    except gphoto2.GPhoto2Error as error:
        remedy = _REMEDIES.get(
            error.code,
            "switch it off and on, check its cable and battery, and disable its power saving",
        )
        raise DeviceError(f"{name} does not answer ({error})", remedy) from error


def _parse_number(value: object) -> float | None:
    """Return the number of "1/125", "0.0125s", "f/5.6", "70 mm" or 70.0; None of "bulb", "Auto"."""
    match = _NUMBER.fullmatch(str(value).strip())
    return (float(match[1]) / float(match[2] or 1) or None) if match else None


class _Link:
    """An open camera; every method raises DeviceError where it does not answer."""

    def __init__(self, name: str, port: str) -> None:
        import gphoto2

        self._name = name
        self._camera = gphoto2.Camera()
        with _as_device_error(name):
            ports = gphoto2.PortInfoList()
            ports.load()
            self._camera.set_port_info(ports[ports.lookup_path(port)])
            self._camera.init()
            listed = self._camera.list_config()
            self._names = {listed.get_name(k) for k in range(listed.count())}

    def close(self) -> None:
        """Release the camera."""
        with contextlib.suppress(Exception):
            self._camera.exit()

    def prepare(self) -> None:
        """Set what `_REQUIRED` lists. Raises DeviceError where the camera refuses."""
        for what, names, right, remedy in _REQUIRED:
            fits = re.compile(right, re.IGNORECASE).fullmatch
            widget = self._find(names)
            if widget is None or fits(value := widget.get_value()):
                continue
            choice = next(filter(fits, self._list_choices(widget)), None)
            if (choice is None or not self._set(widget, choice)) and remedy:
                raise DeviceError(f"the {what} of {self._name} is {value!r}", remedy)

    def read_number(self, names: tuple[str, ...]) -> float | None:
        """Read the number that the first setting of these names has; None without any."""
        widget = self._find(names)
        return None if widget is None else _parse_number(widget.get_value())

    def set_nearest(self, what: str, names: tuple[str, ...], wanted: float) -> None:
        """Set the choice whose ratio to `wanted` is nearest to 1."""
        widget = self._find(names)
        choices = {
            number: choice
            for choice in (self._list_choices(widget) if widget is not None else ())
            if (number := _parse_number(choice))
        }
        if not choices:
            raise DeviceError(
                f"{self._name} offers no {what} to be set",
                "turn its dial to M, or set it at the camera",
            )
        nearest = min(choices, key=lambda number: abs(math.log(number / wanted)))
        if not self._set(widget, choices[nearest]):
            raise DeviceError(
                f"{self._name} refused the {what} {choices[nearest]}",
                "turn its dial to M, or set it at the camera",
            )

    def capture(self) -> RawImage:
        """Take a picture, delete it from the camera, and develop it."""
        import gphoto2

        with _as_device_error(self._name):
            for attempt in range(_TRIES):
                try:
                    path = self._camera.capture(gphoto2.GP_CAPTURE_IMAGE)
                    break
                except gphoto2.GPhoto2Error as error:
                    if error.code != _BUSY or attempt == _TRIES - 1:
                        raise
            where = path.folder, path.name
            file = self._camera.file_get(*where, gphoto2.GP_FILE_TYPE_NORMAL)
            data = bytes(file.get_data_and_size())
            with contextlib.suppress(gphoto2.GPhoto2Error):  # some have deleted it by now
                self._camera.file_delete(*where)
        if PurePath(path.name).suffix.lower() not in RAW_SUFFIXES:
            raise DeviceError(
                f"{self._name} sent {path.name}, which has a tone curve",
                "set its image quality to RAW alone",
            )
        try:
            return develop(data, path.name)
        except InputError as error:
            raise DeviceError(f"{self._name} sent a damaged picture, {error}") from error

    def _find(self, names: tuple[str, ...]) -> Any:
        """Return the widget of the first of these names that the camera has; None without any."""
        name = next((name for name in names if name in self._names), None)
        with _as_device_error(self._name):
            return None if name is None else self._camera.get_single_config(name)

    def _list_choices(self, widget: Any) -> list[str]:
        """Return the choices of a setting; none where it can only be read."""
        with _as_device_error(self._name):
            return [] if widget.get_readonly() else list(widget.get_choices())

    def _set(self, widget: Any, choice: str) -> bool:
        """Set a choice; returns whether the camera reports it afterwards."""
        import gphoto2

        with contextlib.suppress(gphoto2.GPhoto2Error):  # what it has then is read
            widget.set_value(choice)
            self._camera.set_single_config(widget.get_name(), widget)
        found = self._find((widget.get_name(),))
        return bool(found.get_value() == choice)


@cache
def _take_first(name: str, port: str) -> tuple[tuple[int, int], int]:
    """Take a picture, and return its size (width, height) px and full scale, which are those of
    all."""
    link = _Link(name, port)
    try:
        link.prepare()
        image = link.capture()
    finally:
        link.close()
    height, width = image.rgb.shape[:2]
    return (width, height), image.full_scale


@dataclass(eq=False)
class DslrCamera(CameraDriver):
    """The connected camera of that model, or at that `port` of libgphoto2, or the only one. Frames
    are levels of its sensor above black, of one `channel`.

    `exposure_ms`, `gain` (1 is ISO 100) and `aperture` (f-number) are set when it is opened, None:
    unchanged, to the nearest that it has. `preview_s` passes between the wizard's live images, each
    of which releases its shutter. A picture is taken at once, for its size. Raises InputError where
    several cameras fit, DeviceError where none does, or one refuses what `_REQUIRED` lists.
    """

    model: str | None = None
    port: str | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    aperture: float | None = None
    channel: Channel = "green"
    preview_s: float = 10.0

    dtype = np.dtype(np.uint16)

    def __post_init__(self) -> None:
        check_channel(self.channel)
        self._first = CameraSettings(self.exposure_ms, self.gain)
        if self.aperture is not None and not 0 < self.aperture < 1000:
            raise InputError(
                f"an aperture of {self.aperture:g} is impossible", "give an f-number, such as 8"
            )
        self._model, self._port = _choose_camera(self.model, self.port)
        super().__init__(f"the camera {self._model}")
        self.size, self.full_scale = _take_first(self.name, self._port)
        self._link: _Link | None = None
        self._focal_mm = 0.0

    def _start(self) -> None:
        """Claim the camera, and make its pictures comparable."""
        # a camera that was plugged in again has another port
        self._port = _choose_camera(self._model, self.port)[1]
        link = self._link = _Link(self.name, self._port)
        self._claimed.callback(link.close)
        link.prepare()
        if self.aperture is not None:
            link.set_nearest("aperture", _APERTURE, self.aperture)
        settings = self.apply(self._first)
        if settings.exposure_ms is None or settings.gain is None:
            what = "exposure time" if settings.exposure_ms is None else "ISO"
            raise DeviceError(
                f"the {what} of {self.name} is automatic",
                "set it at the camera, or in the rig's file (exposure_ms, gain)",
            )

    def _fill(self, out: np.ndarray) -> None:
        extract_channel(self.grab_colour(), self.channel, out)

    def grab_colour(self) -> np.ndarray:
        """Take a picture, (h, w, 3) RGB."""
        image = self._get_link().capture()
        height, width = image.rgb.shape[:2]
        if (width, height) != self.size:
            _take_first.cache_clear()
            raise DeviceError(
                f"{self.name} sent a picture of {width}x{height} px, not"
                f" {self.size[0]}x{self.size[1]}",
                "choose it anew",
            )
        self._focal_mm = image.focal_mm
        return image.rgb

    def _read_settings(self) -> CameraSettings:
        """Return the nominal exposure and the gain, None for what is automatic."""
        seconds, iso = map(self._get_link().read_number, (_SHUTTER, _ISO))
        return CameraSettings(seconds and 1000 * seconds, iso and iso / _BASE_ISO)

    def _read_lens(self) -> dict[str, float]:
        """Return the f-number, and the focal length in mm as its zoom."""
        link = self._get_link()
        zoom = link.read_number(_FOCAL) or self._focal_mm
        found = {"aperture": link.read_number(_APERTURE), "zoom": zoom}
        return {what: value for what, value in found.items() if value}

    def _write_settings(self, settings: CameraSettings) -> None:
        link = self._get_link()
        if settings.exposure_ms is not None:
            link.set_nearest("exposure time", _SHUTTER, settings.exposure_ms / 1000)
        if settings.gain is not None:
            link.set_nearest("ISO", _ISO, settings.gain * _BASE_ISO)

    def _get_link(self) -> _Link:
        """Return the link. Raises DeviceError unless the camera is open."""
        self.check_open()
        assert self._link
        return self._link


class _Found(NamedTuple):
    """A connected camera."""

    model: str
    port: str

    def __str__(self) -> str:
        return " at ".join(self)


def _list_found() -> list[_Found]:
    """List the connected cameras."""
    import gphoto2

    with _as_device_error("libgphoto2"):
        found = gphoto2.Camera.autodetect()
        return [_Found(found.get_name(k), found.get_value(k)) for k in range(found.count())]


def _choose_camera(model: str | None, port: str | None) -> _Found:
    """Return the only camera that fits."""
    return choose_only(
        _list_found(),
        lambda each: (
            (model is None or model.casefold() == each.model.casefold())
            and port in (None, each.port)
        ),
        "`port`",
    )


def list_dslr_cameras() -> list[str]:
    """List the connected cameras, model and port."""
    return [f"{model}, port {port}" for model, port in _list_found()]


_INSTALL = "pip install 'slviewer[dslr]'"
DRIVER = Driver(
    "gphoto2",
    "a DSLR or mirrorless camera at USB (Canon, Nikon, Sony, …), by its RAW pictures",
    needs="a camera in mode M with its lens at MF, that libgphoto2 knows; not on Windows",
    packages={"gphoto2": _INSTALL, "rawpy": _INSTALL},
    camera=DslrCamera,
    list_connected=list_dslr_cameras,
)
