"""The example scripts and notebooks run; the scripts draw their pictures."""

import importlib.util
import inspect
import os
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest
from copies import copy_session

from slviewer.pipeline import simulate as simulation

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
SCRIPTS = ("compare_models.py", "decode_and_look.py", "merge_and_mesh.py", "sphere_diameter.py")
"""Those that take a picture's path and run in this process; tests/test_public_api.py runs the
others."""

pytestmark = pytest.mark.computes


@pytest.fixture(autouse=True)
def plots_without_screen() -> Iterator[None]:
    """Draw into files alone."""
    matplotlib.use("agg")
    yield
    plt.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_an_example_draws_its_picture(
    script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = tmp_path / "picture.png"
    monkeypatch.setattr(sys, "argv", [script, str(picture)])
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.process
def test_the_batch_example_draws_its_picture(tmp_path: Path) -> None:
    """Its workers are processes that import the script."""
    picture = tmp_path / "picture.png"
    command = [sys.executable, str(EXAMPLES / "batch_dask.py"), str(picture)]
    environment = os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(figures: ModuleType, notebook: Path, tmp_path: Path) -> None:
    figures.run_notebook(notebook, tmp_path, 0.15)
    pictures = list(tmp_path.glob("*.png"))
    assert pictures or notebook.stem == "live_cloud"


@pytest.mark.slow
def test_the_notebook_of_a_live_cloud_runs_on_a_simulated_session(
    figures: ModuleType,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def copy_recorded(*arguments: Any, **options: Any) -> None:
        """Stands for `simulate`, of which it checks the arguments."""
        bound = inspect.signature(simulate).bind(*arguments, **options).arguments
        assert (bound["scale"], bound["poses"]) == (0.25, 8)  # of the recorded session
        copy_session(recorded / "session", bound["session"])

    simulate = simulation.simulate
    monkeypatch.setattr(simulation, "simulate", copy_recorded)
    figures.run_notebook(EXAMPLES / "live_cloud.ipynb", tmp_path)
    printed = capsys.readouterr().out.splitlines()
    counts = (
        next(line for line in reversed(printed) if line.startswith("[")).strip("[]").split(", ")
    )
    assert len(counts) == 3 and all(int(count) > 5000 for count in counts)


def test_every_example_is_run() -> None:
    elsewhere = {"arrays.py", "session.py", "batch_dask.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*SCRIPTS, *elsewhere}
    assert importlib.util.find_spec("nbformat") is None or all(
        _is_notebook(path) for path in EXAMPLES.glob("*.ipynb")
    )


def _is_notebook(path: Path) -> bool:
    import nbformat

    nbformat.validate(nbformat.read(path, as_version=4))
    return True
