"""Multi-frequency unwrapping, level by level: from a phase that covers the projector, or a Gray
cell, to the finest."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.layout import Layout
from slviewer.fringe.limits import LEVEL_SIGMA


@dataclass(frozen=True)
class Level:
    """Combination of measured phases: the sum of weights * wrapped phases, and the period (px) that
    it has."""

    period_px: float
    weights: tuple[int, ...]


WHOLE = 1e-3
"""How far from whole a ratio of periods may be: over fifty repetitions it comes to a twentieth of a
period."""
SAME_RANGE = 1 - 5e-4
"""Part of a length that a period must have to cover it: periods rounded to a hundred thousandth
change the beat of two that differ by a fiftieth so much."""
WIDEST_CELL = 1.25
"""Gray cell, in longest periods, up to which most of its pixels have a phase of their own; those
at its ends, where the phase repeats, are masked."""
LONGEST_BEAT_PX = 1e6
"""Beats of equal frequencies come out longer, by rounding."""


def layout_levels(layout: Layout) -> tuple[Level, ...]:
    """Return the levels by which the periods of a layout are unwrapped, the longest first.

    For a layout whose Gray code, if any, does not number the periods of its one phase shift. Raises
    InputError where the periods do not cover what they must: a Gray cell, the projector, or, where
    a relative phase is acceptable, a range of whole periods.
    """
    periods, where = tuple(shift.period_px for shift in layout.shifts), f"axis {layout.axis}"
    if layout.gray:
        cell = code_cell_px(layout)
        try:
            return plan_levels(periods, cell)
        except InputError as error:
            if cell <= WIDEST_CELL * periods[0]:
                return plan_levels(periods, periods[0])
            raise InputError(
                f"{error}, which a Gray cell spans",
                "set gray_cell_px if the cells are narrower, or add Gray bits or the steps of a"
                f" period of {cell:g} px or more",
                where,
            ) from error
    try:
        return plan_levels(periods, layout.extent)
    except InputError as error:
        if not layout.relative:
            raise InputError(
                f"{error}, which the projector spans",
                "add a longer period or Gray code, or set relative = true for a phase that is not"
                " absolute",
                where,
            ) from error
    return plan_levels(periods, find_common_range(periods))


def unambiguous_px(layout: Layout) -> float:
    """Return the unambiguous range of a layout in projector px, where it is less than the
    projector; else infinite."""
    if layout.gray or not layout.shifts:
        return np.inf
    reach = layout_levels(layout)[0].period_px
    return np.inf if reach >= SAME_RANGE * layout.extent else reach


def lowest_coordinate(period_px: float, extent: float) -> float:
    """Return the coordinate px at which the longest period begins; its excess is split evenly
    between both ends."""
    return -0.5 - (period_px - extent) / 2


def code_cell_px(layout: Layout) -> float:
    """Return the width, px, of the cells that all `code_bits` number."""
    return layout.gray_cell_px / (1 if layout.complementary is None else 2)


def cell_misfit(layout: Layout) -> float:
    """Return the largest distance, in periods of the first level, of a coordinate from the middle
    of its Gray cell.

    Half way between half a cell, where the cell ends, and half a period, where the next order
    begins. In a cell wider than a period, where the phase of its other end begins.
    """
    half = 0.5 * code_cell_px(layout) / layout_levels(layout)[0].period_px
    return min(0.25 + 0.5 * half, 1 - half)


@lru_cache(64)
def plan_levels(periods_px: tuple[float, ...], extent: float) -> tuple[Level, ...]:
    """Plan the levels from one whose period covers ``extent`` px down to the finest; weights are
    per period, as given.

    ``periods_px`` are longest first. Where none covers the extent, those beats of two of them, and
    beats of two beats, take their place that need the least modulation (heterodyne). Raises
    InputError where these do not cover it either.
    """
    singles = tuple(_combine_periods(periods_px, weights) for weights in np.eye(len(periods_px)))
    if periods_px[0] >= SAME_RANGE * extent:
        return singles
    beats = [beat for beat in _list_beats(periods_px) if beat.period_px > periods_px[0]]
    paths: list[tuple[float, int, tuple[Level, ...]]] = []
    for level in (*beats, singles[0]):
        options = [
            (max(spread, _measure_spread(path[-1], level)), length + 1, (*path, level))
            for spread, length, path in paths
        ]
        if level.period_px >= SAME_RANGE * extent:
            options.append((0.0, 1, (level,)))
        if options:
            paths.append(min(options, key=lambda option: option[:2]))
    if paths:
        return (*paths[-1][2][:-1], *singles)
    reached = max(level.period_px for level in (*beats, singles[0]))
    raise InputError(
        f"fringe periods of {_join_periods(periods_px)} px tell only {reached:.0f} px apart, not"
        f" {extent:g}"
    )


def unwrap_levels(
    levels: tuple[Level, ...], wrapped: list[np.ndarray], low: float, near: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Unwrap level by level: coordinate px and order of the finest period, float64 of the shape of
    its phase.

    ``wrapped``: phases rad of all periods, longest first. The first level is the one near the
    coordinates ``near`` px, or without them from ``low`` px on. Third, for each level that is
    compared: the periods between the coordinate of the previous level and the level's own phase,
    whole where both agree.
    """
    coordinate, order, turns = near, np.zeros(np.shape(wrapped[0])), list[np.ndarray]()
    for level in levels:
        angle = sum(
            w * psi.astype(np.float64) for w, psi in zip(level.weights, wrapped, strict=True) if w
        )
        own = np.asarray(angle * (level.period_px / (2 * np.pi)))
        if coordinate is None:
            order = -np.floor((own - low) / level.period_px)
        else:
            turns.append((coordinate - own) / level.period_px)
            order = np.rint(turns[-1])
        coordinate = own + order * level.period_px
    assert coordinate is not None
    return coordinate, order, turns


