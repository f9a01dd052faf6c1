"""The example scripts and notebooks run; the scripts draw their pictures."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLES = DOCS / "examples"
SCRIPTS = ("batch_dask.py", "compare_models.py", "decode_and_look.py", "merge_and_mesh.py", "sphere_diameter.py")
"""Those that take a picture's path; tests/test_public_api.py runs the others."""

pytestmark = pytest.mark.computes


@pytest.mark.parametrize("script", SCRIPTS)
def test_an_example_draws_its_picture(script: str, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    command = [sys.executable, str(EXAMPLES / script), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path) -> None:
    code = (
        "import importlib.util, pathlib; "
        f"spec = importlib.util.spec_from_file_location('figures', {str(DOCS / 'figures.py')!r}); "
        "figures = importlib.util.module_from_spec(spec); spec.loader.exec_module(figures); "
        f"figures.run_notebook(pathlib.Path({str(notebook)!r}), pathlib.Path({str(tmp_path)!r}), 0.15)"
    )
    environment = os.environ | {"MPLBACKEND": "agg", "PYTHONPATH": str(DOCS.parent)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    pictures = list(tmp_path.glob("*.png"))
    assert pictures or notebook.stem == "live_cloud"


def test_every_example_is_run() -> None:
    from_folders = {"arrays.py", "session.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*SCRIPTS, *from_folders}
    assert importlib.util.find_spec("nbformat") is None or all(_is_notebook(path) for path in EXAMPLES.glob("*.ipynb"))


def _is_notebook(path: Path) -> bool:
    import nbformat

    nbformat.validate(nbformat.read(path, as_version=4))
    return True
