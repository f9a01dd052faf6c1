"""The projector page in a real browser: pixels, words, and everything that may happen to a page in
the middle."""

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from clocks import HANG_S, until
from facts import missing_facts, raises
from playwright.sync_api import Browser, BrowserContext, Page, expect
from websockets.exceptions import ConnectionClosed

from slviewer.devices.browser import BrowserProjector, PageChannels, ProjectorChannel
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.server.device_pages import serve_device_pages
from slviewer.server.secure import SafeServer, Serving, serve

SIZE = (360, 270)
SEQUENCE = complementary(SIZE)
KINDS = [next(i for i, f in enumerate(SEQUENCE.frames) if (f.kind, f.axis) == kind) for kind in
         {(f.kind, f.axis): None for f in SEQUENCE.frames}]  # fmt: skip
ELSEWHERE = "Another window is the projector"

Opens = Callable[..., Page]


@pytest.fixture
def channel(server: SafeServer) -> Iterator[ProjectorChannel]:
    channel = ProjectorChannel(answer_s=HANG_S)
    serve_device_pages(server, PageChannels(projector=channel))
    yield channel
    server.device_pages.clear()


class Window:
    """A window of SIZE in a browser of its own, in which one test after another opens its page."""

    def __init__(self, context: BrowserContext) -> None:
        self.errors: list[str] = []
        self.is_used = False
        self._context = context
        self._page: Page | None = None

    def open(self, server: SafeServer) -> Page:
        """Open the projector page, by its link the first time."""
        self.is_used = True
        if self._page is None or self._page.is_closed():
            self._page = follow_link(self._context, server, self.errors)
        else:
            self._page.goto(f"{server.origin}{server.access.grants['project'].path}/")
        return self._page

    def leave(self) -> None:
        """Leave the page, so that nothing of it stays."""
        self.is_used = False
        self.errors.clear()
        if self._page is not None and not self._page.is_closed():
            self._page.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
            self._page.evaluate("sessionStorage.clear()")
            self._page.goto("about:blank")


def follow_link(context: BrowserContext, server: SafeServer, errors: list[str]) -> Page:
    """Open the projector page in a new window; `errors` are those of its scripts."""
    page = context.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(server.link("project"))
    page.wait_for_url("**/project-*/")  # the token does not stay in the address
    return page


@pytest.fixture(scope="module")
def usual(browser: Browser, server: SafeServer) -> Iterator[Window]:
    context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
    yield Window(context)
    context.close()


@pytest.fixture
def opens(browser: Browser, server: SafeServer, usual: Window) -> Iterator[Opens]:
    """Opens a projector page, whose screen is its window unless another one is given; only the
    first usual one is in a browser that other tests use.
    """
    contexts, errors = [], []

    def opened(
        size: tuple[int, int] = SIZE, ratio: float = 1.0, screen: tuple[int, int] | None = None
    ) -> Page:
        if (size, ratio, screen) == (SIZE, 1.0, None) and not usual.is_used:
            return usual.open(server)
        width, height = (math.ceil(side / ratio) for side in size)
        whole = {"width": screen[0], "height": screen[1]} if screen else None
        viewport = {"width": width, "height": height}
        contexts.append(
            browser.new_context(viewport=viewport, screen=whole, device_scale_factor=ratio)
        )
        return follow_link(contexts[-1], server, errors)

    yield opened
    errors += usual.errors
    if usual.is_used:
        usual.leave()
    for context in contexts:
        context.close()
    assert not errors


@pytest.fixture
def projector(channel: ProjectorChannel) -> Iterator[BrowserProjector]:
    projector = BrowserProjector(SIZE, channel)
    yield projector
    projector.close()


def seen(page: Page) -> np.ndarray:
    """(h, w, 3) device pixels of the page's window."""
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def shows(page: Page, picture: np.ndarray) -> bool:
    return np.array_equal(seen(page), np.repeat(picture[..., None], 3, axis=2))


def ready(channel: ProjectorChannel, projector: BrowserProjector) -> None:
    """Open, with the sequence loaded."""
    assert channel.wait_ready(HANG_S).state == "ready", channel.page_state()
    projector.open()
    projector.load(SEQUENCE)


def settle(page: Page) -> None:
    """Let the time be over for which a browser says how full screen is left."""
    page.wait_for_function("document.fullscreenElement !== null")
    page.evaluate("report(); settlesAt = 0; report()")


def state_has(channel: ProjectorChannel, *facts: object) -> bool:
    """Whether the message about the page's state has these facts."""
    return missing_facts(channel.page_state().words, *facts) == []


