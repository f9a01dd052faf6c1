"""Starting is quick because nothing heavy is imported before a command works."""

import inspect
import subprocess
import sys

import pytest

from slviewer.cli import COMMANDS, main

CODE = """
import sys
from slviewer.cli import COMMANDS, main

helps = ([name, "--help"] for name in COMMANDS)
for arguments in (["--version"], ["--help"], ["import", "p18", "--help"], *helps):
    assert main(arguments) == 0, arguments
    heavy = {"numpy", "numba", "scipy", "cv2", "open3d", "viser", "matplotlib", "zarr"}
    heavy |= {"distributed", "fsspec"}
    assert not heavy & set(sys.modules), (arguments, heavy & set(sys.modules))
"""


@pytest.mark.process
def test_help_imports_nothing_heavy_and_lists_every_command() -> None:
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    listing = run.stdout[: run.stdout.index("usage: slviewer import")]
    assert all(f"• {name} " in listing for name in COMMANDS)


def test_a_command_has_the_arguments_that_its_functions_docstring_describes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["merge", "--help"]) == 0
    said = capsys.readouterr().out
    assert {"--reference", "--start", "--json"} <= set(said.split())
    assert not {"--picked", "--keep-background", "--progress"} & set(said.split())
    assert "three or more points" not in said  # what is behind the arguments is for Python
    merge = inspect.signature(COMMANDS["merge"]()).parameters
    assert (
        merge["captures"].annotation.__origin__ == tuple[str, ...]
        and merge["model"].default is None
    )


@pytest.mark.parametrize("command", ["export", "mesh"])
def test_help_says_that_extrapolated_points_are_omitted(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    assert "xtrapolated" in capsys.readouterr().out
