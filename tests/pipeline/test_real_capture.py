"""A photographed rig: five poses of a chessboard, Gray code with inverses (the procam-calibration
sample)."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from slviewer.cli import main
from slviewer.pipeline.operation import load_record
from slviewer.records.merge import Reconstruction
from slviewer.session.store import Session

pytestmark = [pytest.mark.computes, pytest.mark.slow]  # two calibrations from large photographs


@pytest.fixture(scope="module")
def kamino(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The imported session, calibrated with stereo alone for the board turned, then with all models
    for the board."""
    session = tmp_path_factory.mktemp("kamino") / "session"
    source = real_data / "kamino_procam_jpg90"
    assert main(["import", "procam-calibration", str(source), str(session)]) == 0
    for board, models in (("9x7", ["--models", "stereo"]), ("7x9", [])):
        out = session.parent / f"{board}.json"
        assert (
            main(
                [
                    "calibrate",
                    str(session),
                    "--target",
                    f"chessboard:{board}:75",
                    *models,
                    "--json",
                    str(out),
                ]
            )
            == 0
        )
    return session


@pytest.mark.parametrize("board", ["9x7", "7x9"])
def test_it_calibrates_as_well_as_plain_opencv(kamino: Path, board: str) -> None:
    found = json.loads((kamino.parent / f"{board}.json").read_text())
    rms = found["calibration"]["stereo"]["fit"]["reprojection_rms_px"]
    assert (
        0.05 < rms["camera"] <= 0.40
        and 0.05 < rms["projector"] <= 0.30
        and 0.05 < rms["stereo"] <= 0.35
    )
    assert found["calibration"]["stereo"]["model"]["rig"]["projector"]["K"][0][0] == pytest.approx(
        1890, abs=25
    )
    assert len(found["calibration"]["stereo"]["fit"]["poses"]) == 5


@pytest.mark.slow
def test_poses_give_the_board(
    kamino: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in (0, 4):
        ply = tmp_path / f"{k}.ply"
        assert main(["reconstruct", str(kamino), f"capture_{k}", "--out", str(ply)]) == 0
        text = capsys.readouterr().out
        with Session.open(kamino) as store:
            # the baseline is vertical
            assert load_record(store, Reconstruction, f"capture_{k}").axis == "y"
        assert "stereo" in text and "pixelwise" in text and "coverage" in text
        points = np.asarray(trimesh.load(ply).vertices)
        centred = points - points.mean(0)
        rms = np.linalg.svd(centred, full_matrices=False)[1][2] / np.sqrt(len(points))
        assert 0.5 < rms < 6.0  # at 3.3 m, Gray code alone: a projector row is some 9 mm of depth
        assert 400 < np.ptp(points[:, 0]) < 900  # the board, and nothing but the board
