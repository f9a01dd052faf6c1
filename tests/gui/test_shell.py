"""The frame of the page, as someone sees it who opens it: the steps, one pose, a reload, a guest, a failure."""

import time
import webbrowser
from pathlib import Path

import pytest
import zstandard
from playwright.sync_api import Browser, expect
from wizard_page import SIZE, Opened, button, choose, click, field

from slviewer.errors import UsageError
from slviewer.gui.app import App, browser_opened, rig_choice
from slviewer.wizard.operator import Operator

STEPS = ("Rig", "Target", "Poses", "Calibrate", "Verify", "Scan", "Merge", "Measure", "Export")


def test_from_the_link_to_a_pose_that_a_reload_keeps(opened: Opened, operator: Operator) -> None:
    page = opened.page
    for number, title in enumerate(STEPS, 1):
        expect(button(page, f"{number}. {title}")).to_be_visible()

    click(page, "2. Target")
    click(page, "Use this board")
    expect(page.get_by_text("In use: circles:21x16:9")).to_be_visible()
    click(page, "Continue to Poses")
    expect(page.get_by_text("Board detected: 336 of 336 features")).to_be_visible()
    click(page, "Place board")
    click(page, "Capture pose")
    expect(page.get_by_text("pose_01").first).to_be_visible()
    assert operator.wait_for(lambda s: (p := s.pose("pose_01")) is not None and p.state == "good", 30.0)
    expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()

    page.reload()
    expect(page.get_by_text("1 pose, 0 scans")).to_be_visible()
    expect(button(page, "Capture pose")).to_be_visible()
    expect(page.get_by_text("good", exact=True).first).to_be_visible()
    assert opened.errors == []


def test_a_guest_sees_the_same_step_and_changes_nothing(opened: Opened, app: App, browser: Browser) -> None:
    guest = browser.new_context(viewport=SIZE).new_page()
    guest.goto(app.server.link("watch"))
    expect(guest.get_by_text("View only")).to_be_visible()
    click(opened.page, "2. Target")
    expect(button(guest, "Use this board")).to_be_visible()
    click(guest, "1. Rig")
    guest.wait_for_timeout(500)
    assert app.shell.current == "target"
    guest.context.close()


def test_new_links_end_what_the_old_ones_opened(opened: Opened, app: App, browser: Browser) -> None:
    page, old = opened.page, app.server.link("watch")
    guest = browser.new_context(viewport=SIZE).new_page()
    guest.goto(old)
    expect(guest.get_by_text("View only")).to_be_visible()
    click(page, "Links")
    expect(page.get_by_text(old)).to_be_visible()
    assert old not in guest.content()
    before = page.url
    click(page, "New links")
    page.wait_for_url(lambda url: "/operate-" in url and url != before)
    expect(button(page, "1. Rig")).to_be_visible()
    assert app.server.link("watch") != old
    guest.reload()
    expect(guest.get_by_text("no longer valid")).to_be_visible()
    guest.goto(old)
    expect(guest.get_by_text("no longer, valid")).to_be_visible()
    guest.context.close()


def test_the_password_of_a_camera_reaches_operators_alone(
    opened: Opened, app: App, browser: Browser, caplog: pytest.LogCaptureFixture
) -> None:
    page = opened.page
    received: list[bytes | str] = []
    guest = browser.new_context(viewport=SIZE).new_page()
    guest.on("websocket", lambda socket: socket.on("framereceived", lambda frame: received.append(frame)))
    guest.goto(app.server.link("watch"))
    expect(guest.get_by_text("View only")).to_be_visible()
    click(page, "1. Rig")
    choose(page, "Rig", "Custom …")
    field(page, "Camera ID").fill("rtsp://admin:hunter2@127.0.0.1:9/stream")
    page.wait_for_timeout(500)
    click(page, "Use these devices")
    expect(page.get_by_text("127.0.0.1/stream").first).to_be_visible()
    page.reload()
    expect(field(page, "Camera ID")).to_have_value("rtsp://admin:hunter2@127.0.0.1:9/stream")
    guest.reload()
    expect(guest.get_by_text("127.0.0.1/stream").first).to_be_visible()
    shown = "".join(field(guest, "Camera ID").input_value() + guest.content())
    assert "hunter2" not in shown + caplog.text + "".join(unpacked(frame) for frame in received)
    guest.context.close()


def unpacked(frame: bytes | str) -> str:
    """The text of a frame that viser's server sent."""
    assert isinstance(frame, bytes)
    size = int.from_bytes(frame[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size], int.from_bytes(frame[:8], "little"))
    return inner.decode("latin-1")


def test_the_browser_is_handed_a_one_time_link_in_a_private_file(
    app: App, browser: Browser, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[str] = []
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(webbrowser, "get", lambda: None)
    monkeypatch.setattr(webbrowser, "open", given.append)
    page = browser.new_context(viewport=SIZE).new_page()
    with browser_opened(app.server):
        while not given:
            time.sleep(0.01)
        (address,) = given
        file = Path(address.removeprefix("file://"))
        assert file.stat().st_mode & 0o777 == 0o600 and file.parent.stat().st_mode & 0o777 == 0o700
        assert not [grant for grant in app.server.access.grants.values() if grant.token in address + file.read_text()]
        page.goto(address)
        page.wait_for_url("**/operate-*/")
        end = time.monotonic() + 5
        while file.exists() and time.monotonic() < end:
            page.wait_for_timeout(50)
        assert not file.exists()
    page.context.close()


def test_what_cannot_be_done_is_said_in_words(opened: Opened, tmp_path: Path) -> None:
    (tmp_path / "a file").write_text("not a session")
    page = opened.page
    field(page, "Folder").fill(str(tmp_path / "a file"))
    click(page, "Open session")
    expect(page.get_by_text("Error", exact=True).first).to_be_visible()
    assert opened.errors == []


@pytest.mark.parametrize("text", ["simulated:half", "simulated:1,5"])
def test_a_rig_that_is_none(text: str) -> None:
    assert rig_choice("simulated:0.25") == {"driver": "simulated", "scale": 0.25}
    with pytest.raises(UsageError, match="rig"):
        rig_choice(text)
