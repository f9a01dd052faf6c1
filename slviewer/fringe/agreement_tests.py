"""Tests that the frames of one axis pass if their description is correct."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slviewer.fringe.axis_agreement import FEWEST_EDGES, Agreement
from slviewer.fringe.axis_reader import AxisFrames
from slviewer.fringe.contradiction import Contradiction

MIN_RULE, MIN_COMMON, MIN_RISING = 0.5, 0.5, 0.5
"""Shares of the code edges below which the description fails: a wrong one gives no more than
chance. Correct ones gave 0.93 and more, also for a cluttered scene in room light."""
MIN_OPPOSED = 0.8
"""Share below which two images are not a bit and its inverse: images of other patterns are alike at
half of the pixels."""
SURE = 0.75
"""Shares that a hypothesis must exceed to be reported."""
MIN_LEVEL = 0.4
"""Length of the mean unit vector of the step from one period to the next. Steps that spread evenly
give 0, and noise that loses every twentieth order 0.5."""
MAX_BEGIN_TURNS = 0.15
"""Largest offset between Gray code and fringes, in periods: the tolerance of decoding at the code's
edges."""
MAX_LEVEL_TURNS = 0.2
"""Largest offset between two periods, in turns: half the tolerance of decoding."""
SURE_LEVEL = 0.9
"""Above this length the mean step is accurate to a hundredth of a period, and half of that offset
is the limit."""
MAX_CELL = 0.12
"""Relative error of a cell's width: with a smaller one, the edges in view would still have one
phase."""
MAX_OUTSIDE = 0.01
"""Largest share of coordinates outside the projector: blur moves a few across its border."""
CERTAIN = 0.93
"""Shares at which no other hypothesis needs to be tried."""


@dataclass(frozen=True)
class Answer:
    """Contradictions that together explain the frames of an axis, and the agreement that results
    from them.

    ``score``: sum of the agreement shares, see `sum_shares`. ``is_certain``: whether no other
    hypothesis needs to be tried.
    """

    contradictions: tuple[Contradiction, ...]
    score: float
    is_certain: bool = False


def explain(contradictions: Iterable[Contradiction], a: Agreement) -> Answer:
    """Return the answer of contradictions with which the frames agree as ``a`` says."""
    return Answer(tuple(contradictions), sum_shares(a), is_certain(a))


def sum_shares(a: Agreement) -> float:
    """Return the sum of the agreement shares (0 to 1 each); an unknown share (NaN) counts as
    0.5."""
    return float(sum(0.5 if np.isnan(share) else share for share in _list_shares(a)))


def _list_shares(a: Agreement) -> list[float]:
    """Return the agreement shares (0 to 1 each); NaN where a test cannot be made."""
    return [a.opposed, a.rule, a.common, a.rising, *a.level_common]


def is_certain(a: Agreement) -> bool:
    """Return whether every known share exceeds ``CERTAIN``."""
    return all(np.isnan(share) or share > CERTAIN for share in _list_shares(a))


def failed_tests(frames: AxisFrames, a: Agreement) -> set[str]:
    """Return the names of the tests that the frames fail; a test that cannot be made counts as
    passed.

    The names are "bits", "inverse", "rule", "common", "begin", "rising", "cell", "levels", "level
    offset" and "outside".
    """
    failed = set()
    if a.unreadable is not None:
        failed.add("bits")
    if a.opposed < MIN_OPPOSED:
        failed.add("inverse")
    if a.rule < MIN_RULE:
        failed.add("rule")
    if a.edges >= FEWEST_EDGES and frames.fringe is not None:
        if a.common < MIN_COMMON:
            failed.add("common")
        elif abs(wrap(a.begin_turns - frames.origin_px / frames.fringe[0])) > MAX_BEGIN_TURNS:
            failed.add("begin")
        if a.rising < MIN_RISING:
            failed.add("rising")
        if abs(a.turns_per_cell * frames.fringe[0] / frames.cell_px - 1) > MAX_CELL:
            failed.add("cell")
    if any(common < MIN_LEVEL for common in a.level_common):
        failed.add("levels")
    elif any(
        abs(turns) > (MAX_LEVEL_TURNS if common < SURE_LEVEL else MAX_LEVEL_TURNS / 2)
        for turns, common in zip(a.level_turns, a.level_common, strict=True)
    ):
        failed.add("level offset")
    if a.outside > MAX_OUTSIDE:
        failed.add("outside")
    return failed


def has_evidence(frames: AxisFrames, a: Agreement) -> bool:
    """Return whether the frames give positive evidence for a hypothesis, rather than merely no test
    against it.

    Every share that can be measured must exceed ``SURE``, and enough code edges, or several
    periods, must be in view.
    """
    if frames.bits and not (a.edges >= FEWEST_EDGES and a.rule > SURE):
        return False
    if np.isfinite(a.common) and not (a.common > SURE and a.rising > SURE):
        return False
    return bool(frames.bits) or (bool(a.level_common) and min(a.level_common) > SURE)


def is_proven(frames: AxisFrames, a: Agreement) -> bool:
    """Return whether the frames fail no test, and give positive evidence as well."""
    return not failed_tests(frames, a) and has_evidence(frames, a)


def wrap(turns: float) -> float:
    """Wrap a number of periods to the range -0.5 ... 0.5."""
    return float((turns + 0.5) % 1 - 0.5)
