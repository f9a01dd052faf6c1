"""Frames that do not fit their capture are named, and sound captures are left in peace."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import capture, slope, variants

from slviewer.fringe.layout import axis_layout, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.presets import complementary, gray, gray_bits, multifrequency, p18, phase_steps
from slviewer.fringe.residual import frame_residuals
from slviewer.fringe.residual_order import (
    detect_foreign_frames,
    detect_misordered_steps,
    recover_step_order,
)
from slviewer.fringe.residual_sample import Fringe, estimate_roughness, sample_fringe
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.session.importers import procam_calibration
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

PROJECTOR = (256, 128)
COORDINATE = slope(80, 200, start=20.0)
PRESETS = {
    "p18": p18(PROJECTOR),
    "gray": gray(PROJECTOR),
    "eight": complementary(PROJECTOR, 8, 16.0),
    "five": complementary(PROJECTOR, 5, 16.0),
    "four": complementary(PROJECTOR, 4, 16.0),
    "three": complementary(PROJECTOR, 3, 16.0),
    "levels": multifrequency(PROJECTOR, 6),
}
SEQUENCES = {
    name: PatternSequence(PROJECTOR, tuple(f for f in sequence.frames if f.axis != "y"))
    for name, sequence in PRESETS.items()
}


def sampled_steps(sequence: PatternSequence, stack: np.ndarray) -> Fringe:
    """The frames of the finest period, as they are."""
    layout, white = axis_layout(sequence, "x"), white_level(sequence, stack, sequence.select("x"))
    sampled = sample_fringe(stack, layout.shifts[-1], measure_noise(layout, stack, white), white)
    assert sampled is not None
    return sampled


def step_faults(sequence: PatternSequence, stack: np.ndarray) -> dict[int, str]:
    """The faults of the finest period's frames under equal light: without an estimate of the light,
    and its time."""
    sampled = sampled_steps(sequence, stack)
    return {
        s.frame: s.fault for s in detect_misordered_steps(sampled) or detect_foreign_frames(sampled)
    }


def told(sequence: PatternSequence, stack: np.ndarray) -> dict[int, str]:
    return {s.frame: s.fault for s in frame_residuals(sequence, stack, "x").suspects}


def late(stack: np.ndarray, k: int) -> np.ndarray:
    stack = stack.copy()
    stack[k] = stack[k - 1]
    return stack


def swapped(stack: np.ndarray, k: int) -> np.ndarray:
    stack = stack.copy()
    stack[[k, k + 1]] = stack[[k + 1, k]]
    return stack


def dropped(stack: np.ndarray, k: int) -> np.ndarray:
    stack = stack.copy()
    stack[k:-1] = stack[k + 1 :]
    return stack


def brighter(stack: np.ndarray, k: int, times: float = 1.05) -> np.ndarray:
    stack = stack.copy()
    stack[k] = np.clip(np.rint(times * stack[k].astype(float)), 0, np.iinfo(stack.dtype).max)
    return stack


LIGHTS = [
    {},
    {"gamma": 2.2},
    {"defocus": 3.0},
    {"gain": 12.0, "ambient": 40.0, "shot": 0.02},
    {"gain": 300.0},
    {"shot": 0.1},
]


@pytest.mark.parametrize(
    ("name", "seed"), [("p18", 0), ("gray", 0), ("eight", 1), ("four", 2), ("levels", 0)]
)
def test_sound_captures_raise_no_suspects(name, seed):
    assert told(SEQUENCES[name], capture(SEQUENCES[name], COORDINATE, seed=seed)) == {}


def test_gamma_is_a_fault_of_three_steps_alone():
    for name, expected in (("three", {0: "gamma"}), ("four", {})):
        assert told(SEQUENCES[name], capture(SEQUENCES[name], COORDINATE, gamma=2.2)) == expected


@pytest.mark.slow
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("how", LIGHTS, ids=str)
def test_sound_captures_in_any_light_raise_no_suspects(name, how):
    expected = {0: "gamma"} if name == "three" and "gamma" in how else {}
    # in dim light, fewer pixels raise an alarm in one of eight captures
    coordinate = slope(120, 200, start=20.0)
    for seed in range(3):
        assert (
            told(SEQUENCES[name], capture(SEQUENCES[name], coordinate, seed=seed, **how))
            == expected
        )


@pytest.mark.parametrize("name", ["p18", "eight", "five", "levels"])
def test_a_misplaced_step_fits_its_hypothesis_best(name):
    sequence = SEQUENCES[name]
    stack, n = capture(sequence, COORDINATE), sequence.frames[0].steps
    first = 12 if name == "levels" else 0  # the finest period
    assert step_faults(sequence, stack) == {}
    for k in (first + 1, first + n // 2, first + n - 1):
        assert step_faults(sequence, late(stack, k)) == {k: "late"}
    for k in (first, first + n // 2 - 1):
        assert step_faults(sequence, swapped(stack, k)) == {k: "swapped"}
    assert first + n - 2 in step_faults(sequence, swapped(stack, first + n - 2))
    assert (
        step_faults(sequence, dropped(stack, first + n // 2 - 1))[first + n // 2 - 1] == "dropped"
    )
    strange = stack.copy()
    strange[first] = stack[-1]  # what was shown before
    assert step_faults(sequence, strange) == {first: "strange"}


@pytest.mark.parametrize(
    "steps", [[*range(0, 18, 2), *range(1, 18, 2)], [k // 2 + 9 * (k % 2) for k in range(18)]]
)
def test_the_order_of_all_steps_is_recovered(steps):
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, COORDINATE)
    assert recover_step_order(sampled_steps(sequence, stack)) is None
    stack[:18] = stack[steps]
    assert recover_step_order(sampled_steps(sequence, stack)) == steps


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"gamma": 2.2}, {"gain": 25.0, "shot": 0.02}], ids=str)
@pytest.mark.parametrize("name", ["p18", "eight", "five", "levels"])
def test_a_misplaced_step_is_named(name, how):
    sequence = SEQUENCES[name]
    stack = capture(sequence, COORDINATE, **how)
    n = sequence.frames[0].steps
    first = 12 if name == "levels" else 0  # the finest period
    for k in (first + 1, first + n // 2, first + n - 1):
        assert told(sequence, late(stack, k)) == {k: "late"}
    for k in (first, first + n // 2 - 1):
        assert told(sequence, swapped(stack, k)) == {k: "swapped"}
    assert first + n - 2 in told(sequence, swapped(stack, first + n - 2))
    lost = told(sequence, dropped(stack, first + n // 2 - 1))
    assert lost.get(first + n // 2 - 1) == "dropped" or (
        name == "levels" and "gamma" in how and lost
    )
    strange = stack.copy()
    strange[first] = stack[-1]  # what was shown before
    assert told(sequence, strange) == {first: "strange"}
    for lag in (1, 2) if n > 6 else ():
        behind = np.concatenate([stack[-1:].repeat(lag, 0), stack[:-lag]])
        assert told(sequence, behind)[0] == "lag"


@pytest.mark.parametrize("name", ["p18", "eight", "levels"])
@pytest.mark.parametrize(
    ("k", "times"), variants([(k, t) for k in (0, 3, 5) for t in (0.95, 1.05)], (3, 1.05))
)
def test_a_frame_that_is_lit_otherwise_is_named(name, k, times):
    sequence = SEQUENCES[name]
    here = k + 12 if name == "levels" else k  # a period longer than the view cannot tell
    found = frame_residuals(
        sequence, brighter(capture(sequence, COORDINATE, shot=0.02), here, times), "x"
    )
    assert {s.frame: s.fault for s in found.suspects} == {here: "exposure-drift"}
    assert found.frames[here].light == pytest.approx(times, abs=0.012)


def test_a_lamp_that_never_stands_still_is_told_once():
    stack = capture(SEQUENCES["p18"], COORDINATE).astype(float)
    stack *= (1 + 0.06 * np.cos(2.4 * np.arange(len(stack))))[:, None, None]
    found = frame_residuals(SEQUENCES["p18"], np.clip(stack, 0, 255).astype(np.uint8), "x")
    assert [s.fault for s in found.suspects if s.frame < 18] == ["exposure-drift"]
    assert not missing_facts(found.suspects[0].sentence, "corrected", "exposure")


def test_the_residual_is_the_noise_and_shows_who_is_wrong():
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, COORDINATE, read=1.5, shot=0.01)
    clean = frame_residuals(sequence, stack, "x")
    assert len(clean.frames) == 18 and clean.message == ""
    assert all(0.9 < f.sigmas < 1.1 and 1.2 < f.rms < 2.5 for f in clean.frames)
    assert all(abs(f.light - 1) < 0.005 for f in clean.frames)
    wrong = frame_residuals(sequence, late(stack, 6), "x").frames
    assert wrong[6].rms > 3 * np.median([f.rms for f in wrong]) and wrong[6].rms > 8


def test_three_steps_say_that_they_cannot_tell():
    sequence = SEQUENCES["three"]
    stack = capture(sequence, COORDINATE)
    found = frame_residuals(sequence, stack, "x")
    assert np.isnan(found.frames[0].sigmas)
    for k in (1, 2):
        assert told(sequence, late(stack, k)) == {k: "late"}


@pytest.mark.slow
def test_four_steps_know_that_something_is_wrong():
    sequence = SEQUENCES["four"]
    stack = capture(sequence, COORDINATE)
    for k in (1, 2, 3):
        assert told(sequence, late(stack, k)) == {k: "late"}
    assert told(sequence, swapped(stack, 1)) == {1: "swapped"}
    (either,) = frame_residuals(sequence, swapped(stack, 0), "x").suspects
    assert not missing_facts(either.sentence, "frames 1 and 2", "frames 3 and 4")
    assert told(sequence, brighter(stack, 2)) == {2: "exposure-drift"}


def test_either_of_two_pairs_of_four_steps_may_be_swapped():
    sequence = SEQUENCES["four"]
    (either,) = detect_misordered_steps(
        sampled_steps(sequence, swapped(capture(sequence, COORDINATE), 0))
    )
    assert either.fault == "swapped" and not missing_facts(
        either.sentence, "frames 1 and 2", "frames 3 and 4"
    )


def test_a_late_step_is_named_whatever_the_light():
    sequence = SEQUENCES["five"]
    assert told(sequence, late(capture(sequence, COORDINATE), 3)) == {3: "late"}


def test_a_late_or_swapped_bit_is_named():
    bits, sequence = SEQUENCES["gray"], SEQUENCES["eight"]
    assert told(bits, late(capture(bits, COORDINATE), 3)) == {3: "late"}
    assert told(sequence, swapped(capture(sequence, COORDINATE), 10)).get(10) == "swapped"


@pytest.mark.slow
def test_gray_frames_that_are_late_lost_or_swapped_are_named():
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, COORDINATE)
    # the scene lies in ten of 128 periods: bits before these are the same everywhere
    for k in (
        18,
        23,
        24,
    ):
        assert told(sequence, late(stack, k)).get(k) == "late"
    for k in (22, 23):
        assert told(sequence, swapped(stack, k)).get(k) == "swapped"


@pytest.mark.slow
def test_bits_and_inverses_must_add_up():
    sequence = SEQUENCES["gray"]
    stack = capture(sequence, COORDINATE)
    for k in (1, 2, 3, 5):
        assert told(sequence, late(stack, k)) == {k: "late"}
    assert told(sequence, swapped(stack, 2)) == {2: "swapped"}
    assert told(sequence, swapped(stack, 1)) == {1: "swapped"}
    assert told(sequence, dropped(stack, 2)) == {2: "dropped"}
    assert told(sequence, brighter(stack, 0)) == {0: "exposure-drift"}


@pytest.mark.slow
def test_it_looks_at_a_full_camera_within_a_fraction_of_a_second():
    rig = letter(1.0)
    renderer = Renderer(rig, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0]))))
    sequence = PatternSequence(rig.projector.size, p18(rig.projector.size).frames[:26])
    stack = renderer.capture(sequence)
    # a specular spot
    stack[:, 500:560, 700:760] = np.minimum(2.5 * stack[:, 500:560, 700:760].astype(float), 255)
    assert told(sequence, stack) == {}
    assert told(sequence, late(stack, 9)) == {9: "late"}
    times = []
    for _ in range(3):
        begin = time.process_time()
        frame_residuals(sequence, stack, "x")
        times.append(time.process_time() - begin)
    assert min(times) < 0.5


def test_twelve_bits_in_sixteen():
    sequence = SEQUENCES["eight"]
    stack = capture(sequence, COORDINATE).astype(np.uint16) * 16
    assert told(sequence, stack) == {}
    assert told(sequence, late(stack, 3)) == {3: "late"}


@pytest.mark.parametrize("width", [63, 64])
@pytest.mark.parametrize("highest", [255, 65535])
def test_roughness_is_the_median_of_third_differences(width: int, highest: int):
    frames = np.random.default_rng(0).integers(0, highest, (3, 5, width)).astype(np.float32)
    median = np.median(np.abs(np.diff(frames, n=3, axis=-1)))
    assert estimate_roughness(frames.reshape(3, -1), width) == median / (0.6745 * np.sqrt(20))


@pytest.mark.slow
def test_photographed_captures(real_data: Path):
    for recording in procam_calibration.LAYOUT.read(real_data / "kamino_procam_jpg90"):
        for axis in recording.sequence.axes:
            assert frame_residuals(recording.sequence, recording.frames, axis).suspects == ()
    for k in (2, 5, 8):
        assert told(recording.sequence, late(recording.frames, k)) == {k: "late"}
    folder = real_data / "slmaster_david" / "L"
    stack = np.stack(
        [cv2.imread(str(folder / f"{i}.png"), cv2.IMREAD_GRAYSCALE) for i in range(10)]
    )
    steps = [*phase_steps("x", 4, 18.0), *gray_bits("x", 5), Frame("complementary", "x")]
    david = PatternSequence((32 * 18, 32 * 18), tuple(steps), gray_origin_px=-9.0)
    assert told(david, stack) == {}
    for k in (1, 2, 3, 4):
        assert told(david, late(stack, k)) == {k: "late"}
    assert told(david, swapped(stack, 1)) == {1: "swapped"}
