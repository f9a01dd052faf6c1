"""What the page says of a calibration and of scans belongs to the model in use, and to what is
drawn."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from copies import copy_session
from playwright.sync_api import Browser, expect
from wizard_page import CALM, Opened, browse, choose, click

from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator

pytestmark = pytest.mark.slow


@pytest.fixture
def shown(recorded: Path, tmp_path: Path, browser: Browser) -> Iterator[Opened]:
    """The page on a copy of the recorded session, calibrated with all models, without a rig."""
    folder = copy_session(recorded / "session", tmp_path / "session")
    with Operator(folder, timing=CALM) as engine:
        app = App(engine, Serving(port=0))
        with browse(browser, app) as opened:
            yield opened
        app.close()


def test_calibrate_shows_and_judges_the_residuals_of_the_model_in_use(shown: Opened) -> None:
    page = shown.page
    click(page, "4. Calibrate")
    expect(page.get_by_text("The residuals of splined are noise.")).to_be_visible()
    expect(page.get_by_text("of each target pose by the splined model")).to_be_visible()
    expect(page.get_by_text(re.compile(r"camera, splined: measured .*px: noise"))).to_be_visible()
    choose(page, "Model", "stereo")
    expect(page.get_by_text("The residuals of the stereo model are a pattern")).to_be_visible()
    expect(page.get_by_text("no problems detected")).to_have_count(0)
    expect(page.get_by_text("of each target pose by the stereo model")).to_be_visible()
    expect(
        page.get_by_text(re.compile(r"camera, stereo: measured .*px: a pattern"))
    ).to_be_visible()
    assert shown.errors == []


def test_scan_outside_the_calibrated_depths_says_so(shown: Opened) -> None:
    page = shown.page
    click(page, "6. Scan")
    choose(page, "Scan", "plane_01")
    click(page, "Reconstruct", exact=True)
    expect(
        page.get_by_text("of the points are outside the calibrated depths").first
    ).to_be_visible()
    expect(page.get_by_text("which includes what the calibration leaves uncertain")).to_be_visible()
    expect(page.get_by_text("more points are extrapolated")).to_be_visible()
    expect(page.get_by_label("Extrapolated points")).to_be_checked()
    assert shown.errors == []
