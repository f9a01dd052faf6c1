"""Lists the cameras of the installed GenTL producers.

A producer (`.cti`) comes with the camera maker's software and can be loaded once in a process, so
that everything that requests the same file here shares it.
"""

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slviewer.errors import DeviceError, InputError

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
            f"{name} does not answer: check its cable, and close other programs that use it"
            f" ({reason})"
        ) from error


def producer_files(producer: str | None = None) -> list[str]:
    """List the .cti files to load: the given one, or all that are installed.

    Raises InputError where the given one is no such file, DeviceError where none is installed.
    """
    if producer is not None:
        if not (producer.endswith(".cti") and Path(producer).is_file()):
            raise InputError(
                f"{producer} is not a GenTL producer: give the path of a .cti file of your camera's"
                " software"
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
            " file): install the software of your camera's maker, such as Spinnaker (FLIR), pylon"
            " (Basler) or IDS peak, and start again, or give the path of its .cti file as"
            " `producer`"
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
                f"the GenTL producer {file} cannot list cameras: close other programs that use them"
            )
    except BaseException as error:
        ignore_errors(harvester.reset)
        if isinstance(error, (OSError, *_list_library_errors())):
            raise DeviceError(
                f"the GenTL producer {file} cannot be loaded: install it again ({error})"
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
