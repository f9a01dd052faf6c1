"""The capture assistant: exposures chosen for scenes whose brightness is known."""

import numpy as np
import pytest
from facts import missing_facts, raises

from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import PRESETS
from slviewer.pipeline.suggest_exposure import STATES, suggest_exposure

PROJECTOR = (64, 48)
SIZE = (120, 90)
READ, SHOT, DARK = 1.0, 0.05, 4.0


class Bench:
    """A camera that sees the projector's light on a scene; ``light`` (h, w): grey levels per ms
    under white."""

    name = "the bench"
    dtype = np.dtype(np.uint8)

    def __init__(self, light, room=0.1, exposures=(0.01, 1000.0), gains=(1.0, 16.0), reports=True):
        self.light, self.room, self.exposures, self.gains, self.reports = (
            light,
            room,
            exposures,
            gains,
            reports,
        )
        self.size, self.now, self.shown, self.sequence = SIZE, CameraSettings(1.0, 1.0), None, None
        self.rng, self.applied, self.grabs = np.random.default_rng(0), [], 0
        rows, columns = np.indices(light.shape)
        self.place = rows * PROJECTOR[1] // light.shape[0], columns * PROJECTOR[0] // light.shape[1]

    def open(self):
        """Nothing is claimed."""

    close = open

    def settings(self):
        return self.now if self.reports else CameraSettings()

    def apply(self, settings):
        exposure, gain = (
            settings.exposure_ms or self.now.exposure_ms,
            settings.gain or self.now.gain,
        )
        self.now = CameraSettings(
            float(np.clip(exposure, *self.exposures)), float(np.clip(gain, *self.gains))
        )
        self.applied.append(self.now)
        return self.settings()

    def load(self, sequence):
        self.sequence = sequence

    def show(self, index):
        self.shown = render_pattern(self.sequence, index)[self.place] / 255

    def show_level(self, grey):
        self.shown = np.full(self.light.shape, (grey or 0) / 255)

    def grab(self, out):
        self.grabs += 1
        electrons = self.light * (self.room + self.shown) * self.now.exposure_ms
        noise = np.sqrt(READ + SHOT * electrons) * self.rng.standard_normal(electrons.shape)
        out[:] = np.clip(np.round((electrons + noise) * self.now.gain + DARK), 0, 255)


class Projector:
    """The bench's projector."""

    name, size = "the projector", PROJECTOR

    def __init__(self, bench):
        self.open, self.close = bench.open, bench.close
        self.load, self.show, self.show_level = bench.load, bench.show, bench.show_level


def make(light, **kinds):
    bench = Bench(np.broadcast_to(np.asarray(light, float), SIZE[::-1]).copy(), **kinds)
    return bench, Rig("bench", bench, Projector(bench))


def suggest(rig, patterns="complementary", **arguments):
    return suggest_exposure(rig, PRESETS[patterns](PROJECTOR), **arguments)


def halves(dark, bright, part=0.5):
    light = np.full(SIZE[::-1], float(bright))
    light[:, : int(part * SIZE[0])] = dark
    return light


@pytest.mark.parametrize("patterns", list(PRESETS))
@pytest.mark.parametrize("light", [2.0, 60.0, 4000.0])
def test_an_even_scene_gets_one_exposure_just_below_saturation(light, patterns):
    bench, rig = make(light)
    found = suggest(rig, patterns)
    assert len(found.exposures_ms) == 1
    peak = light * 1.1 * found.exposures_ms[0] + DARK
    assert 0.6 * 255 < peak < 255
    assert found.share > 0.999 and np.all(found.state == STATES.index("measured"))
    assert bench.settings() == CameraSettings(1.0, 1.0), "the settings are those from before"
    assert bench.grabs < 120


