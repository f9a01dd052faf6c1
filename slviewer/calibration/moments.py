"""Fit ``z = (c0 + c1 phi)/(1 + c2 phi)`` at each pixel from moments in float64, some image rows at
a time.

Depth and phase are relative to a reference point of each pixel (``zeta = z - z_ref``, ``s = phi -
phi_ref``), which leaves the rational family as it is, ``zeta = (a0 + a1 s)/(1 + a2 s)``, and keeps
the sums well conditioned.
"""

import numba
import numpy as np

from slviewer.geometry.jit import kernel


@kernel(parallel=True)
def fit_rational(
    phase, z, phase_ref, z_ref, min_poses, coefficients, rms, poses, phase_min, phase_max, condition
):
    """Fit pixels of some rows to their poses: phase (n, h', w) rad and depth z (n, h', w) mm, NaN
    where invalid.

    Fills ``coefficients`` (3, h', w) a0 ... a2 and ``rms`` mm, NaN at pixels of fewer than
    ``min_poses`` poses; ``poses``, the range of valid ``phase``, and the fit's ``condition``, (h',
    w) each. First the equation's own residual is minimised, which is linear, ``zeta = a0 + a1 s -
    a2 zeta s``; then one Gauss-Newton step minimises the residual in depth.
    """
    for v in numba.prange(phase.shape[1]):
        a = np.empty(10)
        for u in range(phase.shape[2]):
            reference = phase_ref[v, u]
            count, low, high = _sum_linear_moments(phase, z, v, u, reference, z_ref, a)
            poses[v, u], phase_min[v, u], phase_max[v, u] = count, low, high
            a0 = a1 = a2 = residual = scaled_condition = np.nan
            if count >= min_poses:
                a0, a1, a2, _, _ = _solve_moments(a)
                if not np.isnan(a0):
                    _sum_gauss_newton_moments(phase, z, v, u, reference, z_ref, a0, a1, a2, a)
                    b0, b1, b2, explained, scaled_condition = _solve_moments(a)
                    a0, a1, a2 = a0 + b0, a1 + b1, a2 + b2
                    residual = np.sqrt(max(0.0, a[9] - explained) / count)
            coefficients[0, v, u], coefficients[1, v, u], coefficients[2, v, u] = a0, a1, a2
            rms[v, u], condition[v, u] = residual, scaled_condition


@numba.njit
def _sum_linear_moments(phase, z, v, u, phase_ref, z_ref, a):
    """Fill the sums ``a``: upper triangle of the normal matrix (6) and right-hand side (3). Returns
    the number of valid poses and the range of their phases."""
    a[:] = 0.0
    count, low, high = 0, np.inf, -np.inf
    for i in range(phase.shape[0]):
        p = phase[i, v, u]
        s, zeta = p - phase_ref, z[i, v, u] - z_ref
        if not (np.isfinite(s) and np.isfinite(zeta)):
            continue
        q = -zeta * s
        a[0] += 1.0
        a[1] += s
        a[2] += q
        a[3] += s * s
        a[4] += s * q
        a[5] += q * q
        a[6] += zeta
        a[7] += s * zeta
        a[8] += q * zeta
        count += 1
        low, high = min(low, p), max(high, p)
    return count, low, high


@numba.njit
def _sum_gauss_newton_moments(phase, z, v, u, phase_ref, z_ref, a0, a1, a2, a):
    """Fill ``a`` (10,) with one pixel's Gauss-Newton sums for z = (a0 + a1 s) / (1 + a2 s) over the
    poses.

    ``s`` is the phase less ``phase_ref``, z less ``z_ref``. a[:6]: upper triangle of the normal
    matrix, a[6:9]: its right side, a[9]: sum of the squared residuals; poses with NaN are skipped.
    """
    a[:] = 0.0
    for i in range(phase.shape[0]):
        s = phase[i, v, u] - phase_ref
        w = 1.0 / (1.0 + a2 * s)
        model = (a0 + a1 * s) * w
        r = z[i, v, u] - z_ref - model
        if not (np.isfinite(s) and np.isfinite(r)):
            continue
        j1, j2 = s * w, -s * w * model
        a[0] += w * w
        a[1] += w * j1
        a[2] += w * j2
        a[3] += j1 * j1
        a[4] += j1 * j2
        a[5] += j2 * j2
        a[6] += w * r
        a[7] += j1 * r
        a[8] += j2 * r
        a[9] += r * r


@numba.njit
def _solve_moments(a):
    """Solve the normal equations ``a`` by Cholesky of the normalised matrix.

    Returns the three unknowns, the sum of squares that they explain, and the condition; NaN without
    a solution.
    """
    none = np.nan
    if a[0] <= 0 or a[3] <= 0 or a[5] <= 0:
        return none, none, none, none, none
    d0, d1, d2 = 1 / np.sqrt(a[0]), 1 / np.sqrt(a[3]), 1 / np.sqrt(a[5])
    m01, m02, m12 = a[1] * d0 * d1, a[2] * d0 * d2, a[4] * d1 * d2
    y0, b1, b2 = a[6] * d0, a[7] * d1, a[8] * d2
    l11s = 1 - m01 * m01
    if not l11s > 1e-12:
        return none, none, none, none, none
    l11 = np.sqrt(l11s)
    l21 = (m12 - m01 * m02) / l11
    l22s = 1 - m02 * m02 - l21 * l21
    if not l22s > 1e-12:
        return none, none, none, none, none
    l22 = np.sqrt(l22s)
    y1 = (b1 - m01 * y0) / l11
    y2 = (b2 - m02 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    x0 = y0 - m01 * x1 - m02 * x2
    return x0 * d0, x1 * d1, x2 * d2, y0 * y0 + y1 * y1 + y2 * y2, 1 / min(l11, l22)
