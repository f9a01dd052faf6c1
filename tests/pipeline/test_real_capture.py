"""A photographed rig: five poses of a chessboard, Gray code with inverses (the procam-calibration sample)."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from slviewer.cli import main


@pytest.fixture(scope="module")
def kamino(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    session = tmp_path_factory.mktemp("kamino") / "session"
    source = real_data / "kamino_procam_jpg90"
    assert main(["import", "procam-calibration", str(source), str(session)]) == 0
    return session


@pytest.mark.parametrize("target", ["chessboard:9x7:75", "chessboard:7x9:75"])
def test_it_calibrates_as_well_as_plain_opencv(kamino: Path, target: str, tmp_path: Path) -> None:
    out = tmp_path / "calibration.json"
    assert main(["calibrate", str(kamino), "--target", target, "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    rms = found["models"]["stereo"]["reprojection_rms_px"]
    assert 0.05 < rms["camera"] <= 0.40 and 0.05 < rms["projector"] <= 0.30 and 0.05 < rms["stereo"] <= 0.35
    assert found["models"]["stereo"]["K_projector"][0][0] == pytest.approx(1890, abs=25)
    assert len(found["poses_used"]) == 5


def test_each_pose_gives_the_board(kamino: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(kamino), "--target", "chessboard:7x9:75"]) == 0
    for k in range(5):
        ply = tmp_path / f"{k}.ply"
        assert main(["reconstruct", str(kamino), f"capture_{k}", "--out", str(ply)]) == 0
        text = capsys.readouterr().out
        assert "axis y" in text  # the baseline is vertical
        assert "stereo" in text and "pixelwise" in text and "coverage" in text
        points = np.asarray(trimesh.load(ply).vertices)
        centred = points - points.mean(0)
        rms = np.linalg.svd(centred, full_matrices=False)[1][2] / np.sqrt(len(points))
        assert 0.5 < rms < 6.0  # at 3.3 m, Gray code alone: a projector row is some 9 mm of depth
        assert 400 < np.ptp(points[:, 0]) < 900  # the board, and nothing but the board
