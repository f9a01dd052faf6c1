"""A cloud outside of the depths at which its rig was calibrated says so, wherever it is used."""

from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts

from slviewer.fringe.presets import multifrequency
from slviewer.gui.steps.scan import describe_depths, live_html
from slviewer.pipeline.cloud_record import check_depths, list_outside_depths
from slviewer.pipeline.models import load_stereo, save_model
from slviewer.pipeline.operation import Job, load_record
from slviewer.pipeline.reconstruct import scan_cloud
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.merge import DepthCheck, Reconstruction
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.boards import FLAT, BoardScene, Pose
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.wizard.live_scan import LiveModel
from slviewer.wizard.snapshot import BoardSeen, LiveView

pytestmark = pytest.mark.computes

Run = Callable[..., tuple[int, str, str]]
RIG = letter(0.1, 3, local_distortion_px=0.0)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of a plate that is tilted from about 570 to 640 mm."""
    folder = tmp_path_factory.mktemp("depths") / "session"
    tilt = np.radians(30)
    R = np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]], float
    )
    pose = Pose(R, np.array([-60.0, -50.0, 640.0]))
    plate = BoardScene(pose, None, (0, 0), (120, 100), FLAT, np.zeros((0, 2)))
    sequence = multifrequency(RIG.projector.size, 4)
    frames = Renderer(RIG, plate).capture(sequence, 1)
    with Session.create(folder) as store:
        save_true_stereo(store, RIG)
        store.save_capture("part", "scan", sequence, frames, source="test")
    return folder


def calibrate_between(session: Path, *depths_mm: float) -> None:
    near, far = depths_mm
    with Session.open(session, write=True) as store:
        save_model(store, replace(load_stereo(store), depth_range_mm=(near, far)))


@pytest.mark.parametrize(
    ("near", "far", "least", "most"), [(500, 700, 0, 0), (560, 610, 0.2, 0.8), (400, 500, 1, 1)]
)
def test_share_of_points_outside_is_stated(
    session: Path, run: Run, near: float, far: float, least: float, most: float
) -> None:
    calibrate_between(session, near, far)
    status, text, error = run("reconstruct", session, "part")
    with Session.open(session) as store:
        record = load_record(store, Reconstruction, "part")
    assert status == 0 and record.depths is not None
    assert least <= record.depths.outside <= most
    assert record.is_good == (most == 0)
    if most == 0:
        assert "outside the calibrated depths" not in text + error + record.summary()
    else:
        assert record.depths.nearest_mm is not None and record.depths.sigma_mm is not None
        assert not record.depths.is_whole and 0.01 < record.depths.sigma_mm < 2
        share = f"{100 * record.depths.outside:.0f} %"
        found = missing_facts(text, share, f"{near:.0f} to {far:.0f} mm", "noise alone")
        assert found == []
        assert missing_facts(record.summary(), share, "outside") == []


def test_merge_warns_of_scans_outside_and_records_them(session: Path) -> None:
    calibrate_between(session, 400, 500)
    cloud = Cloud(np.full((2, 3, 3), 600.0), "x", "stereo", np.full((2, 3), 0.1))
    warnings: list[str] = []
    with Session.open(session) as store:
        found = list_outside_depths(store, {"a": cloud, "b": cloud}, warnings.append)
        imported = replace(cloud, model="")
        assert check_depths(store, imported) is None
        assert list_outside_depths(store, {"c": imported}, warnings.append) == {}
    assert found["a"].outside == 1 and len(warnings) == 1  # one cause, one message
    assert missing_facts(warnings[0], "a, b", "400 to 500 mm", "100 %") == []


def test_sigma_outside_is_said_to_be_whole_where_the_model_knows_its_errors(session: Path) -> None:
    calibrate_between(session, 400, 500)
    sigma = np.full((2, 3), 0.3)
    cloud = Cloud(np.full((2, 3, 3), 600.0), "x", "stereo", sigma, sigma_calibration=4 / 3 * sigma)
    with Session.open(session) as store:
        check = check_depths(store, cloud)
    assert check == DepthCheck((400, 500), 1.0, 600, 600, pytest.approx(0.5), True)
    assert missing_facts(check.text(), "0.500 mm", "includes") == []


def test_live_scan_and_board_in_view_are_compared_with_the_calibrated_depths(
    session: Path,
) -> None:
    with Session.open(session) as store:
        model, sequence = load_stereo(store), store.load_capture("part").sequence
    live = LiveModel(sequence, "x", model, 2.0, depths_mm=(400.0, 500.0))
    points = np.full((80, 80, 3), np.nan, np.float32)
    assert live.share_outside(points) == 0
    points[:40, :, 2], points[40:, :, 2] = 900, 1001
    assert live.share_outside(points) == 0.5
    live.depths_mm = None
    assert live.share_outside(points) == 0

    text, tone = describe_depths((489.0, 669.0), None)
    assert missing_facts(text, "489 to 669 mm") == [] and tone == "dim"
    T = np.eye(4)
    for depth, expected in ((600.0, "dim"), (745.0, "warning"), (400.0, "warning")):
        T[2, 3] = depth
        text, tone = describe_depths(
            (489.0, 669.0), BoardSeen(np.zeros((4, 2)), np.zeros((4, 2)), 1.0, T, 0.0)
        )
        assert missing_facts(text, f"{depth:.0f} mm") == [] and tone == expected
    assert describe_depths(None, None)[0] == ""
    shown = LiveView(5.0, 5.0, 100.0, 1000, 0.64)
    html = unescape(live_html(shown, 500, (489.0, 669.0))).replace("\xa0", " ")
    assert missing_facts(html, "64 %", "489 to 669 mm") == []
    assert "outside" not in live_html(replace(shown, outside=0.0), 500, (489.0, 669.0))
    assert "outside" not in live_html(shown, 500, None)


def test_extrapolated_points_are_marked_in_files_and_used_by_nothing_else(
    recorded: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def evaluate_again(*_: object) -> None:
        raise AssertionError("the depths are evaluated again")

    monkeypatch.setattr("slviewer.pipeline.cloud_record.masked_share", evaluate_again)
    folder = copy_session(recorded / "session", tmp_path / "session")
    path = tmp_path / "all.ply"
    assert run("reconstruct", folder, "plane_01", "--out", path)[0] == 0
    with Session.open(folder) as store:
        record = load_record(store, Reconstruction, "plane_01")
        stored = store.load_result("clouds/plane_01")[1]["extrapolated"]
        cloud = scan_cloud(Job(store), "plane_01")
    ply = read_ply(path)
    assert record.extrapolated == stored.sum() == ply.scalars["extrapolated"].sum() > 100
    assert record.points + record.extrapolated == len(ply.points)
    assert record.masked == pytest.approx(record.extrapolated / len(ply.points), rel=1e-9)
    assert record.extrapolated_mm is not None and record.sigma_calibration_mm is not None
    assert record.extrapolated_mm > 1.5 * record.sigma_calibration_mm
    assert cloud.extrapolated is None and np.count_nonzero(cloud.mask) == record.points
    status, text, _ = run("reconstruct", folder, "plane_01", "--out", path, "--supported-only")
    ply = read_ply(path)
    assert status == 0 and len(ply.points) == record.points
    assert "extrapolated" not in ply.scalars and "extrapolated" in text
