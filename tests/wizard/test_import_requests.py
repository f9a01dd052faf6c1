"""Importing as an operator asks for it: a folder of the computer, or a zip that was uploaded."""

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from wizard_events import HANG_S, list_texts

from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray
from slviewer.pipeline.import_captures import import_opencv_calibration
from slviewer.session.exporters import write_calibration
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Level

PROJECTOR = (120, 90)


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    with Operator(tmp_path / "session") as engine:
        yield engine


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Two captures of the procam-calibration layout, and one with a missing image."""
    sequence = gray(PROJECTOR)
    for n in range(3):
        folder = tmp_path / "source" / f"capture_{n}"
        folder.mkdir(parents=True)
        rng = np.random.default_rng(n)
        for i in range(len(sequence.frames)):
            frame = render_pattern(sequence, i) * 0.5 + 40 + rng.normal(0, 1, PROJECTOR[::-1])
            cv2.imwrite(str(folder / f"graycode_{i:02d}.png"), frame.round().astype(np.uint8))
    (tmp_path / "source" / "capture_1" / "graycode_05.png").unlink()
    return tmp_path / "source"


def archived(source: Path) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as out:
        for file in sorted(source.rglob("*.png")):
            out.write(file, file.relative_to(source.parent))
        out.writestr("source/notes.txt", "x")
    return data.getvalue()


def reports(operator: Operator, level: Level, *facts: object) -> bool:
    """Whether a notice of this level states these facts."""
    return any(not missing_facts(text, *facts) for text in list_texts(operator.snapshot(), level))


@pytest.mark.computes
def test_a_folder_becomes_poses_and_what_is_skipped_is_said(
    operator: Operator, source: Path
) -> None:
    assert operator.import_folder(f" {source} ", projector="120x90")
    view = operator.wait_until_idle(HANG_S).session
    assert view is not None and [pose.name for pose in view.poses] == ["capture_0", "capture_2"]
    assert reports(operator, "good", 2, "poses", "capture_0", "capture_2")
    assert reports(operator, "warning", "capture_1", "graycode_05")


@pytest.mark.computes
def test_a_zip_becomes_scans_and_leaves_nothing_behind(operator: Operator, source: Path) -> None:
    assert operator.import_zip("my scans.zip", archived(source), role="scan", projector="120x90")
    view = operator.wait_until_idle(HANG_S).session
    assert view is not None and [scan.name for scan in view.scans] == ["capture_0", "capture_2"]
    assert reports(operator, "warning", "notes.txt")
    assert reports(operator, "good", 2, "scans", "capture_0", "capture_2")
    assert operator.session is not None
    assert operator.session.load_capture("capture_0").meta["source"] == "my scans.zip"
    assert not [path for path in operator.session.folder.iterdir() if "import" in path.name]
    assert operator.import_zip(
        "one.zip", archived(source / "capture_0"), role="scan", projector="120x90"
    )
    operator.wait_until_idle(HANG_S)
    assert reports(operator, "warning", "capture_0", "already")
    # as poses
    assert operator.import_zip("one.zip", archived(source / "capture_0"), projector="120x90")
    operator.wait_until_idle(HANG_S)
    assert reports(operator, "error", "capture_0", "already")


def test_what_cannot_be_imported_is_said_in_words(
    operator: Operator, source: Path, tmp_path: Path
) -> None:
    assert not operator.import_folder("  ")
    for path, facts in (
        (tmp_path / "absent", [tmp_path / "absent"]),
        (tmp_path, [tmp_path, source]),
    ):
        assert operator.import_folder(path)
        operator.wait_until_idle(HANG_S)
        assert reports(operator, "error", *facts), facts
    assert operator.import_zip("a.zip", b"no zip")
    operator.wait_until_idle(HANG_S)
    assert reports(operator, "error", "zip")
    assert operator.import_folder(source, projector="wide")
    operator.wait_until_idle(HANG_S)
    assert reports(operator, "error", "wide")
    assert operator.session is not None and operator.session.capture_names() == []


def test_a_cancelled_import_saves_nothing(operator: Operator, source: Path) -> None:
    assert operator.import_folder(source, projector="120x90")
    operator.cancel()
    operator.wait_until_idle(HANG_S)
    assert operator.session is not None and operator.session.capture_names() == []


@pytest.mark.process
@pytest.mark.computes
def test_an_imported_calibration_without_sizes_waits_for_captures(
    source: Path, tmp_path: Path
) -> None:
    K, R = np.array([[400.0, 0, 60], [0, 400.0, 45], [0, 0, 1]]), np.eye(3)
    matrices = {
        "K_camera": K,
        "D_camera": np.zeros(5),
        "K_projector": K,
        "D_projector": np.zeros(5),
    }
    write_calibration(tmp_path / "rig.yml", {**matrices, "R": R, "T": np.array([100.0, 0, 0])})
    import_opencv_calibration(tmp_path / "rig.yml", tmp_path / "session")
    with Operator(tmp_path / "session") as operator:
        view = operator.wait_until_idle(HANG_S).session
        assert view is not None and view.calibration is None
        assert operator.import_folder(source, projector="120x90")
        view = operator.wait_until_idle(HANG_S).session
        assert (
            view is not None
            and view.calibration is not None
            and view.calibration.stereo.baseline_mm == 100
        )


@pytest.mark.computes
def test_a_dropped_file_is_imported_by_its_kind(
    operator: Operator, source: Path, tmp_path: Path
) -> None:
    points = np.random.default_rng(0).normal((0, 0, 500), 20, (500, 3))
    text = "\n".join(" ".join(map(str, point)) for point in points).encode()
    K, R = np.array([[400.0, 0, 60], [0, 400.0, 45], [0, 0, 1]]), np.eye(3)
    rig = {f"{kind}_{of}": K for kind in "KD" for of in ("camera", "projector")}
    rig |= {"D_camera": np.zeros(5), "D_projector": np.zeros(5), "R": R, "T": 100 * R[0]}
    write_calibration(tmp_path / "rig.yml", rig)
    assert not operator.import_file("notes.md", b"x")
    assert "notes.md" in list_texts(operator, "error")[0]
    assert operator.import_folder(source / "capture_0", projector="120x90")  # states the size
    assert operator.import_file("../a part.xyz", text)
    assert operator.import_file("set.zip", archived(source))
    view = operator.wait_until_idle(HANG_S).content
    assert [scan.name for scan in view.scans] == ["a_part"], list_texts(operator, "error")
    assert [pose.name for pose in view.poses] == ["capture_0", "capture_2"]
    assert operator.import_file("rig.yml", (tmp_path / "rig.yml").read_bytes())
    operator.wait_until_idle(HANG_S)
    # the frames, of no scene, contradict it
    assert reports(operator, "error", "capture_0", "calibration")
    assert operator.session is not None
    left = {each.name for each in operator.session.folder.glob(".*")}
    assert left <= {".lock", ".lock-holder"}
