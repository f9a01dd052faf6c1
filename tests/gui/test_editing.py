"""Region of interest and editing of points in the step Scan, as someone uses them in a browser."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Browser, FloatRect, Page, expect
from scipy.spatial import cKDTree
from wizard_page import (
    CALM,
    PATIENCE_S,
    Opened,
    button,
    choose,
    click,
    cut_labels,
    field,
    new_page,
    unfold,
    wait_until,
    wait_until_still,
)

from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.gui.app import App
from slviewer.gui.scene import read_view
from slviewer.pipeline.capture import capture
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.records.inspection import Inspection
from slviewer.server.secure import Serving
from slviewer.session.inspection_plan import OWN_PLAN, read_plan, write_plan
from slviewer.session.scan_edits import load_edits
from slviewer.simulation.rig import letter
from slviewer.simulation.turning import turn_pose, turning
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import load_scan_cloud, whole_cloud
from tests.rendered_calibration import true_calibration

pytestmark = [pytest.mark.computes, pytest.mark.slow]

OUTLINE = 40 * np.array([(np.cos(t), np.sin(t)) for t in np.linspace(0, 2 * np.pi, 16)])
"""Places (n, 2) of a lasso around a place on the page, px."""


def capture_scans(
    folder: Path, world: SimulatedWorld, angles_deg: dict[str, float], patterns: str = "gray"
) -> None:
    """Capture {scan: angle of the table} of what stands before a simulated rig."""
    for name, angle_deg in angles_deg.items():
        world.turn_table(angle_deg)
        capture(
            folder,
            name,
            {},
            role="scan",
            patterns=patterns,
            set_up=lambda *_: RigSetup(simulated_rig(world)),
        )


class Views:
    """The views of a wizard's only browser, as it reported them."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._positions: list[np.ndarray] = []
        app.server.viser.on_client_connect(
            lambda client: client.camera.on_update(
                lambda camera: self._positions.append(np.array(camera.position))
            )
        )

    def show(self, points: np.ndarray) -> bool:
        """Return whether the browser's view has moved to points (..., 3) mm."""
        (client,) = self._app.server.viser.get_clients().values()
        low, high = np.nanpercentile(points.reshape(-1, 3), [2, 98], axis=0)
        is_meant = np.linalg.norm(client.camera.look_at - (low + high) / 2) < 0.1 * np.linalg.norm(
            high - low
        )
        reported = self._positions[-1] if self._positions else np.full(3, np.inf)
        return bool(is_meant and np.allclose(reported, client.camera.position, atol=0.5))

    def wait_for(self, page: Page, points: np.ndarray) -> None:
        """Wait until the browser's view has moved to points (..., 3) mm."""
        wait_until(page, lambda: self.show(points))


@pytest.fixture(scope="module")
def shared_wizard(
    tmp_path_factory: pytest.TempPathFactory, browser: Browser
) -> Iterator[tuple[Opened, App, Operator, Views]]:
    """A page on a session with two scans, of which the first is reconstructed, without a rig."""
    folder, rig = tmp_path_factory.mktemp("two_scans") / "session", letter(0.25)
    true_calibration(folder, rig)
    world = SimulatedWorld(rig)
    world.place("object")
    capture_scans(folder, world, {"one": 0.0, "two": 0.0})
    with Operator(folder, timing=CALM) as operator:
        operator.reconstruct("one")
        operator.wait_until_idle(PATIENCE_S)
        app = App(operator, Serving(port=0))
        views = Views(app)
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        yield opened, app, operator, views
        page.context.close()
        app.close()


@pytest.fixture
def wizard(
    shared_wizard: tuple[Opened, App, Operator, Views],
) -> tuple[Opened, App, Operator, Views]:
    """The page in the step Scan, without edits, errors or region."""
    opened, app, operator, views = shared_wizard
    for name in ("one", "two"):
        while operator.wait_until_idle(PATIENCE_S).scan(name).edits:  # type: ignore[union-attr]
            assert operator.undo_edit(name)
    opened.errors.clear()
    click(opened.page, "6. Scan")
    choose(opened.page, "Scan", "one")
    expect(opened.page.get_by_text(re.compile("points shown; the file has all"))).to_be_visible()
    return opened, app, operator, views


