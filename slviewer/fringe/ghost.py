"""A share of the image before in each frame: a display that answers slowly, an exposure across the change of patterns.

Within a series of phase steps a ghost of the step before shifts all phases alike, and nothing contradicts it. The first
step of a series holds a ghost of another pattern, and there it is measured.
"""

import numpy as np

from slviewer.fringe.residual_sample import Fringe
from slviewer.fringe.suspect import Suspect

LEAST_SHARE = 0.01
"""Of the image before: less shifts the phase of eight steps by under 0.01 rad."""
MOST_SHARE = 0.5
"""More is a frame that is late."""
SIGMAS = 10.0
"""Of its standard error, which tens of thousands of pixels make small: what blur and noise pretend lies below."""


def ghost_share(sampled: Fringe) -> tuple[float, float]:
    """The share of the image before in each image, and its standard error, from the first step of a period.

    NaN where no frame was captured right before the first step, or three steps fit anything.
    """
    before = sampled.beside.get(sampled.shift.indices[0] - 1)
    if before is None or sampled.steps < 4:
        return np.nan, np.nan
    keep = sampled.keep
    # A frame that is off by e leaves keep[:, 0] e, so that e is the residual of the first step over keep[0, 0].
    off = (keep[0].astype(np.float32) @ sampled.frames) / np.float32(keep[0, 0])
    first, last = sampled.fitted[0], sampled.fitted[-1]
    # Its light may also differ from that of the other frames: gain and offset are not taken for a ghost.
    design = np.stack([before - last, first, np.ones_like(first)]).astype(float)
    normal = design @ design.T
    inverse = np.linalg.pinv(normal, rcond=1e-9)
    weights = inverse @ (design @ off)
    left = off - weights @ design
    variance = float(np.mean(left**2)) * float(inverse[0, 0])
    return float(weights[0]), float(np.sqrt(max(variance, 0.0)))


def ghost_suspects(sampled: Fringe) -> list[Suspect]:
    """The first step of a period, where it holds a share of the image before it."""
    share, error = ghost_share(sampled)
    if not (LEAST_SHARE < share < MOST_SHARE and share > SIGMAS * error):
        return []
    i = sampled.shift.indices[0]
    return [
        Suspect(
            i,
            "strange",
            f"frame {i + 1} holds {100 * share:.0f} % of the image before it, and so may every frame: the projector "
            "changes its image slowly, or the camera exposes during the change; wait longer after each pattern",
        )
    ]
