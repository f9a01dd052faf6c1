"""Live clouds in a browser, and how fast they come to those who look."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from wizard_page import CALM, PATIENCE_S, Opened, click, new_page

from slviewer.fringe.layout import to_eight_bits
from slviewer.gui.app import App
from slviewer.gui.scene import thin
from slviewer.server.secure import Serving
from slviewer.simulation.rig import letter
from slviewer.validation.bench_live import live_rate
from slviewer.wizard.operator import Operator
from tests.rendered_calibration import true_calibration

SCALE = 0.15


@pytest.fixture
def app(tmp_path: Path) -> Iterator[App]:
    folder = tmp_path / "session"
    true_calibration(folder, letter(SCALE))
    # the browser needs the cores too
    slow = {
        "driver": "simulated",
        "scale": SCALE,
        "settle_ms": 30,
    }
    with Operator(folder, slow, timing=CALM) as operator:
        assert operator.wait_for(lambda s: s.rig.state == "open", PATIENCE_S) is not None
        operator.place("object")
        wizard = App(operator, Serving(port=0))
        yield wizard
        wizard.close()


@pytest.mark.slow
@pytest.mark.computes
def test_live_clouds_are_shown_saved_and_stopped(browser: Browser, app: App) -> None:
    page = new_page(browser)
    found = Opened(page)
    page.goto(app.server.link())
    click(page, "6. Scan")
    click(page, "Live")
    expect(page.get_by_text("clouds/s").first).to_be_visible()
    expect(page.get_by_text("Nothing is saved yet")).to_be_visible()
    click(page, "Save cloud")
    expect(page.get_by_text("scan_01").first).to_be_visible()
    assert app.operator.wait_for(
        lambda s: s.live is not None and s.live.shown_per_s > 0, PATIENCE_S
    )
    app.shell.go("merge")  # to leave the step ends it
    assert app.operator.wait_for(lambda s: s.live is None, PATIENCE_S)
    assert found.errors == []
    page.context.close()


@pytest.mark.slow
@pytest.mark.computes
def test_live_rate_is_measured_beside_stalled_viewer() -> None:
    found = live_rate(SCALE, 1.0)
    assert found.size == (240, 180) and found.points > 3000
    assert found.captures_per_s + found.captures_per_s_stalled > 0
    assert found.clouds_per_s > 0 and found.shown_per_s > 0 and found.latency_ms > 1
    assert (
        set(vars(found)) > {"latency_ms", "growth_mb", "growth_files", "growth_threads"}
        and "240x180" in found.text()
    )


def test_thin_cloud_evenly_to_limit() -> None:
    points = np.full((120, 160, 3), 500, np.float32)
    points[:, :40] = np.nan
    texture = np.arange(120 * 160, dtype=np.uint16).reshape(120, 160)
    for limit, left in ((20_000, 14_400), (8_000, 7_200), (4_000, 3_600), (2_500, 2_400)):
        few, colours = thin(points, to_eight_bits(texture), limit)
        assert len(few) == len(colours) == left and np.isfinite(few).all()
        assert isinstance(colours, np.ndarray) and colours.dtype == np.uint8 and colours.max() >= 60
