"""The panels of the hand-eye calibration and of other rigs, which own entry points add."""

from pathlib import Path

from playwright.sync_api import Browser, expect
from wizard_page import CALM, click, field, new_page, unfold

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator


def test_the_panels_run_their_operations_and_show_why_they_cannot(
    tmp_path: Path, browser: Browser
) -> None:
    Session.create(tmp_path / "session").close()
    with Operator(tmp_path / "session", timing=CALM) as operator:
        wizard, page = App(operator, Serving(port=0)), new_page(browser)
        page.goto(wizard.server.link())
        click(page, "4. Calibrate")
        unfold(page, "Hand-eye (robot)")
        field(page, "File of poses").fill("robot.csv")
        expect(page.get_by_text("Mounting", exact=True)).to_be_visible()
        click(page, "Calibrate hand-eye")
        expect(page.get_by_text("holds no calibration").first).to_be_visible()
        click(page, "7. Merge")
        unfold(page, "Other rigs")
        field(page, "Sessions of other rigs").fill(str(tmp_path))
        click(page, "Relate rigs")
        expect(page.get_by_text("no captures named").first).to_be_visible()
        page.context.close()
        wizard.close()
