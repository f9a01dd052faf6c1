"""Frames of unequal light are measured as if the light had been equal, and the cause is named."""

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import missing_facts
from fringe_scene import capture, coverage, slope, variants, wrong

from slviewer.examination.examine import examine
from slviewer.examination.findings import describe_light
from slviewer.examination.light import estimate_frame_light
from slviewer.fringe import decode as decoding
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import complementary, gray, gray_bits, p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence

pytestmark = pytest.mark.computes

PROJECTOR = (256, 128)
TRUTH = slope(240, 320, per_px=0.5, start=20.0)


def one_axis(sequence):
    return PatternSequence(PROJECTOR, tuple(f for f in sequence.frames if f.axis in ("x", None)))


SEQUENCES = {
    "p18": one_axis(p18(PROJECTOR)),
    "four": one_axis(complementary(PROJECTOR, 4, 16.0)),
    "three": one_axis(complementary(PROJECTOR, 3, 16.0)),
}


def relit(stack, gain=1.0, offset=0.0):
    light = gain * stack.astype(float) + offset
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def gains(count, spread, seed=1):
    return np.random.default_rng(seed).uniform(1 - spread, 1, count)[:, None, None]


def decode(sequence, stack, axis):
    return decoding.decode(sequence, stack, axis, estimate_frame_light(sequence, stack))


