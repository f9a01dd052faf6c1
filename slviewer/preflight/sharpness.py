"""Is each pixel of the pattern one pixel of the projector?

Stripes one pixel wide are half white and half black, and half as bright as white, whether the camera resolves them or
not. Where a display scales them they become grey, and grey of a gamma is not half as bright.
"""

import numpy as np

from slviewer.devices.capture import capture
from slviewer.devices.protocols import Rig
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.check_results import Check
from slviewer.preflight.rig_under_test import RigUnderTest

_TELLS = 0.08  # grey must be so far from half as bright as white
_OFF = 0.3  # of that distance


def sharpness(bench: RigUnderTest, middle: float) -> Check:
    """`middle`: light of the middle grey level as a share of white, which the gamma check measured."""
    where = bench.usable()
    if abs(middle - 0.5) < _TELLS or not where.any():
        said = "Whether the display scales the patterns cannot be seen: its grey is as bright as its finest stripes."
        return Check("pixels", "unknown", said, "", {"middle_grey": round(middle, 3)})
    size = bench.rig.projector.size
    shares = []
    for axis in ("x", "y"):
        sequence = PatternSequence(size, tuple(phase_steps(axis, 4, 2.0)))
        rig = Rig(bench.rig.name, bench.rig.camera, bench.rig.projector, bench.settle_ms)
        frames = capture(rig, sequence)[:, :: bench.stride, :: bench.stride]
        both = (frames[0].astype(np.float32) + frames[2]) / 2  # stripes and their negative: no moire is left
        shares.append(bench.share(both, where))
    worst = max(shares, key=lambda share: abs(share - 0.5))
    figures = {
        "fine_stripes_x": round(shares[0], 3),
        "fine_stripes_y": round(shares[1], 3),
        "middle_grey": round(middle, 3),
    }
    if (worst - 0.5) / (middle - 0.5) > _OFF:
        return Check(
            "pixels",
            "bad",
            f"Stripes one pixel wide are {100 * worst:.0f} % as bright as white instead of 50 %: the display scales or "
            "blurs the patterns.",
            "Set the projector's native resolution, a zoom of 100 %, and no keystone correction or sharpening.",
            figures,
        )
    return Check("pixels", "good", "Patterns are shown pixel for pixel.", "", figures)
