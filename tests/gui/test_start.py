"""The start page: from no session to a new one, and what can be done with the recent ones."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from wizard_page import CALM, PATIENCE_S, RIG, Opened, button, click, field, new_page

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.session.recent import RecentSessions
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator


@pytest.fixture
def start(
    tmp_path: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Opened, Operator]]:
    """The start page of a simulated rig, with a recent session."""
    monkeypatch.setattr("platformdirs.user_documents_path", lambda: tmp_path)
    folder = tmp_path / "slviewer" / "Bracket 12"
    Session.create(folder).close()
    recent = RecentSessions(tmp_path / "state" / "recent.json")
    recent.add(folder)
    with Operator(rig=RIG, timing=CALM) as operator:
        assert operator.wait_for(lambda s: s.rig.state == "open", PATIENCE_S)
        app = App(operator, Serving(port=0), recent=recent)
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        yield opened, operator
        page.context.close()
        app.close()


def test_sessions_are_made_deleted_and_restored(
    start: tuple[Opened, Operator], tmp_path: Path
) -> None:
    opened, operator = start
    page, work = opened.page, tmp_path / "slviewer"
    expect(page.get_by_text("0 poses, 0 scans")).to_be_visible()
    expect(page.get_by_text("Not calibrated")).to_be_visible()
    click(page, "Duplicate")
    expect(page.get_by_role("alert").filter(has_text="no calibration").first).to_be_visible()
    click(page, "Delete")
    expect(button(page, "Restore Bracket 12")).to_be_visible()
    assert not (work / "Bracket 12").exists()
    click(page, "Restore Bracket 12")
    expect(page.get_by_text("Bracket 12", exact=True)).to_be_visible()
    opened.enter("Name", "Bracket 12")
    click(page, "New session")
    expect(page.get_by_role("alert").filter(has_text="is a session already")).to_be_visible()
    opened.enter("Name", "Bracket 13")
    click(page, "New session")
    expect(button(page, "Use this board")).to_be_visible()  # the rig is ready
    assert operator.session is not None and operator.session.folder == work / "Bracket 13"
    shutil.rmtree(work / "Bracket 12")
    click(page, "Sessions")
    expect(page.get_by_text("Recent sessions")).to_be_visible()
    click(page, "Delete")
    expect(page.get_by_role("alert").filter(has_text="is open")).to_be_visible()
    expect(page.get_by_text("Bracket 12", exact=True)).to_be_hidden()
    expect(field(page, "Name")).not_to_have_value("Bracket 13")
    assert opened.errors == []
