"""Sub-pixel centres of circles: centroids of their ink, relative to the brightness of the paper
around them."""

import numpy as np

from slviewer.geometry.jit import kernel, read_only, run_rows
from slviewer.geometry.rigid import Floats, Floats32
from slviewer.geometry.vectors import lengths
from slviewer.target.blobs import Blobs

EDGE_WIDTH_PX = 2.5
"""Distance in px by which the camera's PSF blurs a circle's edge outwards."""
RING_PX = 5.0
"""Width of the ring beyond the soft edge from which the paper's brightness is read."""
CORE_RADIUS = 0.6
"""Share of a circle's radius that its blurred edge does not reach."""
INITIAL_GATE = 0.35
"""Largest variation of the background around a circle, over its contrast: light that halves across
one circle."""
GATE_SIGMAS = 4.0
FLATNESS = 0.04
"""Pixels of the ring are background within so many standard deviations of its plane, or this share
of the contrast."""
MIN_RING_PIXELS = 8
"""Smallest number of pixels for a plane fit."""


def refine_centres(image: Floats32, blobs: Blobs) -> Floats:
    """Return the centroids (n, 2) float64 px of the circles' ink, relative to the brightness around
    each circle.

    ``image`` (h, w) float32; ``blobs`` describe the circles' ellipses to some tenths of a pixel.
    Ink is ``1 - I / W`` with W the plane through the paper's brightness next to the circle, so that
    uneven light does not move the centroid; for bright circles, ink is the excess over the
    background, divided by the plane of their own brightness. NaN where too little paper is visible
    around a circle, or where the result is too far from the initial centre.
    """
    centres, covariances = blobs.centres, blobs.covariances
    refined = np.full(centres.shape, np.nan)
    arrays = [
        read_only(np.ascontiguousarray(each, np.float64))
        for each in (centres, covariances, _ring_widths(centres, covariances))
    ]
    image = read_only(np.ascontiguousarray(image))
    run_rows(_measure_centroids, len(centres), image, *arrays, blobs.inverted, refined)
    off = lengths(refined - centres)
    refined[~(off < np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))] = np.nan
    return refined


def _ring_widths(centres: Floats, covariances: Floats) -> Floats:
    """Return the width (n,) px of the paper between each circle's edge and its nearest
    neighbour's."""
    apart = lengths(centres[:, None] - centres)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(1)
    towards = (centres[nearest] - centres) / apart.min(1)[:, None]
    # half the width of an ellipse along a direction e: 2 sqrt(e C e), C being a quarter of the
    # squared half axes
    own, other = (
        2 * np.sqrt(np.einsum("ni,nij,nj->n", towards, c, towards))
        for c in (covariances, covariances[nearest])
    )
    return apart.min(1) - own - other


