"""Errors of the phase where the surface's brightness jumps, the effect of the camera's blur, and
their correction.

A camera pixel receives light from a neighbourhood, and more of it from the brighter side: the
pixel's phase is that of a place displaced towards that side. For a Gaussian point spread of
standard deviation s the displacement is s^2 grad(ln B), B being the blurred modulation (Tweedie's
formula), so that the phase is off by s^2 grad(phi) . grad(ln B): at silhouettes, shadows and
printed edges, by far more than noise. The blur is estimated from the steepness of the edges, then
from the phase itself: a surface that continues across an edge shows how far the phase is off there.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.geometry.jit import kernel, run_rows
from slviewer.geometry.rigid import Floats32, Mask
from slviewer.geometry.robust import weighted_median
from slviewer.geometry.vectors import thin_out

TILES = (4, 5)
"""Rows and columns of tiles in which the blur is estimated: it may vary over the image."""
REACH = 8
"""px: half the width of the window whose contrast is compared with the steepest slope in it."""
CONTRAST = 0.3
"""Smallest contrast of an edge, as a share of the image's median modulation."""
NOISE_RANGE = 10.0
"""Smallest contrast of an edge in standard deviations; noise alone reaches some six in a window."""
EDGES = 10
"""Number of pixels at edges below which a tile has the blur of the whole image."""
SHARPEST = 0.35
"""Quantile of the edges' widths that is used: shading and printed gradients are wider than a
blurred step."""
LEAST_PX = 0.3
"""Standard deviation of an ideal pixel's own aperture, 12 ** -0.5, rounded up."""
SIGNIFICANT = 1.0
"""Standard deviations of noise from which on a displacement takes part in the estimate of the
blur."""
REFINED = 300
"""Number of such pixels below which nothing is corrected."""
LEVELS = 6
"""Bins between the levels on both sides of an edge; differences of pixels are steeper or flatter
than the slope of a blurred step in each of them."""
REFINED_AT_LEVEL = 50
"""Number of pixels below which a bin has the factor of all."""
REFINEMENT = (0.25, 2.5)
"""Displacement over the one expected from the edges' steepness: outside of these bounds, what looks
like printed edges is something else."""
BENT, BENT_SIGMAS = 0.04, 4.0
"""rad, and standard deviations of noise: phases on both sides of an edge that are further from one
line are those of two surfaces, or of a crease."""
REMAINING = 0.25
"""Share of a corrected displacement that remains uncertain."""
_STEP = math.sqrt(2 * math.pi)


@dataclass(frozen=True, eq=False)
class EdgeDisplacement:
    """Displacement of a phase by the camera's blur.

    ``shift``: (h, w) float32, measured less true phase, NaN where that is; ``is_continuous``: (h,
    w) bool, where the surface continues across the edge and its phase confirms the shift, which can
    be subtracted there.
    """

    shift: Floats32
    is_continuous: Mask

    @property
    def remaining(self) -> Floats32:
        """(h, w) float32: error of a phase from which the shift was subtracted where the surface is
        continuous."""
        return np.abs(self.shift) * np.where(
            self.is_continuous, np.float32(REMAINING), np.float32(1)
        )


def estimate_camera_blur(modulation: Floats32, mask: Mask, noise: float) -> Floats32:
    """Estimate the standard deviation, px, of the camera's point spread: (rows, columns) of `TILES`
    float32.

    From the steepness of the edges of the modulation (h, w) grey levels; the aperture of an ideal
    pixel where there are none. ``mask`` (h, w): pixels whose modulation is above noise, which set
    the scale of contrast. ``noise``: standard deviation of the modulation.
    """
    blur = np.full(TILES, LEAST_PX, np.float32)
    if np.count_nonzero(mask) < EDGES:
        return blur
    usual = float(np.median(thin_out(modulation[mask], 100_000)))
    size = 2 * REACH + 1
    least = max(CONTRAST * usual, NOISE_RANGE * noise)
    slopes = [np.zeros_like(modulation), np.zeros_like(modulation)]
    slopes[0][:-1], slopes[1][:, :-1] = (np.abs(np.diff(modulation, axis=axis)) for axis in (0, 1))
    places, ranges, steepness = [], [], []
    for axis, window in enumerate((np.ones((size, 1), np.uint8), np.ones((1, size), np.uint8))):
        slope = slopes[axis]
        steepest = (
            (slope == cv2.dilate(slope, window))
            & (slope >= slopes[1 - axis])
            & (slope > least / size)
        )
        contrast = cv2.dilate(modulation, window) - cv2.erode(modulation, window)
        steepest &= contrast > least
        places.append(np.argwhere(steepest))
        ranges.append(contrast[steepest])
        steepness.append(slope[steepest])
    rows, columns = np.concatenate(places).T
    widths = np.concatenate(ranges) / (np.concatenate(steepness) * np.float32(_STEP))
    if not len(widths):
        return blur
    height, width = modulation.shape
    blur[:] = max(LEAST_PX, float(np.quantile(widths, SHARPEST)))
    tile = rows * TILES[0] // height * TILES[1] + columns * TILES[1] // width
    for k in range(TILES[0] * TILES[1]):
        here = widths[tile == k]
        if len(here) >= EDGES:
            blur.flat[k] = max(LEAST_PX, float(np.quantile(here, SHARPEST)))
    return blur


