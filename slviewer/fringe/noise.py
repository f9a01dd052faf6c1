"""Measurement of the camera's noise from the frames of one capture."""

from functools import cache
from typing import NamedTuple

import numpy as np

from slviewer.fringe.cosines import compute_median, cosine_columns, fit_common_harmonics, fit_cosine
from slviewer.fringe.layout import Layout

ROWS = 20
"""Image rows that are sampled."""
BLOCK = 8
"""Neighbouring pixels whose variances are averaged before the median: single variances are too
skewed."""
BINS = 16
DARKEST = 0.05
"""Of white: darker blocks that never change may be image without noise."""
QUANTISATION = 1 / 12
"""Variance of rounding to whole grey levels, in squared grey levels: no frame has less noise."""
OWN_HARMONICS = 4
"""Highest harmonic that is fitted pixel by pixel; those that gamma adds beyond it are below the
noise."""


class Blocks(NamedTuple):
    """Noise of blocks of pixels: their mean ``levels`` (b,), and ``variances`` (b,) of one frame's
    grey level, each with so many degrees of ``freedom``."""

    levels: np.ndarray
    variances: np.ndarray
    freedom: float


def measure_noise(layout: Layout, stack: np.ndarray, white: float) -> tuple[float, float]:
    """Measure (a, b): the variance of one frame's grey level is a + b * level, in squared grey
    levels.

    Both non-negative, and together at least what rounding to whole grey levels adds.

    From the residual of an n-step phase shift: per pixel, cosines up to a harmonic that n allows
    are removed; then, from all pixels together, what the remaining harmonics have in common with
    the fringe, so that gamma does not count as noise. Three steps, and Gray code alone, have no
    such residual, nor have pixels that are black or saturated in one of the steps (a gamma of 2.2
    can make that all pixels): then from the constancy of Gray + inverse, or from differences along
    image rows or columns, whichever are smaller: those along the stripes. Sampled from a few rows,
    or columns, of the image.
    """
    bins = list[Blocks]()
    if layout.steps >= 4:
        bins.append(_measure_phase_step_noise(sample(stack, layout.shifts[-1].indices), white))
    elif len(layout.inverse) >= 2:
        bins.append(
            _measure_inverse_noise(sample(stack, layout.gray), sample(stack, layout.inverse), white)
        )
    if not any(len(each.levels) for each in bins):
        frames = layout.shifts[-1].indices if layout.shifts else (layout.white, layout.black)
        # without either, the bit of the fewest edges
        indices = tuple(i for i in frames if i is not None) or layout.gray[:1] + layout.inverse[:1]
        bins = [
            _measure_difference_noise(sample(s, indices), white)
            for s in (stack, stack.transpose(0, 2, 1))
        ]
    fits = [_bin_variances(*measured) for measured in bins if len(measured.levels)]
    # Fringes and texture only ever add to the differences.
    a, b = _fit_line(*min(fits, key=_compute_mean_variance)) if fits else (0.0, 0.0)
    return (a, b) if a + b * white / 2 > QUANTISATION else (QUANTISATION, 0.0)


