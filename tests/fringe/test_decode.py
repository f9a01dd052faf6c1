from dataclasses import replace

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import raises
from fringe_scene import capture, coverage, slope, variants, wrong

from slviewer.errors import InputError
from slviewer.fringe.binary_bits import has_binary_beside_phase, to_gray_code
from slviewer.fringe.decode import decode, texture
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.presets import complementary, gray, multifrequency, p18
from slviewer.fringe.sequence import Frame, PatternSequence

PROJECTOR = (912, 1140)
SEQUENCES = {
    "p18": p18(PROJECTOR),
    "complementary": complementary(PROJECTOR),
    "three steps": complementary(PROJECTOR, 3, 18.0),
    "five steps": complementary(PROJECTOR, 5, 20.0),
    "multifrequency": multifrequency(PROJECTOR),
    "heterodyne": multifrequency((400, 400), 8, (18.0, 21.0, 25.0)),
    "gray": gray(PROJECTOR),
}


def rms(phase, coordinate):
    inner = np.s_[:, 5:-5]  # the simulated lens blur repeats the image's border
    return float(np.sqrt(np.nanmean((phase.coordinate - coordinate)[inner] ** 2)))


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("axis", variants(["x", "y"], "x"))
@pytest.mark.computes
def test_the_coordinate_comes_back(name, axis):
    sequence, truth = SEQUENCES[name], slope()
    phase = decode(sequence, capture(sequence, truth, axis=axis, gain=200), axis)
    assert (
        phase.axis == axis and phase.phase.dtype == np.float32 and phase.phase.shape == truth.shape
    )
    assert wrong(phase, truth, part=0.4 if phase.steps else 3) == 0
    assert coverage(phase) > 0.995
    assert phase.illuminated.all()
    if name == "gray":
        assert phase.steps == 0 and np.isnan(phase.wrapped).all()
        # 0.29 for columns, less where an edge was recognised
        assert 0.15 < rms(phase, truth) < 0.32
    else:
        expected = (
            np.sqrt(np.mean(phase.sigma_phase[phase.mask] ** 2)) * phase.period_px / (2 * np.pi)
        )
        assert 0.8 * expected < rms(phase, truth) < 1.15 * expected


@pytest.mark.computes
def test_both_signs_of_the_phase_shift():
    truth = slope()
    sequence = replace(SEQUENCES["complementary"], phase_sign=-1)
    frames = capture(sequence, truth)
    assert wrong(decode(sequence, frames, "x"), truth) == 0
    assert (
        wrong(decode(replace(sequence, phase_sign=1), frames, "x"), truth, part=0.1)
        > truth.size / 2
    )


@pytest.mark.parametrize("origin", variants([-0.5, -4.5, -9.5], -9.5))
@pytest.mark.parametrize("name", ["p18", "complementary"])
@pytest.mark.computes
def test_another_origin_of_the_code(name, origin):
    truth = slope()
    sequence = replace(SEQUENCES[name], gray_origin_px=origin)
    phase = decode(sequence, capture(sequence, truth), "x")
    assert wrong(phase, truth) == 0 and coverage(phase) > 0.995


@pytest.mark.computes
def test_complementary_bit_with_inverses_of_the_others():
    truth, sequence = slope(), complementary(PROJECTOR, 4, 18.0)
    inverses = tuple(replace(f, kind="inverse") for f in sequence.frames if f.kind == "gray")
    sequence = PatternSequence(PROJECTOR, (*sequence.frames, *inverses))
    phase = decode(sequence, capture(sequence, truth), "x")
    assert wrong(phase, truth) == 0 and coverage(phase) > 0.995


@pytest.mark.computes
def test_gray_bits_without_white_or_without_inverses():
    truth, sequence = slope(), SEQUENCES["gray"]
    for drop in (("white", "black"), ("inverse",)):
        some = PatternSequence(PROJECTOR, tuple(f for f in sequence.frames if f.kind not in drop))
        phase = decode(some, capture(some, truth, defocus=0.3), "x")
        assert wrong(phase, truth, part=1.6) == 0 and coverage(phase) > 0.97, drop


@pytest.mark.computes
def test_frames_may_come_in_any_order():
    truth, sequence = slope(), SEQUENCES["p18"]
    frames = capture(sequence, truth)
    order = np.random.default_rng(3).permutation(len(frames))
    shuffled = PatternSequence(PROJECTOR, tuple(sequence.frames[i] for i in order))
    expected, phase = decode(sequence, frames, "x"), decode(shuffled, frames[order], "x")
    np.testing.assert_array_equal(phase.phase, expected.phase)


