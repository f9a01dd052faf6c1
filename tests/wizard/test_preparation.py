"""Kernels are compiled in the background at the first start, and never again."""

import contextlib
import itertools
import subprocess
import sys
from pathlib import Path

import pytest
from wizard_events import HANG_S

from slviewer.geometry import jit
from slviewer.wizard import preparation
from slviewer.wizard.autopilot import PATIENCE_S
from slviewer.wizard.preparation import (
    OTHERS,
    SECONDS,
    Preparation,
    prepared_file,
    share_compiled,
)

SCRIPT = "import sys; print(0.0); print(0.5, flush=True); sys.exit({status})"


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that says that everything is compiled, which is not there yet."""
    monkeypatch.setattr(preparation, "cache_root", lambda: tmp_path)
    monkeypatch.delenv(preparation.SWITCHED_OFF)
    file = prepared_file()
    assert file is not None and not file.exists()
    return file


def prepare(status: int) -> list[float | None]:
    """What is reported by a process that ends with this status."""
    reports: list[float | None] = []
    preparation_process = Preparation(
        reports.append, [sys.executable, "-c", SCRIPT.format(status=status)]
    )
    preparation_process.start()
    preparation_process._thread.join(HANG_S)
    return reports


@pytest.mark.process
def test_progress_is_reported_and_the_next_start_compiles_nothing(done: Path) -> None:
    assert prepare(0) == [0.0, 0.5, None]
    assert done.exists()
    assert prepare(0) == []


@pytest.mark.process
def test_what_failed_is_tried_again_at_the_next_start(done: Path) -> None:
    assert prepare(1) == [0.0, 0.5, None]
    assert not done.exists()


def test_an_environment_variable_switches_it_off(
    done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(preparation.SWITCHED_OFF, "1")
    assert prepare(0) == []
    assert not done.exists()


@pytest.mark.slow
@pytest.mark.process
def test_the_process_ends_with_the_program_that_started_it() -> None:
    process = subprocess.Popen(
        preparation.COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None and process.stdout is not None
    assert float(process.stdout.readline()) == 0.0  # it works
    process.stdin.close()
    assert process.wait(HANG_S) == 1


def test_progress_grows_with_each_kernel_by_the_time_that_it_takes() -> None:
    kernels = [*SECONDS, *(f"kernel {i}" for i in range(OTHERS))]
    shares = [share_compiled(kernels[:n]) for n in range(len(kernels) + 1)]
    steps = [after - before for before, after in itertools.pairwise(shares)]
    assert shares[0] == 0 and shares[-1] == 0.99 and min(steps[:-2]) > 0
    # a slow kernel moves it more than a fast one, and none holds it up for long
    assert steps[0] == max(steps) and 0.05 < steps[0] < 0.2
    assert share_compiled([*kernels, "more than known"]) == 0.99


def test_compiled_kernels_are_named(tmp_path: Path) -> None:
    compile_once = jit._compile_once(lambda signature: signature, tmp_path / "coded_rows.lock")
    assert compile_once("float32") == "float32" == compile_once("float32")  # loaded anew
    assert list(jit.COMPILED)[-1] == ("coded_rows", "float32")


def test_preparation_waits_for_kernels_that_take_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    patience_s: list[float] = []

    class Waiting:
        def __init__(self, _operator: object, poses: int, patience_s: float = PATIENCE_S) -> None:
            self._patience_s = patience_s

        def run(self) -> None:
            patience_s.append(self._patience_s)

    monkeypatch.setattr(preparation, "Autopilot", Waiting)
    monkeypatch.setattr(preparation, "Operator", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(preparation, "_exit_with_parent", lambda: None)
    monkeypatch.setattr(preparation, "_report_share", lambda: None)
    monkeypatch.setattr(preparation.os, "nice", lambda _: None)
    preparation.prepare()
    assert patience_s[0] >= 10 * PATIENCE_S