def place_in_view(app: App, point: np.ndarray, box: FloatRect) -> tuple[float, float]:
    """Where a point (3,) mm is on the page, px, whose view has this box."""
    (client,) = app.server.viser.get_clients().values()
    x, y = read_view(client).project(point)
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def to_screen(app: App, page: Page, point: np.ndarray) -> tuple[float, float]:
    """Where a point (3,) mm is on the page, px."""
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    return place_in_view(app, point, box)


def drag(page: Page, places: np.ndarray) -> None:
    """Press the mouse, move it over places (n, 2) px, and release it."""
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place)
    page.mouse.up()


def wait_for_frames(page: Page, count: int = 3) -> None:
    """Wait until the page has drawn so many frames: what lies below the mouse is looked up in each
    of them."""
    for _ in range(count):
        page.evaluate("new Promise(requestAnimationFrame)")


def drag_rectangle(page: Page, x: float, y: float, size: float) -> None:
    """Drag a rectangle around (x, y) px."""
    drag(page, np.array([(x - size, y - size), (x, y), (x + size, y + size)]))


def count_selected(page: Page) -> int:
    text = page.get_by_text(re.compile(r"of [\d,]+ points selected")).text_content() or ""
    return int(text.split(" of ")[0].replace(",", ""))


def test_points_are_selected_deleted_and_restored(
    wizard: tuple[Opened, App, Operator, Views],
) -> None:
    opened, app, operator, views = wizard
    page = opened.page
    assert operator.session is not None
    cloud = whole_cloud(operator.session, "one")
    valid = np.argwhere(np.isfinite(cloud.points[..., 2]))
    v, u = valid[np.argmin(np.abs(valid - np.median(valid, axis=0)).sum(axis=1))]
    unfold(page, "Edit points")
    choose(page, "Select by", "lasso")
    expect(page.get_by_text("Drag a line around")).to_be_visible()
    views.wait_for(page, cloud.points)
    x, y = to_screen(app, page, cloud.points[v, u])
    drag(page, np.array([x, y]) + OUTLINE)
    wait_until(page, lambda: count_selected(page) > 0)
    selected = count_selected(page)
    (client,) = app.server.viser.get_clients().values()
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    size = np.array([box["width"], box["height"]])
    away = read_view(client).project(cloud.points) * size + [box["x"], box["y"]] - [x, y]
    inside = np.linalg.norm(away, axis=-1) < 40.0
    assert 20 < selected < 0.5 * len(valid)
    # the lasso has 15 sides, the mouse whole pixels
    assert 0.93 * inside.sum() < selected <= inside.sum() + 10

    choose(page, "Select by", "brush")
    expect(page.get_by_text("Drag over the points")).to_be_visible()
    wait_until_still(page)
    drag(page, np.array([(x - 120.0, y), (x - 60, y), (x, y)]))
    wait_until(page, lambda: count_selected(page) > selected)
    page.keyboard.down("Shift")
    drag(page, np.array([(x - 120.0, y), (x - 60, y), (x, y)]))
    page.keyboard.up("Shift")
    wait_until(page, lambda: 0 < count_selected(page) < selected)
    click(page, "Select nothing")
    choose(page, "Select by", "lasso")
    expect(page.get_by_text("Drag a line around")).to_be_visible()
    wait_until_still(page)
    drag(page, np.array([x, y]) + OUTLINE)
    wait_until(page, lambda: count_selected(page) == selected)
    click(page, "Delete selected")
    wait_until(page, lambda: len(operator.snapshot().scan("one").edits) == 1)  # type: ignore[union-attr]
    (edit,) = load_edits(operator.session, "one").active
    assert edit.pixels is not None and edit.pixels[v, u] and edit.points == selected
    expect(page.get_by_text(re.compile(f"{selected:,} removed by edits"))).to_be_visible()
    assert load_scan_cloud(operator.session, "one").measured_count == len(valid) - selected

    choose(page, "Select by", "rectangle")
    expect(page.get_by_text("Drag a rectangle")).to_be_visible()
    wait_until_still(page)
    drag_rectangle(page, x, y, 60)
    wait_until(page, lambda: count_selected(page) > 0)
    click(page, "Invert selection")
    total = len(valid) - selected
    wait_until(page, lambda: count_selected(page) > 0.3 * total)
    click(page, "Hide selected")
    expect(page.get_by_text(re.compile(r"[\d,]+ hidden"))).to_be_visible()
    assert len(operator.snapshot().scan("one").edits) == 1  # type: ignore[union-attr]
    click(page, "Show hidden")
    click(page, "Undo edit")
    wait_until(page, lambda: not operator.snapshot().scan("one").edits)  # type: ignore[union-attr]
    expect(page.get_by_text(re.compile("points shown; the file has all"))).to_be_visible()
    click(page, "Redo edit")
    wait_until(page, lambda: len(operator.snapshot().scan("one").edits) == 1)  # type: ignore[union-attr]
    choose(page, "Select by", "off")  # drags turn the view again
    assert cut_labels(page) == []
    assert opened.errors == []


