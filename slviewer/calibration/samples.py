"""Phase over a board's bright pixels, averaged over small blocks: what a joint adjustment of both devices compares."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis

COUNT = 4000
"""Blocks kept of one pose: more tell of no finer distortion, and cost the adjustment its time."""
LARGEST_BLOCK = 5
"""Pixels along a block's side at most: over more, a tilted board's perspective bends the phase within the block."""
LEAST_FILLED = 0.5
"""Share of a block's pixels that must be bright."""


@dataclass(frozen=True, eq=False)
class Samples:
    """``camera`` (n, 2) px: the mean of each block's pixels; ``projector`` (n, 2) px: the mean of their coordinates.

    ``sigma`` (n, 2) px is the latter's standard deviation from the capture's noise. Columns are the axes x and y; an
    axis that was not captured is NaN in both.
    """

    camera: np.ndarray
    projector: np.ndarray
    sigma: np.ndarray

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.camera, self.projector, self.sigma)}
        if len(shapes) != 1 or self.camera.ndim != 2 or self.camera.shape[1] != 2:
            raise InputError(f"samples of shapes {sorted(shapes)} do not belong together: three arrays (n, 2) do")


def block_samples(
    phases: Mapping[Axis, PhaseMap], bright: Mapping[Axis, np.ndarray], axes: Sequence[Axis], count: int = COUNT
) -> Samples:
    """About ``count`` blocks, spread evenly over the pixels (h, w) that are ``bright`` for every captured axis."""
    usable = np.logical_and.reduce(list(bright.values()))
    v, u = np.nonzero(usable)
    side = int(np.clip(np.sqrt(len(v) / count), 1, LARGEST_BLOCK))
    across = usable.shape[1] // side + 1
    block = (v // side) * across + u // side
    filled = np.bincount(block)
    kept = np.nonzero(filled >= max(1, LEAST_FILLED * side * side))[0]
    if len(kept) > count:
        kept = np.sort(np.random.default_rng(0).choice(kept, count, replace=False))
    inverse = 1.0 / filled[kept]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(block, weights=values)[kept] * inverse

    camera = np.stack([mean(u), mean(v)], axis=1)
    projector, sigma = np.full((2, len(kept), 2), np.nan)
    for axis, phase in phases.items():
        column, px = axes.index(axis), phase.period_px / (2 * np.pi)
        projector[:, column] = mean(phase.phase[v, u].astype(float) * px)
        sigma[:, column] = np.sqrt(mean((phase.sigma_phase[v, u].astype(float) * px) ** 2) * inverse)
    return Samples(camera, projector, sigma)
