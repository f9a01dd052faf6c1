"""What is wrong with a rig is named, and a sound rig is left in peace."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from time import process_time
from typing import Any

import numpy as np
import pytest
from clocks import SteppingClock
from facts import missing_facts
from imperfect_rig import Imperfections, imperfect, resampled_rig

from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import SimulatedTurntable, simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import Cancelled
from slviewer.pipeline.examination import Preflight
from slviewer.pipeline.rig_choice import set_up
from slviewer.preflight.check_rig import check_rig, preflight
from slviewer.preflight.turntable import check_turning
from slviewer.simulation.boards import Pose
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

SCALE = 0.1


def slow(*values: object) -> Any:
    """Parameters of a test that repeats in the slow tier what another one shows."""
    return pytest.param(*values, marks=pytest.mark.slow)


def world(**how) -> SimulatedWorld:
    return SimulatedWorld(letter(SCALE, **how))


@pytest.fixture
def time() -> SteppingClock:
    return SteppingClock(step_s=0.001)


Looked = Callable[..., Preflight]
Lying = Callable[..., Rig]


@pytest.fixture
def looked(time: SteppingClock) -> Looked:
    """Checks a rig."""

    def check(rig: Rig, **how: Any) -> Preflight:
        with rig.opened():
            return preflight(rig, clock=time.clock, **how)

    return check


def wrong_with(found: Preflight) -> set[str]:
    return {check.name for check in found.checks if check.verdict in ("bad", "warning")}


@pytest.fixture
def lying(time: SteppingClock) -> Lying:
    """Makes a simulated rig with imperfections."""
    return lambda **wrong: imperfect(simulated_rig(world()), Imperfections(**wrong), time.clock)[0]


@pytest.fixture
def compiled(looked: Looked) -> None:
    """The kernels that a check uses are compiled."""
    looked(simulated_rig(world()))


@pytest.mark.parametrize("seed", [0, slow(1), slow(2)])
def test_a_sound_rig_is_left_in_peace(seed, looked, compiled):
    said: list[str] = []
    done: list[float] = []
    before = process_time()
    found = looked(
        simulated_rig(world(seed=seed)),
        say=said.append,
        progress=lambda share, doing: done.append(share),
    )
    assert wrong_with(found) == set() and found.verdict == "good"
    assert found.settle_ms == 0 and found.exposure_ms is None
    # of the processor, whatever else it does
    assert found.seconds > 0 and process_time() - before < 10
    assert len(said) == len(found.checks) == 10 and done == sorted(done) and done[-1] == 1.0
    assert all(check.observation.endswith(".") for check in found.checks)
    assert found.to_json()["checks"][0]["name"] == "screen"
    table = np.array(found.levels)
    assert np.abs(table - np.arange(256)).max() <= 2


def test_a_turntable_is_checked_too(looked):
    scene = world()
    found = looked(replace(simulated_rig(scene), turntable=SimulatedTurntable(scene)))
    assert found.check("turntable").verdict == found.verdict == "good" and len(found.checks) == 11
    assert abs(scene.table_deg) < 0.2 and scene.standing == "board"
    lame = SimulatedTurntable(scene)
    lame.open()
    broken = check_turning(lame)
    assert broken.verdict == "bad" and not missing_facts(broken.remedy, "close")


def test_gamma_is_measured_and_mended_by_its_table(looked):
    found = looked(simulated_rig(world(gamma=2.2)))
    assert wrong_with(found) == {"gamma"}
    figures = found.check("gamma").figures
    assert figures["gamma"] == pytest.approx(2.2, abs=0.03)
    assert 25 < figures["nonlinearity_percent"] < 33
    assert figures["phase_error_rad"]["3"] == pytest.approx(0.205, abs=0.02)
    light = (np.array(found.levels) / 255) ** 2.2
    assert np.abs(light - np.arange(256) / 255).max() < 0.015
    assert found.check("pixels").verdict == "good"


def test_latency_is_measured_and_waited_for(looked, lying):
    found = looked(lying(latency_ms=25, frame_ms=6))
    figures = found.check("latency").figures
    assert wrong_with(found) == set()
    assert 18 <= figures["latency_ms"] <= 70 and figures["latency_frames"] > 1
    assert 25 <= found.settle_ms <= 100
    assert found.settle_ms >= figures["latency_ms"]


@pytest.mark.parametrize("images", [1, slow(2)])
def test_a_camera_that_is_behind_is_named(images, looked, lying):
    found = looked(lying(lag=images))
    assert wrong_with(found) == {"latency", "order"}
    assert found.check("latency").figures["stale_images"] == images
    assert found.check("order").figures["lag"] == images


@pytest.mark.parametrize(
    ("wrong", "names", "facts"),
    [
        ({"late": {9}}, {"order"}, ("frame 10", "frame 9")),
        slow({"late": {3}}, {"order"}, ("frame 4", "frame 3")),
        ({"repeated": {9}}, {"order", "repeats"}, ("frame 10", "frame 9")),
        slow({"dropped": 10}, {"order"}, ("frame 11", "missing")),
        ({"swapped": 8}, {"order"}, ("frames 9 and 10", "places")),
    ],
)
def test_frames_out_of_order_are_named(wrong, names, facts, looked, lying):
    found = looked(lying(**wrong))
    assert wrong_with(found) == names and found.verdict == "bad"
    assert not missing_facts(found.check("order").observation, *facts)


def test_another_screen_is_named(looked, lying):
    found = looked(lying(elsewhere=True))
    assert wrong_with(found) == {"screen"} and found.verdict == "bad"
    assert found.settle_ms is None and found.levels is None
    assert not missing_facts(found.check("screen").remedy, "screen")
    assert found.check("gamma").verdict == "unknown"


@pytest.mark.parametrize(
    ("exposure_ms", "verdict"), [(2.0, "bad"), (0.3, "warning"), (0.08, "bad")]
)
def test_a_wrong_exposure_is_named_with_a_better_one(exposure_ms, verdict, time):
    rig = simulated_rig(world())
    with rig.opened():
        for _ in range(3):  # how much too bright cannot be seen at once
            rig.camera.apply(CameraSettings(exposure_ms))
            found = preflight(rig, clock=time.clock)
            assert found.check("exposure").verdict == verdict
            if found.exposure_ms is None or verdict != "bad" or exposure_ms < 1:
                break
            exposure_ms, verdict = found.exposure_ms, "good"
    if exposure_ms < 0.5:
        assert found.exposure_ms == pytest.approx(1.0, abs=0.12)
    else:
        assert found.verdict == "good"


@pytest.mark.slow
@pytest.mark.parametrize(("hertz", "exposure"), [(100.0, "10 ms"), slow(120.0, "8.33 ms")])
def test_mains_light_is_named_with_its_frequency(hertz, exposure, looked, lying):
    found = looked(lying(room=25, mains_depth=0.4, mains_hz=hertz))
    flicker = found.check("flicker")
    assert flicker.verdict == "bad" and not missing_facts(flicker.observation, "room's")
    assert not missing_facts(flicker.remedy, exposure)
    assert flicker.figures["mains_hz"] in (None, int(hertz))
    assert wrong_with(found) <= {"flicker", "exposure", "ambient"}
    assert wrong_with(looked(lying(lamp_depth=0.06))) == {"flicker"}


def test_a_bright_room_is_named(looked):
    dim = letter(SCALE)
    dim = replace(dim, light=replace(dim.light, ambient=0.6))
    assert wrong_with(looked(simulated_rig(SimulatedWorld(dim)))) == {"ambient"}


def test_a_lamp_switched_on_meanwhile_is_named(looked, time):
    rig, wrong = imperfect(simulated_rig(world()), clock=time.clock)

    def switch(sentence: str) -> None:
        wrong.room = 12.0

    found = looked(rig, say=switch)
    assert "ambient" in wrong_with(found) and not missing_facts(
        found.check("ambient").observation, "brighter"
    )
    assert "motion" not in wrong_with(found)


def test_the_camera_is_left_as_it_was():
    set_ups = []

    def remembered(choice, board):
        set_ups.append(set_up(choice, board))
        return set_ups[-1]

    check_rig({"driver": "simulated", "scale": SCALE}, exposure_ms=0.5, gain=2.0, set_up=remembered)
    camera = set_ups[0].rig.camera
    camera.open()
    assert camera.settings() == CameraSettings(1.0, 1.0)


def test_what_moves_is_named(looked):
    here = world()

    def push(sentence: str) -> None:
        if "frames are in order" in sentence:
            pose = here.pose
            here.place("board", Pose(pose.R, pose.t + np.array([3.0, 0.0, 0.0])))

    found = looked(simulated_rig(here), say=push)
    assert wrong_with(found) == {"motion"}


def test_patterns_that_are_scaled_are_named(looked):
    found = looked(resampled_rig(world(gamma=2.2), 1.1))
    assert found.check("pixels").verdict == "bad"
    assert not missing_facts(found.check("pixels").remedy, "native resolution")
    assert wrong_with(found) == {"gamma", "pixels"}


def test_it_stops_when_it_is_told_to(looked):
    def stop(share: float, doing: str) -> None:
        if share > 0.3:
            raise Cancelled("cancelled")

    rig = simulated_rig(world())
    with pytest.raises(Cancelled):
        looked(rig, progress=stop)
    assert looked(rig).verdict == "good"


class TwelveBits:
    """The simulated camera with 12 bits in 16, which cannot tell its exposure."""

    def __init__(self, camera) -> None:
        self._camera, self.name, self.size, self.dtype = (
            camera,
            camera.name,
            camera.size,
            np.dtype(np.uint16),
        )
        self.open, self.close = camera.open, camera.close
        self.settings = partial(CameraSettings)

    def apply(self, settings: CameraSettings) -> CameraSettings:
        return CameraSettings()

    def grab(self, out: np.ndarray) -> None:
        eight = np.empty(out.shape, np.uint8)
        self._camera.grab(eight)
        out[:] = eight.astype(np.uint16) * 16 + 7


def test_a_camera_of_twelve_bits_that_says_nothing_of_its_exposure(looked):
    rig = simulated_rig(world())
    found = looked(Rig("twelve", TwelveBits(rig.camera), rig.projector))
    assert wrong_with(found) == set() and found.exposure_ms is None
    assert found.check("exposure").figures["bright_share_of_full_scale"] == pytest.approx(
        0.83, abs=0.03
    )


def test_a_second_camera_is_checked_too(looked, lying, time, compiled):
    pair = simulated_rig(world(), cameras=2)
    assert pair.second is not None
    found = looked(pair)
    assert found.verdict == "good"
    alone = Rig("second", pair.second, pair.projector)
    late, _ = imperfect(alone, Imperfections(lag=1), time.clock)
    said = list[str]()
    found = looked(replace(pair, second=late.camera, projector=late.projector), say=said.append)
    assert wrong_with(found) == {"latency", "order"}
    assert found.check("order").figures["lag"] == 1
    assert all("Second camera" in found.check(name).observation for name in ("latency", "order"))
    assert sum("Second camera" in each for each in said) == len(said) / 2
