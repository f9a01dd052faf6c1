"""Open3D imports on a bare machine, and says how to be installed where it cannot."""

import subprocess
import sys

import pytest
from facts import missing_facts

pytestmark = pytest.mark.process


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=False
    )


UNUSED = (
    "IPython", "configargparse", "dash", "flask", "ipywidgets", "jsonschema", "nbformat", "pandas",
    "plotly", "pydantic", "sklearn", "werkzeug",
)  # fmt: skip
"""What Open3D's wheels require, for drawings in notebooks and machine learning, and slviewer never
imports: it works where they are missing."""


def test_no_module_imports_what_open3d_requires_for_notebooks() -> None:
    done = run(
        "import importlib, pkgutil, sys, slviewer\n"
        f"sys.modules.update(dict.fromkeys({UNUSED}))  # importing one of them fails\n"
        "for module in pkgutil.walk_packages(slviewer.__path__, 'slviewer.'):\n"
        "    if module.name.split('.')[1] not in ('docs', 'assets', '_version'):\n"
        "        importlib.import_module(module.name)\n"
        "from slviewer.registration.open3d_loader import open3d\n"
        "print(open3d().geometry.PointCloud.__name__)"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "PointCloud", done.stderr


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
    assert missing_facts(done.stdout, "open3d", "pip install open3d") == [], done.stderr


def test_a_break_while_open3d_is_imported_waits_for_its_end() -> None:
    done = run(
        "import os, signal, sys, threading, time\n"
        "from slviewer.registration.open3d_loader import open3d\n"
        # a shell's background jobs ignore it
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def interrupt():\n"  # once the import has begun
        "    while 'open3d' not in sys.modules:\n        time.sleep(0.001)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "threading.Thread(target=interrupt).start()\n"
        "try:\n    open3d(); signal.pause()\nexcept KeyboardInterrupt:\n    raise SystemExit(130)"
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
