"""The frame of the page, as someone sees it who opens it: the step, a guest, the links, the help, a
failure."""

import re
import webbrowser
from collections.abc import Iterator
from pathlib import Path

import pytest
import zstandard
from facts import raises
from playwright.sync_api import Browser, Locator, Page, expect
from wizard_page import (
    CALM,
    PATIENCE_S,
    RIG,
    SIZE,
    Opened,
    browse,
    button,
    choose,
    click,
    expect_message,
    field,
    new_page,
    open_tab,
    wait_until,
)

from slviewer.errors import UsageError
from slviewer.gui.app import App, browser_opened, rig_choice
from slviewer.pipeline.models import save_verdict
from slviewer.pipeline.rig_choice import save_rig
from slviewer.records.verdict import Finding, Verdict
from slviewer.server.secure import Serving
from slviewer.wizard.operator import Operator


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[App]:
    """One wizard for all tests of this file."""
    with Operator(tmp_path_factory.mktemp("shell") / "session", RIG, timing=CALM) as operator:
        assert operator.wait_for(lambda s: s.rig.state == "open", PATIENCE_S) is not None
        wizard = App(operator, Serving(port=0))
        yield wizard
        wizard.close()


@pytest.fixture(scope="module")
def shared_page(browser: Browser, app: App) -> Iterator[Opened]:
    with browse(browser, app) as found:
        yield found


@pytest.fixture
def opened(shared_page: Opened) -> Opened:
    """The operator's page, which has reported no error in this test yet."""
    shared_page.errors.clear()
    return shared_page


SEES_VISER = """new MutationObserver(() => {
  window.seen ||= document.body?.innerText.includes("Dev Settings");
}).observe(document, { childList: true, subtree: true, attributes: true })"""
"""Whether the panel that viser's client shows on its own was ever seen."""


def test_no_panel_of_visers_own_is_seen_while_the_page_starts(browser: Browser, app: App) -> None:
    page = new_page(browser)
    page.add_init_script(SEES_VISER)
    page.goto(app.server.link(), wait_until="commit")
    expect(button(page, "1. Rig")).to_be_visible()
    assert not page.evaluate("window.seen")
    page.context.close()


@pytest.fixture(scope="module")
def shared_guest(browser: Browser, app: App) -> Iterator[Opened]:
    page = new_page(browser)
    found = Opened(page)
    page.goto(app.server.link("watch"))
    expect(page.get_by_text("View only")).to_be_visible()
    yield found
    page.context.close()


def test_guest_sees_same_step_and_changes_nothing(
    opened: Opened, shared_guest: Opened, app: App
) -> None:
    guest = shared_guest.page
    click(opened.page, "2. Target")
    expect(button(guest, "Use this board")).to_be_visible()
    shared_guest.send(lambda: click(guest, "1. Rig"), "GuiUpdateMessage")
    # what the operator requests after that is all that happens
    click(opened.page, "Use this board")
    expect(guest.get_by_text("In use: circles:21x16:9")).to_be_visible()
    assert app.shell.current == "target"


def test_view_keeps_most_of_the_page_in_the_theme_of_the_system(opened: Opened) -> None:
    page = opened.page
    scene = page.locator("canvas").first

    def share_of_view() -> float:
        """Return the share of the page's width that the 3D view has."""
        box = scene.bounding_box()
        assert box is not None
        return box["width"] / SIZE["width"]

    assert 0.6 <= share_of_view() < 0.7
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.locator(f"html[data-mantine-color-scheme={scheme}]").wait_for()
    fold = page.get_by_role("button", name="Collapse").last
    fold.click()
    wait_until(page, lambda: share_of_view() > 0.8)
    page.get_by_role("button", name="Expand").first.click()
    wait_until(page, lambda: share_of_view() < 0.7)


def test_live_image_is_enlarged_by_click_and_by_key(opened: Opened) -> None:
    page = opened.page
    click(page, "1. Rig")
    # the panel of before goes a moment later, and its own live image with it
    expect(button(page, "Check rig")).to_be_visible()
    expect(button(page, "Create PDF")).to_be_hidden()
    image = button(page, "Camera image")
    image.wait_for()

    def width() -> float:
        """Return the width of the live image, px."""
        box = image.bounding_box()  # None while a new picture takes its place
        return box["width"] if box else 0.0

    expect(page.get_by_text("done", exact=True)).to_be_visible()  # the rig is open: a thumbnail
    wait_until(page, lambda: 0 < width() < 0.3 * SIZE["width"])
    image.click()
    wait_until(page, lambda: width() > 0.3 * SIZE["width"])
    image.press("Enter")
    wait_until(page, lambda: 0 < width() < 0.3 * SIZE["width"])
    expect(button(page, "Check rig")).to_have_attribute("title", re.compile("10 s"))


def test_refused_rig_leaves_the_one_in_use(opened: Opened, app: App, tmp_path: Path) -> None:
    page, operator = opened.page, app.operator
    assert operator.session is not None
    camera = {"driver": "opencv", "source": str(tmp_path / "no.avi")}
    save_rig(
        operator.session,
        "gone",
        {"camera": camera, "projector": {"driver": "browser", "size": [640, 480]}},
    )
    assert operator.set_hands_free(False)  # anything that has the session read anew
    click(page, "1. Rig")
    latest = 0
    for _ in range(2):  # it can be tried again
        choose(page, "Rig", "gone")
        refused = operator.wait_for(
            lambda s, n=latest: any("no.avi" in e.text and e.number > n for e in s.notices),
            PATIENCE_S,
        )  # type: ignore[misc]
        assert refused is not None
        latest = refused.notices[-1].number
        expect(page.get_by_text("no.avi").first).to_be_visible()
        expect(field(page, "Rig")).to_have_value("Simulated, quarter size")
    assert operator.snapshot().rig.state == "open"


