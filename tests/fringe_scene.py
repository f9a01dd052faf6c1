"""Frames of a scene whose projector coordinates are known, without any geometry."""

from collections.abc import Iterable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from slviewer.fringe.patterns import profile
from slviewer.fringe.phase import PhaseMap

OVERSAMPLING = 8


def variants(cases: Iterable, *default) -> list:
    """Return all cases as parameters of a test; only those given as ``default`` are outside the
    slow tier."""
    cases = list(cases)
    assert all(case in cases for case in default)
    slow = pytest.mark.slow
    return [
        (
            case
            if case in default
            else pytest.param(*case if isinstance(case, tuple) else [case], marks=slow)
        )
        for case in cases
    ]


def slope(height=120, width=200, per_px=0.6, start=40.0):
    """(h, w) projector coordinates of a smooth, slightly wavy surface."""
    v, u = np.mgrid[:height, :width]
    return start + per_px * u + 0.1 * v + 2 * np.sin(v / 20)


def capture(
    sequence,
    coordinate,
    *,
    axis="x",
    defocus=0.8,
    psf=0.7,
    gain=180.0,
    ambient=15.0,
    read=1.0,
    shot=0.0,
    gamma=1.0,
    seed=0,
):
    """(n, h, w) uint8 frames; ``defocus`` in projector px, ``psf`` in camera px along the rows.

    ``gain`` (a number or (h, w)) is white less ambient, in grey levels; noise variance is read^2 +
    shot * level.
    """
    rng = np.random.default_rng(seed)
    frames = np.empty((len(sequence.frames), *coordinate.shape), np.uint8)
    for i in range(len(frames)):
        along, levels = profile(sequence, i)
        if along not in (None, axis):
            frames[i] = np.rint(ambient)
            continue
        light = np.repeat((levels / 255.0) ** gamma, OVERSAMPLING)
        light = gaussian_filter1d(light, defocus * OVERSAMPLING, mode="nearest")
        position = (np.arange(len(light)) + 0.5) / OVERSAMPLING - 0.5
        seen = ambient + gaussian_filter1d(
            gain * np.interp(coordinate, position, light, left=0, right=0), psf, axis=1
        )
        seen += rng.normal(size=seen.shape) * np.sqrt(read**2 + shot * seen)
        frames[i] = np.clip(np.rint(seen), 0, 255)
    return frames


def wrong(phase: PhaseMap, coordinate, part=0.4):
    """How many valid pixels are off by more than a part of the period."""
    return int(
        np.count_nonzero(np.abs(phase.coordinate - coordinate)[phase.mask] > part * phase.period_px)
    )


def coverage(phase: PhaseMap, region=...):
    """Valid pixels over illuminated ones."""
    return np.count_nonzero(phase.mask[region]) / np.count_nonzero(phase.illuminated[region])
