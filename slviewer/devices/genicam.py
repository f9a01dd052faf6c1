"""USB3 Vision and GigE Vision cameras, through the GenTL producer that their maker installs.

`Features` are those for a structured-light rig: exposure in ms, gain as a factor, a trigger, no
automatics. A node map is any object with a camera's nodes as attributes; its nodes are those of
`genicam.genapi`.
"""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.gentl import (
    Image,
    Link,
    NoFrameError,
    as_device_error,
    list_cameras,
    open_node_map,
)
from slviewer.devices.pixel_formats import PixelFormat, best_format, pixel_format
from slviewer.devices.protocols import (
    CameraDriver,
    CameraSettings,
    Channel,
    check_channel,
    check_frame,
    choose_only,
    extract_channel,
)
from slviewer.errors import DeviceError, InputError

Trigger = Literal["software", "hardware", "free"]

# EAccessMode: 1 not now, 2 write, 3 read, 4 both
_IMPLEMENTED, _READABLE, _WRITABLE = ((1, 2, 3, 4), (3, 4), (2, 4))
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")  # the second is older GigE cameras'
_MS = {"ns": 1e-6, "us": 1e-3, "µs": 1e-3, "μs": 1e-3, "ms": 1.0, "s": 1e3}
_LENS = {
    "focus": ("FocusStepper", "Focus", "FocalPower"),
    "zoom": ("Zoom", "FocalLength"),
    "aperture": ("ApertureStepper", "Iris", "Aperture"),
}
"""Features of the optics, by rising precedence."""
_AUTOMATIC = ("ExposureAuto", "GainAuto", "BalanceWhiteAuto", "BlackLevelAuto")
_ALTERING = (
    "AcquisitionFrameRateEnable",
    "AcquisitionFrameRateEnabled",
    "GammaEnable",
    "GammaEnabled",
    "LUTEnable",
)
_FRAME_TRIGGERS = ("FrameStart", "ExposureStart")


