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
    more than a jump may have. Edges of stripes are predicted wrongly by a part of a cell, so that a
    steady motion must explain most of their displacements.
    """
    out = dict[Axis, float]()
    for axis, steps in _measure_steps(evaluator, base):
        period, every = base.sequence.period_px(axis), np.arange(len(steps.shift))
        has_steps = bool(base.sequence.phase_shifts(axis))
        share, least_px = limits.JUMP_OF_STRIPES[0], limits.JUMP_OF_STRIPES[1] * period
        steady = steps.fit(every / len(every))
        is_large = abs(steady.px) > least_px and steady.share > limits.STEADY_OF_STRIPES
        is_steady = steady.is_clear(limits.SIGMAS, period) and steps.confirms(steady)
        if is_steady and (has_steps or is_large):
            out[axis] = steady.px
        jump = max((steps.fit(every >= k) for k in every[1:]), key=lambda fitted: fitted.share)
        displaced = jump.shape
        if steps.weight[displaced].sum() > steps.weight.sum() / 2:
            displaced = ~displaced
        is_jump = jump.share > max(limits.JUMP_SHARE, steady.share)
        explains, confirms = steps.explains(displaced), steps.confirms(jump)
        if has_steps:
            is_jump &= explains and abs(jump.px) < limits.MOST_JUMP * period
        else:  # two of three: blur may leave more at the stripes' edges than a jump does
            is_large = jump.share > share and abs(jump.px) > least_px
            is_jump &= explains + confirms + is_large >= 2
        if is_jump and jump.is_clear(limits.JUMP_SIGMAS, period):
            out[axis] = jump.px
    return out


def has_trend(evaluator: Evaluator, base: Hypothesis) -> bool:
    """Return whether a displacement that grows from image to image of an axis explains what its
    phase steps and stripes leave beside the background, contrast and displacement of each pixel.

    It shows between the stripes and few steps, whose mean the coordinate takes up.
    """
    for axis, sample, m in evaluator.explained(base):
        slope = m.atoms.slope_at(m.coordinate)[m.places]
        time = np.array(m.images) / max(np.ptp(m.images), 1)
        trend = slope * time[:, None]
        left = m.residual(sample) / m.contrast
        spans = [np.ones_like(slope), m.predicted, slope]
        for i, basis in enumerate(spans):
            squares = np.maximum(np.einsum("kp,kp->p", basis, basis), 1e-6)
            for each in (*spans[i + 1 :], trend, left):
                each -= basis * (np.einsum("kp,kp->p", basis, each) / squares)
        moment, weight = (np.einsum("kp,kp->p", trend, each) for each in (left, trend))
        px = -moment.sum() / weight.sum()
        error = np.sqrt(np.sum((moment + px * weight) ** 2)) / weight.sum()
        period = base.sequence.period_px(axis)
        if abs(px) > limits.LEAST_MOTION * period + limits.SIGMAS * error:
            return True
    return False


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

    ``edges`` (k,): a number for steps that show the same edges: one for all phase steps, and one
    for a bit and its inverse; ``shift`` (k,): px of the projector; ``weight`` (k,): inverse of its
    variance; ``explained``, ``whole`` (k,): squared residual that the shift explains, and all of
    it.
    """

    images: np.ndarray
    edges: np.ndarray
    shift: np.ndarray
    weight: np.ndarray
    explained: np.ndarray
    whole: np.ndarray

    def fit(self, shape: np.ndarray, within_edges: bool = False) -> _Displacement:
        """Fit the displacements by a multiple of a shape (k,) and a constant, or one for each of
        the ``edges``, at which the prediction may be off."""
        edges = self.edges if within_edges else np.zeros_like(self.edges)
        same = (edges[:, None] == edges) * self.weight
        same /= same.sum(axis=1, keepdims=True)
        centred, shift = shape - same @ shape, self.shift - same @ self.shift
        information = max(float(self.weight @ centred**2), 1e-12)
        px = float((self.weight * centred) @ shift) / information
        variance = max(float(self.weight @ shift**2), 1e-12)
        return _Displacement(shape, px, information**-0.5, px**2 * information / variance)

    def confirms(self, found: _Displacement) -> bool:
        """Return whether steps that show the same edges are displaced as well; where one edge is
        predicted wrongly, a bit and its inverse are not."""
        count = len({*self.edges.tolist()})
        if count == 1:
            return True
        same = self.fit(found.shape, within_edges=True)
        sigmas = np.sqrt(same.share * (count - 1) / max(1 - same.share, 1e-9))
        return same.px * found.px > 0 and bool(sigmas > limits.PAIR_SIGMAS)

    def explains(self, steps: np.ndarray) -> bool:
        """Return whether displacement explains most of what some steps, (k,) bool, leave."""
        least = limits.JUMP_EXPLAINS * self.whole[steps].sum()
        return bool(self.explained[steps].sum() > least)


def _measure_steps(evaluator: Evaluator, base: Hypothesis) -> Iterator[tuple[Axis, _Steps]]:
    """Yield the displacements of the phase steps of each axis that has four at least, or of its
    stripes where it has no steps.

    The coordinate that predicts a pixel is the mean over its steps; each step is displaced from it
    by residual / slope, beside light of its own.
    """
    for axis, sample, m in evaluator.explained(base):
        atoms = evaluator.atoms(base, axis)
        steps = np.flatnonzero(atoms.groups[m.places] >= 0)
        slope = atoms.slope_at(m.coordinate)[m.places]
        kinds = [base.sequence.frames[i] for i in m.images]
        if not steps.size and base.sequence.find("inverse", axis):
            steps = np.flatnonzero(np.count_nonzero(slope, axis=1) >= limits.FEWEST_AT_EDGES)
        if len(steps) < 4:
            continue
        images = np.array(m.images)[steps]
        steps = steps[order := np.argsort(images)]
        residual, slope = (m.residual(sample) / m.contrast)[steps], slope[steps]
        if atoms.groups.max() < 0:
            predicted = m.predicted[steps]
            residual, slope = (_remove_levels(each, predicted) for each in (residual, slope))
        squares, moment, whole = (
            np.einsum("kp,kp->k", a, b)
            for a, b in ((slope, slope), (residual, slope), (residual, residual))
        )
        weight = squares / np.maximum(whole, 1e-9) * residual.shape[1]  # frames without noise
        edges = np.array([0 if kinds[k].kind == "phase" else kinds[k].bit for k in steps])
        yield (
            axis,
            _Steps(images[order], edges, -moment / squares, weight, moment**2 / squares, whole),
        )


def _remove_levels(values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return values (k, p) without what a gain and an offset of each frame explain, whose predicted
    levels are (k, p): of one edge alone they imitate a displacement."""
    values = values - values.mean(axis=1, keepdims=True)
    levels = predicted - predicted.mean(axis=1, keepdims=True)
    squares = np.maximum(np.einsum("kp,kp->k", levels, levels), 1e-6)
    gain = np.einsum("kp,kp->k", values, levels) / squares
    return np.asarray(values - gain[:, None] * levels)
