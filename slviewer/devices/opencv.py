"""A camera for everything that OpenCV can open: a webcam, a video file, an MJPEG (http://…) or RTSP
address.

Frames have 8 bits: OpenCV gives no more of any of these. A webcam's exposure, white balance and
focus stay where they are when it is opened, as nothing may change by itself during a capture.
"""

import math
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.opencv_controls import (
    Dialect,
    dialect_of,
    disable_automatics,
    exposure_ms,
    set_exposure,
    set_value,
)
from slviewer.devices.opencv_reader import TIMING, Reader, StreamTiming
from slviewer.devices.opencv_source import connect_source, describe_source, list_webcams
from slviewer.devices.protocols import (
    CameraSettings,
    Channel,
    Openable,
    check_channel,
    check_frame,
    check_image_size,
    extract_channel,
)
from slviewer.errors import DeviceError, InputError

SETTLING = 3
"""Pictures that a webcam takes until an exposure that was set is the one that they have."""

_IN_USE: dict[int | str, "OpenCVCamera"] = {}
"""Who has which source open in this process: most cannot be opened a second time to query their
size."""


@dataclass(eq=False)
class OpenCVCamera(Openable):
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
    size: tuple[int, int] = None  # type: ignore[assignment]  # until it is known
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
                "a gain, a focus or a white balance that is not a number cannot be set: give one"
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
        self.size = wanted or self._probe_size()

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about the settings, a sentence each."""
        return tuple(f"{self.name}: {sentence}" for sentence in self._notices.values() if sentence)

    def _start(self) -> None:
        """Start reading. Raises DeviceError where the source does not answer, or its frames have
        another size."""
        if self._reader is not None:
            # it may hang in a call, the device still in its hands
            self._reader.join(self.timing.opening_s)
        self._reader = Reader(self.name, self._connect, self.timing)
        self._next, self._read = self._check_size(self._reader.first()), 0
        self._notices = {}
        self._reader.do(self._prepare)
        _IN_USE[self.source] = self

    def close(self) -> None:
        """Release the source, if necessary once it returns from a blocking call."""
        if self._reader is not None:
            self._reader.close()
        if _IN_USE.get(self.source) is self:
            del _IN_USE[self.source]
        super().close()

    def grab(self, out: np.ndarray) -> None:
        """Grab a picture whose exposure started after this call; of a video file, the next
        picture."""
        check_frame(self, out)
        image = self._read_picture()
        if image.ndim == 2:
            np.copyto(out, image)
        else:
            extract_channel(image[..., ::-1], self.channel, out)

    def grab_colour(self) -> np.ndarray:
        """As `grab`, (h, w, 3) RGB; three equal channels for a monochrome source."""
        image = self._read_picture()
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB)

    def settings(self) -> CameraSettings:
        """Read the exposure; None where the camera does not report it."""
        dialect = self._dialect
        reader = self._require_reader()
        return CameraSettings(
            None if dialect is None else reader.do(lambda capture: exposure_ms(capture, dialect))
        )

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set the exposure; what could not be set is in `notes`."""
        dialect, ms = self._dialect, settings.exposure_ms
        reader = self._require_reader()
        if dialect is not None and ms is not None:
            self._notices["exposure"] = reader.do(
                lambda capture: set_exposure(capture, dialect, ms)
            )
            self._unsettled = SETTLING
        if dialect is not None and settings.gain is not None:
            self._notices["gain"] = (
                "its gain has units of its own: set it in the rig's file, as the camera's gain"
            )
        return self.settings()

    def _require_reader(self) -> Reader:
        """Return the reader. Raises DeviceError unless the camera is open."""
        self.check_open()
        assert self._reader is not None
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
                    f"{self.name} has ended after {self._read} pictures: close it and open it again"
                    " to start over"
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
                f" {self.size[1]}: choose {width} x {height} as its size, or another that it has"
            )
        if image.dtype != np.uint8:
            raise DeviceError(
                f"{self.name} gives {image.dtype} and not 8 bits: switch it to an 8-bit format"
            )
        return image

    def _probe_size(self) -> tuple[int, int]:
        """Return the source's default size (width, height) px."""
        reader = Reader(self.name, self._connect, self.timing)
        try:
            height, width = reader.first().shape[:2]
            return width, height
        finally:
            reader.close()


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
            f"{source!r} is not a camera: give a webcam's number, a video file, or an address"
        )
    return source


DRIVER = Driver(
    "opencv",
    "a webcam, a video file, or a stream (MJPEG, RTSP)",
    needs="a camera's number, a file, or an address, as `source`",
    camera=OpenCVCamera,
    list_connected=list_webcams,
)