class Features:
    """The GenICam features of a camera called `name`. Every method raises DeviceError if it does
    not answer."""

    def __init__(self, node_map: Any, name: str) -> None:
        self._nodes, self._name = node_map, name

    def size(self) -> tuple[int, int]:
        """Return the (width, height) px of its images: the whole sensor, or the region that is set
        in it."""
        width, height = self._get_node("Width"), self._get_node("Height")
        if width is None or height is None:
            raise DeviceError(f"{self._name} does not report its image size", "use another camera")
        with as_device_error(self._name):
            return int(width.value), int(height.value)

    def choose_format(self, wanted: str | None = None) -> PixelFormat:
        """Choose the pixel format, `wanted` or the best. Raises InputError for one that is not
        offered or not supported.
        """
        offered = self._list_choices("PixelFormat")
        usable = [name for name in offered if pixel_format(name) is not None]
        chosen = (
            best_format(usable)
            if wanted is None
            else pixel_format(wanted)
            if wanted in offered
            else None
        )
        if chosen is None:
            missing = "none that can be read" if wanted is None else f"no {wanted} that can be read"
            raise InputError(
                f"{self._name} offers {missing}",
                f"use one of {', '.join(usable) or 'another camera'} as pixel_format",
            )
        return chosen

    def choose_trigger(self, wanted: Trigger | None, line: str | None) -> Trigger:
        """Choose what starts an exposure: `wanted`, else software where supported, else free
        running.

        Raises InputError for a trigger or a line that the camera lacks.
        """
        if wanted is not None and wanted not in get_args(Trigger):
            raise InputError(
                f"no trigger is called {wanted!r}", f"use one of {', '.join(get_args(Trigger))}"
            )
        has_mode = "On" in self._list_choices("TriggerMode")
        sources = self._list_choices("TriggerSource") if has_mode else []
        software = (
            "Software" in sources and self._get_node("TriggerSoftware", _IMPLEMENTED) is not None
        )
        if wanted is None:
            return "software" if software else "free"
        if wanted == "software" and not software:
            raise InputError(
                f"{self._name} has no software trigger", "leave `trigger` out, and it runs free"
            )
        lines = [source for source in sources if source not in ("Software", "Off")]
        if wanted == "hardware" and (line is None or line not in lines):
            if not lines:
                raise InputError(f"{self._name} has no trigger lines", "leave `trigger` out")
            missing = f"no trigger line {line!r}" if line else "a trigger line to be named"
            raise InputError(
                f"{self._name} has {missing}", f"use one of {', '.join(lines)} as `line`"
            )
        return wanted

    def check_settings(self, wanted: CameraSettings) -> None:
        """Raise InputError for settings that the camera has no feature for."""
        if wanted.exposure_ms is not None and self._get_exposure_node() is None:
            raise InputError(
                f"{self._name} has no exposure time that can be set", "leave exposure_ms out"
            )
        if wanted.gain is not None and self._get_gain_node() is None:
            gain = self._get_node("Gain")
            why = "no gain" if gain is None else "a gain in device-specific steps of unknown factor"
            raise InputError(
                f"{self._name} has {why}", "leave `gain` out, and set it with its maker's software"
            )

    def prepare(self, chosen: PixelFormat, trigger: Trigger, line: str | None) -> None:
        """Configure comparable frames: no automatics, grey levels proportional to light, this
        format and trigger."""
        with as_device_error(self._name):
            self._choose("PixelFormat", chosen.name)
            self._choose("AcquisitionMode", "Continuous")
            self._choose("ExposureMode", "Timed")
            for name in _AUTOMATIC:
                self._choose(name, "Off")
            for name in _ALTERING:
                if (node := self._get_node(name, _WRITABLE)) is not None:
                    node.value = False
            if (gamma := self._get_node("Gamma", _WRITABLE)) is not None:
                _set_nearest(gamma, 1.0)
            self._choose("GainSelector", "All")
            self._set_trigger(trigger, line)
            current = self._get_node("PixelFormat")
            if current is None or current.value != chosen.name:
                raise DeviceError(
                    f"{self._name} did not accept the pixel format {chosen.name}",
                    "choose another one",
                )

    def release(self) -> None:
        """Restore free running, which other programs expect."""
        with as_device_error(self._name):
            self._set_trigger("free", None)

    def fire(self) -> None:
        """Start an exposure by software."""
        with as_device_error(self._name):
            self._nodes.TriggerSoftware.execute()

    def settings(self) -> CameraSettings:
        """Read the current settings; None for those that the camera lacks, and for a gain of
        unknown factor."""
        with as_device_error(self._name):
            exposure, gain = self._get_exposure_node(), self._get_gain_node()
            return CameraSettings(
                None if exposure is None else float(exposure.value) * _ms_per_unit(exposure),
                None if gain is None else 10 ** (float(gain.value) / 20),
            )

    def read_lens(self) -> dict[str, float]:
        """Read the focus, zoom and aperture that a camera with a motorised or a liquid lens has."""
        with as_device_error(self._name):
            found = {
                what: node
                for what, names in _LENS.items()
                for name in names
                if (node := self._get_node(name)) is not None
            }
            return {what: float(node.value) for what, node in found.items()}

    def apply(self, settings: CameraSettings) -> None:
        """Set the nearest supported values of the settings that the camera has."""
        with as_device_error(self._name):
            exposure, gain = self._get_exposure_node(), self._get_gain_node()
            if settings.exposure_ms is not None and _is_settable(exposure):
                _set_nearest(exposure, settings.exposure_ms / _ms_per_unit(exposure))
            if settings.gain is not None and _is_settable(gain):
                _set_nearest(gain, 20 * math.log10(settings.gain))

    def _get_exposure_node(self) -> Any:
        """Return the readable node of the exposure time; None where there is none."""
        return next(
            (node for name in _EXPOSURES if (node := self._get_node(name)) is not None), None
        )

    def _get_gain_node(self) -> Any:
        """Return the readable node of the gain, if its unit is dB; else None."""
        gain = self._get_node("Gain")
        return (
            gain
            if gain is not None and str(getattr(gain, "unit", "")).strip().lower() == "db"
            else None
        )

    def _set_trigger(self, trigger: Trigger, line: str | None) -> None:
        """Switch every trigger off but the one that starts each frame."""
        selectors = self._list_choices("TriggerSelector")
        for selector in selectors or [""]:
            self._choose("TriggerSelector", selector)
            self._choose("TriggerMode", "Off")
        if trigger == "free":
            return
        self._choose(
            "TriggerSelector", next((name for name in _FRAME_TRIGGERS if name in selectors), "")
        )
        source = "Software" if trigger == "software" else line
        if not (self._choose("TriggerSource", source or "") and self._choose("TriggerMode", "On")):
            raise DeviceError(
                f"{self._name} did not accept the trigger {source}", "choose another one"
            )

    def _list_choices(self, name: str) -> list[str]:
        """List the readable entries of the enumeration `name`."""
        node = self._get_node(name)
        if node is None:
            return []
        with as_device_error(self._name):
            return [
                entry.symbolic for entry in node.entries if entry.get_access_mode() in _READABLE
            ]

    def _choose(self, name: str, choice: str) -> bool:
        """Set the enumeration `name` to `choice`; False where the camera does not offer it."""
        if choice not in self._list_choices(name):
            return False
        node = getattr(self._nodes, name)
        if node.value != choice:
            node.value = choice
        return True

    def _get_node(self, name: str, access: tuple[int, ...] = _READABLE) -> Any:
        """Return the node `name`, if it has one of these access modes now; else None."""
        with as_device_error(self._name):
            node = getattr(self._nodes, name, None)
            return node if node is not None and node.get_access_mode() in access else None


