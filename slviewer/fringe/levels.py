"""Multi-frequency unwrapping: from a phase that covers the projector down to the finest, level by level."""

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.limits import LEVEL_SIGMA

LONGEST = 3
"""How many of the longest periods may be combined to a beat."""


@dataclass(frozen=True)
class Level:
    """A phase made of measured ones: sum of weights * wrapped phases, with the period that this combination has."""

    period_px: float
    weights: tuple[int, ...]


def plan_levels(periods_px: tuple[float, ...], extent: int) -> tuple[Level, ...]:
    """Levels from one whose period covers ``extent`` px down to the finest period; weights are per period, as given.

    ``periods_px`` are longest first. Where none covers the extent, beats of two, then of three of the longest take
    their place (heterodyne). Raises InputError where these do not cover it either.
    """
    singles = [_combine(periods_px, {i: 1}) for i in range(len(periods_px))]
    if periods_px[0] >= extent:
        return tuple(singles)
    count = min(LONGEST, len(periods_px))
    beats = [_combine(periods_px, {j: 1, i: -1}) for i, j in combinations(range(count), 2)]
    covering = [beat for beat in beats if beat.period_px >= extent]
    if covering:
        return (min(covering, key=lambda level: level.period_px), *singles)
    if count == LONGEST:
        both = [_combine(periods_px, {0: 1, 1: -2, 2: 1})]
        both = [level for level in both if extent <= level.period_px < np.inf]
        if both:
            beat = min(beats, key=lambda level: level.period_px if level.weights[1] else np.inf)
            return (both[0], beat, *singles)
    reached = max([periods_px[0], *(beat.period_px for beat in beats)])
    listed = ", ".join(f"{p:g}" for p in periods_px)
    raise InputError(
        f"fringe periods of {listed} px tell only {reached:.0f} px apart, and the projector "
        f"has {extent}: add a longer period or Gray code"
    )


def needed_modulation(levels: tuple[Level, ...], steps: int) -> float:
    """The modulation, in standard deviations of a grey level, with which each level surely finds the order of the next.

    ``steps``: phase steps of the period with the fewest.
    """
    spread = max(
        (
            np.hypot(np.linalg.norm(longer.weights) * longer.period_px / level.period_px, np.linalg.norm(level.weights))
            for longer, level in pairwise(levels)
        ),
        default=0.0,
    )
    return float(spread * np.sqrt(2 / steps) / (2 * np.pi * LEVEL_SIGMA))


def _combine(periods_px: tuple[float, ...], weights: dict[int, int]) -> Level:
    frequency = sum(w / periods_px[i] for i, w in weights.items())
    sign = 1 if frequency >= 0 else -1
    period = 1 / abs(frequency) if frequency else np.inf
    return Level(period, tuple(sign * weights.get(i, 0) for i in range(len(periods_px))))
