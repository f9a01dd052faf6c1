"""The camera alone: from pictures of the board in a folder."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts

from slviewer.calibration.camera import calibrate_camera
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import p18
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate, calibrate_camera_alone
from slviewer.pipeline.certificate import verify_report
from slviewer.pipeline.report import report
from slviewer.records.calibration import StereoFit
from slviewer.session.importers.camera_file import read_camera_file
from slviewer.session.importers.images import read_image
from slviewer.session.store import Session
from slviewer.simulation.boards import FLAT, printed_board
from slviewer.simulation.plans import target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.truth import rig_record
from slviewer.target.board import Board, Detection

Run = Callable[..., tuple[int, str, str]]
pytestmark = pytest.mark.computes

BOARD = Board.parse("circles:21x16:9")
RIG = letter(0.25, 4, local_distortion_px=0.0)
WHITE = p18(RIG.projector.size)  # whose frame 25 is


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    width, height = RIG.camera.size
    for i, pose in enumerate(target_poses(RIG, BOARD, 8)):
        image = np.empty((height, width), np.uint8)
        renderer = Renderer(RIG, printed_board(BOARD, pose, FLAT, RIG.seed))
        renderer.frame(profile(WHITE, 25), np.array([i, 7], np.uint32), image)
        cv2.imwrite(str(folder / f"board_{i}.png"), image)
    cv2.imwrite(str(folder / "wall.png"), np.full((height, width), 90, np.uint8))
    return folder


@pytest.mark.slow
def test_a_camera_is_calibrated_from_pictures(pictures: Path, run: Run, tmp_path: Path) -> None:
    out, found = tmp_path / "camera.yml", tmp_path / "camera.json"
    status, text, error = run(
        "calibrate", pictures, "--target", BOARD, "--camera-only", "--out", out, "--json", found
    )
    assert (
        status == 0
        and not missing_facts(text, "good", "wall.png")
        and not missing_facts(error, "wall.png")
    )
    data = json.loads(found.read_text())
    K, true = np.array(data["K_camera"]), np.array(rig_record(RIG)["camera"]["K"])
    assert 0.005 < data["reprojection_rms_px"] < 0.05
    assert np.all(np.abs(np.diag(K - true)[:2]) < 5 * np.array(data["focal_sigma_px"]) + 0.1)
    storage = cv2.FileStorage(str(out), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("K_camera").mat(), K)
    storage.release()


def test_a_camera_calibration_states_how_many_features_were_seen() -> None:
    board, size = Board.parse("chessboard:9x6:20"), (640, 480)
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    rng = np.random.default_rng(1)
    detections = {}
    for i in range(8):
        turn, shift = rng.uniform(-0.4, 0.4, 3), np.array([rng.uniform(-180, 20), -50, 300.0])
        seen, _ = cv2.projectPoints(board.points, turn, shift, K, np.zeros(5))
        pixels = seen[:, 0] + rng.normal(0, 0.03, (len(seen), 2))
        ids = np.flatnonzero(((pixels > 0) & (pixels < size)).all(1))
        detections[f"picture_{i}"] = Detection(pixels[ids], ids)
    counts = {name: len(each.ids) for name, each in detections.items()}
    assert min(counts.values()) < 54
    calibration = calibrate_camera(board, detections, size)
    assert calibration.to_json()["features"] == counts
    fewest, most = min(counts.values()), max(counts.values())
    assert not missing_facts(calibration.text(), "54 features", f"{fewest} to {most}")


def test_bars_and_a_dead_column_are_no_part_of_pictures(pictures: Path, tmp_path: Path) -> None:
    names = [f"board_{i}.png" for i in range(4)]
    rng = np.random.default_rng(0)
    for name in names:
        image = np.pad(read_image(pictures / name), ((0, 0), (60, 30)), constant_values=128)
        image[:, 200] = 0
        cv2.imwrite(str(tmp_path / name), image)
    noisy = tmp_path / "noisy"
    noisy.mkdir()
    for name in names:
        image = read_image(tmp_path / name)
        bars = np.rint(128 + rng.normal(0, 1.5, image.shape)).astype(np.uint8)
        image[:, :60], image[:, -30:] = bars[:, :60], bars[:, -30:]
        cv2.imwrite(str(noisy / name), image)
    plain = calibrate_camera_alone(pictures, str(BOARD), poses=names)
    for folder, named in ((tmp_path, ("60 px", "30 px", "column 200")), (noisy, ("column 200",))):
        barred = calibrate_camera_alone(folder, str(BOARD))
        moved = plain.lens.K + np.array([[0, 0, 60], [0, 0, 0], [0, 0, 0]])
        sigma = max(plain.focal_sigma_px)
        np.testing.assert_allclose(barred.lens.K, moved, atol=0.5 * sigma)
        assert barred.verdict.level == plain.verdict.level and not barred.excluded
        (note,) = (f for f in barred.verdict.findings if f.cause == "constant-pixels")
        assert not missing_facts(note.observation, *named)


def test_pictures_are_chosen_and_too_few_are_refused(pictures: Path, run: Run) -> None:
    status, _, error = run(
        "calibrate", pictures, "--target", BOARD, "--camera-only", "--poses", "board_[01].png"
    )
    assert status == 3 and not missing_facts(error, "2 usable poses")
    assert (
        run("calibrate", pictures, "--target", BOARD, "--camera-only", "--exclude", "none*")[0] == 2
    )


@pytest.mark.slow
def test_a_session_keeps_the_lens_that_was_fixed(
    recorded: Path, pictures: Path, run: Run, tmp_path: Path
) -> None:
    folder, lens = copy_session(recorded / "session", tmp_path / "session"), tmp_path / "lens.yaml"
    status, text, _ = run("calibrate", folder, "--target", BOARD, "--camera-only", "--out", lens)
    assert status == 0 and not missing_facts(text, "--camera", str(lens), "--fix-camera")
    settings = CalibrateSettings(str(BOARD), ("stereo",), camera=lens, fix_camera=True)
    found = calibrate.run(folder, replace(settings, replace_all=True))["stereo"]
    assert isinstance(found.fit, StereoFit) and found.fit.fixed_camera == "lens.yaml"
    assert "lens/camera" in found.inputs and found.settings["camera"] == "lens/camera"
    assert any("lens.yaml" in note for note in found.fit.table().notes)
    known = read_camera_file(lens, RIG.camera.size)
    assert found.fit.focal_px["camera"] == (known.lens.K[0, 0], known.lens.K[1, 1])
    lens.unlink()
    calibrate(folder, **found.settings)  # as the wizard does
    page = tmp_path / "report.html"
    report(folder, page)
    checked = verify_report(folder, page)
    assert {c.state for c in checked.checks if c.what == "calibration/stereo"} == {"same"}
    with Session.open(folder, write=True) as store:
        assert store.state_of("calibration/stereo") == "fresh"
        meta = store.load_result("lens/camera")[0]
        kept = {k: v for k, v in meta.items() if k not in ("hash", "arrays", "checksums")}
        store.save_result("lens/camera", {**kept, "content": "another"}, {})
        assert store.state_of("calibration/stereo") == "stale"
