"""From a calibration to a file: the panels that measure, in a browser, over a recorded session."""

import csv
import json
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from copies import copy_session
from facts import missing_facts
from playwright.sync_api import Browser, Page, expect
from playwright.sync_api import TimeoutError as NotShownError
from wizard_page import (
    CALM,
    PATIENCE_S,
    SIZE,
    browse,
    button,
    choose,
    click,
    cut_labels,
    expect_message,
    field,
    wait_until_still,
)

from slviewer.gui.app import App
from slviewer.gui.colouring import paint_points, scan_values, uncertainty
from slviewer.gui.panel import Painter, display_name
from slviewer.gui.steps.calibrate import colour_errors, named_poses, verdict_html
from slviewer.gui.steps.export import _describe_view
from slviewer.gui.steps.rig import list_presets
from slviewer.gui.steps.scan import point_html, sort_scans
from slviewer.gui.widgets import colour_range, records_html, report_table
from slviewer.pipeline.accept import gather_results
from slviewer.pipeline.models import save_verdict
from slviewer.pipeline.operation import Stored
from slviewer.records.acceptance import HeldOutPose, ModelComparison
from slviewer.records.calibration import SECOND_CAMERA, Reprojection
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Reconstruction
from slviewer.records.record import Cell, Table, to_plain
from slviewer.records.verdict import Finding, Verdict
from slviewer.records.verification import ModelFit, Shape, Verification
from slviewer.server.secure import Serving
from slviewer.session.ply import read_ply
from slviewer.session.store import Session
from slviewer.simulation.assets import asset
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import ScanCloud
from slviewer.wizard.snapshot import ExportView, ScanView

REJECTED = Verdict.of(
    [
        Finding(
            "moved",
            "rejected",
            "pose_03 moved by 0.9 px",
            "hold the <b>board</b> still",
            ("pose_03",),
        )
    ]
)


@pytest.fixture(scope="module")
def measured(
    recorded: Path, tmp_path_factory: pytest.TempPathFactory, browser: Browser
) -> Iterator[tuple[Page, Operator, list[str]]]:
    """A page on a copy of the recorded session, without a rig, and without the model that takes
    longest to compare."""
    folder = copy_session(recorded / "session", tmp_path_factory.mktemp("measured") / "session")
    with Session.open(folder, write=True) as store:
        store.trash_result("calibration/splined")
    with Operator(folder, timing=CALM) as engine:
        wizard = App(engine, Serving(port=0))
        with browse(browser, wizard) as found:
            yield found.page, engine, found.errors
        wizard.close()


