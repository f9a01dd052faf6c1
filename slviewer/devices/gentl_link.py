"""One claimed camera behind a GenTL producer, and its filled buffers one by one.

`harvesters` claims and streams; each workaround of its behaviour has a comment.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.devices.gentl import (
    LOCK,
    ListedCamera,
    as_device_error,
    ignore_errors,
    open_producer,
    read_info,
    read_listed_camera,
)
from slviewer.errors import DeviceError

_POLL_S = 0.0005
_LINKS: dict[ListedCamera, "Link"] = {}


@dataclass(frozen=True)
class Image:
    """The bytes of one image where they arrived: valid until the buffer is handed back, never
    copied."""

    data: np.ndarray
    size: tuple[int, int]
    padding: int


@contextlib.contextmanager
def open_node_map(camera: ListedCamera) -> Iterator[Any]:
    """Yield the node map of `camera`, for reading; claims the camera meanwhile unless this process
    has already."""
    with LOCK:
        link = _LINKS.get(camera)
    if link is not None:
        yield link.node_map
        return
    link = Link(camera)
    try:
        yield link.node_map
    finally:
        link.close()


class Link:
    """A claimed camera. Belongs to one thread; `close` never raises, and the camera can be claimed
    again after it."""

    def __init__(self, camera: ListedCamera) -> None:
        """Claim the camera. Raises DeviceError where it is not connected or in use by another
        program."""
        self.name = f"the camera {camera}"
        self._camera = camera
        self._acquirer: Any = None
        self._incomplete = _make_event_counter()
        self._format = 0
        self._producer = contextlib.ExitStack()
        self.streaming = False
        with LOCK:
            try:
                self._harvester = self._producer.enter_context(open_producer(camera.file))
                listed = [
                    info
                    for info in self._harvester.device_info_list
                    if read_listed_camera(info, camera.file) == camera
                ]
                if not listed:
                    raise DeviceError(
                        f"{self.name} is not connected: plug it in, and wait until it has started"
                    )
                with as_device_error(self.name), _preserve_sigint_handler():
                    self._acquirer = self._harvester.create(
                        listed[0], config=_make_acquirer_options()
                    )
                if len(self._acquirer.data_streams) != 1:
                    raise DeviceError(
                        f"{self.name} sends {len(self._acquirer.data_streams)} streams: use one"
                        " with one"
                    )
                self._acquirer.timeout_period_on_update_event_data_call = 0
                self._acquirer.add_callback(
                    self._acquirer.Events.INCOMPLETE_BUFFER, self._incomplete
                )
                self.node_map = self._acquirer.remote_device.node_map
            except BaseException:
                self.close()
                raise
            _LINKS[camera] = self

    def close(self) -> None:
        """Release the camera and its producer, even if the camera is disconnected."""
        with LOCK:
            if _LINKS.get(self._camera) is self:
                del _LINKS[self._camera]
            acquirer, self._acquirer, self.streaming = self._acquirer, None, False
            if acquirer is not None:
                # unlike destroy(), lets go of its memory
                ignore_errors(lambda: acquirer.__exit__(None, None, None))
                if acquirer.is_valid():  # it failed halfway: the second time skips what failed
                    ignore_errors(acquirer.destroy)
                ignore_errors(lambda: self._harvester.image_acquirers.remove(acquirer))
            self._producer.close()

    def start(self) -> None:
        """Start streaming into empty buffers."""
        with as_device_error(self.name):
            self._format = self.node_map.PixelFormat.get_int_value()
            self._acquirer.start()
        self.streaming = True

    def stop(self) -> None:
        """Stop streaming and discard filled buffers; never raises."""
        self.streaming = False
        if self._acquirer is not None:
            ignore_errors(self._acquirer.stop)

    def drop_filled(self) -> None:
        """Return the buffers that were filled before this call, unread."""
        for _ in range(self._acquirer.num_buffers):
            with as_device_error(self.name):
                before = self._incomplete.count
                buffer = self._acquirer.try_fetch(timeout=_POLL_S / 5, is_raw=True)
                if buffer is not None:
                    _return_buffer(buffer)
                elif self._incomplete.count == before:
                    return

    def drop_next(self, timeout_s: float) -> None:
        """Return the next buffer, complete or not, unread."""
        buffer = self._wait_buffer(timeout_s)
        if buffer is not None:
            with as_device_error(self.name):
                _return_buffer(buffer)

    @contextlib.contextmanager
    def next(
        self, timeout_s: float, nbytes: Callable[[tuple[int, int], int], int]
    ) -> Iterator[Image]:
        """Yield the next image; `nbytes(size, padding)`: bytes required. Raises DeviceError for an
        incomplete one."""
        buffer = self._wait_buffer(timeout_s)
        if buffer is None:
            raise DeviceError(_describe_incomplete_frame(self.name))
        try:
            with as_device_error(self.name):
                image = self._read_image(buffer, nbytes)
            yield image
        finally:
            ignore_errors(lambda: _return_buffer(buffer))

    def _wait_buffer(self, timeout_s: float) -> Any:
        """Wait for the next buffer; None for one that is incomplete.

        Polled, with pauses of our own: the binding keeps all Python threads waiting while it waits,
        and `fetch` restarts its timeout after each incomplete buffer, and returns none of them.
        """
        until = time.monotonic() + timeout_s
        before = self._incomplete.count
        while True:
            with as_device_error(self.name):
                buffer = self._acquirer.try_fetch(timeout=_POLL_S / 5, is_raw=True)
            if buffer is not None or self._incomplete.count != before:
                return buffer
            if time.monotonic() > until:
                raise DeviceError(
                    f"{self.name} gave no frame within {timeout_s:.1f} s: check its cable, its"
                    " trigger and its exposure"
                )
            time.sleep(_POLL_S)

    def _read_image(self, buffer: Any, nbytes: Callable[[tuple[int, int], int], int]) -> Image:
        """Read from the raw buffer: harvesters' own components unpack into copies, and keep the
        rows' padding."""
        nodes = self.node_map
        size = (
            read_info(buffer, "width") or nodes.Width.value,
            read_info(buffer, "height") or nodes.Height.value,
        )
        padding, offset = (
            read_info(buffer, "padding_x") or 0,
            read_info(buffer, "image_offset") or 0,
        )
        if (read_info(buffer, "pixel_format") or self._format) != self._format:
            raise DeviceError(
                f"{self.name} sends another pixel format than was set: choose another one"
            )
        data = np.frombuffer(buffer.raw_buffer, np.uint8)[offset:]
        needed = nbytes(size, padding)
        filled = read_info(buffer, "size_filled")
        if min(len(data), len(data) if filled is None else filled - offset) < needed:
            raise DeviceError(_describe_incomplete_frame(self.name))
        return Image(data, size, padding)


