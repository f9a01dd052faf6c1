"""Opening what OpenCV calls a video: which backend, how long, and what is live."""

import contextlib
import os
import sys
from pathlib import Path
from urllib.parse import urlsplit

import cv2

from slviewer.devices.opencv_reader import TIMING, Connected, StreamTiming
from slviewer.errors import DeviceError

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
    source: int | str, size: tuple[int, int] | None, timing: StreamTiming = TIMING
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
                f"{name} does not answer, or not with a video: check that its camera is switched"
                " on, and its address"
            )
        return Connected(capture, live=capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0)
    if not Path(source).is_file():
        raise DeviceError(f"{name} does not exist: check its path, {source}")
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise DeviceError(
            f"{name} cannot be read as a video: convert it, to MJPEG in an AVI file for instance"
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


def _open_webcam(source: int | str, size: tuple[int, int] | None) -> Connected:
    """Open a webcam by the first backend that works, at `size` if supported. Raises DeviceError."""
    for backend in _WEBCAMS:
        capture = cv2.VideoCapture(source, backend)
        if capture.isOpened():
            break
    else:
        raise DeviceError(
            f"{describe_source(source)} does not answer: check its cable, whether another program"
            " uses it, and what `slviewer devices` finds"
        )
    if size is not None and not _set_size(capture, size):
        # many webcams have their larger sizes compressed only, and OpenCV tries that last
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        _set_size(capture, size)
    # DirectShow's grab only checks whether the camera is there (cap_dshow.cpp: grabFrame)
    return Connected(capture, live=True, grab_waits=backend != cv2.CAP_DSHOW)


def _set_size(capture: cv2.VideoCapture, size: tuple[int, int]) -> bool:
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
