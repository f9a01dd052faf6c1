"""Ctrl+Z and Ctrl+Y undo and redo what is named on the page, not while text is entered; "?" lists
the keys."""

from pathlib import Path

from playwright.sync_api import Browser, expect
from wizard_page import CALM, Opened, button, field, new_page, wait_until

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.wizard.operator import Operator


def test_keys_undo_and_redo_what_the_page_names(tmp_path: Path, browser: Browser) -> None:
    with Operator(tmp_path / "session", timing=CALM) as operator:

        def has_region() -> bool:
            return operator.snapshot().content.region is not None

        app = App(operator, Serving(port=0))
        page = new_page(browser)
        opened = Opened(page)
        page.goto(app.server.link())
        button(page, "1. Rig").wait_for()
        assert operator.set_region(RegionOfInterest((0.0, 0.0, 500.0), (10.0, 10.0, 10.0)))
        expect(button(page, "Undo: set the region")).to_be_visible()
        page.keyboard.press("Control+z")
        wait_until(page, lambda: not has_region())
        expect(button(page, "Redo: set the region")).to_be_visible()
        page.keyboard.press("Control+y")
        wait_until(page, has_region)
        expect(button(page, "Undo: set the region")).to_be_visible()

        button(page, "Sessions").click()
        field(page, "Name").fill("some folder")
        page.keyboard.press("Control+z")
        page.keyboard.press("Shift+?")
        button(page, "1. Rig").focus()
        page.keyboard.press("Shift+?")
        expect(page.get_by_role("dialog").get_by_text("Ctrl+Z")).to_be_visible()
        expect(page.get_by_role("dialog").get_by_text("Undo: set the region")).to_be_visible()
        assert has_region() and page.get_by_role("dialog").count() == 1
        button(page, "Close").click()
        assert opened.errors == []
        page.context.close()
        app.close()
