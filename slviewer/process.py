"""Long computations in a process of their own, beside which the program goes on.

Open3D's calls hold the interpreter's lock: for twenty seconds while Poisson's method reconstructs
400,000 points, and in these the wizard neither draws, nor captures, nor cancels.
"""

import os
import pickle
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, TypeVar

from slviewer.errors import SlviewerError

T = TypeVar("T")

_POLL_S = 0.2
"""How often a report is repeated, so that cancelling is noticed."""


def call_apart(function: Callable[..., T], *arguments: Any, progress: Callable[..., object]) -> T:
    """Return ``function(*arguments, progress=progress)``, of a module of the package.

    It is computed in a process of its own, except where this is the main thread: nothing waits
    beside that. What ``progress`` raises ends the process; it is called again and again while
    nothing new is reported. Raises what the function raises, and SlviewerError where the process
    ends before it.
    """
    if threading.current_thread() is threading.main_thread():
        return function(*arguments, progress=progress)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-P", "-c", f"from {__name__} import _answer; _answer()"]
    pipe = subprocess.PIPE
    with (
        ThreadPoolExecutor(1) as reader,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment) as process,
    ):
        assert process.stdin and process.stdout
        try:
            with process.stdin as sent:
                pickle.dump((function, arguments), sent, pickle.HIGHEST_PROTOCOL)
            last: tuple[Any, ...] | None = None
            while True:
                answer = reader.submit(pickle.load, process.stdout)
                while not wait([answer], _POLL_S).done:
                    if last is not None:
                        progress(*last)
                kind, value = answer.result()
                if kind != "reported":
                    break
                progress(*(last := value))
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
            raise SlviewerError(
                f"the process that computed ended early, with status {process.wait()}",
                "where memory was short, close other programs, or use fewer points",
            ) from error
        finally:
            process.kill()
    if kind == "raised":
        raise value
    return value  # type: ignore[no-any-return]


def _answer() -> None:
    """Compute what standard input asks for; report progress and result on standard output."""
    with os.fdopen(os.dup(1), "wb") as output:
        os.dup2(2, 1)  # what libraries print

        def report(kind: str, value: object) -> None:
            """Send one message."""
            output.write(pickle.dumps((kind, value), pickle.HIGHEST_PROTOCOL))
            output.flush()

        function, arguments = pickle.load(sys.stdin.buffer)  # noqa: S301 (of the parent)
        try:
            report(
                "returned", function(*arguments, progress=lambda *last: report("reported", last))
            )
        except Exception as error:
            error.add_note(traceback.format_exc())
            report("raised", error)