@pytest.mark.slow
@pytest.mark.computes
def test_deeper_grey_levels():
    truth, sequence = slope(), SEQUENCES["p18"]
    frames = capture(sequence, truth, gain=120)
    eight = decode(sequence, frames, "x")
    ten = decode(sequence, frames.astype(np.uint16) * 4, "x")
    np.testing.assert_allclose(ten.phase, eight.phase, atol=1e-4)
    np.testing.assert_allclose(ten.modulation, 4 * eight.modulation, rtol=1e-5)
    assert ten.noise[0] + 400 * ten.noise[1] == pytest.approx(
        16 * (eight.noise[0] + 100 * eight.noise[1]), rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "times"), [(np.uint8, 1), (np.uint16, 16), (np.uint16, 257)])
@pytest.mark.computes
def test_clipped_pixels_are_saturated_and_noise_at_white_is_not(dtype, times):
    truth, sequence = slope(), SEQUENCES["complementary"]
    gain = np.full(truth.shape, 200.0)
    gain[:, :80] = 330.0
    # Full scale of 12 bits is 4095, not 255 * 16: stretch so that clipped samples reach it.
    frames = capture(sequence, truth, gain=gain, ambient=20, read=2.0)
    frames = np.where(
        frames == 255, 4095 if times == 16 else 255 * times, frames.astype(np.uint32) * times
    ).astype(dtype)
    phase = decode(sequence, frames, "x")
    assert (phase.reason[:, :76] == Reason.SATURATED).all()
    assert phase.illuminated.all()
    assert (phase.reason[:, 84:] != Reason.SATURATED).mean() > 0.99
    assert np.isnan(phase.phase[:, :76]).all() and np.isfinite(phase.wrapped).all()


@pytest.mark.parametrize("decoder", [decode, decode_reference])
@pytest.mark.computes
def test_what_is_clipped_in_every_frame_is_saturated_not_dark(decoder):
    truth, sequence = slope(), SEQUENCES["p18"]
    ambient = np.full(truth.shape, 20.0)
    ambient[10:30, 40:70] = 400.0  # a reflection that leaves no modulation
    phase = decoder(sequence, capture(sequence, truth, ambient=ambient, read=2.0), "x")
    assert (phase.reason[12:28, 42:68] == Reason.SATURATED).all()
    assert phase.mask[35:, 5:-5].mean() > 0.99


@pytest.mark.computes
def test_shadow_is_dark_and_the_lit_part_is_kept_to_its_border():
    truth, sequence = slope(), SEQUENCES["p18"]
    gain = np.full(truth.shape, 150.0)
    gain[:, :70] = 0
    phase = decode(sequence, capture(sequence, truth, gain=gain, read=2.0, psf=0.3), "x")
    assert (phase.reason[:, :69] == Reason.DARK).mean() > 0.999
    assert not phase.illuminated[:, :69].any() or phase.illuminated[:, :69].mean() < 0.001
    assert phase.mask[:, 71:].mean() > 0.999
    assert wrong(phase, truth) == 0


@pytest.mark.computes
def test_beyond_the_projector_is_dark_or_outside():
    sequence = SEQUENCES["p18"]
    truth = slope(start=850.0, per_px=0.6)
    phase = decode(sequence, capture(sequence, truth), "x")
    inside = truth < 909
    assert phase.mask[inside].mean() > 0.99
    assert not phase.mask[truth > 914].any()
    smaller = PatternSequence((880, 1140), sequence.frames)
    phase = decode(smaller, capture(sequence, truth), "x")
    beyond = (truth > 882) & inside
    assert (phase.reason[beyond] == Reason.OUTSIDE).mean() > 0.98
    assert np.nanmax(phase.coordinate) <= 880


@pytest.mark.computes
def test_scattered_light_without_stripes_is_dark_in_gray_code():
    truth, sequence = slope(), SEQUENCES["gray"]
    frames = capture(sequence, truth, read=1.5).astype(np.int32)
    scattered = np.rint(
        frames.mean(axis=2, keepdims=True) * 0.5
        + np.random.default_rng(1).normal(size=frames.shape)
    )
    frames[:, :, :60] = scattered[:, :, :60]
    phase = decode(sequence, frames.clip(0, 255).astype(np.uint8), "x")
    assert phase.mask[:, :60].mean() < 0.002
    assert phase.illuminated[:, :60].mean() < 0.5
    assert phase.mask[:, 62:].mean() > 0.99


@pytest.mark.computes
def test_multifrequency_refuses_what_noise_would_make_a_guess():
    truth, sequence = slope(), SEQUENCES["heterodyne"]
    phase = decode(sequence, capture(sequence, truth, gain=60, read=3.0), "x")
    assert wrong(phase, truth) == 0