def _compute_mean_variance(bins: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Return the mean variance of the bins, weighted by their counts."""
    _, variances, counts = bins
    return float(variances @ counts / counts.sum())


def sample(stack: np.ndarray, indices: tuple[int, ...]) -> np.ndarray:
    """Sample evenly spread rows of the frames: (n, rows, blocks, BLOCK) of their dtype; pixels that
    fill whole blocks."""
    height, width = stack.shape[1:]
    rows = np.unique(np.linspace(0, height - 1, min(ROWS, height)).round().astype(int))
    block = BLOCK if width >= BLOCK else 1
    step = max(1, width // (block * 64))
    used, whole = width // block * block, np.dtype((np.void, block * stack.itemsize))
    out = np.empty((len(indices), len(rows), -(-used // (block * step)), block), stack.dtype)
    for sampled, i in zip(out.view(whole)[..., 0], indices, strict=True):
        lines = np.ascontiguousarray(stack[i][rows][:, :used])
        sampled[:] = lines.view(whole)[:, ::step]  # a block is one item
    return out


def _measure_phase_step_noise(samples: np.ndarray, white: float) -> Blocks:
    """Measure the noise of blocks from the residual of cosines in the phase steps."""
    n = len(samples)
    samples = _select_unclipped(samples, white)  # (n, blocks, BLOCK)
    own = max(1, min(OWN_HARMONICS, (n - 1) // 2 - 2))
    frames = samples.reshape(n, -1)
    background, phasor = fit_cosine(frames)
    residue = frames - background
    if own < OWN_HARMONICS:
        residue -= fit_common_harmonics(frames, phasor, own)
    freedom = n - 1 - 2 * own
    # Not a matrix product: BLAS would start its threads for this little, and they get in the way of
    # numba's.
    residue = np.einsum("wk,kp->wp", _list_residual_directions(n, own), residue)
    variance = (
        np.einsum("wp,wp->p", residue, residue).reshape(samples.shape[1:]).mean(axis=-1) / freedom
    )
    return Blocks(samples.mean(axis=(0, 2)), variance, freedom * samples.shape[-1])


@cache
def _list_residual_directions(n: int, own: int) -> np.ndarray:
    """Return orthonormal rows (n - 1 - 2 own, n) float32: what cosines up to harmonic ``own`` of n
    steps do not fit."""
    basis, _ = np.linalg.qr(cosine_columns(np.arange(n), n, own), mode="complete")
    return np.ascontiguousarray(basis[:, 1 + 2 * own :].T.astype(np.float32))


def _measure_inverse_noise(gray: np.ndarray, inverse: np.ndarray, white: float) -> Blocks:
    """Measure the noise of blocks from sums of bits and their inverses."""
    both = _select_unclipped(np.concatenate([gray, inverse]), white)
    total = both[: len(gray)] + both[len(gray) :]
    # Interreflected light and room light hardly differ between neighbours.
    rest = total - total.mean(axis=0)
    rest -= rest.mean(axis=-1, keepdims=True)
    freedom = (len(total) - 1) * max(total.shape[-1] - 1, 1)
    variances = (rest**2).sum(axis=(0, -1)) / (2 * freedom)
    return Blocks(total.mean(axis=(0, -1)) / 2, variances, freedom)


def _measure_difference_noise(samples: np.ndarray, white: float) -> Blocks:
    """Measure the noise of blocks from third differences along a line.

    Fringes and shading are nearly quadratic over four pixels.
    """
    if samples.shape[-1] < BLOCK:
        return Blocks(np.zeros(0), np.zeros(0), 1.0)
    usable = _select_unclipped(samples, white)
    if usable.size:
        samples = usable.reshape(-1, samples.shape[-1])  # each frame has its own level
    else:
        is_unclipped = (samples.max(axis=-1) < white) & (samples.min(axis=-1) > 0)
        samples = samples[is_unclipped].astype(np.float32)
    # Independent noise of variance 1 gives third differences with coefficients 1, 3, 3, 1 the
    # covariances c = 20, -15, 6, -1 at distances d = 0 ... 3. The mean square of the five in a
    # block has the relative variance 2 / f of a chi squared with f degrees of freedom, where
    # f = (5 c_0)^2 / (5 c_0^2 + 2 sum_d (5 - d) c_d^2) = 2.5.
    squares = np.diff(samples, n=3, axis=-1) ** 2
    return Blocks(samples.mean(axis=-1), squares.mean(axis=-1) / 20, 2.5)


def _select_unclipped(samples: np.ndarray, white: float) -> np.ndarray:
    """Return the sampled blocks (n, blocks, BLOCK) float32 that are clipped neither at white nor at
    black in any of the n frames, which would hide noise, nor have one level throughout, as bars
    and masks do, which are not image; in the `DARKEST`, compression may have removed the noise."""
    highest, lowest = samples.max(axis=0).max(axis=-1), samples.min(axis=0).min(axis=-1)
    is_image = (highest > lowest) | (highest < DARKEST * white)
    usable = ((highest < white) & (lowest > 0) & is_image).ravel()
    blocks = samples.reshape(len(samples), usable.size, samples.shape[-1])
    return np.compress(usable, blocks, axis=1).astype(np.float32)


def _bin_variances(
    levels: np.ndarray, variances: np.ndarray, freedom: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean level, robust variance and number of blocks in bins of equal count."""
    order = np.argsort(levels)
    bins = [b for b in np.array_split(order, min(BINS, max(1, len(order) // 24))) if len(b)]
    to_mean = (1 - 2 / (9 * freedom)) ** 3  # the median of chi squared over its mean
    return (
        np.array([levels[b].mean() for b in bins], np.float64),
        np.array([compute_median(variances[b]) for b in bins]) / to_mean,
        np.array([len(b) for b in bins], np.float64),
    )


def _fit_line(levels: np.ndarray, variances: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Fit non-negative (a, b) of variance = a + b level, each bin weighted by its own precision."""
    if len(levels) < 2:
        return (float(variances[0]) if len(levels) else 0.0), 0.0
    weight = np.sqrt(counts) / np.maximum(variances, 0.1 * variances.mean() + 1e-12)
    design = np.stack([np.ones_like(levels), levels], axis=1) * weight[:, None]
    target = variances * weight
    products, sums = design.T @ design, design.T @ target
    (aa, ab), (_, bb) = products
    determinant = aa * bb - ab**2
    a, b = bb * sums[0] - ab * sums[1], aa * sums[1] - ab * sums[0]
    if determinant > 0 and a >= 0 and b >= 0:
        return float(a / determinant), float(b / determinant)
    # one of the two is 0: of which the other explains more
    alone = np.maximum(sums, 0) / np.diag(products)
    return (
        (float(alone[0]), 0.0)
        if alone[0] * sums[0] >= alone[1] * sums[1]
        else (0.0, float(alone[1]))
    )
