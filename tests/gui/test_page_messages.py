"""One cause, one message: what the page says of another session, of the board, and in toasts."""

from pathlib import Path

from playwright.sync_api import expect
from wizard_page import PATIENCE_S, Opened, button, click

from slviewer.gui.app import App
from slviewer.wizard.operator import Operator

TARGET = "circles:21x16:9"


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