def _is_settable(node: Any) -> bool:
    """Whether a node exists and can be written now."""
    return node is not None and node.get_access_mode() in _WRITABLE


def _ms_per_unit(exposure: Any) -> float:
    """Return the length of the exposure node's unit in ms; microseconds, as in the standard, where
    it names none."""
    return _MS.get(str(getattr(exposure, "unit", "")).strip(), 1e-3)


def _set_nearest(node: Any, wanted: float) -> None:
    """Set a numeric node to the nearest valid value."""
    low, high = node.min, node.max
    whole = isinstance(low, int)
    step = node.inc if whole or node.has_inc() else 0
    value = min(max(wanted, low), high)
    if step:
        value = low + round((value - low) / step) * step
        value = value if value <= high else value - step
    node.value = int(value) if whole else float(value)


IN_FLIGHT = 2
"""Frames of a camera that runs by its own clock, or a line's, that may have begun before a call and
arrive after it: one that is being exposed, and the one before, which is being read out and sent."""

_ANSWER_TIMEOUT_S = 2.0
_SENDING_S = 0.1
"""What an image takes to arrive after its exposure."""


@dataclass(eq=False)
class GenicamCamera(CameraDriver):
    """The connected camera of that serial number or model, or the only one there is: it delivers
    grey levels unprocessed, uint8, or uint16 with its 10 or 12 bits at the bottom.

    With a software trigger each grab starts its own exposure. Of a camera that runs free, or by a
    line whose pulses repeat (a projector's frame clock), buffers are discarded until one comes
    whose exposure began after the call. A frame that is late or incomplete is a DeviceError, and
    never mistaken for the next: the stream is restarted after it.

    `producer` is the .cti file of its maker's software, None: all that are installed. `exposure_ms`
    and `gain` are set when it is opened, None: unchanged. `pixel_format` None: the deepest mono of
    up to 12 bits that comes unpacked; of a colour camera its colours, of which `grab` decodes the
    `channel`, and `grab_colour` all three. `trigger` "software" (where it has one), "hardware" with
    the name of its `line`, or "free"; by hardware it also takes the bursts of a projector that
    triggers it. Raises InputError for what the camera has not, or where several fit; DeviceError
    where none is connected.
    """

    producer: str | None = None
    serial: str | int | None = None
    model: str | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    pixel_format: str | None = None
    channel: Channel = "green"
    trigger: Trigger | None = None
    line: str | None = None

    def __post_init__(self) -> None:
        check_channel(self.channel)
        serial = None if self.serial is None else str(self.serial)
        self._camera = choose_only(
            list_cameras(self.producer),
            lambda each: (
                serial in (None, each.serial)
                and (self.model is None or self.model.casefold() == each.model.casefold())
            ),
            "`serial` number",
        )
        super().__init__(f"the camera {self._camera}")
        self._first = CameraSettings(self.exposure_ms, self.gain)
        with open_node_map(self._camera) as node_map:
            features = Features(node_map, self.name)
            self.pixels = features.choose_format(self.pixel_format)
            self._trigger = features.choose_trigger(self.trigger, self.line)
            features.check_settings(self._first)
            self.size = features.size()
        self.dtype, self.full_scale = self.pixels.dtype, 2**self.pixels.bits - 1
        if self.pixels.colour:
            self.grab_colour = self._grab_colour  # which makes it a `ColourCamera`
        if self._trigger == "hardware":
            self.arm = self._arm  # which makes it a `TriggeredCamera`
        self._link: Link | None = None
        self._timeout_s = _ANSWER_TIMEOUT_S

    def _start(self) -> None:
        """Claim the camera and start it. Raises DeviceError where it is gone, in use or was
        reconfigured."""
        self._link = Link(self._camera)
        features = self._get_features()
        features.prepare(self.pixels, self._trigger, self.line)
        if features.size() != self.size:
            (width, height), (columns, rows) = features.size(), self.size
            raise DeviceError(
                f"{self.name} has images of {width}x{height} px, no longer {columns}x{rows}",
                "choose it anew",
            )
        self.apply(self._first)
        self._link.start()

    def close(self) -> None:
        """Release the camera, in free-running mode."""
        super().close()
        link, self._link = self._link, None
        if link:
            link.stop()
            with contextlib.suppress(Exception):
                Features(link.node_map, self.name).release()
            link.close()

    def _fill(self, out: np.ndarray) -> None:
        with self._grab_fresh() as image:
            self._unpack(image, out)

    def _arm(self, frames: int) -> None:
        """Wait for up to `frames` triggers from now on."""
        self.check_open()
        assert self._link
        self._link.stop()
        self._link.start(frames)

    def fetch(self, out: np.ndarray) -> bool:
        """Fill `out` (h, w) with the next triggered frame; False where none comes any more."""
        check_frame(self, out)
        try:
            with self._next_image(self._timeout_s - _ANSWER_TIMEOUT_S + _SENDING_S) as image:
                self._unpack(image, out)
        except NoFrameError:
            return False
        return True

    def disarm(self) -> None:
        """Stop waiting, and discard what is left."""
        if self._link:
            self._link.stop()

    def _unpack(self, image: Image, out: np.ndarray) -> None:
        """Write what is decoded of an image."""
        if self.pixels.colour:
            extract_channel(self._convert_rgb(image), self.channel, out)
        else:
            self.pixels.unpack(image.data, out, image.padding)

    def _grab_colour(self) -> np.ndarray:
        """Grab a frame whose exposure began after the call, (h, w, 3) RGB."""
        self.check_open()
        with self._grab_fresh() as image:
            return np.array(self._convert_rgb(image))

    def _convert_rgb(self, image: Image) -> np.ndarray:
        """Convert the bytes of an image to (h, w, 3) RGB."""
        return self.pixels.rgb(self.pixels.view_samples(image.data, image.size, image.padding))

    def _read_settings(self) -> CameraSettings:
        return self._get_features().settings()

    def _read_lens(self) -> dict[str, float]:
        return self._get_features().read_lens()

    def _write_settings(self, settings: CameraSettings) -> None:
        """Set them, and wait longer for frames of longer exposures."""
        features = self._get_features()
        features.apply(settings)
        exposure_ms = features.settings().exposure_ms
        self._timeout_s = _ANSWER_TIMEOUT_S + (exposure_ms or 0.0) / 1000

    @contextlib.contextmanager
    def _grab_fresh(self) -> Iterator[Image]:
        """Yield an image whose exposure began after the call; after an error the stream is
        stopped."""
        link = self._link
        assert link
        try:
            if not link.streaming:
                link.start()
            link.drop_filled()
            if self._trigger == "software":
                self._get_features().fire()
            else:
                for _ in range(IN_FLIGHT):
                    link.drop_next(self._timeout_s)
            with self._next_image(self._timeout_s) as image:
                yield image
        except BaseException:
            link.stop()  # what is still on its way must not be the next grab's
            raise

    @contextlib.contextmanager
    def _next_image(self, timeout_s: float) -> Iterator[Image]:
        """Yield the next image. Raises DeviceError for one of another size."""
        self.check_open()
        assert self._link
        with self._link.next(timeout_s, self.pixels.nbytes) as image:
            if image.size != self.size:
                raise DeviceError(
                    f"{self.name} sent a frame of {image.size}, not {self.size}", "choose it anew"
                )
            yield image

    def _get_features(self) -> Features:
        """Return the features of the open camera."""
        assert self._link
        return Features(self._link.node_map, self.name)


def list_genicam_cameras() -> list[str]:
    """List the connected cameras: maker, model, serial number. Raises DeviceError without
    producers."""
    return [str(camera) for camera in list_cameras()]


_INSTALL = "pip install 'slviewer[genicam]'"
DRIVER = Driver(
    "genicam",
    "a USB3 Vision or GigE Vision camera (FLIR, Basler, IDS, …)",
    needs="the software of the camera's maker, which brings a GenTL producer (a .cti file)",
    packages={"harvesters": _INSTALL, "genicam": _INSTALL},
    camera=GenicamCamera,
    list_connected=list_genicam_cameras,
)