def rms_px(phase):
    inner = np.s_[8:-8, 8:-8]
    return float(np.sqrt(np.nanmean((phase.coordinate - TRUTH)[inner] ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("name", variants(SEQUENCES, "four"))
def test_drifting_exposure_costs_nothing(name):
    sequence = SEQUENCES[name]
    stack = capture(sequence, TRUTH, shot=0.02)
    floor = rms_px(decode(sequence, stack, "x"))
    for spread in (0.1, 0.3):
        phase = decode(sequence, relit(stack, gains(len(stack), spread)), "x")
        assert wrong(phase, TRUTH) == 0 and coverage(phase) > 0.99
        assert 0.8 * floor < rms_px(phase) < 1.3 * floor


@pytest.mark.parametrize("name", variants(["p18", "three"], "three"))
def test_gains_are_those_that_were_applied(name):
    sequence = SEQUENCES[name]
    gain = gains(len(sequence.frames), 0.2)
    light = estimate_frame_light(sequence, relit(capture(sequence, TRUTH, shot=0.02), gain))
    steps = [i for i, f in enumerate(sequence.frames) if f.kind == "phase"]
    ratio = light.gain[steps] / gain[steps, 0, 0]
    assert ratio.std() / ratio.mean() < 0.004
    (found,) = describe_light(sequence, light)
    assert found.cause == "exposure-drift" and not missing_facts(found.observation, "corrected")


BEATS = PatternSequence(
    PROJECTOR, tuple(f for period in (16.8, 14.1, 11.7) for f in phase_steps("x", 3, period))
)


@pytest.mark.parametrize("change", [-0.08, 0.08])
def test_a_small_drift_is_known_by_the_steps_of_all_periods(change):
    gain = np.linspace(1, 1 + change, len(BEATS.frames))
    stack = capture(BEATS, TRUTH, shot=0.01)
    floor = rms_px(decode(BEATS, stack, "x"))
    drifting = relit(stack, 0.9 * gain[:, None, None])
    light = estimate_frame_light(BEATS, drifting)
    ends = np.log(light.gain[[0, -1]])
    assert ends[1] - ends[0] == pytest.approx(np.log(1 + change), rel=0.1)
    assert rms_px(decoding.decode(BEATS, drifting, "x")) > 1.2 * floor
    assert 0.8 * floor < rms_px(decode(BEATS, drifting, "x")) < 1.1 * floor
    (found,) = describe_light(BEATS, light)
    assert found.cause == "exposure-drift" and not missing_facts(found.observation, "corrected")


def test_gains_that_differ_at_random_are_no_drift():
    gain = gains(len(BEATS.frames), 0.015, seed=3)
    light = estimate_frame_light(BEATS, relit(capture(BEATS, TRUTH, shot=0.01), 0.9 * gain))
    assert light.terms == ()


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("gamma", variants([1.0, 2.2], 2.2))
def test_a_steady_capture_is_left_as_it_is(name, gamma):
    sequence = SEQUENCES[name]
    light = estimate_frame_light(sequence, capture(sequence, TRUTH, shot=0.02, gamma=gamma))
    assert not light.is_significant and not [*describe_light(sequence, light)]


TONED = {
    "gray": one_axis(gray(PROJECTOR)),
    "four": SEQUENCES["four"],
    "wide": PatternSequence(PROJECTOR, tuple(phase_steps("x", 4, 256.0))),
}


def seen_by_an_ordinary_camera(sequence, gain=1.0, per_px=0.9):
    """Sharp stripes, blurred by the lens, lit by ``gain`` (n,), through a tone curve of 1/2.2."""
    seen = capture(
        sequence, slope(240, 320, per_px, start=-20.0), defocus=0.3, psf=0.5, ambient=6.0, read=0.3
    )
    light = np.clip(seen * np.reshape(gain, (-1, 1, 1)) / 255, 0, 1)
    noise = np.random.default_rng(2).normal(0, 0.8, seen.shape)
    return np.clip(np.rint(255 * light ** (1 / 2.2) + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", TONED)
def test_a_tone_curve_is_no_varying_light(name):
    """Of fine stripes, blur before a tone curve lets the mean grow as a gain would."""
    light = estimate_frame_light(TONED[name], seen_by_an_ordinary_camera(TONED[name]))
    assert light.terms == () and np.all(light.gain == 1)


@pytest.mark.parametrize("name", TONED)
@pytest.mark.parametrize("per_px", [0.25, 0.9])
def test_gains_that_a_tone_curve_hides_are_not_made_worse(name, per_px):
    """At 0.25 projector pixels a pixel the view has a third of the wide period."""
    sequence = TONED[name]
    gain = np.random.default_rng(5).uniform(0.8, 1, len(sequence.frames))
    stack = seen_by_an_ordinary_camera(sequence, gain, per_px)
    logs = np.log(gain) / 2.2
    light = estimate_frame_light(sequence, stack)
    steps = [i for i, f in enumerate(sequence.frames) if f.kind in ("phase", "gray", "inverse")]
    assert (np.log(light.gain) - logs)[steps].std() < 1.05 * logs[steps].std()


@pytest.mark.parametrize("exposure", [0.75, 1.0, 1.6])
def test_patterns_exposed_unlike_white_are_sound(exposure):
    """Stripes of the last three bits are narrower than a pixel."""
    bits = gray_bits("x", 11)
    sequence = PatternSequence((1920, 1080), (*bits, Frame("white"), Frame("black")))
    coordinate = slope(120, 200, per_px=9.6, start=20.0)
    stack = capture(sequence, coordinate, defocus=0.3, psf=0.4, gain=140.0, ambient=2.0, read=1.5)
    found = examine(sequence, relit(stack, np.r_[[exposure] * 11, 1, 1][:, None, None]))
    assert not found.rejected and [f.cause for f in found.findings][:1] == ["blur"]
    assert not missing_facts(found.findings[0].observation, "bit 8 of x, 9 of x, 10 of x")


@pytest.mark.slow
def test_mains_flicker_under_a_rolling_shutter():
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, TRUTH, shot=0.02)
    v, k = np.linspace(0, 1, stack.shape[1])[:, None], np.arange(len(stack))[:, None, None]
    flickering = relit(stack, 1 + 0.05 * np.sin(2 * np.pi * (3.2 * v + 0.37 * k)))
    light = estimate_frame_light(sequence, flickering)
    assert light.cycles == pytest.approx(3.2, abs=0.05)
    assert [f.cause for f in describe_light(sequence, light)] == ["flicker"]
    assert rms_px(decode(sequence, flickering, "x")) < 1.15 * rms_px(decode(sequence, stack, "x"))


@pytest.mark.parametrize("first", variants([7, 20], 7))
def test_room_light_that_is_switched_on(first):
    sequence = SEQUENCES["p18"]
    stack = capture(sequence, TRUTH, shot=0.02, gain=140)
    illuminated = relit(stack, 1, np.where(np.arange(len(stack)) >= first, 40, 0)[:, None, None])
    light = estimate_frame_light(sequence, illuminated)
    (found,) = describe_light(sequence, light)
    assert (found.cause, found.frames) == ("room-light", (first,))
    phase = decode(sequence, illuminated, "x")
    assert coverage(phase) > 0.99 and rms_px(phase) < 1.15 * rms_px(decode(sequence, stack, "x"))


@pytest.mark.slow
def test_gray_code_whose_pairs_drift_two_to_one():
    sequence = one_axis(gray(PROJECTOR))
    stack = capture(sequence, TRUTH, defocus=0.3, gain=220)
    sums = np.repeat(np.linspace(1, 0.5, 1 + len(stack) // 2), 2)[: len(stack), None, None]
    phase = decode(sequence, relit(stack, sums * gains(len(stack), 0.2)), "x")
    assert wrong(phase, TRUTH, part=3) == 0 and coverage(phase) > 0.97


def test_clipped_pixels_stay_saturated_and_levels_are_the_captures():
    sequence = SEQUENCES["p18"]
    white = np.full(TRUTH.shape, 100.0)
    white[:, :80] = 235.0
    stack = capture(sequence, TRUTH, gain=white, ambient=10)
    phase = decode(sequence, relit(stack, 1.4 * gains(len(stack), 0.06)), "x")
    before = decode(sequence, relit(stack, 1.4), "x")
    assert (before.reason[:, :70] == Reason.SATURATED).mean() > 0.9
    assert (phase.reason[:, :70] == Reason.SATURATED).mean() > 0.9
    assert phase.mask[:, 90:].mean() > 0.99
    ratio = np.median((phase.modulation / before.modulation)[:, 90:])
    variance, steady = (p.noise[0] + 100 * p.noise[1] for p in (phase, before))
    assert 0.94 < ratio < 1.0 and 0.6 < variance / steady < 1.4


def test_frames_without_a_pattern_have_equal_light():
    sequence = PatternSequence(PROJECTOR, (Frame("white"), Frame("black")))
    stack = np.full((2, 60, 80), 9, np.uint8)
    light = estimate_frame_light(sequence, stack)
    assert not light.is_significant and (light.gain == 1).all()


def test_the_definition_agrees():
    sequence = SEQUENCES["four"]
    stack = relit(capture(sequence, TRUTH), gains(len(sequence.frames), 0.2))
    light = estimate_frame_light(sequence, stack)
    assert light.is_significant
    fast = decoding.decode(sequence, stack, "x", light)
    slow = decode_reference(sequence, stack, "x", light)
    np.testing.assert_array_equal(fast.reason, slow.reason)
    np.testing.assert_allclose(fast.phase, slow.phase, atol=1e-4)
