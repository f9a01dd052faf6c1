"""A camera for everything that OpenCV can open: a webcam, a video file, an MJPEG (http://…) or RTSP
address.

Frames have 8 bits: OpenCV gives no more of any of these. A webcam's exposure, white balance and
focus stay where they are when it is opened, as nothing may change by itself during a capture.

What OpenCV's ways to a webcam call its exposure, gain, focus and white balance, and in which units,
is a `Dialect`. A camera may refuse a value, round it or ignore it: what counts is the value that it
reports afterwards.
"""

import contextlib
import math
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.opencv_reader import TIMING, Connected, Reader, StreamTiming
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

UNKNOWN = -1.0
"""What OpenCV says for a control that it does not know (`getProperty` of every backend)."""
_LENS = {
    "focus": cv2.CAP_PROP_FOCUS,
    "zoom": cv2.CAP_PROP_ZOOM,
    "aperture": cv2.CAP_PROP_IRIS,
}


@dataclass(frozen=True)
class Dialect:
    """The control conventions of one backend. `automatics`: each automatic control, and the value
    that switches it off; None where setting the value that it has does. `remedy`: where they can be
    switched off otherwise.
    """

    to_ms: Callable[[float], float]
    from_ms: Callable[[float], float]
    white_balance: int
    automatics: tuple[tuple[str, int, float | None], ...]
    remedy: str


