"""Scanning live on a small simulated rig: clouds as a capture gives them, the newest first, and an
end in any case."""

import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from faulty_rig import FaultyRigs
from wizard_events import HANG_S, SPARING, until, wait_until_open

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.devices.protocols import CameraSettings
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import short
from slviewer.geometry import cuda_device
from slviewer.pipeline.capture_phases import decode_capture
from slviewer.pipeline.models import load_stereo
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from slviewer.wizard import acquisition, live_scan
from slviewer.wizard.acquisition import Stream
from slviewer.wizard.live_scan import LiveCloud, LiveModel
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Level

pytestmark = pytest.mark.computes

SCALE = 0.15
# what waits beside it needs the cores too
RIG = {
    "driver": "simulated",
    "scale": SCALE,
    "settle_ms": 4,
}
SETTINGS = CameraSettings(1.0, 1.0)


class Wizard:
    """A wizard over a session that is calibrated with the truth, and the live clouds that it
    made."""

    def __init__(self, folder: Path) -> None:
        rig = letter(SCALE)
        with Session.create(folder) as store:
            save_true_stereo(store, rig)
        self.rigs = FaultyRigs()
        self.clouds: list[LiveCloud] = []
        self.operator = Operator(folder, RIG, set_up=self.rigs, timing=SPARING)
        self.operator.subscribe_live(self.clouds.append)
        wait_until_open(self.operator)
        self.operator.place("object")

    def goes_on(self, more: int = 3) -> None:
        seen = len(self.clouds)
        until(lambda: len(self.clouds) >= seen + more)

    def ends(self) -> None:
        assert self.operator.wait_for(lambda s: s.live is None, HANG_S)

    def reports(self, level: Level, *facts: object) -> bool:
        """Whether a notice of this level comes, or has come, that states these facts."""
        shown = self.operator.wait_for(
            lambda s: any(
                n.level == level and not missing_facts(n.text, *facts) for n in s.notices
            ),
            HANG_S,
        )
        return shown is not None


@pytest.fixture
def wizard(tmp_path: Path) -> Iterator[Wizard]:
    wizard = Wizard(tmp_path / "session")
    yield wizard
    wizard.operator.close()


def test_slow_clouds_have_a_rate_too() -> None:
    events = deque((time_s, 0.0) for time_s in (0.0, 10.0, 15.0, 20.0))
    assert live_scan._compute_rate(events, 21.0) == pytest.approx(0.2)
    assert live_scan._compute_rate(events, 60.0) == pytest.approx(1 / 40)  # nothing came since
    assert live_scan._compute_rate(deque([(0.0, 0.0)]), 1.0) == 0.0


@pytest.mark.slow
def test_clouds_stream_are_kept_and_give_way_to_a_capture(wizard: Wizard) -> None:
    operator = wizard.operator
    assert not operator.save_live() and wizard.reports("error", "live")
    assert operator.start_live()
    wizard.goes_on()
    for cloud in wizard.clouds:
        operator.count_live_shown(cloud)
    live = operator.wait_for(lambda s: s.live is not None and s.live.shown_per_s > 0, HANG_S)
    assert live is not None and live.live is not None
    assert live.live.points > 3000 and live.live.clouds_per_s > 0
    assert live.live.latency_ms is not None and live.live.latency_ms > 1
    numbers = [cloud.number for cloud in wizard.clouds]
    assert numbers == sorted(set(numbers))

    assert operator.save_live("a <b>face</b>")  # saved when this returns, and it goes on
    store = operator.session
    assert store is not None and store.capture_names() == ["scan_01"]
    wizard.goes_on()
    kept = store.load_capture("scan_01")
    assert len(kept.sequence.frames) == 11 and kept.sequence.axes == ("x",)
    model = load_stereo(store)
    normal = model.points(decode_capture(kept)["x"])
    points, _ = LiveModel(kept.sequence, "x", model).cloud(kept.stack())
    both = np.isfinite(points[..., 2])
    np.testing.assert_array_equal(points[both], normal[both])
    assert both.sum() > 0.97 * np.isfinite(normal[..., 2]).sum()  # nothing moved
    assert not np.isfinite(points[~np.isfinite(normal[..., 2])]).any()
    difference = wizard.clouds[-1].points[..., 2] - normal[..., 2]
    assert np.nanmedian(np.abs(difference)) < 1.0  # the same object, in light of its own

    assert operator.capture_scan()
    wizard.ends()
    after = operator.wait_until_idle()
    assert after.session is not None and after.rig.state == "open"
    assert [(s.label, s.cloud) for s in after.session.scans] == [
        ("a <b>face</b>", "fresh"),
        ("scan_02", "fresh"),
    ]


@pytest.mark.slow
def test_stopping_frees_the_devices_and_starting_again_goes_on(wizard: Wizard) -> None:
    operator = wizard.operator
    for _ in range(2):
        assert operator.start_live()
        wizard.goes_on()
        assert operator.stop_live()
        wizard.ends()
    seen = len(wizard.clouds)
    number = operator.preview().number  # type: ignore[union-attr]
    until(lambda: operator.preview().number > number + 1)  # type: ignore[union-attr]
    assert len(wizard.clouds) == seen and operator.snapshot().rig.state == "open"
    assert operator.stop_live()  # twice does no harm
    until(lambda: "slviewer live" not in {thread.name for thread in threading.enumerate()})


