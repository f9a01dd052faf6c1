"""Does the camera look at what this projector lights?"""

import numpy as np

from slviewer.pipeline.check_results import Check
from slviewer.preflight.rig_under_test import RigUnderTest

_CODE = (1, 0, 1, 1, 0, 0, 1, 0)
_FOLLOWS = 0.9  # correlation with the code
_NOTHING, _LITTLE = 0.01, 0.1  # shares of the image


def screen(bench: RigUnderTest) -> Check:
    """On and off by a code that nothing else in the room follows; what follows it is what is lit from here on."""
    images = np.stack([bench.look(255 if on else None, "which screen the camera sees") for on in _CODE])
    code = np.array(_CODE) - np.mean(_CODE)
    images = images - images.mean(axis=0)
    amplitude = np.tensordot(code, images, 1) / float(code @ code)  # grey levels, white less dark
    spread = np.sqrt((images**2).sum(axis=0) * float(code @ code))
    correlation = amplitude * float(code @ code) / np.maximum(spread, 1e-6)
    follows = (correlation > _FOLLOWS) & (amplitude > max(4 * bench.noise, 0.01 * bench.full))
    share = float(follows.mean())
    if share >= _NOTHING:
        bench.illuminated = follows
    figures = {"share_that_follows": round(share, 4), "contrast_levels": round(float(_middle(amplitude, follows)), 1)}
    if share < _NOTHING:
        return Check(
            "screen",
            "bad",
            "The camera sees no change when the projector goes from dark to white.",
            "Check that the projector is on and shows this program's picture on the right screen, that the lens cap is "
            "off, and that the camera looks at what it lights.",
            figures,
        )
    if share < _LITTLE:
        return Check(
            "screen",
            "warning",
            f"Only {100 * share:.0f} % of the image follows the projector.",
            "Turn the camera and the projector so that both look at the same place, or raise the exposure.",
            figures,
        )
    sentence = f"{100 * share:.0f} % of the image follows the projector's light."
    return Check("screen", "good", sentence, "", figures)


def _middle(values: np.ndarray, where: np.ndarray) -> float:
    return float(np.median(values[where])) if where.any() else 0.0