def test_points_of_two_scans_are_deleted_and_restored_in_step_merge(
    wizard: tuple[Opened, App, Operator, Views],
) -> None:
    opened, app, operator, views = wizard
    page = opened.page
    operator.reconstruct("two")
    operator.wait_until_idle(PATIENCE_S)
    assert operator.session is not None
    points = whole_cloud(operator.session, "one").points
    click(page, "7. Merge")
    expect(button(page, "Merge 2 scans")).to_be_visible()
    unfold(page, "Edit points")
    choose(page, "Select by", "lasso")
    expect(page.get_by_text("Drag a line around")).to_be_visible()
    views.wait_for(page, points)
    valid = np.argwhere(np.isfinite(points[..., 2]))
    v, u = valid[np.argmin(np.abs(valid - np.median(valid, axis=0)).sum(axis=1))]
    x, y = to_screen(app, page, points[v, u])
    drag(page, np.array([x, y]) + OUTLINE)
    wait_until(page, lambda: count_selected(page) > 0)
    selected = count_selected(page)

    def edits() -> list[int]:
        return [len(operator.snapshot().scan(name).edits) for name in ("one", "two")]  # type: ignore[union-attr]

    click(page, "Delete selected")
    wait_until(page, lambda: edits() == [1, 1])
    assert (
        sum(load_edits(operator.session, name).active[0].points for name in ("one", "two"))
        == selected
    )
    click(page, "Undo edit")
    wait_until(page, lambda: edits() == [0, 0])
    click(page, "Redo edit")
    wait_until(page, lambda: edits() == [1, 1])
    assert cut_labels(page) == []
    assert opened.errors == []


