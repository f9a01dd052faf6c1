"""Starting is quick because nothing heavy is imported before a command works."""

import subprocess
import sys

import pytest

from slviewer.cli import COMMANDS

CODE = """
import sys
from slviewer.cli import COMMANDS, main

for arguments in (["--version"], ["--help"], ["import", "p18", "--help"], *([name, "--help"] for name in COMMANDS)):
    assert main(arguments) == 0, arguments
    heavy = {"numpy", "numba", "scipy", "cv2", "open3d", "viser", "matplotlib", "zarr", "distributed", "fsspec"}
    assert not heavy & set(sys.modules), (arguments, heavy & set(sys.modules))
"""


@pytest.mark.slow
def test_help_imports_nothing_heavy_and_lists_every_command() -> None:
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    listing = run.stdout[: run.stdout.index("usage: slviewer import")]
    assert all(f"• {name} " in listing for name in COMMANDS)
