"""The projector coordinate at a board feature, and its slopes there, read from the phase around
it."""

import numpy as np

from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import median_of

MAX_SAMPLES = 1024
"""Samples that a window may have; they are not more than 31 along either side."""
MAX_OFF_CENTRE = 0.35
"""Largest distance, in half widths, between the centroid of a window's samples and its centre;
beyond it, the fit would extrapolate. At a chessboard's corner two opposite squares are bright, and
their centroid is the corner."""


def fit_local_values(
    field: np.ndarray, weight: np.ndarray, pixels: Floats, radius: Floats
) -> tuple[Floats, Floats]:
    """Fit value and slopes of ``field`` (h, w) at sub-pixel ``pixels`` (n, 2), by a robust
    quadratic around each.

    ``radius`` (n,) px: half the width of each window; ``weight`` (h, w): 0 where the field is not
    used, so that the value at a dark circle's centre comes from its bright surroundings alone.
    Returns values (n,) float64 and slopes (n, 2) per px along u and v; NaN with fewer than 30
    samples in the window, or samples on one side only.
    """
    out = np.full((len(pixels), 3), np.nan)
    arrays = (np.ascontiguousarray(a, np.float64) for a in (field, weight, pixels, radius))
    run_rows(_fit_windows, len(pixels), *arrays, out)
    return out[:, 0], out[:, 1:]


@kernel()
def _solve_spd(A, b, x):  # type: ignore[no-untyped-def]
    """Solve A x = b by Cholesky, from A's lower triangle, in place.

    Calling a library's solver would add five seconds of compilation.
    """
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = np.sqrt(max(total, 1e-300))
            else:
                A[i, j] = total / A[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= A[i, k] * x[k]
        x[i] = total / A[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= A[k, i] * x[k]
        x[i] = total / A[i, i]


@kernel()
def _fit_windows(first, last, field, weight, pixels, radius, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 3) with value and slopes of a robust quadratic fit around pixels ``first``
    to ``last``.

    Where a fit is not possible, ``out`` stays as it is.
    """
    basis, value, base = np.empty((MAX_SAMPLES, 6)), np.empty(MAX_SAMPLES), np.empty(MAX_SAMPLES)
    robust, solution = np.empty(MAX_SAMPLES), np.zeros(6)
    for i in range(first, last):
        r = radius[i]
        count = _collect_samples(field, weight, pixels[i, 0], pixels[i, 1], r, basis, value, base)
        if count < 30:
            continue
        for k in range(count):
            robust[k] = value[k]
        middle = median_of(robust, count)
        inliers = _fit_quadratic(count, middle, basis, value, base, robust, solution)
        if inliers >= 0.5 * count:
            out[i, 0], out[i, 1], out[i, 2] = solution[0] + middle, solution[1] / r, solution[2] / r


@kernel()
def _collect_samples(field, weight, cu, cv, r, basis, value, base):  # type: ignore[no-untyped-def]
    """Fill in the quadratic's terms, the values and the weights of a window's samples around pixel
    (cu, cv).

    Returns their number; 0 where they are on one side only, or the window is not in the image.
    """
    if not (np.isfinite(cu) and np.isfinite(cv) and r > 1):
        return 0
    height, width = field.shape
    stride = max(1, int(np.ceil(2 * r / 30)))
    u0, u1 = max(0, int(np.ceil(cu - r))), min(width - 1, int(np.floor(cu + r)))
    v0, v1 = max(0, int(np.ceil(cv - r))), min(height - 1, int(np.floor(cv + r)))
    count = 0
    mean_x = mean_y = 0.0
    for v in range(v0, v1 + 1, stride):
        for u in range(u0, u1 + 1, stride):
            if weight[v, u] > 0 and count < MAX_SAMPLES:
                x, y = (u - cu) / r, (v - cv) / r
                terms = basis[count]
                terms[0], terms[1], terms[2] = 1.0, x, y
                terms[3], terms[4], terms[5] = x * x, x * y, y * y
                value[count], base[count] = field[v, u], weight[v, u]
                mean_x += x
                mean_y += y
                count += 1
    return 0 if np.hypot(mean_x, mean_y) > MAX_OFF_CENTRE * count else count


@kernel()
def _fit_quadratic(count, middle, basis, value, base, robust, solution):  # type: ignore[no-untyped-def]
    """Fit ``solution`` (6,) to the first ``count`` values (k,) less ``middle``, with Tukey's
    weights.

    ``basis`` (k, 6): the terms; ``base`` (k,): the weights. Fills ``robust`` (k,) with Tukey's, and
    returns the number of inliers.
    """
    residual = np.empty(count)
    for k in range(count):
        robust[k] = 1.0
    for _ in range(5):
        A, b = np.zeros((6, 6)), np.zeros(6)
        for k in range(count):
            w = base[k] * robust[k]
            if w > 0:
                for p in range(6):
                    wp = w * basis[k, p]
                    b[p] += wp * (value[k] - middle)
                    for q in range(p + 1):
                        A[p, q] += wp * basis[k, q]
        trace = A[0, 0] + A[1, 1] + A[2, 2] + A[3, 3] + A[4, 4] + A[5, 5]
        for p in range(6):
            A[p, p] += 1e-12 * trace
        _solve_spd(A, b, solution)
        for k in range(count):
            fitted = 0.0
            for p in range(6):
                fitted += basis[k, p] * solution[p]
            residual[k] = value[k] - middle - fitted
            robust[k] = abs(residual[k])
        scale = 4.685 * 1.4826 * median_of(robust, count) + 1e-6
        for k in range(count):
            t = residual[k] / scale
            robust[k] = (1 - t * t) ** 2 if abs(t) < 1 else 0.0
    inliers = 0
    for k in range(count):
        inliers += robust[k] > 0.1
    return inliers