# V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us; V4L2_EXPOSURE_MANUAL is 1 (docs.kernel.org, "Camera
# Control Reference"). OpenCV 4 and later hands both on as they are
# (modules/videoio/src/cap_v4l.cpp; the 0.25 and 0.75 of older advice are those of its normalised
# ranges, which `CAP_PROP_MODE` 0 switches off).
_V4L2 = Dialect(
    to_ms=lambda value: value / 10,
    from_ms=lambda ms: max(1.0, round(ms * 10)),
    white_balance=cv2.CAP_PROP_WB_TEMPERATURE,
    automatics=(
        ("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, 1.0),
        ("white balance", cv2.CAP_PROP_AUTO_WB, 0.0),
        ("focus", cv2.CAP_PROP_AUTOFOCUS, 0.0),
    ),
    remedy="look for a switch at the camera itself",
)


# Windows counts in powers of two of a second (learn.microsoft.com, "ICameraControl::put_Exposure");
# OpenCV cuts the fraction off, and sets each value with the flag that says "manual" (cap_dshow.cpp,
# cap_msmf.cpp: setProperty).
def _make_windows_dialect(white_balance: int) -> Dialect:
    """Return the conventions of Windows' backends: exposures are powers of two in s, set by their
    exponent."""
    return Dialect(
        lambda value: 1000 * 2.0**value,
        lambda ms: float(round(math.log2(ms / 1000))),
        white_balance,
        (
            ("exposure", cv2.CAP_PROP_EXPOSURE, None),
            ("white balance", white_balance, None),
            ("focus", cv2.CAP_PROP_FOCUS, None),
        ),
        "do it in the system's camera settings",
    )


_DIALECTS = {
    "V4L2": _V4L2,
    "DSHOW": _make_windows_dialect(cv2.CAP_PROP_WHITE_BALANCE_BLUE_U),
    "MSMF": _make_windows_dialect(cv2.CAP_PROP_TEMPERATURE),
}


def dialect_of(capture: cv2.VideoCapture) -> Dialect | None:
    """Return the control conventions of the open `capture`'s backend; None where controls are not
    accessible: those of a stream, and on macOS those of any camera (cap_avfoundation_mac.mm sets a
    size and a frame rate only).
    """
    dialect = _DIALECTS.get(capture.getBackendName())
    if dialect is _V4L2:
        capture.set(cv2.CAP_PROP_MODE, 0)
    return dialect


def disable_automatics(capture: cv2.VideoCapture, words: Dialect) -> dict[str, str]:
    """Fix exposure, white balance and focus at their current values; returns {control: warning} for
    those that stay automatic.

    A pattern sequence means nothing when its frames are exposed differently.
    """
    notices = {}
    for what, control, off in words.automatics:
        if (now := capture.get(control)) == UNKNOWN:
            continue
        # some drivers take a control out of its automatic mode when its present value is written
        wanted = now if off is None else off
        if not (capture.set(control, wanted) and capture.get(control) == wanted):
            notices[f"automatic {what}"] = (
                f"its automatic {what} cannot be switched off: {words.remedy}"
            )
    return notices


def exposure_ms(capture: cv2.VideoCapture, words: Dialect) -> float | None:
    """Read the current exposure, ms; None where the camera does not report it."""
    value = capture.get(cv2.CAP_PROP_EXPOSURE)
    ms = 0.0 if value == UNKNOWN else words.to_ms(value)
    return ms if 0 < ms < 1e5 else None


def set_exposure(capture: cv2.VideoCapture, words: Dialect, ms: float) -> str:
    """Set the exposure to the nearest supported value; returns a warning if that differs or failed,
    else ""."""
    value = words.from_ms(ms)
    capture.set(cv2.CAP_PROP_EXPOSURE, value)
    applied = exposure_ms(capture, words)
    if applied is None:
        return "its exposure cannot be set: set it at the camera itself"
    if abs(applied - ms) > 0.01 * ms:
        return f"its exposure is {applied:g} ms, {ms:g} ms were requested"
    return ""


def set_value(capture: cv2.VideoCapture, control: int, value: float, what: str) -> str:
    """Set a control, in the camera's units; returns a warning if the value differs or was not set,
    else ""."""
    capture.set(control, value)
    applied = capture.get(control)
    if applied == UNKNOWN != value:
        return f"its {what} cannot be set: set it at the camera itself"
    return (
        "" if abs(applied - value) < 0.5 else f"its {what} is {applied:g}, {value:g} was requested"
    )


# named, as OpenCV's own choice differs between its builds, and with it the units of every control
_WEBCAMS = {"win32": (cv2.CAP_DSHOW, cv2.CAP_MSMF), "darwin": (cv2.CAP_AVFOUNDATION,)}.get(
    sys.platform, (cv2.CAP_V4L2,)
)
_MAX_WEBCAMS = 4  # webcams, where the system lists none
_SYSFS = Path("/sys/class/video4linux")


def describe_source(source: int | str) -> str:
    """Return the source's name for messages; an address without its password."""
    if isinstance(source, int):
        return f"the camera {source}"
    if _is_address(source):
        address = urlsplit(source)
        return f"the stream {address.hostname or ''}{address.path.rstrip('/')}"
    return f"the camera {source}" if _is_device(source) else f"the video {Path(source).name}"


def connect_source(
    source: int | str, size: Size | None, timing: StreamTiming = TIMING
) -> Connected:
    """Open a source, a webcam at `size` (width, height) px where supported. Raises DeviceError.

    An address may take `patience_s` of the timing to answer, and later to send more.
    """
    _silence_libraries()
    if isinstance(source, int) or _is_device(source):
        return _open_webcam(source, size)
    name = describe_source(source)
    if _is_address(source):
        limit = int(1000 * timing.patience_s)
        # one thread: a decoder that works on several pictures at once keeps as many of them back. A
        # stream that changes its size is scaled to the previous one, without notice
        options = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: limit,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: limit,
            cv2.CAP_PROP_N_THREADS: 1,
        }
        capture = cv2.VideoCapture(
            source, cv2.CAP_FFMPEG, [part for option in options.items() for part in option]
        )
        if not capture.isOpened():
            raise DeviceError(
                f"{name} does not answer, or not with a video",
                "check that its camera is switched on, and its address",
            )
        return Connected(capture, live=capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0)
    if not Path(source).is_file():
        raise DeviceError(f"{name} does not exist", f"check its path, {source}")
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise DeviceError(
            f"{name} cannot be read as a video", "convert it, to MJPEG in an AVI file for instance"
        )
    return Connected(capture, live=False)


def list_webcams() -> list[str]:
    """List the connected webcams, a line each; opened only where the system does not list them."""
    if sys.platform == "linux":
        return list_sysfs_webcams(_SYSFS)
    _silence_libraries()
    lines = []
    for index in range(_MAX_WEBCAMS):
        with contextlib.suppress(DeviceError):
            connected = _open_webcam(index, None)
            lines.append(f"source {index}")
            connected.capture.release()
    return lines


def list_sysfs_webcams(sysfs: Path) -> list[str]:
    """As `list_webcams`, from Linux's sysfs, with missing permissions. A camera's further nodes
    carry no pictures."""
    lines = []
    for node in sorted(sysfs.glob("video*"), key=lambda node: (len(node.name), node.name)):
        with contextlib.suppress(OSError):
            if int((node / "index").read_text()) == 0:
                device = Path("/dev") / node.name
                locked = (
                    ""
                    if os.access(device, os.R_OK | os.W_OK)
                    else f", no permission to use {device}"
                )
                lines.append(
                    f"source {node.name.removeprefix('video')}:"
                    f" {(node / 'name').read_text().strip()}{locked}"
                )
    return lines


