"""An operation of another package is a command, a function, a job and a panel, and its figure is in
every view."""

import csv
import json
import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from clocks import HANG_S
from copies import copy_session
from facts import missing_facts
from playwright.sync_api import Browser, expect
from wizard_page import CALM, choose, click, field, new_page, unfold, wait_until

from slviewer.cli import main
from slviewer.errors import UsageError
from slviewer.gui.app import App
from slviewer.pipeline.certificate import read_certificate, verify_report
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

pytestmark = pytest.mark.usefixtures("example")
SCAN = "object_r1"


def import_operation() -> Any:
    """The module of the operation, imported anew for each test."""
    return import_module("slviewer_example.brightness")


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    """The captures alone: certificates repeat no calibration."""
    others = shutil.ignore_patterns(
        "calibration", "poses", "evidence", "compiled", "plane_*", "sphere_*"
    )
    return copy_session(recorded / "session", tmp_path / "session", others)


@pytest.mark.computes
def test_terminal_json_csv_report_and_certificate_hold_the_figure(
    session: Path, tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    status, out, _ = run("brightness", session, SCAN, "--json", tmp_path / "found.json")
    record = json.loads((tmp_path / "found.json").read_text())["brightness"][SCAN]
    shown = f"{record['mean_percent']:.1f}"
    assert status == 0 and shown in out and "%" in out and 5 < record["mean_percent"] < 95
    assert main(["export", str(session), "table", "--out", str(tmp_path / "figures.csv")]) == 0
    (row,) = csv.DictReader((tmp_path / "figures.csv").read_text().splitlines())
    assert row["record"] == SCAN and float(row["mean %"]) == record["mean_percent"]
    report = tmp_path / "report.html"
    assert main(["report", str(session), "--out", str(report)]) == 0
    page = report.read_text()
    assert "Brightness" in page and "How bright captures are." in page and f">{shown}<" in page
    assert read_certificate(report)[1].figures[f"brightness/{SCAN}"] == {
        "mean_percent": record["mean_percent"]
    }
    states = {check.what: check.state for check in verify_report(session, report).checks}
    assert states[f"brightness/{SCAN}"] == "same"
    status, _, said = run("brightness", session, SCAN, "--brightest", "0")
    assert status == 2 and not missing_facts(said, "--brightest", "0.1", "100")
    with pytest.raises(UsageError):
        import_operation().brightness(session, SCAN, brightest=101.0)


@pytest.mark.computes
@pytest.mark.slow
def test_python_and_wizard_store_what_the_terminal_does(session: Path, tmp_path: Path) -> None:
    again = copy_session(session, tmp_path / "again")
    module = import_operation()
    (found,) = module.brightness(session, SCAN).values()
    with Operator(again) as operator:
        assert operator.run("brightness", capture=SCAN)
        view = operator.wait_until_idle(HANG_S).session
        assert view is not None
        assert [each.record for each in view.list_records(module.Brightness)] == [found]
    with Session.open(session) as one, Session.open(again) as other:
        assert one.load_result(f"brightness/{SCAN}") == other.load_result(f"brightness/{SCAN}")


def test_its_panel_measures_and_the_page_shows_the_figure(session: Path, browser: Browser) -> None:
    with Operator(session, timing=CALM) as operator:
        wizard, page = App(operator, Serving(port=0)), new_page(browser)
        page.goto(wizard.server.link())
        click(page, "6. Scan")
        unfold(page, "Brightness")
        choose(page, "Capture", SCAN)
        field(page, "Brightest, %").fill("1")
        field(page, "Brightest, %").press("Enter")
        click(page, "Measure brightness")
        brightness = import_operation().Brightness
        wait_until(page, lambda: bool(operator.snapshot().session.list_records(brightness)))  # type: ignore[union-attr]
        (found,) = (each.record for each in operator.snapshot().session.list_records(brightness))  # type: ignore[union-attr]
        assert found.mean_percent > 60  # not of all pixels
        expect(page.get_by_text(f"{SCAN}: {found.mean_percent:.1f} %")).to_be_visible()
        click(page, "9. Export")
        page.get_by_text("Figures", exact=True).click()
        expect(page.get_by_text("Brightness").first).to_be_visible()
        expect(page.get_by_text(f"{found.mean_percent:.1f}", exact=True)).to_be_visible()
        page.context.close()
        wizard.close()


@pytest.mark.parametrize("broken", ["step", "build", "draw"])
def test_a_broken_panel_stops_nothing(
    session: Path, browser: Browser, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    def fail(panel: object) -> None:
        raise RuntimeError("the maker forgot a file")

    panel = import_module("slviewer_example.brightness_panel").BrightnessPanel
    monkeypatch.setattr(panel, broken, "nowhere" if broken == "step" else fail)
    with Operator(session, timing=CALM) as operator:
        wizard, page = App(operator, Serving(port=0)), new_page(browser)
        page.goto(wizard.server.link())
        click(page, "6. Scan")
        expect(page.get_by_text("Calibrate first.")).to_be_visible()
        page.context.close()
        wizard.close()