def test_region_is_set_by_numbers_and_by_handle(
    wizard: tuple[Opened, App, Operator, Views],
) -> None:
    opened, app, operator, _ = wizard
    page = opened.page
    assert operator.session is not None
    total = whole_cloud(operator.session, "one").measured_count

    def region():  # type: ignore[no-untyped-def]
        session = operator.snapshot().session
        assert session is not None
        return session.region if session.region_is_on else None

    unfold(page, "Region of interest")
    click(page, "Automatic region")
    wait_until(page, lambda: region() is not None)
    automatic = region()
    assert load_scan_cloud(operator.session, "one").measured_count > 0.995 * total
    field(page, "Size (mm)").fill(f"{automatic.size_mm[0] / 2:.1f}")
    wait_until(page, lambda: abs(region().size_mm[0] - automatic.size_mm[0] / 2) < 0.1)
    assert 0.2 * total < load_scan_cloud(operator.session, "one").measured_count < 0.9 * total
    expect(page.get_by_text(re.compile("removed by edits and region"))).to_be_visible()
    page.locator("xpath=//*[normalize-space(text())='Handles']/following::input[1]").check()
    # of the box, along the arrow; what is drawn just then may take the drag
    for share in 10 * (
        0.3,
        0.25,
        0.35,
    ):
        wait_until_still(page)
        start = region()
        arrow = np.array([share * max(start.size_mm), 0, 0])
        x, y = to_screen(app, page, np.array(start.centre_mm) + arrow)
        page.mouse.move(x, y)
        wait_for_frames(page)
        page.mouse.down()
        page.mouse.move(x + 20, y, steps=4)
        page.mouse.move(x + 60, y, steps=6)
        page.mouse.up()
        if operator.wait_for(
            lambda _: abs(region().centre_mm[0] - automatic.centre_mm[0]) > 1, 2.0
        ):
            break
    assert abs(region().centre_mm[0] - automatic.centre_mm[0]) > 1
    assert np.allclose(region().size_mm[1:], automatic.size_mm[1:], atol=0.11)
    for _ in range(10):  # what is drawn just then may put the older number back
        field(page, "Centre (mm)").fill("5000")
        if operator.wait_for(lambda _: abs(region().centre_mm[0] - 5000) < 0.1, 10.0):
            break
    expect(
        page.get_by_text(re.compile(r"none of its \d+ points lies in the region"))
    ).to_be_visible()
    page.locator("xpath=//*[normalize-space(text())='Use region']/following::input[1]").uncheck()
    wait_until(page, lambda: region() is None)
    expect(page.get_by_text(re.compile("points shown; the file has all"))).to_be_visible()
    assert cut_labels(page) == []
    assert opened.errors == []


def test_six_clicks_make_textured_mesh_of_part_without_its_table(
    tmp_path: Path, browser: Browser
) -> None:
    folder, rig = tmp_path / "session", letter(0.25)
    true_calibration(folder, rig)
    world = SimulatedWorld(rig)
    world.place("stone on a table")
    names = {"a": 0.0, "b": 20.0, "c": 40.0}
    capture_scans(folder, world, names, "p18")
    with Operator(folder, timing=CALM) as operator:
        app = App(operator, Serving(port=0))
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        click(page, "6. Scan")
        for name in names:  # as a capture does with "Align as you scan"
            operator.reconstruct(name)
            operator.wait_until_idle(PATIENCE_S)
            operator.align(name)
            operator.wait_until_idle(PATIENCE_S)
        expect(page.get_by_text("seen by more than one; gaps")).to_be_visible()
        page.evaluate("window.clicks = 0; addEventListener('click', () => window.clicks++, true)")

        click(page, "Remove support, 3 scans")
        wait_until(page, lambda: all(operator.snapshot().scan(name).edits for name in names))  # type: ignore[union-attr]
        click(page, "7. Merge")
        click(page, "Merge 3 scans")
        wait_until(page, lambda: operator.snapshot().session.merge is not None)  # type: ignore[union-attr]
        click(page, "9. Export")
        click(page, "Write textured mesh")
        link = page.get_by_role("link", name=re.compile(r"Download .*\.glb"))
        expect(link).to_be_visible()
        with page.expect_download() as started:
            link.click()
        assert page.evaluate("window.clicks") == 6
        started.value.save_as(tmp_path / "part.glb")
        assert opened.errors == []
        page.context.close()
        app.close()
    mesh = trimesh.load(tmp_path / "part.glb", force="mesh")
    points = 1000 * mesh.vertices * [1, -1, -1]  # GLB: m, y up
    stone = turning(1)["turn_01"]
    truth = trimesh.Trimesh(
        turn_pose(stone.pose, names["c"]).to_camera(stone.vertices), stone.triangles
    )
    away, nearest = cKDTree(truth.vertices).query(points)
    height = np.abs(
        np.sum((points - truth.vertices[nearest]) * truth.vertex_normals[nearest], axis=1)
    )
    # the calibration is without distortion
    assert 0.02 < np.median(height) < 0.2 and np.percentile(height, 99) < 0.6
    assert away.max() < 3.0  # nothing is left of the table
    assert np.asarray(mesh.visual.material.baseColorTexture).shape[:2] == (2048, 2048)


