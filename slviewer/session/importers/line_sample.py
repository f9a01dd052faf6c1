"""Sample of some rows and columns of all frames of an undescribed capture."""

from dataclasses import dataclass

import numpy as np

from slviewer.examination import limits
from slviewer.fringe.cosines import estimate_roughness
from slviewer.fringe.layout import clip_level

PIXELS = 40_000
"""Number of pixels on rows, and on columns: twenty edges even of the most significant bit, in
either direction."""
GRID = 100
"""Pixels along the shorter side of the grid that shows where the patterns are."""
BLOCK = 4
"""Neighbouring columns that are read together: they share the memory's cache lines."""


@dataclass(frozen=True, eq=False)
class LineSample:
    """Pixels of some rows and columns of n frames.

    ``frames`` (n, p) float32 grey levels; ``line`` (p,): index of the line, image rows below
    ``rows``, columns from there; ``place`` (p,): px along a line. ``least_swing``: grey levels by
    which a pixel must vary to show a pattern.
    """

    frames: np.ndarray
    line: np.ndarray
    rows: int
    place: np.ndarray
    least_swing: float


def sample_lines(stack: np.ndarray, pixels: int = PIXELS) -> LineSample:
    """Sample rows and columns of an (n, h, w) stack, spread evenly over the area that the patterns
    illuminate."""
    height, width = stack.shape[1:]
    step = max(1, min(height, width) // GRID)
    grid = np.ascontiguousarray(stack[:, step // 2 :: step, step // 2 :: step])
    swing = (grid.max(axis=0) - grid.min(axis=0)).astype(np.float32)
    least = limits.DARK_SHARE * clip_level(grid.dtype, int(grid.max()))
    pattern = np.maximum(swing - least, 0)
    rows = _select_lines(pattern.sum(axis=1), step, height, round(pixels / width))
    columns = _select_lines(pattern.sum(axis=0), step, width, round(pixels / height / BLOCK))
    columns = np.unique(np.minimum(columns[:, None] + np.arange(BLOCK), width - 1))
    lines, across = stack[:, rows], stack[:, :, columns].transpose(0, 2, 1)
    frames = [part.reshape(len(stack), -1) for part in (lines, across)]
    counts = (len(rows), width), (len(columns), height)
    line = np.repeat(np.arange(len(rows) + len(columns)), np.repeat(*np.array(counts).T[::-1]))
    place = np.concatenate([np.tile(np.arange(size), count) for count, size in counts])
    levels = np.concatenate(frames, axis=1).astype(np.float32)
    noise = estimate_roughness(levels[:, : len(rows) * width], width)
    return LineSample(levels, line, len(rows), place, max(least, limits.DARK_SIGMAS * noise))


def _select_lines(weight: np.ndarray, step: int, size: int, count: int) -> np.ndarray:
    """Select about ``count`` of ``size`` rows or columns, with a density in proportion to
    ``weight``.

    ``weight``: of every ``step``-th row or column.
    """
    count = max(1, min(count, size))
    total = np.cumsum(weight + 1e-3 * max(float(weight.max()), 1e-6))
    places = np.interp((np.arange(count) + 0.5) / count * total[-1], total, np.arange(len(total)))
    return np.unique(np.clip(np.rint(places * step), 0, size - 1).astype(int))
