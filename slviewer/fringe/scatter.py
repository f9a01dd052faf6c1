"""Noise of the phase measured from neighbouring pixels, which includes what the residual over phase
steps does not.

Lossy compression adds errors that are partly in the fringe's own harmonic. The n steps of a pixel
fit these as well as the fringe itself, so that the noise of grey levels predicts too little; but
the phase of a smooth surface then scatters more than predicted from pixel to pixel, or, where JPEG
has smoothed its blocks of 8 x 8 pixels, from block to block.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from slviewer.fringe.cosines import compute_median
from slviewer.fringe.phase import PhaseMap, Reason

WINDOW = 16
"""px: side of a window, two blocks of JPEG."""
WINDOWS = 14
"""Windows that are sampled along a column of the image, and along a row."""
HOLES = 0.2
"""Largest share of a window's pixels without a phase: strong compression spoils single ones all
over an image. A block has some left."""
FEWEST = 30
"""Number of valid windows below which the scatter is not measured."""
BLOCK = 8
"""px: side of a block of JPEG, and of the parts of a window whose third differences are
averaged."""
QUANTILE = 0.25
"""Quantile of the blocks' ratios of observed to predicted variance that is used: up to three
quarters of a scene may be edges and texture."""
SIGNIFICANT = 2.0
"""Times the predicted standard deviation, below which none is raised without compression: the
relief of an object, which is no noise, reaches 1.3."""
BLOCKINESS = 1.5
"""Third differences across the borders of blocks over those inside, from which an image counts as
compressed: without compression noise leaves it within 1.15, with JPEG of quality 85 it is 2 to
3."""
ROUNDING = 1 / 12
"""Variance of a rounded grey level: frames without noise still have it, and residuals may not
include it."""
_VARIANCES = 20.0  # of a third difference: 1 + 9 + 9 + 1
_FREEDOM = 25.0  # of the mean over a block: its differences overlap


@dataclass(frozen=True)
class Scatter:
    """Scatter of the phase between neighbouring pixels.

    ``ratio``: observed over predicted standard deviation of the phase; NaN for too few valid
    pixels. ``blockiness``: phase differences across the borders of a grid of 8 x 8 pixels over
    those inside; 1 without a grid.
    """

    ratio: float
    blockiness: float

    @property
    def is_compressed(self) -> bool:
        """Whether the frames were compressed as JPEG."""
        return self.blockiness > BLOCKINESS


def with_scatter(phase: PhaseMap) -> PhaseMap:
    """Return the phase map with the measured ``sigma_scale``, where it is significant."""
    scatter = measure_scatter(phase)
    raised = scatter.ratio > (1.0 if scatter.is_compressed else SIGNIFICANT)
    return replace(phase, sigma_scale=scatter.ratio) if raised else phase


def measure_scatter(phase: PhaseMap) -> Scatter:
    """Measure the scatter of the phase between neighbouring pixels of smooth surfaces, relative to
    ``phase.noise``."""
    if not phase.steps or min(phase.phase.shape) < WINDOW:
        return Scatter(np.nan, 1.0)
    first = _select_valid_windows(phase)
    if len(first) < FEWEST:
        return Scatter(np.nan, 1.0)
    values, background, modulation = (
        _cut_windows(each, first) for each in (phase.phase, phase.background, phase.modulation)
    )
    values = values - np.nanmean(values, axis=(1, 2), keepdims=True)  # exact enough in float32
    holes = _fill_holes(values)
    third = [np.diff(values, n=3, axis=axis) for axis in (1, 2)]
    blockiness = max(
        _measure_blockiness(np.abs(np.moveaxis(third[i], i + 1, 2)), first[:, i]) for i in range(2)
    )
    a, b = phase.noise
    predicted = np.maximum(np.float32(a) + np.float32(b) * background, np.float32(ROUNDING))
    predicted *= np.float32(2 / phase.steps) / np.maximum(modulation, np.float32(1e-6)) ** 2
    predicted += np.float32(phase.model_error_rad**2)
    predicted[holes] = 0  # they do not scatter
    if blockiness > BLOCKINESS:
        ratio = float(np.median(_compute_window_variance(values) / predicted.mean(axis=(1, 2))))
        return Scatter(float(np.sqrt(ratio)), blockiness)
    ratios = np.sort(_compute_block_variance(values) / _split_blocks(predicted).mean(axis=(1, 2)))
    # A chi squared of so many degrees of freedom has its quantile here (Wilson and Hilferty 1931).
    spread = 2 / (9 * _FREEDOM)
    expected = (1 - spread - 0.6745 * np.sqrt(spread)) ** 3
    return Scatter(float(np.sqrt(ratios[int(QUANTILE * len(ratios))] / expected)), blockiness)


def _select_valid_windows(phase: PhaseMap) -> np.ndarray:
    """Return row and column of the first pixel (m, 2) of evenly spread windows in which every pixel
    is valid, or nearly every where these are few."""
    height, width = phase.phase.shape
    corners = [
        np.unique(np.linspace(0, size - WINDOW, min(WINDOWS, size // WINDOW)).astype(int))
        for size in (height, width)
    ]
    first = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, 2)
    holes = (_cut_windows(phase.reason, first) != Reason.VALID).mean(axis=(1, 2))
    is_whole = holes == 0
    return first[is_whole if np.count_nonzero(is_whole) >= FEWEST else holes <= HOLES]


def _fill_holes(values: np.ndarray) -> np.ndarray:
    """Give the NaN of windows (m, WINDOW, WINDOW), in place, the values of the cubic surface fitted
    to the others; return where they were."""
    basis, holes = _make_cubic_basis(), np.isnan(values)
    for k in np.flatnonzero(holes.any(axis=(1, 2))):
        window, here = values[k], holes[k].ravel()
        fitted = np.linalg.lstsq(basis[~here], window[~holes[k]], rcond=None)[0]
        window[holes[k]] = basis[here] @ fitted
    return holes


def _cut_windows(image: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the windows (m, WINDOW, WINDOW) of an image (h, w) whose ``first`` pixels (m, 2) are
    given."""
    return np.lib.stride_tricks.sliding_window_view(image, (WINDOW, WINDOW))[*first.T]


