"""Compiles the kernels that a first calibration and scan need, side by side, in processes of their
own, while the program runs.

``kernels.json`` lists them in the order of need: name, types of the arguments, and the seconds that
the compiler takes on one core of a server, of which only the shares matter. The processes are
started where this version of the program has not run them yet; kernels that are compiled there are
not compiled here (`jit`).
"""

import hashlib
import importlib
import json
import logging
import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import binding
from numba.core import types as numba_types

from slviewer.geometry.jit_cache import cache_root, hash_sources

types: Any = numba_types
KERNELS = Path(__file__).with_name("kernels.json")
SWITCHED_OFF = "SLVIEWER_NO_PREPARATION"
"""Environment variable that, set to anything, prevents the processes."""
COMMAND = [sys.executable, "-m", "slviewer.geometry.jit_prepare"]
MOST_PROCESSES = 8
"""Each takes about 200 MB."""
NICENESS = 10


class Preparation:
    """The processes that compile, from `start` to `close`, or for the length of a ``with`` block.

    ``report`` is called, on a thread of its own, with the share of the work that is done, and with
    None at the end. ``command``: the process, which prints these shares and ends with its standard
    input.
    """

    def __init__(
        self,
        report: Callable[[float | None], None] = lambda share: None,
        command: Sequence[str] = COMMAND,
    ) -> None:
        self._report, self._command = report, command
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the process, unless it has ended well before; where that fails, kernels are
        compiled when they are first used."""
        if os.environ.get(SWITCHED_OFF) or (done := prepared_file()) is None or done.exists():
            return
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        try:
            self._process = process = subprocess.Popen(
                self._command,
                stdin=pipe,
                stdout=pipe,
                stderr=subprocess.DEVNULL,
                text=True,
                env=environment,
            )
        except OSError as error:
            logging.getLogger(__name__).warning("kernels cannot be compiled beforehand: %s", error)
            return
        self._thread = threading.Thread(
            target=self._follow, args=(process, done), name="slviewer preparation", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the process; what it has compiled is saved."""
        if self._process:
            self._process.kill()

    def __enter__(self) -> "Preparation":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _follow(self, process: subprocess.Popen[str], done: Path) -> None:
        """Follow the progress of the process, and make the file ``done`` when it has ended well."""
        assert process.stdout is not None
        for line in process.stdout:
            self._report(float(line))
        if process.wait() == 0:
            done.touch()
        self._report(None)


def prepared_file() -> Path | None:
    """The file that exists once the listed kernels of these sources are compiled for this machine;
    None without a cache."""
    root = cache_root()
    if root is None:
        return None
    made_by = f"{sys.version} {numba.__version__} {binding.get_host_cpu_name()}"
    modules = sorted({name.partition(":")[0] for name, _, _ in _list_kernels()})
    whole = "".join([KERNELS.read_text(), made_by, *map(hash_sources, modules)])
    return root / f"prepared-{hashlib.blake2b(whole.encode(), digest_size=16).hexdigest()}"


def describe_type(kind: Any) -> Any:
    """Return numba's type of an argument as JSON: arrays as in "uint8 3C read-only", tuples as
    lists, named ones under their names."""
    if isinstance(kind, types.BaseTuple):
        parts = [describe_type(part) for part in kind.types]
        named = getattr(kind, "instance_class", None)
        return {f"{named.__module__}:{named.__qualname__}": parts} if named else parts
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim}{kind.layout}{'' if kind.mutable else ' read-only'}"
    return str(kind)


def build_type(description: Any) -> Any:
    """Return numba's type that `describe_type` describes."""
    if isinstance(description, str):
        scalar, *array = description.split()
        kind = numba.from_dtype(np.dtype(scalar))
        return types.Array(kind, int(array[0][0]), array[0][1], array[1:] != []) if array else kind
    named, parts = None, description
    if isinstance(description, dict):
        ((name, parts),) = description.items()
        named = _import(name)
    return types.BaseTuple.from_types(tuple(map(build_type, parts)), named)


def prepare() -> None:
    """Compile the listed kernels, and print the share that is done; ends when standard input is
    closed."""
    _exit_after(sys.stdin.read)
    kernels = _list_kernels()
    done_s, whole_s = 0.0, sum(seconds for _, _, seconds in kernels)
    print(0.0, flush=True)
    processes = min(MOST_PROCESSES, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, spawn, _begin_process) as pool:
        seconds_of = {
            pool.submit(_compile, name, arguments): seconds for name, arguments, seconds in kernels
        }
        for compiled in as_completed(seconds_of):
            compiled.result()
            done_s += seconds_of[compiled]
            print(round(done_s / whole_s, 3), flush=True)


def _list_kernels() -> list[tuple[str, list[Any], float]]:
    """Return name, described arguments and seconds of each listed kernel."""
    return [tuple(kernel) for kernel in json.loads(KERNELS.read_text())]


def _import(name: str) -> Any:
    """Return what is named ``module:name``."""
    module, _, inside = name.partition(":")
    return getattr(importlib.import_module(module), inside)


def _compile(name: str, arguments: list[Any]) -> None:
    """Compile a kernel for arguments of these described types."""
    _import(name).compile(tuple(map(build_type, arguments)))


def _begin_process() -> None:
    """Let a process of the pool give way to others, and end with the one that made it."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    parent = multiprocessing.parent_process()
    assert parent is not None
    _exit_after(parent.join)


def _exit_after(wait: Callable[[], object]) -> None:
    """End this process, in whichever way it is busy, once ``wait`` has returned."""

    def follow() -> None:
        """Wait, and end the process."""
        wait()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


if __name__ == "__main__":
    prepare()
