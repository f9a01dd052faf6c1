"""Motion of the scene during a capture, from the displacement of the pattern in each phase step."""

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis
from slviewer.fringe.sequence import Axis


def measure_motion(evaluator: Evaluator, base: Hypothesis) -> dict[Axis, float]:
    """Return the displacement of the patterns from the first to the last phase step of each axis in
    which it is significant, px of the projector.

    The coordinate that predicts a pixel is the mean over its steps; each step is displaced from it
    by residual / slope. Light that varies displaces no step, and a step that shows another pattern
    displaces one.
    """
    out = dict[Axis, float]()
    for axis, sample, m, good in evaluator.explained(base):
        atoms = evaluator.atoms(base, axis)
        steps = np.flatnonzero(atoms.groups[m.places] >= 0)
        if len(steps) < 4:
            continue
        slope = atoms.slope_at(m.coordinate[good])[m.places][steps]
        residual = (m.residual(sample)[:, good] / m.contrast[good])[steps]
        squares, moment = (np.einsum("kp,kp->k", a, slope) for a in (slope, residual))
        shift = -moment / squares
        weight = squares / np.mean(residual**2, axis=1)
        time = np.argsort(np.argsort(np.array(m.images)[steps])) / len(steps)
        time = time - np.average(time, weights=weight)
        information = float(weight @ time**2)
        trend = float((weight * time) @ shift) / information
        least = limits.LEAST_MOTION * base.sequence.periods_px(axis)[-1]
        if abs(trend) > least + limits.SIGMAS * information**-0.5:
            out[axis] = trend
    return out
