"""The camera on a page: what it must report to be used, and what its pictures must be (the page:
tests/server)."""

import struct
import threading

import msgspec
import numpy as np
import pytest
from clocks import HANG_S
from facts import missing_facts, raises

from slviewer.devices.browser import SETTLING_MS, BrowserCamera, CameraChannel, Video
from slviewer.devices.protocols import CameraSettings
from slviewer.errors import DeviceError, InputError

VIDEO = Video((4, 3), "", "Back camera", (), 10.0, True)


def video(**changes: object) -> Video:
    return msgspec.structs.replace(VIDEO, **changes)


def hello(shown: Video = VIDEO) -> bytes:
    return msgspec.json.encode({"op": "hello", "window": "a", "take": False, "facts": shown})


class Phone:
    """A page that answers every request; `pictures` are what it sends, and `settings` what it was
    told to lock."""

    def __init__(self, channel: CameraChannel, shown: Video = VIDEO) -> None:
        self.channel, self.settings, self.settling_ms, self.asked = channel, [], [], []
        self.pictures: dict[str, bytes] = {"green": bytes(range(12)), "rgb": bytes(range(36))}
        self.why = ""
        self.page = channel.connect(hello(shown), self.receive)

    def receive(self, message: bytes | None) -> None:
        if message is None:  # another connection is the camera
            return
        size = struct.unpack("<I", message[:4])[0]
        request = msgspec.json.decode(message[4 : 4 + size])
        self.asked.append(request["op"])
        if "number" in request:
            threading.Thread(target=self.answer, args=(request,)).start()

    def answer(self, request: dict) -> None:
        content = self.pictures[request["channel"]] if request["op"] == "grab" else b""
        if request["op"] == "lock":
            self.settings.append(request["exposure_ms"])
            self.settling_ms.append(request["settling_ms"])
        done = msgspec.json.encode({"op": "done", "number": request["number"], "why": self.why})
        answer = struct.pack("<I", len(done)) + done + content if content else done.decode()
        self.channel.handle_message(self.page, answer)

    def report(self, shown: Video) -> None:
        self.channel.handle_message(
            self.page, msgspec.json.encode({"op": "report", "facts": shown}).decode()
        )


@pytest.mark.parametrize(
    ("shown", "fact"),
    [
        (video(size=None, problem="insecure"), "--tls"),
        (video(size=None, problem="NotAllowedError"), "allow"),
        (video(size=None, problem="NotReadableError"), "other programs"),
        (video(size=None, problem="AbortError"), "AbortError"),
        (video(size=None), "starting"),
        (video(visible=False), "hidden"),
    ],
)
def test_a_page_without_pictures_is_refused_with_a_remedy(shown: Video, fact: str) -> None:
    channel = CameraChannel()
    channel.connect(hello(shown), lambda _: None)
    assert channel.page_state().state == "refused" and not missing_facts(
        channel.page_state().words, fact
    )
    with pytest.raises(DeviceError):
        BrowserCamera((4, 3), page=channel).open()


def test_without_a_server_or_a_page_there_is_no_camera() -> None:
    with raises(DeviceError, "slviewer wizard"):
        BrowserCamera()
    with raises(DeviceError, "size", "unknown"):
        BrowserCamera(page=CameraChannel())
    for options in (
        {"size": [0, 5]},
        {"size": [9000, 10]},
        {"channel": "cyan"},
        {"exposure_ms": -1.0},
    ):
        with pytest.raises(InputError):
            BrowserCamera(**{"size": [4, 3], "page": CameraChannel(), **options})


def test_pictures_arrive_byte_for_byte() -> None:
    channel = CameraChannel()
    phone = Phone(channel)
    camera = BrowserCamera(exposure_ms=5.0, page=channel)
    camera.open()
    assert phone.settling_ms == [SETTLING_MS]
    out = np.zeros((3, 4), np.uint8)
    camera.grab(out)
    assert np.array_equal(out, np.arange(12).reshape(3, 4))
    assert np.array_equal(camera.grab_colour(), np.arange(36).reshape(3, 4, 3))
    assert (
        phone.settings == [5.0] and camera.settings() == CameraSettings(10.0) and camera.notes == ()
    )
    phone.report(video(automatic=("exposure", "focus"), exposure_ms=None))
    assert camera.apply(CameraSettings(20.0, 2.0)) == CameraSettings()
    assert phone.settings == [5.0, 20.0]
    assert not missing_facts(camera.notes[0], "exposure", "focus") and len(camera.notes) == 2
    camera.close()
    assert phone.asked[-1] == "stand"


def test_a_picture_that_is_none_ends_the_grab() -> None:
    channel, out = CameraChannel(answer_s=HANG_S), np.zeros((3, 4), np.uint8)
    phone = Phone(channel)
    camera = BrowserCamera(page=channel)
    camera.open()
    phone.pictures["green"] = bytes(11)
    with raises(DeviceError, "11 bytes"):
        camera.grab(out)
    phone.why = "its pictures have changed their size"
    with raises(DeviceError, phone.why):
        camera.grab(out)
    phone.report(video(size=(3, 4)))
    with raises(DeviceError, "3 x 4", "4 x 3"):
        camera.grab(out)
    phone.report(VIDEO)
    Phone(channel)  # reloaded: its settings are no longer locked
    with raises(DeviceError, "reloaded"):
        camera.grab(out)
    camera.close()
    with raises(DeviceError, "not open"):
        camera.grab(out)
    camera.open()


@pytest.mark.parametrize(
    "message",
    [b"", b"\xff" * 9, struct.pack("<I", 2**31) + b"{}", '{"op": "report"}', '{"op": "done"}', "x"],
)
def test_nonsense_is_refused(message: bytes | str) -> None:
    channel = CameraChannel()
    page = Phone(channel).page
    with pytest.raises(InputError):
        channel.handle_message(page, message)
