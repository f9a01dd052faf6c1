"""Mask of a board's pixels with undisturbed phase: bright ones, clear of the contrast edges.

The camera's lens and pixels mix bright and dark across an edge, and the phase of a bright pixel
there is that of a point farther inside the bright part: by half a blur's sigma at the edge, a tenth
at 1.3 sigma, a fortieth at 2 and a hundredth at 2.5, whatever the blur (measured on rendered boards
of known truth). The errors of opposite sides of a circle cancel, so that the error of a feature or
a smoothed surface is smallest where 2 sigma are excluded; with more, the loss of pixels adds more
noise.
"""

from collections.abc import Callable

import cv2
import numpy as np

from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.rigid import Mask

CLEARANCE_SIGMAS = 2.0
"""Distance from an edge, in standard deviations of its blur, beyond which a bright pixel's phase is
undisturbed."""
MIN_CLEARANCE_PX = 1.0
"""Smallest clearance: the uncertainty of a mask's edge."""
MIN_CLEAR_SHARE = 0.25
"""Share of the bright pixels within half a pitch that must be clear of edges; otherwise the
clearance is reduced."""
SHARPEST_PX = 12**-0.5
"""Blur of an edge by the pixel area alone."""
EDGE_BAND = 0.25
"""Pixels whose brightness differs by this share of the contrast from dark and from bright belong to
an edge; with a Gaussian blur they are within 0.6745 sigma of it."""


def bright_pixels(phase: PhaseMap, inside: Mask, pitch: float) -> Mask:
    """Select the valid pixels (h, w) bool of the board's bright parts at a distance from contrast
    edges.

    ``inside`` (h, w) bool: the board's pixels; ``pitch``: px. Bright pixels have more than half of
    the largest modulation within a pitch. The distance is 2 sigma of the edges' blur, less where
    few pixels would remain, as between the squares and markers of a ChArUco board.
    """
    modulation = np.where(inside & phase.mask, phase.modulation, 0).astype(np.float32)
    crest = _local_extreme(cv2.dilate, modulation, pitch)
    bright = (modulation > 0.5 * crest) & (modulation > 0)
    # a lone pixel lost to noise is not an edge
    dark = cv2.morphologyEx((~bright).view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    sigma = edge_blur_px(phase, inside, pitch)
    # px from the edge, half a px before the first dark pixel's middle
    apart = cv2.distanceTransform(1 - dark, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
    clear = np.zeros_like(bright)
    window = (2 * int(pitch / 2) + 1,) * 2
    around = cv2.blur(bright.astype(np.float32), window)
    for share in (1.0, 0.8, 0.6, 0.3):
        few = cv2.blur(clear.astype(np.float32), window) < MIN_CLEAR_SHARE * around
        clear |= few & bright & (apart > max(share * CLEARANCE_SIGMAS * sigma, MIN_CLEARANCE_PX))
    return clear


def edge_blur_px(phase: PhaseMap, inside: Mask, pitch: float) -> float:
    """Estimate the blur of the board's contrast edges by lens and pixels, standard deviation in px.

    It is proportional to the area of intermediate pixels over the length of the edges.
    """
    modulation = np.asarray(phase.modulation, np.float32)
    crest, trough = (_local_extreme(of, modulation, pitch) for of in (cv2.dilate, cv2.erode))
    contrast = crest - trough
    # the board's outline is not an edge
    edged = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    edged &= contrast > 0.4 * crest
    level = np.clip((modulation - trough) / np.maximum(contrast, 1e-6), 0, 1)
    area = np.count_nonzero(edged & (level > EDGE_BAND) & (level < 1 - EDGE_BAND))
    across, down = cv2.Sobel(level, cv2.CV_32F, 1, 0), cv2.Sobel(level, cv2.CV_32F, 0, 1)
    steep = np.maximum(np.hypot(across, down), 1e-6)
    high = level > 0.5
    # an edge of length L with its normal at (n_u, n_v) crosses L n_u rows and L n_v columns
    rows = (high[:, 1:] != high[:, :-1]) & edged[:, 1:] & edged[:, :-1]
    columns = (high[1:] != high[:-1]) & edged[1:] & edged[:-1]
    across, down = np.abs(across) / steep, np.abs(down) / steep
    length = float(across[:, 1:][rows].sum() + down[1:][columns].sum())
    if length < pitch:
        return SHARPEST_PX
    return float(np.clip(area / length / (2 * 0.6745), SHARPEST_PX, pitch / 8))


def _local_extreme(
    of: Callable[..., np.ndarray], modulation: np.ndarray, pitch: float
) -> np.ndarray:
    """(h, w): the largest or smallest modulation within a pitch, by ``cv2.dilate`` or
    ``cv2.erode``."""
    shrink = max(1, int(pitch // 12))
    small = cv2.blur(modulation, (shrink, shrink))[::shrink, ::shrink] if shrink > 1 else modulation
    reach = 2 * int(np.ceil(0.7 * pitch / shrink)) + 1
    extreme = of(small, np.ones((reach, reach), np.uint8))
    return cv2.resize(extreme, modulation.shape[::-1], interpolation=cv2.INTER_LINEAR)
