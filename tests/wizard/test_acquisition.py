"""The devices' thread: previews, captures that are whole or absent, and devices that fail and come back."""

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from faulty_rig import Faults, breakable

from slviewer.devices.capture import CapturedFrames
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import DeviceError, SessionError
from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import PatternSequence
from slviewer.simulation.rig import letter
from slviewer.wizard import acquisition as module
from slviewer.wizard.acquisition import Acquisition, CaptureRequest
from slviewer.wizard.jobs import Jobs
from slviewer.wizard.notices import Notices

WORLD = SimulatedWorld(letter(0.1))
SEQUENCE = complementary(WORLD.rig.projector.size)
FRAMES = len(SEQUENCE.frames)


class Bench:
    """An acquisition on a small simulated rig that can be broken, and what it gave."""

    def __init__(self) -> None:
        self.notices = Notices(lambda: None)
        self.previews: list[np.ndarray] = []
        self.saved: list[tuple[str, np.ndarray, CameraSettings]] = []
        self.acquisition = Acquisition(self.notices, lambda: None, lambda frame, _: self.previews.append(frame))
        self.rig: Rig
        self.faults: Faults
        self.rig, self.faults = breakable(simulated_rig(WORLD))

    def open(self) -> None:
        self.acquisition.use(self.rig)
        self.until(lambda: self.acquisition.view().state == "open")

    def request(self, name: str, sequence: PatternSequence = SEQUENCE) -> CaptureRequest:
        return CaptureRequest(
            name,
            sequence,
            lambda taken: self.saved.append((name, taken.frames.copy(), taken.settings)),
            lambda: None,
        )

    def until(self, condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, "it took too long"
            time.sleep(0.005)

    def previews_go_on(self) -> None:
        seen = len(self.previews)
        self.until(lambda: len(self.previews) > seen + 1)

    @property
    def texts(self) -> list[str]:
        return [notice.text for notice in self.notices.all()]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(module, "RETRY_S", 0.1)
    monkeypatch.setattr(module, "PREVIEWS_PER_S", 50.0)
    bench = Bench()
    yield bench
    bench.acquisition.close()


def test_previews_and_captures(bench: Bench) -> None:
    with pytest.raises(DeviceError, match="rig"):
        bench.acquisition.capture(bench.request("too early"))
    bench.open()
    view = bench.acquisition.view()
    assert (view.camera, view.projector, view.exposure_ms) == ((160, 120), (912, 1140), 1.0)
    bench.previews_go_on()
    assert bench.previews[0] is not bench.previews[1] and bench.previews[-1].mean() > 30
    for name in ("one", "two"):
        bench.acquisition.capture(bench.request(name))
    bench.until(lambda: bench.acquisition.idle)
    assert [name for name, _, _ in bench.saved] == ["one", "two"]
    assert bench.saved[0][1].shape == (FRAMES, 120, 160) and bench.saved[0][2].exposure_ms == 1.0
    bench.previews_go_on()


def test_exposure_and_light_take_effect(bench: Bench) -> None:
    bench.open()
    bench.previews_go_on()
    bright = bench.previews[-1].mean()
    bench.acquisition.set_camera(CameraSettings(0.5))
    bench.until(lambda: bench.acquisition.view().exposure_ms == 0.5)
    bench.previews_go_on()
    assert bench.previews[-1].mean() == pytest.approx(bright / 2, rel=0.1)
    bench.acquisition.set_light("dark")
    bench.until(lambda: bench.previews[-1].mean() < 0.2 * bright)
    bench.acquisition.set_camera(CameraSettings(1e5))
    bench.until(lambda: bench.acquisition.view().exposure_ms == 100.0)  # what the camera really took


@pytest.mark.parametrize("fault", ["timeout", "unplugged", "projector"])
@pytest.mark.parametrize("frame", [0, 17, FRAMES - 1])
def test_a_fault_ends_one_capture_and_nothing_else(bench: Bench, fault, frame: int) -> None:
    bench.open()
    bench.faults.plan(fault, frame)
    bench.acquisition.capture(bench.request("broken"))
    bench.acquisition.capture(bench.request("waiting"))
    bench.until(lambda: len(bench.texts) >= 2)
    assert f"frame {frame + 1} of {FRAMES}, and its frames were discarded" in bench.texts[0]
    assert "1 waiting capture dropped" in bench.texts[0] and bench.texts[1] == "the rig answers again"
    assert bench.saved == [] and bench.acquisition.idle
    bench.previews_go_on()
    bench.acquisition.capture(bench.request("after"))
    bench.until(lambda: bench.acquisition.idle)
    assert [name for name, _, _ in bench.saved] == ["after"] and bench.acquisition.view().fault == ""


def test_devices_that_do_not_open_are_tried_again_and_told_of_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    def refuse() -> None:
        tries.append(time.monotonic())
        raise DeviceError("the camera is not there: plug it in")

    monkeypatch.setattr(bench.rig.camera, "open", refuse)
    bench.acquisition.use(bench.rig)
    bench.until(lambda: len(tries) >= 3)
    assert bench.acquisition.view().state == "lost" and bench.texts == ["the camera is not there: plug it in"]
    assert min(np.diff(tries)) > 0.08
    with pytest.raises(DeviceError):
        bench.acquisition.capture(bench.request("in vain"))
    monkeypatch.undo()
    bench.until(lambda: bench.acquisition.view().state == "open")


def test_a_disk_that_refuses_loses_the_capture_but_not_the_rig(bench: Bench) -> None:
    def save(taken: CapturedFrames) -> None:
        raise SessionError("the disk is full: free some space")

    bench.open()
    followed: list[bool] = []
    bench.acquisition.capture(CaptureRequest("pose_01", SEQUENCE, save, lambda: followed.append(True)))
    bench.until(lambda: bool(bench.texts))
    assert bench.texts == ["pose_01: the disk is full: free some space"] and followed == []
    assert bench.acquisition.view().state == "open"
    bench.previews_go_on()


def test_a_capture_can_be_cancelled(bench: Bench) -> None:
    bench.open()
    started = threading.Event()
    grab = bench.rig.camera.grab

    def slow(out: np.ndarray) -> None:
        started.set()
        time.sleep(0.02)
        grab(out)

    bench.rig.camera.grab = slow  # type: ignore[method-assign]
    bench.acquisition.capture(bench.request("long"))
    bench.until(lambda: (c := bench.acquisition.view().capture) is not None and c.frame > 2)
    bench.acquisition.cancel()
    bench.until(lambda: bench.acquisition.idle, 0.5)
    assert bench.saved == [] and bench.texts == ["long: cancelled"]
    bench.previews_go_on()


def test_previews_go_on_while_the_worker_is_busy(bench: Bench) -> None:
    bench.open()
    jobs = Jobs(bench.notices, lambda: None)
    end = threading.Event()
    jobs.submit("Busy", lambda report: end.wait(5))
    bench.previews_go_on()
    view = jobs.view()
    assert view is not None and view.name == "Busy"
    end.set()
    jobs.close()


def test_closing_gives_the_devices_back(bench: Bench) -> None:
    bench.open()
    bench.acquisition.use(None)
    bench.until(lambda: WORLD.shown is not None and not WORLD.shown.pattern[1].any())
    bench.rig.open()  # nobody else has it
    bench.rig.close()
    bench.open()
    bench.acquisition.close()
    assert not any(t.name == "slviewer acquisition" and t.is_alive() for t in threading.enumerate())
    bench.rig.open()
    bench.rig.close()
