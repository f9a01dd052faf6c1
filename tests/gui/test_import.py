"""A zip that is uploaded in a browser becomes poses, and what is wrong with it is said there."""

import io
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from wizard_page import (
    CALM,
    PATIENCE_S,
    Opened,
    browse,
    button,
    choose,
    click,
    expect_message,
    field,
)

from slviewer import import_captures
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import gray
from slviewer.gui.app import App
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator

PROJECTOR = (120, 90)


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    """A new session without a rig: imported captures need none."""
    with Operator(tmp_path / "session", timing=CALM) as engine:
        yield engine


def zip_of_captures() -> bytes:
    """Two captures of Gray code with inverses, one of which lacks an image, and a file that is no
    image."""
    sequence, data, rng = gray(PROJECTOR), io.BytesIO(), np.random.default_rng(1)
    with zipfile.ZipFile(data, "w") as out:
        for name in ("capture_0", "capture_1"):
            for i in range(len(sequence.frames)):
                frame = (
                    (render_pattern(sequence, i) * 0.5 + 40 + rng.normal(0, 1, PROJECTOR[::-1]))
                    .round()
                    .astype(np.uint8)
                )
                if (name, i) != ("capture_1", 4):
                    out.writestr(
                        f"set/{name}/graycode_{i:02d}.png", cv2.imencode(".png", frame)[1].tobytes()
                    )
        out.writestr("set/notes.txt", "x")
    return data.getvalue()


@pytest.mark.slow
def test_uploaded_zip_becomes_poses_and_its_faults_are_listed(
    opened: Opened, operator: Operator
) -> None:
    page = opened.page
    click(page, "3. Poses")
    page.get_by_text("Import captures", exact=True).click()
    choose(page, "Layout", "procam-calibration")
    expect(page.get_by_text("Default size: of the session, else 1024x768.")).to_be_visible()
    opened.enter("Projector", "120x90")
    for name, content in (("broken.zip", b"no zip"), ("set.zip", zip_of_captures())):
        with page.expect_file_chooser() as chooser:
            click(page, "Upload zip")
        chooser.value.set_files({"name": name, "mimeType": "application/zip", "buffer": content})
        if name == "broken.zip":
            expect(page.get_by_text(re.compile("the file is not a zip")).first).to_be_visible()
            expect(button(page, "Upload zip")).to_be_enabled()
    expect_message(page, "1 capture imported as a target pose: capture_0")
    expect_message(page, re.compile("not imported: capture_1: it lacks graycode_04"))
    expect_message(page, re.compile("notes.txt in the zip"))
    session = operator.session
    assert session is not None and session.load_capture("capture_0").sequence.projector == PROJECTOR
    assert session.load_capture("capture_0").role == "calibration" and opened.errors == []


@pytest.mark.computes
@pytest.mark.slow
def test_the_board_in_imported_poses_is_recognised(
    real_data: Path, tmp_path: Path, browser: Browser
) -> None:
    folder = tmp_path / "session"
    import_captures(real_data / "kamino_procam_jpg90", folder, layout="procam-calibration")
    with Operator(folder, timing=CALM) as operator:
        operator.wait_until_idle(PATIENCE_S)
        app = App(operator, Serving(port=0))
        with browse(browser, app) as opened:
            click(opened.page, "2. Target")
            expect(field(opened.page, "Board")).to_have_value("Chessboard")
            expect(field(opened.page, "Columns")).to_have_value("9")
            expect(field(opened.page, "Rows")).to_have_value("7")
            expect(opened.page.get_by_text("5 of 5 images")).to_be_visible()
        assert operator.snapshot().content.target == ""  # its pitch is the operator's to enter
        app.close()
