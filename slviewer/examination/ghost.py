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
    for axis, sample, m in evaluator.explained(base):
        slope = evaluator.atoms(base, axis).slope_at(m.coordinate)[m.places]
        A, B, d = m.background, m.contrast, m.predicted
        later = [k for k, i in enumerate(m.images) if i > 0]
        images = np.array(m.images)[later] - 1
        before = (sample.levels[images, 1] - A) / B
        known = np.flatnonzero(np.isin(images, m.images))
        before[known] = d[[m.images.index(i) for i in images[known]]]
        own = np.stack([A / B + d, np.ones_like(d), slope])[:, later].astype(float)
        both = np.stack([before - d[later], (m.residual(sample) / B)[later]])
        squares, products = (np.einsum("akp,bkp->kab", own, each) for each in (own, both))
        fit = np.linalg.pinv(squares, 1e-8, hermitian=True) @ products
        x, r = both - np.einsum("kab,akp->bkp", fit, own)
        weight = 1 / (r.var(axis=1) + 1e-6)
        usable = np.where(np.abs(x) < 1.5, x, 0)  # of the contrast; more is another surface's
        normal += float(weight @ np.einsum("kp,kp->k", usable, usable))
        moment += float(weight @ np.einsum("kp,kp->k", usable, r))
    return moment / normal, normal**-0.5


def has_ghost(evaluator: Evaluator, base: Hypothesis) -> float:
    """Return the share of the image before if it is significant, else 0."""
    share, error = measure_ghost(evaluator, base)
    return share if share > limits.LEAST_GHOST + limits.GHOST_SIGMAS * error else 0.0
