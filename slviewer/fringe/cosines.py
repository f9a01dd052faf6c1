"""Cosines fitted to phase steps, and the sample of rows that statistics of frames come from."""

from functools import cache

import numpy as np

PIXELS = 60_000
"""Number of sampled pixels: their statistics are accurate to half a percent."""
FEWEST = 500
"""Number of valid pixels below which a frame is not judged."""
HIGHEST = 6
"""The highest harmonic of the fringe that is attributed to gamma."""


def cosine_columns(steps: np.ndarray, n: int, own: int) -> np.ndarray:
    """Return the design matrix (len(steps), 1 + 2 own) of a fringe: constant, cosines and sines at
    each step of n.

    ``own``: number of harmonics.
    """
    angle = 2 * np.pi * np.asarray(steps, float) / n
    harmonics = [f(h * angle) for h in range(1, own + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *harmonics], axis=1)


def select_rows(height: int, width: int, pixels: int = PIXELS) -> np.ndarray:
    """Return the indices of evenly spread rows that hold about ``pixels`` pixels."""
    count = min(height, max(1, round(pixels / width)))
    return np.unique(np.linspace(0, height - 1, count).round().astype(int))


def estimate_roughness(frames: np.ndarray, width: int) -> float:
    """Return the grey levels by which neighbours along a row deviate from a smooth curve, at least
    0.29.

    ``frames`` (n, p) of whole rows of ``width`` pixels, integral grey levels. A fault of a frame
    does not affect it. The minimum is the noise of rounding: dark and saturated pixels do not
    differ at all.
    """
    third = np.diff(frames.reshape(len(frames), -1, width), n=3, axis=-1).ravel()
    # faster than sorting integral values
    counts = np.cumsum(np.bincount(np.abs(third, out=third).astype(np.intp)))
    median = float(
        np.searchsorted(counts, [(third.size - 1) // 2, third.size // 2], side="right").mean()
    )
    return max(median / (0.6745 * np.sqrt(20)), 12**-0.5)  # 1 + 9 + 9 + 1 variances


def compute_median(values: np.ndarray) -> float:
    """Return the median of a few values, none NaN, as `numpy.median` does in several times the
    time; NaN for none."""
    ordered, count = np.sort(values, axis=None), np.size(values)
    if not count:
        return np.nan
    return float((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def fit_cosine(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return background (p,) float32 and modulation e^(i phase) (p,) complex64 of ``frames`` (n,
    p), equidistant steps.

    The phase is that of a positive phase sign.
    """
    n = len(frames)
    wave = np.exp(-2j * np.pi * np.arange(n) / n).astype(np.complex64) * np.float32(2 / n)
    phasor = np.empty(frames.shape[1], np.complex64)
    phasor.real, phasor.imag = np.einsum("wk,kp->wp", np.stack([wave.real, wave.imag]), frames)
    return frames.mean(axis=0), phasor


def evaluate_cosine(background: np.ndarray, phasor: np.ndarray, n: int) -> np.ndarray:
    """Return the n steps (n, p) float32 of the cosines that `fit_cosine` has fitted."""
    angle = (2 * np.pi * np.arange(n) / n)[:, None]
    return np.asarray(background + np.real(phasor * np.exp(1j * angle).astype(np.complex64)))


def measure_concentration(phasor: np.ndarray) -> float:
    """Return the length of the mean unit phasor (p,): 0 for evenly spread phases, 1 for a common
    one."""
    return abs(complex(np.mean(phasor / np.maximum(np.abs(phasor), 1e-6))))


def fit_common_harmonics(frames: np.ndarray, phasor: np.ndarray, own: int) -> np.ndarray:
    """Fit the harmonics beyond ``own`` that all pixels share, with each fringe's phase and
    strength; returns (n, p).

    Harmonic m of the fringe appears among n steps as the m-th, or as its alias.
    """
    n = len(frames)
    waves, aliases = _list_common_harmonics(n, own)
    if not aliases:
        return np.zeros_like(frames)
    strength = np.abs(phasor)
    unit = phasor / np.maximum(strength, np.float32(1e-6))
    powers = {1: unit}
    for m in range(2, HIGHEST + 1):
        powers[m] = powers[m - 1] * unit
    measured = np.einsum("wk,kp->wp", waves, frames)
    parts = np.empty_like(measured)
    for place, (scale, direct, mirrored) in enumerate(aliases):
        residual = np.empty_like(phasor)
        residual.real, residual.imag = scale * measured[2 * place : 2 * place + 2]
        design = np.stack(
            [strength * powers[m] for m in direct]
            + [strength * np.conj(powers[m]) for m in mirrored]
        )
        normal, moment = design.conj() @ design.T, design.conj() @ residual
        if len(design) == 1:  # the pseudo-inverse of one number, in a tenth of the time
            weights = moment * (1 / normal.real[0]) if normal[0, 0] else np.zeros_like(moment)
        else:
            weights = np.linalg.pinv(normal, rcond=1e-4) @ moment
        common = np.einsum("r,rp->p", weights, design)
        parts[2 * place], parts[2 * place + 1] = common.real, common.imag
    return waves.T @ parts


@cache
def _list_common_harmonics(
    n: int, own: int
) -> tuple[np.ndarray, list[tuple[np.float32, list[int], list[int]]]]:
    """Return the waves beyond harmonic ``own`` of n steps, (2 q, n) float32, in which harmonics of
    a fringe appear.

    Also, for each of the q: the scale of its amplitude, and the harmonics that appear in it
    directly and mirrored.
    """
    waves, aliases = [np.zeros((0, n))], []
    for q in range(own + 1, n // 2 + 1):
        direct, mirrored = (
            [m for m in range(2, HIGHEST + 1) if (m + s * q) % n == 0] for s in (-1, 1)
        )
        if direct or mirrored:
            angle = 2 * np.pi * q * np.arange(n) / n
            waves.append(np.stack([np.cos(angle), -np.sin(angle)]))
            aliases.append((np.float32((1 if 2 * q == n else 2) / n), direct, mirrored))
    return np.concatenate(waves).astype(np.float32), aliases
