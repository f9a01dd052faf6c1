"""The frame of the page, as someone sees it who opens it: the steps, one pose, a reload, a guest, a failure."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from wizard_page import SIZE, Opened, button, field

from slviewer.errors import UsageError
from slviewer.gui.app import App, rig_choice
from slviewer.wizard.operator import Operator

STEPS = ("Rig", "Target", "Poses", "Calibrate", "Verify", "Scan", "Merge", "Measure", "Export")


def test_from_the_link_to_a_pose_that_a_reload_keeps(opened: Opened, operator: Operator) -> None:
    page = opened.page
    for number, title in enumerate(STEPS, 1):
        expect(button(page, f"{number}. {title}")).to_be_visible()

    button(page, "2. Target").click()
    button(page, "Use this board").click()
    expect(page.get_by_text("In use: circles:21x16:9")).to_be_visible()
    button(page, "Continue to Poses").click()
    expect(page.get_by_text("Board detected: 336 of 336 features")).to_be_visible()
    button(page, "Place board").click()
    button(page, "Capture pose").click()
    expect(page.get_by_text("pose_01").first).to_be_visible()
    assert operator.wait_for(lambda s: (p := s.pose("pose_01")) is not None and p.state == "good", 30.0)
    expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()

    page.reload()
    expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()
    expect(button(page, "Capture pose")).to_be_visible()
    expect(page.get_by_text("good", exact=True).first).to_be_visible()
    assert opened.errors == []


def test_a_guest_sees_the_same_step_and_changes_nothing(opened: Opened, app: App, browser: Browser) -> None:
    guest = browser.new_context(viewport=SIZE).new_page()
    guest.goto(app.server.link("watch"))
    expect(guest.get_by_text("View only")).to_be_visible()
    button(opened.page, "2. Target").click()
    expect(button(guest, "Use this board")).to_be_visible()
    button(guest, "1. Rig").click()
    guest.wait_for_timeout(500)
    assert app.shell.current == "target"
    guest.context.close()


def test_what_cannot_be_done_is_said_in_words(opened: Opened, tmp_path: Path) -> None:
    (tmp_path / "a file").write_text("not a session")
    page = opened.page
    field(page, "Folder").fill(str(tmp_path / "a file"))
    button(page, "Open session").click()
    expect(page.get_by_text("Error", exact=True).first).to_be_visible()
    assert opened.errors == []


@pytest.mark.parametrize("text", ["simulated:half", "simulated:1,5"])
def test_a_rig_that_is_none(text: str) -> None:
    assert rig_choice("simulated:0.25") == {"driver": "simulated", "scale": 0.25}
    with pytest.raises(UsageError, match="rig"):
        rig_choice(text)
