"""The whole wizard, as someone works with it: to a file that others can read, watched, killed, and
with bad cables."""

import logging
import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from faulty_rig import FaultyRigs
from playwright.sync_api import Browser, Page, expect
from wizard_page import (
    CALM,
    PATIENCE_S,
    RIG,
    Opened,
    button,
    capture_pose,
    choose,
    click,
    field,
    new_page,
    pose_row,
    press,
    wait_until,
)

from slviewer.gui.app import App
from slviewer.records.verification import Verification
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import SessionView

TARGET = "circles:21x16:9"
SLOW = """driver = "simulated"
scale = 0.25
settle_ms = 60
"""
"""A rig whose captures last longer than a browser takes to tell of them."""
STEPS = ("Rig", "Target", "Poses", "Calibrate", "Verify", "Scan", "Merge", "Measure", "Export")
ON_THE_CLOUD = (530, 420)
"""Page px, in the middle of the scene."""
DEPTHS_MM = (560, 600, 640)


def visit(browser: Browser, url: str) -> Opened:
    """A browser of its own on this address, ready."""
    page = new_page(browser)
    found = Opened(page)
    page.goto(url)
    button(page, "1. Rig").wait_for()
    return found


def stand(page: Page, thing: str) -> None:
    """Let another thing stand before the simulated rig."""
    choose(page, "Object", thing)
    expect(field(page, "Object")).to_have_value(thing)
    expect(page.get_by_text("Choose an object to capture")).to_be_hidden()


def complaints(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR]


# the journey


@pytest.fixture
def bare(tmp_path: Path) -> Iterator[Operator]:
    """A new session, and no rig yet."""
    with Operator(tmp_path / "session", timing=CALM) as engine:
        yield engine