def _measure_blockiness(third: np.ndarray, first: np.ndarray) -> float:
    """Measure the blockiness, see `Scatter`, from sizes of third differences (m, lines, WINDOW -
    3).

    The differences are along the last axis; ``first`` (m,): px at which each window begins along
    it.
    """
    offset = (first[:, None] + np.arange(third.shape[2])) % BLOCK
    size = third.mean(axis=1)
    sizes = np.array([compute_median(size[offset == k]) for k in range(BLOCK)])
    if not np.isfinite(sizes).all():
        return 1.0
    k = int(np.argmax(sizes))
    # A pattern of columns that repeats every two or four is the sensor's.
    return float(sizes[k] / max(compute_median(sizes), sizes[(k + BLOCK // 2) % BLOCK], 1e-12))


def _compute_window_variance(values: np.ndarray) -> np.ndarray:
    """Return the variance (m,) of windows (m, WINDOW, WINDOW) about the cubic surface fitted to
    each."""
    basis, flat = _make_cubic_basis(), values.reshape(len(values), -1).astype(np.float64)
    remaining = (flat**2).sum(axis=1) - (np.einsum("mp,pk->mk", flat, basis) ** 2).sum(axis=1)
    return np.asarray(remaining / (WINDOW**2 - basis.shape[1]))


@cache
def _make_cubic_basis() -> np.ndarray:
    """Return orthonormal cubic surfaces (WINDOW^2, 10) of a window."""
    x = np.linspace(-1, 1, WINDOW)
    powers = [np.outer(x**i, x**j).ravel() for i in range(4) for j in range(4 - i)]
    return np.asarray(np.linalg.qr(np.stack(powers, axis=1))[0])


def _compute_block_variance(values: np.ndarray) -> np.ndarray:
    """Return the variance (4 m,) of each block of the windows, from third differences along rows
    and columns."""
    blocks = _split_blocks(values)
    squares = [(np.diff(blocks, n=3, axis=axis) ** 2).mean(axis=(1, 2)) for axis in (1, 2)]
    return np.asarray((squares[0] + squares[1]) / (2 * _VARIANCES))


def _split_blocks(windows: np.ndarray) -> np.ndarray:
    """Split windows (m, WINDOW, WINDOW) into blocks (4 m, BLOCK, BLOCK)."""
    parts = WINDOW // BLOCK
    split = windows.reshape(-1, parts, BLOCK, parts, BLOCK)
    return split.transpose(0, 1, 3, 2, 4).reshape(-1, BLOCK, BLOCK)
