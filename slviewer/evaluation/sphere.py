"""How round and how large a cloud measures spheres."""

from dataclasses import dataclass

import numpy as np

from slviewer.evaluation.fit import ShapeResult, fit_shape
from slviewer.evaluation.region import find_sphere, find_spheres, start_sphere
from slviewer.geometry.shapes import Sphere, fit_sphere


@dataclass(frozen=True, eq=False)
class SphereResult(ShapeResult):
    """``ShapeResult`` of a sphere with free radius; errors are positive outwards."""

    sphere: Sphere

    @property
    def radius_mm(self) -> float:
        """Radius of the fitted sphere."""
        return self.sphere.radius


def evaluate_sphere(
    points: np.ndarray,
    mask: np.ndarray | None,
    sigma_z: np.ndarray | None = None,
    radius: float | None = None,
    start: Sphere | None = None,
) -> SphereResult:
    """Fit a sphere to a cloud ``(h, w, 3)`` mm, NaN where invalid, and measure the radial distances
    from it.

    ``mask`` ``(h, w)``: the pixels that show the sphere; None: the largest round patch is found.
    ``sigma_z`` ``(h, w)`` mm: the expected noise of z. ``radius`` in mm, roughly, helps to find the
    sphere; the fitted radius stays free, as in the Letter's Table 2. ``start``: about where the
    sphere lies, if that is known.
    """
    if mask is None:
        start, mask = find_sphere(points, sigma_z=sigma_z, radius=radius)
    elif start is None:
        start = start_sphere(points, mask, sigma_z, radius)
    sphere, result = fit_shape(points, mask, sigma_z, start, fit_sphere)
    return SphereResult(**vars(result), sphere=sphere)


def evaluate_spheres(
    points: np.ndarray, count: int, sigma_z: np.ndarray | None = None, radius: float | None = None
) -> list[SphereResult]:
    """The ``count`` spheres of one cloud, such as a ball bar's two, from left to right; otherwise
    as above."""
    spheres = find_spheres(points, count, sigma_z, radius)
    return [evaluate_sphere(points, region, sigma_z, radius, start) for start, region in spheres]