def _open_webcam(source: int | str, size: Size | None) -> Connected:
    """Open a webcam by the first backend that works, at `size` if supported. Raises DeviceError."""
    for backend in _WEBCAMS:
        capture = cv2.VideoCapture(source, backend)
        if capture.isOpened():
            break
    else:
        raise DeviceError(
            f"{describe_source(source)} does not answer",
            "check its cable, whether another program uses it, and what `slviewer devices` finds",
        )
    if size is not None and not _set_size(capture, size):
        # many webcams have their larger sizes compressed only, and OpenCV tries that last
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        _set_size(capture, size)
    # DirectShow's grab only checks whether the camera is there (cap_dshow.cpp: grabFrame)
    return Connected(capture, live=True, grab_waits=backend != cv2.CAP_DSHOW)


def _set_size(capture: cv2.VideoCapture, size: Size) -> bool:
    """Switch to `size`; returns whether the camera supports it."""
    sides = dict(zip((cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT), size, strict=True))
    for side, pixels in sides.items():
        capture.set(side, pixels)
    return all(capture.get(side) == pixels for side, pixels in sides.items())


def _is_address(source: str) -> bool:
    """Whether the source is a network address."""
    return "://" in source


def _is_device(source: str) -> bool:
    """Whether the source is a device file."""
    return source.startswith("/dev/")


