"""Spikes of one period at code edges, lonely pixels, and depth steps that must stay as they are."""

import numpy as np
import pytest
from decode_reference import repair_spikes
from fringe_scene import capture, coverage, slope, variants, wrong

from slviewer.fringe.decode import decode
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import complementary, p18

PROJECTOR = (912, 1140)
SEQUENCES = {"p18": p18(PROJECTOR), "complementary": complementary(PROJECTOR, 8, 18.0)}
CONDITIONS = [
    (0.5, 0.5, 40, 2, 1.0),
    (0.5, 0.7, 50, 4, 1.0),
    (2.0, 0.7, 60, 3, 1.0),
    (3.0, 1.0, 60, 2, 2.2),
    (4.0, 0.5, 150, 4, 1.0),
    (4.5, 2.0, 220, 2, 2.2),
    (1.0, 3.0, 120, 2, 1.0),
]
TWO_PI = 2 * np.pi


@pytest.mark.computes
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("per_px", variants([0.25, 0.6, 1.6], 1.6))
@pytest.mark.parametrize(
    ("defocus", "psf", "gain", "read", "gamma"), variants(CONDITIONS, CONDITIONS[1], CONDITIONS[5])
)
def test_no_wrong_period_survives_blur_and_noise(name, per_px, defocus, psf, gain, read, gamma):
    sequence, truth = SEQUENCES[name], slope(per_px=per_px)
    frames = capture(
        sequence, truth, defocus=defocus, psf=psf, gain=gain, read=read, gamma=gamma, ambient=20
    )
    phase = decode(sequence, frames, "x")
    assert wrong(phase, truth) == 0
    assert coverage(phase) > 0.99
    assert phase.illuminated.mean() > 0.9


@pytest.mark.computes
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("jump", variants([18.0, -18.0, 9.0, 31.3], -18.0))
def test_a_depth_step_survives_unaltered_on_both_sides(name, jump):
    sequence, truth = SEQUENCES[name], slope()
    truth[30:90, 60:130] += jump
    phase = decode(sequence, capture(sequence, truth, defocus=0.8, psf=0.15, gain=150), "x")
    assert wrong(phase, truth) == 0
    assert phase.mask.mean() > 0.998
    region = np.zeros(truth.shape, bool)
    region[30:90, 60:130] = True
    assert phase.mask[region].mean() > 0.99


def _map(jump=0.0, height=40, width=60):
    """An absolute phase of period 18 px with a block that stands off by ``jump`` rad."""
    phase = (TWO_PI / 18 * slope(height, width)).astype(np.float32)
    phase[10:30, 20:45] += np.float32(jump)
    return phase


def _settle(phase, sequence=None):
    reason = np.where(np.isnan(phase), Reason.INCONSISTENT, Reason.VALID).astype(np.uint8)
    return repair_spikes(axis_layout(sequence or p18(PROJECTOR), "x"), phase, reason)


@pytest.mark.parametrize("jump", [0.0, 3.3, -5.0, TWO_PI, -TWO_PI, 9.0, 40.0])
def test_a_clean_depth_step_loses_its_corners_at_most(jump):
    phase = _map(jump)
    settled, reason = _settle(phase)
    lost = np.argwhere(reason != Reason.VALID)
    assert len(lost) <= (4 if jump else 0)
    assert all(v in (10, 29) and u in (20, 44) for v, u in lost)
    np.testing.assert_array_equal(settled[reason == Reason.VALID], phase[reason == Reason.VALID])


def test_single_spikes_at_a_code_edge_are_repaired_and_others_masked():
    clean = _map()
    part = np.abs((clean / TWO_PI + 0.5 / 18 + 0.5) % 1 - 0.5)  # periods from the nearest code edge
    rng = np.random.default_rng(5)
    for at_edge in (True, False):
        phase = clean.copy()
        v, u = np.nonzero(
            (part < 0.1 if at_edge else part > 0.2) & (rng.random(clean.shape) < 0.02)
        )
        phase[v, u] += TWO_PI * rng.choice([-1, 1], len(v)).astype(np.float32)
        settled, reason = _settle(phase)
        if at_edge:
            np.testing.assert_allclose(settled, clean, atol=1e-4)
        else:
            assert (reason[v, u] == Reason.INCONSISTENT).all()
            assert np.count_nonzero(reason) == len(v)
            np.testing.assert_array_equal(settled[reason == 0], clean[reason == 0])


def test_spikes_of_many_periods_are_masked_never_guessed():
    phase = _map()
    phase[20, 30] += 5 * TWO_PI
    phase[5, 5] -= 3.0 * TWO_PI
    settled, reason = _settle(phase)
    assert reason[20, 30] == reason[5, 5] == Reason.INCONSISTENT
    assert np.isnan(settled[20, 30]) and np.count_nonzero(reason) == 2


def test_the_border_of_the_lit_region_stays_and_specks_go():
    phase = _map()
    v, u = np.mgrid[: phase.shape[0], : phase.shape[1]]
    outside = (v - 20) ** 2 + (u - 30) ** 2 > 15**2
    phase[outside] = np.nan
    phase[2, 3] = phase[36, 50] = 20.0
    settled, reason = _settle(phase)
    assert (reason[~outside] == Reason.VALID).all()
    assert reason[2, 3] == reason[36, 50] == Reason.INCONSISTENT
    assert np.isfinite(settled).sum() == (~outside).sum()


@pytest.mark.computes
@pytest.mark.parametrize("name", SEQUENCES)
def test_pixels_that_mix_two_surfaces_are_masked(name):
    sequence, truth = SEQUENCES[name], slope(160, 240)
    truth[40:120, 80:160] += 31.3
    phase = decode(
        sequence, capture(sequence, truth, defocus=4.0, psf=1.5, gain=150, read=2.0), "x"
    )
    assert wrong(phase, truth) == 0
    assert phase.mask.mean() > 0.98
