"""Too bright, too dark, or right: white light, measured."""

import numpy as np

from slviewer.pipeline.check_results import Check, CheckVerdict
from slviewer.pipeline.exposure_check import CLIPPED, MUCH_CLIPPED, TOO_WEAK, WEAK
from slviewer.preflight.rig_under_test import RigUnderTest

_TARGET = 0.85  # of full scale, for the 99.5th percentile of what is illuminated
_BACK_OFF = 0.5  # how much light is too much cannot be seen: half of it, then look again


def exposure(bench: RigUnderTest) -> tuple[Check, float | None]:
    """The check, and the exposure in ms to set instead; None where the present one is right or unknown."""
    level, full = bench.white[bench.illuminated], bench.full
    bright = float(np.quantile(level, 0.995))
    clipped = float(np.mean(level >= 0.985 * full))
    black = float(np.median(bench.dark[bench.illuminated]))
    present = bench.rig.camera.settings().exposure_ms
    factor = _BACK_OFF if bright >= 0.985 * full else (_TARGET * full - black) / max(bright - black, 1.0)
    wanted = None if present is None else _round(present * factor)
    figures = {
        "bright_share_of_full_scale": round(bright / full, 3),
        "clipped_share": round(clipped, 4),
        "median_contrast_levels": round(bench.contrast, 1),
        "exposure_ms": present,
        "suggested_exposure_ms": wanted,
        "suggested_factor": round(factor, 2),
    }
    change = f"by {factor:.2g} times" if wanted is None else f"from {present:g} ms to {wanted:g} ms"
    if clipped > CLIPPED:
        verdict: CheckVerdict = "bad" if clipped > MUCH_CLIPPED else "warning"
        said = f"{100 * clipped:.1f} % of what the projector lights is saturated in white light."
        if bright < 0.985 * full:
            return Check("exposure", verdict, said, "Turn what shines, or capture with two exposures.", figures), None
        return Check("exposure", verdict, said, f"Change the exposure {change}, then check again.", figures), wanted
    if bright < WEAK * full:
        verdict = "bad" if bright < TOO_WEAK * full else "warning"
        said = f"White light reaches only {100 * bright / full:.0f} % of the camera's range."
        return Check("exposure", verdict, said, f"Change the exposure {change}, or open the aperture.", figures), wanted
    said = f"White light reaches {100 * bright / full:.0f} % of the camera's range; {100 * clipped:.1f} % is saturated."
    return Check("exposure", "good", said, "", figures), None


def _round(milliseconds: float) -> float:
    return float(f"{milliseconds:.3g}")
