"""What every command prints where it refuses or warns: messages/COMMAND.txt, one file a command,
reviewed as a whole.

A file is a terminal's transcript. The lines that begin with $ are run, one after the other, in a
copy of the same small folders; what they print must be what stands below them. To add a situation,
add its line. With UPDATE_MESSAGES=1 in the environment the files are written instead: read their
difference before you commit it.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from slviewer.cli import find_commands, main
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import multifrequency
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.pipeline.import_captures import import_opencv_calibration
from slviewer.session.exporters import write_calibration
from slviewer.session.store import Session
from slviewer.session.toml import describe_sequence

FILES = sorted((Path(__file__).parent / "messages").glob("*.txt"))
WITHOUT_SITUATIONS = {"devices", "plugins"}
"""They take no arguments; tests/docs/test_example_plugin.py lists broken plugins."""
COMPUTING = {
    "accept",
    "calibrate",
    "check",
    "decode",
    "import",
    "merge",
    "reconstruct",
    "show-on-part",
    "verify",
}
"""Their situations decode or fit, for which kernels are compiled."""
CAMERA, PROJECTOR, FOCAL_PX, SHIFT_PX, BASELINE_MM = (96, 64), (128, 64), 120.0, 8, 40.0
SPHERE = """kind = "sphere"
name = "sphere"
certificate = "none"
[calibrated]
diameter_mm = 196.0
diameter_U_mm = 0.01
form_mm = 0.01
form_U_mm = 0.01
temperature_C = 20.0
expansion_ppm_K = 0.0
expansion_U_ppm_K = 0.0
[measured]
temperature_C = 20.0
temperature_U_K = 0.1
captures = ["sphere_*"]
[limits]
form_mm = 5.0
"""


def render_plane(sequence: PatternSequence) -> np.ndarray:
    """Return frames (n, h, w) uint8 of a plane that faces both devices, FOCAL_PX * BASELINE_MM /
    SHIFT_PX mm away."""
    first = (PROJECTOR[0] - CAMERA[0]) // 2 + SHIFT_PX
    images = [
        render_pattern(sequence, k)[:, first : first + CAMERA[0]]
        for k in range(len(sequence.frames))
    ]
    return np.stack([cv2.convertScaleAbs(image, alpha=0.7, beta=20) for image in images])


def write_images(folder: Path, sequence: PatternSequence, frames: np.ndarray) -> None:
    """Write frames as images, with the TOML that describes them."""
    folder.mkdir()
    files = [f"{k:02d}.png" for k in range(len(frames))]
    for file, frame in zip(files, frames, strict=True):
        cv2.imwrite(str(folder / file), frame)
    (folder / "frames.toml").write_text(describe_sequence(sequence, files))


def make_folders(folder: Path) -> None:
    """Make the sessions, images and files that the situations name."""
    both = multifrequency(PROJECTOR)
    across = one_axis(both, "x")
    frames = render_plane(both)

    # sessions: empty, scanned, calibrated (before it held captures, which confirm a calibration),
    # and three refused
    rig = {
        **{f"K_{name}": [[FOCAL_PX, 0, (w - 1) / 2], [0, FOCAL_PX, (h - 1) / 2], [0, 0, 1]]
           for name, (w, h) in (("camera", CAMERA), ("projector", PROJECTOR))},
        **{"D_camera": [0.0] * 5, "D_projector": [0.0] * 5, "R": np.eye(3),
        "T": [BASELINE_MM, 0, 0]},
    }  # fmt: skip
    write_calibration(
        folder / "rig.yml", {name: np.array(value, float) for name, value in rig.items()}
    )
    for name in ("empty", "scanned", "calibrated"):
        with Session.create(folder / name) as session:
            if name == "empty":
                continue
            if name == "calibrated":
                import_opencv_calibration(
                    folder / "rig.yml", session, camera=CAMERA, projector=PROJECTOR
                )
            session.save_capture("pose_01", "calibration", both, frames, source="made")
            session.save_capture("part", "scan", both, frames, source="made")
            session.save_capture("across", "scan", across, render_plane(across), source="made")
            session.save_capture("dark", "scan", both, np.zeros_like(frames), source="made")
            session.save_capture("smaller", "scan", both, frames[:, :32, :48], source="made")
    for name in ("damaged", "broken", "later"):
        shutil.copytree(folder / "scanned", folder / name)
    chunk = folder / "damaged" / "captures" / "part" / "frames.zarr" / "c.3.0.0"
    chunk.write_bytes(chunk.read_bytes()[:-100])
    (folder / "broken" / "session.json").write_text("")
    (folder / "later" / "session.json").write_text('{"schema": 99}')

    # images: complete, without one, one of them cut short, and a single one
    write_images(folder / "images", both, frames)
    for name in ("fewer", "cut"):
        shutil.copytree(folder / "images", folder / name)
    (folder / "fewer" / "03.png").unlink()
    (folder / "pictures").mkdir()
    shutil.copy(folder / "images" / "00.png", folder / "pictures")
    (folder / "cut" / "03.png").write_bytes((folder / "images" / "03.png").read_bytes()[:60])

    # files
    (folder / "text").mkdir()
    (folder / "text" / "notes.txt").write_text("notes\n")
    (folder / "wrong.toml").write_text("a = [\n")
    (folder / "sphere.toml").write_text(SPHERE)
    (folder / "half.toml").write_text('[camera]\ndriver = "simulated"\n')
    (folder / "unknown-driver.toml").write_text('driver = "banana"\n')
    (folder / "unknown-option.toml").write_text('driver = "simulated"\ncolour = "red"\n')
    (folder / "page.html").write_text("<html></html>")
    trimesh.creation.box((10, 20, 30)).export(folder / "nominal.stl")
    (folder / "cut.stl").write_bytes((folder / "nominal.stl").read_bytes()[:-100])


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what `make_folders` makes; only to be copied."""
    folder = tmp_path_factory.mktemp("messages")
    make_folders(folder)
    return folder


def run_line(line: str) -> str:
    """Return what a command prints, and its exit status where that is not 0."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(shlex.split(line)[1:])
    assert "Traceback" not in printed.getvalue()
    return printed.getvalue() + (f"[status {status}]\n" if status else "")


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(file, marks=pytest.mark.computes if file.stem in COMPUTING else ())
        for file in FILES
    ],
    ids=lambda file: file.stem,
)
def test_a_command_prints_its_reviewed_messages(
    file: Path, folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "work"
    shutil.copytree(folders, work)
    monkeypatch.chdir(work)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    reviewed = file.read_text(encoding="utf-8")
    lines = re.findall(r"^\$ (slviewer.*)$", reviewed, re.MULTILINE)
    printed = "\n".join(f"$ {line}\n{run_line(line)}" for line in lines).replace(str(work), "<tmp>")
    printed = re.sub(r"\b[0-9a-f]{8}\b", "<hash>", printed)
    if "UPDATE_MESSAGES" in os.environ:
        file.write_text(printed, encoding="utf-8")
    assert printed == file.read_text(encoding="utf-8")


def test_every_command_has_reviewed_messages() -> None:
    assert {file.stem for file in FILES} == set(find_commands()) - WITHOUT_SITUATIONS
    for file in FILES:
        text = file.read_text(encoding="utf-8")
        assert f"$ slviewer {file.stem}" in text and "[status " in text, file.name
