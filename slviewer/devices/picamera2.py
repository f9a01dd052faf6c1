"""The camera modules of a Raspberry Pi, through its package picamera2: the raw stream of the
sensor, before black level, white balance and tone curve. No crop (ScalerCrop) applies to it.

Controls, metadata and configurations: "The Picamera2 Library",
https://datasheets.raspberrypi.com/camera/picamera2-manual.pdf.
"""

import contextlib
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.pixel_formats import PixelFormat, pixel_format
from slviewer.devices.protocols import (
    CameraDriver,
    CameraSettings,
    Channel,
    check_channel,
    check_image_size,
    extract_channel,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import Size

_ANSWER_S = 3.0
_MOST_FRAMES = 20
"""Frames that began before a call, or have the previous settings; fewer are queued by sensor,
driver and library."""
_SHIFTED_FULL_SCALE = 0xFFC0  # a Raspberry Pi 5 moves the sensor's 10 or 12 bits to the top of 16
_FIXED = {"AeEnable": False, "AwbEnable": False, "AfMode": 0}
_CHECK = (
    "check its ribbon cable with the power off, close other programs that use it, and see what"
    " `rpicam-hello --list-cameras` finds"
)


@contextlib.contextmanager
def _as_device_error(name: str) -> Iterator[None]:
    """Convert what picamera2 and libcamera raise to a DeviceError about `name`."""
    try:
        yield
    except (ImportError, RuntimeError, OSError) as error:  # TimeoutError is an OSError
        reason = str(error) or type(error).__name__
        raise DeviceError(f"{name} does not answer ({reason})", _CHECK) from error


def _open_camera(number: int, size: Size | None) -> tuple[Any, dict[str, Any]]:
    """Return the camera, open and configured, and its raw stream's actual "format", "size" and
    "stride"."""
    from picamera2 import Picamera2

    camera = Picamera2(number)
    try:
        wanted = size or camera.sensor_resolution
        unpacked = str(camera.sensor_format).split("_")[0]  # SRGGB12 of SRGGB12_CSI2P
        camera.configure(
            camera.create_still_configuration(
                main={"size": (640, 480)},
                raw={"format": unpacked, "size": tuple(wanted)},
                buffer_count=2,  # with one, frames are dropped
                queue=False,
            )
        )
        raw = camera.camera_configuration()["raw"]
        if raw is None:
            raise InputError(
                f"the camera {number} is not a camera module, and has no raw stream",
                "use the driver opencv",
            )
    except BaseException:
        camera.close()
        raise
    return camera, raw


@cache
def _describe_stream(number: int, size: Size | None) -> tuple[Size, str]:
    """Return size and format of a camera's raw stream, once: it cannot be opened twice."""
    camera, raw = _open_camera(number, size)
    camera.close()
    return tuple(raw["size"]), raw["format"]


def _parse_format(name: str) -> PixelFormat | None:
    """Return the format that libcamera calls SRGGB12 or R10; None for a packed one."""
    match = re.fullmatch(r"S?([RGB]+)(\d+)", name)
    if match is None:
        return None
    kind = "Mono" if match[1] == "R" else f"Bayer{match[1][:2]}"
    return pixel_format(f"{kind}{match[2]}")


@dataclass(eq=False)
class PiCamera(CameraDriver):
    """The camera module of that `number`, 0 being the first. Frames hold 10 or 12 bits, at the top
    of 16 on a Raspberry Pi 5, above the sensor's black level; of a colour sensor the mosaic is
    interpolated, and `grab` decodes the `channel`.

    `size`: (width, height) px of one of the sensor's modes, None: all its pixels. `exposure_ms`,
    `gain` and `focus` (dioptres, 1 / m; None: as it is) are set when it is opened, and nothing is
    automatic. Raises InputError for a size that it has not, DeviceError where it does not answer.
    """

    number: int = 0
    size: Size = None  # type: ignore[assignment]  # until it is known
    exposure_ms: float = 10.0
    gain: float = 1.0
    focus: float | None = None
    channel: Channel = "green"

    def __post_init__(self) -> None:
        check_channel(self.channel)
        self._first = CameraSettings(self.exposure_ms, self.gain)
        super().__init__(f"the Raspberry Pi camera {self.number}")
        self._wanted = None if self.size is None else check_image_size("camera", self.size)
        with _as_device_error(self.name):
            self.size, self._format = _describe_stream(self.number, self._wanted)
        pixels = _parse_format(self._format)
        if pixels is None:
            raise InputError(
                f"{self.name} sends {self._format}, which cannot be read", "update picamera2"
            )
        if self._wanted not in (None, self.size):
            (width, height), (columns, rows) = self._wanted, self.size
            raise InputError(
                f"{self.name} has no mode of {width}x{height} px",
                f"choose [{columns}, {rows}] as `size`, which is the nearest, or another of its"
                " modes",
            )
        self.pixels = pixels
        self.dtype = pixels.dtype
        self.full_scale = _SHIFTED_FULL_SCALE if pixels.bits == 16 else 2**pixels.bits - 1
        if pixels.colour:
            self.grab_colour = self._grab_colour  # which makes it a `ColourCamera`
        self._camera: Any = None
        self._padding = 0
        self._metadata: dict[str, Any] = {}

    def _start(self) -> None:
        """Claim the camera and start it with fixed settings. Raises DeviceError where it is gone or
        in use."""
        with _as_device_error(self.name):
            self._camera, raw = _open_camera(self.number, self._wanted)
            self._claimed.callback(self._camera.close)
            if (tuple(raw["size"]), raw["format"]) != (self.size, self._format):
                _describe_stream.cache_clear()
                raise DeviceError(f"{self.name} is another one than before", "choose it anew")
            self._padding = raw["stride"] - self.pixels.nbytes((self.size[0], 1))
            self._set(_FIXED | ({} if self.focus is None else {"LensPosition": self.focus}))
            self._camera.start()
        self._metadata = {}
        self.apply(self._first)

    def _fill(self, out: np.ndarray) -> None:
        samples = self._grab_samples()
        if self.pixels.colour:
            extract_channel(self.pixels.rgb(samples), self.channel, out)
        else:
            np.copyto(out, samples)

    def _grab_colour(self) -> np.ndarray:
        """Grab a frame whose exposure began after the call, (h, w, 3) RGB."""
        self.check_open()
        return np.array(self.pixels.rgb(self._grab_samples()))

    def _grab_samples(self) -> np.ndarray:
        """Return the samples (h, w) of a frame whose exposure began after the call."""
        called_ns = time.monotonic_ns()  # SensorTimestamp counts on this clock
        for _ in range(_MOST_FRAMES):
            with self._next_request() as request:
                # it is when the first row is read out, at the end of its exposure
                began_ns = self._metadata["SensorTimestamp"] - 1000 * self._metadata["ExposureTime"]
                if began_ns >= called_ns:
                    return self.pixels.view_samples(
                        request.make_buffer("raw"), self.size, self._padding
                    )
        raise DeviceError(
            f"{self.name} sent {_MOST_FRAMES} frames that began before the pattern was shown",
            "close and open it again",
        )

    @contextlib.contextmanager
    def _next_request(self) -> Iterator[Any]:
        """Yield the next frame's request, and keep its metadata."""
        exposure_s = self._metadata.get("ExposureTime", 0) * 1e-6
        with _as_device_error(self.name):
            job = self._camera.capture_request(wait=False)
            try:
                request = job.get_result(timeout=_ANSWER_S + 4 * exposure_s)
            except TimeoutError as error:
                self._camera.cancel_all_and_flush()  # or it could not be closed
                raise DeviceError(f"{self.name} sends no frames", _CHECK) from error
            try:
                self._metadata = request.get_metadata()
                yield request
            finally:
                request.release()

    def _read_settings(self) -> CameraSettings:
        """Return those of the last frame."""
        return CameraSettings(
            self._metadata["ExposureTime"] / 1000, float(self._metadata["AnalogueGain"])
        )

    def _read_lens(self) -> dict[str, float]:
        """Return the focus of a module that has one, in dioptres."""
        position = self._metadata.get("LensPosition")
        return {} if position is None else {"focus": float(position)}

    def _write_settings(self, settings: CameraSettings) -> None:
        """Set the nearest values within the sensor's limits, and wait until a frame has them: rows
        and steps of the sensor round them."""
        wanted = {}
        with _as_device_error(self.name):
            limits = self._camera.camera_controls
        for control, value, factor in (
            ("ExposureTime", settings.exposure_ms, 1000),
            ("AnalogueGain", settings.gain, 1),
        ):
            if value is not None:
                low, high = limits[control][:2]
                wanted[control] = type(low)(min(max(value * factor, low), high))
        with _as_device_error(self.name):
            self._set(wanted)
        for _ in range(_MOST_FRAMES):
            with self._next_request():
                applied = self._metadata
            if all(abs(applied[key] - value) <= 0.05 * value for key, value in wanted.items()):
                return

    def _set(self, controls: dict[str, Any]) -> None:
        """Set those of the controls that the camera has."""
        known = self._camera.camera_controls
        self._camera.set_controls({key: controls[key] for key in controls if key in known})


def list_pi_cameras() -> list[str]:
    """List the camera modules: number and sensor."""
    with _as_device_error("the Raspberry Pi's camera system"):
        from picamera2 import Picamera2

        return [
            f"number {number}: {info['Model']}"
            for number, info in enumerate(Picamera2.global_camera_info())
        ]


_INSTALL = (
    "on a Raspberry Pi, sudo apt install python3-picamera2, then pip install 'slviewer[picamera2]'"
    " in an environment made with --system-site-packages"
)
DRIVER = Driver(
    "picamera2",
    "a camera module of a Raspberry Pi",
    needs="a Raspberry Pi with Raspberry Pi OS, to which the module's ribbon cable leads",
    packages={"picamera2": _INSTALL, "libcamera": _INSTALL},
    camera=PiCamera,
    list_connected=list_pi_cameras,
)
