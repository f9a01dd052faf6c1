"""An operation of a dozen lines is a command, a function and a job, and its figure is in every
view."""

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
from clocks import HANG_S
from copies import copy_session
from playwright.sync_api import Browser, expect
from wizard_page import CALM, click, new_page

from slviewer.cli import main
from slviewer.gui.app import App
from slviewer.pipeline.certificate import read_certificate, verify_report
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.operations import OPERATIONS
from slviewer.records.kinds import RECORDS
from slviewer.records.record import Record
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator


class Brightness(Record, frozen=True, kw_only=True):
    """How bright captures are."""

    kind: ClassVar[str] = "brightness"
    title: ClassVar[str] = "Brightness"
    mean_percent: float


@dataclass(frozen=True)
class BrightnessSettings:
    """What is measured.

    Args:
        capture: Name of the capture.
    """

    capture: str


@operation("brightness", Brightness, BrightnessSettings)
def brightness(job: Job, settings: BrightnessSettings) -> Iterator[Found[Brightness]]:
    """Measure how bright a capture is."""
    capture = job.store.load_capture(settings.capture)
    mean = 100 * float(capture.frames.mean()) / 255
    yield Found(
        capture.name, Brightness(mean_percent=mean, inputs=job.store.input_hashes(capture.name))
    )


del OPERATIONS["brightness"]  # every worker imports this file, whichever tests it runs


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Other tests do not see the kind and the operation of this file."""
    RECORDS["brightness"], OPERATIONS["brightness"] = Brightness, brightness
    yield
    del RECORDS["brightness"], OPERATIONS["brightness"]


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
    status, out, _ = run("brightness", session, "object_r1", "--json", tmp_path / "found.json")
    record = json.loads((tmp_path / "found.json").read_text())["brightness"]["object_r1"]
    shown = f"{record['mean_percent']:.1f}"
    assert status == 0 and shown in out and "%" in out and 5 < record["mean_percent"] < 95
    assert main(["export", str(session), "table", "--out", str(tmp_path / "figures.csv")]) == 0
    (row,) = csv.DictReader((tmp_path / "figures.csv").read_text().splitlines())
    assert row["record"] == "object_r1" and float(row["mean %"]) == record["mean_percent"]
    report = tmp_path / "report.html"
    assert main(["report", str(session), "--out", str(report)]) == 0
    page = report.read_text()
    assert "Brightness" in page and "How bright captures are." in page and f">{shown}<" in page
    assert read_certificate(report)[1].figures["brightness/object_r1"] == {
        "mean_percent": record["mean_percent"]
    }
    states = {check.what: check.state for check in verify_report(session, report).checks}
    assert states["brightness/object_r1"] == "same"


@pytest.mark.computes
@pytest.mark.slow
def test_python_and_wizard_store_what_the_terminal_does(session: Path, tmp_path: Path) -> None:
    again = copy_session(session, tmp_path / "again")
    (found,) = brightness(session, "object_r1").values()
    with Operator(again) as operator:
        assert operator.run("brightness", capture="object_r1")
        view = operator.wait_until_idle(HANG_S).session
        assert view is not None and [each.record for each in view.list_records(Brightness)] == [
            found
        ]
    with Session.open(session) as one, Session.open(again) as other:
        assert one.load_result("brightness/object_r1") == other.load_result("brightness/object_r1")


def test_the_page_shows_the_figure(session: Path, browser: Browser) -> None:
    (found,) = brightness(session, "object_r1").values()
    with Operator(session, timing=CALM) as operator:
        wizard, page = App(operator, Serving(port=0)), new_page(browser)
        page.goto(wizard.server.link())
        click(page, "9. Export")
        page.get_by_text("Figures", exact=True).click()
        expect(page.get_by_text("Brightness").first).to_be_visible()
        expect(page.get_by_text(f"{found.mean_percent:.1f}", exact=True)).to_be_visible()
        page.context.close()
        wizard.close()
