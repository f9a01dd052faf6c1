"""Depth of one pixel from its phase, as a CUDA device measures it: each model's own function, compiled for one camera.

A function takes (pixel, phase, c, extra) and returns (x, y, z, |dz/dphi|), mm and mm/rad; points that are not measured
are NaN. The pixel is a uint64, as unsigned indices are taken as they are; ``c`` (m, n) and ``extra`` (k,) lie on the
device. Imported only where there is one.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda

from slviewer.geometry.triangulation import MARGIN, MAX_STEPS, TOLERANCE_PX

ZERO, ONE, NONE = np.float32(0), np.float32(1), np.float32(math.nan)


def pixelwise(pixels: int, gain: float, centre: float) -> Callable[..., Any]:
    """``c`` (5, n) and ``extra`` (2 n,) float32 are `onepass_kernels.Depths`' coefficients and bounds."""
    per_rad, middle, largest_at = np.float32(gain), np.float32(centre), np.uint64(pixels)

    @cuda.jit(device=True)
    def measure(i, phase, c, extra):
        s = per_rad * phase - middle
        c0, c1, c2 = c[0, i], c[1, i], c[2, i]
        per = ONE / (ONE + c2 * s)
        z = (c0 + c1 * s) * per
        if not (s >= extra[i] and s <= extra[largest_at + i] and z > ZERO):
            z = NONE
        return c[3, i] * z, c[4, i] * z, z, abs(c1 - c0 * c2) * per * per * per_rad

    return measure


def splined(
    width: int, grid: tuple[int, int, int], step: int, gain: float, centre: float, near: float, per_mm: float
) -> Callable[..., Any]:
    """``c`` (5, n) and ``extra`` float32, a grid of that shape flattened, are `onepass_kernels.Depths`' own."""
    _, columns, layers = grid
    per_rad, middle, begin, scale = (np.float32(number) for number in (gain, centre, near, per_mm))
    deepest, per_px = np.float32(layers - 1.0001), np.float32(1.0 / step)
    one, aside, lower = np.uint64(1), np.uint64(layers), np.uint64(columns * layers)

    @cuda.jit(device=True)
    def measure(i, phase, c, extra):
        s = per_rad * phase - middle
        c0, c1, c2 = c[0, i], c[1, i], c[2, i]
        per = ONE / (ONE + c2 * s)
        z = (c0 + c1 * s) * per
        slope = abs(c1 - c0 * c2) * per * per * per_rad
        depth = (z - begin) * scale
        if not (depth >= ZERO and depth <= deepest):
            return NONE, NONE, NONE, slope
        at = np.int64(i)
        v = at // width
        u = at - v * width
        j, q = v // step, u // step
        k = int(depth)
        down, right = np.float32(v - j * step) * per_px, np.float32(u - q * step) * per_px
        rest = depth - np.float32(k)
        above = np.uint64((j * columns + q) * layers + k)
        below = above + lower
        a = extra[above] + down * (extra[below] - extra[above])
        b = extra[above + one] + down * (extra[below + one] - extra[above + one])
        here = a + rest * (b - a)
        above, below = above + aside, below + aside
        a = extra[above] + down * (extra[below] - extra[above])
        b = extra[above + one] + down * (extra[below + one] - extra[above + one])
        there = a + rest * (b - a)
        z = z + (here + right * (there - here))
        return c[3, i] * z, c[4, i] * z, z, slope

    return measure


def stereo(row: int, px_per_rad: float) -> Callable[..., Any]:
    """Newton's steps of `geometry.triangulation`, in float64; ``c`` (2, n) are the camera's rays, ``extra`` (24,) R, t,
    the projector's parameters as `geometry.brown` has them, and its size."""
    to_px, other_row = np.float32(px_per_rad), 1 - row
    none = math.nan

    @cuda.jit(device=True)
    def projection(z, a0, a1, a2, e):
        depth = z * a2 + e[11]
        if not (z > 0.0 and depth > 0.0):
            return none, none, none, none
        inverse = 1.0 / depth
        x, y = (z * a0 + e[9]) * inverse, (z * a1 + e[10]) * inverse
        r2 = x * x + y * y
        if not r2 < e[21]:
            return none, none, none, none
        k1, k2, p1, p2, k3 = e[16], e[17], e[18], e[19], e[20]
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        growth = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        dxy = growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        dx = (a0 * e[11] - e[9] * a2) * inverse * inverse
        dy = (a1 * e[11] - e[10] * a2) * inverse * inverse
        u, v = e[12] * xd + e[14], e[13] * yd + e[15]
        if row == 0:
            dxx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
            return u, v, e[12] * (dxx * dx + dxy * dy), e[12] * dx
        dyy = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return v, u, e[13] * (dxy * dx + dyy * dy), e[13] * dy

    @cuda.jit(device=True)
    def measure(i, phase, c, extra):
        measured = np.float64(phase * to_px)
        uc, vc = c[0, i], c[1, i]
        a0 = extra[0] * uc + extra[1] * vc + extra[2]
        a1 = extra[3] * uc + extra[4] * vc + extra[5]
        a2 = extra[6] * uc + extra[7] * vc + extra[8]
        extent, breadth = extra[22 + row], extra[22 + other_row]
        reading = (measured - extra[14 + row]) / extra[12 + row]
        denominator = (a0 if row == 0 else a1) - a2 * reading
        if not (-0.5 - MARGIN * extent <= measured <= (1.0 + MARGIN) * extent - 0.5) or denominator == 0.0:
            return NONE, NONE, NONE, NONE
        z = -(extra[9 + row] - extra[11] * reading) / denominator  # Letter eq. 6
        seen, other, slope, straight = projection(z, a0, a1, a2, extra)
        error = measured - seen
        met = False
        for _ in range(MAX_STEPS):
            if abs(error) <= TOLERANCE_PX:
                met = True
                break
            if not abs(error) < math.inf or slope == 0.0:
                break
            step, damping = error / slope, 1.0
            new = z
            while True:  # shorten the step until it stays in view and comes nearer
                new = z + damping * step
                seen, other, slope, straight = projection(new, a0, a1, a2, extra)
                if abs(measured - seen) < abs(error):
                    break
                damping *= 0.5
                if damping < 1e-3:
                    break
            if not abs(measured - seen) < abs(error):
                break
            z, error = new, measured - seen
        inside = -0.5 - MARGIN * breadth <= other <= (1.0 + MARGIN) * breadth - 0.5
        if not (met and inside and slope * straight > 0.0):
            return NONE, NONE, NONE, NONE
        return np.float32(uc * z), np.float32(vc * z), np.float32(z), to_px * np.float32(abs(1.0 / slope))

    return measure
