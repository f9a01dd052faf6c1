"""The example plugin is installed as a user would install it, passes its own tests, and works in every command."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from slviewer.fringe.patterns import render
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence

pytestmark = pytest.mark.computes

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "docs" / "examples" / "slviewer-example-plugin"


def run(command: list[str], path: Path, where: Path, status: int = 0) -> str:
    """Run Python with installed plugins; returns what it printed."""
    environment = os.environ | {"PYTHONPATH": f"{path}{os.pathsep}{ROOT}", "NO_COLOR": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=where, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example plugin, installed without network."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source") / "plugin"  # a build writes into its source
    shutil.copytree(PACKAGE, source)
    command = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(folder)]
    run([*command, str(source)], folder, folder)
    return folder


def test_the_plugin_passes_its_own_tests(installed: Path, tmp_path: Path) -> None:
    command = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:dash",
        "-p",
        "no:cacheprovider",
        "-o",
        "addopts=",
        f"--rootdir={tmp_path}",
    ]
    assert "8 passed" in run([*command, str(PACKAGE / "tests")], installed, tmp_path)


def test_its_parts_are_listed(installed: Path, tmp_path: Path) -> None:
    printed = run(["-m", "slviewer.cli", "plugins"], installed, tmp_path)
    for name in ("hotfolder", "tcpturntable", "aprilgrid", "axisfolders", "pts"):
        assert f": {name}, from slviewer-example-plugin 1.0: can be used" in printed
    listed = run(["-m", "slviewer.cli", "devices"], installed, tmp_path)
    assert "hotfolder (camera, projector)" in listed and "tcpturntable (turntable)" in listed


def test_its_importer_and_exporter_work_in_commands(installed: Path, tmp_path: Path) -> None:
    frames = [
        frame
        for axis, extent in (("x", 720), ("y", 720))
        for parts in (1, 6, 36)
        for frame in phase_steps(axis, 4, extent / parts)
    ]
    sequence = PatternSequence((720, 720), tuple(frames))
    for k in range(len(frames)):
        file = tmp_path / "part" / "xy"[k // 12] / f"{k % 12}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), cv2.convertScaleAbs(render(sequence, k), alpha=0.7, beta=20))
    command = ["-m", "slviewer.cli", "import"]
    printed = run([*command, "auto", "part", "session", "--projector", "720x720"], installed, tmp_path)
    assert "layout axisfolders" in printed and "1 capture imported as a target pose: part" in printed
    printed = run([*command, "axisfolders", "part", "other", "--projector", "720x720"], installed, tmp_path)
    assert "1 capture imported" in printed
    run(["-m", "slviewer.cli", "decode", "session", "part", "--out", "maps"], installed, tmp_path)
    script = (
        "import numpy as np, pathlib; from slviewer.session.mesh_files import write_shape; "
        "from slviewer.surface.shapes import PointSet; "
        "write_shape(pathlib.Path('cloud.pts'), PointSet(np.array([[1000.0, 2, 3]], np.float32)))"
    )
    run(["-c", script], installed, tmp_path)
    assert (tmp_path / "cloud.pts").read_text().splitlines() == ["1", "1.0000000 0.0020000 0.0030000 128 128 128 128"]


def test_its_board_is_one_of_the_boards(installed: Path, tmp_path: Path) -> None:
    script = "from slviewer.target.board import Board; print(len(Board.parse('aprilgrid:6x5:20').points))"
    assert run(["-c", script], installed, tmp_path).strip() == "120"
    command = ["-m", "slviewer.cli", "target", "aprilgrid:6x5:20", "--out", "sheet.pdf"]
    assert "cannot be drawn" in run(command, installed, tmp_path, status=1)


def test_a_broken_plugin_is_reported_and_stops_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "site"
    info = folder / "broken-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[slviewer.drivers]\nlost = broken_module:DRIVER\nopencv = json:dumps\n"
        "[slviewer.importers]\nwrong = json:dumps\n[slviewer.boards]\nhexgrid = json:nothing\n"
    )
    (folder / "broken_module.py").write_text("raise RuntimeError('the maker forgot a file')\n")
    printed = run(["-m", "slviewer.cli", "plugins"], folder, tmp_path, status=1)
    assert "the maker forgot a file" in printed and "the name opencv is taken" in printed
    assert "not a FolderLayout" in printed and "broken 1.0" in printed
    assert "opencv (camera" in run(["-m", "slviewer.cli", "devices"], folder, tmp_path)
    run(["-m", "slviewer.cli", "import", "--help"], folder, tmp_path)
    command = ["-m", "slviewer.cli", "target", "hexgrid:6x5:20", "--out", "sheet.pdf"]
    assert "slviewer plugins" in run(command, folder, tmp_path, status=1)
