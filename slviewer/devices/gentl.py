"""The cameras of the installed GenTL producers: listed, claimed, and their filled buffers one by
one.

A producer (`.cti`) comes with the camera maker's software and can be loaded once in a process, so
that everything that requests the same file here shares it. `harvesters` claims and streams; each
workaround of its behaviour has a comment.
"""

import contextlib
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import Size

PRODUCERS_VARIABLE = "GENICAM_GENTL64_PATH"
"""Names the folders of all producers that are installed."""

LOCK = threading.RLock()
"""Held while producers are loaded and closed, and cameras claimed and given back."""

_PRODUCERS: dict[str, "_Producer"] = {}

_LOG = logging.getLogger("slviewer.gentl")
# harvesters prints every failure with its stack; errors are raised as sentences
_LOG.addHandler(logging.NullHandler())


@dataclass(frozen=True)
class ListedCamera:
    """A camera that a producer lists; `id` is the producer's own for it."""

    vendor: str
    model: str
    serial: str
    file: str
    id: str

    def __str__(self) -> str:
        return f"{self.vendor} {self.model}, serial {self.serial}"


@contextlib.contextmanager
def as_device_error(name: str) -> Iterator[None]:
    """Convert exceptions of the GenICam libraries, raised in the block, to a DeviceError about
    `name`."""
    try:
        yield
    except _list_library_errors() as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DeviceError(
            f"{name} does not answer",
            f"check its cable, and close other programs that use it ({reason})",
        ) from error


def producer_files(producer: str | None) -> list[str]:
    """List the .cti files to load: the given one, or all that are installed.

    Raises InputError where the given one is no such file, DeviceError where none is installed.
    """
    if producer is not None:
        if not (producer.endswith(".cti") and Path(producer).is_file()):
            raise InputError(
                f"{producer} is not a GenTL producer",
                "give the path of a .cti file of your camera's software",
            )
        return [str(Path(producer).resolve())]
    folders = [
        folder for folder in os.environ.get(PRODUCERS_VARIABLE, "").split(os.pathsep) if folder
    ]
    files = [
        str(file.resolve()) for folder in folders for file in sorted(Path(folder).glob("*.cti"))
    ]
    if not files:
        raise DeviceError(
            f"no GenTL producer is installed ({PRODUCERS_VARIABLE} names no folder with a .cti"
            " file)",
            "install the software of your camera's maker, such as Spinnaker (FLIR), pylon (Basler)"
            " or IDS peak, and start again, or give the path of its .cti file as `producer`",
        )
    return list(dict.fromkeys(files))


def list_cameras(producer: str | None = None) -> list[ListedCamera]:
    """List the cameras of all producers; one that cannot be loaded is an error only if it is the
    only one.

    While a camera of a producer is claimed in this process, its list is that of when it was
    claimed: to look again would take the camera away.
    """
    files, cameras, problems = producer_files(producer), [], []
    for file in files:
        try:
            with open_producer(file) as harvester:
                cameras += [read_listed_camera(info, file) for info in harvester.device_info_list]
        except DeviceError as problem:
            problems.append(problem)
    if problems and len(problems) == len(files):
        raise problems[0]
    return cameras


@dataclass
class _Producer:
    """A loaded producer's harvester, and the number of its users."""

    harvester: Any
    users: int = 0


@contextlib.contextmanager
def open_producer(file: str) -> Iterator[Any]:
    """Yield the shared harvester of a producer, updated for its first user and closed after its
    last."""
    with LOCK:
        if file not in _PRODUCERS:
            _PRODUCERS[file] = _Producer(_load_producer(file))
        producer = _PRODUCERS[file]
        producer.users += 1
    try:
        yield producer.harvester
    finally:
        with LOCK:
            producer.users -= 1
            if producer.users == 0:
                del _PRODUCERS[file]
                ignore_errors(producer.harvester.reset)


def _load_producer(file: str) -> Any:
    """Load a producer and list its cameras; returns its harvester. Raises DeviceError."""
    from harvesters.core import Harvester, ParameterKey, ParameterSet

    harvester = Harvester(config=ParameterSet({ParameterKey.LOGGER: _LOG}))
    try:
        harvester.add_file(file, check_existence=True, check_validity=True)
        harvester.update()
        # harvesters logs why, and goes on without cameras
        if not harvester.has_revised_device_info_list:
            raise DeviceError(
                f"the GenTL producer {file} cannot list cameras",
                "close other programs that use them",
            )
    except BaseException as error:
        ignore_errors(harvester.reset)
        if isinstance(error, (OSError, *_list_library_errors())):
            raise DeviceError(
                f"the GenTL producer {file} cannot be loaded", f"install it again ({error})"
            ) from error
        raise
    return harvester


