"""Ghosting, a share of the previous image in each frame: from a slow display, or an exposure across
a pattern change.

Within a series of phase steps a ghost of the step before shifts all phases alike, and nothing
contradicts it. The first step of a series contains a ghost of another pattern, and there it is
measured.
"""

import numpy as np

from slviewer.fringe.residual_sample import Fringe
from slviewer.fringe.suspect import Suspect

LEAST_SHARE = 0.01
"""Smallest share of the previous image: a smaller one shifts the phase of eight steps by less than
0.01 rad."""
MOST_SHARE = 0.5
"""Largest share of the previous image: with more, the frame is late."""
MOSTLY = 0.5
"""Share of the residual explained by light and ghost together that the ghost alone must
contribute."""
SIGMAS = 10.0
"""Smallest share in multiples of its standard error, which many pixels make small: blur and noise
give less."""


def measure_ghost_share(sampled: Fringe) -> tuple[float, float]:
    """Measure the share of the previous image in each image, and its standard error, from the first
    step of a period.

    NaN where three steps fit anything, or where frames of other light explain the residuals as
    well. Before the very first frame of a capture there is none, and it alone lacks its share.
    """
    before = sampled.beside.get(sampled.shift.indices[0] - 1, sampled.fitted[0])
    if sampled.steps < 4:
        return np.nan, np.nan
    projection = sampled.keep
    residuals = projection.astype(np.float32) @ sampled.frames
    # The first step is off by the share of what the image before differs from the last step; and
    # frames of other light do not count as a ghost: their gains are fitted together with it.
    regressors = np.concatenate([sampled.fitted, (before - sampled.fitted[-1])[None]])
    steps = [*range(sampled.steps), 0]
    normal = projection[np.ix_(steps, steps)] * (regressors @ regressors.T)
    moment = np.einsum("kp,kp->k", regressors, residuals[steps]).astype(float)
    gains = slice(0, sampled.steps)
    by_light = float(
        moment[gains] @ np.linalg.pinv(normal[gains, gains], rcond=1e-6) @ moment[gains]
    )
    inverse = np.linalg.pinv(normal, rcond=1e-6)
    explained = float(moment @ inverse @ moment)
    if explained - by_light < MOSTLY * explained:
        return np.nan, np.nan
    freedom = residuals.shape[1] * np.trace(projection)
    variance = (
        (float(np.sum(residuals.astype(float) ** 2)) - explained) / freedom * float(inverse[-1, -1])
    )
    return float(inverse[-1] @ moment), float(np.sqrt(max(variance, 0.0)))


def detect_ghosting(sampled: Fringe) -> list[Suspect]:
    """Return a suspect for the first step of a period if it contains a share of the image before
    it; else empty."""
    share, error = measure_ghost_share(sampled)
    if not (LEAST_SHARE < share < MOST_SHARE and share > SIGMAS * error):
        return []
    i = sampled.shift.indices[0]
    text = (
        f"frame {i + 1} holds {100 * share:.0f} % of the image before it (ghosting), and so may"
        " every frame"
    )
    if i == 0:
        text = (
            f"the frames hold {100 * share:.0f} % of the image before them (ghosting), but for"
            " frame 1, the first"
        )
    text += (
        ": the projector changes its image slowly, or the camera exposes during the change; wait"
        " longer after each pattern"
    )
    return [Suspect(i, "strange", text)]
