"""How much an operator has to choose: from the start page to an STL, every click is counted."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Browser, Locator, Page, expect
from test_editing import OUTLINE, Views, count_selected, drag, to_screen
from wizard_page import (
    CALM,
    PATIENCE_MS,
    PATIENCE_S,
    RIG,
    Opened,
    button,
    field,
    new_page,
    pose_row,
    wait_until,
    wait_until_still,
)

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import whole_cloud
from slviewer.wizard.snapshot import Snapshot

pytestmark = [pytest.mark.computes, pytest.mark.slow]

MOST_CHOICES = 30
POSES = 6


class Hand:
    """An operator's hand on the page; every click, drag and key counts as one of `choices`."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.choices: list[str] = []

    def act(self, what: str, do: Callable[[], object]) -> None:
        """Do something once the page stands still: what is drawn anew just then may take the
        click."""
        wait_until_still(self.page)
        self.choices.append(what)
        do()

    def click(self, name: str | Locator) -> None:
        """Click a button, a text or a link, once it can be clicked."""
        target = button(self.page, name) if isinstance(name, str) else name
        expect(target.first).to_be_enabled()
        self.act(str(name), target.first.click)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a dropdown: two clicks."""
        self.act(label, field(self.page, label).click)
        self.act(option, self.page.get_by_role("option", name=option, exact=True).click)
        expect(field(self.page, label)).to_have_value(option)


@pytest.fixture
def operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Operator]:
    """A simulated rig, and no session yet."""
    monkeypatch.setattr("platformdirs.user_documents_path", lambda: tmp_path)
    with Operator(rig=RIG, timing=CALM) as engine:
        assert engine.wait_for(lambda s: s.rig.state == "open", PATIENCE_S)
        yield engine


def wait(operator: Operator, holds: Callable[[Snapshot], object]) -> None:
    """Wait for what the operator sees on the page."""
    assert operator.wait_for(lambda s: bool(holds(s)), PATIENCE_S)


def test_new_session_reaches_stl_in_thirty_choices(
    operator: Operator, browser: Browser, tmp_path: Path
) -> None:
    app = App(operator, Serving(port=0))
    views = Views(app)
    page = new_page(browser)
    opened, hand = Opened(page), Hand(page)
    try:
        page.goto(app.server.link())
        hand.click("New session")
        hand.click("Use this board")
        hand.click("Continue to Poses")
        take_poses(hand)
        hand.click("4. Calibrate")
        hand.click(page.get_by_role("button", name="Calibrate", exact=True))
        wait(operator, lambda s: s.calibration and not s.calibration.stale)

        hand.click("6. Scan")
        hand.choose("Object", "object")
        for name in ("scan_01", "scan_02"):
            hand.click("Capture scan")
            wait(operator, lambda s, n=name: (v := s.scan(n)) and v.cloud == "fresh")  # type: ignore[misc]
        lasso(hand, app, views)

        hand.click("7. Merge")
        hand.click("Merge 2 scans")
        wait(operator, lambda s: s.content.merge)
        hand.click("9. Export")
        hand.click("Write STL")
        with page.expect_download() as download:
            hand.click(page.get_by_role("link", name=re.compile(r"Download .*\.stl")))
        download.value.save_as(tmp_path / "part.stl")
        mesh = trimesh.load(tmp_path / "part.stl", force="mesh")
        assert len(mesh.faces) > 1000 and mesh.extents == pytest.approx([141, 126, 31], abs=5)
        print(f"{len(hand.choices)} choices: {hand.choices}")
        assert len(hand.choices) <= MOST_CHOICES, hand.choices
        assert [n.text for n in operator.snapshot().notices if n.level == "error"] == []
        assert opened.errors == []
    finally:
        page.context.close()
        app.close()


def take_poses(hand: Hand) -> None:
    """Capture poses hands-free: the board is put where it is asked for, and held still."""
    hand.click(hand.page.get_by_role("checkbox", name="Hands-free"))
    for number in range(1, POSES + 1):
        if number > 1:
            hand.click("Place board")
        row = pose_row(hand.page, f"pose_{number:02d}", "good")
        expect(row).to_be_visible(timeout=PATIENCE_MS)


def lasso(hand: Hand, app: App, views: Views) -> None:
    """Delete points of the last scan with a lasso."""
    page, session = hand.page, app.operator.session
    assert session is not None
    cloud = whole_cloud(session, "scan_02")
    points = cloud.points[np.isfinite(cloud.points[..., 2])]
    hand.click(page.get_by_text("Edit points", exact=True))
    hand.choose("Select by", "lasso")
    expect(page.get_by_text("Drag a line around")).to_be_visible()
    views.wait_for(page, cloud.points)
    middle = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    places = np.array(to_screen(app, page, middle)) + OUTLINE / 2
    hand.act("lasso", lambda: drag(page, places))
    wait_until(page, lambda: count_selected(page) > 0)
    hand.click("Delete selected")
    wait(app.operator, lambda s: s.scan("scan_02").edits)