def estimate_displacement(phase: Floats32, modulation: Floats32, noise: float) -> EdgeDisplacement:
    """Estimate the displacement of the ``phase`` (h, w) rad by the camera's blur.

    ``modulation`` (h, w) grey levels, of standard deviation ``noise``. Depth jumps and glossy edges
    add errors of their own.
    """
    noise = max(noise, 1e-3)
    blur = estimate_camera_blur(modulation, np.isfinite(phase), noise)
    sigma = cv2.resize(blur, phase.shape[::-1], interpolation=cv2.INTER_LINEAR)
    shift, is_continuous = np.empty_like(phase), np.zeros(phase.shape, bool)
    level = np.zeros(phase.shape, np.uint8)
    run_rows(
        _displace,
        len(phase),
        modulation,
        phase,
        sigma,
        np.float32(noise),
        shift,
        is_continuous,
        level,
    )
    factors = _confirm(
        phase, modulation, EdgeDisplacement(shift, is_continuous), level, float(blur.max()), noise
    )
    is_continuous &= bool(factors.any())
    np.multiply(shift, factors[level], out=shift, where=is_continuous)
    return EdgeDisplacement(shift, is_continuous)


def _confirm(
    phase: Floats32,
    modulation: Floats32,
    displaced: EdgeDisplacement,
    level: NDArray[np.uint8],
    blur: float,
    noise: float,
) -> Floats32:
    """Return the factor (LEVELS,) by which displacements become those of the phase from a straight
    line.

    The line continues the phase of an edge's bright side, from beyond the reach of the ``blur``,
    px. 0 where too few pixels show it, or it is not plausible at every level: shadows of a lamp out
    of focus, highlights and creases look like printed edges, and displace otherwise.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        v, u = np.nonzero(
            displaced.is_continuous & (np.abs(displaced.shift) * modulation > SIGNIFICANT * noise)
        )
    height, width = phase.shape
    far = _beyond_blur(blur)
    inside = (v >= 2 * far) & (u >= 2 * far) & (v < height - 2 * far) & (u < width - 2 * far)
    v, u = v[inside], u[inside]
    if len(v) < REFINED:
        return np.zeros(LEVELS, np.float32)
    rise_u, rise_v = (modulation[v + k, u + 1 - k] - modulation[v - k, u - 1 + k] for k in (0, 1))
    across = np.abs(rise_u) >= np.abs(rise_v)
    dv, du = (
        np.where(along, np.sign(rise) * far, 0).astype(int)
        for along, rise in ((~across, rise_v), (across, rise_u))
    )
    shift = displaced.shift[v, u]
    ratio = (phase[v, u] - 2 * phase[v + dv, u + du] + phase[v + 2 * dv, u + 2 * du]) / shift
    known = np.isfinite(ratio)
    if np.count_nonzero(known) < REFINED:
        return np.zeros(LEVELS, np.float32)
    ratio, weight, bins = ratio[known], np.abs(shift[known]), level[v, u][known]
    factors = np.full(LEVELS, weighted_median(ratio, weight), np.float32)
    for k in np.flatnonzero(np.bincount(bins, minlength=LEVELS) >= REFINED_AT_LEVEL):
        factors[k] = weighted_median(ratio[bins == k], weight[bins == k])
    is_confirmed = REFINEMENT[0] <= factors.min() <= factors.max() <= REFINEMENT[1]
    return factors if is_confirmed else np.zeros(LEVELS, np.float32)


@kernel()
def _beyond_blur(sigma):
    """Return the distance, px, at which a step ten times as bright as its other side displaces
    nothing any more."""
    return int(np.float32(3) * sigma) + 1


@kernel()
def _displace(first, last, modulation, phase, sigma, noise, shift, is_continuous, level):
    """Fill ``shift`` (h, w) with s^2 grad(phi) . grad(ln B) less the part that noise causes,
    ``is_continuous``, and ``level`` with the pixel's place, 0 ... LEVELS - 1, between the dark and
    the bright side of an edge.

    Slopes of B are taken over about half a standard deviation, of phi on its brighter side.
    """
    height, width = phase.shape
    for v in range(first, last):
        for u in range(width):
            if not np.isfinite(phase[v, u]):
                shift[v, u] = np.nan
                continue
            here = max(modulation[v, u], noise)
            reach = max(1, int(np.float32(0.5) * (sigma[v, u] + np.float32(1))))
            left, right = max(u - reach, 0), min(u + reach, width - 1)
            top, bottom = max(v - reach, 0), min(v + reach, height - 1)
            span_u, span_v = np.float32(max(right - left, 1)), np.float32(max(bottom - top, 1))
            slope_u = _compute_log_ratio(modulation[v, right], modulation[v, left], here) / span_u
            slope_v = _compute_log_ratio(modulation[bottom, u], modulation[top, u], here) / span_v
            far = int(np.float32(2) * sigma[v, u]) + 1
            step_u, step_v = far if slope_u > 0 else -far, far if slope_v > 0 else -far
            along = _compute_slope(phase, v, u, 0, step_u)
            down = _compute_slope(phase, v, u, step_v, 0)
            found = along * slope_u + down * slope_v
            by_noise = (
                np.float32(2) * (noise / here) ** 2 * ((along / span_u) ** 2 + (down / span_v) ** 2)
            )
            size = np.sqrt(max(found * found - by_noise, np.float32(0))) * sigma[v, u] * sigma[v, u]
            shift[v, u] = size if found > 0 else -size
            beyond = _beyond_blur(sigma[v, u])
            if abs(slope_u) >= abs(slope_v):
                one = modulation[v, max(u - beyond, 0)]
                other = modulation[v, min(u + beyond, width - 1)]
                is_continuous[v, u] = _continues(phase, modulation, noise, v, u, 0, beyond)
            else:
                one = modulation[max(v - beyond, 0), u]
                other = modulation[min(v + beyond, height - 1), u]
                is_continuous[v, u] = _continues(phase, modulation, noise, v, u, beyond, 0)
            dark, bright = min(one, other), max(one, other)
            place = (here - dark) / max(bright - dark, noise)
            level[v, u] = int(min(max(place, np.float32(0)), np.float32(0.999)) * LEVELS)


@kernel()
def _continues(phase, modulation, noise, v, u, step_v, step_u):
    """Return whether the phases one and two steps from a pixel lie on one line: no depth jump, no
    crease.

    Beyond noise, and a little for curved surfaces and for what blur displaces beyond a step.
    """
    height, width = phase.shape
    far_v, far_u = 2 * step_v, 2 * step_u
    if v < far_v or u < far_u or v >= height - far_v or u >= width - far_u:
        return False
    first, before = phase[v - far_v, u - far_u], phase[v - step_v, u - step_u]
    after, last = phase[v + step_v, u + step_u], phase[v + far_v, u + far_u]
    if not (
        np.isfinite(first) and np.isfinite(before) and np.isfinite(after) and np.isfinite(last)
    ):
        return False
    near = _add_square_noise(modulation, noise, v, u, step_v, step_u)
    ends = _add_square_noise(modulation, noise, v, u, far_v, far_u)
    jump = abs(np.float32(2) * (after - before) - last + first)
    turn = abs(before - first - last + after)
    allowed, sigmas = np.float32(BENT), np.float32(BENT_SIGMAS)
    return jump < allowed + sigmas * np.sqrt(
        np.float32(4) * near + ends
    ) and turn < allowed + sigmas * np.sqrt(near + ends)


@kernel()
def _add_square_noise(modulation, noise, v, u, step_v, step_u):
    """Return the sum of the variances of the phase, rad^2, a step before and a step after a
    pixel."""
    before, after = modulation[v - step_v, u - step_u], modulation[v + step_v, u + step_u]
    return (noise / max(before, noise)) ** 2 + (noise / max(after, noise)) ** 2


@kernel()
def _compute_log_ratio(a, b, between):
    """Return ln(a / b) of levels on both sides of ``between``, itself above 0.

    To first order for a small difference.
    """
    if abs(a - b) < np.float32(0.1) * between:
        return (a - b) / between
    # two and a half standard deviations outside of a straight edge
    least = np.float32(0.05) * between
    return np.log(max(a, least) / max(b, least))


@kernel()
def _compute_slope(phase, v, u, step_v, step_u):
    """Return the slope of the phase per px, one to two steps from a pixel, on the brighter side of
    an edge.

    Nearer to the edge, blur has already flattened the phase. From the pixel itself where the
    surface ends before, 0 where it has no neighbour.
    """
    height, width = phase.shape
    step = step_v + step_u
    near_v, near_u = v + step_v, u + step_u
    if not (0 <= near_v < height and 0 <= near_u < width):
        return np.float32(0)
    near = phase[near_v, near_u]
    far_v, far_u = near_v + step_v, near_u + step_u
    if (
        0 <= far_v < height
        and 0 <= far_u < width
        and np.isfinite(near)
        and np.isfinite(phase[far_v, far_u])
    ):
        return (phase[far_v, far_u] - near) / np.float32(step)
    return (near - phase[v, u]) / np.float32(step) if np.isfinite(near) else np.float32(0)
