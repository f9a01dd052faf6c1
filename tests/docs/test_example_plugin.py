"""The example plugin is installed as a user would install it, passes its own tests, and works in
every command."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from example_plugin import PACKAGE, Install
from facts import missing_facts

from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.shape_files import write_shape
from slviewer.surface.shapes import PointSet
from slviewer.target.board import Board

Run = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
@pytest.mark.process
def test_the_plugin_installs_without_network_and_passes_its_own_tests(tmp_path: Path) -> None:
    site = tmp_path / "site"
    source = tmp_path / "source"  # a build writes into its source
    shutil.copytree(PACKAGE, source)
    environment = os.environ | {
        "PYTHONPATH": f"{site}{os.pathsep}{PACKAGE.parents[2]}",
        "NO_COLOR": "1",
    }

    def run(*command: str | Path) -> str:
        words = [sys.executable, *map(str, command)]
        done = subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    options = ("-q", "--no-deps", "--no-build-isolation", "--no-index", "--target", site)
    run("-m", "pip", "install", *options, source)
    tests = (
        "-q",
        "-p",
        "no:dash",
        "-p",
        "no:cacheprovider",
        "-o",
        "addopts=",
        f"--rootdir={tmp_path}",
    )
    assert "8 passed" in run("-m", "pytest", *tests, PACKAGE / "tests")
    printed = run("-m", "slviewer.cli", "plugins")
    assert not missing_facts(printed, *ENTRIES, "slviewer-example-plugin 1.0")


ENTRIES = ("hotfolder", "tcpturntable", "aprilgrid", "axisfolders", "pts", "brightness")


def test_its_parts_are_listed(example: None, run: Run) -> None:
    status, printed, _ = run("plugins")
    assert status == 0
    for name in ENTRIES:
        assert f": {name}, from slviewer-example-plugin 1.0: can be used" in printed
    status, listed, _ = run("devices")
    assert status == 0
    assert "hotfolder (camera, projector)" in listed and "tcpturntable (turntable)" in listed


@pytest.mark.slow
@pytest.mark.computes
def test_its_importer_and_exporter_work_in_commands(
    example: None, tmp_path: Path, run: Run
) -> None:
    frames = [
        frame
        for axis, extent in (("x", 240), ("y", 240))
        for parts in (1, 6, 36)
        for frame in phase_steps(axis, 4, extent / parts)
    ]
    sequence = PatternSequence((240, 240), tuple(frames))
    for k in range(len(frames)):
        file = tmp_path / "part" / "xy"[k // 12] / f"{k % 12}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), cv2.convertScaleAbs(render_pattern(sequence, k), alpha=0.7, beta=20))
    status, printed, _ = run("import", "auto", "part", "session", "--projector", "240x240")
    assert status == 0
    assert (
        "layout axisfolders" in printed and "1 capture imported as a target pose: part" in printed
    )
    status, printed, _ = run("import", "axisfolders", "part", "other", "--projector", "240x240")
    assert status == 0 and "1 capture imported" in printed
    assert run("decode", "session", "part", "--out", "maps")[0] == 0
    write_shape(tmp_path / "cloud.pts", PointSet(np.array([[1000.0, 2, 3]], np.float32)))
    assert (tmp_path / "cloud.pts").read_text().splitlines() == [
        "1",
        "1.0000000 0.0020000 0.0030000 128 128 128 128",
    ]


def test_its_board_is_one_of_the_boards(example: None, run: Run) -> None:
    assert len(Board.parse("aprilgrid:6x5:20").points) == 120
    status, _, error = run("target", "aprilgrid:6x5:20", "--out", "sheet.pdf")
    assert status == 1 and "cannot be drawn" in error


def test_a_broken_plugin_is_reported_and_stops_nothing(
    install: Install, tmp_path: Path, run: Run
) -> None:
    entries = (
        "[slviewer.drivers]\nlost = broken_module:DRIVER\nopencv = json:dumps\n"
        "[slviewer.importers]\nwrong = json:dumps\n[slviewer.boards]\nhexgrid = json:nothing\n"
        "[slviewer.operations]\nmerge = other_merge:merge\n"
    )
    install("broken", "1.0", entries)
    (tmp_path / "site" / "broken_module.py").write_text(
        "raise RuntimeError('the maker forgot a file')\n"
    )
    (tmp_path / "site" / "other_merge.py").write_text(
        "from slviewer.plugins import Record, operation\n"
        "class Own(Record, frozen=True, kw_only=True):\n    kind = 'merge'\n    title = 'x'\n"
    )
    status, printed, error = run("plugins")
    printed += error
    assert status == 1 and "a kind of records is called merge already" in printed
    assert "the maker forgot a file" in printed and "the name opencv is taken" in printed
    assert "not a FolderLayout" in printed and "broken 1.0" in printed
    status, printed, _ = run("devices")
    assert status == 0 and "opencv (camera" in printed
    assert run("import", "--help")[0] == 0
    status, _, error = run("target", "hexgrid:6x5:20", "--out", "sheet.pdf")
    assert status == 1 and "slviewer plugins" in error
