"""Files from outside: the one place that opens and parses them, within limits of size, depth and
numbers.

Only regular files are read (a pipe or a device would never end), and none larger than its kind may
be. What JSON and TOML hold is limited to what a record needs: `MAX_DEPTH` levels and integers of 64
bits, so that nothing that walks it later runs out of stack or range. Parsers that a malformed file
can crash or exhaust run in a process of their own within limits.
"""

import json
import os
import re
import stat
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from slviewer.errors import DamagedError, InputError, SlviewerError

MAX_JSON_BYTES = 1 << 24
MAX_TOML_BYTES = 1 << 20
MAX_IMAGE_BYTES = 1 << 29
MAX_CLOUD_BYTES = 1 << 31
MAX_DEPTH = 32
_MAX_INTEGER = 1 << 63
_LONE_SURROGATE = re.compile("[\ud800-\udfff]")
_DEEP_KEY = re.compile(r"""(?<![\w"'-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){32}""")
_REMEDY = "restore it from a copy, or compute or import it again"
MOST_REMEMBERED = 4096
_SETTLED_NS = 2 * 10**9
_INVALID = (
    KeyError,
    TypeError,
    ValueError,
    AttributeError,
    IndexError,
    ArithmeticError,
    RecursionError,
    MemoryError,
)
"""What a decoder raises that meets a value that it does not expect."""


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError for anything else: a folder, a pipe, a
    device."""
    # without O_NONBLOCK, opening a pipe waits for its writer; for regular files it changes nothing
    descriptor = os.open(
        path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    )
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(f"it is not a regular file: {path}")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file. Raises OSError for any other, and for one of more than
    ``max_bytes``."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise OSError(
                f"it has {size / 1e6:.0f} MB, and {max_bytes / 1e6:.0f} MB are read at most"
            )
        return file.read(size)  # of a growing file, what it had


def read_input(
    path: Path, max_bytes: int, remedy: str, error: type[SlviewerError] = InputError
) -> bytes:
    """Return the content of a regular file; raises ``error``, with the reason and the remedy, where
    `read_file` raises OSError."""
    try:
        return read_file(path, max_bytes)
    except OSError as fault:
        raise error(f"{path} cannot be read ({_reason(fault)}): {remedy}") from fault


def read_json(
    path: Path, remedy: str = "restore it from a copy, or move its folder away"
) -> dict[str, Any]:
    """The object in a JSON file; DamagedError, with the remedy, where the file is damaged or holds
    no object."""
    try:
        data = _check_values(json.loads(read_file(path, MAX_JSON_BYTES)))
    except (ValueError, OSError, RecursionError, MemoryError) as error:
        raise DamagedError(f"{path} cannot be read ({_reason(error)})", remedy) from error
    if not isinstance(data, dict):
        raise DamagedError(f"{path} holds no JSON object", remedy)
    return data


def identify(path: Path) -> object:
    """Return what changes whenever a file does, by which its reader remembers what it read. It is
    something new each time where the file is missing, or so new that its time may not show that it
    is written again: clocks of file systems are coarse."""
    with suppress(OSError):
        status = path.stat()
        if time.time_ns() - status.st_mtime_ns > _SETTLED_NS:
            return status.st_ino, status.st_size, status.st_mtime_ns
    return object()


def read_toml(path: Path | str) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError where it cannot be read, with the reason."""
    path = expand_user(path)
    try:
        text = read_input(path, MAX_TOML_BYTES, "give the TOML file that is needed here").decode()
        if _DEEP_KEY.search(text):  # which would take the parser hours
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        data: dict[str, Any] = _check_values(tomllib.loads(text))
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{path} is not TOML ({_reason(error)})", "correct it there") from error
    return data


def expand_user(path: Path | str) -> Path:
    """Return the path with the "~" of a home folder expanded, where that user exists."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise InputError(
            f"{path} names a user that does not exist here", "give the whole path"
        ) from error


@contextmanager
def decoding(
    place: Path | str,
    error: Callable[[str], Exception] = DamagedError,
) -> Iterator[None]:
    """Context manager for decoding values read from ``place``: raise what unexpected ones cause as
    ``error``."""
    try:
        yield
    except InputError as fault:
        raise error(f"{place} is damaged ({fault}): {_REMEDY}") from fault
    except _INVALID as fault:
        raise error(
            f"{place} is damaged ({type(fault).__name__}: {_reason(fault)}): {_REMEDY}"
        ) from fault


def _check_values(data: Any) -> Any:
    """Return plain values unchanged. Raises ValueError for nesting, integers or text that no record
    has."""
    level = [data]
    for _ in range(MAX_DEPTH):
        inner: list[Any] = []
        for value in level:
            kind = type(value)
            if kind is dict:
                inner += value
                inner += value.values()
            elif kind is list:
                inner += value
            elif kind is int and not -_MAX_INTEGER <= value < _MAX_INTEGER:
                raise ValueError("an integer of more than 64 bits")
            elif kind is str and not value.isascii() and _LONE_SURROGATE.search(value):
                raise ValueError("text that is not Unicode")
        if not inner:
            return data
        level = inner
    raise ValueError(f"nested more than {MAX_DEPTH} deep")


def _reason(error: BaseException) -> str:
    """Return the reason of an error in a few words."""
    if isinstance(error, RecursionError):
        return "nested too deep"
    if isinstance(error, OSError):
        return str(error.strerror or error)
    return " ".join(str(error).split())[:300] or type(error).__name__


MEMORY_BYTES = 2 << 30
_PATIENCE_S = 60


def run_isolated(
    module: str, *arguments: str, data: bytes = b"", cpu_s: int = 10
) -> tuple[int, bytes]:
    """Run ``python -m module`` with arguments and ``data`` as its input; return its exit status and
    what it wrote.

    The module limits itself by `limit_process`, to ``cpu_s`` of processor time. Status 1: it raised
    an exception; any other but 0: it crashed, or needed more memory or time than it may.
    """
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": paths,
        "SLVIEWER_CPU_S": str(cpu_s),
    }
    sent: dict[str, Any] = {"input": data} if data else {"stdin": subprocess.DEVNULL}
    try:
        ran = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            **sent,
            capture_output=True,
            timeout=_PATIENCE_S + cpu_s,
            env=environment,
        )
    except subprocess.TimeoutExpired:
        return -1, b""
    return ran.returncode, ran.stdout


def limit_process() -> None:
    """Limit memory and processor time of this process, where the system can."""
    if sys.platform == "win32":
        return
    with suppress(ImportError, ValueError, OSError):
        import resource

        seconds = int(os.environ["SLVIEWER_CPU_S"])
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
