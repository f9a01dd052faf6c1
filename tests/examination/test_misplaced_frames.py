"""Frames that do not fit their capture are named, and sound captures are left in peace."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import capture, slope, variants

from slviewer.examination.examine import examine
from slviewer.fringe.cosines import estimate_roughness
from slviewer.fringe.presets import complementary, gray, gray_bits, multifrequency, p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.session.importers.layouts import PROCAM_CALIBRATION
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


def told(sequence: PatternSequence, stack: np.ndarray) -> dict[int, str]:
    """The cause of each finding by the first frame that it names, -1 where it names none."""
    return {f.frames[0] if f.frames else -1: f.cause for f in examine(sequence, stack).findings}


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
def test_sound_captures_in_any_light_are_accused_of_nothing_else(name, how):
    # what decodes of dim, clipped and blurred captures decodes in spite of these
    true_of = {"gain": {"dark", "saturation"}, "defocus": {"blur"}, "gamma": {"blur", "gamma"}}
    allowed = set().union(*(true_of.get(cause, set()) for cause in how))
    coordinate = slope(120, 200, start=20.0)
    for seed in range(3):
        stack = capture(SEQUENCES[name], coordinate, seed=seed, **how)
        assert {f.cause for f in examine(SEQUENCES[name], stack).findings} <= allowed


@pytest.mark.parametrize(
    "steps", [[*range(0, 18, 2), *range(1, 18, 2)], [k // 2 + 9 * (k % 2) for k in range(18)]]
)
def test_an_order_of_all_steps_is_recovered(steps):
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, COORDINATE)
    stack[:18] = stack[steps]
    (found,) = examine(sequence, stack).findings
    assert found.cause == "step-order"
    shown = ", ".join(str(steps.index(k)) for k in range(18))
    assert not missing_facts(found.remedy, shown)


@pytest.mark.parametrize("how", variants([{}, {"gamma": 2.2}, {"gain": 25.0, "shot": 0.02}], {}))
@pytest.mark.parametrize("name", ["p18", "eight", "five", "levels"])
def test_a_misplaced_step_is_named(name, how):
    sequence = SEQUENCES[name]
    stack = capture(sequence, COORDINATE, **how)
    n = sequence.frames[0].steps
    first = 12 if name == "levels" else 0  # the finest period
    for k in (first + 1, first + n // 2, first + n - 1):
        assert told(sequence, late(stack, k)) == {k: "duplicate-frame"}
    for k in (first, first + n // 2 - 1):
        assert told(sequence, swapped(stack, k)) == {k: "frame-order"}
    strange = stack.copy()
    strange[first] = stack[-1]  # what was shown before
    assert told(sequence, strange) == {first: "duplicate-frame"}
    behind = np.concatenate([stack[-1:], stack[:-1]])
    assert told(sequence, behind) == {-1: "frame-lag"}


@pytest.mark.parametrize("name", ["p18", "eight", "levels"])
def test_a_lost_frame_is_named(name):
    sequence = SEQUENCES[name]
    k = len(sequence.frames) // 2
    lost = told(sequence, dropped(capture(sequence, COORDINATE), k))
    assert list(lost.values()) == ["missing-frame"] and abs(next(iter(lost)) - k) <= 1


@pytest.mark.parametrize("name", ["p18", "eight", "levels"])
@pytest.mark.parametrize(
    ("k", "times"), variants([(k, t) for k in (0, 3, 5) for t in (0.95, 1.05)], (3, 1.05))
)
def test_a_frame_that_is_lit_otherwise_is_named(name, k, times):
    sequence = SEQUENCES[name]
    here = k + 12 if name == "levels" else k  # a period longer than the view cannot tell
    stack = brighter(capture(sequence, COORDINATE, shot=0.02), here, times)
    assert told(sequence, stack) == {here: "exposure-drift"}


def test_a_lamp_that_never_stands_still_is_told_once():
    stack = capture(SEQUENCES["p18"], COORDINATE).astype(float)
    stack *= (1 + 0.06 * np.cos(2.4 * np.arange(len(stack))))[:, None, None]
    found = examine(SEQUENCES["p18"], np.clip(stack, 0, 255).astype(np.uint8))
    assert [f.cause for f in found.findings] == ["exposure-drift"]
    assert 0.03 < found.light_rms < 0.06


def test_a_repeated_one_of_three_or_four_steps_is_named():
    for name in ("three", "four"):
        stack = capture(SEQUENCES[name], COORDINATE)
        for k in (1, 2):
            assert told(SEQUENCES[name], late(stack, k)) == {k: "duplicate-frame"}


def test_a_late_or_swapped_bit_is_named():
    bits, sequence = SEQUENCES["gray"], SEQUENCES["eight"]
    assert told(bits, late(capture(bits, COORDINATE), 3)) == {3: "duplicate-frame"}
    assert told(sequence, swapped(capture(sequence, COORDINATE), 10)) == {10: "frame-order"}


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
        # behind the last bits in view, a lag from there on looks the same
        assert told(sequence, late(stack, k)).get(k) in ("duplicate-frame", "frame-lag")
    for k in (22, 23):
        assert told(sequence, swapped(stack, k)).get(k) == "frame-order"


@pytest.mark.slow
def test_bits_and_inverses_must_add_up():
    sequence = SEQUENCES["gray"]
    stack = capture(sequence, COORDINATE)
    # the first pair exchanged is the same as a mirrored axis, and one axis has no direction
    for k in (2, 3, 5):
        assert told(sequence, late(stack, k)) == {k: "duplicate-frame"}
    assert told(sequence, swapped(stack, 2)) == {2: "frame-order"}
    assert told(sequence, swapped(stack, 1)) == {1: "frame-order"}
    assert told(sequence, dropped(stack, 2)) == {2: "missing-frame"}
    assert told(sequence, brighter(stack, 0)) == {}  # 5 % of one frame move no threshold


@pytest.mark.slow
def test_it_looks_at_a_full_camera_within_a_fraction_of_a_second():
    rig = letter(1.0)
    renderer = Renderer(rig, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0]))))
    sequence = PatternSequence(rig.projector.size, p18(rig.projector.size).frames[:26])
    stack = renderer.capture(sequence)
    # a specular spot
    stack[:, 500:560, 700:760] = np.minimum(2.5 * stack[:, 500:560, 700:760].astype(float), 255)
    assert told(sequence, stack) == {}
    assert told(sequence, late(stack, 9)) == {9: "duplicate-frame"}
    times = []
    for _ in range(3):
        begin = time.process_time()
        examine(sequence, stack)
        times.append(time.process_time() - begin)
    assert min(times) < 0.5


def test_twelve_bits_in_sixteen():
    sequence = SEQUENCES["eight"]
    stack = capture(sequence, COORDINATE).astype(np.uint16) * 16
    assert told(sequence, stack) == {}
    assert told(sequence, late(stack, 3)) == {3: "duplicate-frame"}


@pytest.mark.parametrize("width", [63, 64])
@pytest.mark.parametrize("highest", [255, 65535])
def test_roughness_is_the_median_of_third_differences(width: int, highest: int):
    frames = np.random.default_rng(0).integers(0, highest, (3, 5, width)).astype(np.float32)
    median = np.median(np.abs(np.diff(frames, n=3, axis=-1)))
    assert estimate_roughness(frames.reshape(3, -1), width) == median / (0.6745 * np.sqrt(20))


@pytest.mark.slow
def test_photographed_captures(real_data: Path):
    for recording in PROCAM_CALIBRATION.read(real_data / "kamino_procam_jpg90"):
        assert told(recording.sequence, recording.frames) == {}
    for k in (2, 5, 8):
        assert told(recording.sequence, late(recording.frames, k)) == {k: "duplicate-frame"}
    folder = real_data / "slmaster_david" / "L"
    stack = np.stack(
        [cv2.imread(str(folder / f"{i}.png"), cv2.IMREAD_GRAYSCALE) for i in range(10)]
    )
    steps = [*phase_steps("x", 4, 18.0), *gray_bits("x", 5), Frame("complementary", "x")]
    david = PatternSequence((32 * 18, 32 * 18), tuple(steps), gray_origin_px=-9.0)
    assert told(david, stack) == {}
    for k in (1, 2, 3, 4):
        assert told(david, late(stack, k)) == {k: "duplicate-frame"}
    # of four steps, these two exchanged are the other sign of the phase
    assert told(david, swapped(stack, 1)) in ({1: "frame-order"}, {-1: "step-order"})
