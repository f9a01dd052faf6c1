"""`slviewer capture` with the browser projector: it serves the page, prints its link, waits, and
captures."""

import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from playwright.sync_api import Browser

from slviewer.cli import main
from slviewer.devices.drivers import Driver, drivers
from slviewer.devices.protocols import CameraSettings, Openable
from slviewer.session.store import Session
from slviewer.session.toml import to_toml

SIZE = (128, 96)
HANG_S = 600.0
"""Nothing takes as long, on any machine."""


class CountingCamera(Openable):
    """Counts its frames, so that a lost one would be seen."""

    size, dtype = (8, 6), np.dtype(np.uint8)

    def __init__(self) -> None:
        super().__init__("the counting camera")
        self._count = 0

    def grab(self, out: np.ndarray) -> None:
        out[:] = self._count
        self._count += 1

    def settings(self) -> CameraSettings:
        return CameraSettings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        return CameraSettings()


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(drivers(), "counting", Driver("counting", "nothing", camera=CountingCamera))
    file = tmp_path / "rig.toml"
    choice = {
        "camera": {"driver": "counting"},
        "projector": {"driver": "browser", "size": list(SIZE)},
    }
    file.write_text(to_toml(choice))
    return file


def test_the_page_is_served_waited_for_and_captured_with(
    rig: Path, tmp_path: Path, browser: Browser, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[int] = []
    arguments = [
        "capture",
        str(tmp_path / "session"),
        "scan_01",
        "--rig",
        str(rig),
        "--role",
        "scan",
        "--port",
        "0",
    ]
    command = threading.Thread(target=lambda: ended.append(main(arguments)))
    command.start()
    printed = ""
    while not (link := re.search(r"http://\S+", printed)):
        assert command.is_alive(), printed
        time.sleep(0.05)
        printed += capsys.readouterr().err
    context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
    try:
        context.new_page().goto(link[0])
        command.join(HANG_S)
    finally:
        context.close()
    assert ended == [0]
    assert "scan_01" in capsys.readouterr().out
    with Session.open(tmp_path / "session") as store:
        shot = store.load_capture("scan_01")
        assert shot.sequence.projector == SIZE
        assert list(shot.frames[:, 0, 0]) == list(range(len(shot.sequence.frames)))


def test_a_page_that_nobody_opens_ends_the_command(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "capture",
        str(tmp_path / "session"),
        "a",
        "--rig",
        str(rig),
        "--port",
        "0",
        "--wait-s",
        "1",
    ]
    assert main(arguments) == 1
    assert not missing_facts(capsys.readouterr().err, "projector page", "1 s")
    assert not (tmp_path / "session").exists()
