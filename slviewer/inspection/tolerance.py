"""Whether deviations stay within a tolerance, as far as their uncertainty lets one say."""

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.acceptance import judge_property, make_length_error
from slviewer.inspection.deviation import Deviation
from slviewer.records.acceptance import Decision
from slviewer.records.measurement import ToleranceVerdict

LIMITED = "deviation of 99.7 % of the points"


def judge_deviation(
    deviation: Deviation, sigma_mm: np.ndarray, tolerance_mm: float
) -> ToleranceVerdict:
    """The verdict on a deviation; ``sigma_mm`` (n,): standard uncertainty of its points along the
    surface's normal."""
    if not tolerance_mm > 0:
        raise InputError(f"A tolerance of {tolerance_mm:g} mm was given: give a positive one.")
    counted = deviation.counted
    signed = deviation.signed[counted].astype(np.float64)
    U = 2 * np.hypot(np.nan_to_num(sigma_mm[counted].astype(np.float64)), deviation.alignment_mm)
    typical = float(np.median(U))
    off = np.abs(signed)
    inside, outside = off + U <= tolerance_mm, off - U > tolerance_mm
    numbers = deviation.statistics()
    ends = [
        make_length_error(LIMITED, end, numbers[end], typical / 2) for end in ("p_low", "p_high")
    ]
    decisions = [
        judge_property(LIMITED, [end], tolerance_mm).decision or "undecided" for end in ends
    ]
    return ToleranceVerdict(
        tolerance_mm,
        typical,
        (ends[0].error_mm, decisions[0]),
        (ends[1].error_mm, decisions[1]),
        judge_property(LIMITED, ends, tolerance_mm).decision or "undecided",
        100 * float(np.mean(off <= tolerance_mm)),
        100 * float(inside.mean()),
        100 * float(outside.mean()),
        100 * float(np.mean(~inside & ~outside)),
    )


def judge_limits(value: float, U: float, lower: float | None, upper: float | None) -> Decision:
    """Decide by guard bands whether a value of expanded uncertainty U (k = 2) lies between limits,
    of which one may be absent: "pass" inside both by U, "fail" beyond one by more than U, else
    "undecided"."""
    low, high = (-np.inf if lower is None else lower), (np.inf if upper is None else upper)
    if not (np.isfinite(value) and np.isfinite(U)):
        return "undecided"
    if low + U <= value <= high - U:
        return "pass"
    return "fail" if value < low - U or value > high + U else "undecided"
