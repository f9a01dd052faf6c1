"""The autopilot runs the wizard on a small rig; then everything that can be looked at, exported and
undone."""

import csv
import importlib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from copies import copy_session
from facts import missing_facts, raises
from scipy.spatial import cKDTree
from small_fields import fit_few_cells
from wizard_events import HANG_S, SPARING, list_texts

from slviewer.errors import Cancelled
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.merge import MergeSettings, merge
from slviewer.pipeline.operation import Operation
from slviewer.pipeline.reconstruct import ReconstructSettings, VerifySettings, reconstruct, verify
from slviewer.records.verification import Verification
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.wizard import result_views
from slviewer.wizard.autopilot import TARGET, Autopilot
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import SessionView, Snapshot

pytestmark = [pytest.mark.computes, pytest.mark.slow]

RIG = {"driver": "simulated", "scale": 0.25, "seed": 0}
POSES = 8


@contextmanager
def flown(
    folder: Path, patterns: str, acts: list[str], rig: dict[str, Any] = RIG
) -> Iterator[Operator]:
    """An operator of the session in this folder, in which the autopilot has done its acts."""
    with fit_few_cells(), Operator(folder, rig, timing=SPARING) as operator:
        operator.choose_patterns(patterns)
        Autopilot(operator, poses=POSES, patience_s=HANG_S, before=acts.append).run()
        yield operator


@pytest.fixture(scope="module")
def acts() -> list[str]:
    return []


@pytest.fixture(scope="module")
def operator(
    recorded: Path, tmp_path_factory: pytest.TempPathFactory, acts: list[str]
) -> Iterator[Operator]:
    """After all acts of the autopilot, which found all poses but the last in its session."""
    folder = tmp_path_factory.mktemp("flight") / "session"
    with Session.create(folder):
        pass
    for pose in (f"pose_{i:02d}" for i in range(1, POSES)):
        for place in (
            f"captures/{pose}",
            *(f"results/{made}/{pose}" for made in ("poses", "evidence", "trust")),
        ):
            copy_session(recorded / "session" / place, folder / place)
    with flown(folder, "p18", acts) as operator:
        yield operator


def session_of(snapshot: Snapshot) -> SessionView:
    assert snapshot.session is not None
    return snapshot.session


def test_the_flight_from_recorded_poses_reaches_a_merged_ply(
    operator: Operator, acts: list[str]
) -> None:
    assert_all_is_measured(operator.snapshot(), acts)
    assert "Capturing pose 7 of 8" not in acts


@pytest.mark.parametrize("rig", [RIG, RIG | {"dlpc350": True}], ids=["", "lightcrafter"])
def test_the_flight_reaches_a_merged_ply(tmp_path: Path, rig: dict[str, Any]) -> None:
    acts: list[str] = []
    with flown(tmp_path / "session", "complementary", acts, rig) as operator:
        assert_all_is_measured(operator.snapshot(), acts)
    assert "Capturing pose 1 of 8" in acts


def test_the_flight_of_two_cameras_reaches_a_merged_ply(tmp_path: Path) -> None:
    acts: list[str] = []
    with flown(tmp_path / "session", "p18", acts, RIG | {"cameras": 2}) as operator:
        snapshot = operator.snapshot()
    session = session_of(snapshot)
    assert [step.state for step in snapshot.steps] == ["done"] * 9
    assert list_texts(snapshot, "error") == []
    assert session.calibration is not None and session.calibration.best == "splined"
    assert session.calibration.stereo.baseline_mm == pytest.approx(260, abs=2)
    found = {each.name: each.record.models for each in session.list_records(Verification)}
    plane, sphere = (found[name]["splined"] for name in ("plane_01", "sphere_01"))
    assert plane.noise_floor_mm is not None and plane.rms_mm < 1.3 * plane.noise_floor_mm
    assert sphere.radius_mm == pytest.approx(98, abs=0.1)
    assert session.merge is not None and session.merge.record.points > 20_000


