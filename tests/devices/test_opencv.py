"""The opencv driver on real video files and on a real camera of the network, well and broken."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from clocks import HANG_S, until
from facts import missing_facts, raises
from mjpeg import NetworkCamera, network_camera

from slviewer.devices.capture import capture_with_texture
from slviewer.devices.drivers import driver
from slviewer.devices.opencv import OpenCVCamera, list_sysfs_webcams
from slviewer.devices.opencv_reader import StreamTiming
from slviewer.devices.protocols import (
    CameraSettings,
    ColourCamera,
    Openable,
    Rig,
    check_index,
    check_level,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.presets import gray
from slviewer.fringe.sequence import PatternSequence

SIZE = (160, 120)
FPS = 60.0
QUICK = StreamTiming(warm_up_s=0.0, ended_s=0.05)
"""These sources give no dark pictures, and one that has ended stays so."""


class Hastened:
    """The time, which passes by `step_s` more with each look."""

    step_s = 0.0

    def __init__(self) -> None:
        self._skipped_s = 0.0

    def __call__(self) -> float:
        self._skipped_s += self.step_s
        return time.monotonic() + self._skipped_s


def wait_pictures(seen: NetworkCamera, count: int) -> None:
    """Wait until a network camera has sent so many pictures more."""
    goal = seen.sent + count
    assert until(lambda: seen.sent >= goal)


def coded(number: int) -> np.ndarray:
    """A picture of eight stripes, the bits of `number`."""
    bits = [200 * (number >> bit & 1) for bit in range(8)]
    return np.repeat(np.array(bits, np.uint8), SIZE[0] // 8)[None].repeat(SIZE[1], axis=0)


def number(picture: np.ndarray) -> int:
    stripes = picture[SIZE[1] // 2, SIZE[0] // 16 :: SIZE[0] // 8] > 100
    return int(np.packbits(stripes, bitorder="little")[0])


def grabbed(camera: OpenCVCamera) -> np.ndarray:
    out = np.zeros(camera.size[::-1], np.uint8)
    camera.grab(out)
    return out


@contextmanager
def opened(camera: OpenCVCamera) -> Iterator[OpenCVCamera]:
    camera.open()
    try:
        yield camera
    finally:
        camera.close()


def video(path: Path, pictures: list[np.ndarray]) -> str:
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, pictures[0].shape[1::-1]
    )
    for picture in pictures:
        writer.write(picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    return str(path)


# a video file


def test_a_video_gives_frame_after_frame_and_says_when_it_ends(tmp_path):
    path = video(tmp_path / "film.avi", [coded(k) for k in range(6)])
    camera = driver("opencv").camera(source=path)
    assert camera.size == SIZE and camera.dtype == np.uint8 and camera.name == "the video film.avi"
    for _ in range(2):  # opened again, it starts over
        with opened(camera):
            assert [number(grabbed(camera)) for _ in range(6)] == list(range(6))
            assert camera.settings() == camera.apply(CameraSettings(5.0)) == CameraSettings()
            with raises(DeviceError, "film.avi", 6):
                grabbed(camera)
    camera.close()
    with pytest.raises(DeviceError):
        grabbed(camera)


def test_each_channel_of_a_colour_video(tmp_path):
    red, green, blue = 180, 120, 60
    picture = np.full((SIZE[1], SIZE[0], 3), (blue, green, red), np.uint8)
    path = video(tmp_path / "colour.avi", [picture] * 2)
    mean = (red + green + blue) / 3
    for channel, level in (("red", red), ("green", green), ("blue", blue), ("grey", mean)):
        with opened(OpenCVCamera(path, channel=channel)) as camera:
            assert abs(grabbed(camera).astype(float) - level).max() < 4  # JPEG's own error
            assert isinstance(camera, ColourCamera)
            np.testing.assert_allclose(camera.grab_colour()[60, 80], (red, green, blue), atol=4)
    grey = video(tmp_path / "grey.avi", [coded(5)])
    with opened(OpenCVCamera(grey)) as camera:
        colours = camera.grab_colour().astype(int)
        assert colours.shape == (120, 160, 3) and np.ptp(colours, axis=2).max() < 3


# a camera of the network


def test_no_grab_returns_an_older_picture():
    rng = np.random.default_rng(1)
    passed = []  # pictures that were sent during a grab
    with (
        network_camera(coded(0), FPS) as seen,
        opened(OpenCVCamera(seen.url, SIZE, timing=QUICK)) as camera,
    ):
        for k in range(1, 13):
            wait_pictures(seen, 24 if k == 8 else int(rng.integers(3)))  # for a while nobody asks
            seen.picture = coded(k)
            asked = seen.sent
            assert number(grabbed(camera)) == k
            passed.append(seen.sent - asked)
    assert 2 <= np.median(passed) < 8  # two whole frame periods at least, and little more


def test_pictures_that_come_in_clumps_are_never_taken_for_new_ones():
    rng = np.random.default_rng(2)
    with (
        network_camera(coded(0), FPS, clump=3) as seen,
        opened(OpenCVCamera(seen.url, SIZE, timing=QUICK)) as camera,
    ):
        for k in range(1, 6):
            wait_pictures(seen, int(rng.integers(4)))
            seen.picture = coded(k)
            assert number(grabbed(camera)) == k


class Painter(Openable):
    """A projector whose light is what the network camera sees: the number of the pattern, 255 for
    even light."""

    size = (16, 8)

    def __init__(self, seen) -> None:
        super().__init__("the painter")
        self._seen, self._sequence = seen, None

    def load(self, sequence: PatternSequence) -> None:
        self._sequence = sequence

    def show(self, index: int) -> None:
        check_index(self, self._sequence, index)
        self._seen.picture = coded(index)

    def show_level(self, grey: int | None) -> None:
        self._seen.picture = coded(check_level(grey))


def test_every_frame_of_a_capture_is_of_its_pattern():
    sequence = gray(Painter.size)
    with network_camera(coded(255), FPS) as seen:
        rig = Rig("painted", OpenCVCamera(seen.url, SIZE, timing=QUICK), Painter(seen))
        with rig.opened():
            taken = capture_with_texture(rig, sequence)
            assert [number(frame) for frame in taken.frames] == list(range(len(sequence.frames)))
            assert number(taken.texture[..., 0]) == 255 and taken.settings == CameraSettings()


def test_a_stream_says_that_its_settings_are_its_own():
    with (
        network_camera(coded(1), FPS) as seen,
        opened(OpenCVCamera(seen.url, SIZE, exposure_ms=5.0, timing=QUICK)) as camera,
    ):
        (note,) = camera.notes
        assert "secret" not in note + camera.name and not missing_facts(
            camera.name, "127.0.0.1/video"
        )
        assert not missing_facts(note, "exposure")


def test_a_stream_that_stalls_is_told_and_comes_back():
    clock = Hastened()
    timing = StreamTiming(warm_up_s=0.0, clock=clock)
    with (
        network_camera(coded(1), FPS) as seen,
        opened(OpenCVCamera(seen.url, SIZE, timing=timing)) as camera,
    ):
        seen.going.clear()
        asked, clock.step_s = clock(), 1.0
        with raises(DeviceError, "127.0.0.1/video"):
            grabbed(camera)
        assert 1.0 < clock() - asked < HANG_S
        asked = time.monotonic()
        with pytest.raises(DeviceError):
            camera.settings() and grabbed(camera)
        camera.close()
        assert time.monotonic() - asked < HANG_S
        seen.going.set()
        seen.picture, clock.step_s = coded(7), 0.0
        camera.open()
        assert number(grabbed(camera)) == 7


def test_a_camera_that_is_gone_is_told_and_works_once_it_is_back():
    with network_camera(coded(1), FPS) as seen:
        camera = OpenCVCamera(seen.url, SIZE, timing=QUICK)
        camera.open()
        port = seen.port
    asked = time.monotonic()
    with pytest.raises(DeviceError):
        grabbed(camera)
    assert time.monotonic() - asked < HANG_S
    camera.close()
    with pytest.raises(DeviceError):
        camera.open()
    with network_camera(coded(3), FPS, port=port):
        with opened(camera):
            assert number(grabbed(camera)) == 3
        camera.close()  # again: nothing happens


def test_another_size_is_told():
    with network_camera(coded(1), FPS) as seen, raises(DeviceError, "160 x 120", "320 x 240"):
        OpenCVCamera(seen.url, (320, 240), timing=QUICK).open()


# what does not answer


def test_what_does_not_answer_is_told_within_seconds_and_in_one_sentence(tmp_path):
    text = tmp_path / "notes.avi"
    text.write_text("no video")
    with socket.socket() as mute:  # it accepts, and says nothing
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        for source, facts in (
            (63, ("camera 63", "answer", "cable")),
            ("/dev/video63", ("camera /dev/video63", "answer")),
            (str(tmp_path / "none.avi"), ("none.avi", "exist")),
            (str(text), ("notes.avi", "MJPEG")),
            ("http://127.0.0.1:9/video", ("stream 127.0.0.1/video", "answer")),
            ("rtsp://127.0.0.1:9/", ("stream 127.0.0.1", "answer")),
            (f"http://127.0.0.1:{mute.getsockname()[1]}/", ("stream 127.0.0.1", "answer")),
        ):
            begun = time.monotonic()
            with raises(DeviceError, *facts):
                OpenCVCamera(source, timing=StreamTiming(patience_s=0.2))
            assert time.monotonic() - begun < HANG_S, source
    camera = OpenCVCamera("63", SIZE)  # with its size given, it may be plugged in later
    with raises(DeviceError, "camera 63"):
        camera.open()
    camera.close()


@pytest.mark.process
def test_the_libraries_keep_quiet(tmp_path):
    script = (
        "from slviewer.devices.opencv import OpenCVCamera\n"
        "from slviewer.errors import DeviceError\n"
        "for source in (63, 'http://127.0.0.1:9/', 'no.avi'):\n"
        "    try: OpenCVCamera(source)\n"
        "    except DeviceError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=True
    )
    assert done.stdout.count("\n") == 3 and done.stderr == ""


@pytest.mark.parametrize(
    "options",
    [
        {"source": -1},
        {"source": 1.5},
        {"size": (640,)},
        {"size": (640, 0)},
        {"channel": "infrared"},
        {"exposure_ms": 0.0},
        {"gain": float("nan")},
    ],
)
def test_options_that_cannot_be_are_refused(options):
    with pytest.raises(InputError):
        OpenCVCamera(**options)


def test_webcams_are_listed_by_their_names(tmp_path):
    for node, index, name in (
        ("video0", 0, "HD Webcam"),
        ("video1", 1, "HD Webcam"),
        ("video10", 0, "Arducam"),
    ):
        (tmp_path / node).mkdir()
        (tmp_path / node / "index").write_text(f"{index}\n")
        (tmp_path / node / "name").write_text(f"{name}\n")
    lines = list_sysfs_webcams(tmp_path)
    assert [line.split(",")[0] for line in lines] == ["source 0: HD Webcam", "source 10: Arducam"]
    assert list_sysfs_webcams(tmp_path / "none") == [] and isinstance(
        driver("opencv").list_connected(), list
    )


class _OneAtATime(NetworkCamera):
    """A camera that serves nobody else while somebody looks, as webcams do."""

    busy = False

    def verify_request(self, *_: object) -> bool:
        return not self.busy

    def finish_request(self, *who: object) -> None:
        self.busy = True
        try:
            super().finish_request(*who)  # type: ignore[arg-type]
        finally:
            self.busy = False


def test_a_camera_in_use_is_chosen_once_more_and_taken_over():
    server = _OneAtATime(np.full(SIZE[::-1], 100, np.uint8), FPS)
    try:
        first = OpenCVCamera(server.url, timing=QUICK)
        assert until(lambda: not server.busy)
        with opened(first):
            second = OpenCVCamera(server.url, timing=QUICK)
            assert second.size == SIZE
            with pytest.raises(DeviceError):
                second.open()
            assert OpenCVCamera(server.url, timing=QUICK).size == SIZE  # the first one has it still
        assert until(lambda: not server.busy)
        with opened(second):
            assert abs(int(grabbed(second).mean()) - 100) < 5
        server.die()
        with pytest.raises(DeviceError):
            OpenCVCamera(server.url, timing=QUICK)
    finally:
        if not server.dead:
            server.die()
