"""Phase errors that gamma causes in three and four phase steps: estimated from the frames
themselves, and corrected.

A response that is not linear adds harmonics to the fringe, B_m cos(m theta) with theta the argument
of the cosine. Among n steps harmonics n - 1 and n + 1 appear as the first, which is measured as B_1
e^(i theta) (1 + M cos(n theta) - i d sin(n theta)), with M = (B_{n-1} + B_{n+1}) / B_1 and d =
(B_{n-1} - B_{n+1}) / B_1. So the modulation ripples with the cosine, and the phase with the sine:
the error is atan2(-d sin(n theta), 1 + M cos(n theta)). Each is fitted, beside a parabola, to
pieces of image lines about one fringe long. Texture disturbs the modulation alone and relief the
phase alone, and neither follows the fringe, so that only gamma affects both alike. Gamma adds no
sine to the modulation and no cosine to the phase: amplitudes fitted to these are due to texture and
relief, and serve as a control.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.cosines import fit_cosine, select_rows
from slviewer.fringe.layout import Layout
from slviewer.fringe.phase import Noise
from slviewer.geometry.robust import robust_sigma, weighted_median

MOST_STEPS = 4
"""From five steps on, harmonics below the fourth cause no error, and blur removes most of the
others."""
SIGMAS = 5.0
"""Standard errors beyond which a ripple is no accident: one in two million."""
CONTROL = 3.0
"""... and times the ripple that gamma cannot make."""
NOISE_PART = 0.5
"""An error below this part of the phase noise is neglected: it adds 12 % to it."""
BRIGHT = 0.25
"""Share of the strongest fringes of the image that a pixel's have at least: a tone curve amplifies
the noise of pixels without light, and compression hides that of the others."""
PIXELS = 40_000
"""Number of sampled pixels: enough to detect a ripple of half a thousandth."""
MOST_CYCLES = 0.4
"""Fringes per camera pixel up to which neighbouring phases can be unwrapped."""
SHORTEST = 16
"""Pixels that a piece has at least, for seven coefficients."""
BANDS = 6
"""Parts of the image's height and width, whose means give the standard error of the mean of all."""
FEWEST_BLOCKS = 6
ROUNDS = 6
"""The phase itself is the argument of the ripple: fit and correct in turns, until both settle."""
SETTLED = 0.01
"""Change of both amplitudes, in their standard errors, below which they have settled; each round
changes them by some percent of what the last one did."""
OUTLIER = 4.0
"""Times the usual deviation beyond which a piece (an edge, a step) does not count."""


@dataclass(frozen=True)
class AliasedHarmonics:
    """Ripple of n phase steps: amplitudes ``modulation`` (M, relative) and ``phase`` (d, rad), zero
    if not significant.

    ``is_corrected``: whether d is known well enough to be removed; ``error_rad``: rms error of the
    phase that remains.
    """

    steps: int = 0
    modulation: float = 0.0
    phase: float = 0.0
    is_corrected: bool = False
    error_rad: float = 0.0

    @property
    def is_significant(self) -> bool:
        """Whether gamma causes a significant ripple."""
        return self.steps > 0

    def correction(self, theta: np.ndarray) -> np.ndarray:
        """Return the correction, rad float32, to add to the measured argument ``theta`` (rad) of
        the cosine."""
        return _compute_correction(theta, self.steps, self.modulation, self.phase).astype(
            np.float32
        )


def estimate_aliased_harmonics(
    layout: Layout, stack: np.ndarray, white: float, noise: Noise
) -> AliasedHarmonics:
    """Estimate the ripple that harmonics cause in the finest period of an axis; none where it has
    five or more steps.

    ``stack`` (n, h, w) under equal light, which clips at ``white``; ``noise`` (a, b) of its grey
    levels. About 40,000 pixels along the image lines that cross the fringes are used.
    """
    none = AliasedHarmonics()
    if not 0 < layout.steps <= MOST_STEPS:
        return none
    pieces = _cut_pieces(layout, stack, white, noise)
    if pieces is None:
        return none
    fit = _fit_ripple(pieces)
    if fit is None:
        return none
    M, d, spread, second = fit
    size = float(np.hypot(M.value, M.control)) if abs(d.value) < abs(M.value) else abs(d.value)
    if not M.is_significant or size / np.sqrt(2) < NOISE_PART * pieces.sigma:
        return none
    n = pieces.steps
    slope = _compute_slope(n, M.value, d.value)
    if d.is_significant and d.value * M.value > 0 and slope.min() > 0.1:
        noise_gain = max(float(np.mean(slope**-2.0)) - 1, 0.0)
        remaining = np.sqrt((spread**2 + d.error**2 + second**2) / 2 + noise_gain * pieces.sigma**2)
        return AliasedHarmonics(n, M.value, d.value, True, float(remaining))
    # no phase follows: the modulation is texture's
    if abs(d.value - M.value) > SIGMAS * d.error + abs(M.value) / 2:
        return none
    return AliasedHarmonics(n, M.value, d.value, False, abs(M.value) / np.sqrt(2))