def assert_all_is_measured(snapshot: Snapshot, acts: list[str]) -> None:
    """Assert that the autopilot has calibrated, verified, scanned, merged and measured."""
    session = session_of(snapshot)
    assert [step.state for step in snapshot.steps] == ["done"] * 9
    assert list_texts(snapshot, "error") == []
    assert "Capturing pose 8 of 8" in acts and acts[-1] == "Writing the report"
    assert {pose.state for pose in session.poses} == {"used"}
    assert all(pose.rms_px and 0.01 < max(pose.rms_px) < 0.4 for pose in session.poses)
    assert session.coverage is not None and session.coverage.share > 0.6
    assert session.enough and session.plan is not None and 0.005 < session.plan.sigma_mm < 0.024  # type: ignore[operator]
    calibration = session.calibration
    assert (
        calibration is not None
        and calibration.best == "splined"
        and abs(calibration.stereo.baseline_mm - 180) < 2
    )
    assert (
        session.verdict is not None and session.verdict_of_calibration and not calibration.refused
    )
    splined = calibration.splined
    assert splined is not None and splined.noise_px["x"] < 0.03
    assert splined.cells_lit["camera"] > 0.8
    assert set(splined.weights) == set(calibration.stereo.poses) and not splined.excluded
    found = {each.name: each.record.models for each in session.list_records(Verification)}
    plane, sphere = found["plane_01"], found["sphere_01"]
    assert plane["splined"].rms_mm < plane["pixelwise"].rms_mm < plane["stereo"].rms_mm < 0.5  # type: ignore[operator]
    assert plane["splined"].masked is not None and plane["stereo"].masked is None
    assert plane["pixelwise"].noise_floor_mm < plane["pixelwise"].rms_mm  # type: ignore[operator]
    assert sphere["pixelwise"].radius_mm == pytest.approx(98, abs=0.5)
    merge = session.merge
    assert merge is not None and merge.record.reference == "scan_03"
    assert set(merge.record.pairs) == {"scan_01", "scan_02"}
    assert all(
        0.01 < pair.rms_mm < 0.5 and pair.overlap > 0.5 for pair in merge.record.pairs.values()
    )
    merged = read_ply(next(e.path for e in session.exports if e.name == "merged_1.ply"))
    assert len(merged.points) == merge.record.points > 30_000
    assert next(scan.label for scan in session.scans if scan.purpose == "scan") == "Ammonite, near"
    sphere, width = session.measurements
    radius = sphere.record["radius"]
    # the simulated sphere's
    assert radius.U is not None and abs(radius.value - 98) < 2 * radius.U < 0.2
    assert 130 < width.record.quantities[0].value < 150  # the ammonite's


def test_poses_are_asked_for_until_the_wanted_sigma_is_reached(operator: Operator) -> None:
    assert operator.set_wanted_sigma(0.0001) and operator.set_hands_free(True)
    snapshot = operator.wait_until_idle(HANG_S)
    session = session_of(snapshot)
    plan = session.plan
    assert plan is not None and session.wanted_mm == 0.0001 and not session.enough
    assert (
        plan.sigma_next_mm is not None
        and plan.sigma_mm is not None
        and plan.sigma_next_mm < plan.sigma_mm
    )
    assert snapshot.hands_free
    assert operator.set_wanted_sigma(None) and not operator.set_wanted_sigma(-1.0)
    snapshot = operator.wait_until_idle(HANG_S)
    assert session_of(snapshot).enough and not snapshot.hands_free
    assert snapshot.step("poses").state == "done"


def test_panels_find_what_they_draw(operator: Operator) -> None:
    store = operator.session
    assert store is not None
    cloud = result_views.load_scan_cloud(store, "plane_01")
    assert cloud.points.shape == (300, 400, 3) and set(cloud.errors) == {
        "stereo",
        "pixelwise",
        "splined",
    }
    measured = np.isfinite(cloud.points).all(-1)
    assert np.isfinite(cloud.phase[measured]).all() and cloud.modulation[measured].min() > 1
    v, u = 150, 200
    assert cloud.nearest(np.zeros(3), cloud.points[v, u]) == (u, v)
    assert cloud.nearest(np.zeros(3), np.array([0, 1.0, 0])) is None
    curve = result_views.pixel_curve(store, (200, 150), "x")
    assert curve is not None and len(curve.phase) >= 4
    assert result_views.pixel_fits(store)["x"].rms_mm.shape == (3, 300, 400)
    assert result_views.merged_cloud(store, "1").normals is not None


