"""Compiled loops over the points of one scan that compare them with the surface of another."""

from typing import NamedTuple

import numpy as np

from slviewer.geometry.jit import kernel

MIN_NORMAL_COSINE = 0.5
"""Least cosine between the normals of one surface."""
FIELDS = 12
"""Number of sums per point: weight, weight x height, (weight x noise)^2, weight x systematic,
weight x normal (3), number of other scans, weight of colour, weight x colour (3)."""


class SurfaceGrid(NamedTuple):
    """Images (h, w, ...) of a scan's surface, and its ``to_pixel``: see `view.View`."""

    points: np.ndarray
    normals: np.ndarray
    noise: np.ndarray
    systematic: np.ndarray
    inner: np.ndarray
    quality: np.ndarray
    to_pixel: np.ndarray


@kernel()
def pixel_of(x, y, z, to_pixel, shape):
    """Return the (row, column) whose ray passes (x, y, z) mm in the camera's frame; -1 outside the
    scan of a ``shape`` (h, w).

    ``to_pixel``: see ``view._fit_pixel_map``.
    """
    if not z > 0.0:
        return -1, -1
    a = (x / z - to_pixel[0]) / to_pixel[2]
    b = (y / z - to_pixel[1]) / to_pixel[3]
    if abs(a) > 1.02 or abs(b) > 1.02:
        return -1, -1
    u = v = 0.0
    k = 4
    power = 1.0
    for i in range(6):
        term = power
        for _ in range(6 - i):
            u += to_pixel[k] * term
            v += to_pixel[k + 21] * term
            term *= b
            k += 1
        power *= a
    if not (u > -0.5 and v > -0.5 and u < shape[1] - 0.5 and v < shape[0] - 0.5):
        return -1, -1
    return int(np.rint(v)), int(np.rint(u))


@kernel()
def interpolate_surface(p, n, reach, gate, grid, mean):
    """Interpolate a scan's surface at a point ``p`` (3,) mm with normal ``n`` in its frame; False
    where it has none.

    Fills ``mean`` (8,): height above p along n, its variance, systematic sigma, border weight,
    normal (3), and the pixel (v * width + u). The height is a weighted mean over the tangent planes
    of pixels within ``reach`` mm across n and ``gate`` mm along n. Where these planes differ by
    more than their noise, the surface is curved: the variance increases by what exceeds twice that
    of the noise.
    """
    points, normals, noise = grid.points, grid.normals, grid.noise
    height, width = noise.shape
    row, column = pixel_of(p[0], p[1], p[2], grid.to_pixel, noise.shape)
    if row < 0:
        return False
    total = squares = t = tt = noises = s = w = m0 = m1 = m2 = 0.0
    for y in range(max(row - 2, 0), min(row + 3, height)):
        for x in range(max(column - 2, 0), min(column + 3, width)):
            if not np.isfinite(points[y, x, 2]):
                continue
            d0, d1, d2 = points[y, x, 0] - p[0], points[y, x, 1] - p[1], points[y, x, 2] - p[2]
            along = d0 * n[0] + d1 * n[1] + d2 * n[2]
            near = 1.0 - (d0 * d0 + d1 * d1 + d2 * d2 - along * along) / (reach * reach)
            if near <= 0.0:
                continue
            q0, q1, q2 = normals[y, x, 0], normals[y, x, 1], normals[y, x, 2]
            cosine = q0 * n[0] + q1 * n[1] + q2 * n[2]
            if cosine < MIN_NORMAL_COSINE:
                continue
            rise = (q0 * d0 + q1 * d1 + q2 * d2) / cosine
            if abs(rise) > gate:
                continue
            total += near
            t += near * rise
            tt += near * rise * rise
            variance = noise[y, x] * noise[y, x]
            noises += near * variance
            squares += near * near * variance
            s += near * grid.systematic[y, x]
            w += near * grid.inner[y, x]
            m0, m1, m2 = m0 + near * q0, m1 + near * q1, m2 + near * q2
    if not total > 0.3:  # a single pixel at the rim of the reach is not enough
        return False
    t /= total
    curvature = max(tt / total - t * t - 2.0 * noises / total, 0.0)
    mean[0] = t
    mean[1] = squares / (total * total) + curvature
    mean[2] = s / total
    mean[3] = w / total
    length = np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    mean[4], mean[5], mean[6] = m0 / length, m1 / length, m2 / length
    mean[7] = row * width + column
    return True


@kernel()
def measure_heights(first, last, p, n, reach, gate, grid, heights):
    """Measure the heights of a scan's surface above points ``p`` (k, 3) mm with normals ``n`` (k,
    3) in its frame.

    Fills ``heights`` (k, 2): the height in mm and the index of the pixel; (NaN, -1) without
    overlap.
    """
    for i in range(first, last):
        mean = np.empty(8)
        heights[i, 0], heights[i, 1] = np.nan, -1.0
        if interpolate_surface(p[i], n[i], reach, gate, grid, mean):
            heights[i, 0], heights[i, 1] = mean[0], mean[7]


@kernel()
def add_votes(first, last, p, gate, points, witnesses, to_pixel, votes):
    """Add a scan's votes on points ``p`` (k, 3) mm in its frame; only its pixels ``witnesses`` (h,
    w) bool vote, with its surface ``points`` (h, w, 3) mm.

    Adds 1 to ``votes`` (k,) where its surface is within ``gate`` mm in depth, and -1 where the
    surface is more than 1.5 gates behind the point, which is thus in the scan's free space. A
    surface in front hides the point, and one between both is undecided: no vote.
    """
    for i in range(first, last):
        y, x = pixel_of(p[i, 0], p[i, 1], p[i, 2], to_pixel, witnesses.shape)
        if y < 0 or not witnesses[y, x]:
            continue
        behind = points[y, x, 2] - p[i, 2]
        if abs(behind) <= gate:
            votes[i] += 1
        elif behind > 1.5 * gate:
            votes[i] -= 1


@kernel()
def add_surface(
    first, last, p, n, own, R, reach, gate, grid, colours, gain, earlier, sums, inferior
):
    """Add a scan's surface to the ``sums`` (k, FIELDS) of points ``p`` (k, 3) with normals ``n``
    (k, 3) in its frame.

    ``R`` (3, 3): rotation from its frame to the reference's. ``inferior`` (k,) is set True where
    the scan's quality exceeds the points' ``own`` (k,), or equals it if the scan is the ``earlier``
    one.
    """
    height, width = grid.noise.shape
    for i in range(first, last):
        mean = np.empty(8)
        if not interpolate_surface(p[i], n[i], reach, gate, grid, mean):
            continue
        y, x = int(mean[7]) // width, int(mean[7]) % width
        weight = mean[3] / (mean[1] + mean[2] * mean[2])
        sums[i, 0] += weight
        sums[i, 1] += weight * mean[0]
        sums[i, 2] += weight * weight * mean[1]
        sums[i, 3] += weight * mean[2]
        for k in range(3):
            sums[i, 4 + k] += weight * (R[k, 0] * mean[4] + R[k, 1] * mean[5] + R[k, 2] * mean[6])
        sums[i, 7] += 1.0
        if len(colours) == height:
            sight = -(p[i, 0] * n[i, 0] + p[i, 1] * n[i, 1] + p[i, 2] * n[i, 2])
            sight /= np.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2 + p[i, 2] ** 2)
            share = mean[3] * max(sight, 0.0)
            sums[i, 8] += share
            for k in range(3):
                sums[i, 9 + k] += share * gain * colours[y, x, k]
        rival = grid.quality[y, x]
        if rival > own[i] or (rival == own[i] and earlier):
            inferior[i] = True