@kernel()
def _measure_centroids(first, last, image, centres, covariances, gaps, inverted, out):
    """Fill ``out`` (n, 2) with the centroids px of circles ``first`` to ``last``; others stay as
    they are.

    ``gaps`` (n,): width px of the paper around each circle.
    """
    height, width = image.shape
    for k in range(first, last):
        u, v = centres[k]
        (xx, xy), (_, yy) = covariances[k]
        soft = min(EDGE_WIDTH_PX, 0.3 * gaps[k])
        end = min(EDGE_WIDTH_PX + RING_PX, gaps[k] - soft)
        far_u, far_v = 2 * np.sqrt(xx) + end + 1, 2 * np.sqrt(yy) + end + 1
        determinant = xx * yy - xy * xy
        if not (np.isfinite(u + v + far_u + far_v) and determinant > 0.0):
            continue
        u0, v0 = max(int(np.floor(u - far_u)), 0), max(int(np.floor(v - far_v)), 0)
        u1, v1 = min(int(np.ceil(u + far_u)) + 1, width), min(int(np.ceil(v + far_v)) + 1, height)
        size = max(u1 - u0, 0) * max(v1 - v0, 0)
        place, level = np.empty((2, size)), np.empty(size)
        within, ring, core = np.zeros((3, size), np.bool_)
        i = 0
        for row in range(v0, v1):
            for column in range(u0, u1):
                du, dv = column - u, row - v
                square = (yy * du * du - 2 * xy * du * dv + xx * dv * dv) / (4 * determinant)
                radius = np.sqrt(max(square, 0.0))  # 1 on the edge
                # px from the edge, outwards
                beyond = np.sqrt(du * du + dv * dv) * (1 - 1 / max(radius, 1e-6))
                place[0, i], place[1, i], level[i] = du, dv, image[row, column]
                within[i], ring[i] = beyond < soft, soft < beyond < end
                core[i] = radius < CORE_RADIUS
                i += 1
        if np.count_nonzero(ring) < MIN_RING_PIXELS or not core.any():
            continue
        ground = _fit_paper_level(place, level, ring, _quantile(level[core], 0.5))
        light = _fit_plane(place, level, core) if inverted else ground
        paper, own = _plane_at(ground, place), np.maximum(_plane_at(light, place), 1.0)
        ink = ((level - paper) / own if inverted else 1 - level / own)[within]
        total = ink.sum()
        if total > 0.0:
            out[k, 0] = u + (ink * place[0][within]).sum() / total
            out[k, 1] = v + (ink * place[1][within]).sum() / total


@kernel()
def _fit_paper_level(place, level, ring, ink):
    """Fit a plane to the brightness ``level`` (n,) of the ``ring`` (n,) around a circle, without
    edges or other blobs.

    Where the ring does not fit one plane, the fit starts with the quarter that differs most from
    the circle's own level ``ink`` and continues with the pixels within the noise of the plane.
    ``place`` (2, n) px from the circle's centre.
    """
    plane = _fit_plane(place, level, ring)
    levels = level[ring]
    ground = _quantile(levels, 0.75 if ink < _quantile(levels, 0.5) else 0.25)
    contrast = abs(ground - ink)
    off = np.abs(level - _plane_at(plane, place))
    if off[ring].max() < FLATNESS * contrast:
        return plane
    near = ring & (np.abs(level - ground) < INITIAL_GATE * contrast)
    for _ in range(2):
        if np.count_nonzero(near) < MIN_RING_PIXELS:
            return plane
        plane = _fit_plane(place, level, near)
        off = np.abs(level - _plane_at(plane, place))
        near = ring & (
            off < max(GATE_SIGMAS * 1.4826 * _quantile(off[near], 0.5), FLATNESS * contrast)
        )
    return _fit_plane(place, level, near) if np.count_nonzero(near) >= MIN_RING_PIXELS else plane


@kernel()
def _quantile(values, share):
    """Return a quantile of ``values`` (n,) without interpolation."""
    return np.sort(values)[int(share * (len(values) - 1))]


@kernel()
def _fit_plane(place, level, where):
    """Return the plane (mean level, slope along u, along v, mean u, mean v) of least squares
    through pixels ``where``.

    Its slopes are 0 where the pixels are on one line.
    """
    u, v, brightness = place[0][where], place[1][where], level[where]
    mean_u, mean_v, mean = u.mean(), v.mean(), brightness.mean()
    du, dv, dl = u - mean_u, v - mean_v, brightness - mean
    uu, uv, vv = (du * du).sum(), (du * dv).sum(), (dv * dv).sum()
    ul, vl = (du * dl).sum(), (dv * dl).sum()
    determinant = uu * vv - uv * uv
    if not determinant > 1e-9 * uu * vv:
        return mean, 0.0, 0.0, mean_u, mean_v
    along_u, along_v = (vv * ul - uv * vl) / determinant, (uu * vl - uv * ul) / determinant
    return mean, along_u, along_v, mean_u, mean_v


@kernel()
def _plane_at(plane, place):
    """Return the levels (n,) of a plane at pixels ``place`` (2, n)."""
    return plane[0] + plane[1] * (place[0] - plane[3]) + plane[2] * (place[1] - plane[4])