def run_guarded(
    operation: Operation[..., Any, Any], settings: object
) -> Callable[[Session, Reporter], object]:
    """Return the job of an operation, which saves nothing once it is cancelled."""
    return lambda store, report: operation.run(
        store.guarded(report.saving), settings, report, print
    )


@pytest.mark.parametrize(
    ("where", "make"),
    [
        pytest.param(
            "calibrate.calibrate_pixelwise",
            run_guarded(calibrate, CalibrateSettings(TARGET)),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "poses.observe",
            run_guarded(calibrate, CalibrateSettings(TARGET)),
            marks=pytest.mark.slow,
        ),
        (
            "reconstruct.reconstruct_cloud",
            run_guarded(reconstruct, ReconstructSettings("scan_01")),
        ),
        pytest.param(
            "merge.fuse",
            run_guarded(merge, MergeSettings(["scan_01"], "scan_02")),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "reconstruct.fit_clouds",
            run_guarded(verify, VerifySettings(["plane_01"], "plane")),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_work_given_up_inside_a_long_call_saves_nothing(
    operator: Operator,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    make: Callable[[Session, Reporter], object],
) -> None:
    store, report = operator.session, Reporter(lambda: None)
    assert store is not None
    module = importlib.import_module(f"slviewer.pipeline.{where.split('.')[0]}")
    long_call = getattr(module, where.split(".")[1])

    def given_up(*args: object, **options: object) -> object:
        report.cancel()
        return long_call(*args, **options)

    monkeypatch.setattr(module, where.split(".")[1], given_up)
    if where == "poses.observe":
        store.trash_result("poses/pose_05")

    def files() -> dict[str, int]:
        kept = (store.folder / folder for folder in ("results", "exports"))
        return {
            str(p): p.stat().st_mtime_ns
            for folder in kept
            for p in folder.rglob("*")
            if p.is_file()
        }

    before = files()
    with raises(Cancelled):
        make(store, report)
    assert files() == before
    if where == "poses.observe":
        assert store.state_of("poses/pose_05") == "absent"


def test_files_for_other_programs(operator: Operator) -> None:
    assert operator.export("mesh", "scan_01", "stl") and operator.export("mesh", "scan_01", "glb")
    assert (
        operator.export("cloud", "scan_02")
        and operator.export("calibration")
        and operator.export("table")
    )
    assert operator.export("merged-mesh") and operator.diagnostic_bundle()
    session = session_of(operator.wait_until_idle(HANG_S))
    files = {export.name: export for export in session.exports}
    assert all(export.bytes > 100 for export in files.values())
    assert len(trimesh.load(files["scan_01_mesh.stl"].path).faces) > 10_000
    assert "vertex" in read_head(files["merged_1_mesh.ply"].path)
    surface = trimesh.load(files["merged_1_mesh.ply"].path)
    cloud = read_ply(files["merged_1.ply"].path)
    gaps = cKDTree(surface.vertices).query(cloud.points[::200])[0]
    assert len(surface.faces) > 5_000 and np.median(gaps) < 1.0
    rows = list(csv.DictReader(files["figures.csv"].path.read_text().splitlines()))
    verified = [row for row in rows if row["kind"] == "verify" and row["model"]]
    kinds = {"calibration", "clouds", "measurements", "merge", "verify"}
    assert len(verified) == 6 and {row["kind"] for row in rows} == kinds
    assert [verified[0][key] for key in ("record", "label", "model")] == [
        "plane_01",
        "A flat plate",
        "stereo",
    ]
    bundle = next(export for export in files.values() if export.name.startswith("diagnostics_"))
    with zipfile.ZipFile(bundle.path) as inside:
        names = inside.namelist()
        assert {"versions.json", "state.json", "log.txt", "session/decisions.json"} <= set(names)
        assert "previews/pose_01.jpg" in names and not [
            n for n in names if "frames" in n or n.endswith(".npy")
        ]
        assert missing_facts(inside.read("log.txt").decode(), "8 poses") == []
    assert bundle.bytes < 1_000_000
    assert not operator.export("mesh", "scan_01", "doc") and not operator.export("cloud", "../x")
    assert not [
        path
        for path in (operator.session.folder / "exports").iterdir()
        if path.name.startswith(".")
    ]  # type: ignore[union-attr]


def read_head(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(1000).decode("ascii", "replace")


def test_a_scale_that_was_applied_is_in_the_clouds_and_makes_older_ones_stale(
    operator: Operator,
) -> None:
    store = operator.session
    assert store is not None
    before = result_views.load_scan_cloud(store, "scan_02").points
    inputs = store.input_hashes("calibration/splined")
    store.save_result(
        "scale/splined", {"factor": 1.001, "certificate": "lab 7", "inputs": inputs}, {}
    )
    assert operator.choose_model("splined")
    session = session_of(operator.wait_until_idle(HANG_S))
    assert session.calibration is not None and session.calibration.chosen == "splined"
    assert set(session.calibration.scales) == {"splined"}
    assert missing_facts(session.calibration.scales["splined"], "+1000 ppm", "lab 7") == []
    assert {scan.cloud for scan in session.scans} == {"stale"} and all(
        view.stale for view in session.list_records(Verification)
    )
    assert operator.reconstruct("scan_02")
    scan = operator.wait_until_idle(HANG_S).scan("scan_02")
    assert (
        scan is not None
        and scan.cloud == "fresh"
        and missing_facts(scan.figures.scale, "+1000 ppm", "lab 7") == []
    )
    after = result_views.load_scan_cloud(store, "scan_02").points
    both = np.isfinite(before[..., 2]) & np.isfinite(after[..., 2])
    np.testing.assert_allclose(after[both], before[both] * np.float32(1.001), rtol=1e-6)
    store.trash_result("scale/splined")
    assert operator.choose_model("") and not operator.choose_model("anchored")


def test_what_changes_makes_stale_what_came_from_it(operator: Operator) -> None:
    assert operator.exclude("pose_02")
    stale = operator.wait_until_idle(HANG_S)
    assert missing_facts(session_of(stale).calibration.stale, "pose_02", "excluded") == []  # type: ignore[union-attr]
    assert stale.step("calibrate").state == "ready" and stale.step("scan").state == "done"
    assert operator.calibrate()
    again = operator.wait_until_idle(HANG_S)
    session = session_of(again)
    assert (
        session.calibration is not None
        and session.calibration.stale == ""
        and len(session.calibration.stereo.poses) == 7
    )
    # what was made of other poses is gone
    assert session.calibration.models == (
        "stereo",
        "pixelwise",
    )
    assert any(not missing_facts(notice.text, "splined", 8, 7) for notice in again.notices)
    assert {scan.cloud for scan in session.scans} == {"stale"} and all(
        view.stale for view in session.list_records(Verification)
    )
    assert (
        session.merge is not None and session.merge.stale and again.step("merge").state == "ready"
    )
    assert again.pose("pose_02").state == "excluded"  # type: ignore[union-attr]
    assert operator.reconstruct("scan_01")
    assert (
        again.scan("scan_01") is not None
        and operator.wait_until_idle(HANG_S).scan("scan_01").cloud == "fresh"
    )  # type: ignore[union-attr]
    assert operator.undo_merge()
    undone = session_of(operator.wait_until_idle(HANG_S))
    assert undone.merge is None and "merged_1.ply" not in {export.name for export in undone.exports}
    assert not operator.undo_merge()
    assert operator.delete("scan_02")
    assert operator.wait_until_idle(HANG_S).scan("scan_02") is None
