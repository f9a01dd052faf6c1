"""Motion of the scene during a capture, from the displacement of the pattern in each phase step."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis
from slviewer.fringe.sequence import Axis


def measure_motion(evaluator: Evaluator, base: Hypothesis) -> dict[Axis, float]:
    """Return the displacement of the patterns during the phase steps of each axis in which it is
    significant, px of the projector: steady, from the first to the last step, or all at once.

    Light that varies displaces no step, and a step that shows another pattern displaces one, by
    more than a jump may have.
    """
    out = dict[Axis, float]()
    for axis, steps in _measure_steps(evaluator, base):
        period, every = base.sequence.periods_px(axis)[-1], np.arange(len(steps.shift))
        steady = steps.fit(every / len(every))
        if steady.is_clear(limits.SIGMAS, period):
            out[axis] = steady.px
        jump = max((steps.fit(every >= k) for k in every[1:]), key=lambda fitted: fitted.share)
        displaced = jump.shape
        if steps.weight[displaced].sum() > steps.weight.sum() / 2:
            displaced = ~displaced
        is_jump = jump.share > max(limits.JUMP_SHARE, steady.share)
        is_jump &= abs(jump.px) < limits.MOST_JUMP * period
        if is_jump and steps.explains(displaced) and jump.is_clear(limits.JUMP_SIGMAS, period):
            out[axis] = jump.px
    return out


def is_displaced(evaluator: Evaluator, base: Hypothesis, image: int) -> bool:
    """Return whether a displacement explains what an image shows instead of its phase step."""
    return any(
        image in steps.images and steps.explains(steps.images == image)
        for _, steps in _measure_steps(evaluator, base)
    )


class _Displacement(NamedTuple):
    """Multiple ``px`` of a ``shape`` (k,) that fits the displacements of k steps, its standard
    error, and the share of their weighted variance that it explains."""

    shape: np.ndarray
    px: float
    error: float
    share: float

    def is_clear(self, sigmas: float, period_px: float) -> bool:
        """Return whether it is larger than gamma and noise imitate."""
        return abs(self.px) > limits.LEAST_MOTION * period_px + sigmas * self.error


@dataclass(frozen=True, eq=False)
class _Steps:
    """Displacements of the k phase steps of an axis in the order of their ``images`` (k,).

    ``shift`` (k,): px of the projector; ``weight`` (k,): inverse of its variance; ``explained``,
    ``whole`` (k,): squared residual that the shift explains, and all of it.
    """

    images: np.ndarray
    shift: np.ndarray
    weight: np.ndarray
    explained: np.ndarray
    whole: np.ndarray

    def fit(self, shape: np.ndarray) -> _Displacement:
        """Fit the displacements by a multiple of a shape (k,) and a constant."""
        centred = shape - np.average(shape, weights=self.weight)
        information = float(self.weight @ centred**2)
        px = float((self.weight * centred) @ self.shift) / information
        shift = self.shift - np.average(self.shift, weights=self.weight)
        variance = float(self.weight @ shift**2)
        return _Displacement(shape, px, information**-0.5, px**2 * information / variance)

    def explains(self, steps: np.ndarray) -> bool:
        """Return whether displacement explains most of what some steps, (k,) bool, leave."""
        least = limits.JUMP_EXPLAINS * self.whole[steps].sum()
        return bool(self.explained[steps].sum() > least)


def _measure_steps(evaluator: Evaluator, base: Hypothesis) -> Iterator[tuple[Axis, _Steps]]:
    """Yield the displacements of the phase steps of each axis that has four at least.

    The coordinate that predicts a pixel is the mean over its steps; each step is displaced from it
    by residual / slope.
    """
    for axis, sample, m, good in evaluator.explained(base):
        atoms = evaluator.atoms(base, axis)
        steps = np.flatnonzero(atoms.groups[m.places] >= 0)
        if len(steps) < 4:
            continue
        images = np.array(m.images)[steps]
        steps = steps[order := np.argsort(images)]
        slope = atoms.slope_at(m.coordinate[good])[m.places][steps]
        residual = (m.residual(sample)[:, good] / m.contrast[good])[steps]
        squares, moment, whole = (
            np.einsum("kp,kp->k", a, b)
            for a, b in ((slope, slope), (residual, slope), (residual, residual))
        )
        weight = squares / whole * residual.shape[1]
        yield axis, _Steps(images[order], -moment / squares, weight, moment**2 / squares, whole)
