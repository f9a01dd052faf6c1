"""What all tests may use."""

# ruff: noqa: E402 (the number of threads is read where libraries are imported)

import os
import sys

# Workers share the cores: libraries that each take all of them wait for one another.
for library in ("OMP", "OPENBLAS", "NUMBA"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import gc
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import launched
from clocks import HANG_S
from example_plugin import example, install  # noqa: F401 (fixtures)
from filelock import FileLock
from numba.core import event
from playwright.sync_api import Browser, sync_playwright
from small_fields import fit_few_cells

os.environ["SLVIEWER_NO_PREPARATION"] = (
    "1"  # wizards that tests start compile what they use, and nothing beside it
)
# of wizards that tests start
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="slviewer-state-")
sys.dont_write_bytecode = False  # what tests start as processes need not compile the sources again
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


NEEDS = ("browser", "process", "computes", "slow")
"""What a test may need; one that needs none of these is quick."""
MAX_QUICK_COMPILE_S = 10.0
"""Processor seconds that a quick test may spend compiling kernels, on a busy machine; 3 s on a
quiet one."""


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without looking for garbage: nothing of what is collected becomes any."""
    gc.disable()
    found = yield
    gc.freeze()
    gc.enable()
    return found


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what the shared fixtures need, and put heavy files first: both workers end at about the
    same time."""
    weight: dict[Path, int] = {}
    for item in items:
        fixtures = getattr(item, "fixturenames", ())
        if "browser" in fixtures:
            item.add_marker(pytest.mark.browser)
        if "recorded" in fixtures:
            item.add_marker(pytest.mark.computes)
        needs = sum(item.get_closest_marker(name) is not None for name in NEEDS)
        if not needs:
            item.add_marker(pytest.mark.quick)
        weight[item.path] = max(weight.get(item.path, 0), needs)
    items.sort(key=lambda item: -weight[item.path])


class CompilerTime(event.Listener):
    """Processor seconds that this thread has spent compiling kernels."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._start = 0.0, 0, 0.0

    def on_start(self, event: event.Event) -> None:
        if self._depth == 0:
            self._start = time.thread_time()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.thread_time() - self._start


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Fail a quick test that starts a process or compiles for long: it is to be marked with what it
    needs."""
    if item.get_closest_marker("quick") is None:
        return (yield)

    start = subprocess.Popen.__init__

    def refuse(self: Any, command: Any, *arguments: Any, **options: Any) -> None:
        if command[0] == "fc-list":  # of matplotlib, once on a machine
            return start(self, command, *arguments, **options)
        pytest.fail("a quick test starts a process: mark it with `process`", pytrace=False)

    compiler = CompilerTime()
    with pytest.MonkeyPatch.context() as patch, event.install_listener("numba:compile", compiler):
        patch.setattr(subprocess.Popen, "__init__", refuse)
        result = yield
    if compiler.seconds > MAX_QUICK_COMPILE_S:
        pytest.fail(
            f"a quick test compiles for {compiler.seconds:.1f} s: mark it with `computes`",
            pytrace=False,
        )
    return result


@pytest.fixture(scope="session", autouse=True)
def disk_without_waits() -> Iterator[None]:
    """Nobody pulls the plug in a test: what the system was given is not waited for until the disk
    has it as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """One for all tests: Playwright runs once in a process."""
    with sync_playwright() as playwright:
        found = launched(playwright.chromium)
        yield found
        found.close()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures: SLVIEWER_REAL_DATA, else ``../shared/data`` beside the
    repository."""
    given = os.environ.get("SLVIEWER_REAL_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(
            f"no real captures: {folder} is missing; name their folder in SLVIEWER_REAL_DATA"
        )
    return folder


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a ``session`` as the commands simulate and calibrate it, and
    ``calibration.json``, what they found.

    8 poses, planes, spheres and objects at quarter resolution, made once for all workers: only to
    be read or copied. The frames of all captures are checked, as the wizard does when it opens a
    session.
    """
    from slviewer.cli import main
    from slviewer.wizard.operator import Operator

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "recorded"
    session, found = folder / "session", folder / "calibration.json"
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            with fit_few_cells():
                assert main(["simulate", str(session), "--scale", "0.25", "--poses", "8"]) == 0
                assert (
                    main(
                        [
                            "calibrate",
                            str(session),
                            "--target",
                            "circles:21x16:9",
                            "--json",
                            str(found),
                        ]
                    )
                    == 0
                )
            with Operator(session) as operator:
                operator.wait_until_idle(HANG_S)
    assert json.loads(found.read_text())["calibration"], "the worker that made it failed"
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command: its status, and what it wrote to standard output and error."""
    from slviewer.cli import main

    def command(*arguments: object) -> tuple[int, str, str]:
        status = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command
