"""Sample of some rows and columns of all frames, against which a description is checked."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe import limits
from slviewer.fringe.layout import clip_level
from slviewer.fringe.residual_sample import estimate_roughness
from slviewer.fringe.sequence import Axis, PatternSequence

PIXELS = 40_000
"""Number of pixels on rows, and on columns: twenty edges even of the most significant bit, in
either direction."""
GRID = 100
"""Pixels along the shorter side of the grid that shows where the patterns are."""
BLOCK = 4
"""Neighbouring columns that are read together: they share the memory's cache lines."""
NOISE_RANGE = 2 * limits.DARK_SIGMAS
"""Range of a pixel's grey levels, in standard deviations, from which it shows a pattern: in fifty
frames of noise alone the range stays below seven in 99.99 % of the pixels."""


@dataclass(frozen=True, eq=False)
class LineSample:
    """Pixels of some rows and columns of n frames.

    ``frames`` (n, p) float32 grey levels; ``line`` (p,): index of the line, image rows below
    ``rows``, columns from there; ``place`` (p,): px along a line. ``lines`` (n, rows, width): the
    same pixels of the rows, and ``grid`` (n, gh, gw): a thinned image, as captured. ``white``:
    level at which the camera clips; ``noise``: grey levels by which neighbours differ.
    """

    frames: np.ndarray
    line: np.ndarray
    rows: int
    place: np.ndarray
    lines: np.ndarray
    grid: np.ndarray
    white: float
    noise: float

    def swing(self, indices: list[int]) -> np.ndarray:
        """Return the range of grey levels, (p,) float32, from the darkest to the brightest of these
        frames."""
        chosen = self.frames[indices]
        return chosen.max(axis=0) - chosen.min(axis=0)

    @property
    def least_swing(self) -> float:
        """Grey levels by which a pixel must vary to show a pattern."""
        return max(2 * limits.DARK_LEVELS * self.white / 255, NOISE_RANGE * self.noise)


def sample_lines(sequence: PatternSequence, stack: np.ndarray, pixels: int = PIXELS) -> LineSample:
    """Sample rows and columns of an (n, h, w) stack, spread evenly over the area that the patterns
    illuminate."""
    return sample_frames(stack, coded_frames(sequence), pixels, sequence.full_scale)


def sample_frames(
    stack: np.ndarray, coded: list[int], pixels: int = PIXELS, full_scale: int | None = None
) -> LineSample:
    """Sample rows and columns of an (n, h, w) stack whose frames ``coded`` show a pattern, see
    `sample_lines`."""
    height, width = stack.shape[1:]
    step = max(1, min(height, width) // GRID)
    grid = np.ascontiguousarray(stack[:, step // 2 :: step, step // 2 :: step])
    coded_grid = grid[coded]
    swing = (coded_grid.max(axis=0) - coded_grid.min(axis=0)).astype(np.float32)
    white = clip_level(grid.dtype, int(grid.max()), full_scale)
    pattern = np.maximum(swing - 2 * limits.DARK_LEVELS * white / 255, 0)
    rows = _select_lines(pattern.sum(axis=1), step, height, round(pixels / width))
    columns = _select_lines(pattern.sum(axis=0), step, width, round(pixels / height / BLOCK))
    columns = np.unique(np.minimum(columns[:, None] + np.arange(BLOCK), width - 1))
    lines = np.ascontiguousarray(stack[:, rows])
    across = stack[:, :, columns].transpose(0, 2, 1)
    frames = np.concatenate(
        [lines.reshape(len(stack), -1), across.reshape(len(stack), -1)], axis=1
    ).astype(np.float32)
    line = np.concatenate(
        [
            np.repeat(np.arange(len(rows)), width),
            len(rows) + np.repeat(np.arange(len(columns)), height),
        ]
    )
    place = np.concatenate(
        [np.tile(np.arange(width), len(rows)), np.tile(np.arange(height), len(columns))]
    )
    noise = estimate_roughness(frames[coded][:, : len(rows) * width], width)
    return LineSample(frames, line, len(rows), place, lines, grid, white, noise)


def grid_sample(sample: LineSample) -> LineSample:
    """Return the pixels of the thinned image as a sample of their own."""
    count, height, width = sample.grid.shape
    place = np.tile(np.arange(width), height)
    line = np.repeat(np.arange(height), width)
    return replace(
        sample,
        frames=sample.grid.reshape(count, -1).astype(np.float32),
        line=line,
        rows=height,
        place=place,
    )


def _select_lines(weight: np.ndarray, step: int, size: int, count: int) -> np.ndarray:
    """Select about ``count`` of ``size`` rows or columns, with a density in proportion to
    ``weight``.

    ``weight``: of every ``step``-th row or column.
    """
    count = max(1, min(count, size))
    total = np.cumsum(weight + 1e-3 * max(float(weight.max()), 1e-6))
    places = np.interp((np.arange(count) + 0.5) / count * total[-1], total, np.arange(len(total)))
    return np.unique(np.clip(np.rint(places * step), 0, size - 1).astype(int))


def coded_frames(sequence: PatternSequence, axis: Axis | None = None) -> list[int]:
    """Return the indices of the frames that show a pattern, along one axis or any."""
    axes = sequence.axes if axis is None else (axis,)
    return sorted({i for a in axes for i in sequence.select(a) if sequence.frames[i].axis == a})