@pytest.mark.parametrize(
    "ratio", [1, 1.5, *(pytest.param(each, marks=pytest.mark.slow) for each in (1.25, 2))]
)
def test_every_pixel_of_a_pattern_is_one_pixel_of_the_screen(opens, channel, projector, ratio):
    page = opens(ratio=ratio)
    ready(channel, projector)
    for index in KINDS:
        projector.show(index)
        assert shows(page, render_pattern(SEQUENCE, index)), SEQUENCE.frames[index]
    projector.show_level(129)
    assert shows(page, np.full(SIZE[::-1], 129, np.uint8))
    projector.show(0)
    assert shows(page, render_pattern(SEQUENCE, 0)), "even light must leave the patterns loaded"


def test_frames_appear_in_the_order_in_which_they_are_asked_for(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    # what the canvas holds at each animation frame: the sum of a pattern is its fingerprint
    page.evaluate("""window.held = []; (function look() {
            const { data } = context.getImageData(0, 0, 360, 270);
            let sum = 0;
            for (let i = 0; i < data.length; i += 4) sum = (sum * 31 + data[i]) % 1000003;
            if (held.at(-1) !== sum) held.push(sum);
            requestAnimationFrame(look);
        })()""")
    # animation frames that begin between the request and its answer
    page.evaluate("""window.waited = []; let drawn = 0, requested = 0;
        (function count() { drawn += 1; requestAnimationFrame(count); })();
        link.socket.addEventListener("message", () => { requested = drawn; }, { capture: true });
        const send = link.socket.send.bind(link.socket);
        link.socket.send = (text) => {
            if (JSON.parse(text).op === "done") waited.push(drawn - requested);
            send(text);
        };
        null""")
    order = np.random.default_rng(3).permutation(len(SEQUENCE.frames))[:12]
    for index in order:
        projector.show(int(index))
    held, waited = page.evaluate("[held, waited]")

    def fingerprint(index: int) -> int:
        total = 0
        for grey in render_pattern(SEQUENCE, index).ravel().tolist():
            total = (total * 31 + grey) % 1000003
        return total

    assert held[-len(order) :] == [fingerprint(int(index)) for index in order]
    assert len(waited) == len(order) and set(waited) == {2}, (
        "the second begins once the picture is on its way"
    )


def test_pictures_of_24_bits_are_played_one_a_refresh(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    rng = np.random.default_rng(5)
    pictures = [
        (axis, rng.integers(0, 256, (SIZE[axis == "y"], 3), dtype=np.uint8)) for axis in "xyxyx"
    ]
    # the colour of the first pixel at each animation frame, until it is that of the last picture
    page.evaluate("""window.held = []; (function look() {
            held.push([...context.getImageData(0, 0, 1, 1).data].slice(0, 3).join(" "));
            requestAnimationFrame(look);
        })()""")
    projector.load_pictures(pictures)
    projector.play()
    held = page.evaluate("held")
    first = [" ".join(map(str, rgb[0])) for _, rgb in pictures]
    assert held[-1] == first[-1]
    at = held.index(first[0])
    assert held[at : at + 5] == first
    rgb = pictures[-1][1]
    assert np.array_equal(seen(page)[..., ::-1], np.broadcast_to(rgb, (SIZE[1], *rgb.shape)))
    with pytest.raises(DeviceError):
        projector.show(0)  # they took the place of the sequence
    projector.load(SEQUENCE)
    projector.show(0)
    assert shows(page, render_pattern(SEQUENCE, 0))


def test_an_image_is_shown_pixel_by_pixel(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    image = np.random.default_rng(6).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    projector.show_image(image)
    assert np.array_equal(seen(page)[..., ::-1], image)
    with pytest.raises(DeviceError):
        projector.show(0)  # it took the place of the sequence
    with pytest.raises(InputError):
        projector.show_image(image[1:])
    projector.load(SEQUENCE)
    projector.show(0)
    assert shows(page, render_pattern(SEQUENCE, 0))


def test_a_sequence_is_sent_once_and_as_profiles(opens, channel):
    size = (912, 1140)
    opens(size)
    assert channel.wait_ready(HANG_S).state == "ready"
    projector = BrowserProjector(None, channel)
    assert projector.size == size
    sequence = PatternSequence(
        size, tuple(Frame("phase", axis, k, 25, 18.0) for axis in ("x", "y") for k in range(25))
    )
    projector.open()
    with pytest.raises(DeviceError):
        projector.show(0)
    sent = []
    page = channel.page()
    real, page.send = page.send, lambda message: (sent.append(message), real(message))
    projector.load(sequence)
    (message,) = sent
    assert 25 * sum(size) < len(message) < 25 * sum(size) + 1000, (
        "one row or column of each pattern, and no picture"
    )
    sent.clear()
    projector.load(sequence)
    assert sent == []
    with pytest.raises(InputError):
        projector.load(SEQUENCE)
    with pytest.raises(InputError):
        projector.show(50)
    projector.show(49)
    assert len(sent) == 1
    projector.close()


def test_a_window_that_would_resample_is_refused_in_words(opens, channel):
    size = (402, 300)
    page = opens(size, ratio=1.25)
    projector = BrowserProjector(size, channel)
    assert until(lambda: channel.page_state().state == "refused")
    with raises(DeviceError, "402.5 x 300 px", 1.25, "scaling", "resample"):
        projector.open()
    for fact in ("402.5 x 300 px", "1.25"):
        expect(page.locator("main")).to_contain_text(fact)
    page.close()
    assert until(lambda: channel.page_state().state == "waiting")


def test_a_screen_of_another_size_is_refused_in_words(opens, channel, projector):
    page = opens((800, 600))
    assert channel.wait_ready(HANG_S).size == (800, 600)  # nobody has said yet what patterns come
    with raises(DeviceError, "800 x 600", "360 x 270", "resolution"):
        projector.open()
    for fact in ("resolution", "800 x 600", "360 x 270"):
        expect(page.locator("main")).to_contain_text(fact)
    page.set_viewport_size({"width": 360, "height": 270})
    assert channel.wait_ready(HANG_S).size == SIZE
    expect(page.locator("h1")).to_have_text("slviewer projector")
    ready(channel, projector)
    projector.show(1)
    assert shows(page, render_pattern(SEQUENCE, 1))


def test_a_click_fills_the_screen_and_leaving_it_ends_the_capture(opens, channel, projector):
    page = opens(screen=(1280, 800))
    assert until(lambda: channel.page_state().state == "refused")
    with raises(DeviceError, "fill", "screen", "F11"):
        projector.open()
    page.evaluate("window.clicksAt = performance.now()")
    page.get_by_role("button", name="Fill this screen").click()
    assert until(lambda: state_has(channel, "1280 x 800"))
    since_click, left = page.evaluate("[settlesAt - clicksAt, settlesAt - performance.now()]")
    assert left < 6000 <= since_click
    page.evaluate("settlesAt += 1e6")  # the browser's notice stays until it is looked at here
    grown = {"width": SIZE[0], "height": SIZE[1], "screenWidth": SIZE[0], "screenHeight": SIZE[1]}
    # without a display the window does not grow by itself
    session = page.context.new_cdp_session(page)
    session.send(
        "Emulation.setDeviceMetricsOverride", {**grown, "deviceScaleFactor": 1, "mobile": False}
    )
    assert until(lambda: state_has(channel, "notice", "wait"))
    settle(page)
    ready(channel, projector)
    assert page.evaluate("document.fullscreenElement !== null")
    projector.show(0)
    session.send(
        "Emulation.setDeviceMetricsOverride",
        {**grown, "height": 200, "deviceScaleFactor": 1, "mobile": False},
    )
    page.evaluate("document.exitFullscreen()")
    assert until(lambda: state_has(channel, "fill", "screen", "F11"))
    with raises(DeviceError, "fill", "screen", "F11"):
        projector.show(1)
    with raises(DeviceError, "fill", "screen", "F11"):
        projector.load(SEQUENCE)
    expect(page.get_by_role("button", name="Fill this screen")).to_be_visible()


def test_the_marker_tells_the_screen_and_its_sides(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    channel.page().request("marker")
    side = SIZE[1] / 16

    def square(turned: np.ndarray) -> float:
        """Side of the white square in the top left corner, px."""
        return float(np.argmin(turned[0, :, 1] > 127))

    picture = seen(page)
    corners = [
        square(turned) for turned in (picture, picture[:, ::-1], picture[::-1, ::-1], picture[::-1])
    ]
    assert np.allclose(corners, [4 * side, 3 * side, 2 * side, side], atol=1)
    expect(page.locator("main")).to_contain_text("360 x 270")
    projector.show_level(0)
    assert not seen(page).any()
    projector.close()
    expect(page.locator("h1")).to_be_visible()  # and again while nothing is open


def test_a_reload_ends_the_capture_and_the_next_one_is_whole(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    projector.show_level(200)
    projector.show(3)
    page.reload()
    assert channel.wait_ready(HANG_S).state == "ready"
    assert until(lambda: shows(page, np.full(SIZE[::-1], 200, np.uint8))), (
        "the light comes back by itself"
    )
    with pytest.raises(DeviceError) as lost:
        projector.show(4)
    assert not missing_facts(str(lost.value), "reloaded") or not missing_facts(
        str(lost.value), "closed"
    )
    with raises(DeviceError, "load"):
        projector.show(5)
    projector.load(SEQUENCE)
    projector.show(4)
    assert shows(page, render_pattern(SEQUENCE, 4))


def test_a_lost_connection_is_made_again_by_the_page(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    page.evaluate("link.socket.close()")
    assert until(lambda: channel.page_state().state == "waiting")
    with raises(DeviceError, "connection", "lost"):
        projector.show(0)
    assert channel.wait_ready(HANG_S).state == "ready"
    projector.close()
    ready(channel, projector)
    projector.show(2)
    assert shows(page, render_pattern(SEQUENCE, 2))


def test_a_server_that_starts_again_finds_its_page(browser, channel, tmp_path):
    server = serve(Serving(port=0, token_file=tmp_path / "tokens.toml"))
    serve_device_pages(server, PageChannels(projector=channel))
    page = browser.new_page(viewport={"width": 360, "height": 270})
    page.goto(server.link("project"))
    assert channel.wait_ready(HANG_S).state == "ready"
    server.stop()
    expect(page.locator("h1")).to_have_text("slviewer does not answer")
    assert channel.page_state().state == "waiting"
    again = serve(server.serving)
    serve_device_pages(again, PageChannels(projector=channel))
    assert channel.wait_ready(HANG_S).state == "ready"
    page.close()
    again.stop()


def test_a_page_that_is_closed_in_the_middle_is_missed_at_once(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    projector.show(0)
    page.close()
    with pytest.raises(DeviceError) as lost:
        projector.show(1)
    # hidden is the last thing that some browsers say
    assert not missing_facts(str(lost.value), "closed") or not missing_facts(
        str(lost.value), "hidden"
    )
    assert until(lambda: channel.page_state().state == "waiting")
    with raises(DeviceError, "no projector page", "link"):
        projector.load(SEQUENCE)
    projector.close()
    with raises(DeviceError, "no projector page", "link"):
        projector.open()


def test_a_page_that_hangs_is_given_up(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    # its answers are kept back until it has been given up
    page.evaluate("""window.late = [];
        link.socket.send = (text) => late.push(text);
        null""")
    channel.page().answer_s = 0.5
    with raises(DeviceError, "0.5 s"):
        projector.show(1)
    channel.page().answer_s = HANG_S
    page.wait_for_function("late.some((text) => JSON.parse(text).op === 'done')")
    page.evaluate("delete link.socket.send; for (const text of late) link.socket.send(text)")
    projector.load(SEQUENCE)
    projector.show(1)
    assert shows(page, render_pattern(SEQUENCE, 1)), (
        "an answer that came too late is not taken for the next one's"
    )


def test_a_window_that_changes_and_changes_back_still_ends_the_capture(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    projector.show(0)
    for width in (380, 360):
        page.set_viewport_size({"width": width, "height": 270})
        assert until(lambda width=width: channel.page_state().size == (width, 270))
    assert channel.wait_ready(HANG_S).state == "ready"
    with raises(DeviceError, "window", "changed"):
        projector.show(1)
    projector.load(SEQUENCE)
    projector.show(1)
    assert shows(page, render_pattern(SEQUENCE, 1))


def test_a_hidden_page_is_no_projector(opens, channel, projector):
    page = opens()
    ready(channel, projector)
    page.evaluate("""Object.defineProperty(document, "visibilityState", { value: "hidden" });
        document.dispatchEvent(new Event("visibilitychange"))""")
    assert until(lambda: channel.page_state().state == "refused")
    with raises(DeviceError, "hidden", "front"):
        projector.show(1)


def test_a_second_window_takes_over_only_when_it_is_asked_to(opens, channel, projector):
    first = opens()
    ready(channel, projector)
    second = opens()
    expect(second.locator("h1")).to_have_text(ELSEWHERE)
    projector.show(1)
    assert shows(first, render_pattern(SEQUENCE, 1)), "it must not disturb the first"
    second.get_by_role("button", name="Use this window instead").click()
    expect(first.locator("h1")).to_have_text(ELSEWHERE)
    with raises(DeviceError, "another window"):
        projector.show(2)
    settle(second)
    assert channel.wait_ready(HANG_S).state == "ready"
    projector.load(SEQUENCE)
    projector.show(2)
    assert shows(second, render_pattern(SEQUENCE, 2))
    first.reload()
    expect(first.locator("h1")).to_have_text(ELSEWHERE)
    projector.show(3)
    assert shows(second, render_pattern(SEQUENCE, 3))


def test_the_operator_is_led_to_the_page_with_its_rights_alone(
    browser, server, channel, projector_page
):
    context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
    page = context.new_page()
    page.goto(server.link())
    page.wait_for_url("**/operate-*/")
    page.goto(page.url + "projector")
    assert page.url.endswith(projector_page.path)
    assert channel.wait_ready(HANG_S).state == "ready"
    context.close()


def test_nonsense_ends_its_own_connection_only(opens, channel, projector, projector_page):
    opens()
    ready(channel, projector)
    with projector_page.open() as socket_:
        socket_.send("nonsense")
        with pytest.raises(ConnectionClosed):
            socket_.recv(HANG_S)
        assert socket_.close_code == 1008
    projector.show(0)
