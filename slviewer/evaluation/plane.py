"""How flat a cloud measures a flat board."""

from dataclasses import dataclass

import numpy as np

from slviewer.evaluation.fit import ShapeResult, fit_shape
from slviewer.evaluation.region import find_plane, start_plane
from slviewer.geometry.shapes import Plane, fit_plane


@dataclass(frozen=True, eq=False)
class PlaneResult(ShapeResult):
    """``ShapeResult`` of a plane (Letter eq. 12); errors are positive towards the camera."""

    plane: Plane


def evaluate_plane(
    points: np.ndarray,
    mask: np.ndarray | None,
    sigma_z: np.ndarray | None = None,
    start: Plane | None = None,
) -> PlaneResult:
    """Fit a plane to a cloud ``(h, w, 3)`` mm, NaN where invalid, and measure the distances from
    it.

    ``mask`` ``(h, w)``: the pixels that show the plane; None: the largest flat patch is found.
    ``sigma_z`` ``(h, w)`` mm: the expected noise of z, for the noise floor. ``start``: about where
    the plane lies, if that is known.
    """
    if mask is None:
        start, mask = find_plane(points, sigma_z=sigma_z)
    elif start is None:
        start = start_plane(points, mask, sigma_z)
    plane, result = fit_shape(points, mask, sigma_z, start, fit_plane)
    return PlaneResult(**vars(result), plane=plane)
