"""The Brown distortion polynomial as compiled functions (Letter eq. 3 and 5), shared by lenses and
kernels.

Kernels take a lens as ten numbers, ``parameters = [fx, fy, cx, cy, k1, k2, p1, p2, k3, fold]``,
where ``fold`` is the squared radius (normalised) at which the radial polynomial stops growing:
beyond it one pixel belongs to two rays, and nothing past it is ever returned.
"""

import numpy as np

from slviewer.geometry.jit import kernel

TOLERANCE = 1e-12
"""Normalised units at which an inversion has converged: far below the promised 1e-9, and above
rounding."""
MAX_STEPS = 60


def fold_radius_squared(D: np.ndarray) -> float:
    """Smallest r^2 at which d(r')/dr = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 vanishes; inf if it never
    does."""
    k1, k2, _, _, k3 = D
    roots = np.roots(np.trim_zeros(np.array([7 * k3, 5 * k2, 3 * k1, 1.0]), "f"))
    real = roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))].real
    positive = real[real > 0]
    return float(positive.min()) if positive.size else float("inf")


@kernel()
def distort_point(x, y, parameters):
    """Return distorted normalised (x, y) and the derivatives (dx'/dx, dx'/dy, dy'/dy); the Jacobian
    is symmetric."""
    k1, k2, p1, p2, k3 = parameters[4], parameters[5], parameters[6], parameters[7], parameters[8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d(radial)/dx = slope x
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    dxx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, dxx, dxy, dyy


@kernel()
def undistort_point(xd, yd, parameters):
    """Undistorted normalised (x, y) of a distorted point by damped Newton steps; NaN where it fails
    or folds over."""
    fold = parameters[9]
    x, y = xd, yd
    r2 = x * x + y * y
    if r2 >= 0.81 * fold:  # start inside the fold, where the polynomial still grows
        shrink = np.sqrt(0.81 * fold / r2)
        x *= shrink
        y *= shrink
    fx, fy, dxx, dxy, dyy = distort_point(x, y, parameters)
    ex, ey = xd - fx, yd - fy
    error = ex * ex + ey * ey
    for _ in range(MAX_STEPS):
        determinant = dxx * dyy - dxy * dxy
        if not determinant > 0.0:
            return np.nan, np.nan
        if error <= TOLERANCE * TOLERANCE:
            return x, y
        sx = (dyy * ex - dxy * ey) / determinant
        sy = (dxx * ey - dxy * ex) / determinant
        damping = 1.0
        while True:  # shorten the step until it stays inside the fold and comes nearer
            nx, ny = x + damping * sx, y + damping * sy
            fx, fy, dxx, dxy, dyy = distort_point(nx, ny, parameters)
            ex, ey = xd - fx, yd - fy
            new_error = ex * ex + ey * ey
            if nx * nx + ny * ny < fold and new_error < error:
                break
            damping *= 0.5
            if damping < 1e-4:
                return np.nan, np.nan
        x, y, error = nx, ny, new_error
    return np.nan, np.nan


@kernel()
def distort_to_px(x, y, parameters):
    """Return the pixel (u, v) of an undistorted normalised point; NaN at and past the fold."""
    if not x * x + y * y < parameters[9]:
        return np.nan, np.nan
    xd, yd, _, _, _ = distort_point(x, y, parameters)
    return parameters[0] * xd + parameters[2], parameters[1] * yd + parameters[3]


@kernel()
def distort_all(first, last, normalised, parameters, pixels):
    """Fill ``pixels`` (n, 2) from undistorted normalised coordinates (n, 2); NaN at and past the
    fold."""
    for i in range(first, last):
        pixels[i, 0], pixels[i, 1] = distort_to_px(normalised[i, 0], normalised[i, 1], parameters)


@kernel()
def undistort_all(first, last, pixels, parameters, normalised):
    """Fill ``normalised`` (n, 2) with undistorted coordinates of pixels (n, 2); NaN where the
    inversion fails."""
    for i in range(first, last):
        xd = (pixels[i, 0] - parameters[2]) / parameters[0]
        yd = (pixels[i, 1] - parameters[3]) / parameters[1]
        normalised[i, 0], normalised[i, 1] = undistort_point(xd, yd, parameters)


@kernel()
def project_all(first, last, points, parameters, pixels):
    """Fill ``pixels`` (n, 2) with projections of points (n, 3) in the lens's frame; NaN behind the
    lens and past the fold."""
    for i in range(first, last):
        z = points[i, 2]
        pixels[i, 0] = np.nan
        pixels[i, 1] = np.nan
        if z > 0.0:
            pixels[i, 0], pixels[i, 1] = distort_to_px(
                points[i, 0] / z, points[i, 1] / z, parameters
            )
