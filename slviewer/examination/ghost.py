"""Share of the image before in each image: from a slow display, or an exposure across a change.

Among steps of one period a ghost of the step before shifts all phases alike, and nothing
contradicts it. It shows where another pattern came before: at the first step, and between bits.
"""

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis


def measure_ghost(evaluator: Evaluator, base: Hypothesis) -> tuple[float, float]:
    """Measure the share of the image before in all images, and its standard error.

    Each image's own light, light of the room, and displacement are fitted beside it.
    """
    normal, moment = 1e-9, 0.0
    for axis, sample, m, good in evaluator.explained(base):
        slope = evaluator.atoms(base, axis).slope_at(m.coordinate[good])[m.places]
        A, B, d = m.background[good], m.contrast[good], m.predicted[:, good]
        residuals = m.residual(sample)[:, good] / B
        for k, i in enumerate(m.images):
            if i == 0:
                continue
            own = np.stack([(A + B * d[k]) / B, np.ones_like(B), slope[k]])
            measured = (sample.levels[i - 1, 1][good] - A) / B
            before = d[m.images.index(i - 1)] if i - 1 in m.images else measured
            both = np.stack([before - d[k], residuals[k]])
            fit, *_ = np.linalg.lstsq(own.T, both.T, rcond=1e-4)
            x, r = both - fit.T @ own
            usable = np.abs(x) < 1.5  # of the contrast; more is another surface's
            weight = 1 / (float(r.var()) + 1e-6)
            normal += weight * float(x[usable] @ x[usable])
            moment += weight * float(x[usable] @ r[usable])
    return moment / normal, normal**-0.5


def has_ghost(evaluator: Evaluator, base: Hypothesis) -> float:
    """Return the share of the image before if it is significant, else 0."""
    share, error = measure_ghost(evaluator, base)
    return share if share > limits.LEAST_GHOST + limits.GHOST_SIGMAS * error else 0.0
