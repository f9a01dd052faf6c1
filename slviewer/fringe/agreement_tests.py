"""The tests that the frames of one axis pass where their description is right."""

from dataclasses import dataclass

import numpy as np

from slviewer.fringe.axis_agreement import FEWEST_EDGES, Agreement
from slviewer.fringe.axis_reader import AxisFrames
from slviewer.fringe.contradiction import Contradiction

MIN_RULE, MIN_COMMON, MIN_RISING = 0.5, 0.5, 0.5
"""Shares of the code edges below which the description fails: a wrong one gives no more than chance. Right ones gave
0.93 and more, also for a cluttered scene in room light."""
MIN_OPPOSED = 0.8
"""Share below which a bit and its inverse are none: half of the pixels are alike in images of two other patterns."""
SURE = 0.75
"""Shares that a hypothesis must reach to be named."""
MIN_LEVEL = 0.4
"""Length of the mean unit vector of the step from one period to the next. Steps that spread evenly give 0, and noise
that loses every twentieth order 0.5."""
MAX_BEGIN_TURNS = 0.15
"""Of a period, by which Gray code and fringes may be apart: decoding allows for so much at the code's edges."""
MAX_LEVEL_TURNS = 0.2
"""Half of what decoding allows for between two periods."""
SURE_LEVEL = 0.9
"""Above this length the mean step is known to a hundredth of a period, and half of that is too much."""
MAX_CELL = 0.12
"""Part of a cell's width: of two periods that differ by less, edges in view would still fall at one phase."""
MAX_OUTSIDE = 0.01
"""Share of coordinates that may lie beyond the projector, along whose border blur moves a few."""
CERTAIN = 0.93
"""Shares at which no other hypothesis needs to be tried."""


@dataclass(frozen=True)
class Answer:
    """Contradictions that explain the frames together, and how well these then agree."""

    contradictions: tuple[Contradiction, ...]
    score: float
    is_certain: bool = False


def sum_shares(a: Agreement) -> float:
    """The sum of the shares that tell how well the frames agree; a half for what is not known."""
    return float(sum(0.5 if np.isnan(share) else share for share in _shares(a)))


def _shares(a: Agreement) -> list[float]:
    """Shares (0 to 1) of the tests of an agreement; NaN where a test cannot be made."""
    return [a.opposed, a.rule, a.common, a.rising, *a.level_common]


def is_certain(a: Agreement) -> bool:
    """Whether every known share exceeds ``CERTAIN``."""
    return all(np.isnan(share) or share > CERTAIN for share in _shares(a))


def failed_tests(frames: AxisFrames, a: Agreement) -> set[str]:
    """The tests that the frames fail; a test that cannot be made is passed."""
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


def is_supported(frames: AxisFrames, a: Agreement) -> bool:
    """Whether a hypothesis has something to show for itself."""
    if frames.bits and not (a.edges >= FEWEST_EDGES and a.rule > SURE):
        return False
    if np.isfinite(a.common) and not (a.common > SURE and a.rising > SURE):
        return False
    return bool(frames.bits) or (bool(a.level_common) and min(a.level_common) > SURE)


def wrap(turns: float) -> float:
    """-0.5 ... 0.5."""
    return float((turns + 0.5) % 1 - 0.5)
