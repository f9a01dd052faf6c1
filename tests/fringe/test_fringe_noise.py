import numpy as np
import pytest
from fringe_scene import capture, slope, variants
from scipy.optimize import nnls

from slviewer.fringe.decode import decode
from slviewer.fringe.noise import _fit_line
from slviewer.fringe.presets import complementary, gray, p18
from slviewer.fringe.sequence import one_axis

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)


def scene():
    truth = slope(240, 320)
    return truth, np.linspace(40, 210, truth.shape[0])[:, None] * np.ones(truth.shape)


@pytest.mark.parametrize("gamma", variants([1.0, 2.2], 2.2))
@pytest.mark.parametrize(
    ("sequence", "within"),
    [(p18(PROJECTOR), 0.05), (complementary(PROJECTOR, 8, 18.0), 0.05), (gray(PROJECTOR), 0.10)],
    ids=["p18", "eight steps", "gray"],
)
@pytest.mark.parametrize(
    ("read", "shot"), variants([(1.0, 0.02), (2.5, 0.0), (0.8, 0.06)], (1.0, 0.02))
)
def test_shot_and_read_noise(sequence, within, gamma, read, shot):
    truth, gain = scene()
    a, b = decode(
        sequence, capture(sequence, truth, gain=gain, read=read, shot=shot, gamma=gamma), "x"
    ).noise
    assert a >= 0 and b >= 0
    for level in (50, 90):
        expected = read**2 + 1 / 12 + shot * level
        # of the variance: half of it in sigma
        assert abs((a + b * level) / expected - 1) < 2 * within


def test_gray_code_that_clips_in_every_block_still_has_noise():
    truth, _ = scene()
    sequence = one_axis(gray(PROJECTOR), "x")
    frames = capture(sequence, truth, gain=60.0, read=12.0)
    dark = np.clip(frames.astype(int) - int(frames.min()) - 40, 0, 255).astype(np.uint8)
    a, b = decode(sequence, dark, "x").noise
    assert 0.7 < (a + b * 20) / 12.0**2 < 1.5


@pytest.mark.parametrize("steps", variants([3, 4, 5, 6, 7], 3, 4))
def test_few_steps(steps):
    truth, gain = scene()
    sequence = complementary(PROJECTOR, steps, 18.0)
    for gamma in (1.0, 2.2):
        a, b = decode(
            sequence, capture(sequence, truth, gain=gain, read=1.5, shot=0.02, gamma=gamma), "x"
        ).noise
        expected = 1.5**2 + 1 / 12 + 0.02 * 80
        assert 0.8 < (a + 80 * b) / expected < 1.3


def test_the_predicted_phase_noise_is_what_repeats_show():
    truth, gain = scene()
    sequence = p18(PROJECTOR)
    first, second = (
        decode(sequence, capture(sequence, truth, gain=gain, read=1.5, seed=s), "x") for s in (0, 1)
    )
    both = first.mask & second.mask
    seen = np.std((first.phase - second.phase)[both]) / np.sqrt(2)
    predicted = np.sqrt(np.mean(first.sigma_phase[both] ** 2))
    assert seen == pytest.approx(predicted, rel=0.05)


def test_the_line_of_the_variances_is_the_non_negative_fit():
    rng = np.random.default_rng(0)
    signs = set()
    for a, b in ((2.0, 0.05), (2.0, 0.0), (0.0, 0.05), (2.0, -0.02), (-1.0, 0.05), (-1.0, -1.0)):
        levels, counts = np.sort(rng.uniform(10, 250, 16)), rng.integers(5, 50, 16) * 1.0
        variances = np.maximum(a + b * levels + rng.normal(0, 0.1, 16), 1e-3)
        weight = np.sqrt(counts) / np.maximum(variances, 0.1 * variances.mean() + 1e-12)
        design = np.stack([np.ones(16), levels], axis=1) * weight[:, None]
        expected = nnls(design, variances * weight)[0]
        assert _fit_line(levels, variances, counts) == pytest.approx(expected, rel=1e-9, abs=1e-12)
        signs.add(tuple(expected > 0))
    assert len(signs) == 3  # both, and each of them alone
    assert _fit_line(np.full(2, 9.0), np.array([1.0, 1.0]), np.ones(2))[0] >= 0