@pytest.mark.slow
def test_camera_password_is_sent_to_operators_only(
    opened: Opened, shared_guest: Opened, caplog: pytest.LogCaptureFixture
) -> None:
    page, guest = opened.page, shared_guest.page
    received: list[bytes | str] = []
    guest.on(
        "websocket", lambda socket: socket.on("framereceived", lambda frame: received.append(frame))
    )
    guest.reload()
    expect(guest.get_by_text("View only")).to_be_visible()
    click(page, "1. Rig")
    choose(page, "Rig", "Custom …")
    opened.enter("Camera ID", "rtsp://admin:hunter2@127.0.0.1:9/stream")
    click(page, "Use these devices")
    expect(page.get_by_text("127.0.0.1/stream").first).to_be_visible()
    page.reload()
    expect(field(page, "Camera ID")).to_have_value("rtsp://admin:hunter2@127.0.0.1:9/stream")
    guest.reload()
    expect_message(guest, "127.0.0.1/stream")
    shown = "".join(field(guest, "Camera ID").input_value() + guest.content())
    messages = "".join(unpacked(frame) for frame in received)
    assert "Camera ID" in messages and "hunter2" not in shown + caplog.text + messages


def unpacked(frame: bytes | str) -> str:
    """The text of a frame that viser's server sent."""
    assert isinstance(frame, bytes)
    size = int.from_bytes(frame[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(
        frame[16 : 16 + size], int.from_bytes(frame[:8], "little")
    )
    return inner.decode("latin-1")


def test_browser_opens_one_time_link_from_private_file(
    app: App, browser: Browser, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given: list[str] = []
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(webbrowser, "get", lambda: None)
    monkeypatch.setattr(webbrowser, "open", given.append)
    page = new_page(browser)
    with browser_opened(app.server):
        wait_until(page, lambda: given)
        (address,) = given
        file = Path(address.removeprefix("file://"))
        assert file.stat().st_mode & 0o777 == 0o600 and file.parent.stat().st_mode & 0o777 == 0o700
        assert not [
            grant
            for grant in app.server.access.grants.values()
            if grant.token in address + file.read_text()
        ]
        page.goto(address)
        page.wait_for_url("**/operate-*/")
        wait_until(page, lambda: not file.exists())
    page.context.close()


def test_invalid_session_folder_is_reported(opened: Opened, tmp_path: Path) -> None:
    (tmp_path / "a file").write_text("not a session")
    page = opened.page
    click(page, "Sessions")
    page.get_by_text("Another folder", exact=True).click()
    opened.enter("Folder", str(tmp_path / "a file"))
    click(page, "Open session")
    expect(
        page.get_by_role("alert").filter(has_text="Error").filter(has_text="a file").first
    ).to_be_visible()
    assert opened.errors == []


def test_help_opens_in_another_tab(
    opened: Opened, shared_guest: Opened, app: App, browser: Browser
) -> None:
    page, operator, viewer = opened.page, app.operator, shared_guest.page

    def follow(link: Locator, heading: str) -> Page:
        """Click a link, and return the tab with the heading that it opens."""
        with page.context.expect_page() as shown:
            link.click()
        expect(shown.value.locator(":target")).to_have_text(heading)
        assert shown.value.evaluate("window.opener") is None
        return shown.value

    step_help = page.get_by_role("link", name="Help").first
    click(page, "1. Rig")
    expect(step_help).to_have_attribute("href", "help/howto/wizard.md#rig")
    follow(step_help, "Rig").close()
    click(page, "2. Target")
    expect(step_help).to_have_attribute("href", "help/howto/wizard.md#target")
    tab = follow(step_help, "Target")

    tab.get_by_role("link", name="Warnings and findings").first.click()
    expect(tab.get_by_role("heading", level=1)).to_have_text("Warnings and findings")
    tab.get_by_role("link", name="exposures").first.click()
    expect(tab.get_by_role("heading", level=1)).to_have_text("Choosing exposures")
    address = tab.url
    tab.close()

    save_verdict(
        operator.session,
        Verdict.of([Finding("moved", "rejected", "pose_03 moved", "hold it still")]),
        (),
    )
    operator.choose_target("circles:21x16:9")
    click(page, "4. Calibrate")
    finding = page.locator("a[href$='#moved']")
    follow(finding, "Moved").close()

    viewer.locator("a[href$='#moved']").wait_for()
    with viewer.context.expect_page() as shown:
        viewer.locator("a[href$='#moved']").click()
    expect(shown.value.locator(":target")).to_have_text("Moved")

    stranger = new_page(browser)
    answer = stranger.goto(address)
    assert answer is not None and answer.status == 403 and "xposure" not in stranger.content()
    stranger.context.close()
    assert opened.errors == []


@pytest.mark.slow
def test_new_links_invalidate_old_ones(opened: Opened, shared_guest: Opened, app: App) -> None:
    page, old = opened.page, app.server.link("watch")
    guest = shared_guest.page
    expect(guest.get_by_text("View only")).to_be_visible()
    open_tab(page, "Session")
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


@pytest.mark.parametrize("text", ["simulated:half", "simulated:1,5"])
def test_rig_choice_refuses_invalid_scale(text: str) -> None:
    assert rig_choice("simulated:0.25") == {"driver": "simulated", "scale": 0.25}
    with raises(UsageError, "rig", text):
        rig_choice(text)