def _silence_libraries() -> None:
    """Silence the libraries' terminal output, unless a log level is set: errors are raised."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
    # s until a webcam without pictures is given up
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


SETTLING = 3
"""Pictures that a webcam takes until an exposure that was set is the one that they have."""

_IN_USE: dict[int | str, "OpenCVCamera"] = {}
"""Who has which source open in this process: most cannot be opened a second time to query their
size."""


@dataclass(eq=False)
class OpenCVCamera(CameraDriver):
    """One `channel` of the webcam with the number `source`, or of the video at a path or an
    address. `notes` lists, in sentences, settings that were refused or changed since it was opened.

    `size` is (width, height) px, which a webcam is switched to; without it, it is the one in use,
    or the source must answer now. The settings are made when it is opened, None leaves one as it
    is: exposure in ms, gain and focus in the camera's own units, white balance in K. `timing`: how
    long pictures are waited for. A gain in the camera's own units is not a factor on the grey
    levels: `settings` does not report it and `apply` does not set it.

    Raises InputError for invalid options, DeviceError for a source that does not answer.
    """

    source: int | str = 0
    size: Size = None  # type: ignore[assignment]  # until it is known
    exposure_ms: float | None = None
    gain: float | None = None
    focus: float | None = None
    white_balance: float | None = None
    channel: Channel = "green"
    timing: StreamTiming = TIMING

    dtype = np.dtype(np.uint8)

    def __post_init__(self) -> None:
        source = self.source = _check_source(self.source)
        wanted = None if self.size is None else check_image_size("camera", self.size)
        check_channel(self.channel)
        CameraSettings(self.exposure_ms)
        if not all(
            value is None or math.isfinite(value)
            for value in (self.gain, self.focus, self.white_balance)
        ):
            raise InputError(
                "a gain, a focus or a white balance that is not a number cannot be set", "give one"
            )
        super().__init__(describe_source(source))
        if wanted is None and source in _IN_USE:
            wanted = _IN_USE[source].size
        self._connect = partial(connect_source, source, wanted, self.timing)
        self._reader: Reader | None = None
        self._dialect: Dialect | None = None
        self._next: np.ndarray | None = None  # the video's picture that was read to learn its size
        self._read, self._unsettled = 0, 0
        self._notices: dict[str, str] = {}
        if wanted is None:
            reader = Reader(self.name, self._connect, self.timing)
            try:
                height, width = reader.first().shape[:2]
                wanted = width, height
            finally:
                reader.close()
        self.size = wanted

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about the settings, a sentence each."""
        return tuple(f"{self.name}: {sentence}" for sentence in self._notices.values() if sentence)

    def _start(self) -> None:
        """Start reading. Raises DeviceError where the source does not answer, or its frames have
        another size."""
        if self._reader:
            # it may hang in a call, the device still in its hands
            self._reader.join(self.timing.opening_s)
        self._reader = Reader(self.name, self._connect, self.timing)
        self._next, self._read = self._check_size(self._reader.first()), 0
        self._notices = {}
        self._reader.do(self._prepare)
        _IN_USE[self.source] = self

    def close(self) -> None:
        """Release the source, if necessary once it returns from a blocking call."""
        if self._reader:
            self._reader.close()
        if _IN_USE.get(self.source) is self:
            del _IN_USE[self.source]
        super().close()

    def _fill(self, out: np.ndarray) -> None:
        """Write a picture whose exposure started after this call; of a video file, the next
        picture."""
        extract_channel(self.grab_colour(), self.channel, out)

    def grab_colour(self) -> np.ndarray:
        """As `grab`, (h, w, 3) RGB; three equal channels for a monochrome source."""
        image = self._read_picture()
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)

    def _read_settings(self) -> CameraSettings:
        """Return the exposure; None where the camera does not report it."""
        dialect = self._dialect
        reader = self._require_reader()
        return CameraSettings(
            None if dialect is None else reader.do(lambda capture: exposure_ms(capture, dialect))
        )

    def _read_lens(self) -> dict[str, float]:
        """Return those of `_LENS` that the camera reports; none of a stream or a video."""
        if self._dialect is None:
            return {}
        values = self._require_reader().do(
            lambda capture: {name: capture.get(control) for name, control in _LENS.items()}
        )
        return {name: value for name, value in values.items() if value != UNKNOWN}

    def _write_settings(self, settings: CameraSettings) -> None:
        """Set the exposure; what could not be set is in `notes`."""
        dialect, ms = self._dialect, settings.exposure_ms
        reader = self._require_reader()
        if dialect and ms is not None:
            self._notices["exposure"] = reader.do(
                lambda capture: set_exposure(capture, dialect, ms)
            )
            self._unsettled = SETTLING
        if dialect and settings.gain is not None:
            self._notices["gain"] = (
                "its gain has units of its own: set it in the rig's file, as the camera's gain"
            )

    def _require_reader(self) -> Reader:
        """Return the reader. Raises DeviceError unless the camera is open."""
        self.check_open()
        assert self._reader
        return self._reader

    def _prepare(self, capture: cv2.VideoCapture) -> None:
        """Apply the constructor's settings; called on the reader's thread."""
        dialect = self._dialect = dialect_of(capture)
        controls = (self.gain, self.focus, self.white_balance)
        if dialect is None:
            if self._require_reader().live or (self.exposure_ms, *controls) != (None,) * 4:
                self._notices["controls"] = (
                    "its exposure, gain, focus and white balance cannot be set from here: set them"
                    " at the camera itself, and switch off everything automatic"
                )
            return
        self._notices |= disable_automatics(capture, dialect)
        if self.exposure_ms is not None:
            self._notices["exposure"] = set_exposure(capture, dialect, self.exposure_ms)
        properties = (cv2.CAP_PROP_GAIN, cv2.CAP_PROP_FOCUS, dialect.white_balance)
        for control, value, what in zip(
            properties, controls, ("gain", "focus", "white balance"), strict=True
        ):
            if value is not None:
                self._notices[what] = set_value(capture, control, value, what)
        self._unsettled = SETTLING

    def _read_picture(self) -> np.ndarray:
        """Read the next valid picture, (h, w, 3) BGR or (h, w)."""
        reader = self._require_reader()
        if reader.live:
            image = reader.picture(later=self._unsettled)
            self._unsettled = 0
            return self._check_size(image)
        following, self._next = self._next, None
        if following is None:
            read, following = reader.do(lambda capture: capture.read())
            if not read:
                raise DeviceError(
                    f"{self.name} has ended after {self._read} pictures",
                    "close it and open it again to start over",
                )
        self._read += 1
        return self._check_size(following)

    def _check_size(self, image: np.ndarray) -> np.ndarray:
        """Return the image (h, w) or (h, w, 3) if it has the camera's size and 8 bits. Raises
        DeviceError otherwise."""
        height, width = image.shape[:2]
        if (width, height) != self.size:
            raise DeviceError(
                f"{self.name} gives pictures of {width} x {height} px instead of {self.size[0]} x"
                f" {self.size[1]}",
                f"choose {width} x {height} as its size, or another that it has",
            )
        if image.dtype != np.uint8:
            raise DeviceError(
                f"{self.name} gives {image.dtype} and not 8 bits", "switch it to an 8-bit format"
            )
        return image


def _check_source(source: int | str) -> int | str:
    """Return a webcam's number, a path or an address. Raises InputError for anything else."""
    if isinstance(source, str) and source.isdecimal():
        source = int(source)
    if (
        not isinstance(source, int | str)
        or isinstance(source, bool)
        or (isinstance(source, int) and source < 0)
    ):
        raise InputError(
            f"{source!r} is not a camera", "give a webcam's number, a video file, or an address"
        )
    return source


DRIVER = Driver(
    "opencv",
    "a webcam, a video file, or a stream (MJPEG, RTSP)",
    needs="a camera's number, a file, or an address, as `source`",
    camera=OpenCVCamera,
    list_connected=list_webcams,
)