@pytest.mark.slow
def test_a_graphics_card_that_fails_is_named_and_the_processor_goes_on(
    wizard: Wizard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda_device, "_cached_name", ["A card"])  # there is none
    monkeypatch.setattr(cuda_device, "_wanted", [])
    monkeypatch.setattr(cuda_device, "allocate_frames", np.empty)
    monkeypatch.setattr(acquisition, "allocate_frames", np.empty)
    assert cuda_device.find_device() is None  # until it is asked for
    assert wizard.operator.use_graphics_card(True)
    assert cuda_device.find_device() == "A card"
    assert wizard.operator.start_live()
    wizard.goes_on()
    assert wizard.reports("warning", "A card", "processor")
    assert cuda_device.find_device() is None


@pytest.mark.slow
def test_a_fault_ends_it_with_a_sentence_and_what_was_kept_stays(wizard: Wizard) -> None:
    operator = wizard.operator
    assert operator.start_live()
    wizard.goes_on()
    assert operator.save_live()
    wizard.rigs.faults.plan("unplugged", 4)
    assert wizard.reports("error", "the camera does not answer")
    wizard.ends()
    assert wizard.reports("good", "the rig")
    wait_until_open(operator)
    assert operator.session is not None and operator.session.capture_names() == ["scan_01"]
    assert operator.start_live()
    wizard.goes_on(1)


def test_whoever_reads_late_gets_the_newest_and_slows_nobody() -> None:
    world = SimulatedWorld(letter(0.1))
    sequence = short(world.rig.projector.size, "x")
    ended: list[int] = []
    stream = Stream(sequence, lambda: ended.append(1))
    with simulated_rig(world).opened() as rig:
        rig.projector.load(sequence)
        first = stream.capture(rig, SETTINGS, lambda: False)
        assert first is not None and first.shape == (120, 160)
        read = stream.wait_next()
        assert read is not None
        before = read.frames.copy()
        buffers = set()
        for _ in range(6):  # nobody reads meanwhile
            assert stream.capture(rig, SETTINGS, lambda: False) is not None
            assert stream._waiting is not None
            buffers.add(id(stream._waiting.frames))
        np.testing.assert_array_equal(read.frames, before)
        assert len(buffers) == 2 and id(read.frames) not in buffers and stream.captured == 7
        waited = stream._waiting
        assert stream.wait_next() is waited
        frames = iter([False] * 4 + [True])
        assert stream.capture(rig, SETTINGS, lambda: next(frames)) is None and stream.captured == 7
    kept = stream.copy_latest()
    assert kept is not None and waited is not None
    np.testing.assert_array_equal(kept.frames, waited.frames)
    stream.end()
    stream.end()
    assert stream.wait_next() is None and ended == [1]


@pytest.mark.slow
def test_what_moved_between_the_frames_is_masked_and_not_guessed() -> None:
    world = SimulatedWorld(letter(0.2))
    world.place("sphere")
    sequence = short(world.rig.projector.size, "x")
    frames = world.renderer(False).capture(sequence)
    late = frames.copy()
    moving = (slice(None), slice(60, 180), slice(120, 200))
    # one of the finest steps, four columns further
    late[9][moving[1:]] = np.roll(frames[9], 4, axis=1)[moving[1:]]
    phases = [decode(sequence, each, "x") for each in (frames, late)]

    class Depth:
        """What is measured is the phase itself."""

        name, axes = "depth", ("x",)

        def points(self, phase):
            return np.repeat(phase.phase[..., None], 3, axis=2)

        def sigma_z(self, phase, points):
            return points[..., 2]

    still, moved = (
        LiveModel(sequence, "x", Depth()).cloud(each)[0][..., 2] for each in (frames, late)
    )
    assert np.isfinite(still).sum() > 0.95 * phases[0].mask.sum() > 1000
    wrong = np.abs(phases[1].phase - phases[0].phase) > 0.5
    assert wrong[moving[1:]].sum() > 200
    assert np.isfinite(moved[wrong]).mean() < 0.1


@pytest.mark.slow
def test_one_pass_gives_what_decoding_and_reconstructing_give() -> None:
    world = SimulatedWorld(letter(0.15))
    world.place("object")
    sequence = short(world.rig.projector.size, "x")
    renderer, shape = world.renderer(False), (180, 240)
    low, high, ones = (
        np.zeros(shape, np.float32),
        np.full(shape, 400, np.float32),
        np.ones(shape, np.float32),
    )
    terms = [np.full(shape, value) for value in (900.0, -1.0, -9e-4, 0.1, 0.05)]
    fit = PixelFit(
        np.stack(terms), np.stack([ones] * 3), np.full(shape, 20, np.uint16), low, high, ones
    )
    model = PixelwiseModel({"x": fit}, {"x": 18.0}, {}, "x")
    measuring = LiveModel(sequence, "x", model, factor=1.5)
    clouds = []
    for seed in (1, 2):
        frames = renderer.capture(sequence, seed)
        normal = 1.5 * model.points(decode(sequence, frames, "x"))
        points, texture = measuring.cloud(frames)
        clouds.append((points, points.copy(), texture))
        both = np.isfinite(points[..., 2])
        assert both.sum() > 0.95 * np.isfinite(normal[..., 2]).sum() > 3000
        assert not np.isfinite(points[~np.isfinite(normal[..., 2])]).any()
        np.testing.assert_allclose(points[both], normal[both], rtol=1e-5)
        np.testing.assert_array_equal(texture, frames[-1])
    assert clouds[0][0] is not clouds[1][0]
    np.testing.assert_array_equal(clouds[0][0], clouds[0][1])  # the second was written elsewhere
