"""Fringe periods that a description rounds, of a whole number of fringes across the projector."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis, PatternSequence

DECIMALS = range(1, 5)
"""Of periods that may be rounded: more leave no error that matters."""
FEW_DECIMALS = 1
"""With so few, a third of all periods are near a whole number of fringes by chance."""
_BINS = 20
_SIGNIFICANT = 3.0
"""Standard errors."""


@dataclass(frozen=True)
class RoundedPeriods:
    """The ``exact`` period, px, of each described one of an axis of ``extent`` px; ``fit``: 0 where
    the frames fit the described ones, 1 where they fit the exact ones, with its standard error
    ``sigma``, infinite where they do not show it."""

    exact: dict[float, float]
    extent: int
    fit: float
    sigma: float

    @property
    def fringes(self) -> tuple[int, ...]:
        """The number of fringes of each exact period across the projector."""
        return tuple(round(self.extent / exact) for exact in self.exact.values())

    @property
    def is_taken(self) -> bool:
        """Whether the exact periods are right: several round to the described ones, which is no
        chance, and the frames do not contradict it; or they show it."""
        if self.sigma < 0.5 / _SIGNIFICANT:
            return self.fit > 0.5
        return len(self.exact) > 1 and max(map(count_decimals, self.exact)) > FEW_DECIMALS

    @property
    def is_contradicted(self) -> bool:
        """Whether the frames fit the described periods."""
        return self.sigma < 0.5 / _SIGNIFICANT and self.fit < 0.5


def find_rounded_periods(
    sequence: PatternSequence, frames: np.ndarray, decoded: PhaseMap
) -> RoundedPeriods | None:
    """Return the periods of whole numbers of fringes across the projector that those of an axis are
    rounded from, judged by its frames (n, h, w) and their absolute phase; None unless all that
    have decimals may be rounded so, and one is.

    Periods that are scaled unlike each other disagree the more, the farther from the first fringe.
    """
    exact = list_exact_periods(sequence, decoded.axis)
    if not exact:
        return None
    fit, sigma = _fit_scale(sequence, frames, decoded, exact)
    return RoundedPeriods(exact, sequence.extent(decoded.axis), fit, sigma)


def list_exact_periods(sequence: PatternSequence, axis: Axis) -> dict[float, float]:
    """Return the periods of whole numbers of fringes across the projector, by those of an axis that
    are rounded from them; empty where one that has decimals cannot be."""
    if sequence.projector_size is None:
        return {}
    exact, periods, extent = dict[float, float](), sequence.periods_px(axis), sequence.extent(axis)
    # one of two decimals may end in 0
    places = {period: count_decimals(period) for period in periods}
    most = max(places.values(), default=0)
    for period in periods:
        whole = extent / max(1, round(extent / period))
        if abs(whole - period) < 1e-6 * period:
            continue
        if most in DECIMALS and abs(whole - period) <= 0.501 * 10**-most:
            exact[period] = whole
        elif places[period]:
            return {}
    return exact


def count_decimals(period_px: float) -> int:
    """Return the number of decimals of a period, of six at most."""
    return len(f"{period_px:.6f}".rstrip("0").partition(".")[2])


def replace_periods(
    sequence: PatternSequence, axis: Axis, exact: dict[float, float]
) -> PatternSequence:
    """Return a sequence with other periods of an axis."""
    changed = tuple(
        replace(frame, period_px=exact[frame.period_px])
        if frame.kind == "phase" and frame.axis == axis and frame.period_px in exact
        else frame
        for frame in sequence.frames
    )
    return replace(sequence, frames=changed)


def _fit_scale(
    sequence: PatternSequence, frames: np.ndarray, decoded: PhaseMap, exact: dict[float, float]
) -> tuple[float, float]:
    """Return how far from the described (0) to the exact periods (1) those of the frames are, by
    the drift of each longer period's phase against the finest one's, and the standard error."""
    axis = decoded.axis
    *others, (finest, steps) = sequence.phase_shifts(axis)
    valid = np.isfinite(decoded.phase)
    fine, turns = _phasor(frames, steps)[valid], decoded.phase[valid] / (2 * np.pi)
    # the phase of a stack rises or falls with the coordinate, from the same start in all periods
    sign = (
        1
        if np.abs(np.mean(fine * np.exp(-2j * np.pi * turns)))
        > np.abs(np.mean(fine * np.exp(2j * np.pi * turns)))
        else -1
    )
    estimates = list[tuple[float, float]]()
    for period, indices in others:
        scale = exact.get(finest, finest) / finest
        drift = scale / exact.get(period, period) - 1 / period  # turns a px
        if abs(drift) < 1e-9 or len(turns) < 100:
            continue
        px = turns * finest
        phasor = _phasor(frames, indices)[valid] * np.exp(-2j * np.pi * sign * px / period)
        phasor /= np.maximum(np.abs(phasor), 1e-12)
        error = np.angle(phasor / np.mean(phasor)) * sign / (2 * np.pi)
        order = np.array_split(np.argsort(px), _BINS)
        x, y = (np.array([np.median(values[part]) for part in order]) for values in (px, error))
        (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
        estimates.append((slope / drift, float(np.sqrt(covariance[0, 0])) / abs(drift)))
    if not estimates:
        return 0.0, np.inf
    values, sigmas = np.array(estimates).T
    weights = 1 / np.maximum(sigmas, 1e-9) ** 2
    return float(np.average(values, weights=weights)), float(weights.sum() ** -0.5)


def _phasor(frames: np.ndarray, indices: Sequence[int]) -> np.ndarray:
    """Return the phase steps (n) of a stack as complex numbers (h, w)."""
    turns = np.exp(-2j * np.pi * np.arange(len(indices)) / len(indices))
    return np.tensordot(turns, frames[list(indices)].astype(np.float32), 1)