def test_wizard_leads_from_unknown_rig_to_merged_mesh(
    bare: Operator, browser: Browser, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    app = App(bare, Serving(port=0))
    opened = visit(browser, app.server.link())
    page = opened.page
    try:
        for number, title in enumerate(STEPS, 1):
            expect(button(page, f"{number}. {title}")).to_be_visible()
        choose_rig_and_board(page)
        expect(page.get_by_text("Board detected: 336 of 336 features")).to_be_visible()
        for number in range(1, 4):
            capture_pose(page, f"pose_{number:02d}")
            if number == 1:
                expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()
                page.reload()
                expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()
                expect(pose_row(page, "pose_01", "good")).to_be_visible()
                expect(page.get_by_text("good", exact=True).first).to_be_visible()
                expect(button(page, "Capture pose")).to_be_visible()
        assert [pose.state for pose in session_of(bare).poses] == 3 * ["good"]
        calibrate(page, bare)

        click(page, "6. Scan")
        stand(page, "object")
        for name in ("scan_01", "scan_02"):
            press(page, "Capture scan", lambda n=name: bare.snapshot().scan(n) is not None)  # type: ignore[misc]
            assert bare.wait_for(
                lambda s, n=name: (v := s.scan(n)) is not None and v.cloud == "fresh", PATIENCE_S
            )  # type: ignore[misc]
        click(page, "7. Merge")
        click(page, "Merge 2 scans")
        expect(page.get_by_text(re.compile("in the frame of"))).to_be_visible()
        merged = session_of(bare).merge
        assert (
            merged is not None
            and merged.record.reference == "scan_02"
            and set(merged.record.pairs) == {"scan_01"}
        )
        pair = merged.record.pairs["scan_01"]
        rms, overlap, T = pair.rms_mm, pair.overlap, np.array(pair.T_reference_scan)
        assert 0.0 < rms < 0.2 and overlap > 0.95
        # the object was not moved
        assert np.linalg.norm((T @ [0, 0, 600, 1])[:3] - [0, 0, 600]) < 0.5

        click(page, "9. Export")
        choose(page, "Type", "mesh")
        click(page, "Write file")
        with page.expect_download() as download:
            page.get_by_role("link", name=re.compile(r"Download .*mesh")).click()
        download.value.save_as(tmp_path / download.value.suggested_filename)
        mesh = trimesh.load(tmp_path / download.value.suggested_filename, force="mesh")
        assert len(mesh.faces) > 1000 and mesh.extents == pytest.approx([141, 126, 31], abs=5)
        assert [n.text for n in bare.snapshot().notices if n.level == "error"] == []
        assert complaints(caplog) == [] and opened.errors == []
    finally:
        page.context.close()
        app.close()


def choose_rig_and_board(page: Page) -> None:
    """Choose the simulated rig and its board, and go on to the poses."""
    choose(page, "Rig", "Simulated, quarter size")
    expect(page.get_by_text(re.compile(r"camera 400\s×\s300\spx"))).to_be_visible()
    click(page, "2. Target")
    click(page, "Use this board")
    expect(page.get_by_text(f"In use: {TARGET}")).to_be_visible()
    click(page, "Continue to Poses")


def calibrate(page: Page, operator: Operator) -> None:
    """Calibrate from the captured poses."""
    click(page, "4. Calibrate")
    page.get_by_role("button", name="Calibrate", exact=True).click()
    expect(page.get_by_text("Reprojection RMS, camera")).to_be_visible()
    calibration = session_of(operator).calibration
    assert calibration is not None and not calibration.stale


@pytest.mark.slow
def test_wizard_verifies_scans_and_merges_within_noise(
    bare: Operator, browser: Browser, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    app = App(bare, Serving(port=0))
    opened = visit(browser, app.server.link())
    page = opened.page
    try:
        choose_rig_and_board(page)
        for number in range(1, 7):
            if number == 4:
                page.reload()
                expect(pose_row(page, "pose_03", "good")).to_be_visible()
            if number == 6:
                hands_free(page, "pose_06")
            else:
                capture_pose(page, f"pose_{number:02d}")
        expect(page.get_by_text("6 poses, 0 scans")).to_be_visible()

        calibrate(page, bare)
        verify(page, bare)
        scan(page, bare)
        merge(page, bare)
        take_home(page, bare, tmp_path)
        assert [n.text for n in bare.snapshot().notices if n.level == "error"] == []
        assert complaints(caplog) == [] and opened.errors == []
    finally:
        page.context.close()
        app.close()


def verify(page: Page, operator: Operator) -> None:
    """A plane and a sphere, each within what the simulated camera's noise lets one expect."""
    click(page, "5. Verify")
    for shape, sign in (("plane", "towards the camera"), ("sphere", "outwards")):
        stand(page, shape)
        click(page, f"Capture {shape}")
        expect(page.get_by_text(f"errors on one colour scale, red is {sign}")).to_be_visible()
    views = session_of(operator).list_records(Verification)
    rms = {
        (view.record.shape, model): fit.rms_mm / fit.noise_floor_mm
        for view in views
        for model, fit in view.record.models.items()
        if fit.rms_mm is not None and fit.noise_floor_mm is not None
    }
    assert set(rms) == {
        (shape, model) for shape in ("plane", "sphere") for model in ("stereo", "pixelwise")
    }
    assert 0.8 < rms["plane", "pixelwise"] < 2.0 < rms["plane", "stereo"] < 8.0
    assert 0.8 < rms["sphere", "pixelwise"] < 2.0 < rms["sphere", "stereo"] < 5.0


def bring(page: Page, operator: Operator, depth: float) -> None:
    """Type a distance until what stands before the rig is there: a busy page may draw an older
    number over it."""
    for _ in range(10):
        for typed in (depth + 1, depth):
            field(page, "Depth, mm").fill(str(typed))
        if operator.wait_for(
            lambda s: s.world is not None and abs(s.world.T_camera_object[2, 3] - depth) < 0.5, 30.0
        ):
            return
    raise AssertionError(f"nothing came to {depth} mm")


def scan(page: Page, operator: Operator) -> None:
    """The object at three depths."""
    click(page, "6. Scan")
    stand(page, "object")
    choose(page, "Patterns", "micro")
    chosen = operator.wait_for(
        lambda s: s.session is not None and s.session.patterns == "micro", PATIENCE_S
    )
    assert chosen, "micro was chosen, the session has other patterns"
    for number, depth in enumerate(DEPTHS_MM, 1):
        bring(page, operator, depth)
        name = f"scan_{number:02d}"
        press(page, "Capture scan", lambda n=name: operator.snapshot().scan(n) is not None)  # type: ignore[misc]
        assert operator.wait_for(
            lambda s, n=name: (v := s.scan(n)) is not None and v.cloud == "fresh", PATIENCE_S
        )  # type: ignore[misc]
        expect(page.get_by_text(name).first).to_be_visible()
    expect(page.get_by_text("6 poses, 3 scans, 1 plane, 1 sphere")).to_be_visible()
    click_cloud_until(page, page.get_by_text("Clicked point").is_visible)

    click(page, "4. Calibrate")  # its curves, at a pixel of this cloud
    # far from the click: the pixel that is shown first may be the clicked one. It also waits for
    # this step: Scan has something called Cloud as well
    field(page, "Pixel u").fill("20")
    choose(page, "Cloud", "scan_01")
    click_cloud_until(page, lambda: field(page, "Pixel u").input_value() != "20")


def click_cloud_until(page: Page, answers: Callable[[], bool]) -> None:
    """Click on the cloud, to which the view moves by itself, until it answers; a busy machine draws
    it late."""
    clicked = -math.inf

    def try_again() -> bool:
        nonlocal clicked
        if answers():
            return True
        if time.monotonic() > clicked + 1:
            page.mouse.click(*ON_THE_CLOUD)
            clicked = time.monotonic()
        return False

    wait_until(page, try_again)


def hands_free(page: Page, name: str) -> None:
    """The next pose by holding still: the simulated board goes there by itself."""
    page.get_by_role("checkbox", name="Hands-free").check()
    expect(page.get_by_text("Hold still")).to_be_visible()
    expect(pose_row(page, name, "good")).to_be_visible()
    page.get_by_role("checkbox", name="Hands-free").uncheck()


def merge(page: Page, operator: Operator) -> None:
    """All three in the place of the last, by as much as they were moved."""
    click(page, "7. Merge")
    click(page, "Merge 3 scans")
    expect(page.get_by_text(re.compile("in the frame of"))).to_be_visible()
    merged = session_of(operator).merge
    assert merged is not None and merged.record.reference == "scan_03"
    assert set(merged.record.pairs) == {"scan_01", "scan_02"}
    for name, depth in zip(("scan_01", "scan_02"), DEPTHS_MM, strict=False):
        pair = merged.record.pairs[name]
        rms, overlap, T = pair.rms_mm, pair.overlap, np.array(pair.T_reference_scan)
        moved = (T @ [0, 0, depth, 1])[:3]  # the object's own place
        assert 0.02 < rms < 0.2 and overlap > 0.95
        assert 0.001 < np.linalg.norm(moved - [0, 0, DEPTHS_MM[-1]]) < 0.5


def take_home(page: Page, operator: Operator, folder: Path) -> None:
    """The merged cloud, as another program reads it."""
    click(page, "9. Export")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download").first.click()
    assert download.value.suggested_filename.endswith(".ply")
    download.value.save_as(folder / "home.ply")
    cloud = trimesh.load(folder / "home.ply")
    merged = session_of(operator).merge
    assert merged is not None and isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) == merged.record.points and np.isfinite(cloud.vertices).all()
    # the ammonite's size, mm, less its steep rim
    assert cloud.extents == pytest.approx([141, 126, 31], abs=3)


def session_of(operator: Operator) -> SessionView:
    session = operator.snapshot().session
    assert session is not None
    return session


# a second browser


@pytest.mark.slow
def test_viewer_sees_poses_and_changes_nothing(
    opened: Opened, operator: Operator, app: App, browser: Browser
) -> None:
    operator.choose_target(TARGET)
    page, watching = opened.page, visit(browser, app.server.link("watch"))
    guest = watching.page
    click(page, "3. Poses")
    capture_pose(page, "pose_01")
    expect(guest.get_by_text("View only")).to_be_visible()
    expect(pose_row(guest, "pose_01", "good")).to_be_visible()
    before = operator.snapshot()

    click(guest, "Place board")
    click(guest, "Capture pose")
    guest.keyboard.press("c")
    guest.get_by_role("checkbox", name="Hands-free").click()
    click(guest, "Delete")
    click(guest, "Sessions")
    click(guest, "9. Export")

    capture_pose(page, "pose_02")  # after all that, what the operator asks for is all that happens
    expect(pose_row(guest, "pose_02", "good")).to_be_visible()
    after = operator.snapshot()
    assert app.shell.current == "poses" and not after.hands_free
    assert (
        after.session is not None
        and before.session is not None
        and after.session.folder == before.session.folder
    )
    assert [pose.name for pose in after.session.poses] == ["pose_01", "pose_02"]
    assert opened.errors == []
    guest.context.close()


# a process that dies


class Program:
    """`slviewer wizard` as a process of its own."""

    def __init__(self, session: Path, *arguments: str) -> None:
        command = [
            sys.executable,
            "-m",
            "slviewer.cli",
            "wizard",
            str(session),
            "--port",
            "0",
            "--no-browser",
        ]
        self._process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        said = next((line for line in self._process.stdout if "slviewer is ready" in line), "")
        assert said, "the wizard did not start"
        self.url = said.split()[-1]

    def kill(self) -> None:
        """SIGKILL, where there are signals; the end without a farewell elsewhere."""
        self._process.kill()
        self._process.communicate()


@pytest.mark.process
@pytest.mark.slow
def test_killed_capture_costs_no_earlier_pose(tmp_path: Path, browser: Browser) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(SLOW)
    program = Program(tmp_path / "session", "--rig", str(rig))
    try:
        page = visit(browser, program.url).page
        click(page, "2. Target")
        click(page, "Use this board")
        expect(page.get_by_text(f"In use: {TARGET}")).to_be_visible()
        click(page, "3. Poses")
        capture_pose(page, "pose_01")
        click(page, "Capture pose")
        page.get_by_text("Capturing pose_02: frame").first.wait_for()
    finally:
        program.kill()
    page.context.close()

    program = Program(tmp_path / "session")
    try:
        again = visit(browser, program.url)
        page = again.page
        expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()
        click(page, "3. Poses")
        expect(pose_row(page, "pose_01", "good")).to_be_visible()
        capture_pose(page, "pose_02")
        assert again.errors == []
    finally:
        program.kill()
    page.context.close()
    with Session.open(tmp_path / "session") as session:
        frames = [session.load_capture(name).frames for name in session.capture_names()]
        assert len(frames) == 2 and all(
            np.asarray(f).shape == np.asarray(frames[0]).shape for f in frames
        )


# devices that fail


@pytest.mark.slow
def test_fault_ends_one_capture_and_is_reported(tmp_path: Path, browser: Browser) -> None:
    rigs = FaultyRigs()
    with Operator(tmp_path / "session", RIG, set_up=rigs, timing=CALM) as operator:
        assert operator.wait_for(lambda s: s.rig.state == "open", PATIENCE_S)
        operator.choose_target(TARGET)
        app = App(operator, Serving(port=0))
        opened = visit(browser, app.server.link())
        page = opened.page
        try:
            click(page, "3. Poses")
            capture_pose(page, "pose_01")
            for fault, facts, after in (
                ("timeout", ("camera", "no frame", "2 s", "trigger"), "pose_02"),
                ("unplugged", ("camera", "reconnect"), "pose_03"),
            ):
                rigs.faults.plan(fault, 10)  # type: ignore[arg-type]
                click(page, "Capture pose")
                alerts = page.get_by_role("alert")
                for fact in facts:
                    alerts = alerts.filter(has_text=fact)
                expect(alerts).to_be_visible()
                expect(button(page, "Capture pose")).to_be_enabled()
                expect(page.get_by_text(after)).to_have_count(0)
                capture_pose(page, after)
            poses = session_of(operator).poses
            assert [pose.name for pose in poses] == ["pose_01", "pose_02", "pose_03"]
            assert [n.level for n in operator.snapshot().notices].count("error") == 2
            assert opened.errors == []
        finally:
            page.context.close()
            app.close()