def test_a_part_dark_and_shiny_gets_two_exposures():
    _, rig = make(halves(2.0, 600.0))
    found = suggest(rig)
    assert len(found.exposures_ms) == 2
    short, long = found.exposures_ms
    assert 0.5 * 255 < 660 * short + DARK < 255 and 0.5 * 255 < 2.2 * long + DARK < 255
    assert found.share > 0.999 and found.share_before < 0.51
    # at 1 ms the bright half is saturated, the dark half has a modulation of one grey level
    before = found.state_before
    assert (before[:, 60:] == STATES.index("saturated")).all() and (
        before[:, :60] == STATES.index("dark")
    ).mean() > 0.9
    assert not missing_facts(found.text(), f"{short:g}", f"{long:g} ms", "100.0 %")


def test_scenes_of_any_range_are_measured_with_four_exposures_at_most():
    light = np.exp(np.random.default_rng(1).uniform(np.log(0.5), np.log(20_000), SIZE[::-1]))
    _, rig = make(light)
    found = suggest(rig)
    assert 3 <= len(found.exposures_ms) <= 4
    assert found.share > 0.9 > 0.5 > found.share_before
    # what it says is what the frames in these exposures give
    measured = np.zeros(light.shape, bool)
    for exposure in found.exposures_ms:
        peak, modulation = light * 1.1 * exposure + DARK, light * exposure / 2
        sigma = np.sqrt(READ + SHOT * light * 0.6 * exposure)
        measured |= (peak < 252) & (modulation > 4 * sigma)
    assert found.share == pytest.approx(measured.mean(), abs=0.05)


def test_shadows_do_not_count():
    light = halves(0.0, 60.0, 0.7)
    _, rig = make(light)
    found = suggest(rig)
    assert found.share > 0.999 and len(found.exposures_ms) == 1
    assert (found.state[:, :84] == STATES.index("unlit")).mean() > 0.99


def test_only_the_region_counts():
    _, rig = make(halves(2.0, 600.0))
    found = suggest(rig, region=(0, 0, 60, 90))
    assert len(found.exposures_ms) == 1 and 0.5 * 255 < 2.2 * found.exposures_ms[0] + DARK < 255
    for region in ((120, 0, 5, 5), (-1, 0, 5, 5), (0, 0, 0, 5)):
        with raises(InputError, "region", " ".join(map(str, region))):
            suggest(rig, region=region)


def test_time_limits_the_exposures_and_raises_the_gain():
    frames = len(PRESETS["complementary"](PROJECTOR).frames)
    _, rig = make(halves(0.1, 600.0))
    free = suggest(rig, budget_s=60)
    assert free.gain == 1 and free.share > 0.99 and 1.5 < free.capture_s <= 60
    bench, rig = make(halves(0.1, 600.0))
    hurried = suggest(rig, budget_s=1.0)
    assert sum(hurried.exposures_ms) * frames <= 1000 and hurried.capture_s <= 1.0
    assert hurried.gain > 1 and 0.5 <= hurried.share < free.share
    assert bench.settings() == CameraSettings(1.0, 1.0)
    with raises(DeviceError, f"{frames} frames", "0.0001 s"):
        suggest(rig, budget_s=1e-4)


def test_a_camera_of_few_exposures_and_one_without():
    _, rig = make(halves(20.0, 6000.0), exposures=(0.5, 2.0))
    found = suggest(rig)
    assert all(0.5 <= exposure <= 2.0 for exposure in found.exposures_ms)
    assert found.share == pytest.approx(0.5, abs=0.02), (
        "what is saturated at the shortest exposure is said"
    )
    _, rig = make(20.0, reports=False)
    with raises(DeviceError, "the bench", "exposure"):
        suggest(rig)


def test_a_dark_scene_says_so_and_cancelling_restores():
    bench, rig = make(0.0)
    with raises(DeviceError, "no pixel"):
        suggest(rig)
    assert bench.settings() == CameraSettings(1.0, 1.0)
    bench, rig = make(60.0)

    def stop(share, doing):
        raise KeyboardInterrupt

    with raises(KeyboardInterrupt):
        suggest(rig, progress=stop)
    assert bench.settings() == CameraSettings(1.0, 1.0)
