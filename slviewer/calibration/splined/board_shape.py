"""The board as an unknown: a smooth height, and features that are not quite where they should be.

The height is a sum of products of Legendre polynomials of degrees 2 to 4 in all over the features'
rectangle: bow both ways, twist, and what bends in itself. Constants and slopes are missing because
the pose has them.
"""

import numpy as np

from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import unit_vectors

HEIGHT_DEGREES = np.array([(i, total - i) for total in (2, 3, 4) for i in range(total, -1, -1)])
"""(12, 2): of the polynomials in x and y."""
HEIGHT_TERMS = len(HEIGHT_DEGREES)
HEIGHT_SIGMA_MM = np.array([{2: 0.3, 3: 0.1, 4: 0.05}[i + j] for i, j in HEIGHT_DEGREES.tolist()])
"""(12,): prior standard deviation of a board's departure from a plane."""
OFFSET_SIGMA_MM = 0.03
"""Of a printed feature along x and along y."""
GAUGE_MM = 1e-6
"""How nearly the offsets' common shift, turn and growth are held at nothing: the poses and the
pitch have those."""


def board_frame(points: Floats) -> Floats:
    """(4,) mm: middle x, middle y, half width, half height of the features' rectangle."""
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    return np.concatenate([(low + high) / 2, np.maximum((high - low) / 2, 1e-3)])


def offset_gauge(points: Floats) -> Floats:
    """(4, 2n) unit rows: what offsets (x0, y0, x1, y1, ...) have of a shift in x and y, a turn and
    a growth."""
    x, y = (points[:, :2] - points[:, :2].mean(0)).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.array(
        [np.stack(pair, 1).ravel() for pair in ((one, none), (none, one), (-y, x), (x, y))]
    )
    return unit_vectors(rows)


@kernel()
def height_terms(x, y, frame, terms):
    """Fills (3, 12): the polynomials, and their slopes along x and along y, at a board point
    (mm)."""
    a, b = (x - frame[0]) / frame[2], (y - frame[1]) / frame[3]
    pa, pb = np.empty(5), np.empty(5)
    da, db = np.empty(5), np.empty(5)
    for p, d, s in ((pa, da, a), (pb, db, b)):
        p[0], p[1], d[0], d[1] = 1.0, s, 0.0, 1.0
        for n in range(1, 4):
            p[n + 1] = ((2 * n + 1) * s * p[n] - n * p[n - 1]) / (n + 1)
            d[n + 1] = d[n - 1] + (2 * n + 1) * p[n]
    k = 0
    for total in range(2, 5):
        for i in range(total, -1, -1):
            j = total - i
            terms[0, k] = pa[i] * pb[j]
            terms[1, k] = da[i] * pb[j] / frame[2]
            terms[2, k] = pa[i] * db[j] / frame[3]
            k += 1


@kernel()
def height_at(x, y, frame, heights, terms):
    """(z, dz/dx, dz/dy) of the board's surface at a board point; leaves the terms."""
    height_terms(x, y, frame, terms)
    z = zx = zy = 0.0
    for k in range(heights.shape[0]):
        z += heights[k] * terms[0, k]
        zx += heights[k] * terms[1, k]
        zy += heights[k] * terms[2, k]
    return z, zx, zy


@kernel()
def _heights(points, frame, heights, out):
    """Fill ``out`` (n,) mm with the heights of the board's surface at ``points`` (n, 2) mm."""
    terms = np.empty((3, heights.shape[0]))
    for i in range(points.shape[0]):
        out[i], _, _ = height_at(points[i, 0], points[i, 1], frame, heights, terms)


def board_heights(points: Floats, frame: Floats, heights: Floats) -> Floats:
    """(n,) mm: z of the board's surface at board points (n, 2); positive away from the camera."""
    out = np.empty(len(points))
    _heights(np.ascontiguousarray(points[:, :2], np.float64), frame, heights, out)
    return out
