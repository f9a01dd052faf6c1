"""Gamma in three and four phase steps is measured, corrected and reported, and textures are not
taken for it."""

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import missing_facts
from fringe_scene import capture, slope, variants, wrong
from proofs.simulated_capture import draw_setup, render_capture

from slviewer.examination.examine import examine
from slviewer.fringe import decode as decode_module
from slviewer.fringe import phase_shifting
from slviewer.fringe.aliased_harmonics import AliasedHarmonics
from slviewer.fringe.decode import decode
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.presets import complementary, multifrequency, phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

pytestmark = pytest.mark.computes

PROJECTOR = (512, 400)
TRUTH = slope(240, 320)


def decode_uncorrected(monkeypatch, sequence, stack, axis="x"):
    with monkeypatch.context() as patch:
        patch.setattr(phase_shifting, "estimate_aliased_harmonics", lambda *_: AliasedHarmonics())
        return decode(sequence, stack, axis)


def rms_px(phase, truth):
    error = (phase.coordinate - truth)[phase.mask]
    return float(np.sqrt(np.mean(error**2)))


def share_within(phase, truth, sigmas=3.0):
    sigma_px = phase.sigma_phase * phase.period_px / (2 * np.pi)
    return float(
        np.mean(np.abs(phase.coordinate - truth)[phase.mask] < sigmas * sigma_px[phase.mask])
    )


def gamma_suspects(sequence, stack, axis="x"):
    found = examine(sequence, stack).findings
    return [f for f in found if f.cause == "gamma" and f.axis == axis]


GAMMAS = [(3, 2.2, 6), (3, 1 / 2.2, 3), (3, 1.4, 3), (4, 1 / 2.2, 1.7)]


@pytest.mark.parametrize(("steps", "gamma", "times"), variants(GAMMAS, GAMMAS[0], GAMMAS[3]))
def test_gamma_is_corrected_and_reported(monkeypatch, steps, gamma, times):
    sequence = complementary(PROJECTOR, steps, 18.0)
    stack = capture(sequence, TRUTH, gamma=gamma, shot=0.02)
    before, phase = decode_uncorrected(monkeypatch, sequence, stack), decode(sequence, stack, "x")
    assert rms_px(before, TRUTH) > times * rms_px(phase, TRUTH) > 0.02  # noise alone leaves 0.04 px
    assert share_within(phase, TRUTH) > 0.97 > 0.95 > share_within(before, TRUTH)
    assert phase.mask.mean() > 0.97
    [suspect] = gamma_suspects(sequence, stack)
    assert not missing_facts(suspect.observation, f"{steps} phase steps", "gamma")


@pytest.mark.parametrize("pipeline", variants(["denoised", "JPEG 70"], "denoised"))
def test_unlit_pixels_of_an_ordinary_camera_hide_no_gamma(pipeline):
    setup = draw_setup("multifrequency", 9501, pipeline)
    shot = render_capture(setup)
    phase = decode(setup.described, shot.stack, "x")
    error = (phase.coordinate - shot.truth["x"])[phase.mask] / phase.px_per_rad
    angle = phase.steps * shot.truth["x"][phase.mask] / phase.px_per_rad
    known = np.abs(error) < 0.5
    ripple = 2 * np.mean((error * np.exp(1j * angle))[known])
    assert abs(ripple) < 0.005  # rad; 0.1 where it was not found


@pytest.mark.slow
def test_an_error_below_the_noise_is_left_alone(monkeypatch):
    sequence = complementary(PROJECTOR, 4, 18.0)
    stack = capture(sequence, TRUTH, gamma=2.2, shot=0.02)
    phase = decode(sequence, stack, "x")
    assert phase.model_error_rad == 0 and share_within(phase, TRUTH) > 0.98
    assert gamma_suspects(sequence, stack) == []


@pytest.mark.parametrize("phase_sign", variants([1, -1], -1))
def test_offset_and_sign_of_the_phase_do_not_matter(phase_sign):
    plain = complementary(PROJECTOR, 3, 18.0)
    sequence = PatternSequence(PROJECTOR, plain.frames, phase_sign=phase_sign, phase_offset_rad=0.7)
    phase = decode(sequence, capture(sequence, TRUTH, gamma=2.2), "x")
    assert 0.02 < rms_px(phase, TRUTH) < 0.09


def test_the_definition_and_levels_are_corrected_alike():
    sequence = multifrequency(PROJECTOR, 4)
    stack = capture(sequence, TRUTH, gamma=1 / 2.2)
    fast, definition = decode(sequence, stack, "x"), decode_reference(sequence, stack, "x")
    assert fast.model_error_rad == definition.model_error_rad > 0
    np.testing.assert_allclose(fast.phase, definition.phase, atol=1e-4)
    assert np.abs(np.exp(1j * (fast.phase - fast.wrapped)) - 1)[fast.mask].max() < 1e-3


