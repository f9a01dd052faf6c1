"""Compiles the kernels that the wizard needs, in a process of its own, while the operator makes the
first choices.

The process runs the wizard once on a small simulated rig. It is started where this version of the
program has not run it yet; kernels that are compiled there are not compiled here (`geometry.jit`).
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numba
from llvmlite import binding

from slviewer.geometry.jit import COMPILED
from slviewer.geometry.jit_cache import cache_root, hash_sources
from slviewer.wizard.autopilot import RIG, Autopilot
from slviewer.wizard.operator import Operator
from slviewer.wizard.service import Service, log

SCALE = 0.2
"""Of the rig's resolution: small, and every step still succeeds."""
SWITCHED_OFF = "SLVIEWER_NO_PREPARATION"
"""Environment variable that, set to anything, prevents the process."""
COMMAND = [sys.executable, "-m", "slviewer.wizard.preparation"]
SECONDS = {
    "coded_rows": 10.0,
    "_list_rows": 5.0,
    "_add_samples": 5.0,
    "evaluate": 4.5,
    "_measure_centroids": 4.5,
    "fit_rational": 4.0,
    "_fill_rows": 3.0,
    "add_surface": 2.5,
    "_accumulate": 2.5,
    "_fit_paper_level": 2.5,
}
"""Seconds, roughly, that the compiler takes for the slowest kernels on one core of a server: only
their shares of the whole matter."""
OTHERS, OTHER_S = 123, 0.6
"""How many more there are, by name and signature, and the seconds of each, roughly."""
REPORT_S = 0.5
PATIENCE_S = 3600.0
"""Of one act: the kernels of the first pose take minutes to compile, beside other work or on a slow
computer; an act that is given up leaves the others uncompiled."""


class Preparation(Service):
    """The process that compiles.

    ``report`` is called, on a thread of its own, with the share of its work that is done, and with
    None at the end. ``command``: the process, which prints these shares.
    """

    def __init__(
        self, report: Callable[[float | None], None], command: Sequence[str] = COMMAND
    ) -> None:
        super().__init__("slviewer preparation")
        self._report, self._command = report, command
        self._process: subprocess.Popen[str] | None = None

    def close(self) -> None:
        """End the process; what it has compiled is saved."""
        if self._process:
            self._process.kill()

    def _serve(self) -> None:
        """Start the process, follow its progress, and note when it has ended well."""
        done = prepared_file()
        if done is None or done.exists() or os.environ.get(SWITCHED_OFF):
            return
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=pipe,
                stdout=pipe,
                stderr=subprocess.DEVNULL,
                text=True,
                env=environment,
            )
        except OSError as error:  # kernels are then compiled when they are first used
            log.warning("kernels cannot be compiled beforehand: %s", error)
            return
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._report(float(line))
        if self._process.wait() == 0:
            done.touch()
        self._report(None)


def prepared_file() -> Path | None:
    """The file that exists once the kernels of these sources are compiled for this machine; None
    without a cache."""
    root = cache_root()
    if root is None:
        return None
    compiler = f"{sys.version} {numba.__version__} {binding.get_host_cpu_name()}"
    made_by = hashlib.blake2b(compiler.encode(), digest_size=8).hexdigest()
    return root / f"prepared-{hash_sources(__name__)}-{made_by}"


def prepare() -> None:
    """Run the wizard once on a small rig, and print the share that is done; ends when standard
    input is closed."""
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    threading.Thread(target=_report_share, daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(10)
    with (
        tempfile.TemporaryDirectory(
            prefix="slviewer-preparation-", ignore_cleanup_errors=True
        ) as folder,
        Operator(Path(folder, "session"), {**RIG, "scale": SCALE}) as operator,
    ):
        Autopilot(operator, poses=8, patience_s=PATIENCE_S).run()


def share_compiled(kernels: Sequence[str]) -> float:
    """Return the share of the work that is done once these kernels are compiled, in this order, by
    the seconds that each takes; less than 1."""
    total_s = sum(SECONDS.values()) + OTHERS * OTHER_S
    return min(0.99, sum(SECONDS.get(name, OTHER_S) for name in kernels) / total_s)


def _report_share() -> None:
    """Print the share that is done, whenever it has grown."""
    printed = -1.0
    while True:
        share = round(share_compiled([name for name, _ in tuple(COMPILED)]), 3)
        if share > printed:
            print(share, flush=True)
            printed = share
        time.sleep(REPORT_S)


def _exit_with_parent() -> None:
    """End this process once its standard input is closed, as it is when the parent ends in any
    way."""
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    prepare()
