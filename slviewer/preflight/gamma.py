"""How the camera's grey levels follow the projector's, and the table that makes them proportional."""

import numpy as np

from slviewer.fringe.response import fitted_gamma, harmonic_error_rad, linearising, nonlinearity
from slviewer.pipeline.check_results import Check
from slviewer.preflight.rig_under_test import RigUnderTest

_LEVELS = np.arange(18) * 15
CURVED = 0.03
"""Deviation from a straight line, as a share of white, from which the response is named."""
_FEWEST = 500  # pixels
_UNSTEADY = 0.02


def gamma(bench: RigUnderTest) -> tuple[Check, tuple[int, ...] | None, float]:
    """The check, the table for `PatternSequence.levels`, and the light of grey level 127.5 as a share of white."""
    where = bench.usable()
    if np.count_nonzero(where) < _FEWEST:
        sentence = "The response cannot be measured: too few pixels are illuminated and not saturated."
        return Check("gamma", "unknown", sentence, "Mend the exposure first.", {}), None, 0.5
    if bench.unsteady > _UNSTEADY:
        said = f"The response cannot be measured: the light flickers by {100 * bench.unsteady:.0f} %."
        return Check("gamma", "unknown", said, "Mend the flicker first.", {}), None, 0.5
    images = [bench.look(int(level), "response to grey levels") for level in _LEVELS]
    light = np.array([float(image[where].sum(dtype=float)) for image in images])
    if light[-1] <= light[0]:
        sentence = "The response cannot be measured: white is no brighter than black."
        return Check("gamma", "unknown", sentence, "Mend what the other checks name first.", {}), None, 0.5
    seen = (light - light[0]) / (light[-1] - light[0])
    exponent, curved = fitted_gamma(_LEVELS, seen), nonlinearity(_LEVELS, seen)
    errors = {n: harmonic_error_rad(_LEVELS, seen, n) for n in (3, 4, 6, 8)}
    figures = {
        "gamma": round(exponent, 3),
        "nonlinearity_percent": round(100 * curved, 2),
        "phase_error_rad": {str(n): round(error, 5) for n, error in errors.items()},
        "shown": _LEVELS.tolist(),
        "seen": [round(float(s), 5) for s in seen],
    }
    levels = linearising(_LEVELS, seen)
    middle = float(np.interp(127.5, _LEVELS, seen))
    if curved <= CURVED:
        said = f"Light is proportional to grey levels within {100 * curved:.1f} %."
        return Check("gamma", "good", said, "", figures), levels, middle
    said = (
        f"Light follows grey levels with a gamma of {exponent:.2f}, {100 * curved:.0f} % off a straight line: an error "
        f"of {errors[3]:.3f} rad with 3 steps and {errors[4]:.3f} rad with 4, before blur smooths it."
    )
    remedy = "Use the table that straightens it (measured just now), or 8 steps and more."
    return Check("gamma", "warning", said, remedy, figures), levels, middle
