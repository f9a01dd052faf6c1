"""What a test says of one property: an error, its uncertainty, and whether it is allowed.

There are two kinds of ranges. Of *form* and *flatness* the error itself is a range: the narrowest
interval that holds 95 % (99.7 %) of the points' deviations from the fitted shape, so that a few
stray points do not decide. Of *size*, *spacing* and *scale* the error is one number, and its ranges
are where the true error lies with 95 % (99.7 %) probability, by the test's own uncertainty.
"""

from collections.abc import Sequence

import numpy as np

from slviewer.records.acceptance import Decision, JudgedProperty, PropertyError

K_95, K_997 = 1.96, 2.97


def narrowest_range(deviations: np.ndarray, share: float) -> float:
    """Width of the narrowest interval that holds so great a share of the deviations (n,)."""
    values = np.sort(deviations[np.isfinite(deviations)])
    inside = max(int(np.ceil(share * len(values))), 1)
    return float((values[inside - 1 :] - values[: len(values) - inside + 1]).min())


def make_form_error(name: str, position: str, deviations: np.ndarray, U_mm: float) -> PropertyError:
    """Return the error of form from points' deviations (n,) mm from their shape."""
    inner, outer = narrowest_range(deviations, 0.95), narrowest_range(deviations, 0.997)
    return PropertyError(name, position, inner, U_mm, (0.0, inner), (0.0, outer))


def make_length_error(name: str, position: str, error_mm: float, u_mm: float) -> PropertyError:
    """Return the error of a length with its standard uncertainty."""
    inner, outer = ((error_mm - k * u_mm, error_mm + k * u_mm) for k in (K_95, K_997))
    return PropertyError(name, position, error_mm, 2 * u_mm, inner, outer)


def judge_property(
    name: str, figures: Sequence[PropertyError], limit_mm: float | None
) -> JudgedProperty:
    """The decision on one property from its figures at all positions."""
    mine = [figure for figure in figures if figure.property == name]
    worst = max(mine, key=lambda figure: abs(figure.error_mm) + figure.U_mm)
    return JudgedProperty(
        name, worst, limit_mm, None if limit_mm is None else decide(mine, limit_mm)
    )


def decide(figures: Sequence[PropertyError], limit_mm: float) -> Decision:
    """Decide with a guard band: fail if any error exceeds the limit by more than U, pass if error +
    U never does."""
    if any(abs(figure.error_mm) - figure.U_mm > limit_mm for figure in figures):
        return "fail"
    return (
        "pass"
        if all(abs(figure.error_mm) + figure.U_mm <= limit_mm for figure in figures)
        else "undecided"
    )
