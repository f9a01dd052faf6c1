"""One claimed camera behind a GenTL producer, and its filled buffers one by one.

`harvesters` claims and streams; what is worked around of it is said where it is done.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.devices.gentl import LOCK, Found, answering, listed_as, loaded, quietly, read_info
from slviewer.errors import DeviceError

_POLL_S = 0.0005
_LINKS: dict[Found, "Link"] = {}


@dataclass(frozen=True)
class Image:
    """The bytes of one image where they arrived: valid until the buffer is handed back, never copied."""

    data: np.ndarray
    size: tuple[int, int]
    padding: int


@contextlib.contextmanager
def asked(camera: Found) -> Iterator[Any]:
    """The node map of `camera`, to be read only; claimed for that long where this process has not claimed it yet."""
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
    """One claimed camera. Belongs to one thread; `close` never raises, and the camera can be claimed again after it."""

    def __init__(self, camera: Found) -> None:
        """Claim it. Raises DeviceError where it is not connected or another program has it."""
        self.name = f"the camera {camera}"
        self._camera = camera
        self._acquirer: Any = None
        self._incomplete = _counter()
        self._format = 0
        self._producer = contextlib.ExitStack()
        self.streaming = False
        with LOCK:
            try:
                self._harvester = self._producer.enter_context(loaded(camera.file))
                listed = [info for info in self._harvester.device_info_list if listed_as(info, camera.file) == camera]
                if not listed:
                    raise DeviceError(f"{self.name} is not connected: plug it in, and wait until it has started")
                with answering(self.name), _interrupts_kept():
                    self._acquirer = self._harvester.create(listed[0], config=_acquirer_options())
                if len(self._acquirer.data_streams) != 1:
                    raise DeviceError(f"{self.name} sends {len(self._acquirer.data_streams)} streams: use one with one")
                self._acquirer.timeout_period_on_update_event_data_call = 0
                self._acquirer.add_callback(self._acquirer.Events.INCOMPLETE_BUFFER, self._incomplete)
                self.node_map = self._acquirer.remote_device.node_map
            except BaseException:
                self.close()
                raise
            _LINKS[camera] = self

    def close(self) -> None:
        """Give everything back, also of a camera that is gone."""
        with LOCK:
            if _LINKS.get(self._camera) is self:
                del _LINKS[self._camera]
            acquirer, self._acquirer, self.streaming = self._acquirer, None, False
            if acquirer is not None:
                quietly(lambda: acquirer.__exit__(None, None, None))  # unlike destroy(), lets go of its memory
                if acquirer.is_valid():  # it failed halfway: the second time skips what failed
                    quietly(acquirer.destroy)
                quietly(lambda: self._harvester.image_acquirers.remove(acquirer))
            self._producer.close()

    def start(self) -> None:
        """Let images flow into buffers that are all empty."""
        with answering(self.name):
            self._format = self.node_map.PixelFormat.get_int_value()
            self._acquirer.start()
        self.streaming = True

    def stop(self) -> None:
        """Let none flow, and forget those that did; never raises."""
        self.streaming = False
        if self._acquirer is not None:
            quietly(self._acquirer.stop)

    def drop_filled(self) -> None:
        """Hand back unread the buffers that were filled before this call."""
        for _ in range(self._acquirer.num_buffers):
            with answering(self.name):
                before = self._incomplete.count
                buffer = self._acquirer.try_fetch(timeout=_POLL_S / 5, is_raw=True)
                if buffer is not None:
                    _hand_back(buffer)
                elif self._incomplete.count == before:
                    return

    def drop_next(self, timeout_s: float) -> None:
        """Hand back unread the next buffer, complete or not."""
        buffer = self._wait(timeout_s)
        if buffer is not None:
            with answering(self.name):
                _hand_back(buffer)

    @contextlib.contextmanager
    def next(self, timeout_s: float, nbytes: Callable[[tuple[int, int], int], int]) -> Iterator[Image]:
        """The next image; `nbytes(size, padding)` says how large one must be. Raises DeviceError for one not whole."""
        buffer = self._wait(timeout_s)
        if buffer is None:
            raise DeviceError(_lossy(self.name))
        try:
            with answering(self.name):
                image = self._image(buffer, nbytes)
            yield image
        finally:
            quietly(lambda: _hand_back(buffer))

    def _wait(self, timeout_s: float) -> Any:
        """The next buffer, None for one that is incomplete.

        Asked again and again with pauses of our own: the binding keeps all Python threads waiting while it waits, and
        `fetch` begins its time anew after each incomplete buffer, and returns none of them.
        """
        until = time.monotonic() + timeout_s
        before = self._incomplete.count
        while True:
            with answering(self.name):
                buffer = self._acquirer.try_fetch(timeout=_POLL_S / 5, is_raw=True)
            if buffer is not None or self._incomplete.count != before:
                return buffer
            if time.monotonic() > until:
                raise DeviceError(
                    f"{self.name} gave no frame within {timeout_s:.1f} s: check its cable, its trigger and its exposure"
                )
            time.sleep(_POLL_S)

    def _image(self, buffer: Any, nbytes: Callable[[tuple[int, int], int], int]) -> Image:
        """Read from the raw buffer: harvesters' own components unpack into copies, and keep the rows' padding."""
        nodes = self.node_map
        size = (read_info(buffer, "width") or nodes.Width.value, read_info(buffer, "height") or nodes.Height.value)
        padding, offset = read_info(buffer, "padding_x") or 0, read_info(buffer, "image_offset") or 0
        if (read_info(buffer, "pixel_format") or self._format) != self._format:
            raise DeviceError(f"{self.name} sends another pixel format than was set: choose another one")
        data = np.frombuffer(buffer.raw_buffer, np.uint8)[offset:]
        needed = nbytes(size, padding)
        filled = read_info(buffer, "size_filled")
        if min(len(data), len(data) if filled is None else filled - offset) < needed:
            raise DeviceError(_lossy(self.name))
        return Image(data, size, padding)


def _counter() -> Any:
    """A callback that counts."""
    from harvesters.core import Callback

    class Counter(Callback):
        count = 0

        def emit(self, context: object = None) -> None:
            self.count += 1

    return Counter()


def _acquirer_options() -> Any:
    from harvesters.core import ParameterKey, ParameterSet

    # What nobody reads is not parsed: the chunks of a damaged buffer cannot be, which costs the buffer.
    return ParameterSet({ParameterKey.ENABLE_AUTO_CHUNK_DATA_UPDATE: False})


@contextlib.contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Keep Ctrl+C what it was: harvesters makes it close the camera instead of ending the program."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


def _hand_back(buffer: Any) -> None:
    buffer.parent.queue_buffer(buffer)


def _lossy(name: str) -> str:
    return (
        f"{name} sent an incomplete frame: use a faster port or a shorter cable, and for GigE cameras jumbo packets or "
        "a longer packet delay"
    )
