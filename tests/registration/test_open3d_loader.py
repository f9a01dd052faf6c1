"""Open3D imports on a bare machine, and says how to be installed where it cannot."""

import subprocess
import sys

import pytest


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.computes
def test_open3d_imports_in_a_fresh_process() -> None:
    done = run("from slviewer.registration.open3d_loader import open3d; print(open3d().geometry.PointCloud.__name__)")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "PointCloud"


@pytest.mark.computes
def test_open3d_imports_without_dash() -> None:
    code = "from slviewer.registration.open3d_loader import open3d; import sys; open3d(); print('dash' in sys.modules)"
    done = run(code)
    assert done.stdout.strip() == "False", done.stderr


def test_importing_the_loader_does_not_import_open3d() -> None:
    done = run("import sys, slviewer.registration.open3d_loader; print('open3d' in sys.modules)")
    assert done.stdout.strip() == "False", done.stderr


def test_a_missing_open3d_names_the_remedy() -> None:
    done = run(
        "import sys; sys.modules['open3d'] = None\n"
        "from slviewer.errors import SlviewerError\n"
        "from slviewer.registration.open3d_loader import open3d\n"
        "try:\n    open3d()\nexcept SlviewerError as error:\n    print(error)"
    )
    assert "pip install open3d" in done.stdout, done.stderr


@pytest.mark.computes
def test_a_break_while_open3d_is_imported_waits_for_its_end() -> None:
    done = run(
        "import os, signal, threading, time\n"
        "from slviewer.registration.open3d_loader import open3d\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        "threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "try:\n    open3d(); time.sleep(60)\nexcept KeyboardInterrupt:\n    raise SystemExit(130)"
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
