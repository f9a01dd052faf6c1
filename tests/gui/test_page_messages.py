"""One cause, one message: what the page says of another session, of the board, and in toasts."""

from collections.abc import Iterator
from pathlib import Path

import clocks
import pytest
from copies import copy_session
from facts import missing_facts
from playwright.sync_api import Browser, expect
from wizard_page import CALM, PATIENCE_S, Opened, button, click, new_page

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

TARGET = "circles:21x16:9"


@pytest.fixture
def three_poses(
    recorded: Path, tmp_path: Path, browser: Browser
) -> Iterator[tuple[Opened, Operator]]:
    """A page on a session with three good poses, without a rig."""
    Session.create(tmp_path / "session").close()
    for number in range(1, 4):
        for place in ("captures", "results/poses", "results/evidence", "results/trust"):
            name = f"{place}/pose_{number:02d}"
            copy_session(recorded / "session" / name, tmp_path / "session" / name)
    with Operator(tmp_path / "session", timing=CALM) as operator:
        assert operator.choose_target(TARGET)
        operator.wait_until_idle(PATIENCE_S)
        app = App(operator, Serving(port=0))
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        button(page, "4. Calibrate").wait_for()
        yield opened, operator
        page.context.close()
        app.close()


@pytest.mark.computes
def test_few_poses_are_one_message_with_the_strongest_demand(
    three_poses: tuple[Opened, Operator],
) -> None:
    opened, operator = three_poses
    page = opened.page
    click(page, "4. Calibrate")
    page.get_by_role("button", name="Calibrate", exact=True).click()
    demand = page.get_by_text("8 poses at least")
    expect(demand).to_be_visible()
    expect(demand).to_have_count(1)
    text = page.locator("body").inner_text()
    assert "Capture more" not in text and "capture more" not in text and "dozen" not in text
    expect(page.locator(".mantine-Notification-root")).to_have_count(0)  # the panel states it
    notices = [notice.text for notice in operator.wait_until_idle(PATIENCE_S).notices]
    assert len(notices) == 1 and missing_facts(notices[0], "3 usable poses", 8, "pixel-wise") == []
    assert opened.errors == []


def test_another_session_starts_at_its_first_step_without_old_messages(
    opened: Opened, app: App, operator: Operator, tmp_path: Path
) -> None:
    page = opened.page
    assert operator.choose_target(TARGET)
    click(page, "3. Poses")
    expect(button(page, "Capture pose")).to_be_visible()
    assert not operator.open_session("")
    expect(page.get_by_text("no folder is named").last).to_be_visible()
    assert operator.open_session(tmp_path / "second")
    expect(button(page, "Use this board")).to_be_visible()
    page.get_by_role("tab", name="Messages").click()
    expect(page.get_by_text("No messages.")).to_be_visible()
    assert app.shell.current == "target" and opened.errors == []


def test_a_finished_step_does_not_miss_the_board(opened: Opened, operator: Operator) -> None:
    page = opened.page
    assert operator.choose_target(TARGET) and operator.place_at_suggestion()
    assert operator.capture_pose()
    operator.wait_until_idle(PATIENCE_S)
    assert operator.place("plane")
    click(page, "2. Target")
    expect(page.get_by_text("No board in view")).to_be_visible()
    click(page, "3. Poses")  # of which more are needed
    expect(page.get_by_text("No board in view")).to_be_hidden()
    assert opened.errors == []


def test_one_notification_at_a_time_and_one_line_about_software_rendering(
    app: App, operator: Operator, browser: Browser
) -> None:
    page = new_page(browser)
    opened = Opened(page)
    page.goto(app.server.link())
    software = page.get_by_text("drawn in software")
    expect(software).to_be_visible()
    height = (software.bounding_box() or {"height": 0.0})["height"]
    assert 0 < height < 30
    expect(page.get_by_text("Software WebGL rendering detected")).to_have_count(0)
    button(page, "1. Rig").wait_for()
    notifications = page.locator(".mantine-Notification-root")
    expect(notifications).to_have_count(0)
    for number in range(8):
        operator.notify("warning", f"cause {number}")
    operator.notify("error", "the gravest")
    operator.notify("info", "a note")
    expect(notifications).to_have_count(1)
    operator.notify("warning", "not as grave")
    operator.notify("error", "the latest, and as grave")
    expect(notifications.filter(has_text="the latest, and as grave")).to_be_visible()
    expect(notifications).to_have_count(1)
    page.get_by_role("tab", name="Messages").click()
    expect(page.get_by_text("not as grave")).to_be_visible()
    page.reload()
    button(page, "1. Rig").wait_for()
    expect(software).to_have_count(0)
    assert opened.errors == []
    page.context.close()


def test_a_notice_is_shown_on_the_start_page_too() -> None:
    with Operator() as operator:
        app = App(operator, Serving(port=0))
        failures: list[BaseException] = []
        app._context.report_failure = failures.append  # type: ignore[method-assign]
        operator.notify("warning", "a cause")
        assert clocks.until(lambda: app._notified == 1 or bool(failures))
        app.close()
    assert failures == [] and app.shell.current == "start"


def test_back_warns_before_it_leaves_the_page(opened: Opened) -> None:
    page = opened.page
    address = page.url
    click(page, "3. Poses")
    page.go_back()
    expect(page.get_by_text("Back leaves the wizard")).to_be_visible()
    assert page.url == address
    expect(page.get_by_text("Back leaves the wizard")).to_have_count(0)
    expect(button(page, "3. Poses")).to_be_visible()
