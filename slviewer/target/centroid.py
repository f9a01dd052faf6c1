"""Sub-pixel centres of circles: centroids of their ink, relative to the brightness of the paper around them."""

import numpy as np
from numpy.typing import NDArray

from slviewer.target.blobs import Blobs

EDGE_WIDTH_PX = 2.5
"""Distance in px by which the camera's PSF blurs a circle's edge outwards."""
RING_PX = 5.0
"""Width of the ring beyond the soft edge from which the paper's brightness is read."""
CORE_RADIUS = 0.6
"""Share of a circle's radius that its blurred edge does not reach."""
INITIAL_GATE = 0.35
"""Largest variation of the background around a circle, over its contrast: light that halves across one circle."""
GATE_SIGMAS = 4.0
FLATNESS = 0.04
"""Pixels of the ring are background within so many standard deviations of its plane, or this share of the contrast."""
MIN_RING_PIXELS = 8
"""Smallest number of pixels for a plane fit."""


def refine_centres(image: NDArray[np.float32], blobs: Blobs) -> NDArray[np.float64]:
    """Return the centroids (n, 2) float64 px of the circles' ink, relative to the brightness around each circle.

    ``image`` (h, w) float32; ``blobs`` describe the circles' ellipses to some tenths of a pixel. Ink is ``1 - I / W``
    with W the plane through the paper's brightness next to the circle, so that uneven light does not move the centroid;
    for bright circles, ink is the excess over the background, divided by the plane of their own brightness. NaN where
    too little paper is visible around a circle, or where the result is too far from the initial centre.
    """
    centres, covariances, inverted = blobs.centres, blobs.covariances, blobs.inverted
    ring_px = _ring_widths(centres, covariances)
    refined = np.full(centres.shape, np.nan)
    for k, (centre, covariance) in enumerate(zip(centres, covariances, strict=True)):
        refined[k] = _measure_centroid(image, centre, covariance, float(ring_px[k]), inverted)
    off = np.linalg.norm(refined - centres, axis=1)
    refined[~(off < np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))] = np.nan
    return refined


def _ring_widths(centres: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return the width (n,) px of the paper between each circle's edge and its nearest neighbour's."""
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(1)
    towards = (centres[nearest] - centres) / apart.min(1)[:, None]
    # half the width of an ellipse along a direction e: 2 sqrt(e C e), C being a quarter of the squared half axes
    own, other = (
        2 * np.sqrt(np.einsum("ni,nij,nj->n", towards, c, towards)) for c in (covariances, covariances[nearest])
    )
    return np.asarray(apart.min(1) - own - other)


def _measure_centroid(
    image: np.ndarray, centre: np.ndarray, covariance: np.ndarray, gap: float, inverted: bool
) -> tuple[float, float]:
    """Return the sub-pixel centroid (u, v) px of one circle; NaN where it cannot be measured."""
    soft = min(EDGE_WIDTH_PX, 0.3 * gap)
    reach = 2 * np.sqrt(np.diag(covariance)) + min(EDGE_WIDTH_PX + RING_PX, gap - soft) + 1
    u0, v0 = np.maximum(np.floor(centre - reach), 0).astype(int)
    u1, v1 = np.minimum(np.ceil(centre + reach) + 1, image.shape[::-1]).astype(int)
    patch = image[v0:v1, u0:u1].astype(np.float64)
    du, dv = np.meshgrid(np.arange(u0, u1) - centre[0], np.arange(v0, v1) - centre[1])
    (a, b), (_, c) = np.linalg.inv(covariance) / 4
    radius = np.sqrt(a * du * du + 2 * b * du * dv + c * dv * dv)  # 1 on the edge
    beyond = np.hypot(du, dv) * (1 - 1 / np.maximum(radius, 1e-6))  # px from the edge, outwards
    ring = (beyond > soft) & (beyond < min(EDGE_WIDTH_PX + RING_PX, gap - soft))
    if np.count_nonzero(ring) < MIN_RING_PIXELS:
        return np.nan, np.nan
    within = beyond < soft
    ground = _fit_paper_level(du, dv, patch, ring, _quantile(patch[radius < CORE_RADIUS], 0.5))
    if inverted:
        light = _fit_plane(du, dv, patch, radius < CORE_RADIUS)
        ink = (patch - ground) / np.maximum(light, 1.0)
    else:
        ink = 1 - patch / np.maximum(ground, 1.0)
    ink = ink[within]
    total = ink.sum()
    if total <= 0:
        return np.nan, np.nan
    return float(centre[0] + ink @ du[within] / total), float(centre[1] + ink @ dv[within] / total)


def _fit_paper_level(du: np.ndarray, dv: np.ndarray, patch: np.ndarray, ring: np.ndarray, ink: float) -> np.ndarray:
    """Fit a plane (h, w) to the brightness of the ``ring`` (h, w) bool around a circle, without edges or other blobs.

    Where the ring does not fit one plane, the fit starts with the quarter that differs most from the circle's own level
    ``ink`` and continues with the pixels within the noise of the plane.
    """
    plane = _fit_plane(du, dv, patch, ring)
    levels = patch[ring]
    ground = _quantile(levels, 0.75 if ink < _quantile(levels, 0.5) else 0.25)
    contrast = abs(ground - ink)
    if np.abs(levels - plane[ring]).max() < FLATNESS * contrast:
        return plane
    near = ring & (np.abs(patch - ground) < INITIAL_GATE * contrast)
    for _ in range(2):
        if np.count_nonzero(near) < MIN_RING_PIXELS:
            return plane
        plane = _fit_plane(du, dv, patch, near)
        off = np.abs(patch - plane)
        near = ring & (off < max(GATE_SIGMAS * 1.4826 * _quantile(off[near], 0.5), FLATNESS * contrast))
    return _fit_plane(du, dv, patch, near) if np.count_nonzero(near) >= MIN_RING_PIXELS else plane


def _quantile(values: np.ndarray, share: float) -> float:
    """Return a quantile without interpolation, which for few values is faster than NumPy's."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])


def _fit_plane(du: np.ndarray, dv: np.ndarray, values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Fit a plane (h, w) to the ``values`` (h, w) ``where`` (h, w) bool, by least squares."""
    A = np.stack([np.ones(int(np.count_nonzero(where))), du[where], dv[where]], axis=1)
    c = np.linalg.lstsq(A, values[where], rcond=None)[0]
    return np.asarray(c[0] + c[1] * du + c[2] * dv)