def correct_harmonics(
    harmonics: AliasedHarmonics, layout: Layout, phase: np.ndarray, wrapped: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Remove the ripple from absolute and wrapped phase (h, w) float32 rad, where it is known well
    enough to correct.

    Otherwise both are returned unchanged.
    """
    if not harmonics.is_corrected:
        return phase, wrapped
    added = harmonics.correction(wrapped + np.float32(layout.offset_rad))
    turned = wrapped + added
    turned -= np.float32(2 * np.pi) * np.rint(turned * np.float32(0.5 / np.pi))
    return phase + added, turned


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of image lines, k pieces of s pixels each.

    ``theta`` (k, s): phase in rad, unwrapped; ``modulation`` (k, s): relative to the piece's mean;
    ``block`` (k,): part of the image; ``sigma``: median phase noise, rad.
    """

    steps: int
    theta: np.ndarray
    modulation: np.ndarray
    block: np.ndarray
    sigma: float


@dataclass(frozen=True)
class _Amplitude:
    """Estimated amplitude of a ripple, its standard error, and the amplitude of a control that
    should be zero."""

    value: float
    error: float
    control: float

    @property
    def is_significant(self) -> bool:
        """Whether the amplitude exceeds both its error and the control."""
        return abs(self.value) > max(SIGMAS * self.error, CONTROL * abs(self.control))


def _cut_pieces(layout: Layout, stack: np.ndarray, white: float, noise: Noise) -> _Pieces | None:
    """Cut rows or columns, whichever cross more fringes, into pieces; None where too few fringes
    are in view."""
    indices = list(layout.shifts[-1].indices)
    candidates = [
        _sample_lines(each, indices, white, noise) for each in (stack, stack.transpose(0, 2, 1))
    ]
    phasor, background, valid, cycles = max(candidates, key=lambda c: c[3])
    if not 0 < cycles < MOST_CYCLES:
        return None
    size = max(SHORTEST, int(np.ceil(1 / cycles)))
    lines, count = len(phasor), phasor.shape[1] // size
    if count == 0:
        return None
    shape = (lines, count, size)
    usable = valid[:, : count * size].reshape(shape).all(axis=2)
    if not usable.any():
        return None
    band = BANDS * np.arange(lines) // lines
    block = (BANDS * band[:, None] + BANDS * np.arange(count) // count)[usable]
    chosen = phasor[:, : count * size].reshape(shape)[usable].astype(np.complex128)
    modulation = np.abs(chosen)
    level = background[:, : count * size].reshape(shape)[usable]
    sigma = np.sqrt(2 / len(indices) * np.maximum(noise[0] + noise[1] * level, 0)) / modulation
    theta = np.unwrap(np.angle(chosen), axis=1)
    relative = modulation / modulation.mean(axis=1, keepdims=True)
    return _Pieces(len(indices), theta, relative, block, float(np.median(sigma)))


def _sample_lines(
    stack: np.ndarray, indices: list[int], white: float, noise: Noise
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return phasor, background and validity (lines, pixels) of some image rows.

    Fourth, the median number of fringes per pixel along them, strong ones first.
    """
    rows = select_rows(stack.shape[1], stack.shape[2], PIXELS)
    frames = np.stack([stack[i][rows] for i in indices])
    clipped = (frames >= white).any(axis=0)
    background, phasor = fit_cosine(frames.reshape(len(frames), -1).astype(np.float32))
    shape = frames.shape[1:]
    background, phasor = background.reshape(shape), phasor.reshape(shape)
    sigma = np.sqrt(np.maximum(noise[0] + noise[1] * background, 0))
    modulation = np.abs(phasor)
    least = max(BRIGHT * float(np.quantile(modulation, 0.98)), 1e-3)
    valid = (modulation > np.maximum(limits.DARK_SIGMAS * sigma, least)) & ~clipped
    both = valid[:, 1:] & valid[:, :-1]
    if not both.any():
        return phasor, background, valid, 0.0
    product = (phasor[:, 1:] * np.conj(phasor[:, :-1]))[both]
    turn = weighted_median(np.abs(np.angle(product)), np.abs(product))
    return phasor, background, valid, turn / (2 * np.pi)


class _Mean(NamedTuple):
    """A mean, its standard error, and the standard deviation of the means of blocks of the image;
    NaN where there are too few."""

    value: float = np.nan
    error: float = np.nan
    spread: float = np.nan


class _Ripple(NamedTuple):
    """The amplitudes ``M`` of the modulation's and ``d`` of the phase's ripple, the ``spread`` of d
    over the image, and what remains of the phase's at the double frequency, ``second``."""

    M: _Amplitude
    d: _Amplitude
    spread: float
    second: float


def _fit_ripple(pieces: _Pieces) -> _Ripple | None:
    """Fit the ripple; None for too few pieces."""
    M = d = 0.0
    n, size = pieces.steps, pieces.theta.shape[1]
    x = np.broadcast_to(np.linspace(-1, 1, size), pieces.theta.shape)
    for _ in range(ROUNDS):
        added = _compute_correction(pieces.theta, n, M, d)
        theta = pieces.theta + added
        cosine, sine = np.cos(n * theta), np.sin(n * theta)
        columns = (np.ones_like(x), x, x**2, cosine, sine, 2 * cosine**2 - 1, 2 * sine * cosine)
        design = np.stack(columns, axis=1)  # (k, 7, s)
        centred = theta - theta.mean(axis=1, keepdims=True)
        target = np.stack([centred, pieces.modulation * np.cos(added)], axis=1)
        inverse = np.linalg.inv(
            design @ design.transpose(0, 2, 1) + 1e-6 * size * np.eye(len(columns))
        )
        weights = inverse @ (design @ target.transpose(0, 2, 1))
        residual = target - weights.transpose(0, 2, 1) @ design
        residual_rms = np.sqrt(np.einsum("kts,kts->kt", residual, residual) / size)
        good = (residual_rms < OUTLIER * np.median(residual_rms, axis=0)).all(axis=1)
        information = 1 / np.diagonal(inverse, axis1=1, axis2=2)
        # rows: constant, x, x^2, cos, sin, cos 2, sin 2; columns: phase, modulation
        phase_cosine, phase_sine, second, modulation_cosine, modulation_sine = (
            _compute_robust_mean(
                weights[good, row, column], information[good, row], pieces.block[good]
            )
            for row, column in ((3, 0), (4, 0), (6, 0), (3, 1), (4, 1))
        )
        if not np.isfinite([phase_sine.value, modulation_cosine.value]).all():
            return None
        limit, old_M, old_d = 0.9 / n, M, d
        M = float(np.clip(modulation_cosine.value, -0.9, 0.9))
        d = float(np.clip(d - phase_sine.value, -limit, limit))
        if (
            abs(M - old_M) <= SETTLED * modulation_cosine.error
            and abs(d - old_d) <= SETTLED * phase_sine.error
        ):
            break
    return _Ripple(
        _Amplitude(M, modulation_cosine.error, modulation_sine.value),
        _Amplitude(d, phase_sine.error, phase_cosine.value),
        phase_sine.spread,
        second.value,
    )


def _compute_robust_mean(values: np.ndarray, weights: np.ndarray, block: np.ndarray) -> _Mean:
    """Return the weighted mean without outliers."""
    if len(values) == 0:
        return _Mean()
    middle = np.median(values)
    is_inlier = np.abs(values - middle) <= OUTLIER * robust_sigma(values, middle)
    values, weights, block = values[is_inlier], weights[is_inlier], block[is_inlier]
    total = np.bincount(block, weights)
    used = total > 0
    if np.count_nonzero(used) < FEWEST_BLOCKS:
        return _Mean()
    total, means = total[used], np.bincount(block, weights * values)[used] / total[used]
    share = total / total.sum()
    mean = float(share @ means)
    many = 1 - float(share @ share)
    spread = float(np.sqrt(share @ (means - mean) ** 2 / max(many, 0.1)))
    return _Mean(mean, spread * float(np.sqrt(share @ share)), spread)


def _compute_correction(theta: np.ndarray, n: int, M: float, d: float) -> np.ndarray:
    """Return the correction (rad) to add to measured arguments ``theta`` (rad).

    It is the inverse of the ripple, from a table over one wave.
    """
    if M == d == 0:
        return np.zeros_like(theta)
    wave, error = _tabulate_ripple(M, d)
    place = n * theta
    place = place - 2 * np.pi * np.rint(place / (2 * np.pi))
    return np.interp(place, np.maximum.accumulate(wave + n * error), -error)


def _compute_slope(n: int, M: float, d: float) -> np.ndarray:
    """Return the derivative of the measured argument with respect to the true one, at 1024 points
    of one wave."""
    wave, error = _tabulate_ripple(M, d)
    return np.diff(wave + n * error) / np.diff(wave)


def _tabulate_ripple(M: float, d: float) -> tuple[np.ndarray, np.ndarray]:
    """Return 1025 arguments (rad) of one wave of the ripple, and the errors of the phase (rad)
    there."""
    wave = np.linspace(-np.pi, np.pi, 1025)
    return wave, np.arctan2(-d * np.sin(wave), 1 + M * np.cos(wave))
