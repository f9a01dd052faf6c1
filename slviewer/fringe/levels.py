"""Multi-frequency unwrapping, level by level: from a phase that covers the projector, or a Gray
cell, to the finest."""

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.layout import SAME_WIDTH, Layout
from slviewer.fringe.limits import LEVEL_SIGMA

LONGEST = 3
"""How many of the longest periods may be combined to a beat."""


@dataclass(frozen=True)
class Level:
    """Combination of measured phases: the sum of weights * wrapped phases, and the period (px) that
    it has."""

    period_px: float
    weights: tuple[int, ...]


WHOLE = 1e-3
"""How far from whole a ratio of periods may be: over fifty repetitions it comes to a twentieth of a
period."""


def layout_levels(layout: Layout) -> tuple[Level, ...]:
    """Return the levels by which the periods of a layout are unwrapped, the longest first.

    For a layout whose Gray code, if any, does not number the periods of its one phase shift. Raises
    InputError where the periods do not cover what they must: a Gray cell, the projector, or, where
    a relative phase is acceptable, a range of whole periods.
    """
    periods, where = tuple(shift.period_px for shift in layout.shifts), f"axis {layout.axis}: "
    if layout.gray:
        cell = code_cell_px(layout)
        try:
            return plan_levels(periods, cell * (1 - SAME_WIDTH))
        except InputError as error:
            raise InputError(
                f"{where}{error}, which a Gray cell spans: set gray_cell_px if the cells are"
                f" narrower, or add Gray bits or the steps of a period of {cell:g} px or more"
            ) from error
    try:
        return plan_levels(periods, layout.extent)
    except InputError as error:
        if not layout.relative:
            raise InputError(
                f"{where}{error}, which the projector spans: add a longer period or Gray code, or"
                " set relative = true for a phase that is not absolute"
            ) from error
    return plan_levels(periods, find_common_range(periods))


def unambiguous_px(layout: Layout) -> float:
    """Return the unambiguous range of a layout in projector px, where it is less than the
    projector; else infinite."""
    if layout.gray or not layout.shifts:
        return np.inf
    reach = layout_levels(layout)[0].period_px
    return np.inf if reach >= layout.extent else reach


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
    begins.
    """
    return 0.25 * (1 + code_cell_px(layout) / layout_levels(layout)[0].period_px)


def plan_levels(periods_px: tuple[float, ...], extent: float) -> tuple[Level, ...]:
    """Plan the levels from one whose period covers ``extent`` px down to the finest; weights are
    per period, as given.

    ``periods_px`` are longest first. Where none covers the extent, beats of two, then of three of
    the longest take their place (heterodyne). Raises InputError where these do not cover it either.
    """
    singles = [_combine_periods(periods_px, {i: 1}) for i in range(len(periods_px))]
    if periods_px[0] >= extent:
        return tuple(singles)
    every = _list_beats(periods_px)
    covering = [beat for beat in every if extent <= beat.period_px < np.inf]
    if len(periods_px) > LONGEST and covering:
        return (
            *_chain_beats(min(covering, key=lambda level: level.period_px), every, singles[0]),
            *singles,
        )
    beats = _list_beats(periods_px, LONGEST)
    covering = [beat for beat in beats if beat.period_px >= extent]
    if covering:
        return (min(covering, key=lambda level: level.period_px), *singles)
    if len(periods_px) >= LONGEST:
        both = _combine_periods(periods_px, {0: 1, 1: -2, 2: 1})
        if extent <= both.period_px < np.inf:
            beat = min(beats, key=lambda level: level.period_px if level.weights[1] else np.inf)
            return (both, beat, *singles)
    reached = max([periods_px[0], *(beat.period_px for beat in beats)])
    raise InputError(
        f"fringe periods of {_join_periods(periods_px)} px tell only {reached:.0f} px apart, not"
        f" {extent:g}"
    )


def _chain_beats(longest: Level, beats: list[Level], single: Level) -> tuple[Level, ...]:
    """Return levels from ``longest`` down to above ``single``: of the beats those between which the
    largest ratio of periods, and then the number of levels, is least."""
    nodes = sorted(
        {b for b in beats if single.period_px < b.period_px < longest.period_px},
        key=lambda b: -b.period_px,
    )
    best: list[tuple[float, int, tuple[Level, ...]]] = []
    for level in (longest, *nodes, single):
        options = [
            (max(ratio, path[-1].period_px / level.period_px), length + 1, (*path, level))
            for ratio, length, path in best
        ]
        best.append(min(options, key=lambda option: option[:2]) if options else (1.0, 0, (level,)))
    return best[-1][2][:-1]


def unwrap_levels(
    levels: tuple[Level, ...], wrapped: list[np.ndarray], low: float, near: np.ndarray | None = None
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


def find_common_range(periods_px: tuple[float, ...]) -> float:
    """Return the range px after which all phases of the periods repeat, and within which
    coordinates are unambiguous.

    It is the longest period or a beat of two. Raises InputError where no such range holds whole
    numbers of all periods.
    """
    beats = _list_beats(periods_px, LONGEST)
    for reach in sorted({periods_px[0], *(beat.period_px for beat in beats)}, reverse=True):
        turns = reach / np.array(periods_px)
        if reach < np.inf and (np.abs(turns - np.rint(turns)) <= WHOLE).all():
            return float(reach)
    raise InputError(
        f"fringe periods of {_join_periods(periods_px)} px share no range of which each is a whole"
        " part, so that even a relative phase cannot be decoded: give the size of a projector that"
        f" the longest covers, or leave out the steps of all but {periods_px[-1]:g} px"
    )


def required_modulation(levels: tuple[Level, ...], steps: int) -> float:
    """Return the modulation, in standard deviations of a grey level, that each level needs for the
    order of the next.

    ``steps``: phase steps of the period with the fewest.
    """
    spread = max(
        (
            np.hypot(
                np.linalg.norm(longer.weights) * longer.period_px / level.period_px,
                np.linalg.norm(level.weights),
            )
            for longer, level in pairwise(levels)
        ),
        default=0.0,
    )
    return float(spread * np.sqrt(2 / steps) / (2 * np.pi * LEVEL_SIGMA))


def _list_beats(periods_px: tuple[float, ...], most: int | None = None) -> list[Level]:
    """Return the beats of two of the periods, of the ``most`` longest ones if given."""
    pairs = combinations(range(len(periods_px))[:most], 2)
    return [_combine_periods(periods_px, {j: 1, i: -1}) for i, j in pairs]


def _join_periods(periods_px: tuple[float, ...]) -> str:
    """Return periods as text, separated by commas."""
    return ", ".join(f"{p:g}" for p in periods_px)


def _combine_periods(periods_px: tuple[float, ...], weights: dict[int, int]) -> Level:
    """Return the beat of several periods whose phases are added with integer weights."""
    frequency = sum(w / periods_px[i] for i, w in weights.items())
    sign = 1 if frequency >= 0 else -1
    period = 1 / abs(frequency) if frequency else np.inf
    return Level(period, tuple(sign * weights.get(i, 0) for i in range(len(periods_px))))
