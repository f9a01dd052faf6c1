"""Motion of the scene during a capture, from the displacement of the pattern in each phase step."""

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis
from slviewer.fringe.sequence import Axis


def measure_motion(evaluator: Evaluator, base: Hypothesis) -> dict[Axis, float]:
    """Return the displacement of the patterns during the phase steps of each axis in which it is
    significant, px of the projector: steady, from the first to the last step, or all at once.

    The coordinate that predicts a pixel is the mean over its steps; each step is displaced from it
    by residual / slope. Light that varies displaces no step, and a step that shows another pattern
    displaces one, by more than a jump may have.
    """
    out = dict[Axis, float]()
    for axis, sample, m, good in evaluator.explained(base):
        atoms = evaluator.atoms(base, axis)
        steps = np.flatnonzero(atoms.groups[m.places] >= 0)
        if len(steps) < 4:
            continue
        steps = steps[np.argsort(np.array(m.images)[steps])]
        slope = atoms.slope_at(m.coordinate[good])[m.places][steps]
        residual = (m.residual(sample)[:, good] / m.contrast[good])[steps]
        squares, moment = (np.einsum("kp,kp->k", a, slope) for a in (slope, residual))
        shift = -moment / squares
        weight = squares / np.mean(residual**2, axis=1)
        period = base.sequence.periods_px(axis)[-1]
        steady = _fit_shape(shift, weight, np.arange(len(steps)) / len(steps))
        if _is_clear(steady, limits.SIGMAS, period):
            out[axis] = steady[0]
        jumps = [
            _fit_shape(shift, weight, np.arange(len(steps)) >= k) for k in range(1, len(steps))
        ]
        jump = max(jumps, key=lambda fitted: fitted[2])
        is_jump = (
            jump[2] > max(limits.JUMP_SHARE, steady[2]) and abs(jump[0]) < limits.MOST_JUMP * period
        )
        if is_jump and _is_clear(jump, limits.JUMP_SIGMAS, period):
            out[axis] = jump[0]
    return out


def _fit_shape(
    shift: np.ndarray, weight: np.ndarray, shape: np.ndarray
) -> tuple[float, float, float]:
    """Fit displacements (k,) by a multiple of a shape (k,) and a constant: the multiple, its
    standard error, and the share of the displacements' weighted variance that it explains."""
    centred = shape - np.average(shape, weights=weight)
    information = float(weight @ centred**2)
    multiple = float((weight * centred) @ shift) / information
    variance = float(weight @ (shift - np.average(shift, weights=weight)) ** 2)
    return multiple, information**-0.5, multiple**2 * information / variance


def _is_clear(fitted: tuple[float, float, float], sigmas: float, period_px: float) -> bool:
    """Return whether a displacement is larger than gamma and noise imitate."""
    px, error, _ = fitted
    return abs(px) > limits.LEAST_MOTION * period_px + sigmas * error
