"""Points that only the first of two cameras sees, measured by that camera and the projector.

The projector may have moved since it was calibrated, which the cameras do not notice. Where both
measure, they are compared: a projector turned by 1 mrad measures 1.3 to 3.6 mm beside the cameras,
hundreds of times what is predicted, and then fills nothing.

Where both measure, the cameras' points stay as they are. Both share the first camera's phase: on
planes of the simulated pair their errors have a correlation of 0.93, and a mean weighted by inverse
variances has 1.09 to 1.12 times the error of the cameras alone, on spheres 1.03 to 1.06 times. On
steep parts of a rough object it would have 0.70 to 0.84 times that, but every point would move with
the projector then.
"""

from dataclasses import replace

import numpy as np

from slviewer.geometry.rigid import Mask
from slviewer.geometry.vectors import rms
from slviewer.reconstruction.cloud import Cloud, Map, number_tiles
from slviewer.records.merge import ProjectorFill

TILES = (5, 6)
"""Rows and columns of tiles of what the cloud covers: a projector that turned is off in all of
them, or differently in each."""
LEAST_IN_TILE = 50
"""Points, below which a tile says nothing."""
LEAST_TILES = 6
"""Below, the cameras say too little of the projector."""
MOST_DIFFERENT = 4.0
"""Times the predicted difference that is measured at most. Scans of the simulated pair show 0.1 to
1.1, and 60 to 540 where its projector turned by 1 mrad."""


def fill_unseen(cloud: Cloud, lit: Cloud, unseen: Mask) -> Cloud:
    """Return the ``cloud`` of two cameras with the points that the second one does not see taken
    from ``lit``, the cloud of the first camera and the projector in the same frame of reference,
    and with the `ProjectorFill`.

    ``unseen`` (h, w) bool: the pixels to fill. Their sigma contains the difference of both clouds
    where both measure, as far as that exceeds its prediction. Where it is too large, or there is
    too little to compare, no point is filled.
    """
    filled = unseen & lit.mask
    points = int(np.count_nonzero(filled))
    different, predicted = compare_clouds(cloud, lit)
    is_used = different <= MOST_DIFFERENT * predicted  # False for NaN
    known = {} if np.isnan(different) else {"different_mm": different, "predicted_mm": predicted}
    fill = ProjectorFill(points, is_used, **known)
    if not (points and is_used):
        return replace(cloud, fill=fill)
    excess = np.float32(max(different**2 - predicted**2, 0.0) ** 0.5)
    edges = np.float32(0.0) if lit.sigma_edges is None else lit.sigma_edges
    return replace(
        cloud,
        points=np.where(filled[..., None], lit.points, cloud.points),
        sigma_z=np.where(filled, lit.sigma_z, cloud.sigma_z),
        sigma_calibration=_choose(filled, lit.sigma_calibration, cloud.sigma_calibration),
        sigma_edges=_choose(filled, np.hypot(edges, excess), cloud.sigma_edges),
        extrapolated=_choose(filled, lit.extrapolated, cloud.extrapolated),
        fill=fill,
    )


def _choose(filled: Mask, lit: Map | None, own: Map | None) -> Map | None:
    """Return a map with the values of ``lit`` where ``filled``; None, which stands for zeros, if
    both are."""
    some = own if lit is None else lit
    if some is None:
        return None
    zero = np.zeros((), some.dtype)
    return np.where(filled, zero if lit is None else lit, zero if own is None else own)


def compare_clouds(cloud: Cloud, lit: Cloud) -> tuple[float, float]:
    """Return the RMS of the median differences of depth, mm, in tiles of what two clouds of one
    grid both measure, and of what their uncertainties predict; NaN where that is too little."""
    v, u = np.nonzero(cloud.mask & lit.mask)
    if not len(v):
        return np.nan, np.nan
    corner = np.array([u.min(), v.min()])
    size = int(np.ptp(u)) + 1, int(np.ptp(v)) + 1
    tile = number_tiles(np.column_stack([u, v]) - corner, size, TILES)
    difference = (lit.points[v, u, 2] - cloud.points[v, u, 2]).astype(float)
    scattered, common = np.zeros(len(v)), np.zeros(len(v))
    for each in (cloud, lit):
        scattered += each.sigma_z[v, u].astype(float) ** 2
        if each.sigma_edges is not None:  # of either sign, at either side of an edge
            scattered += each.sigma_edges[v, u].astype(float) ** 2
        if each.sigma_calibration is not None:
            common += each.sigma_calibration[v, u].astype(float) ** 2
    different, predicted = list[float](), list[float]()
    for number in np.unique(tile):
        chosen = tile == number
        count = np.count_nonzero(chosen)
        if count >= LEAST_IN_TILE:
            different.append(float(np.median(difference[chosen])))
            of_median = np.median(scattered[chosen]) * (np.pi / 2) / count
            predicted.append(float(np.sqrt(np.median(common[chosen]) + of_median)))
    if len(different) < LEAST_TILES:
        return np.nan, np.nan
    return rms(different), rms(predicted)