@pytest.mark.parametrize("gamma", variants([1.8, 2.2, 1 / 2.2], 1.8))
def test_gamma_in_a_long_period_moves_no_fringe(monkeypatch, gamma):
    """An error of 0.2 rad of one period is half a fringe of sixteen."""
    frames = [*phase_steps("x", 3, 512.0), *phase_steps("x", 3, 32.0)]
    sequence = PatternSequence(PROJECTOR, tuple(frames))
    stack = capture(sequence, TRUTH, gamma=gamma, shot=0.02)
    phase, definition = decode(sequence, stack, "x"), decode_reference(sequence, stack, "x")
    assert wrong(phase, TRUTH) == 0 and phase.mask.mean() > 0.97
    np.testing.assert_array_equal(phase.reason, definition.reason)
    np.testing.assert_allclose(phase.phase, definition.phase, atol=1e-4)
    uncorrected = (np.zeros((2, 0), np.float32), 0.4)
    monkeypatch.setattr(decode_module, "estimate_level_errors", lambda _: uncorrected)
    assert decode(sequence, stack, "x").mask.mean() < 0.9


V, U = np.mgrid[:240, :320]
TEXTURES = {
    "black circles": np.where(
        np.hypot((U + 0.1 * V) % 40 - 20, (V - 0.05 * U) % 40 - 20) < 12, 15.0, 200.0
    ),
    "white circles": np.where(np.hypot(U % 26 - 13, V % 26 - 13) < 8, 220.0, 30.0),
    "chessboard of one fringe": np.where((U // 30 + V // 30) % 2 > 0, 200.0, 25.0),
    "three stripes a fringe": 120 + 60 * np.cos(2 * np.pi * U / 10),
    "random": np.clip(120 + 40 * np.random.default_rng(3).normal(size=U.shape), 20, 220),
}


@pytest.mark.parametrize("steps", variants([3, 4], 3))
@pytest.mark.parametrize("texture", variants(TEXTURES, "black circles", "three stripes a fringe"))
@pytest.mark.parametrize("tilt", variants([0.0, 0.1], 0.1))
def test_textures_raise_no_alarm(monkeypatch, texture, steps, tilt):
    truth = (
        40
        + 0.6 * U
        + tilt * V
        + (2 * np.sin(V / 20) + 20 * (np.hypot(U - 160, V - 120) < 60)) * (tilt > 0)
    )
    sequence = complementary(PROJECTOR, steps, 18.0)
    stack = capture(sequence, truth, gain=TEXTURES[texture], shot=0.02)
    phase = decode(sequence, stack, "x")
    assert phase.model_error_rad == 0 and gamma_suspects(sequence, stack) == []
    np.testing.assert_array_equal(
        phase.phase, decode_uncorrected(monkeypatch, sequence, stack).phase
    )


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_rendered_board(monkeypatch, gamma):
    rig = letter(0.25, local_distortion_px=0, gamma=gamma)
    turn = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    board = Board.parse("circles:21x16:9")
    middle = board.points.mean(axis=0)
    renderer = Renderer(
        rig, printed_board(board, Pose(turn, np.array([0.0, 0.0, 600.0]) - turn @ middle))
    )
    sequence = complementary(rig.projector.size, 3, 36.0)
    stack, truth = renderer.capture(sequence), renderer.truth().projector
    for column, axis in enumerate(sequence.axes):
        phase, before = (
            decode(sequence, stack, axis),
            decode_uncorrected(monkeypatch, sequence, stack, axis),
        )
        inside = phase.mask & np.isfinite(truth[..., column])
        off, off_before = (
            np.median(np.abs((p.coordinate - truth[..., column])[inside])) for p in (phase, before)
        )
        assert len(gamma_suspects(sequence, stack, axis)) == (gamma != 1)
        assert off_before > 3 * off > 0.03 if gamma != 1 else off == off_before


def test_noise_of_three_steps_is_measured_along_the_stripes():
    sequence = complementary(PROJECTOR, 3, 8.0)
    truth = 40 + 0.6 * U
    for image, axis_stack in ((truth, lambda s: s), (truth, lambda s: s.transpose(0, 2, 1))):
        stack = np.ascontiguousarray(axis_stack(capture(sequence, image, gamma=2.2, read=1.5)))
        a, b = measure_noise(axis_layout(sequence, "x"), stack, 255.0)
        assert 0.92 < (a + 80 * b) / (1.5**2 + 1 / 12) < 1.12
