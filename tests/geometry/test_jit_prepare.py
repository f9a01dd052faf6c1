"""Kernels are compiled in the background at the first start, and never again."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from clocks import HANG_S

from slviewer.geometry import jit, jit_prepare
from slviewer.geometry.jit_prepare import KERNELS, Preparation, build_type, prepared_file

SCRIPT = "import sys; print(0.0); print(0.5, flush=True); sys.exit({status})"


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that says that everything is compiled, which is not there yet."""
    monkeypatch.setattr(jit_prepare, "cache_root", lambda: tmp_path)
    monkeypatch.delenv(jit_prepare.SWITCHED_OFF)
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
    if preparation_process._thread:
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
    monkeypatch.setenv(jit_prepare.SWITCHED_OFF, "1")
    assert prepare(0) == []
    assert not done.exists()


@pytest.mark.slow
@pytest.mark.process
def test_the_process_ends_with_the_program_that_started_it() -> None:
    process = subprocess.Popen(
        jit_prepare.COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None and process.stdout is not None
    assert float(process.stdout.readline()) == 0.0  # it works
    process.stdin.close()
    assert process.wait(HANG_S) == 1


def test_compiled_kernels_are_named_but_for_those_that_only_others_call(tmp_path: Path) -> None:
    inner = jit._compile_once(lambda kinds: kinds, "inner", tmp_path / "inner.lock")
    outer = jit._compile_once(inner, "outer", tmp_path / "outer.lock")
    assert outer(("float32",)) == ("float32",)
    assert jit.COMPILED[-1][:2] == ("outer", ("float32",))
    assert all(kernel.name != "inner" for kernel in jit.COMPILED)


FLIGHT = """
import json, sys
from slviewer.geometry.jit import COMPILED
from slviewer.geometry.jit_prepare import describe_type
from slviewer.wizard.autopilot import RIG, Autopilot
from slviewer.wizard.operator import Operator
with Operator(sys.argv[1], {**RIG, "scale": 0.2}) as operator:
    Autopilot(operator, poses=8, patience_s=3600.0).run()
listed = {}
for name, kinds, seconds in COMPILED:
    row = [name, [describe_type(kind) for kind in kinds]]
    listed.setdefault(json.dumps(row), [*row, round(seconds, 2)])
print("[\\n" + ",\\n".join(map(json.dumps, listed.values())) + "\\n]")
"""


@pytest.mark.slow
@pytest.mark.process
def test_what_the_whole_wizard_needs_is_listed(tmp_path: Path) -> None:
    """With UPDATE_KERNELS=1 compile all anew, which takes minutes, and write the list."""
    update = bool(os.environ.get("UPDATE_KERNELS"))
    environment = {**os.environ, **({"NUMBA_CACHE_DIR": str(tmp_path)} if update else {})}
    command = [sys.executable, "-c", FLIGHT, str(tmp_path / "session")]
    flight = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    if update:
        KERNELS.write_text(flight.stdout)
    listed = {json.dumps(kernel[:2]) for kernel in json.loads(KERNELS.read_text())}
    needed = {json.dumps(kernel[:2]) for kernel in json.loads(flight.stdout)}
    assert sorted(needed - listed) == []
    assert len(listed - needed) < 5  # what some other computer's image needs


@pytest.mark.slow
@pytest.mark.process
def test_listed_kernels_are_compiled_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Into an empty folder, of a list of two; then they are loaded from there."""
    kernels = [k for k in json.loads(KERNELS.read_text()) if "geometry.brown" in k[0]]
    script = f"""
from pathlib import Path
from slviewer.geometry import jit_prepare
jit_prepare.KERNELS = Path({str(tmp_path / "kernels.json")!r})
if __name__ == "__main__":
    jit_prepare.prepare()
"""
    (tmp_path / "kernels.json").write_text(json.dumps(kernels))
    (tmp_path / "script.py").write_text(script)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py")],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    shares = [float(line) for line in process.stdout]
    assert process.wait() == 0 and len(shares) == 1 + len(kernels)
    assert shares == sorted(shares) and (shares[0], shares[-1]) == (0.0, 1.0)
    machine_code = list((tmp_path / "cache").rglob("*.nbc"))
    assert len(machine_code) >= len(kernels)


def test_types_of_arguments_survive_the_list() -> None:
    for _, arguments, _ in json.loads(KERNELS.read_text()):
        kinds = [build_type(argument) for argument in arguments]
        assert [jit_prepare.describe_type(kind) for kind in kinds] == arguments