def _make_event_counter() -> Any:
    """Return a callback that counts its calls."""
    from harvesters.core import Callback

    class Counter(Callback):
        """Callback for events that counts them."""

        count = 0

        def emit(self, context: object = None) -> None:
            """Count an event."""
            self.count += 1

    return Counter()


def _make_acquirer_options() -> Any:
    """Return the options of harvesters' acquirers: chunk data is not parsed."""
    from harvesters.core import ParameterKey, ParameterSet

    # Unused chunks are not parsed: the chunks of a damaged buffer cannot be, which costs the
    # buffer.
    return ParameterSet({ParameterKey.ENABLE_AUTO_CHUNK_DATA_UPDATE: False})


@contextlib.contextmanager
def _preserve_sigint_handler() -> Iterator[None]:
    """Restore the handler of Ctrl+C: harvesters' own closes the camera instead of ending the
    program."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


def _return_buffer(buffer: Any) -> None:
    """Queue a buffer again, to be filled."""
    buffer.parent.queue_buffer(buffer)


def _describe_incomplete_frame(name: str) -> str:
    """Return the message for an incomplete frame, with remedies."""
    return (
        f"{name} sent an incomplete frame: use a faster port or a shorter cable, and for GigE"
        " cameras jumbo packets or a longer packet delay"
    )