def read_listed_camera(info: Any, file: str) -> ListedCamera:
    """Convert a producer's device info to a `ListedCamera`."""

    def word(what: str) -> str:
        """Return a property as text; "?" where it is empty."""
        return str(read_info(info, what) or "").strip() or "?"

    return ListedCamera(word("vendor"), word("model"), word("serial_number"), file, word("id_"))


def read_info(module: Any, what: str) -> Any:
    """Return the property `what` of a GenTL module; None where its producer does not report it."""
    try:
        return getattr(module, what)
    except _list_library_errors():
        return None


def _list_library_errors() -> tuple[type[Exception], ...]:
    """Return the exception types of the GenICam libraries, which are optional: imported here."""
    from genicam import genapi, gentl

    return (genapi.GenericException, gentl.GenericException)


def ignore_errors(step: Callable[[], object]) -> None:
    """Call a step of closing, and log what it raises."""
    try:
        step()
    except Exception as error:
        _LOG.info("while closing: %s", error)


class NoFrameError(DeviceError):
    """A camera that gave no frame in time."""


_POLL_S = 0.0005
_LINKS: dict[ListedCamera, "Link"] = {}


@dataclass(frozen=True)
class Image:
    """The bytes of one image where they arrived: valid until the buffer is handed back, never
    copied."""

    data: np.ndarray
    size: Size
    padding: int


@contextlib.contextmanager
def open_node_map(camera: ListedCamera) -> Iterator[Any]:
    """Yield the node map of `camera`, for reading; claims the camera meanwhile unless this process
    has already."""
    with LOCK:
        link = _LINKS.get(camera)
    if link:
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
        from harvesters.core import ParameterKey, ParameterSet

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
                        f"{self.name} is not connected", "plug it in, and wait until it has started"
                    )
                # Unused chunks are not parsed: the chunks of a damaged buffer cannot be, which
                # costs the buffer.
                options = ParameterSet({ParameterKey.ENABLE_AUTO_CHUNK_DATA_UPDATE: False})
                with as_device_error(self.name), _preserve_sigint_handler():
                    self._acquirer = self._harvester.create(listed[0], config=options)
                if len(self._acquirer.data_streams) != 1:
                    raise DeviceError(
                        f"{self.name} sends {len(self._acquirer.data_streams)} streams",
                        "use one with one",
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

    def start(self, buffers: int = 3) -> None:
        """Start streaming into so many empty buffers, or the fewest that the camera allows."""
        with as_device_error(self.name):
            self._acquirer.num_buffers = max(buffers, self._acquirer.min_num_buffers)
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
    def next(self, timeout_s: float, nbytes: Callable[[Size, int], int]) -> Iterator[Image]:
        """Yield the next image; `nbytes(size, padding)`: bytes required. Raises DeviceError for an
        incomplete one."""
        buffer = self._wait_buffer(timeout_s)
        if buffer is None:
            raise _report_incomplete_frame(self.name)
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
                raise NoFrameError(
                    f"{self.name} gave no frame within {timeout_s:.1f} s",
                    "check its cable, its trigger and its exposure",
                )
            time.sleep(_POLL_S)

    def _read_image(self, buffer: Any, nbytes: Callable[[Size, int], int]) -> Image:
        """Read from the raw buffer: harvesters' own components unpack into copies, and keep the
        rows' padding."""
        nodes = self.node_map
        size = (
            read_info(buffer, "width") or nodes.Width.value,
            read_info(buffer, "height") or nodes.Height.value,
        )
        padding = read_info(buffer, "padding_x") or 0
        offset = read_info(buffer, "image_offset") or 0
        if (read_info(buffer, "pixel_format") or self._format) != self._format:
            raise DeviceError(
                f"{self.name} sends another pixel format than was set", "choose another one"
            )
        data = np.frombuffer(buffer.raw_buffer, np.uint8)[offset:]
        needed = nbytes(size, padding)
        filled = read_info(buffer, "size_filled")
        if min(len(data), len(data) if filled is None else filled - offset) < needed:
            raise _report_incomplete_frame(self.name)
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


def _report_incomplete_frame(name: str) -> DeviceError:
    """Return the error of an incomplete frame, with remedies."""
    return DeviceError(
        f"{name} sent an incomplete frame",
        "use a faster port or a shorter cable, and for GigE cameras jumbo packets or a longer"
        " packet delay",
    )
