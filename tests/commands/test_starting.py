"""Starting is quick because nothing heavy is imported before a command works."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

from slviewer.cli import find_commands, main
from slviewer.commands.command import _SourceModule
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.rig import letter
from slviewer.validation.bench_scaling import save_scans

CODE = """
import sys
from slviewer.cli import find_commands, main

helps = ([name, "--help"] for name in find_commands())
for arguments in (["--version"], ["--help"], ["import", "p18", "--help"], *helps):
    assert main(arguments) == 0, arguments
    heavy = {"numpy", "numba", "scipy", "cv2", "open3d", "viser", "matplotlib", "zarr"}
    heavy |= {"distributed", "fsspec"}
    assert not heavy & set(sys.modules), (arguments, heavy & set(sys.modules))
"""

RECONSTRUCT = """
import sys
from slviewer.cli import main

assert main(["reconstruct", sys.argv[1], "scan_01"]) == 0
unused = {"open3d", "matplotlib", "viser", "zarr", "trimesh", "distributed"}
parts = ("ndimage", "optimize", "sparse", "spatial", "special", "stats")
unused |= {f"scipy.{part}" for part in parts}  # numba itself imports scipy.linalg
assert not unused & set(sys.modules), unused & set(sys.modules)
"""


@pytest.mark.process
def test_help_imports_nothing_heavy_and_lists_every_command() -> None:
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    listing = run.stdout[: run.stdout.index("usage: slviewer import")]
    assert all(f"\n  {name} " in listing for name in find_commands())


def test_a_command_has_the_arguments_that_its_functions_docstring_describes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["merge", "--help"]) == 0
    said = capsys.readouterr().out
    assert {"--reference", "--start", "--json"} <= set(said.split())
    assert not {"--picked", "--keep-background", "--progress"} & set(said.split())
    assert "three or more points" not in said  # what is behind the arguments is for Python
    merge = inspect.signature(find_commands()["merge"]()).parameters
    assert (
        merge["captures"].annotation.__origin__ == tuple[str, ...]
        and merge["model"].default is None
    )


@pytest.mark.parametrize("command", [[name] for name in find_commands()] + [["import", "frames"]])
def test_help_shows_values_and_defaults_of_the_terminal_only(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert not re.search(r"None\b|\bRaises |\bReturns the|[a-z]Error\b|``|default: ('')?\)", text)
    assert "(default: False)" not in text


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["export", "session", "--fromat", "stl"], "--format"),
        (["mesh", "session", "part", "--methd=grid"], "--method"),
        (["import", "p18", "--projectr", "9x9", "folder"], "--projector"),
        (["wizard", "--prot", "80"], "--port"),
        (["calibrate", "session", "--tartget", "circles:3x4:5"], "--target"),
    ],
)
def test_a_misspelt_option_is_named_and_not_what_it_displaced(
    arguments: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_a_value_of_the_wrong_type_is_refused_by_that_type_only(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["mesh", "session", "part", "--triangles", "many"]) == 2
    text = capsys.readouterr().err
    assert "--triangles" in text and "many" in text and "None" not in text
    assert "whole number" in text and "literal" not in text
    assert main(["simulate", "session", "--scale", "0,5"]) == 2
    text = capsys.readouterr().err
    assert "--scale" in text and "0.5" in text and "convert" not in text


@pytest.mark.parametrize("command", ["export", "mesh"])
def test_help_says_that_extrapolated_points_are_omitted(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "--help"]) == 0
    assert "xtrapolated" in capsys.readouterr().out


@pytest.mark.process
@pytest.mark.computes
def test_reconstruct_imports_no_more_than_it_uses(tmp_path: Path) -> None:
    scale, session = 0.15, tmp_path / "session"
    save_scans(session, scale, letter_plan(letter(scale), poses=3)["pose_01"], 1)
    code = [sys.executable, "-c", RECONSTRUCT, str(session)]
    run = subprocess.run(code, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_modules_are_read_where_strings_look_like_statements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = '''"""
NAME = 3
"""
TEXT = """
def other(:
"""
@cache
def last(x: int = 1) -> int:
    return x
WIDTH: int = 4
'''
    (tmp_path / "made_up_module.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    module = _SourceModule("made_up_module")
    assert module["WIDTH"] == 4 and module["TEXT"] == "\ndef other(:\n"
    assert module.find_node("NAME") is None
    definition = module.find_node("last")
    assert isinstance(definition, ast.FunctionDef) and len(definition.decorator_list) == 1


def test_an_unknown_command_is_refused_with_the_nearest_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["reconstuct"]) == 2
    assert "did you mean reconstruct?" in capsys.readouterr().err
