"""Whether a capture is too bright or too dark."""

from collections.abc import Mapping

import numpy as np

from slviewer.fringe.cosines import select_rows
from slviewer.fringe.layout import white_level
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.check_results import Check, CheckVerdict
from slviewer.pipeline.operation import Warn

CLIPPED, MUCH_CLIPPED = 0.005, 0.05
"""Shares of the illuminated pixels that are saturated: a warning, and bad."""
WEAK, TOO_WEAK = 0.4, 0.12
"""Of full scale, that the brightest illuminated pixels should reach: below, a warning, and bad."""
_BRIGHTER = "Raise the exposure, or open the aperture."


def check_capture_exposure(
    sequence: PatternSequence, frames: np.ndarray, phases: Mapping[Axis, PhaseMap]
) -> Check:
    """Whether the frames (n, h, w) of a capture are too bright or too dark, by the pixels that see
    the patterns."""
    full = white_level(sequence, frames, range(len(frames)))
    illuminated = np.logical_or.reduce([phase.illuminated for phase in phases.values()])
    if not illuminated.any():
        return Check("exposure", "bad", "No pixel sees the patterns.", _BRIGHTER, {})
    rows = select_rows(*frames.shape[1:])
    coded = [i for i, frame in enumerate(sequence.frames) if frame.kind != "texture"]
    brightest = np.max([frames[i][rows] for i in coded], axis=0)
    levels = brightest[illuminated[rows]] if illuminated[rows].any() else brightest.ravel()
    share = float(np.quantile(levels, 0.995)) / full
    clipped = max(
        float(np.mean(phase.reason[phase.illuminated] == Reason.SATURATED))
        for phase in phases.values()
    )
    sentence = f"The brightest of the scene reaches {100 * share:.0f} % of the camera's range"
    verdict: CheckVerdict = "good"
    remedy = ""
    if clipped > CLIPPED:
        verdict = "bad" if clipped > MUCH_CLIPPED else "warning"
        sentence = f"{100 * clipped:.1f} % of the illuminated pixels are saturated."
        remedy = "Lower the exposure, or capture with two exposures."
    elif share < WEAK:
        verdict = "bad" if share < TOO_WEAK else "warning"
        sentence, remedy = f"{sentence}.", _BRIGHTER
    else:
        sentence += f"; {100 * clipped:.1f} % of the pixels are saturated."
    figures = {
        "bright_share_of_full_scale": round(share, 3),
        "saturated_share": round(clipped, 4),
    }
    return Check("exposure", verdict, sentence, remedy, figures)


def warn_of_exposure(
    name: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    phases: Mapping[Axis, PhaseMap],
    warn: Warn,
) -> None:
    """Warn, with the capture's name, where `check_capture_exposure` finds it too bright or too
    dark."""
    exposure = check_capture_exposure(sequence, frames, phases)
    if exposure.verdict != "good":
        warn(f"{name}: {exposure.sentence} {exposure.remedy}")
