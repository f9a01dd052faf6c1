"""Whether the camera sees this projector, and each pixel of a pattern is one pixel of the
projector."""

import numpy as np

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import Rig
from slviewer.examination.limits import LEAST_LIT
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.examination import Check
from slviewer.preflight.rig_under_test import RigUnderTest

_CODE = (1, 0, 1, 1, 0, 0, 1, 0)
_MIN_CORRELATION = 0.9  # correlation with the code
_LITTLE = 0.1  # of the image


def check_screen(bench: RigUnderTest) -> Check:
    """Check that the camera sees the projector, switched by a code; stores the illuminated pixels
    in the rig."""
    images = np.stack(
        [bench.grab_mean(255 if on else None, "which screen the camera sees") for on in _CODE]
    )
    code = np.array(_CODE) - np.mean(_CODE)
    images = images - images.mean(axis=0)
    amplitude = np.tensordot(code, images, 1) / float(code @ code)  # grey levels, white less dark
    spread = np.sqrt((images**2).sum(axis=0) * float(code @ code))
    correlation = amplitude * float(code @ code) / np.maximum(spread, 1e-6)
    follows = (correlation > _MIN_CORRELATION) & (
        amplitude > max(4 * bench.noise, 0.01 * bench.full)
    )
    share = float(follows.mean())
    contrast = float(np.median(amplitude[follows])) if share else 0.0
    figures = {"share_that_follows": round(share, 4), "contrast_levels": round(contrast, 1)}
    if share < LEAST_LIT:
        return Check(
            "screen",
            "bad",
            "The camera sees no change when the projector goes from dark to white.",
            "Check that the projector is on and shows this program's picture on the right screen,"
            " that the lens cap is off, and that the camera looks at what it lights.",
            figures,
        )
    bench.illuminated = follows
    if share < _LITTLE:
        return Check(
            "screen",
            "warning",
            f"Only {100 * share:.0f} % of the image follows the projector.",
            "Turn the camera and the projector so that both look at the same place, or raise the"
            " exposure.",
            figures,
        )
    text = f"{100 * share:.0f} % of the image follows the projector's light."
    return Check("screen", "good", text, "", figures)


_MIN_GREY_CONTRAST = 0.08  # grey must be so far from half as bright as white
_MAX_DEVIATION = 0.3  # of that distance


def check_pixels(bench: RigUnderTest, middle: float) -> Check:
    """Whether each pixel of a pattern is one pixel of the projector; ``middle``: light of the
    middle grey level as a share of white, which the gamma check measured.

    Stripes one pixel wide are half white and half black, and half as bright as white, whether the
    camera resolves them or not. Where a display scales them they become grey, and grey of a gamma
    is not half as bright.
    """
    where = bench.usable()
    if abs(middle - 0.5) < _MIN_GREY_CONTRAST or not where.any():
        text = (
            "Whether the display scales the patterns cannot be seen: its grey is as bright as its"
            " finest stripes."
        )
        remedy = (
            "Check in the projector's menu: native resolution, a zoom of 100 %, no keystone"
            " correction or sharpening."
        )
        return Check("pixels", "unknown", text, remedy, {"middle_grey": round(middle, 3)})
    size = bench.rig.projector.size
    shares = []
    for axis in ("x", "y"):
        sequence = PatternSequence(size, tuple(phase_steps(axis, 4, 2.0)))
        rig = Rig(bench.rig.name, bench.rig.camera, bench.rig.projector, bench.settle_ms)
        frames = capture_frames(rig, sequence)[:, :: bench.stride, :: bench.stride]
        both = (
            frames[0].astype(np.float32) + frames[2]
        ) / 2  # stripes and their negative: without moire
        shares.append(bench.share(both, where))
    worst = max(shares, key=lambda share: abs(share - 0.5))
    figures = {
        "fine_stripes_x": round(shares[0], 3),
        "fine_stripes_y": round(shares[1], 3),
        "middle_grey": round(middle, 3),
    }
    if (worst - 0.5) / (middle - 0.5) > _MAX_DEVIATION:
        return Check(
            "pixels",
            "bad",
            f"Stripes one pixel wide are {100 * worst:.0f} % as bright as white instead of 50 %:"
            " the display scales or blurs the patterns.",
            "Set the projector's native resolution, a zoom of 100 %, and no keystone correction or"
            " sharpening.",
            figures,
        )
    return Check("pixels", "good", "Patterns are shown pixel for pixel.", "", figures)
