"""Which cameras are behind the GenTL producers that are installed.

A producer (`.cti`) comes with the camera maker's software and can be loaded once in a process, so that everything that
asks for the same file here shares it.
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
_LOG.addHandler(logging.NullHandler())  # harvesters prints every failure with its stack; errors are raised as sentences


@dataclass(frozen=True)
class Found:
    """A camera that a producer lists; `id` is the producer's own for it."""

    vendor: str
    model: str
    serial: str
    file: str
    id: str

    def __str__(self) -> str:
        return f"{self.vendor} {self.model}, serial {self.serial}"


@contextlib.contextmanager
def answering(name: str) -> Iterator[None]:
    """Turn what the GenICam libraries raise into a DeviceError about `name`."""
    try:
        yield
    except _library_errors() as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise DeviceError(
            f"{name} does not answer: check its cable, and close other programs that use it ({said})"
        ) from error


def producer_files(producer: str | None = None) -> list[str]:
    """The .cti files to load: the one that is given, or all that are installed.

    Raises InputError where the given one is no such file, DeviceError where none is installed.
    """
    if producer is not None:
        if not (producer.endswith(".cti") and Path(producer).is_file()):
            raise InputError(f"{producer} is no GenTL producer: give the path of a .cti file of your camera's software")
        return [str(Path(producer).resolve())]
    folders = [folder for folder in os.environ.get(PRODUCERS_VARIABLE, "").split(os.pathsep) if folder]
    files = [str(file.resolve()) for folder in folders for file in sorted(Path(folder).glob("*.cti"))]
    if not files:
        raise DeviceError(
            f"no GenTL producer is installed ({PRODUCERS_VARIABLE} names no folder with a .cti file): install the "
            "software of your camera's maker, such as Spinnaker (FLIR), pylon (Basler) or IDS peak, and start again, "
            "or give the path of its .cti file as `producer`"
        )
    return list(dict.fromkeys(files))


def connected(producer: str | None = None) -> list[Found]:
    """All cameras that the producers list; one that cannot be loaded fails only where it is the only one.

    While a camera of a producer is claimed in this process, its list is that of when it was claimed: to look again
    would take the camera away.
    """
    files, cameras, problems = producer_files(producer), [], []
    for file in files:
        try:
            with loaded(file) as harvester:
                cameras += [listed_as(info, file) for info in harvester.device_info_list]
        except DeviceError as problem:
            problems.append(problem)
    if problems and len(problems) == len(files):
        raise problems[0]
    return cameras


@dataclass
class _Producer:
    harvester: Any
    users: int = 0


@contextlib.contextmanager
def loaded(file: str) -> Iterator[Any]:
    """The harvester of one producer: listed afresh by its first user, closed after its last."""
    with LOCK:
        if file not in _PRODUCERS:
            _PRODUCERS[file] = _Producer(_load(file))
        producer = _PRODUCERS[file]
        producer.users += 1
    try:
        yield producer.harvester
    finally:
        with LOCK:
            producer.users -= 1
            if producer.users == 0:
                del _PRODUCERS[file]
                quietly(producer.harvester.reset)


def _load(file: str) -> Any:
    from harvesters.core import Harvester, ParameterKey, ParameterSet

    harvester = Harvester(config=ParameterSet({ParameterKey.LOGGER: _LOG}))
    try:
        harvester.add_file(file, check_existence=True, check_validity=True)
        harvester.update()
        if not harvester.has_revised_device_info_list:  # harvesters logs why, and goes on without cameras
            raise DeviceError(f"the GenTL producer {file} cannot list cameras: close other programs that use them")
    except BaseException as error:
        quietly(harvester.reset)
        if isinstance(error, (OSError, *_library_errors())):
            raise DeviceError(f"the GenTL producer {file} cannot be loaded: install it again ({error})") from error
        raise
    return harvester


def listed_as(info: Any, file: str) -> Found:
    """What a producer tells of a camera in its list."""

    def word(what: str) -> str:
        return str(read_info(info, what) or "").strip() or "?"

    return Found(word("vendor"), word("model"), word("serial_number"), file, word("id_"))


def read_info(module: Any, what: str) -> Any:
    """A fact about a GenTL module, None where its producer does not tell."""
    try:
        return getattr(module, what)
    except _library_errors():
        return None


def _library_errors() -> tuple[type[Exception], ...]:
    from genicam import genapi, gentl

    return (genapi.GenericException, gentl.GenericException)


def quietly(step: Callable[[], object]) -> None:
    """Do what belongs to closing, and go on whatever it raises."""
    try:
        step()
    except Exception as error:
        _LOG.info("while closing: %s", error)