def test_calibration_shows_poses_and_fit_of_a_pixel(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, _, errors = measured
    click(page, "4. Calibrate")
    expect(page.get_by_text("Reprojection RMS, camera")).to_be_visible()
    expect(
        page.get_by_text("Reprojection error of each target pose by the stereo model.")
    ).to_be_visible()
    choose(page, "Pose", "pose_02")
    expect(page.get_by_text("pose_02, camera, stereo: measured minus predicted")).to_be_visible()
    choose(page, "Residuals", "projector")
    expect(page.get_by_text("pose_02, projector, stereo: measured minus predicted")).to_be_visible()
    expect(page.get_by_text(re.compile(r"Fit of camera pixel \(\d+, \d+\) to"))).to_be_visible()
    field(page, "Pixel u").fill("150")
    field(page, "Pixel v").fill("120")
    expect(page.get_by_text("Fit of camera pixel (150, 120) to")).to_be_visible()
    field(page, "Pixel v").fill("0")
    expect(page.get_by_text("Pixel (150, 0) saw the board in too few poses")).to_be_visible()

    click(page, "Exclude pose_02")
    expect(button(page, "Include pose_02 again")).to_be_visible()
    expect(page.get_by_text("Excluded since").first).to_be_visible()
    click(page, "Include pose_02 again")
    expect(button(page, "Exclude pose_02")).to_be_visible()
    page.get_by_text("Parameters", exact=True).click()
    expect(page.get_by_text("angle between the optical axes")).to_be_visible()
    assert errors == []


@pytest.mark.slow
def test_models_are_compared_on_request_and_comparison_can_be_cancelled(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, engine, errors = measured
    click(page, "4. Calibrate")
    click(page, "Compare models")
    again = button(page, "Compare again")
    expect(again).to_be_enabled()
    expect_message(page, "pixelwise is recommended")
    session = engine.snapshot().session
    assert session is not None and session.calibration is not None
    (found,) = session.list_records(ModelComparison)
    compared = found.record
    assert not found.stale and len(compared.poses["stereo"]) == 8 and not compared.failed
    assert 0.01 < compared.models["pixelwise"].plane_mm < compared.models["stereo"].plane_mm < 1

    again.click()
    button(page, "Cancel").click()
    expect(page.get_by_text("Comparing the models: cancelled").first).to_be_visible()
    expect(again).to_be_enabled()
    assert engine.wait_until_idle(PATIENCE_S).session.list_records(ModelComparison) == [found]  # type: ignore[union-attr]
    assert errors == []


@pytest.mark.slow
def test_plane_and_sphere_are_measured_and_exported(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, _, errors = measured
    click(page, "5. Verify")
    choose(page, "Capture", "plane_03")
    click(page, "Measure plane")
    expect(
        page.get_by_text("errors on one colour scale, red is towards the camera")
    ).to_be_visible()
    choose(page, "Capture", "sphere_3")
    click(page, "Measure sphere")
    expect(page.get_by_text("errors on one colour scale, red is outwards")).to_be_visible()
    expect(page.get_by_text("error of pixelwise; red is outwards")).to_be_visible()
    click(page, "Write CSV")
    with page.expect_download() as download:
        page.get_by_text("Download figures.csv").click()
    rows = list(csv.DictReader(Path(download.value.path()).read_text().splitlines()))
    verified = [(row["record"], row["model"]) for row in rows if row["kind"] == "verify"]
    assert len(verified) == 4 and {model for _, model in verified} == {"stereo", "pixelwise"}
    assert all(0 < float(row["RMS mm"]) < 0.5 for row in rows if row["kind"] == "verify")
    assert errors == []


def pick_two_places(page: Page) -> None:
    """A place on the scan, to the left, and one on the reference beside it; then take them back."""
    choose(page, "Start from", "picked points")
    none = page.get_by_text(re.compile("^Pair 1: click a point on"))
    expect(none).to_be_visible()
    expect(button(page, "Merge 2 scans")).to_be_disabled()
    # until the two stand side by side, the reference may be where the scan will be: only the answer
    # tells them apart
    click_until(page, (385, 400), re.compile(r"click the same point on .* on the right\.$"))
    click_until(page, (640, 400), re.compile("^[1-9] of 3 pairs picked"))
    said = page.get_by_text(re.compile(r"^(Pair \d|\d pairs): "))
    # one sent twice began another pair
    while not said.inner_text().startswith("Pair 1: click a point on"):
        with suppress(NotShownError):  # the text was of before: all points are taken back
            button(page, "Undo last point").click(timeout=5000)
    expect(page.get_by_text("0 of 3 pairs picked")).to_be_visible()


@pytest.mark.slow
def test_scans_are_reconstructed_picked_merged_and_exported(
    measured: tuple[Page, Operator, list[str]], tmp_path: Path
) -> None:
    page, operator, errors = measured
    click(page, "6. Scan")
    for name in ("object_r1", "object_r2"):
        choose(page, "Scan", name)
        page.wait_for_timeout(1000)  # a busy program may take the click before the choice
        click(page, "Reconstruct", exact=True)
        assert operator.wait_for(lambda s, name=name: s.scan(name).cloud == "fresh", PATIENCE_S)  # type: ignore[misc]
    expect(page.get_by_text(re.compile("points shown; the file has all"))).to_be_visible()
    choose(page, "Colour", "depth")
    expect(page.get_by_text(re.compile(r"^\d+\.\d\smm$")).first).to_be_visible()
    click_until(page, (590, 420), "Phase, axis x")  # right of where notifications stand
    field(page, "New name").fill("Lion <b>1</b>")
    click(page, "Rename scan")
    expect(page.get_by_text("Lion <b>1</b> (object_r2)").first).to_be_visible()

    click(page, "7. Merge")
    choose(page, "Start from", "turntable")
    expect(page.get_by_text(re.compile(r"object_r1 at 0°, Lion <b>1</b> at 30°"))).to_be_visible()
    choose(page, "Start from", "current position")
    click(page, "Merge 2 scans")
    expect(page.get_by_text("Not merged.")).to_be_visible()
    expect(
        page.get_by_text("Or use the initial alignment by features, or by picked points.").first
    ).to_be_visible()
    pick_two_places(page)
    choose(page, "Start from", "features")
    click(page, "Merge 2 scans")
    expect(page.get_by_text(re.compile("in the frame of"))).to_be_visible()
    expect(page.get_by_text(re.compile(r"^0\.\d{3}$")).first).to_be_visible()
    expect(page.get_by_text("Not merged.")).to_be_hidden()
    choose(page, "Colour", "uncertainty")
    expect(page.get_by_text("uncertainty along the normal (1 sigma)")).to_be_visible()
    choose(page, "3D view", "scans, as captured")

    page.get_by_role("button", name=re.compile(r"^\d+\. Export")).click()
    with page.expect_download() as download:
        page.get_by_role("link", name="Download").first.click()
    download.value.save_as(tmp_path / "merged.ply")
    merged = read_ply(tmp_path / "merged.ply")
    snapshot = operator.snapshot()
    assert snapshot.session is not None and snapshot.session.merge is not None
    assert (
        len(merged.points) == snapshot.session.merge.record.points
        and np.isfinite(merged.points).all()
    )
    choose(page, "Source", "Lion <b>1</b> (object_r2)")
    choose(page, "Type", "mesh")
    choose(page, "File type", "GLB")
    expect(
        page.get_by_text(re.compile(r"Unit: metres and y up, as glTF demands.*About \d"))
    ).to_be_visible()
    choose(page, "Smoothing", "light")
    field(page, "Triangles").fill("6000")
    field(page, "Triangles").press("Tab")
    expect(page.get_by_text(re.compile(r"Unit: metres.*About \d+\skB"))).to_be_visible()
    click(page, "Write file")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download object_r2_mesh.glb").click()
    download.value.save_as(tmp_path / "part.glb")
    part = trimesh.load(tmp_path / "part.glb", force="mesh")
    # the ammonite, 140 mm wide
    assert 4000 < len(part.faces) <= 6000 and 0.08 < part.extents.max() < 0.2
    expect(
        page.get_by_text(
            re.compile(
                r"^object_r2: (5\d{3}|6000) triangles by grid.*smoothing moved the surface by"
            )
        )
    ).to_be_visible()
    choose(page, "Texture", "1024 px")
    click(page, "Write again")
    expect(page.get_by_text(re.compile(r"texture of 1024x1024\spx")).first).to_be_visible()
    assert operator.wait_until_idle(PATIENCE_S) is not None
    with page.expect_download() as download:
        page.get_by_role("link", name="Download object_r2_mesh.glb").click()
    download.value.save_as(tmp_path / "textured.glb")
    part = trimesh.load(tmp_path / "textured.glb", force="mesh")
    assert np.asarray(part.visual.material.baseColorTexture).shape[:2] == (1024, 1024)
    click(page, "Write calibration")
    expect(page.get_by_text("calibration.yml").first).to_be_visible()
    choose(page, "Content", "poses")
    choose(page, "Format", "JSON")
    click(page, "Write poses")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download poses.json").click()
    poses = json.loads(Path(download.value.path()).read_text())
    assert len(poses["targets"]) == 8 and len(poses["merges"][0]["scans"]) == 2

    click(page, "7. Merge")
    click(page, "Undo merge")
    expect(button(page, "Undo merge")).to_be_hidden()
    assert errors == []


def surface_of_object(operator: Operator) -> str:
    """The name in the list of surfaces of `object_r2`, which another test may have renamed."""
    session = operator.snapshot().session
    assert session is not None
    return next(
        display_name(scan.name, scan.label) for scan in session.scans if scan.name == "object_r2"
    )


@pytest.mark.slow
def test_distance_is_measured_between_two_clicks(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, operator, errors = measured
    if operator.wait_until_idle(PATIENCE_S).scan("object_r2").cloud != "fresh":  # type: ignore[union-attr]
        assert operator.reconstruct("object_r2")
    before = len(operator.wait_until_idle(PATIENCE_S).session.measurements)  # type: ignore[union-attr]
    click(page, "8. Measure")
    choose(page, "Surface", surface_of_object(operator))
    measure_distance(page, operator, before + 1)
    assert errors == []


def measure_distance(page: Page, operator: Operator, count: int) -> None:
    """Measure between two places on the object: the measurement is the last of so many."""
    tool(page, "Distance", "Click the first point.")
    click_until(page, (480, 440), "Click the second point.")
    page.mouse.click(590, 420)
    width = came(operator, count)
    assert width.what == "distance" and 5 < width.quantities[0].value < 140
    shown = re.escape(width.quantities[0].format().rstrip("*")).replace(r"\ ", r"\s")
    expect_message(page, re.compile(shown))


@pytest.mark.slow
def test_part_is_measured_and_compared_with_its_nominal(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, operator, errors = measured
    for name in ("object_r2", "sphere_3"):
        if operator.wait_until_idle(PATIENCE_S).scan(name).cloud != "fresh":  # type: ignore[union-attr]
            assert operator.reconstruct(name)
    before = len(operator.wait_until_idle(PATIENCE_S).session.measurements)  # type: ignore[union-attr]
    click(page, "8. Measure")
    choose(page, "Surface", surface_of_object(operator))
    tool(page, "Distance", "Click the first point.")
    click_until(page, (480, 440), "Click the second point.")
    page.keyboard.press("Escape")
    expect(page.get_by_text("Choose a tool.")).to_be_visible()
    measure_distance(page, operator, before + 1)

    tool(page, "Section", "Click the start of the section.")
    click_until(page, (480, 440), "Click the end of the section")
    page.mouse.click(590, 420)
    came(operator, before + 2)
    expect(page.get_by_text("height difference A – B")).to_be_visible()
    expect(page.get_by_text("Radius through A, C, B")).to_be_visible()

    choose(page, "Surface", "sphere_3")
    tool(page, "Sphere", "Click the centre of the sphere.")
    click_until(page, (540, 400), "points in the ball")
    click(page, "Fit sphere")
    radius = came(operator, before + 3).quantities[0]
    # the simulated sphere's, mm
    assert radius.U is not None and abs(radius.value - 98.0) < max(2 * radius.U, 0.1)
    expect(
        page.get_by_text(re.compile("ball of radius 30"))
    ).to_be_visible()  # or the name typed is that of before
    field(page, "New name").fill("Ball <i>")
    page.get_by_role("button", name="Rename", exact=True).click()
    expect(page.get_by_text("Ball <i>").first).to_be_visible()

    tool(page, "Deviation", "Choose or upload a nominal model")
    choose(page, "Surface", surface_of_object(operator))
    with page.expect_file_chooser() as chooser:
        click(page, "Upload model")
    chooser.value.set_files(asset("objects/ammonite.ply"))
    field(page, "Tolerance ±, mm").fill("1.5")
    expect(button(page, "Compare")).to_be_enabled()
    click(page, "Compare")
    found = came(operator, before + 4).deviation
    assert found is not None and found.verdict is not None
    assert found.verdict.decision == "pass" and 0.01 < found.statistics_mm.rms < 0.5
    expect(page.get_by_text("Tolerance ± 1.5 mm: pass").first).to_be_visible()
    expect(page.get_by_text("Histogram of the deviations.")).to_be_visible()

    click(page, "Delete result")
    click(page, "Restore deleted")
    expect(button(page, "Restore deleted")).to_be_hidden()
    came(operator, before + 4)
    operator.wait_until_idle(PATIENCE_S)
    click(page, "Write CSV")
    with page.expect_download() as download:
        page.get_by_text("Download measurements.csv").click()
    rows = list(csv.DictReader(Path(download.value.path()).read_text("utf-8-sig").splitlines()))
    assert {row["kind"] for row in rows} == {"distance", "section", "sphere", "deviation"}
    assert all(row["state"] == "fresh" and row["unit"] for row in rows)
    assert errors == []


def tool(page: Page, name: str, says: str) -> None:
    """Take a measuring tool in hand."""
    page.get_by_role("button", name=name, exact=True).click()
    expect(page.get_by_text(says)).to_be_visible()


def click_until(page: Page, place: tuple[int, int], answer: str | re.Pattern[str]) -> None:
    """Click on the surface, which comes before the eyes by itself, until it answers."""
    for _ in range(40):
        page.mouse.click(*place)
        try:
            # a second click too early is a second point
            return page.get_by_text(answer).first.wait_for(timeout=5000)
        except NotShownError:
            continue
    raise AssertionError(f"no click brought {answer!r}")


def came(operator: Operator, count: int) -> Measurement:
    """The last of so many measurements, once it is there."""
    found = operator.wait_for(
        lambda s: s.session is not None and len(s.session.measurements) == count, PATIENCE_S
    )
    assert found is not None and found.session is not None, operator.snapshot().notices[-1].text
    return found.session.measurements[-1].record


def test_rejected_calibration_states_reason_and_blocks_scans_until_accepted(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, operator, errors = measured
    store = operator.session
    assert store is not None
    click(page, "4. Calibrate")
    expect(page.get_by_text("no problems detected")).to_be_visible()
    choose(page, "Model", "stereo")
    expect(
        page.get_by_text("stereo is used (your choice); pixelwise is recommended")
    ).to_be_visible()
    meta, arrays = store.load_result("calibration/stereo")
    meta = {key: value for key, value in meta.items() if key not in ("hash", "arrays", "checksums")}
    store.save_result("calibration/stereo", {**meta, "verdict": to_plain(REJECTED)}, arrays)
    save_verdict(store, REJECTED, ["pose_03"])
    assert operator.choose_model("")
    expect(page.get_by_text("do not measure with it")).to_be_visible()
    expect(page.get_by_text("Hold the <b>board</b> still.")).to_be_visible()
    click(page, "pose_03")
    expect(page.get_by_text(re.compile("pose_03, .*: measured minus predicted"))).to_be_visible()
    click(page, "6. Scan")
    expect(
        page.get_by_text("The calibration was rejected: pose_03 moved by 0.9 px").first
    ).to_be_visible()
    click(page, "4. Calibrate")
    page.get_by_label("Accept anyway").check()
    assert operator.wait_for(lambda s: s.step("scan").state != "blocked", PATIENCE_S)
    assert errors == []


@pytest.mark.slow
def test_no_label_is_cut_at_1280_by_800(measured: tuple[Page, Operator, list[str]]) -> None:
    page, operator, _ = measured
    assert page.viewport_size == SIZE
    for number, step in enumerate(operator.wait_until_idle(PATIENCE_S).steps, 1):
        click(page, f"{number}. {step.title}")
        expect(
            page.locator("div", has_text=re.compile(rf"^{number}\s+{step.title}")).first
        ).to_be_visible()
        wait_until_still(page, 1000)  # what the panel computes may replace its instruction
        assert cut_labels(page) == [], step.title


@pytest.mark.slow
def test_no_label_is_cut_beside_results(measured: tuple[Page, Operator, list[str]]) -> None:
    test_no_label_is_cut_at_1280_by_800(measured)


def test_comparison_and_verdict_as_html() -> None:
    measured = {
        m: {"pose_1": HeldOutPose(p, 2 * p, 9.0, p, p, 100, 600.0)}
        for m, p in (("stereo", 0.2), ("splined", 0.02))
    }
    compared = gather_results(measured, (("pose_1",),), {"pixelwise": "too <few> poses"})
    html = records_html([Stored("1", "1", compared)])
    assert (
        re.search(r"font-weight:600\">0&#46;020", html)
        and "<few>" not in html
        and html.index("stereo") > 0
    )
    assert named_poses(REJECTED, None) == ("pose_03",) and "before" not in verdict_html(
        REJECTED, True, None
    )
    assert "gave no calibration" in verdict_html(REJECTED, False, None)


def test_painter_draws_latest_request_and_survives_failures() -> None:
    failures: list[BaseException] = []
    painter = Painter(failures.append, threading.Lock())
    begun, go, done = threading.Event(), threading.Event(), threading.Event()
    shown: list[object] = []

    def slow() -> str:
        begun.set()
        go.wait(PATIENCE_S)
        return "old"

    painter.request(shown.append, 1, slow)
    assert begun.wait(PATIENCE_S)
    painter.request(shown.append, 2, lambda: 1 / 0)
    painter.request(shown.append, 3, lambda: "new")
    painter.request(shown.append, 3, lambda: "the same again")
    painter.request_once(shown.append, lambda: 1 / 0)
    painter.request_once(lambda made: (shown.append(made), done.set()), lambda: "last")
    go.set()
    assert done.wait(PATIENCE_S)
    assert shown == ["new", "last"] and [type(f) for f in failures] == [ZeroDivisionError]


def test_purpose_of_captures_and_order_of_scans() -> None:
    def scan(name: str, purpose: str = "scan") -> ScanView:
        return ScanView(name, name, purpose, "", "fresh", Reconstruction(), b"")  # type: ignore[arg-type]

    assert [scan(n).shape for n in ("plane_01", "sphere_2", "object_r1")] == [
        "plane",
        "sphere",
        "scan",
    ]
    assert scan("scan_01", "plane").shape == "plane"
    names = [s.name for s in sort_scans([scan("a"), scan("plane_1"), scan("b")])]
    assert names == ["b", "a", "plane_1"]


def test_tables_escape_names_and_mark_the_best() -> None:
    def found(
        rms: dict[str, float], shape: Shape = "plane", **figures: Any
    ) -> Stored[Verification]:
        models = {name: ModelFit(100, 0, mm, 0.03, 0.9, **figures) for name, mm in rms.items()}
        record = Verification(shape=shape, models=models, incidence={"R1": 0, "R2": 90, "R3": 10})
        return Stored("a", "<img src=x>", record)

    html = records_html([found({"stereo": 0.2, "pixelwise": 0.1})])
    assert "<img" not in html and html.index("0&#46;200") < html.index("0&#46;100")
    assert re.search(r"font-weight:600\">0&#46;100", html) and html.count("90&#46;0") == 2
    ball = found({"stereo": 0.2}, "sphere", radius_mm=97.9, centre_mm=(0.0, 0.0, 500.0))
    other = Stored("b", "b", found({"stereo": 0.2}, "sphere", centre_mm=(12.5, 0.0, 500.0)).record)
    assert (
        "97&#46;900" in records_html([ball])
        and records_html([ball, other]).count("12&#46;500") == 1
    )
    assert records_html([]) == ""


def test_cloud_is_coloured_by_chosen_quantity() -> None:
    points = np.full((4, 5, 3), np.nan, np.float32)
    points[1:, 1:] = np.stack(np.broadcast_arrays(0.0, 1.0, np.linspace(500, 600, 4)), axis=-1)
    flat = np.ones((4, 5), np.float32)
    grey = np.full((4, 5), 7, np.uint8)
    cloud = ScanCloud(
        points, "x", "stereo", flat, name="a", phase=flat, modulation=flat, texture=grey, errors={}
    )
    painted, words = paint_points(scan_values(cloud), "depth")
    assert painted.shape == (4, 5, 3) and len(np.unique(painted[1], axis=0)) == 5 and "mm" in words
    noisy = replace(cloud, sigma_z=3 * flat, sigma_calibration=4 * flat)
    np.testing.assert_allclose(uncertainty(noisy)[1:, 1:], 5.0)
    assert "5&#46;000" in paint_points(scan_values(noisy), "uncertainty")[
        1
    ] and "5&#46;000" in point_html(noisy, 4, 2)
    assert "noise only" in paint_points(scan_values(cloud), "uncertainty")[1].replace("&#32;", " ")
    # half as bright where the normal is unknown, as at the rim
    assert paint_points(scan_values(cloud), "texture")[0][0, 0].tolist() == [3, 3, 3]
    assert "measure this capture" in paint_points(scan_values(cloud), "error")[1].replace(
        "&#32;", " "
    )
    assert "600&#46;000" in point_html(cloud, 4, 2)
    assert colour_range(np.array([np.nan])) == (0.0, 1.0)


@pytest.mark.slow
def test_the_title_page_of_the_report_is_typed_once(
    measured: tuple[Page, Operator, list[str]],
) -> None:
    page, operator, errors = measured
    page.get_by_role("button", name=re.compile(r"^\d+\. Export")).click()
    page.get_by_text("Title page", exact=True).click()
    stated = {"Part": "Vase <b>", "Customer": "Acme", "Temperature, °C": "20,5"}
    for label, text in stated.items():
        field(page, label).fill(text)
    click(page, "Write report")
    expect(page.get_by_text("report.html", exact=True).first).to_be_visible()
    details = operator.snapshot().content.report_details
    assert (details.part, details.customer, details.temperature_c) == ("Vase <b>", "Acme", 20.5)
    expect(field(page, "Temperature, °C")).to_have_value("20.5")
    assert (
        "Vase &lt;b&gt;" in (operator.snapshot().content.folder / "exports/report.html").read_text()
    )
    assert errors == []


def test_all_rigs_are_offered_but_those_that_the_list_has_already() -> None:
    assert {"two-cameras", "turntable", "simulated-lightcrafter4500", "webcam"} <= {
        *list_presets(None)
    }
    assert "simulated" not in list_presets(None)


def test_residuals_name_the_second_camera() -> None:
    rms_px = {"camera": 0.04, "projector": 0.05}
    of = Reprojection("stereo", rms_px, {"pose": (0.04, 0.05)}, rms_px, SECOND_CAMERA)
    assert of.rms_text == "camera 0.040 px, second camera 0.050 px"
    assert "second camera" in of.judge(Verdict(()), "stereo").text()
    table = of.rename(
        Table.of([{"projector": 1.0, "camera": Cell("projector x")}], "", ["projector"])
    )
    assert [column.title for column in table.columns] == ["second camera", "camera"]
    assert table.values(table.rows[0])[1] == "second camera x" and table.notes == ["second camera"]


def test_names_in_front_of_many_columns_stand_in_rows_of_their_own() -> None:
    names, columns = ["a_long_name_of_a_capture", "b"], ("Model", "RMS", "Floor", "Excluded")
    rows = [
        {"capture": name, "model": "stereo", **{each.lower(): 1.0 for each in columns[1:]}}
        for name in names
    ]
    html = report_table(Table.of(rows, "Planes"))
    lines = [re.sub(r"<[^>]*>", "", line) for line in html.split("<tr>")[1:]]
    assert unescape(lines[0]).startswith("Capture / model") and len(lines) == 1 + 2 * len(names)
    assert html.count(' colspan="4"') == 2 and "<wbr>" in html


def test_poses_are_red_by_their_error_against_the_noise_not_the_best_pose() -> None:
    errors = {"best": 0.010, "usual": 0.013, "good": 0.016, "other": 0.014, "bad": 0.09}
    colours = colour_errors(errors, [0.0102])
    green = colours["best"]
    assert green[1] > green[0] and colours["usual"] == colours["other"] == green
    assert colours["good"][1] > colours["good"][0]  # rather green
    assert colours["bad"][0] > 2 * colours["bad"][1]
    # without an estimate of the noise the poses are compared with their median
    alike = colour_errors({"a": 0.3, "b": 0.31, "c": 0.33}, [])
    assert all(g > r for r, g, _ in alike.values())


def test_a_mesh_that_the_view_does_not_show_is_named() -> None:
    small = ExportView("part.stl", Path("part.stl"), 1000)
    assert _describe_view("mesh", None, "stl") == _describe_view("mesh", small, "stl") == ""
    assert _describe_view("cloud", small, "xyz") == ""
    assert missing_facts(_describe_view("mesh", small, "3mf"), "3mf", "points") == []
    large = replace(small, bytes=100_000_000)
    assert missing_facts(_describe_view("merged-mesh", large, "stl"), "100 MB", "points") == []