def test_plan_is_made_uploaded_and_run_on_two_scans(tmp_path: Path, browser: Browser) -> None:
    folder, rig = tmp_path / "session", letter(0.25)
    true_calibration(folder, rig)
    world = SimulatedWorld(rig)
    world.place("sphere")
    capture_scans(folder, world, {"a": 0.0, "b": 0.0}, "p18")
    with Operator(folder, timing=CALM) as operator:
        for name in ("a", "b"):
            operator.reconstruct(name)
            operator.wait_until_idle(PATIENCE_S)
        top = world.pose.t - [0.0, 0.0, 98.0]
        app = App(operator, Serving(port=0))
        views = Views(app)
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        click(page, "8. Measure")
        views.wait_for(page, load_scan_cloud(operator.session, "a").points)
        page.get_by_text("Sphere", exact=True).click()
        choose(page, "Region", "rectangle")
        wait_until_still(page)
        x, y = to_screen(app, page, top)
        drag_rectangle(page, x, y, 50)
        expect(page.get_by_text(re.compile(r"[\d,]+ points in the box"))).to_be_visible()
        click(page, "Fit sphere")
        wait_until(page, lambda: len(operator.snapshot().session.measurements) == 1)  # type: ignore[union-attr]
        (fitted,) = operator.snapshot().session.measurements  # type: ignore[union-attr]
        assert abs(fitted.record["radius"].value - 98.0) < 1.5 and "box" in fitted.record.where
        click(page, "End tool")
        click(page, "Make plan")
        wait_until(page, lambda: operator.snapshot().session.plans == (OWN_PLAN,))  # type: ignore[union-attr]
        unfold(page, "Inspection plan")
        choose(page, "Parts", "all 2 scans")
        click(page, "Run plan")

        def decisions() -> list[str]:
            runs = operator.snapshot().session.list_records(Inspection)  # type: ignore[union-attr]
            return [part.decision for part in runs[-1].record.parts] if runs else []

        wait_until(page, lambda: len(decisions()) == 2)
        # the plan's own tolerance is as small as the uncertainty
        assert decisions() == [
            "undecided",
            "undecided",
        ]
        expect(page.get_by_text("2 undecided", exact=True)).to_be_visible()

        plan = read_plan(folder / OWN_PLAN)
        (diameter,) = (each for each in plan.characteristic if each.kind == "diameter")
        wide = (
            replace(diameter, lower=195.0, upper=199.0),
            replace(diameter, name="small", lower=190.0, upper=191.0),
        )
        write_plan(replace(plan, name="ball", characteristic=wide[:1]), tmp_path / "ball.toml")
        write_plan(replace(plan, name="small", characteristic=wide), tmp_path / "small.toml")
        for count, (name, judged) in enumerate((("ball", "2 pass"), ("small", "2 fail")), 2):
            with page.expect_file_chooser() as chooser:
                click(page, "Upload plan")
            chooser.value.set_files(tmp_path / f"{name}.toml")
            wait_until(page, lambda count=count: len(operator.snapshot().session.plans) == count)  # type: ignore[misc,union-attr]
            choose(page, "Plan", f"{name}.toml")
            click(page, "Run plan")
            expect(page.get_by_text(judged, exact=True)).to_be_visible()
        assert "small" in (folder / "exports" / "parts.html").read_text()
        assert cut_labels(page) == []
        assert opened.errors == []
        page.context.close()
        app.close()
