"""Parsers that a malformed file can crash or exhaust, each run in a process of its own within
limits."""

import os
import subprocess
import sys
from contextlib import suppress
from typing import Any

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