def test_texture():
    sequence, truth = SEQUENCES["p18"], slope()
    frames = capture(sequence, truth)
    np.testing.assert_array_equal(texture(sequence, frames), frames[25])
    plain = PatternSequence(PROJECTOR, sequence.frames[:25])
    mean = texture(plain, frames[:25])
    assert mean.dtype == np.uint8 and np.abs(mean - frames[:18].mean(axis=0)).max() <= 0.51


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda f: f[:-1], (51, 52)),
        (lambda f: f.astype(np.float32), ("float32",)),
        (lambda f: f[0], ("shape", "(8, 10)")),
        (lambda f: np.stack([f] * 3, axis=-1), ("(52, 8, 10, 3)", "channel")),
        (lambda f: [f[0], f[1][:-1]], ("(7, 10)", "(8, 10)")),
        (lambda f: f[:, :0], ("shape", "(52, 0, 10)")),
    ],
)
def test_a_wrong_stack_is_refused(make, facts):
    with raises(InputError, *facts):
        decode(SEQUENCES["p18"], make(np.zeros((52, 8, 10), np.uint8)), "x")


def _only(sequence, *kinds):
    return PatternSequence(sequence.projector, tuple(f for f in sequence.frames if f.kind in kinds))


@pytest.mark.parametrize(
    ("sequence", "facts"),
    [
        (_only(SEQUENCES["p18"], "phase"), ("18 px",)),
        (_only(SEQUENCES["gray"], "gray"), ("inverses",)),
        (
            _only(SEQUENCES["complementary"], "phase", "complementary"),
            ("complementary", "Gray bits"),
        ),
        (
            PatternSequence((4096, 4096), SEQUENCES["p18"].frames),
            ("7 Gray bits", "128 periods", 4096),
        ),
        (_only(SEQUENCES["p18"], "texture"), ("axis x", "pattern")),
        (multifrequency((3000, 3000), 4, (18.0, 20.0)), ("axis x", "longer period")),
    ],
)
def test_a_sequence_without_an_absolute_phase_is_refused(sequence, facts):
    with raises(InputError, *facts):
        decode(sequence, np.zeros((len(sequence.frames), 8, 10), np.uint8), "x")


@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (40, 3)])
@pytest.mark.computes
def test_tiny_black_and_white_images_end_masked(name, shape):
    sequence = SEQUENCES[name]
    for level in (0, 128, 255):
        phase = decode(sequence, np.full((len(sequence.frames), *shape), level, np.uint8), "x")
        clipped = level == 255 and sequence.periods_px("x")
        assert (phase.reason == (Reason.SATURATED if clipped else Reason.DARK)).all() and np.isnan(
            phase.phase
        ).all()
        assert phase.noise[0] >= 0 and phase.noise[1] >= 0


def test_a_phase_map_of_mixed_sizes_is_refused():
    good = np.zeros((3, 4), np.float32)
    with raises(InputError, "shapes"):
        PhaseMap("x", 18.0, good, good, good, good[:2], good.astype(np.uint8), (1.0, 0.0), 18)


def test_white_frames_belong_to_every_axis():
    frames = (*SEQUENCES["gray"].frames[:-2], Frame("white"), Frame("black"))
    assert PatternSequence(PROJECTOR, frames).select("y")[-2:] == [len(frames) - 2, len(frames) - 1]


@pytest.mark.computes
@pytest.mark.parametrize("cell", [1, 3])
def test_plain_binary_numbers_are_decoded_or_masked_never_misread(cell):
    sequence = replace(gray(PROJECTOR, cell), binary=True)
    truth = slope()
    frames = capture(sequence, truth, gain=200)
    phase, expected = decode(sequence, frames, "x"), decode_reference(sequence, frames, "x")
    assert wrong(phase, truth, part=3) == 0
    assert coverage(phase) > 0.6
    assert np.array_equal(phase.mask, expected.mask)
    assert wrong(decode(replace(sequence, binary=False), frames, "x"), truth, part=3) > 0


@pytest.mark.computes
@pytest.mark.parametrize("name", ["p18", "complementary", "three steps"])
@pytest.mark.parametrize("gain", [200, 60])
def test_binary_numbers_beside_phase_steps_are_combined_to_gray_code(name, gain):
    sequence, truth = replace(SEQUENCES[name], binary=True), slope()
    frames = capture(sequence, truth, gain=gain)
    assert has_binary_beside_phase(sequence)
    phase = decode(*to_gray_code(sequence, frames), "x")
    assert wrong(phase, truth) == 0
    assert 0.92 < coverage(phase) < 1
    several, _ = to_gray_code(sequence, np.concatenate([frames, frames]))
    assert not several.binary and not has_binary_beside_phase(several)


@pytest.mark.parametrize("period", [300.0, 18.0])
def test_plain_binary_numbers_beside_phase_steps_are_refused(period):
    sequence = replace(complementary(PROJECTOR, 4, period), binary=True)
    with raises(InputError, "binary", "Gray"):
        decode(sequence, np.zeros((len(sequence.frames), 8, 8), np.uint8), "x")
