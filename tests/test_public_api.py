"""What a notebook uses: names that import lazily, and two scripts that run."""

import ast
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from copies import copy_session

import slviewer as sl
from slviewer.session.toml import describe_sequence
from slviewer.simulation.rig import letter
from tests.proofs.hostile import BOARD, HostileBench, write_images

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six target poses and a plane as folders of images."""
    folder = tmp_path_factory.mktemp("images")
    bench = HostileBench(letter(0.15, 0, local_distortion_px=0.0), folder, poses=6)
    for part, names in (("poses", bench.targets), ("scan", ("plane_04",))):
        for name in names:
            files = write_images(folder / part / name, bench.capture(name)[0])
        (folder / part / "sequence.toml").write_text(describe_sequence(bench.sequence, files))
    return folder


Run = Callable[..., str]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run an example with arguments in this process; returns what it printed."""

    def script(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return script


def figures(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+\.\d+", text)]


@pytest.mark.slow
@pytest.mark.computes
def test_arrays_are_measured_without_a_session(images: Path, tmp_path: Path, run: Run) -> None:
    said = run("arrays.py", images, BOARD, tmp_path / "errors.png")
    rms, floor = figures(said)[:2]
    assert 0.01 < floor < 0.3 and 0.8 * floor < rms < 2.0 * floor
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.computes
def test_a_session_is_made_and_measured(images: Path, tmp_path: Path, run: Run) -> None:
    said = run("session.py", images, BOARD, tmp_path / "session")
    assert "verdict: good" in said
    assert int(re.findall(r"(\d+) points in", said)[0]) > 5000
    assert sl.load_calibration(tmp_path / "session").name == "stereo"


def test_examples_need_nothing_below_slviewer() -> None:
    files = [path for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")]
    below = {
        path.name: re.findall(r"(?:from|import) (slviewer\.[\w.]+)", path.read_text())
        for path in files
    }
    assert len(files) > 8 and not [name for name, modules in below.items() if modules]


@pytest.mark.computes
def test_a_session_has_the_operations_as_methods(recorded: Path, tmp_path: Path) -> None:
    folder = copy_session(recorded / "session", tmp_path / "session")
    with sl.Session.open(folder, write=True) as session:
        found = session.verify(["plane_03"], "plane")
        assert (
            found["plane_03"].best == "splined" and session.state_of("verify/plane_03") == "fresh"
        )
        # read, as the session is open for writing
        again = sl.verify(folder.as_posix(), ["plane_03"], "plane")
        assert again["plane_03"].models == found["plane_03"].models
        assert session.load_arrays("verify/plane_03")["error_splined"].shape == (300, 400)
        assert session.reconstruct("object_r1").only.points > 10_000


@pytest.mark.process
def test_names_are_imported_when_they_are_first_used() -> None:
    code = (
        "import sys, slviewer as sl; assert 'numpy' not in sys.modules; sl.decode; assert 'open3d'"
        " not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    stub = Path(sl.__file__).with_suffix(".pyi").read_text("utf-8")
    (stated,) = (each for each in ast.parse(stub).body if isinstance(each, ast.Assign))
    assert sorted(ast.literal_eval(stated.value)) == sl.__all__ and set(sl.__all__) <= set(dir(sl))
    assert all(getattr(sl, name).__doc__ for name in sl.__all__)
    with pytest.raises(AttributeError):
        _ = sl.nothing_of_this_name
