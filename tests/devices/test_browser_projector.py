"""What a window must be like to show patterns, and which window is the projector (the page:
tests/server)."""

import msgspec
import pytest
from facts import missing_facts, raises

from slviewer.devices.browser import BrowserProjector, ProjectorChannel, Screen
from slviewer.devices.drivers import driver
from slviewer.errors import DeviceError, InputError

FULL_HD = Screen(1.0, (1920, 1080), (1920, 1080), (1920, 1080), True, True, True, 1.0)


def screen(**changes: object) -> Screen:
    return msgspec.structs.replace(FULL_HD, **changes)


def hello(window: str = "a", take: bool = False, shown: Screen = FULL_HD) -> bytes:
    return msgspec.json.encode({"op": "hello", "window": window, "take": take, "facts": shown})


@pytest.mark.parametrize(
    ("shown", "size"),
    [
        (FULL_HD, (1920, 1080)),
        (FULL_HD, None),
        (screen(full=False), (1920, 1080)),  # a kiosk, or F11
        (screen(box=None), (1920, 1080)),
        (screen(dpr=1.5, inner=(1280, 720), whole=(1280, 720)), (1920, 1080)),
        (screen(dpr=2.0, inner=(456, 570), whole=(456, 570), box=(912, 1140)), (912, 1140)),
        (screen(dpr=4 / 3 + 4e-8, inner=(1440, 810), whole=(1440, 810)), (1920, 1080)),
    ],
)
def test_windows_that_show_each_pixel_as_it_is(shown, size):
    assert shown.refusal(size) == ""
    assert shown.size == (size or (1920, 1080))


@pytest.mark.parametrize(
    ("shown", "size", "facts"),
    [
        (screen(visible=False), None, ("hidden", "front")),
        (screen(full=False, inner=(1920, 969)), None, ("fill", "screen", "F11")),
        (screen(pinched=1.2), None, ("magnified", "touch")),
        (screen(dpr=1.25, inner=(1537, 864)), None, ("resample", "1921.25 x 1080 px", 1.25)),
        (screen(dpr=1.1, inner=(1745, 982)), None, ("resample", "scaling", "100 %")),
        (screen(dpr=1.25, inner=(1092, 768), box=(1366, 960)), None, ("resample",)),
        (screen(dpr=2.0, inner=(960, 540)), None, ("960 x 540", "1920 x 1080", "zoom")),
        (screen(inner=(1920, 980), box=None), None, ("zoom", "100 %")),
        (FULL_HD, (912, 1140), ("1920 x 1080", "912 x 1140", "resolution")),
        (screen(settled=False), (1920, 1080), ("notice", "wait")),
        (FULL_HD, (1919, 1080), ("1919 x 1080", "exactly")),
        (FULL_HD, (3840, 2160), ("1920 x 1080", "3840 x 2160")),
    ],
)
def test_windows_that_would_spoil_patterns_are_refused_with_what_to_change(shown, size, facts):
    assert missing_facts(shown.refusal(size), *facts) == []


def test_without_a_server_the_driver_says_who_has_one():
    assert driver("browser").page and not driver("browser").missing
    with raises(DeviceError, "slviewer wizard"):
        BrowserProjector()


def test_the_size_is_the_pages_unless_it_is_given():
    channel = ProjectorChannel()
    assert BrowserProjector([912, 1140], channel).size == (912, 1140)
    with pytest.raises(DeviceError):
        BrowserProjector(page=channel)
    channel.connect(hello(), lambda message: None)
    assert BrowserProjector(page=channel).size == (1920, 1080)
    for size in ([0, 5], [5], [1.5, 2], "912x1140"):
        with pytest.raises(InputError):
            BrowserProjector(size, channel)  # type: ignore[arg-type]


def test_no_page_is_said_at_once():
    projector = BrowserProjector([912, 1140], ProjectorChannel())
    for _ in range(2):
        with pytest.raises(DeviceError):
            projector.open()
    projector.close()
    with pytest.raises(DeviceError):
        projector.show_level(255)


def test_one_window_is_the_projector_until_another_is_asked_for():
    channel, sent = ProjectorChannel(), {"first": [], "again": [], "other": []}
    assert channel.page_state().state == "waiting" and channel.page_state().size is None
    first = channel.connect(hello("a"), sent["first"].append)
    assert channel.page_state().state == "ready" and channel.page_state().size == (1920, 1080)
    assert channel.connect(hello("b"), sent["other"].append) is None and sent["other"] == []
    # reloaded, its old connection not yet gone
    again = channel.connect(hello("a"), sent["again"].append)
    assert sent["first"][-1] is None and not missing_facts(first.gone, "reloaded")
    channel.disconnect(first)
    assert channel.page() is again
    other = channel.connect(hello("b", take=True), sent["other"].append)
    assert (
        sent["again"][-1] is None
        and not missing_facts(again.gone, "another window")
        and channel.page() is other
    )
    channel.disconnect(other)
    assert channel.page_state().state == "waiting" and channel.wait_ready(0.01).state == "waiting"


def test_what_the_page_says_is_judged_by_what_is_expected():
    channel, sent = ProjectorChannel(), []
    page = channel.connect(hello(), sent.append)
    channel.set_size((912, 1140))
    assert channel.page_state().state == "refused" and not missing_facts(
        channel.page_state().words, "912 x 1140"
    )
    with raises(DeviceError, "1920 x 1080"):
        channel.page()
    told = len(sent)
    channel.set_size((912, 1140))
    assert len(sent) == told, "what is no news is not sent again"
    small = screen(inner=(912, 1140), whole=(912, 1140), box=None)
    channel.handle_message(page, msgspec.json.encode({"op": "report", "facts": small}).decode())
    assert channel.page_state().state == "ready" and channel.page_state().size == (912, 1140)
    assert len(sent) == told + 1 and page.changes == 1


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"{}",
        b"\xff",
        '{"op": "done"}',
        '{"op": "report", "facts": {}}',
        hello(),
        msgspec.json.encode(
            {"op": "report", "facts": {**msgspec.structs.asdict(FULL_HD), "dpr": 0}}
        ),
    ],
)
def test_nonsense_is_refused(message):
    channel = ProjectorChannel()
    page = channel.connect(hello(), lambda message: None)
    with pytest.raises(InputError):
        channel.handle_message(page, message)
    if message != hello():
        with pytest.raises(InputError):
            channel.connect(message, lambda message: None)
