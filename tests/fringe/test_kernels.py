"""The kernels against the definition."""

import numpy as np
import pytest
from decode_reference import decode_reference
from fringe_scene import capture, slope, variants

from slviewer.fringe.decode import decode, pack_shifts
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.presets import complementary, gray, multifrequency, p18, phase_steps
from slviewer.fringe.sequence import PatternSequence

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)
SEQUENCES = {
    "p18": p18(PROJECTOR),
    "complementary": complementary(PROJECTOR, 4, 18.0),
    "three steps": complementary(PROJECTOR, 3, 18.0),
    "multifrequency": multifrequency(PROJECTOR),
    "heterodyne": multifrequency((400, 400), 8, (18.0, 21.0, 25.0)),
    "gray": gray(PROJECTOR),
    "gray, bits alone": PatternSequence(
        PROJECTOR, tuple(f for f in gray(PROJECTOR).frames if f.kind != "inverse")
    ),
}


def step():
    truth = slope()
    truth[30:90, 60:130] += 31.3
    return truth


def assert_same(sequence, frames, axis):
    fast, definition = decode(sequence, frames, axis), decode_reference(sequence, frames, axis)
    assert fast.phase.dtype == definition.phase.dtype == np.float32
    assert (
        fast.noise == definition.noise
        and fast.steps == definition.steps
        and fast.period_px == definition.period_px
    )
    np.testing.assert_array_equal(fast.reason, definition.reason)
    turn = np.exp(1j * (fast.wrapped.astype(np.float64) - definition.wrapped))
    if fast.steps:
        assert np.abs(np.angle(turn)).max() < 1e-5
    np.testing.assert_allclose(fast.phase, definition.phase, rtol=0, atol=1e-4)
    np.testing.assert_allclose(fast.modulation, definition.modulation, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(fast.background, definition.background, rtol=1e-5, atol=1e-4)


LIGHTS = [
    {"read": 1.0},
    {"gain": 50, "read": 3.0},
    {"defocus": 4.0, "psf": 1.5, "read": 2.0, "gamma": 2.2, "gain": 220},
    {"gain": 290, "shot": 0.05},
]


@pytest.mark.slow
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("light", variants(LIGHTS, LIGHTS[2]))
def test_on_scenes_with_a_depth_step(name, light):
    sequence = SEQUENCES[name]
    assert_same(sequence, capture(sequence, step(), **light), "x")


@pytest.mark.parametrize("name", SEQUENCES)
def test_on_random_and_flat_frames(name):
    sequence = SEQUENCES[name]
    rng = np.random.default_rng(2)
    n = len(sequence.frames)
    assert_same(sequence, rng.integers(0, 256, (n, 23, 31)).astype(np.uint8), "x")
    assert_same(sequence, np.zeros((n, 5, 7), np.uint8), "x")
    assert_same(sequence, np.full((n, 3, 1), 255, np.uint8), "y")


# another type of frames: each kernel is compiled for it too
@pytest.mark.parametrize("name", variants(SEQUENCES))
def test_on_random_frames_of_more_bits(name):
    """The kernels are compiled for uint16 as well."""
    sequence = SEQUENCES[name]
    frames = (
        np.random.default_rng(2).integers(0, 4096, (len(sequence.frames), 23, 31)).astype(np.uint16)
    )
    assert_same(sequence, frames, "y")


@pytest.mark.slow
def test_on_frames_that_are_no_contiguous_array():
    sequence = SEQUENCES["complementary"]
    assert_same(sequence, capture(sequence, step())[:, :, ::2], "x")


@pytest.mark.parametrize("n", range(3, 25))
def test_sums_of_four_frames_at_a_time_are_those_of_each(n):
    levels = np.random.default_rng(n).integers(0, 256, n)
    sequence = PatternSequence(
        PROJECTOR, tuple(phase_steps("x", n, 18.0)), phase_sign=-1, relative=True
    )
    steps = pack_shifts(axis_layout(sequence, "x"))
    p, q, r, s = levels[steps.frames].T
    angle = 2 * np.pi * np.arange(n) / n
    assert steps.cosines @ (p - r - q + s) == pytest.approx(np.cos(angle) @ levels, abs=1e-3)
    assert steps.sines @ (p - r + q - s) == pytest.approx(-np.sin(angle) @ levels, abs=1e-3)
    assert levels[steps.frames].sum() - steps.counted[0] * levels[0] == (levels - levels[0]).sum()
