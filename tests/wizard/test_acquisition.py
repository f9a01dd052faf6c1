"""The devices' thread: previews, captures that are whole or absent, and devices that fail and come
back."""

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from facts import missing_facts, raises
from faulty_rig import Faults, breakable
from wizard_events import HANG_S, until

from slviewer.devices.capture import CapturedFrames
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import SimulatedCamera, simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import DeviceError, SessionError
from slviewer.fringe.presets import short
from slviewer.fringe.sequence import PatternSequence
from slviewer.simulation.rig import letter
from slviewer.wizard.acquisition import Acquisition
from slviewer.wizard.jobs import Jobs, Notices
from slviewer.wizard.service import Timing
from slviewer.wizard.snapshot import CaptureProgress, Level

pytestmark = pytest.mark.computes

WORLD = SimulatedWorld(letter(0.1))
SEQUENCE = short(WORLD.rig.projector.size, "x")
FRAMES = len(SEQUENCE.frames)


class Clock:
    """A clock that the test moves, and that counts how often it was read."""

    def __init__(self) -> None:
        self.now_s, self.reads = 0.0, 0

    def __call__(self) -> float:
        self.reads += 1
        return self.now_s


class Bench:
    """An acquisition on a small simulated rig that can be broken, and what it gave."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.notices = Notices(lambda: None)
        self.previews: list[np.ndarray] = []
        self.saved: list[tuple[str, np.ndarray, CameraSettings]] = []
        self.progress: list[CaptureProgress] = []
        self.acquisition = Acquisition(
            self.notices,
            self._record_progress,
            lambda frame, *_: self.previews.append(frame),
            Timing(retry_s=0.1, previews_per_s=50.0),
            clock,
        )
        self.rig: Rig
        self.faults: Faults
        self.rig, self.faults = breakable(simulated_rig(WORLD))

    def open(self) -> None:
        self.acquisition.use(self.rig)
        until(lambda: self.acquisition.view().state == "open")

    def request(self, name: str) -> tuple[str, PatternSequence, Callable[[CapturedFrames], None]]:
        return (
            name,
            SEQUENCE,
            lambda taken: self.saved.append((name, taken.frames.copy(), taken.settings)),
        )

    def previews_go_on(self) -> None:
        seen = len(self.previews)
        until(lambda: len(self.previews) > seen + 1)

    @property
    def texts(self) -> list[str]:
        return [notice.text for notice in self.notices.all()]

    @property
    def levels(self) -> list[Level]:
        return [notice.level for notice in self.notices.all()]

    def _record_progress(self) -> None:
        """Record every state of the running capture, on the thread that changes it."""
        if (capture := self.acquisition.view().capture) is not None:
            self.progress.append(capture)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.acquisition.close()


def test_previews_and_captures(bench: Bench) -> None:
    with raises(DeviceError, "too early", "rig"):
        bench.acquisition.capture(*bench.request("too early"))
    bench.open()
    view = bench.acquisition.view()
    assert (view.camera, view.projector, view.exposure_ms) == ((160, 120), (912, 1140), 1.0)
    bench.previews_go_on()
    assert bench.previews[0] is not bench.previews[1] and bench.previews[-1].mean() > 30
    for name in ("one", "two"):
        bench.acquisition.capture(*bench.request(name))
    until(lambda: bench.acquisition.idle)
    assert [name for name, _, _ in bench.saved] == ["one", "two"]
    assert bench.saved[0][1].shape == (FRAMES, 120, 160) and bench.saved[0][2].exposure_ms == 1.0
    bench.previews_go_on()


def test_a_shutter_that_wears_is_spared() -> None:
    clock = Clock()
    bench = Bench(clock)
    bench.rig.camera.preview_s = 10.0
    bench.open()
    seen = 2  # the one that opens it, and the first of the others
    for now_s, change, more in (
        (9.9, None, 0),
        (10.1, None, 1),
        (19.9, None, 0),
        (19.9, lambda: bench.acquisition.set_light("dark"), 1),
        (19.95, lambda: bench.acquisition.set_camera(CameraSettings(2.0)), 1),
        (29.0, None, 0),
    ):
        clock.now_s, seen = now_s, seen + more
        if change:
            change()
        until(lambda: len(bench.previews) >= seen)  # noqa: B023
        reads = clock.reads
        until(lambda: clock.reads > reads + 4)  # noqa: B023
        assert len(bench.previews) == seen, now_s
    bench.acquisition.close()


def test_still_scenes_and_unseen_previews_are_not_rendered() -> None:
    clock, world = Clock(), SimulatedWorld(letter(0.1))
    bench = Bench(clock)
    bench.rig = simulated_rig(world)
    bench.open()

    def count(wait_s: float) -> int:
        """Return how many previews come in so long."""
        before, reads = len(bench.previews), clock.reads
        for _ in range(10):
            clock.now_s += wait_s / 10
            until(lambda: clock.reads > reads + 4)  # noqa: B023
            reads = clock.reads
        return len(bench.previews) - before

    count(1.0)
    assert count(60.0) == 0
    world.move(turn_deg=20.0)
    assert count(1.0) >= 1
    bench.acquisition.set_light("grey")
    assert count(1.0) >= 1
    bench.acquisition.is_followed = True  # its stillness is what hands-free capture waits for
    assert count(1.0) >= 8
    bench.acquisition.is_followed = False
    bench.rig.camera.__class__ = type("OtherCamera", (SimulatedCamera,), {"scene_state": None})
    assert count(1.0) >= 8
    bench.acquisition.is_seen = False
    count(0.1)
    assert count(4.0) <= 1
    assert 1 <= count(12.0) <= 3
    bench.acquisition.close()


def test_exposure_and_light_take_effect(bench: Bench) -> None:
    bench.open()
    bench.previews_go_on()
    bright = bench.previews[-1].mean()
    bench.acquisition.set_camera(CameraSettings(0.5))
    until(lambda: bench.acquisition.view().exposure_ms == 0.5)
    bench.previews_go_on()
    assert bench.previews[-1].mean() == pytest.approx(bright / 2, rel=0.1)
    bench.acquisition.set_light("dark")
    until(lambda: bench.previews[-1].mean() < 0.2 * bright)
    bench.acquisition.set_camera(CameraSettings(1e5))
    until(lambda: bench.acquisition.view().exposure_ms == 100.0)  # what the camera really took


@pytest.mark.parametrize("fault", ["timeout", "unplugged", "projector"])
@pytest.mark.parametrize("frame", [0, 5, FRAMES - 1])
def test_a_fault_ends_one_capture_and_nothing_else(bench: Bench, fault, frame: int) -> None:
    bench.open()
    bench.faults.plan(fault, frame)
    bench.acquisition.capture(*bench.request("broken"))
    bench.acquisition.capture(*bench.request("waiting"))
    until(lambda: len(bench.texts) >= 2)
    assert (
        missing_facts(
            bench.texts[0], f"{frame + 1} of {FRAMES}", "discarded", "1 waiting", "dropped"
        )
        == []
    )
    assert bench.levels == ["error", "good"]
    assert bench.saved == [] and bench.acquisition.idle
    bench.previews_go_on()
    bench.acquisition.capture(*bench.request("after"))
    until(lambda: bench.acquisition.idle)
    assert [name for name, _, _ in bench.saved] == [
        "after"
    ] and bench.acquisition.view().fault == ""


def test_devices_that_do_not_open_are_tried_again_and_reported_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    bench = Bench(clock)
    tries = []

    def refuse() -> None:
        tries.append(clock.now_s)
        raise DeviceError("the camera is not there: plug it in")

    def look_at_the_clock_again() -> None:
        reads = clock.reads
        until(lambda: clock.reads > reads + 4)

    monkeypatch.setattr(bench.rig.camera, "open", refuse)
    bench.acquisition.use(bench.rig)
    # 0.1 s after the last one
    for now_s, count in (
        (0.0, 1),
        (0.09, 1),
        (0.11, 2),
        (0.2, 2),
        (0.22, 3),
    ):
        clock.now_s = now_s
        until(lambda count=count: len(tries) >= count)
        look_at_the_clock_again()
        assert len(tries) == count
    assert bench.acquisition.view().state == "lost" and bench.texts == [
        "the camera is not there: plug it in"
    ]
    with raises(DeviceError, "in vain"):
        bench.acquisition.capture(*bench.request("in vain"))
    monkeypatch.undo()
    clock.now_s = 0.33
    until(lambda: bench.acquisition.view().state == "open")
    bench.acquisition.close()


def test_a_disk_that_refuses_loses_the_capture_but_not_the_rig(bench: Bench) -> None:
    def save(taken: CapturedFrames) -> None:
        raise SessionError("the disk is full: free some space")

    bench.open()
    bench.acquisition.capture("pose_01", SEQUENCE, save)
    until(lambda: bool(bench.texts))
    assert bench.texts == ["pose_01: the disk is full: free some space"]
    assert bench.acquisition.view().state == "open"
    bench.previews_go_on()


def test_a_capture_can_be_cancelled(bench: Bench) -> None:
    bench.open()
    in_third_frame, cancelled = threading.Event(), threading.Event()
    grab, grabbed = bench.rig.camera.grab, []

    def grab_slowly(out: np.ndarray) -> None:
        if bench.acquisition.view().capture is not None:
            grabbed.append(1)
            if len(grabbed) == 3:
                in_third_frame.set()
                assert cancelled.wait(HANG_S)
        grab(out)

    bench.rig.camera.grab = grab_slowly  # type: ignore[method-assign]
    bench.acquisition.capture(*bench.request("long"))
    assert in_third_frame.wait(HANG_S)
    bench.acquisition.cancel()
    cancelled.set()
    until(lambda: bench.acquisition.idle)
    assert len(grabbed) == 3 and bench.saved == [] and bench.levels == ["info"]
    assert missing_facts(bench.texts[0], "long", "cancelled") == []
    bench.previews_go_on()


def test_previews_go_on_while_the_worker_is_busy(bench: Bench) -> None:
    bench.open()
    jobs = Jobs(bench.notices, lambda: None, lambda: None)
    end = threading.Event()
    jobs.submit("Busy", lambda report: end.wait(HANG_S))
    bench.previews_go_on()
    view = jobs.view()
    assert view is not None and view.name == "Busy"
    end.set()
    jobs.close()


def test_closing_gives_the_devices_back(bench: Bench) -> None:
    bench.open()
    bench.acquisition.use(None)
    until(lambda: WORLD.shown is not None and not WORLD.shown.pattern[1].any())
    bench.rig.open()  # nobody else has it
    bench.rig.close()
    bench.open()
    bench.acquisition.close()
    until(
        lambda: (
            not any(
                t.name == "slviewer acquisition" and t.is_alive() for t in threading.enumerate()
            )
        )
    )
    bench.rig.open()
    bench.rig.close()
