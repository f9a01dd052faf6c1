"""What a test says of one property: an error, its uncertainty, and whether it is allowed.

There are two kinds of ranges. Of *form* and *flatness* the error itself is a range: the narrowest interval that
holds 95 % (99.7 %) of the points' deviations from the fitted shape, so that a few stray points do not decide. Of
*size*, *spacing* and *scale* the error is one number, and its ranges are where the true error lies with 95 % (99.7 %)
probability, by the test's own uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Decision = Literal["pass", "fail", "undecided"]
K_95, K_997 = 1.96, 2.97


def narrowest_range(deviations: np.ndarray, share: float) -> float:
    """Width of the narrowest interval that holds so great a share of the deviations (n,)."""
    values = np.sort(deviations[np.isfinite(deviations)])
    inside = max(int(np.ceil(share * len(values))), 1)
    return float((values[inside - 1 :] - values[: len(values) - inside + 1]).min())


@dataclass(frozen=True)
class AcceptanceFigure:
    """One property at one position: ``error_mm`` with the test's expanded uncertainty ``U_mm`` (k = 2).

    ``within_95_mm``, ``within_997_mm``: (low, high), as the module says; of form and flatness low is 0 and high the
    width, and the error is the 95 % width.
    """

    property: str
    position: str
    error_mm: float
    U_mm: float
    within_95_mm: tuple[float, float]
    within_997_mm: tuple[float, float]

    @classmethod
    def of_form(cls, name: str, position: str, deviations: np.ndarray, U_mm: float) -> "AcceptanceFigure":
        """Return the figure of form from points' deviations (n,) mm from their shape."""
        inner, outer = narrowest_range(deviations, 0.95), narrowest_range(deviations, 0.997)
        return cls(name, position, inner, U_mm, (0.0, inner), (0.0, outer))

    @classmethod
    def of_length(cls, name: str, position: str, error_mm: float, u_mm: float) -> "AcceptanceFigure":
        """Return the figure of a length error with its standard uncertainty."""
        inner, outer = K_95 * u_mm, K_997 * u_mm
        return cls(
            name,
            position,
            error_mm,
            2 * u_mm,
            (error_mm - inner, error_mm + inner),
            (error_mm - outer, error_mm + outer),
        )


@dataclass(frozen=True)
class Judgement:
    """One property over all positions: the ``worst`` figure, the limit, and the decision (None without a limit)."""

    property: str
    worst: AcceptanceFigure
    limit_mm: float | None
    decision: Decision | None


def judge_property(name: str, figures: Sequence[AcceptanceFigure], limit_mm: float | None) -> Judgement:
    """The decision on one property from its figures at all positions."""
    mine = [figure for figure in figures if figure.property == name]
    worst = max(mine, key=lambda figure: abs(figure.error_mm) + figure.U_mm)
    return Judgement(name, worst, limit_mm, None if limit_mm is None else decide(mine, limit_mm))


def decide(figures: Sequence[AcceptanceFigure], limit_mm: float) -> Decision:
    """Decide with a guard band: fail if any error exceeds the limit by more than U, pass if error + U never does."""
    if any(abs(figure.error_mm) - figure.U_mm > limit_mm for figure in figures):
        return "fail"
    return "pass" if all(abs(figure.error_mm) + figure.U_mm <= limit_mm for figure in figures) else "undecided"