def longest_range(periods_px: tuple[float, ...]) -> float:
    """Return the longest of the periods and their beats, px."""
    return max(periods_px[0], *(beat.period_px for beat in _list_beats(periods_px)), 0.0)


def find_common_range(periods_px: tuple[float, ...]) -> float:
    """Return the range px after which all phases of the periods repeat, and within which
    coordinates are unambiguous.

    It is the longest period or a beat. Raises InputError where no such range holds whole
    numbers of all periods.
    """
    beats = [beat.period_px for beat in _list_beats(periods_px)]
    for reach in sorted([periods_px[0], *beats], reverse=True):
        turns = reach / np.array(periods_px)
        if (np.abs(turns - np.rint(turns)) <= WHOLE).all():
            return float(reach)
    raise InputError(
        f"fringe periods of {_join_periods(periods_px)} px share no range of which each is a whole"
        " part, so that even a relative phase cannot be decoded",
        "give the size of a projector that the longest covers, or leave out the steps of all but"
        f" {periods_px[-1]:g} px",
    )


def required_modulation(levels: tuple[Level, ...], steps: int) -> float:
    """Return the modulation, in standard deviations of a grey level, that each level needs for the
    order of the next.

    ``steps``: phase steps of the period with the fewest.
    """
    spread = max((_measure_spread(*both) for both in pairwise(levels)), default=0.0)
    return float(spread * np.sqrt(2 / steps) / (2 * np.pi * LEVEL_SIGMA))


def _measure_spread(longer: Level, level: Level) -> float:
    """Return the standard deviation, in periods of ``level``, of the step to it from the one
    before, per that of the phases in periods."""
    own, before = np.linalg.norm(level.weights), np.linalg.norm(longer.weights)
    return float(np.hypot(before * longer.period_px / level.period_px, own))


def _list_beats(periods_px: tuple[float, ...]) -> list[Level]:
    """Return the beats of two of the periods, and the beats of two of those of the five longest,
    longest first."""
    units = np.eye(len(periods_px))
    twos, some = ([i - j for i, j in combinations(each, 2)] for each in (units, units[:5]))
    fours = [i + sign * j for i, j in combinations(some, 2) for sign in (1, -1)]
    beats = {_combine_periods(periods_px, weights) for weights in twos + fours}
    finite = [beat for beat in beats if beat.period_px < LONGEST_BEAT_PX]
    return sorted(finite, key=lambda beat: (-beat.period_px, beat.weights))


def _join_periods(periods_px: tuple[float, ...]) -> str:
    """Return periods as text, separated by commas."""
    return ", ".join(f"{p:g}" for p in periods_px)


def _combine_periods(periods_px: tuple[float, ...], weights: np.ndarray) -> Level:
    """Return the beat of several periods whose phases are added with integer weights (m,)."""
    frequency = float(weights @ (1 / np.array(periods_px)))
    weights = weights * np.sign(frequency)
    return Level(1 / max(abs(frequency), 1e-9), tuple(weights.astype(int).tolist()))
