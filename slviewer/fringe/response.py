"""Response of the light that a camera measures to the grey level that a projector shows.

A response is given as `shown` (n,) grey levels, increasing from 0 to 255, and `seen` (n,) light, 0
for dark and 1 for white, noise included. Between them it is a monotone piecewise cubic (PCHIP).
Where only fringes were captured, their second harmonic shows its exponent.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize_scalar

from slviewer.errors import InputError
from slviewer.fringe.cosines import FEWEST, select_rows
from slviewer.fringe.layout import axis_layout, white_level
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.vectors import rms

_FINE = 16  # places per grey level at which a response is tabulated before it is inverted


def fit_gamma(shown: np.ndarray, seen: np.ndarray) -> float:
    """Fit the exponent of the power of shown / 255 that approximates the response best."""
    x, y = _check_response(shown, seen)
    fit = minimize_scalar(
        lambda g: float(np.sum((x**g - y) ** 2)), bounds=(0.2, 5.0), method="bounded"
    )
    return float(fit.x)


def measure_nonlinearity(shown: np.ndarray, seen: np.ndarray) -> float:
    """Return the largest distance of the response from a straight line, as a share of white."""
    x, y = _check_response(shown, seen)
    return float(np.abs(y - x).max())


def predict_phase_error(shown: np.ndarray, seen: np.ndarray, steps: int) -> float:
    """Predict the rms error of the phase, rad, that the response causes in `steps` phase steps,
    without any blur."""
    curve = _fit_monotonic_curve(shown, seen)
    phase = 2 * np.pi * np.arange(360) / 360
    k = 2 * np.pi * np.arange(steps)[:, None] / steps
    light = curve(0.5 + 0.5 * np.cos(phase + k))
    error = np.angle((light * np.exp(-1j * k)).sum(0) * np.exp(-1j * phase))
    return rms(error)


def linearise_levels(shown: np.ndarray, seen: np.ndarray) -> tuple[int, ...]:
    """Return the 256 grey levels to show so that the light grows evenly from dark to white.

    These are `PatternSequence.levels`.
    """
    x = np.arange(255 * _FINE + 1) / (255 * _FINE)
    y = np.maximum.accumulate(_fit_monotonic_curve(shown, seen)(x))
    levels = np.rint(255 * np.interp(np.arange(256) / 255, y, x)).astype(int)
    levels[0], levels[255] = 0, 255
    return tuple(np.maximum.accumulate(levels).tolist())


def _fit_monotonic_curve(shown: np.ndarray, seen: np.ndarray) -> PchipInterpolator:
    """Fit an interpolator to the response, made monotonic: noise must not reverse it."""
    x, y = _check_response(shown, seen)
    rising = (
        np.maximum.accumulate(y) + np.minimum.accumulate(y[::-1])[::-1]
    ) / 2  # noise must not turn it round
    rising[0], rising[-1] = 0.0, 1.0
    return PchipInterpolator(x, np.clip(rising, 0, 1))


def _check_response(shown: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey levels (0 to 1) and light as float arrays. Raises InputError where they are no
    response."""
    x, y = np.asarray(shown, float) / 255, np.asarray(seen, float)
    if (
        x.ndim != 1
        or x.shape != y.shape
        or len(x) < 3
        or x[0] != 0
        or x[-1] != 1
        or (np.diff(x) <= 0).any()
    ):
        raise InputError(
            "a response needs three or more grey levels that rise from 0 to 255, and the light of"
            " each"
        )
    if not np.isfinite(y).all():
        raise InputError(
            "a response has light that is not a number",
            "measure it where the projector lights the scene",
        )
    return x, y


def measure_second_harmonic(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> float:
    """Return the amplitude of the finest fringe's second harmonic over the first, positive for a
    gamma above 1.

    NaN for fewer than five phase steps, which do not separate the two, and where too few pixels
    have fringes.
    """
    layout = axis_layout(sequence, axis)
    if layout.steps < 5:
        return np.nan
    indices = layout.shifts[-1].indices
    rows = select_rows(*stack.shape[1:])
    frames = np.stack([stack[i][rows].ravel() for i in indices])
    white = white_level(sequence, stack, indices)
    frames = frames[:, (frames.max(0) < white) & (frames.min(0) > 0)].astype(np.float32)
    first, second = np.fft.fft(frames, axis=0)[1:3] * (2 / len(indices))
    strength = np.abs(first)
    weakest = 0.3 * np.quantile(strength, 0.95) if strength.size else np.inf
    modulated = strength > max(8.0 * white / 255, weakest)
    if np.count_nonzero(modulated) < FEWEST:
        return np.nan
    first, second, strength = first[modulated], second[modulated], strength[modulated]
    along = np.real(second * np.conj(first / strength) ** 2)
    return float(np.sum(along) / np.sum(strength))


def gamma_from_harmonic(harmonic: float) -> float:
    """Return the exponent for which a power of a sinusoidal fringe has this ratio of second
    harmonic to first.

    Powers have ratios from -0.5 to 1; others are taken for the nearest of these.
    """
    harmonic = float(np.clip(harmonic, -0.49, 0.99))
    return (1 + 2 * harmonic) / (1 - harmonic)
